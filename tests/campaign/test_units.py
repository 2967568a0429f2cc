"""Quantities as people write them."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support import factories

from lidarops.campaign.model import campaign_schema, editor_schema, load_campaign
from lidarops.units import parse_quantity, written


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("4 ns", "s", 4e-9),
        ("532 nm", "m", 532e-9),
        ("532nm", "m", 5.32e-7),
        ("7.5 m", "m", 7.5),
        ("0.3 km", "m", 300.0),
        ("30 min", "s", 1800.0),
        ("30 minutes", "s", 1800.0),
        ("\N{MINUS SIGN}5 hours", "s", -18000.0),
        ("500 metres", "m", 500.0),
        ("0.1 km-1", "m-1", 1e-4),
        ("0.1 km^-1", "m-1", 1e-4),
        ("0.1 1/km", "m-1", None),
        ("0.1 /km", "m-1", 1e-4),
        ("36 km/h", "m s-1", 10.0),
        ("10 g/kg", "kg kg-1", 0.01),
        ("5 %", "1", 0.05),
        ("45°", "degree", 45.0),
        ("20 µV", "mV", 0.02),
        ("4", "s", None),
        ("4 m", "s", None),
        ("4 ns and more", "s", None),
        ("1e400 m", "m", None),
        ("1e9999999999999999999 m", "m", None),
        ("5 bins", "1", None),
        ("5 bins", "bins", 5.0),
        ("estimate", "s", None),
    ],
)
def test_a_quantity_becomes_the_number_that_a_person_would_write(
    text: str, unit: str, value: float | None
) -> None:
    assert parse_quantity(text, unit) == value


@given(st.floats(1e-10, 1e7).map(lambda value: float(f"{value:.6g}")), st.sampled_from(["s", "m"]))
def test_what_is_written_is_read_back(value: float, unit: str) -> None:
    assert parse_quantity(written(value, unit), unit) == value


def test_a_campaign_with_quantities_is_that_with_numbers(tmp_path: Path) -> None:
    plain = factories.campaign().model_dump(mode="json", exclude={"simulation"})
    instrument = plain["instruments"]["lidar"] = next(iter(plain["instruments"].values()))
    facts = {
        "full_overlap_range": 500, "clock_offset": 3600, "zenith_angle": 90,
        "channels": {"photon_532o": {"dead_time": 4e-9, "wavelength": 5.32e-7}},
    }  # fmt: skip
    written_facts = {
        "full_overlap_range": "0.5 km", "clock_offset": "1 h", "zenith_angle": "90 deg",
        "channels": {"photon_532o": {"dead_time": "4 ns", "wavelength": "532 nm"}},
    }  # fmt: skip
    path = {"channels": ["photon_532o"]}
    read = []
    for name, stated, sections in (
        ("plain", facts, [[750, 4500]]),
        ("written", written_facts, [["750 m", "4.5 km"]]),
    ):
        instrument |= {
            "facts": [stated],
            "products": {"homogeneous": path | {"sections": sections}},
        }
        file = tmp_path / f"{name}.yaml"
        file.write_text(yaml.safe_dump(plain))
        read.append(load_campaign(file))
    assert read[0] == read[1]


def test_editors_accept_quantities_where_there_is_a_unit() -> None:
    def kinds(schema: dict[str, object], name: str) -> set[str]:
        (found,) = [
            definition["properties"][name]
            for definition in schema["$defs"].values()  # type: ignore[attr-defined]
            if name in definition.get("properties", {})
        ]
        return {inner.get("type", "") for inner in found.get("anyOf", [found])}

    assert "string" in kinds(editor_schema(), "full_overlap_range")
    assert "string" not in kinds(campaign_schema(), "full_overlap_range")
    assert "string" not in kinds(editor_schema(), "dead_time_uncertainty")
