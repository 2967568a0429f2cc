"""Building of products from results, and refused input."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import ValidationError
from support.cases import each
from support.oracles.angle_scenes import retrieve_scan
from support.products.encoded_products import build_product
from support.products.made_products import (
    MAKERS,
    PLACED,
    SCENE,
    STATION,
    context,
    homogeneous,
    multiangle,
    signal,
)

from lidarops.campaign.model import Metadata, Station
from lidarops.errors import ProductError
from lidarops.flags import FlagBit
from lidarops.kinds import flags_of
from lidarops.netcdf.context import duration
from lidarops.netcdf.encoding import bitround
from lidarops.netcdf.variables import layout_of, summary_of
from lidarops.records import DetectionMode, Stamp
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality

KINDS = list(MAKERS)


def decoded(data: xr.Dataset, kind: str, **changes) -> xr.Dataset:
    return xr.decode_cf(build_product(data, context(kind, **changes)))


@each("kind", KINDS)
def test_numbers_are_preserved(kind: str):
    data = MAKERS[kind]()
    product = decoded(data, kind)
    for row in layout_of(kind).variables:
        if row.name.endswith("usable"):
            continue
        if row.optional and row.name not in data:
            assert row.name not in product
            continue
        bits = 23 if row.bits is None else row.bits
        np.testing.assert_allclose(
            product[row.name].to_numpy().astype(float),
            data[row.name].to_numpy().astype(float),
            rtol=2.0 ** -(bits + 1) * (1 + 1e-6),
            atol=0,
            err_msg=row.name,
        )
    np.testing.assert_array_equal(product["time"], data["time"])
    np.testing.assert_array_equal(product["time_bnds"], data["time_bnds"])
    assert product["station"].item() == STATION.name


@each("kind", KINDS)
def test_attributes_name_existing_variables_only(kind: str):
    product = build_product(MAKERS[kind](), context(kind))
    for name, variable in product.variables.items():
        for attribute in ("ancillary_variables", "coordinates", "bounds"):
            for named in variable.attrs.get(attribute, "").split():
                assert named in product.variables, (name, attribute)


@each("kind", KINDS)
def test_usable_is_the_worst_severity_of_the_bits(kind: str):
    for row in layout_of(kind).judges:
        check_summary(kind, row.name, row.flags or ())


def check_summary(kind: str, name: str, bits: Iterable[FlagBit]) -> None:
    data = MAKERS[kind]()
    flags, usable = data[name], summary_of(name)
    known = flags_of(kind)
    allowed = [0, *bits]
    flags[...] = np.resize(np.array(allowed, np.int32), flags.shape)
    flags[0, 0] = int(allowed[1] | allowed[-1])
    # A value that is missing without a bit would be refused.
    data = data.fillna(1.0)
    product = build_product(data, context(kind))
    expected = [
        max((bit.severity for bit in known.raised(int(value))), default=0)
        for value in flags.values.flat
    ]
    np.testing.assert_array_equal(product[usable].values.ravel(), expected)
    assert product[usable].dims == product[name].dims
    assert product[usable].dtype == np.int8
    main = next(row for row in layout_of(kind).variables if row.uncertain)
    assert "quality_flag usable" in product[main.name].attrs["ancillary_variables"]
    decoded_flags = xr.decode_cf(product)["usable"]
    assert decoded_flags.attrs["flag_meanings"] == "good use_with_care do_not_use"
    np.testing.assert_array_equal(decoded_flags.attrs["flag_values"], [0, 1, 2])


def test_usable_cannot_be_passed_in():
    data = homogeneous()
    data["usable"] = (data["quality_flag"].dims, np.zeros(data["quality_flag"].shape, np.int8))
    with pytest.raises(ProductError, match="usable"):
        build_product(data, context())


def test_storage_types_and_fill_values():
    product = build_product(signal(), context("signal"))
    assert product["signal"].dtype == np.float32
    assert product["time"].dtype == np.float64
    assert product["shots"].dtype == product["quality_flag"].dtype == np.int32
    fill = np.float32(9.969209968386869e36)
    assert product["signal"].values[0, 0] == fill
    for name, variable in product.variables.items():
        is_data = name in {row.name for row in layout_of("signal").variables}
        assert ("_FillValue" in variable.attrs) == (is_data and variable.dtype.kind == "f"), name
    assert "calendar" not in product["time"].attrs
    assert not product["time_bnds"].attrs
    assert not product["range_bnds"].attrs


def test_order_of_dimensions_does_not_matter():
    data = homogeneous()
    turned = data.transpose("section", "nv", "time")
    xr.testing.assert_identical(build_product(data, context()), build_product(turned, context()))


def test_the_input_is_not_changed():
    data = signal()
    before = data.copy(deep=True)
    build_product(data, context("signal"))
    xr.testing.assert_identical(data, before)


@each("kind", KINDS)
def test_coordinates_are_listed_where_their_dimensions_are(kind: str):
    product = build_product(MAKERS[kind](zenith=30.0, azimuth=10.0), context(kind))
    for name, variable in product.variables.items():
        for listed in variable.attrs.get("coordinates", "").split():
            assert set(product[listed].dims) <= set(variable.dims), (name, listed)
        assert "station" not in variable.attrs.get("coordinates", "").split()
    along_beam = {"altitude", "zenith_angle", "azimuth"}
    main, beam = {
        "signal": ("signal", along_beam),
        "multiangle": ("residual", {"beam_zenith_angle", "beam_azimuth"}),
        "visibility": (
            "total_extinction",
            {"latitude", "longitude", "altitude", "crossing_id"},
        ),
        "homogeneous": ("total_extinction", along_beam),
    }.get(kind, ("aerosol_extinction", along_beam))
    assert beam | {"wavelength"} <= set(product[main].attrs["coordinates"].split())
    assert not beam & set(product["shots"].attrs["coordinates"].split()) - {
        "zenith_angle",
        "azimuth",
    }


def test_variables_of_three_dimensions_or_over_beams_name_no_position():
    product = build_product(multiangle(), context("multiangle"))
    for row in layout_of("multiangle").variables:
        if row.name not in product:
            continue
        listed = set(product[row.name].attrs["coordinates"].split())
        assert listed & {"latitude", "longitude"} == (
            {"latitude", "longitude"}
            if len(row.dims) < 3 and row.dims != ("time", "beam")
            else set()
        )


def test_range_bounds_are_half_way_between_centres():
    product = build_product(signal(), context("signal"))
    np.testing.assert_array_equal(product["range_bnds"][:, 0], 7.5 * np.arange(40))
    np.testing.assert_array_equal(product["range_bnds"][:, 1], 7.5 * np.arange(1, 41))


@settings(deadline=None, max_examples=50)
@given(
    zenith=st.floats(0, 180),
    altitude=st.floats(-500, 9000),
    start=st.floats(0, 100),
    width=st.floats(1, 100),
)
def test_altitude_is_that_of_a_straight_beam(zenith, altitude, start, width):
    data = signal(profiles=2, bins=5, zenith=zenith)
    centres = start + width * (np.arange(5) + 0.5)
    station = Station(name="s", latitude=1, longitude=2, altitude=altitude)
    product = build_product(data.assign_coords(range=centres), context("signal", station=station))
    expected = [altitude + r * math.cos(math.radians(zenith)) for r in centres]
    assert product["altitude"].dims == ("altitude" if zenith <= 10 else "range",)
    np.testing.assert_allclose(product["altitude"], expected, rtol=1e-6, atol=1e-3)
    assert product.attrs["geospatial_vertical_min"] == product["altitude"].values.min()
    assert product.attrs["geospatial_vertical_max"] == product["altitude"].values.max()
    vertical = min(zenith, 180 - zenith) <= 10
    assert (product.attrs.get("featureType") == "timeSeriesProfile") == vertical
    assert (product["station"].attrs.get("cf_role") == "timeseries_id") == vertical


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in PLACED])
def test_a_moving_beam_gives_altitudes_over_time(kind: str):
    zenith = [0.0, 30.0, 60.0, 30.0, 90.0]
    product = decoded(MAKERS[kind](zenith=zenith), kind)
    along = "section" if kind == "homogeneous" else "range"
    distance = product["range" if along == "range" else "section_range"]
    assert product["altitude"].dims == ("time", along)
    np.testing.assert_array_equal(product["zenith_angle"], zenith)
    np.testing.assert_allclose(product["altitude"][0], STATION.altitude + distance, rtol=1e-6)
    np.testing.assert_allclose(product["altitude"][2], STATION.altitude + distance / 2, rtol=1e-6)
    np.testing.assert_allclose(product["altitude"][4], STATION.altitude, rtol=1e-6)
    assert "featureType" not in product.attrs


def test_ends_of_sections_have_their_altitude():
    product = build_product(homogeneous(zenith=60.0), context())
    np.testing.assert_allclose(
        product["altitude_bnds"], STATION.altitude + product["section_bounds"] / 2, rtol=1e-6
    )


def test_extents_are_those_of_the_data():
    product = build_product(homogeneous(profiles=3, zenith=90.0), context())
    attrs = product.attrs
    assert attrs["time_coverage_start"] == "2026-03-01T10:00:00Z"
    assert attrs["time_coverage_end"] == "2026-03-01T10:30:00Z"
    assert attrs["time_coverage_duration"] == "PT30M"
    assert attrs["time_coverage_resolution"] == "PT10M"
    assert attrs["geospatial_vertical_min"] == attrs["geospatial_vertical_max"] == 53.5
    assert attrs["geospatial_lat_min"] == attrs["geospatial_lat_max"] == STATION.latitude
    assert attrs["geospatial_bounds"] == "POINT (46.44 30.76)"


@settings(deadline=None)
@given(st.integers(0, 10**9))
def test_durations_read_back(milliseconds: int):
    assert pd.Timedelta(duration(milliseconds / 1000)) == pd.Timedelta(milliseconds, "ms")


def test_dates_are_those_of_writing_or_of_the_environment(monkeypatch: pytest.MonkeyPatch):
    def created() -> str:
        attributes = build_product(homogeneous(), context(stamp=Stamp(3))).attrs
        assert attributes["product_version"] == "3"
        assert attributes["history"].startswith(attributes["date_modified"])
        return str(attributes["date_created"])

    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    before = datetime.now(UTC).replace(microsecond=0)
    assert before <= datetime.fromisoformat(created()) <= datetime.now(UTC)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert created() == "1970-01-02T00:00:00Z"
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    with pytest.raises(ProductError, match="SOURCE_DATE_EPOCH"):
        created()


def test_history_has_one_line_for_each_step_of_the_plan():
    about = context("elastic")
    lines = build_product(MAKERS["elastic"](), about).attrs["history"].splitlines()
    assert all(line.startswith("2026-") and "lidarops" in line for line in lines)
    *done, omitted, last = lines
    assert [line.split()[1].rstrip(":") for line in done] == [
        step.name for step in about.plan.steps
    ]
    assert "left out dark: photon counting has no dark signal" in omitted
    assert "wrote the elastic product" in last


def test_the_history_of_a_glued_channel_names_the_steps_of_its_parts():
    about = context("elastic")
    plan = about.plan
    own = tuple(replace(step, channel="glued_532o") for step in plan.steps)
    part = replace(plan.steps[0], name="dead_time", channel="photon_532o")
    about = replace(about, channel="glued_532o", plan=replace(plan, steps=(part, *own)))
    history = build_product(MAKERS["elastic"](), about).attrs["history"]
    assert f"dead_time of photon_532o: {part.reason}" in history
    assert "left out dark of photon_532o: photon counting has no dark signal" in history


def test_the_summary_states_the_detection():
    for channel, words in (
        ("photon_532o", "photon counting) of"),
        ("glued_532o", "analog detection glued to photon counting) of"),
    ):
        about = context("elastic")
        about = replace(about, channel=channel)
        attrs = build_product(MAKERS["elastic"](), about).attrs
        assert words in attrs["summary"]


def test_what_a_campaign_does_not_give_is_left_out():
    bare = Metadata()
    attrs = build_product(homogeneous(), context(metadata=bare)).attrs
    assert not {*bare.lacking, "publisher_name", "creator_type", "metadata_link"} & set(attrs)
    assert not [value for value in attrs.values() if "unknown" in str(value)]
    assert "Golub" in attrs["references"]
    assert not {"PI", "wigos_station_id"} & set(attrs)
    given = Metadata(creator_name="A. Person", creator_email="a.person@example.org")
    attrs = build_product(homogeneous(), context(metadata=given)).attrs
    assert attrs["publisher_name"] == "A. Person"
    assert attrs["publisher_email"] == "a.person@example.org"
    assert set(bare.lacking) - set(given.lacking) == {"creator_name", "creator_email"}


def test_identifiers_and_the_principal_investigator_are_stated_as_networks_do():
    named = STATION.model_copy(update={"wigos_station_id": "0-20000-0-33837"})
    people = Metadata(principal_investigator="A. Person")
    attrs = build_product(homogeneous(), context(station=named, metadata=people)).attrs
    assert attrs["PI"] == "A. Person"
    assert attrs["wigos_station_id"] == "0-20000-0-33837"
    assert attrs["station_ID"] == "odesa"
    assert attrs["measurement_ID"] == attrs["lidarops_scene"] == SCENE
    with pytest.raises(ValidationError, match="wigos_station_id"):
        Station(name="Odesa", latitude=46.0, longitude=30.0, wigos_station_id="33837")


@pytest.mark.parametrize(("channel", "mode"), [("glued_532o", "glued"), ("photon_532o", "photon")])
def test_the_detection_mode_of_glued_channels_is_stated(channel: str, mode: str):
    product = build_product(homogeneous(), context(channel=channel))
    assert product.attrs["lidarops_detection_mode"] == mode


def test_no_attribute_is_empty():
    for kind in KINDS:
        product = build_product(MAKERS[kind](), context(kind, summary=""))
        assert all(value != "" for value in product.attrs.values())
        for variable in product.variables.values():
            assert all(np.size(value) and str(value) for value in variable.attrs.values())


def test_paths():
    path = context("signal").path
    assert path == ("odesa/lidar-1/signal/2026/odesa_lidar-1_signal_photon_532o_20260301T000000.nc")
    local = context(start=datetime.fromisoformat("2026-01-01T01:00:00+03:00"))
    assert local.path.startswith("odesa/lidar-1/homogeneous/2025/")


def test_scenes_of_two_range_grids_have_two_files():
    start = "lidar-1_20260301T000000"
    paths = {context(scene=scene).path for scene in (f"{start}-4096x75", f"{start}-100x30")}
    assert len(paths) == 2


@each("channel", ["../x", "", "a/b", ".hidden", "a b"])
def test_paths_stay_in_their_folder(channel: str):
    with pytest.raises(ProductError, match="file name"):
        context(channel=channel)


# Refused input


def drop(name: str) -> Callable[[xr.Dataset], xr.Dataset]:
    return lambda data: data.drop_vars(name)


def put(name: str, value: float, where: tuple[int, ...] = ()) -> Callable[[xr.Dataset], xr.Dataset]:
    def change(data: xr.Dataset) -> xr.Dataset:
        values = data[name].to_numpy().copy()
        if isinstance(value, float) and values.dtype.kind == "i":
            values = values.astype(float)
        values[where] = value
        return data.assign({name: (data[name].dims, values)})

    return change


@each("kind", KINDS)
def test_every_missing_variable_is_named(kind: str):
    data = MAKERS[kind]()
    rows = (*layout_of(kind).coordinates, *layout_of(kind).variables)
    optional = {row.name for row in rows if row.optional and "standard_error" not in row.name}
    needed = [str(name) for name in data.variables if name not in optional]
    assert len(needed) > 9
    for name in needed:
        with pytest.raises(ProductError) as caught:
            build_product(data.drop_vars(name), context(kind))
        assert caught.value.field == name


@each(
    ("change", "field", "problem"),
    [
        (put("time", np.datetime64("NaT"), (1,)), "time", "missing times"),
        (lambda data: data.isel(time=[1, 0]), "time", "rise"),
        (lambda data: data.isel(time=[1, 1]), "time", "rise"),
        (lambda data: data.isel(time=[]), None, "empty"),
        (lambda data: data.assign_coords(time=np.arange(5)), "time", "datetime64"),
        (put("time_bnds", np.datetime64("2027-01-01"), (0, 0)), "time_bnds", "enclose"),
        (put("zenith_angle", math.nan, (1,)), "zenith_angle", "finite"),
        (put("zenith_angle", -90.0), "zenith_angle", "valid range"),
        (put("section_range", math.inf, (0,)), "section_range", "finite"),
        (put("section_range", 0.0, (0,)), "section_bounds", "enclose"),
        (put("section", 1.5, (0,)), "section", "whole numbers"),
        (put("total_extinction", math.nan, (1, 1)), "total_extinction", "carry no quality bit"),
        (put("total_extinction", 1e300, (1, 1)), "total_extinction", "carry no quality bit"),
        (
            put("total_extinction_standard_error", math.inf, (1, 1)),
            "total_extinction_standard_error",
            "bit",
        ),
        (
            put("total_extinction_standard_error", -1.0, (1, 1)),
            "total_extinction_standard_error",
            "range",
        ),
        (put("reduced_chi2", -0.1, (1, 1)), "reduced_chi2", "valid range"),
        (put("quality_flag", 1 << 23 | 1 << 16, (0, 0)), "quality_flag", "not have: 16, 23"),
        (put("quality_flag", -1, (0, 0)), "quality_flag", "29, 30, 31"),
        (put("quality_flag", 0.5, (0, 0)), "quality_flag", "whole numbers"),
        (put("valid_bins", math.nan, (0, 0)), "valid_bins", "whole numbers"),
        (put("valid_bins", 2**40, (0, 0)), "valid_bins", "whole numbers"),
        (put("shots", -1, (0,)), "shots", "valid range"),
        (lambda data: data.isel(section=0, drop=True), "section", "missing"),
        (lambda data: data.rename(section="level"), "section", "missing"),
        (lambda data: data.assign(shots=data["total_extinction"]), "shots", "dimensions"),
        (lambda data: data.assign(shots=data["shots"].astype(str)), "shots", "not numbers"),
        (lambda data: data.assign(extra=data["shots"]), "extra", "not a variable"),
        (lambda data: data.chunk(), "time_bnds", "dask"),
    ],
)
def test_bad_results_are_refused(change, field, problem):
    with pytest.raises(ProductError, match=problem) as caught:
        build_product(change(homogeneous()), context())
    assert field is None or caught.value.field == field


@each(
    ("change", "field", "problem"),
    [
        (put("quality_flag", int(HomogeneousQuality.POOR_FIT), (0, 0)), "quality_flag", ": 18"),
        (lambda data: data.isel(range=[1, 0]), "range", "rise"),
        (lambda data: data.isel(range=[0]), "range_bnds", "single value"),
        (lambda data: data.assign_coords(range=np.full(40, np.nan)), "range", "finite"),
        (lambda data: data.assign_coords(range=np.arange(40) * 1j), "range", "not numbers"),
        (
            lambda data: data.drop_vars("time_bnds").assign_coords(
                time_bnds=(("time", "nv"), np.tile(data["time"], (3, 1)).T)
            ),
            "time_bnds",
            "3 bounds",
        ),
    ],
)
def test_bad_signals_are_refused(change, field, problem):
    with pytest.raises(ProductError, match=problem) as caught:
        build_product(change(signal()), context("signal"))
    assert caught.value.field == field


@each(
    ("change", "field", "problem"),
    [
        (put("altitude", 53.5, (0,)), "altitude", "station"),
        (put("altitude", math.nan, (3,)), "altitude", "finite"),
        (lambda data: data.isel(altitude=slice(None, None, -1)), "altitude", "rise"),
        (put("beam_zenith_angle", -30.0, (1,)), "beam_zenith_angle", "valid range"),
        (put("beam_zenith_angle", math.nan, (1,)), "beam_zenith_angle", "finite"),
        (put("beam", 0.5, (0,)), "beam", "whole numbers"),
        (put("vertical_optical_depth", math.nan, (2, 2)), None, ""),
        (put("quality_flag", int(ElasticQuality.CLOUD), (0, 0)), "quality_flag", ": 17"),
        (
            put("total_extinction_gradient_error", -1.0, (1, 1)),
            "total_extinction_gradient_error",
            "range",
        ),
        (lambda data: data.assign_coords(zenith_angle=0.0), None, ""),
    ],
)
def test_bad_scans_are_refused(change, field, problem):
    data = change(multiangle())
    if field is None:
        # A missing value with a bit, and coordinates that the kind does not have, do no harm.
        assert "zenith_angle" not in build_product(data, context("multiangle"))
        return
    with pytest.raises(ProductError, match=problem) as caught:
        build_product(data, context("multiangle"))
    assert caught.value.field == field


def test_a_missing_optical_depth_without_a_bit_is_refused():
    data = multiangle()
    data["quality_flag"][2] = 0
    with pytest.raises(ProductError, match="carry no quality bit"):
        build_product(put("vertical_optical_depth", math.nan, (2, 2))(data), context("multiangle"))


def test_layers_of_a_scan_reach_from_the_station_upwards():
    product = build_product(multiangle(levels=4), context("multiangle"))
    assert product["altitude"].attrs["axis"] == "Z"
    assert product["altitude"].attrs["bounds"] == "altitude_bnds"
    tops = STATION.altitude + 60.0 * np.arange(5)
    np.testing.assert_array_equal(product["altitude_bnds"], np.stack([tops[:-1], tops[1:]], -1))
    assert product.attrs["geospatial_vertical_resolution"] == "60 m"
    assert "featureType" not in product.attrs


def test_a_level_beam_does_not_resolve_altitudes():
    """The cosine of 90 degrees is not exactly 0."""
    name = "geospatial_vertical_resolution"
    assert (
        build_product(homogeneous(zenith=90.0), context()).attrs[name] == "none: the beam is level"
    )
    slanting = build_product(homogeneous(zenith=89.9), context())
    sections = slanting["altitude"].values
    assert float(slanting.attrs[name].split()[0]) == pytest.approx(np.diff(sections)[0], abs=1e-4)


def test_a_product_states_the_steps_of_its_retrieval():
    product = build_product(multiangle(), context("multiangle"))
    assert product.attrs["lidarops_steps"] == "joint: extinction is requested"
    assert "lidarops_steps" not in build_product(homogeneous(), context()).attrs


def test_a_single_bin_may_have_given_bounds():
    data = signal(bins=4).isel(range=[2])
    data = data.assign_coords(range_bnds=(("range", "nv"), [[15.0, 22.5]]))
    product = build_product(data, context("signal"))
    np.testing.assert_array_equal(product["range_bnds"], [[15.0, 22.5]])


def test_a_missing_value_with_a_bit_is_written_as_missing():
    data = put("amplitude", 1e300, (0, 0))(homogeneous())
    product = decoded(data, "homogeneous")
    assert np.isnan(product["amplitude"].values[0, 0])
    assert product["quality_flag"].values[0, 0] != 0


# Properties


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from(KINDS).flatmap(
        lambda kind: st.tuples(
            st.just(kind),
            hnp.arrays(
                np.int32,
                (3, 4),
                elements=st.lists(st.sampled_from(list(flags_of(kind)))).map(
                    lambda bits: int(np.bitwise_or.reduce([0, *map(int, bits)]))
                ),
            ),
        )
    )
)
def test_flags_read_back_from_masks_and_meanings(case):
    kind, flags = case
    data = MAKERS[kind](3, 4)
    data = data.fillna(1.0)
    for row in layout_of(kind).judges:
        known = row.flags or ()
        data[row.name][:] = flags & np.int32(sum(known))
        stored = decoded(data, kind)[row.name]
        masks = stored.attrs["flag_masks"].tolist()
        named = dict(zip(stored.attrs["flag_meanings"].split(), masks, strict=True))
        for value, read in zip(flags.flat, stored.values.flat, strict=True):
            expected = {bit.word for bit in known if value & bit}
            assert {name for name, mask in named.items() if read & mask} == expected


normal = st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=False)


@settings(deadline=None)
@given(values=st.lists(normal, min_size=1), bits=st.integers(1, 23))
def test_bitround_is_rounding_of_the_mantissa_half_to_even(values: list[float], bits: int):
    given_ = np.array(values, np.float32)
    mantissa, exponent = np.frexp(given_.astype(float))
    expected = np.ldexp(np.rint(np.ldexp(mantissa, bits + 1)), exponent - bits - 1)
    with np.errstate(over="ignore"):
        expected = expected.astype(np.float32)
    rounded = bitround(given_, bits)
    np.testing.assert_array_equal(rounded, expected)
    np.testing.assert_array_equal(bitround(rounded, bits), rounded)


def test_bitround_keeps_nan_and_infinity():
    # A NaN with all bits set would overflow into zero.
    worst = np.array([0x7FFFFFFF, 0xFFFFFFFF, 0x7F800000], np.uint32).view(np.float32)
    rounded = bitround(worst, 13)
    assert np.isnan(rounded[:2]).all()
    assert rounded[2] == np.inf


def test_profiles_may_follow_each_other_faster_than_a_millisecond():
    data = homogeneous(profiles=3)
    starts = np.datetime64("2026-03-01T10:00:00", "ns") + np.arange(3) * np.timedelta64(500, "us")
    data = data.assign_coords(
        time=starts + np.timedelta64(250, "us"),
        time_bnds=(("time", "nv"), np.stack([starts, starts + np.timedelta64(500, "us")], -1)),
    )
    times = decoded(data, "homogeneous")["time"].values
    assert all(
        abs((later - sooner) / np.timedelta64(1, "us") - 500) < 1
        for sooner, later in pairwise(times)
    )


def test_every_mode_has_its_unit():
    for mode, unit in ((DetectionMode.ANALOG, "mV m2"), (DetectionMode.PHOTON, "MHz m2")):
        assert build_product(homogeneous(), context(mode=mode))["amplitude"].attrs["units"] == unit


def test_the_window_is_stated_in_utc():
    start = datetime(2026, 3, 1, tzinfo=UTC)
    attrs = build_product(
        homogeneous(), context(start=start, stop=start + timedelta(hours=6))
    ).attrs
    assert attrs["lidarops_window_end"] == "2026-03-01T06:00:00Z"


def test_a_scan_goes_from_profiles_to_a_product():
    zenith = np.tile([0.0, 30.0, 50.0, 60.0], 3)
    distance = 15.0 * (np.arange(400) + 0.5)
    power = 1e7 * np.exp(-distance / 2e4) / distance**2 + 3.0
    noise = np.random.default_rng(1).normal(0.0, 0.05, (12, 400))
    starts = np.datetime64("2026-03-01T10:00:00", "ns") + np.arange(12) * np.timedelta64(60, "s")
    ends = starts + np.timedelta64(60, "s")
    dims = ("time", "range")
    found = retrieve_scan(
        xr.Dataset(
            {
                "power": (dims, power + noise),
                "variance": (dims, np.full(noise.shape, 0.05**2)),
                "quality": (dims, np.zeros(noise.shape, np.int32)),
                "noise_correlation_length": ("time", np.ones(len(noise))),
            },
            coords={"range": distance},
        ),
        zenith_angle=zenith,
        azimuth=np.full(12, 90.0),
        time_bnds=np.stack([starts, ends], axis=-1),
        shots=np.full(12, 600),
        altitude_grid=STATION.altitude + 60.0 * np.arange(1, 60),
        station_altitude=STATION.altitude,
        background_range=(5400.0, 6000.0),
    )
    assert found.attrs["method"] == "joint"
    found = found.assign(retrieval_method=0, background_method=0)
    product = decoded(found, "multiangle")
    assert {"time": 3, "altitude": 59, "beam": 4}.items() <= product.sizes.items()
    np.testing.assert_array_equal(product["quality_flag"], found["quality_flag"])
    np.testing.assert_allclose(product["beam_azimuth"], 90.0)
    assert "joint" in product.attrs["lidarops_steps"]
