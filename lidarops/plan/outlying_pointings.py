"""Find the granules of which alone a beam points elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence

from lidarops.plan.surroundings import Outlying, granules_around
from lidarops.records import FEWEST_ALIKE, Granule


def lone_pointings(
    granules: Sequence[Granule], days: Collection[int]
) -> Iterator[tuple[Granule, Outlying]]:
    """Yield granules that alone have their pointing, while every other pointing has several.

    Of a beam that is fixed otherwise it cannot be used: the whole scene would seem to move. In a
    scan it is one of many pointings.

    Parameters
    ----------
    granules : sequence of Granule
        Good ones of one instrument, by start time.
    days : collection of int
        Days since 1970-01-01.
    """
    for own, around in granules_around(granules, days):
        counts = Counter(_pointing(granules[index]) for index in around)
        lone = [pointing for pointing, number in counts.items() if number == 1]
        others = [number for number in counts.values() if number > 1]
        if len(lone) != 1 or not others or min(others) < FEWEST_ALIKE:
            continue
        for granule in granules[own.start : own.stop]:
            if _pointing(granule) == lone[0]:
                text = f"the pointing {_in_words(granule)} alone of all files around it"
                yield granule, Outlying("", text) if len(others) > 1 else Outlying(text, "")


def _pointing(granule: Granule) -> tuple[float | None, float | None]:
    return granule.zenith_angle, granule.azimuth


def _in_words(granule: Granule) -> str:
    pointing = (("zenith angle", granule.zenith_angle), ("azimuth", granule.azimuth))
    return " and ".join(f"{name} {angle:g}" for name, angle in pointing if angle is not None)
