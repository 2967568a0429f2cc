"""Headers of Licel files with all their values on one level, as tests vary them one by one."""

from __future__ import annotations

from typing import Any

from lidarops.raw import licel


def new_header(**values: Any) -> licel.Header:
    """Return the header; those of line 2 are among the values."""
    place = {name: values.pop(name) for name in licel.Place._fields if name in values}
    return licel.new_header(place=licel.Place(**place), **values)


def new_dataset(**values: Any) -> licel.Dataset:
    """Return the line of a dataset; those of its recorder are among the values."""
    recorder = {name: values.pop(name) for name in licel.Recorder._fields if name in values}
    return licel.new_dataset(licel.Recorder(**recorder), **values)
