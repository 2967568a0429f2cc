"""Rows of variables, checked against the CF tables."""

from __future__ import annotations

import importlib.resources
from collections.abc import Iterator
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from compliance_checker.cfunits import Unit
from support.cases import each

from lidarops.flags import Severity
from lidarops.kinds import kinds
from lidarops.netcdf.variables import (
    PROVENANCE,
    STATION,
    Coverage,
    Row,
    attributes,
    judging,
    layout_of,
    summary_of,
)
from lidarops.records import DetectionMode
from lidarops.retrieve.raman.errors import BACKSCATTER_CAUSES, EXTINCTION_CAUSES


def rows() -> Iterator[tuple[str, Row]]:
    """Yield the rows of all kinds, each with its name for a message."""
    for kind in kinds():
        layout = layout_of(kind)
        for row in (*layout.coordinates, *layout.variables, STATION, PROVENANCE):
            yield f"{kind}: {row.name}", row


@pytest.fixture(scope="module")
def standard_names() -> dict[str, str | None]:
    """Standard name -> canonical unit, of the table that the compliance checker holds."""
    source = importlib.resources.files("compliance_checker") / "data/cf-standard-name-table.xml"
    table = ET.fromstring(source.read_text(encoding="utf-8"))
    assert table.findtext("version_number") == "93"
    # Aliases are elements of their own and so no names here.
    return {entry.attrib["id"]: entry.findtext("canonical_units") for entry in table.iter("entry")}


def test_standard_names_exist_and_their_units_convert(standard_names: dict[str, str | None]):
    named = [(place, row) for place, row in rows() if row.standard_name]
    assert len(named) > 100
    for place, row in named:
        name, _, modifier = str(row.standard_name).partition(" ")
        assert modifier in ("", "standard_error"), place
        assert name in standard_names, place
        canonical = standard_names[name]
        if canonical:
            # The canonical unit of time is s; a time coordinate counts from an epoch.
            unit = attributes(row, mode=DetectionMode.ANALOG)["units"].split(" since ")[0]
            assert Unit(unit).is_convertible(Unit(canonical)), place
        else:
            assert row.units is None, place


@pytest.mark.parametrize("mode", list(DetectionMode))
def test_every_unit_is_valid_and_no_placeholder_is_left(mode: DetectionMode):
    for place, row in rows():
        found = attributes(row, mode=mode)
        assert found["long_name"], place
        assert found["coverage_content_type"] in set(Coverage), place
        assert "{" not in "".join(str(value) for value in found.values()), place
        if row.dtype != "S1":
            Unit(found["units"].split(" since ")[0])


_CAUSES = ("noise", "background", "reference", "lidar_ratio", "molecular", "dead_time", "baseline")


_AIR = (
    "atmospheric_molecular_calculation_source",
    "molecular_profile_age",
    "molecular_profile_distance",
    "molecular_density_relative_error",
)


def test_variables_without_standard_name():
    gluing = {
        *("glue_lag", "glue_lag_standard_error", "glue_slope", "glue_slope_standard_error"),
        *("glue_bottom", "glue_top"),
    }
    reference = {
        *("reference_bottom", "reference_top"),
        *("reference_bottom_altitude", "reference_top_altitude"),
        *("reference_scattering_ratio", "reference_scattering_ratio_standard_error"),
        "reference_detection_limit",
    }
    unnamed = {
        kind: {row.name for row in layout.variables if not row.standard_name}
        for kind, known in kinds().items()
        for layout in [layout_of(kind)]
        if known.package.startswith("lidarops.")
    }
    assert unnamed == {
        "signal": {
            "signal",
            "signal_standard_error",
            "signal_dead_time_error",
            "signal_baseline_error",
            "background",
            "background_standard_error",
            "noise_correlation_length",
            "background_method",
            *gluing,
        },
        "elastic": {
            *(f"aerosol_backscatter_error_{cause}" for cause in _CAUSES),
            "molecular_backscatter",
            "molecular_extinction",
            *reference,
            *_AIR,
            "background_method",
            "vertical_resolution",
            "cloud_base_range",
            "cloud_fraction",
            "background",
            "background_standard_error",
            "scattering_ratio",
            "scattering_ratio_standard_error",
            *gluing,
        },
        "raman": {
            *(f"aerosol_extinction_error_{cause}" for cause in EXTINCTION_CAUSES),
            *(f"aerosol_backscatter_error_{cause}" for cause in BACKSCATTER_CAUSES),
            *(
                f"{quantity}_error_{kind}"
                for quantity in ("lidar_ratio", "water_vapour_mixing_ratio")
                for kind in ("random", "systematic")
            ),
            "aerosol_extinction_smoothing_error",
            "vertical_resolution",
            "cloud_base_range",
            "cloud_fraction",
            "overlap",
            "overlap_standard_error",
            "molecular_backscatter",
            *reference,
            *_AIR,
            "background_method",
            "background",
            "background_standard_error",
        },
        "multiangle": {
            *(
                f"{quantity}{error}"
                for quantity in (
                    "vertical_optical_depth",
                    "total_extinction",
                    "layer_vertical_optical_depth",
                    "plane_vertical_optical_depth",
                    "plane_total_extinction",
                )
                for error in ("", "_standard_error", "_gradient_error")
            ),
            "monotone_vertical_optical_depth",
            "reduced_chi2",
            "log_intercept",
            "log_intercept_standard_error",
            "data_share",
            "regularisation",
            "prior_vertical_optical_depth",
            "inhomogeneity",
            "residual",
            "beam_signal",
            "beam_obstruction",
            "vertical_optical_depth_error_air",
            "vertical_optical_depth_dead_time_error",
            "total_extinction_dead_time_error",
            "vertical_optical_depth_baseline_error",
            "total_extinction_baseline_error",
            "analog_baseline",
            "analog_baseline_standard_error",
            "blocked_range",
            "effective_degrees_of_freedom",
            "reach",
            "retrieval_method",
            "background_method",
        },
        "visibility": {
            "visibility_in_air_lower",
            "visibility_in_air_upper",
            "total_extinction",
            "total_extinction_standard_error",
            "total_extinction_systematic_error",
            "condition",
            "path_optical_depth",
            "reduced_chi2",
            "degrees_of_freedom",
            "multiplier",
            "beam_range",
            "retrieval_method",
        },
        "homogeneous": {
            "visibility_in_air_lower",
            "visibility_in_air_upper",
            "total_extinction",
            "total_extinction_standard_error",
            "total_extinction_model_error",
            "total_extinction_baseline_error",
            "amplitude",
            "amplitude_standard_error",
            "background",
            "background_standard_error",
            "background_model_error",
            "slope_error",
            "reduced_chi2",
            "retrieval_method",
        },
    }


def test_method_codes_are_published_and_keep_their_numbers():
    """Readers of older files rely on the numbers: append, and never reorder."""
    coded = {
        (kind, row.name): row.states
        for kind, known in kinds().items()
        for row in layout_of(kind).data
        if row.name.endswith(("_method", "_source")) and known.package.startswith("lidarops.")
    }
    background = ("tail_mean", "cubic", "known_shape", "before_pulse")
    assert coded == {
        ("homogeneous", "retrieval_method"): (
            "compressed", "direct", "cubic", "known_background", "linearized", "known_extinction",
        ),
        ("multiangle", "retrieval_method"): (
            "joint", "kano_hamilton", "two_angle", "mld", "mld_prior",
        ),
        ("visibility", "retrieval_method"): (
            "beams_with_prior", "beams_without_prior", "triangles",
        ),
        **{(kind, "background_method"): background
           for kind in ("signal", "elastic", "raman", "multiangle")},
        **{(kind, "atmospheric_molecular_calculation_source"): (
            "US_standard_atmosphere", "radiosounding", "ecmwf", "icon-iglo-12-23", "gdas",
        )
           for kind in ("elastic", "raman")},
    }  # fmt: skip


def test_one_name_is_one_quantity_in_all_kinds():
    meanings: dict[str, set[tuple[str | None, str | None]]] = {}
    words: dict[str, set[str | None]] = {}
    for kind in kinds():
        for row in layout_of(kind).variables:
            meanings.setdefault(row.name, set()).add((row.units, row.standard_name))
            if "extinction" in row.name:
                words.setdefault(row.name, set()).add(row.long_name)
    assert {name for name, various in meanings.items() if len(various) > 1} == set()
    assert all(len(words[f"{whose}_extinction"]) == 1 for whose in ("aerosol", "total"))
    # Which extinction, and along which path, is part of the name.
    assert not {"extinction", "backscatter", "optical_depth"} & set(meanings)


def test_no_standard_name_means_total_extinction_in_air(standard_names: dict[str, str | None]):
    known = {name for name in standard_names if name.startswith("volume_extinction_coefficient")}
    assert known == {
        "volume_extinction_coefficient_of_radiative_flux_in_air_due_to_ambient_aerosol_particles",
        "volume_extinction_coefficient_of_radiative_flux_in_air_due_to_cloud_particles",
    }


@each(
    ("mode", "name", "unit"),
    [
        (DetectionMode.ANALOG, "signal", "mV m2"),
        (DetectionMode.PHOTON, "signal", "MHz m2"),
        (DetectionMode.ANALOG, "signal_standard_error", "mV m2"),
        (DetectionMode.PHOTON, "background_standard_error", "MHz"),
        (DetectionMode.ANALOG, "background", "mV"),
    ],
)
def test_units_of_the_signal_follow_the_mode(mode: DetectionMode, name: str, unit: str):
    assert attributes(layout_of("signal").rows[name], mode=mode)["units"] == unit


@pytest.mark.parametrize("layout", map(layout_of, kinds()), ids=list(kinds()))
def test_ancillaries_and_standard_errors_are_consistent(layout):
    names = [row.name for row in (*layout.coordinates, *layout.variables)]
    assert len(set(names)) == len(names)
    for row in layout.variables:
        assert set(row.ancillaries) <= set(names)
        if row.uncertain:
            error = layout.rows[f"{row.name}_standard_error"]
            assert row.ancillaries[0] == error.name
            assert (error.units, error.dims, error.dtype) == (row.units, row.dims, row.dtype)
            assert error.valid_min == 0
    assert all(row.valid_min is None for row in layout.variables if row.uncertain)


@pytest.mark.parametrize("layout", map(layout_of, kinds()), ids=list(kinds()))
def test_flag_masks_are_powers_of_two_in_the_type_of_the_flag(layout):
    for row in layout.judges:
        found = attributes(row, mode=DetectionMode.ANALOG)
        masks, meanings = found["flag_masks"], found["flag_meanings"].split()
        assert masks.dtype == np.dtype(row.dtype)
        assert len(masks) == len(meanings) == len(set(meanings))
        assert all(mask > 0 and mask & (mask - 1) == 0 for mask in masks.tolist())
        for mask, meaning in zip(masks.tolist(), meanings, strict=True):
            bit = layout.flags.named(meaning)
            assert bit == mask
            assert f"{meaning}: {bit.description}" in found["comment"]
        rejecting = [bit.severity is Severity.REJECT for bit in row.flags]
        words = ["Bad" if rejects else "Indeterminate" for rejects in rejecting]
        assert found["flag_assessments"].split() == words


@pytest.mark.parametrize("layout", map(layout_of, kinds()), ids=list(kinds()))
def test_quantities_name_the_flags_that_judge_them(layout):
    names = [row.name for row in layout.judges]
    for row in layout.variables:
        flags = [name for name in row.ancillaries if name in names]
        summaries = [name for name in row.ancillaries if name.endswith("usable")]
        if flags:
            assert flags == [judging(row.name, names)], row.name
            assert summaries == [summary_of(flags[0])], row.name
    raman = [row.name for row in layout_of("raman").judges]
    assert judging("lidar_ratio_error_random", raman) == "lidar_ratio_quality_flag"
    assert judging("aerosol_extinction_error_noise", raman) == "quality_flag"


def test_retrieved_quantities_keep_all_their_bits_and_signals_13():
    bits = {row.name: row.bits for row in layout_of("signal").variables}
    assert bits["signal"] == 13
    assert all(row.bits is None for row in layout_of("homogeneous").variables)
