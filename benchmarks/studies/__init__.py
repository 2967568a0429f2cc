"""Studies of guards, thresholds and tests, whose tables pages of the documentation hold."""
