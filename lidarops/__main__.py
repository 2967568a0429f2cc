"""The command line, as ``lidarops`` and ``python -m lidarops``."""

import sys

from lidarops.errors import LidarOpsError


def main() -> None:
    """Run the command line; an installed package that cannot be imported costs one line."""
    try:
        # The options of commands depend on the installed kinds of product.
        from lidarops.cli import app  # noqa: PLC0415
    except LidarOpsError as error:
        sys.exit(f"error: {error}")
    app(prog_name="lidarops")


if __name__ == "__main__":
    main()
