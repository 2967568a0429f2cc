"""What a package outside of lidarops adds to it: a raw format."""
