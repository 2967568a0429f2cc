"""The xarray layer: the same bits as numpy for any chunks; units and dimensions are checked."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from support.oracles.homogeneous import signal

import lidarops
from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import labeled, path_fit
from lidarops.retrieve.signal import labeled as labeled_signal

RANGE = np.arange(1, 401) * 30.0
SECTIONS = [(1500.0, 6000.0), (3000.0, 12000.0), (6000.0, 9000.0)]
VALUES = [
    "background",
    "background_standard_error",
    "amplitude",
    "amplitude_standard_error",
    "total_extinction",
    "total_extinction_standard_error",
    "reduced_chi2",
    "valid_bins",
]


@pytest.fixture
def power():
    rng = np.random.default_rng(0)
    values = 50.0 + signal(RANGE, 3e6, 5e-5) + rng.normal(size=(2, 13, RANGE.size))
    values[0, 3, 100:130] = np.nan
    values[1, 7] = np.nan
    return xr.DataArray(
        values,
        dims=("channel", "time", "range"),
        coords={
            "range": ("range", RANGE, {"units": "m"}),
            "time": np.arange(13),
            "channel": ["a", "b"],
        },
        attrs={"units": "mV"},
    )


def in_section(array, near, far):
    first, past = np.searchsorted(RANGE, [near, far])
    return np.asarray(array)[..., first:past], RANGE[first:past]


def test_result_is_that_of_numpy_for_each_section(power):
    fit = labeled.fit_homogeneous_path(power, sections=SECTIONS, variance=1.0)
    assert fit["total_extinction"].dims == ("channel", "time", "section")
    for k, edges in enumerate(SECTIONS):
        expected = path_fit.fit_homogeneous_path(*in_section(power, *edges), variance=1.0)
        for name in VALUES:
            same = getattr(expected, name.removeprefix("total_"))
            np.testing.assert_array_equal(fit[name][..., k], same)
        np.testing.assert_array_equal(fit["quality_flag"][..., k], expected.quality)
    np.testing.assert_allclose(fit["total_extinction"].median("time")[:, 0], 5e-5, rtol=0.02)


@pytest.mark.parametrize("method", ["direct", "cubic"])
def test_profiles_in_parts_give_the_same_bits(power, method):
    rng = np.random.default_rng(1)
    bits = rng.choice([0, Quality.PILE_UP], power.shape, p=[0.9, 0.1]).astype(np.int32)
    variance = power.copy(data=rng.uniform(0.5, 2.0, power.shape))
    parts = power, variance, power.copy(data=bits)

    def fit(rows):
        own, noise, quality = (part.isel(time=rows) for part in parts)
        return labeled.fit_homogeneous_path(
            own, sections=SECTIONS, variance=noise, quality=quality, method=method
        )

    whole = fit(slice(None))
    joined = xr.concat([fit(slice(0, 1)), fit(slice(1, 8)), fit(slice(8, 13))], dim="time")
    for name in whole:
        np.testing.assert_array_equal(joined[name], whole[name])
    assert whole["quality_flag"].dtype == whole["valid_bins"].dtype == np.int32


def test_bad_bins_are_excluded_and_their_bits_carried(power):
    quality = xr.zeros_like(power, dtype=np.int32)
    quality[0, 0, 60:90] = Quality.SATURATED
    quality[0, 1, 60:70] = Quality.INCOMPLETE_OVERLAP
    quality[0, 2, 60:70] = Quality.INPUT_MISSING
    quality[0, 4, 60:90] = Quality.PILE_UP
    spoiled = xr.where(quality & labeled.EXCLUDED, 1e6, power).transpose(*power.dims)
    spoiled["range"].attrs = power["range"].attrs
    fit = labeled.fit_homogeneous_path(
        spoiled, sections=SECTIONS[:2], variance=1.0, quality=quality
    )
    clean = labeled.fit_homogeneous_path(power, sections=SECTIONS[:2], variance=1.0)

    masked = np.where((quality & labeled.EXCLUDED) != 0, np.nan, power)
    expected = path_fit.fit_homogeneous_path(*in_section(masked, *SECTIONS[0]), variance=1.0)
    np.testing.assert_array_equal(fit["total_extinction"][..., 0], expected.extinction)
    carried = fit["quality_flag"][0, :, 0] & labeled.CARRIED
    assert carried[0] == Quality.SATURATED
    assert carried[1] == Quality.INCOMPLETE_OVERLAP
    assert carried[2] == 0
    assert carried[4] == Quality.PILE_UP
    assert fit["total_extinction"][0, 4, 0] == clean["total_extinction"][0, 4, 0]
    # The second section begins beyond the spoiled bins.
    np.testing.assert_array_equal(
        fit["total_extinction"][..., 1], clean["total_extinction"][..., 1]
    )
    assert not np.any(fit["quality_flag"][0, :3, 1] & labeled.CARRIED)


@pytest.mark.parametrize("dims", [("range",), ("time", "range"), ("time",), ("channel", "time")])
def test_variance_may_lack_dimensions(power, dims):
    shape = [power.sizes[dim] for dim in dims]
    values = np.random.default_rng(2).uniform(0.5, 2.0, shape)
    variance = xr.DataArray(values, dims=dims)
    full = variance.broadcast_like(power).transpose(*power.dims)
    expected = labeled.fit_homogeneous_path(power, sections=SECTIONS, variance=full)
    fit = labeled.fit_homogeneous_path(power, sections=SECTIONS, variance=variance)
    # A variance common to all profiles uses another solver, with the same result.
    for name in ("background", "amplitude", "total_extinction"):
        apart = abs(fit[name] - expected[name])
        error = expected[f"{name}_standard_error"]
        assert (apart < 0.01 * error).where(error.notnull(), other=True).all()


def test_coordinates_and_units_describe_the_sections(power):
    fit = labeled.fit_homogeneous_path(power, sections=SECTIONS)
    assert fit["section"].to_numpy().tolist() == [0, 1, 2]
    assert fit["section_range"].to_numpy().tolist() == [3750.0, 7500.0, 7500.0]
    np.testing.assert_array_equal(fit["section_bounds"], SECTIONS)
    assert fit["section_bounds"].dims == ("section", "nv")
    units = {name: fit[name].attrs["units"] for name in VALUES[:-1]}
    assert units["background"] == units["background_standard_error"] == "mV"
    assert units["amplitude"] == "mV m2"
    assert units["total_extinction_standard_error"] == "m-1"
    assert {"time", "channel"} <= set(fit.coords)
    plain = power.copy()
    plain.attrs = {}
    assert (
        labeled.fit_homogeneous_path(plain, sections=SECTIONS)["amplitude"].attrs["units"] == "m2"
    )


def test_a_single_profile(power):
    one = power.isel(channel=0, time=0)
    fit = labeled.fit_homogeneous_path(one, sections=SECTIONS, variance=1.0)
    assert fit["total_extinction"].dims == ("section",)


def test_near_is_inside_and_far_is_not(power):
    fit = labeled.fit_homogeneous_path(power, sections=[(1500.0, 3000.0)])
    assert fit["valid_bins"].max() == 50


def with_units(power, units):
    changed = power.copy()
    changed["range"] = changed["range"].assign_attrs({"units": units})
    return changed


@pytest.mark.parametrize(
    ("change", "arguments", "field", "words"),
    [
        (lambda p: with_units(p, "km"), {}, "range", "'km'"),
        (lambda p: p.assign_coords(range=RANGE), {}, "range", "no attribute units"),
        (lambda p: p.drop_vars("range"), {}, "range", "no attribute units"),
        (lambda p: p[..., [1, 0, *range(2, 400)]], {}, "range", "ascend"),
        (lambda p: p[..., ::-1], {}, "range", "ascend"),
        (lambda p: p, {"sections": [(2000.0, 1000.0)]}, "sections", "holds 0 bins"),
        (lambda p: p, {"sections": [(13000.0, 15000.0)]}, "sections", "30 to 12000 m"),
        (lambda p: p, {"sections": [(3000.0, 3080.0)]}, "sections", "3 bins"),
        (lambda p: p, {"method": "fernald"}, "method", "cubic"),
        (lambda p: p, {"variance": -1.0}, "variance", "negative"),
        (lambda p: p, {"variance": "misaligned"}, "variance", "does not fit"),
        (lambda p: p, {"quality": "extra"}, "quality", "dimensions"),
    ],
)
def test_invalid_arguments_are_refused(power, change, arguments, field, words):
    arguments = {"sections": SECTIONS} | arguments
    if arguments.get("variance") == "misaligned":
        arguments["variance"] = xr.ones_like(power).assign_coords(time=np.arange(13) + 1)
    if arguments.get("quality") == "extra":
        arguments["quality"] = xr.zeros_like(power, dtype=np.int32).expand_dims(angle=2)
    with pytest.raises(RetrievalInputError, match=words) as caught:
        labeled.fit_homogeneous_path(change(power), **arguments)
    assert caught.value.field == field


def test_real_vertical_profiles_are_flagged(data_root):
    files = sorted((data_root / "pilar" / "20241002").glob("h*"))[:30]
    archive = lidarops.open_archive(files, mask_and_scale=False)
    signal_ = labeled_signal.condition(archive, "analog_532p")
    fit, fit_of_mean = (
        labeled.fit_homogeneous_path(
            power,
            sections=[(1000.0, 3000.0), (1500.0, 5000.0), (2500.0, 10500.0)],
            variance=variance,
        )
        for power, variance in (
            (signal_["power"], signal_["variance"]),
            (signal_["power"].mean("time"), signal_["variance"].mean("time") / len(files)),
        )
    )
    # In the longest section, noise hides the shape of single profiles.
    assert np.all(fit["quality_flag"].isel(section=[0, 1]) != 0)
    assert np.all(fit_of_mean["quality_flag"] != 0)


def test_chunks_do_not_change_a_bit_of_signals(data_root):
    files = sorted((data_root / "pilar" / "20241002").iterdir())[:5]
    # The far range of this counter is not paralysed.
    for channel, settings in (("analog_532p", {}), ("photon_53200o", {"dead_time": 2e-9})):
        results = []
        for chunk in (1, 2, 5):
            archive = lidarops.open_archive(
                files, mask_and_scale=False, profiles_per_chunk=chunk, header_position="ignore"
            )
            conditioned = labeled_signal.condition(
                archive, channel, full_overlap_range=500.0, **settings
            )
            far = (27_000.0, 30_000.0)
            results.append(labeled_signal.correct_for_range(conditioned, far).load())
        for other in results[1:]:
            for name in results[0].data_vars:
                np.testing.assert_array_equal(other[name].values, results[0][name].values)
        assert np.isfinite(results[0]["background"].values).any()


FAR = np.arange(1, 2001) * 15.0
"""m, bins to 30 km."""


def far_path(extinction, profiles=300, amplitude=2e8, background=20.0, sigma=0.5, seed=3):
    rng = np.random.default_rng(seed)
    clean = signal(FAR, amplitude, extinction)
    noise = rng.normal(0.0, sigma, (profiles, FAR.size))
    values = background + clean + noise
    return xr.DataArray(
        values,
        dims=("time", "range"),
        coords={"range": ("range", FAR, {"units": "m"})},
        attrs={"units": "mV"},
    )


@pytest.mark.parametrize(("extinction", "amplitude"), [(2e-4, 2e8), (5e-5, 2e7)])
def test_the_background_of_the_far_range_makes_extinction_more_certain(extinction, amplitude):
    """Its error holds what signal may be left there, of which half is subtracted."""
    power = far_path(extinction, amplitude=amplitude)
    options = {"sections": [(1500.0, 4000.0)], "variance": 0.25}
    own = labeled.fit_homogeneous_path(power, **options)
    far = labeled.fit_homogeneous_path(
        power, **options, method="known_background", background_range=(27_000.0, 30_000.0)
    )
    off = (far["total_extinction"] - extinction) / far["total_extinction_standard_error"]
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.12)
    assert (np.abs(off) < 4.0).all()
    ratio = far["total_extinction_standard_error"] / own["total_extinction_standard_error"]
    # At 5e-5 m-1, signal reaches 27 km.
    assert ratio.median() < (0.5 if extinction == 2e-4 else 1.2)
    assert not (far["quality_flag"] & int(Quality.BACKGROUND_UNCERTAIN)).any()


def test_signal_left_in_a_near_tail_is_part_of_the_error():
    """The last tenth of 4.5 km holds 30 standard errors of its mean."""
    power = far_path(2e-5, sigma=0.2).sel(range=slice(None, 4500.0))
    far = labeled.fit_homogeneous_path(
        power,
        sections=[(1500.0, 4000.0)],
        variance=0.04,
        method="known_background",
        background_range=(4050.0, 4500.0),
    )
    off = (far["total_extinction"] - 2e-5) / far["total_extinction_standard_error"]
    assert np.isfinite(off).all()
    assert (np.abs(off) < 4.0).all()
    assert far["background_standard_error"].median() > 0.2


def test_a_given_background_is_that_of_all_profiles_with_its_error():
    power = far_path(2e-4, profiles=7)
    options = {
        "sections": [(1500.0, 4000.0)],
        "variance": 0.25,
        "method": "known_background",
        "background": (370.0, 0.2),
    }
    fit = labeled.fit_homogeneous_path(power, **options)
    assert (fit["background"] == 370.0).all()
    np.testing.assert_allclose(fit["background_standard_error"], 0.2)
    with pytest.raises(RetrievalInputError, match="background: is given together"):
        labeled.fit_homogeneous_path(power, **options, background_range=(27_000.0, 30_000.0))


def test_the_far_background_needs_variances():
    with pytest.raises(RetrievalInputError, match="variance: is needed"):
        labeled.fit_homogeneous_path(
            far_path(2e-4, profiles=2),
            sections=[(1500.0, 4000.0)],
            method="known_background",
            background_range=(27_000.0, 30_000.0),
        )


@pytest.mark.parametrize("method", ["linearized", "known_extinction"])
def test_a_given_extinction_is_that_of_each_profile(method):
    power = far_path(2e-4, profiles=7)
    given = xr.DataArray(2e-4 * np.linspace(0.9, 1.1, 7), dims="time")
    options = {"sections": [(1500.0, 4000.0)], "variance": 0.25, "method": method}
    fit = labeled.fit_homogeneous_path(power, **options, extinction=given)
    inside = (FAR >= 1500.0) & (FAR < 4000.0)
    for k in range(7):
        expected = path_fit.fit_homogeneous_path(
            power.values[k, inside],
            FAR[inside],
            variance=0.25,
            method=method,
            extinction=given.values[k],
        )
        for name in VALUES:
            np.testing.assert_array_equal(
                fit[name].values[k, 0], getattr(expected, name.removeprefix("total_"))
            )


def test_a_given_extinction_must_fit_the_power():
    with pytest.raises(RetrievalInputError, match="extinction"):
        labeled.fit_homogeneous_path(
            far_path(2e-4, profiles=2),
            sections=[(1500.0, 4000.0)],
            method="known_extinction",
            extinction=xr.DataArray(np.full(3, 2e-4), dims="time"),
        )
