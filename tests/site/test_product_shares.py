"""Calendar and badges of products of which some profiles are usable, and of those without any."""

from __future__ import annotations

import re

import numpy as np
import pytest
import xarray as xr

from lidarops.site import pages
from lidarops.site.product_entry import Entry, mean_availability
from lidarops.site.quality import read_quality


def entry(available: int, profiles: int = 100, kind: str = "raman", lacking: str = "") -> Entry:
    return Entry(
        path="odesa/lidar/x.nc", sha256="", size=1,
        campaign="odesa", station="odesa", place="Odesa", instrument="lidar",
        name="Lidar", kind=kind, channel="photon_355o", light="355 nm", latitude=None,
        longitude=None, altitude=None, license="", start="2026-03-01T10:00:00",
        stop="2026-03-01T11:00:00", values=1000, usable=0 if lacking else 864, unflagged=0,
        profiles=profiles, available=available, lacking=lacking, problem="",
    )  # fmt: skip


def words(page: bytes) -> str:
    return re.sub(r"<[^>]+>", "", page.decode())


def test_the_calendar_states_the_share_of_usable_profiles():
    by_day = {"2026-03-01": [entry(16)]}
    day = words(pages.day("odesa", "2026-03-01", by_day, None, None))
    assert "1 product; 16.0 % of profiles usable" in day.replace("\N{NO-BREAK SPACE}", " ")
    page = words(pages.year("odesa", "2026", {"2026": [entry(16)]}))
    assert "16.0 % of profiles usable, 1 product" in page.replace("\N{NO-BREAK SPACE}", " ")


def test_availability_is_the_mean_over_retrievals():
    signal = entry(0, profiles=10**6, kind="signal")
    assert mean_availability([entry(16), entry(10, 10), signal]) == pytest.approx(0.58)
    assert mean_availability([signal]) == 0.0
    assert mean_availability([entry(0, 0)]) is None
    assert entry(0, 0).grade == "unknown"


def test_products_without_usable_values_are_folded_with_the_reason():
    by_day = {"2026-03-01": [entry(0, lacking="below full overlap (100 %)"), entry(90)]}
    page = pages.day("odesa", "2026-03-01", by_day, None, None).decode()
    shown, folded = page.split("1 product without usable values")
    assert "below full overlap (100 %)" not in shown
    assert "below full overlap (100 %)" in folded
    assert shown.count('class="product"') == folded.count('class="product"') == 1


def product(first_usable: int, name: str = "range") -> xr.Dataset:
    """Return three profiles of ten bins of 1 km; the first is usable from one bin on."""
    flags = np.ones((3, 10), dtype=np.int32)
    flags[0, first_usable:] = 0
    height = 500.0 + 1000.0 * np.arange(10) + 200.0 * (name == "altitude")
    return xr.Dataset(
        {
            "quality_flag": (
                ("time", name),
                flags,
                {"flag_masks": np.int32([1]), "flag_meanings": "input_missing"},
            ),
            "station_altitude": ((), 200.0, {"units": "m"}),
        },
        {name: (name, height)},
        {"lidarops_kind": "signal"},
    )


@pytest.mark.parametrize("name", ["range", "altitude"])
def test_a_profile_counts_where_a_value_is_usable_below_a_height(name: str):
    for first_usable, below, available in ((4, 5e3, 1), (5, 5e3, 0), (5, 6e3, 1)):
        counted = read_quality(product(first_usable, name), below)
        assert (counted.profiles, counted.available) == (3, available)


def test_a_product_without_usable_values_says_why():
    assert read_quality(product(9)).lacking == ""
    assert read_quality(product(10)).lacking.endswith("(100 %)")
