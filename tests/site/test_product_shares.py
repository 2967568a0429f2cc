"""Calendar and badges of products that are good, to be used with care, or rejected in part."""

from __future__ import annotations

import re

import pytest

from lidarops.site import pages
from lidarops.site.product_entry import Entry, ShareGrade, mean_shares


def entry(values: int, unflagged: int, usable: int, kind: str = "raman") -> Entry:
    return Entry(
        path="odesa/lidar/x.nc", sha256="", size=1, page="product/odesa/x.html", thumbnail="x.svg",
        digests=(), campaign="odesa", station="odesa", place="Odesa", instrument="lidar",
        name="Lidar", kind=kind, channel="photon_355o", light="355 nm", latitude=None,
        longitude=None, altitude=None, license="", start="2026-03-01T10:00:00",
        stop="2026-03-01T11:00:00", values=values, usable=usable, unflagged=unflagged, alt="",
        problem="",
    )  # fmt: skip


CARE = entry(1000, 56, 864)
"""Few values are good, most are to be used with care."""


def words(page: bytes) -> str:
    return re.sub(r"<[^>]+>", "", page.decode())


def test_values_to_be_used_with_care_make_no_badge_of_good_ones():
    assert CARE.grade is ShareGrade.FEW
    assert entry(1000, 0, 1000).grade is ShareGrade.NONE
    assert entry(1000, 800, 800).grade is ShareGrade.MOST


def test_the_calendar_states_good_care_and_rejected_values():
    by_day = {"2026-03-01": [CARE]}
    day = words(pages.day("odesa", "2026-03-01", by_day, None, None))
    assert "on average 5.6 % good, 80.8 % care, 13.6 % reject" in day.replace(
        "\N{NO-BREAK SPACE}", " "
    )
    page = pages.year("odesa", 2026, [CARE], ["2026"])
    assert "16 % good, 81 % care, 14 % reject, 1 product" in words(page)
    for word, begin, width in (("good", 0, 5.6), ("care", 5.6, 80.8), ("reject", 86.4, 13.6)):
        assert f'class="q-{word}" x="{begin}" width="{width}"'.encode() in page
    assert b"usable" not in page


def test_shares_are_means_over_retrievals():
    signal = entry(10**6, 0, 0, kind="signal")
    shares = mean_shares([CARE, entry(10, 10, 10), signal])
    assert shares == pytest.approx((0.528, 0.404, 0.068))
    assert mean_shares([entry(0, 0, 0)]) is None
