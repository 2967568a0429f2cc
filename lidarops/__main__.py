"""``python -m lidarops``: the command line."""

from lidarops.cli import app

if __name__ == "__main__":
    app(prog_name="lidarops")
