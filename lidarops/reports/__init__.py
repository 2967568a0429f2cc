"""The HTML report of a run, the run record, and `lidarops inspect`."""
