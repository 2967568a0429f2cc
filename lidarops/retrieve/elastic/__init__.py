"""Backscatter and extinction of particles from an elastic lidar."""
