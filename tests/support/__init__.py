"""Helper modules that several test modules share."""
