"""Files of means, compared with the products."""

from __future__ import annotations

import json
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support.archives.aggregate_archive import add_day, facts_of
from support.products.compliance import findings
from support.products.made_products import MAKERS

from lidarops.aggregate.facts import Period, Refused, Weights, groups, read_product_facts
from lidarops.aggregate.means import Means, MeansResult
from lidarops.aggregate.means_variables import (
    averaged,
    layout,
    systematic,
)
from lidarops.aggregate.open_products import open_products
from lidarops.kinds import flags_of, kinds
from lidarops.netcdf.context import UNUSED_INPUTS
from lidarops.netcdf.variables import ErrorKind, layout_of
from lidarops.records import DetectionMode
from lidarops.retrieve.air.visibility import (
    VisibilityDefinition,
    WavelengthLaw,
    visibility_of_extinction,
)


def means_of(root: Path, period: Period = Period.DAY, **options) -> MeansResult:
    (group,) = grouped = groups(facts_of(root))
    return Means(root, grouped, period, **options).of(group)


def only(root: Path, done: MeansResult) -> xr.Dataset:
    (file,) = done.files
    with xr.open_dataset(root / file.path) as means:
        return means.load()


def test_means_have_the_date_of_their_newest_product(tmp_path: Path):
    dates = []
    for day in range(3):
        with xr.open_dataset(tmp_path / add_day(tmp_path, day)) as product:
            dates.append(product.attrs["date_modified"])
    means = only(tmp_path, means_of(tmp_path)).attrs
    assert means["date_modified"] == means["date_created"] == max(dates)
    assert means["history"].startswith(max(dates))


def test_means_state_how_many_products_lack_raw_files(tmp_path: Path):
    days = [add_day(tmp_path, day) for day in range(3)]
    assert UNUSED_INPUTS not in only(tmp_path, means_of(tmp_path)).attrs
    with netCDF4.Dataset(tmp_path / days[1], "a") as product:
        product.setncattr(UNUSED_INPUTS, "coast/h1: cannot be read")
    means = only(tmp_path, means_of(tmp_path))
    assert means.attrs[UNUSED_INPUTS] == "1 of 3 products lack raw files, and name them"
    assert UNUSED_INPUTS not in open_products(tmp_path).attrs


def test_daily_means_of_the_usable_values(tmp_path: Path):
    for day in range(3):
        add_day(tmp_path, day, profiles=6, sections=2)
    means = only(tmp_path, means_of(tmp_path))
    data = open_products(tmp_path, usable=1).load()
    assert means.sizes["time"] == 3
    for day in range(3):
        values = data.isel(time=slice(6 * day, 6 * day + 6))
        mean = means.isel(time=day)
        usable = values.usable < 2
        count = usable.sum("time")
        assert count.to_numpy().tolist() == [5, 6]
        np.testing.assert_array_equal(mean.total_extinction_observations, count)
        np.testing.assert_allclose(mean.usable_share, count / 6)
        x = values.total_extinction.astype(float)
        np.testing.assert_allclose(mean.total_extinction, x.mean("time"), rtol=1e-6)
        np.testing.assert_allclose(
            mean.total_extinction_standard_error,
            np.sqrt((values.total_extinction_standard_error.astype(float) ** 2).sum("time"))
            / count,
            rtol=1e-6,
        )
        np.testing.assert_allclose(
            mean.total_extinction_standard_deviation, x.std("time", ddof=1), rtol=1e-6
        )
        np.testing.assert_allclose(
            mean.total_extinction_model_error,
            values.total_extinction_model_error.mean("time"),
            rtol=1e-6,
        )
        assert mean.shots == 3600
    assert (means.quality_flag == 0).all()


def partly_cloudy(data: xr.Dataset) -> xr.Dataset:
    """Change six profiles of elastic values: clear, clear, a third, only the mean, unknown, bad."""
    bits = {bit.word: np.int32(bit) for bit in flags_of("elastic")}
    flags = np.zeros((6, data.sizes["range"]), np.int32)
    flags[1, :] = bits["low_signal_to_noise"]
    flags[2, :20] = bits["partly_cloudy"]
    flags[3, :30] = bits["cloud"]
    flags[4, :] = bits["cloud"]
    flags[5, :] = bits["no_reference"] | bits["cloud"]
    fraction = np.zeros(flags.shape)
    fraction[2, :20], fraction[3, :30], fraction[4], fraction[5] = 1.0 / 3.0, np.nan, np.nan, 1.0
    mask = np.zeros(flags.shape, np.int8)
    mask[2, :20], mask[3, :30], mask[4], mask[5] = 1, 2, 3, 2
    for name, values in (
        ("quality_flag", flags), ("cloud_fraction", fraction), ("cloud_mask", mask)
    ):  # fmt: skip
        data[name] = (("time", "range"), values)
    for name in list(data.data_vars):
        if name != "cloud_fraction" and data[name].dtype.kind == "f":
            data[name] = data[name].fillna(1e-7)
    data["shots"] = ("time", np.array([600, 600, 1200, 600, 600, 600], np.int32))
    return data


@pytest.mark.parametrize("weights", list(Weights))
def test_means_state_the_share_of_cloudy_profiles(weights: Weights, tmp_path: Path):
    add_day(tmp_path, 0, "elastic", profiles=6, change=partly_cloudy)
    mean = only(tmp_path, means_of(tmp_path, weights=weights)).isel(time=0)
    thin, all_shots = (1.0, 5.0) if weights is Weights.PLAIN else (2.0, 6.0)
    # The unknown profile is not examined, and the rejected one is not in the mean.
    examined = all_shots - 1.0
    expected = np.repeat([(thin / 3.0 + 1.0) / examined, 1.0 / examined, 0.0], [20, 10, 10])
    np.testing.assert_allclose(mean.cloud_fraction, expected, rtol=1e-6)
    assert mean.aerosol_extinction_observations.values.tolist() == [5] * 40
    np.testing.assert_allclose(mean.usable_share, 5.0 / 6.0)
    np.testing.assert_allclose(mean.good_share, np.repeat([1, 2, 3], [20, 10, 10]) / 6.0)
    names = mean.aerosol_extinction.attrs["ancillary_variables"].split()
    assert {"cloud_fraction", "good_share", "usable_share"} <= set(names)


def test_a_mean_is_cloudy_where_all_its_values_are(tmp_path: Path):
    """Of five usable values, one to three are cloudy; of one product, all are."""

    def overcast(data: xr.Dataset) -> xr.Dataset:
        cloud = np.int32(flags_of("elastic").named("cloud"))
        return data.assign(quality_flag=data.quality_flag * 0 + cloud)

    add_day(tmp_path, 0, "elastic", profiles=6, change=partly_cloudy)
    add_day(tmp_path, 1, "elastic", change=overcast)
    flags = only(tmp_path, means_of(tmp_path)).quality_flag.values
    both = [np.int32(flags_of("elastic").named(word)) for word in ("cloud", "partly_cloudy")]
    seen = flags & (both[0] | both[1])
    assert (seen[0] == both[1]).all()
    assert (seen[1] == both[0]).all()


def test_versions_of_means_count_those_of_their_products(tmp_path: Path):
    add_day(tmp_path, 0)
    assert only(tmp_path, means_of(tmp_path)).attrs["product_version"] == "1"
    add_day(tmp_path, 1)
    assert only(tmp_path, means_of(tmp_path)).attrs["product_version"] == "2"
    add_day(tmp_path, 1, version=2)
    assert only(tmp_path, means_of(tmp_path)).attrs["product_version"] == "3"


def test_a_profile_of_few_shots_has_little_weight(tmp_path: Path):
    """As the last mean of a night, over a few files: its error is ten times that of the others."""
    shots = np.array([600, 600, 600, 600, 6], np.int32)

    def uneven(data: xr.Dataset) -> xr.Dataset:
        data["shots"] = ("time", shots)
        data["total_extinction_standard_error"][-1] *= 10.0
        return data

    add_day(tmp_path, 0, change=uneven)
    data = open_products(tmp_path, usable=1).astype(np.float64).load()
    weights = xr.DataArray(shots, dims="time").where(np.isfinite(data.total_extinction))
    weights = weights / weights.sum("time")
    expected = (weights * data.total_extinction).sum("time")
    errors = ((weights * data.total_extinction_standard_error) ** 2).sum("time") ** 0.5
    means = only(tmp_path, means_of(tmp_path))
    np.testing.assert_allclose(means.total_extinction[0], expected, rtol=1e-6)
    np.testing.assert_allclose(means.total_extinction_standard_error[0], errors, rtol=1e-6)
    assert means.attrs["lidarops_weights"] == "shots"
    equal = only(tmp_path, means_of(tmp_path, weights=Weights.PLAIN))
    # In the first section, all values are usable.
    assert (
        equal.total_extinction_standard_error[0, 0]
        > 4.0 * means.total_extinction_standard_error[0, 0]
    )


def test_weights_are_the_inverse_variance_if_requested(tmp_path: Path):
    def uneven(data: xr.Dataset) -> xr.Dataset:
        data["total_extinction_standard_error"] *= xr.DataArray(np.arange(1.0, 6.0), dims="time")
        return data

    add_day(tmp_path, 0, change=uneven)
    means = only(tmp_path, means_of(tmp_path, weights=Weights.INVERSE_VARIANCE))
    data = open_products(tmp_path).astype(np.float64).load()
    weights = 1.0 / data.total_extinction_standard_error**2
    expected = (weights * data.total_extinction).sum("time") / weights.sum("time")
    np.testing.assert_allclose(means.total_extinction[0], expected, rtol=1e-6)
    np.testing.assert_allclose(
        means.total_extinction_standard_error[0], weights.sum("time") ** -0.5, rtol=1e-6
    )
    assert means.attrs["lidarops_weights"] == "inverse-variance"
    assert "1 / standard_error^2" in means.total_extinction.attrs["comment"]


def test_shared_errors_do_not_decrease_with_the_number_of_profiles(tmp_path: Path):
    add_day(tmp_path, 0, "elastic", profiles=9)
    means = only(tmp_path, means_of(tmp_path)).isel(time=0)
    data = open_products(tmp_path).astype(np.float64).load()
    used = np.isfinite(data.aerosol_backscatter)
    count = used.sum("time")

    def random(factor):
        causes = ("noise", "background")
        square = sum(data[f"aerosol_backscatter_error_{cause}"] ** 2 for cause in causes)
        return (factor**2 * square).where(used)

    shared = sum(
        (data[f"aerosol_backscatter_error_{cause}"].where(used).sum("time") / count) ** 2
        for cause in ("reference", "lidar_ratio", "molecular", "dead_time", "baseline")
    )
    expected = np.sqrt(random(1.0).sum("time") / count**2 + shared)
    some = count.to_numpy() > 0
    assert some.any()
    assert not some.all()
    errors = means.aerosol_backscatter_standard_error.to_numpy()
    np.testing.assert_allclose(errors[some], expected.to_numpy()[some], rtol=3e-3)
    for name, factor in (
        ("aerosol_extinction", data.lidar_ratio.isel(product=0)),
        ("scattering_ratio", 1.0 / data.molecular_backscatter.isel(product=0)),
    ):
        total = data[f"{name}_standard_error"] ** 2
        rest = np.sqrt(np.maximum(total - random(factor), 0.0)).where(used).sum("time") / count
        expected = np.sqrt(random(factor).sum("time") / count**2 + rest**2)
        errors = means[f"{name}_standard_error"].to_numpy()
        np.testing.assert_allclose(errors[some], expected.to_numpy()[some], rtol=3e-3)
    assert np.isnan(means.aerosol_backscatter.to_numpy()[~some]).all()
    assert (means.quality_flag.to_numpy()[~some] & flags_of("elastic").rejecting != 0).all()
    assert (means.usable.to_numpy()[~some] == 2).all()


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (
            "multiangle",
            ["vertical_optical_depth", "total_extinction", "layer_vertical_optical_depth"],
        ),
        ("visibility", ["total_extinction", "visibility_in_air"]),
    ],
)
def test_fully_shared_errors_are_averaged(kind: str, names: list[str], tmp_path: Path):
    """Smoothing of scans and the prior of networks affect all profiles alike."""

    def even(data: xr.Dataset) -> xr.Dataset:
        for name in names:
            error = data[f"{name}_standard_error"]
            data[error.name] = error.where(error.isnull(), 0.25 * float(error.mean()))
        return data

    add_day(tmp_path, 0, kind, change=even)
    means = only(tmp_path, means_of(tmp_path)).isel(time=0)
    data = open_products(tmp_path).astype(np.float64).load()
    for name in names:
        assert float(means[f"{name}_observations"].max()) >= 4
        errors = means[f"{name}_standard_error"].to_numpy()
        expected = data[f"{name}_standard_error"].max("time").to_numpy()
        some = np.isfinite(errors)
        assert some.any()
        np.testing.assert_allclose(errors[some], expected[some], rtol=1e-6)
        assert "they are averaged" in means[name].attrs["comment"]
        assert data[f"{name}_standard_error"].attrs["error_kind"] == ErrorKind.BOTH


def test_each_systematic_error_is_averaged_under_its_own_name(tmp_path: Path):
    quantity = "vertical_optical_depth"
    names = [f"{quantity}_gradient_error", f"{quantity}_dead_time_error"]

    def odd(data: xr.Dataset) -> xr.Dataset:
        data[names[1]][2, 5] = np.nan
        return data

    add_day(tmp_path, 0, "multiangle", change=odd)
    means = only(tmp_path, means_of(tmp_path)).isel(time=0)
    data = open_products(tmp_path, usable=1).astype(np.float64).load()
    level = np.arange(data.sizes["altitude"])
    for name in names:
        expected = data[name].mean("time").where((level != 5) | (name != names[1]))
        np.testing.assert_allclose(means[name], expected, rtol=0.005)
        assert name in means[quantity].attrs["ancillary_variables"].split()
    # The error of the dead time is unknown in one profile, and so in the mean.
    assert np.isnan(means[names[1]][5])
    assert float(means[f"{quantity}_observations"][5]) == float(data[quantity][:, 5].count())


def test_an_error_that_no_product_has_is_no_ancillary_variable(tmp_path: Path):
    name = "signal_dead_time_error"
    add_day(tmp_path, 0, "signal", change=lambda data: data.drop_vars(name, errors="ignore"))
    means = only(tmp_path, means_of(tmp_path))
    assert set(means.signal.attrs["ancillary_variables"].split()) <= set(means.variables)


def test_means_of_visibility_state_the_systematic_error_of_extinction(tmp_path: Path):
    add_day(tmp_path, 0, "visibility")
    means = only(tmp_path, means_of(tmp_path)).isel(time=0)
    data = open_products(tmp_path, usable=1).astype(np.float64).load()
    # The synthetic retrieval has a systematic error of 3 percent and a random error of 2 percent.
    expected = 0.03 * data.visibility_in_air.mean("time")
    error = means.visibility_in_air_systematic_error
    np.testing.assert_allclose(error, expected, rtol=1e-4)
    assert error.attrs["error_kind"] == "systematic"
    assert error.name in means.visibility_in_air.attrs["ancillary_variables"].split()


@pytest.mark.parametrize("law", [WavelengthLaw.NONE, WavelengthLaw.KRUSE])
def test_the_systematic_error_of_visibility_does_not_average_out(
    law: WavelengthLaw, tmp_path: Path
):
    """Extinction is too large by its stated systematic error in all profiles."""
    definition = VisibilityDefinition(wavelength=532e-9, law=law)
    true, random, declared = 2e-4, 6e-6, 2e-5

    def off(data: xr.Dataset) -> xr.Dataset:
        noise = np.random.default_rng(8).normal(0.0, random, data.total_extinction.shape)
        # Replaces the extinction that `add_day` has scaled.
        data["total_extinction"] = data.total_extinction.dims, true + declared + noise
        data["total_extinction_standard_error"] = xr.full_like(data.total_extinction, random)
        data["total_extinction_model_error"] = xr.full_like(data.total_extinction, declared)
        data["quality_flag"] = xr.zeros_like(data.quality_flag)
        names = ("", "_standard_error", "_model_error")
        parts = (data[f"total_extinction{name}"].to_numpy() for name in names)
        dims = data.total_extinction.dims
        visibility = visibility_of_extinction(*parts, definition)
        return data.assign({name: (dims, values) for name, values in visibility.items()})

    add_day(tmp_path, 0, profiles=100, change=off)
    means = only(tmp_path, means_of(tmp_path)).isel(time=0)
    expected = visibility_of_extinction(
        *(np.array(value) for value in (true, random, declared)), definition
    )
    bias = np.abs(means.visibility_in_air - expected["visibility_in_air"])
    error = means.visibility_in_air_standard_error
    systematic_error = means.visibility_in_air_systematic_error
    assert (error < 0.02 * means.visibility_in_air).all()
    assert (bias > 4.0 * error).all()
    assert (bias < 1.3 * systematic_error).all()
    assert (bias > 0.7 * systematic_error).all()


def test_a_month_has_all_its_days_and_each_year_its_file(tmp_path: Path):
    # 1 March 2026 is day 0: these are in February and March 2026, and in December 2025.
    for day in (-62, -3, 2, 4):
        add_day(tmp_path, day)
    done = means_of(tmp_path, Period.MONTH)
    assert [(file.periods, file.products) for file in done.files] == [(1, 1), (2, 3)]
    with xr.open_dataset(tmp_path / done.files[1].path) as means:
        # The middles of February and March, as in time.
        assert means.attrs["time_coverage_start"] == "2026-02-15T00:00:00Z"
        assert means.attrs["time_coverage_end"] == "2026-03-16T12:00:00Z"
        assert means.attrs["time_coverage_duration"] == "P59D"
        ends = np.array(["2026-02-15T00", "2026-03-16T12"], "datetime64[ns]")
        np.testing.assert_array_equal(means.time, ends)
        np.testing.assert_array_equal(
            means.time_bnds,
            np.array([["2026-02-01", "2026-03-01"], ["2026-03-01", "2026-04-01"]], "datetime64"),
        )
        np.testing.assert_array_equal(means.total_extinction_observations[:, 1], [5, 10])


def test_a_profile_belongs_to_the_day_of_its_middle(tmp_path: Path):
    def late(data: xr.Dataset) -> xr.Dataset:
        shift = np.timedelta64(13 * 60 + 30, "m")
        return data.assign_coords(time=data.time + shift, time_bnds=data.time_bnds + shift)

    # From 23:30: three profiles on the first day, two on the next day, which has five more.
    add_day(tmp_path, 0, change=late)
    add_day(tmp_path, 1)
    means = only(tmp_path, means_of(tmp_path))
    np.testing.assert_array_equal(means.amplitude_observations[:, 1], [3, 7])


@pytest.mark.parametrize("kind", list(MAKERS))
def test_every_kind_has_means_with_attributes_of_the_table(kind: str, tmp_path: Path):
    add_day(tmp_path, 0, kind)
    means = only(tmp_path, means_of(tmp_path))
    for row in averaged(layout_of(kind)):
        if row.name in means:
            mode = DetectionMode.PHOTON
            assert means[row.name].attrs["units"] == row.units.format(signal="MHz")
            assert means[row.name].attrs["cell_methods"].startswith("time: mean (of usable")
            deviation = means[f"{row.name}_standard_deviation"]
            assert deviation.attrs["cell_methods"].startswith("time: standard_deviation")
            assert mode.value == means.attrs["lidarops_detection_mode"]
    for name in ("usable_share", "good_share", "quality_flag", "usable", "shots"):
        assert name in means
    assert ("cloud_fraction" in means) == (kind in ("elastic", "raman"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "period"),
    [("elastic", Period.DAY), ("signal", Period.DAY), ("visibility", Period.MONTH)],
)
def test_means_comply(kind: str, period: Period, tmp_path: Path):
    for day in range(2):
        add_day(tmp_path, day, kind)
    (file,) = means_of(tmp_path, period).files
    conventions, discovery = findings(tmp_path / file.path)
    assert conventions == set()
    rows = layout(kind, period, Weights.PLAIN).variables
    nameless = {
        f'variable "{row.name}" missing the following attributes: standard_name'
        for row in rows
        if row.standard_name is None
    }
    assert discovery <= nameless


def test_the_provenance_lists_every_product(tmp_path: Path):
    for day in range(3):
        add_day(tmp_path, day)
    means = only(tmp_path, means_of(tmp_path))
    document = json.loads(means.provenance.item())
    facts = facts_of(tmp_path)
    inputs = {
        (entity["lidarops:sha256"], entity["lidarops:id"], entity["lidarops:path"])
        for entity in document["entity"].values()
        if entity["prov:type"]["$"] == "lidarops:Product"
    }
    assert inputs == {(product.sha256, product.id, product.path) for product in facts}
    assert document["entity"]["lidarops:means"]["lidarops:id"] == means.attrs["id"]
    assert document["activity"]["lidarops:averaging"]["lidarops:weights"] == "shots"
    assert means.attrs["lidarops_input_count"] == 3


def test_equal_products_give_equal_bytes_and_other_settings_another_id(tmp_path: Path):
    for root in "ab":
        for day in range(2):
            add_day(tmp_path / root, day)
    (first,), (second,) = (means_of(tmp_path / root).files for root in "ab")
    assert first.sha256 == second.sha256
    ids = {only(tmp_path / "a", means_of(tmp_path / "a", period)).attrs["id"] for period in Period}
    (weighted,) = means_of(tmp_path / "a", weights=Weights.INVERSE_VARIANCE).files
    with xr.open_dataset(tmp_path / "a" / weighted.path) as means:
        ids.add(means.attrs["id"])
    assert len(ids) == 3


def test_a_damaged_product_is_reported_and_the_others_averaged(tmp_path: Path):
    paths = [add_day(tmp_path, day) for day in range(2)]
    (group,) = grouped = groups(facts_of(tmp_path))
    (tmp_path / paths[0]).write_bytes(b"nothing")
    done = Means(tmp_path, grouped, Period.DAY).of(group)
    assert [product.path for product in done.refused] == [paths[0]]
    assert [file.products for file in done.files] == [1]


def test_a_beam_that_moves_has_no_mean(tmp_path: Path):
    add_day(tmp_path, 0, zenith=[0.0, 10.0, 20.0, 30.0, 40.0])
    made = means_of(tmp_path)
    assert not made.files
    assert "several directions" in made.note


def test_means_are_no_products(tmp_path: Path):
    add_day(tmp_path, 0)
    (file,) = means_of(tmp_path).files
    refused = read_product_facts(tmp_path, file.path)
    assert isinstance(refused, Refused)
    assert refused.reason.startswith("holds means of products")
    assert not any(isinstance(product, Refused) for product in facts_of(tmp_path))


@pytest.mark.parametrize("kind", list(kinds()))
def test_every_systematic_error_is_averaged(kind: str):
    source = layout_of(kind)
    covered = {name for row in averaged(source) for name in systematic(row)}
    covered |= {name for row in averaged(source) if row.budget for name in row.budget.shared}
    for row in source.variables:
        if row.error_kind is ErrorKind.SYSTEMATIC and not row.uncertain and "time" in row.dims:
            assert row.name in covered, row.name
