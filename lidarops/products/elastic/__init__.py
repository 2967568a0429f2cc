"""The ``elastic`` product: backscatter and extinction of particles from an elastic lidar."""
