"""What is beside a product."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lidarops.site.product_entry import Entry, with_neighbours

ENTRY = Entry(
    path="", sha256="", size=1, campaign="c", station="s",
    place="S", instrument="i", name="I", kind="signal", channel="a", light="", latitude=None,
    longitude=None, altitude=None, license="", start="", stop="", values=0, usable=0,
    unflagged=0, profiles=1, available=1, lacking="", problem="",
)  # fmt: skip


def made(channel: str, start: str, stop: str) -> Entry:
    """Return a product of some hours of a day, such as ``2024-03-01T00``."""
    path = f"{channel} {start}"
    return replace(ENTRY, path=path, channel=channel, start=f"{start}:00:00", stop=f"{stop}:00:00")


def siblings(*others: Entry) -> list[str]:
    one = made("own", "2024-03-01T20", "2024-03-01T21")
    beside = {entry.path: neighbours for entry, neighbours in with_neighbours([one, *others])}
    return [other.path for other in beside[one.path].siblings]


@pytest.mark.parametrize(
    ("start", "stop", "beside"),
    [
        ("2021-03-01T20", "2021-03-01T21", False),
        ("2024-03-01T21", "2024-03-01T22", False),
        ("2024-03-01T19", "2024-03-01T20", False),
        ("2024-03-01T20", "2024-03-01T20", True),
        ("2024-03-01T00", "2024-03-02T00", True),
        ("2024-03-01T20", "2024-03-01T21", True),
    ],
    ids=["years before", "after", "before", "of no length", "of the day", "of the same time"],
)
def test_siblings_are_of_the_same_time(start: str, stop: str, *, beside: bool) -> None:
    other = made("other", start, stop)
    assert siblings(other) == ([other.path] if beside else [])


def test_a_sibling_that_overlaps_goes_before_one_that_begins_nearer() -> None:
    day = made("other", "2024-03-01T00", "2024-03-02T00")
    next_day = made("other", "2024-03-02T00", "2024-03-03T00")
    short = made("other", "2024-03-01T18", "2024-03-01T19")
    assert siblings(next_day, short, day) == [day.path]


def test_the_nearest_of_those_that_overlap_is_shown() -> None:
    long = made("other", "2024-03-01T00", "2024-03-02T00")
    near = made("other", "2024-03-01T19", "2024-03-01T22")
    assert siblings(long, near) == [near.path]
