"""The HTML report of a run and of a benchmark, the run record, and `lidarops inspect`."""
