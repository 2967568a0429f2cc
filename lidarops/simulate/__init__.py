"""The lidar equation forward: simulated campaigns of raw files with known truth."""
