"""Products that a plan makes of counts of a simulated lidar, compared with its truth."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import dask.array as da
import numpy as np
import pytest
import xarray as xr
from support import factories
from support.cases import each
from support.products.encoded_products import build_product

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.campaign.model import Campaign, Metadata
from lidarops.flags import Quality
from lidarops.netcdf.context import Context
from lidarops.records import DetectionMode, Plan, Role
from lidarops.retrieve.air.molecular import MolecularProfile, us_standard
from lidarops.run.scenes import cut_scenes
from lidarops.scene import dependence, pipe
from lidarops.scene.case import counted_channels
from lidarops.scene.plan import plan_scene
from lidarops.scene.profiles import ChannelSignal, Chunk, ProductStream, Source, chunks
from lidarops.scene.retrieval import streams_of

AIR = MolecularProfile.us_standard()
STATION = 20.0
LIDAR_RATIO = 50.0
SHOTS = 600
DEAD_TIME = 4e-9
INPUT_RANGE = 0.5
"""V."""
RATIO = 20.0
"""MHz a mV."""
SKY = 0.1
"""MHz."""
MINUTE = np.timedelta64(60_000_000_000, "ns")
START = np.datetime64("2026-03-01T00:00", "ns")
NONE = Ancillaries({}, {}, {}, ())
distance = 7.5 * (np.arange(1200) + 0.5)


def particles(altitude):
    z = np.asarray(altitude, dtype=float)
    return 2e-6 / (1.0 + np.exp(np.clip((z - 1200.0) / 120.0, -50.0, 50.0)))


def count_rate(r, *, zenith=0.0, constant=4e12, air=AIR):
    """MHz, without sky."""
    climb = np.cos(np.deg2rad(zenith))
    fine = np.linspace(0.0, r[-1], 10 * r.size)
    z = STATION + climb * fine
    extinction = LIDAR_RATIO * particles(z) + air.extinction(z, 532e-9)
    steps_ = np.diff(fine) * (extinction[1:] + extinction[:-1]) / 2.0
    depth = np.interp(r, fine, np.concatenate([[0.0], np.cumsum(steps_)]))
    z = STATION + climb * r
    total = particles(z) + air.backscatter(z, 532e-9)
    return constant * total * np.exp(-2.0 * depth) / r**2


def archive(rate=None, *, profiles=20, zenith=0.0, seed=0, lag=0, ripple=0.0, first=START, chunk=7):
    """Raw counts of an analog and a photon counting channel, one profile a minute."""
    rng = np.random.default_rng(seed)
    rate = count_rate(distance, zenith=zenith) if rate is None else rate
    light = rate + SKY
    bins, exposure = light.size, SHOTS * 7.5 / 150.0
    measured = light / (1.0 + light * DEAD_TIME * 1e6)
    counts = rng.poisson(np.broadcast_to(measured * exposure, (profiles, bins)))
    voltage = 1.0 + np.interp(np.arange(bins) - lag, np.arange(bins), light) / RATIO
    voltage = voltage + ripple * np.sin(np.arange(bins) / 5.0)
    voltage = voltage + 0.02 * rng.standard_normal((profiles, bins))
    scale = SHOTS * 4096 / (1000 * INPUT_RANGE)
    starts = first + np.arange(profiles) * MINUTE
    common = {"bin_width": 7.5}
    fired = np.full(profiles, SHOTS, np.int32)

    def lazy(values):
        return da.from_array(np.rint(values).astype(np.int32), chunks=(chunk, bins))

    return xr.Dataset(
        {
            "photon_532o": (
                ("time", "range"),
                lazy(counts),
                {"detection_mode": "photon", **common},
            ),
            "analog_532o": (
                ("time", "range"),
                lazy(np.clip(voltage * scale, 0, SHOTS * 4095)),
                {"detection_mode": "analog", "adc_bits": 12, **common},
            ),
            "photon_532o_shots": ("time", fired),
            "analog_532o_shots": ("time", fired),
            "analog_532o_input_range": ("time", np.full(profiles, INPUT_RANGE)),
        },
        coords={
            "time": starts + MINUTE // 2,
            "time_bnds": (("time", "nv"), np.stack([starts, starts + MINUTE], axis=-1)),
            "range": ("range", 7.5 * (np.arange(bins) + 0.5), {"units": "m"}),
            "zenith_angle": ("time", np.full(profiles, zenith)),
        },
    )


ELASTIC = {
    "channels": ["photon_532o", "glued_532o"],
    "lidar_ratio_standard_error": 0.0,
    "molecular_relative_error": 0.0,
    "reference": {"lowest": 3000, "highest": 8000, "relative_error": 0.0},
}


def campaign(products, **facts) -> Campaign:
    channels = {
        "photon_532o": {"dead_time": DEAD_TIME},
        "analog_532o": {"noise_variance": 4e-4},
    }
    settings = {"zenith_angle": 0.0, "channels": channels, **facts}
    validated = factories.campaign(products=products, facts=[settings])
    # all_steps: retrieves sections along a vertical beam too.
    return validated.model_copy(update={"all_steps": True})


def planned(settings: Campaign, *, dark: bool = False, bins: int = 1200) -> Plan:
    layout = tuple(replace(channel, bins=bins) for channel in (factories.PHOTON, factories.ANALOG))
    granules = [factories.granule(0, layout=layout)]
    if dark:
        granules.append(
            factories.granule(-30, path="dark/d", role=Role.DARK, layout=layout, size=7)
        )
    return plan_scene(cut_scenes(settings, granules).scenes[0], settings)


def carry_out(
    products, raw=None, *, channel="photon_532o", dark=None, ancillaries=None, profiles=7, **facts
):
    """Return the products of a channel, from chunks of some profiles."""
    raw = archive() if raw is None else raw
    plan = planned(campaign(products, **facts), dark=dark is not None, bins=raw.sizes["range"])
    files = NONE if ancillaries is None else ancillaries
    source = Source(raw, dark, files, STATION)
    signal = pipe.channel_signal(source, plan.steps, channel)
    streams = streams_of(plan.steps, signal)
    rows = {kind: [] for kind in streams}
    counted = counted_channels(plan.steps, channel)
    for chunk in chunks(source, counted, streams.values(), profiles):
        for kind, stream in streams.items():
            rows[kind] += stream.add(chunk)
    return {kind: product_of([*rows[kind], *stream.results()]) for kind, stream in streams.items()}


def product_of(batches):
    """Return a product from its frame and the batches of its rows."""
    frame, *rows = batches
    if len(rows) == 1:
        return rows[0]
    whole = xr.concat(rows, "time", data_vars="minimal", coords="minimal", compat="override")
    return frame.assign(whole.variables)


def read(folder: Path, **files: str) -> Ancillaries:
    """Write and read the files beside a campaign file."""
    for name, content in files.items():
        (folder / f"{name}.csv").write_text(content)
    facts = {f"{name}_profile": f"{name}.csv" for name in files}
    plan = planned(campaign({"elastic": ELASTIC}, **facts))
    return Ancillaries.read(folder, dependence.ancillary_files(plan.steps))


def between(low, high):
    return (distance > low) & (distance < high)


@cache
def elastic_products():
    """Return the elastic products of the photon-counting and the glued channel."""
    products = {"elastic": {**ELASTIC, "average": "10min"}}
    return {
        channel: carry_out(products, channel=channel)["elastic"]
        for channel in ("photon_532o", "glued_532o")
    }


def deviation(product, inside):
    """Return the deviation of values without other bits from the truth, in standard errors."""
    score = (product["aerosol_backscatter"] - particles(STATION + distance)) / product[
        "aerosol_backscatter_standard_error"
    ]
    # Without values below their noise the others would be biased.
    flags = product["quality_flag"] & ~np.int32(Quality.LOW_SIGNAL_TO_NOISE)
    return score.where(flags == 0).to_numpy()[:, inside]


@pytest.mark.parametrize(
    ("kind", "request_"),
    [
        ("signal", {"channels": ["glued_532o"]}),
        ("elastic", {**ELASTIC, "average": "20min"}),
        ("homogeneous", {"channels": ["photon_532o"], "sections": [[750, 4500]], "visibility": {}}),
        (
            "homogeneous",
            {
                "channels": ["photon_532o"],
                "sections": [[750, 4500]],
                "method": "known_background",
            },
        ),
        (
            "homogeneous",
            {
                "channels": ["photon_532o"],
                "sections": [[750, 4500]],
                "method": "linearized",
                "extinction": 2e-4,
            },
        ),
    ],
)
def test_a_product_takes_nothing_but_what_its_plan_names(kind, request_, monkeypatch) -> None:
    """Else a product could depend on what its plan does not state."""
    channel, taken = request_["channels"][-1], set()

    def noted(signal, name):
        if name in GIVEN_BY:
            taken.add((object.__getattribute__(signal, "channel"), name))
        return object.__getattribute__(signal, name)

    monkeypatch.setattr(ChannelSignal, "__getattribute__", noted, raising=False)
    carry_out({kind: request_}, channel=channel)
    plan = planned(campaign({kind: request_}))
    closure = dependence.plan_closure(plan, [(kind, channel)])
    named = {(entry.channel, entry.name) for entry in (*closure.steps, *closure.left_out)}
    assert all(named & {(of, stage) for stage in GIVEN_BY[name]} for of, name in taken)
    assert {name for _, name in taken} >= {"profiles", "dead_time", "full_overlap_range"}


GIVEN_BY = {
    "wavelength": ("read",),
    "full_overlap_range": ("overlap",),
    "overlap": ("overlap",),
    "range_offset": ("range_offset",),
    "dark": ("dark",),
    "dead_time": ("dead_time",),
    "dead_time_uncertainty": ("dead_time",),
    "relative_variance": ("noise",),
    "estimated_lag": ("lag",),
    "profiles": ("noise", "glue"),
    "molecules": ("molecular",),
}
"""Stages that may give what a signal holds."""


@pytest.mark.parametrize("channel", ["photon_532o", "glued_532o"])
def test_elastic_recovers_the_truth(channel: str) -> None:
    product = elastic_products()[channel]
    assert product.sizes == {"time": 2, "range": 1200, "nv": 2}
    assert np.isfinite(product["reference_bottom"]).all()
    for low, high in ((800, 1500), (1500, 3000), (3000, 6000)):
        score = deviation(product, between(low, high))
        assert np.isfinite(score).mean() > 0.9
        assert np.sqrt(np.nanmean(score**2)) < 1.3
    np.testing.assert_array_equal(product["profiles"], [10, 10])
    np.testing.assert_array_equal(product["shots"], [6000, 6000])
    np.testing.assert_array_equal(product["time"], START + np.array([5, 15]) * MINUTE)


def test_the_glued_channel_starts_nearer_than_photon_counting() -> None:
    near = between(300, 700)
    photon, glued = (deviation(elastic_products()[c], near) for c in ("photon_532o", "glued_532o"))
    assert np.isfinite(photon).mean() < 0.1
    assert np.isfinite(glued).all()
    assert np.abs(glued).max() < 4.0
    product = elastic_products()["glued_532o"]
    score = (product["glue_slope"] - RATIO) / product["glue_slope_standard_error"]
    assert np.abs(score).max() < 4.0
    assert not [name for name in elastic_products()["photon_532o"] if str(name).startswith("glue_")]


@pytest.mark.parametrize("channel", ["photon_532o", "glued_532o"])
def test_results_can_be_built_into_products(channel: str) -> None:
    plan = planned(campaign({"elastic": ELASTIC}))
    retrieved = elastic_products()[channel]
    settings = {
        "mode": DetectionMode.PHOTON,
        "wavelength": 532e-9,
        "station_key": "coast",
        "station": factories.campaign().stations["coast"],
        "instrument_key": "lidar",
        "instrument_name": "",
        "metadata": Metadata(),
        "title": "Test",
        "summary": "",
        "start": datetime(2026, 3, 1, tzinfo=UTC),
        "stop": datetime(2026, 3, 1, tzinfo=UTC) + timedelta(days=1),
        "campaign": "test",
        "scene": plan.scene,
        "kind": "elastic",
        "channel": channel,
        "inputs": (),
        "plan": plan,
        "settings": {},
        "versions": {},
        "code_version": "0",
        "raw_format": "Licel",
        "notes": (),
    }
    product = build_product(retrieved, Context(**settings))
    assert product["aerosol_backscatter"].dims == ("time", "altitude")
    stored = product["aerosol_backscatter"].to_numpy()
    np.testing.assert_allclose(
        stored[np.isfinite(retrieved["aerosol_backscatter"])],
        retrieved["aerosol_backscatter"].to_numpy()[np.isfinite(retrieved["aerosol_backscatter"])],
        rtol=2e-4,
    )
    np.testing.assert_allclose(product["altitude"][..., 100], STATION + distance[100], rtol=1e-6)


@each("channel", ["photon_532o", "glued_532o"])
@each("profiles", [1, 3, 20])
def test_any_chunks_give_the_same_bits(channel: str, profiles: int) -> None:
    products = {"elastic": {**ELASTIC, "average": "10min"}}
    product = carry_out(products, archive(chunk=13), channel=channel, profiles=profiles)["elastic"]
    xr.testing.assert_identical(product, elastic_products()[channel])


def test_a_slant_beam_recovers_the_same_truth() -> None:
    products = {"elastic": {**ELASTIC, "reference": {"lowest": 3000, "highest": 6000}}}
    raw = archive(zenith=30.0)
    product = carry_out(products, raw, zenith_angle=30.0)["elastic"]
    altitude = STATION + np.cos(np.deg2rad(30.0)) * distance
    assert float(product["zenith_angle"]) == 30.0
    score = (product["aerosol_backscatter"] - particles(altitude)) / product[
        "aerosol_backscatter_standard_error"
    ]
    inside = score.to_numpy()[:, between(800, 3000)]
    assert np.sqrt(np.nanmean(inside**2)) < 1.4
    assert float(product["reference_bottom"][0]) >= 3000.0 / np.cos(np.deg2rad(30.0)) - 1e-6


def test_missing_profiles_give_flags_and_no_error() -> None:
    raw = archive()
    for name in ("photon_532o", "analog_532o"):
        counts = raw[name].to_numpy().copy()
        counts[10:] = 0
        raw[name] = (("time", "range"), da.from_array(counts, chunks=(6, -1)), raw[name].attrs)
    raw["photon_532o_shots"] = ("time", np.where(np.arange(20) < 10, SHOTS, 0).astype(np.int32))
    raw["analog_532o_shots"] = raw["photon_532o_shots"]
    products = {"elastic": {**ELASTIC, "average": "10min"}, "signal": {"channels": ["glued_532o"]}}
    for channel in ("photon_532o", "glued_532o"):
        for kind, product in carry_out(products, raw, channel=channel).items():
            flag = product["quality_flag"].to_numpy()
            name = "aerosol_backscatter" if kind == "elastic" else "signal"
            assert (flag[np.isnan(product[name].to_numpy())] != 0).all()
            assert np.isnan(product[name].to_numpy()[-1]).all()
            assert np.isfinite(product[name].to_numpy()[0]).mean() > 0.9


# Files beside the campaign file ---------------------------------------------------------------


def test_a_sounding_replaces_the_standard_atmosphere(tmp_path: Path) -> None:
    z = np.linspace(0.0, 20_000.0, 201)
    pressure, temperature = us_standard(z)
    warm = temperature + 8.0
    force = pressure[0] * (pressure / pressure[0]) ** (1.0 - 8.0 / 260.0)
    rows = [f"{a:.1f},{p / 100:.6f},{t:.3f}" for a, p, t in zip(z, force, warm, strict=True)]
    text = "\n".join(["altitude [m],pressure [hPa],temperature [K]", *rows])
    files = read(tmp_path, molecular=text)
    air = files.profiles["molecular.csv"]
    raw = archive(count_rate(distance, air=air))
    products = {"elastic": ELASTIC}
    sounded = carry_out(products, raw, ancillaries=files, molecular_profile="molecular.csv")
    standard = carry_out(products, raw)
    np.testing.assert_allclose(
        sounded["elastic"]["molecular_backscatter"],
        air.backscatter(STATION + distance, 532e-9),
        rtol=1e-12,
    )
    inside = between(800, 1500)
    assert np.sqrt(np.nanmean(deviation(sounded["elastic"], inside) ** 2)) < 1.4
    standard_air = standard["elastic"]["molecular_backscatter"]
    assert np.abs(standard_air / sounded["elastic"]["molecular_backscatter"] - 1.0).max() > 0.02


OVERLAP = "range [m],overlap\n300,0.1\n600,0.4\n1200,0.8\n1800,1\n"
SEEN = np.where(
    distance < 300.0, 0.05, np.interp(distance, [300, 600, 1200, 1800], [0.1, 0.4, 0.8, 1])
)
FACTS = {"overlap_profile": "overlap.csv"}


class TestOverlap:
    raw = staticmethod(lambda: archive(count_rate(distance, constant=4e11) * SEEN))

    def test_the_signal_is_divided_by_it(self, tmp_path: Path) -> None:
        products = {"signal": {"channels": ["photon_532o"]}}
        files = read(tmp_path, overlap=OVERLAP)
        whole = carry_out(products, self.raw(), ancillaries=files, **FACTS)["signal"]
        plain = carry_out(products, self.raw())["signal"]
        known = distance > 300.0
        for name in ("signal", "signal_standard_error"):
            np.testing.assert_allclose(
                whole[name].to_numpy()[:, known],
                plain[name].to_numpy()[:, known] / SEEN[known],
                rtol=1e-6,
            )
        flag = whole["quality_flag"].to_numpy() & int(Quality.INCOMPLETE_OVERLAP)
        np.testing.assert_array_equal(flag != 0, np.broadcast_to(~known, flag.shape))
        assert np.isnan(whole["signal"].to_numpy()[:, ~known]).all()

    def test_elastic_is_unbiased_where_it_is_given(self, tmp_path: Path) -> None:
        files = read(tmp_path, overlap=OVERLAP)
        retrieved = carry_out({"elastic": ELASTIC}, self.raw(), ancillaries=files, **FACTS)
        score = deviation(retrieved["elastic"], between(450, 1200))
        assert np.isfinite(score).mean() > 0.9
        assert np.sqrt(np.nanmean(score**2)) < 1.4

    def test_it_also_holds_for_the_glued_channel(self, tmp_path: Path) -> None:
        files = read(tmp_path, overlap=OVERLAP)
        products = {"signal": {"channels": ["photon_532o", "glued_532o"]}}
        retrieved = carry_out(products, channel="glued_532o", ancillaries=files, **FACTS)
        flag = retrieved["signal"]["quality_flag"].to_numpy()
        assert (flag[:, distance < 300.0] & int(Quality.INCOMPLETE_OVERLAP) != 0).all()

    def test_products_are_independent(self, tmp_path: Path) -> None:
        files = read(tmp_path, overlap=OVERLAP)
        sections = {"channels": ["photon_532o"], "sections": [[100, 900], [900, 4500]]}
        alone = carry_out({"homogeneous": sections}, self.raw(), ancillaries=files, **FACTS)
        products = {"homogeneous": sections, "signal": {"channels": ["photon_532o"]}}
        beside = carry_out(products, self.raw(), ancillaries=files, **FACTS)
        xr.testing.assert_identical(alone["homogeneous"], beside["homogeneous"])

    def test_a_path_through_partial_overlap_is_corrected_or_flagged(self, tmp_path: Path) -> None:
        files = read(tmp_path, overlap=OVERLAP)
        level = 1e9 * np.exp(-2.0 * 3e-4 * distance) / distance**2
        sections = {"channels": ["photon_532o"], "sections": [[400, 3000]]}
        settings = {**FACTS, "zenith_angle": 90.0}
        product = carry_out(
            {"homogeneous": sections}, archive(level * SEEN), ancillaries=files, **settings
        )["homogeneous"]
        right = (
            np.abs(product["total_extinction"] - 3e-4)
            < 5 * product["total_extinction_standard_error"]
        )
        assert (right | (product["quality_flag"] != 0)).all()


# Dark signals, lags and the rest of a plan ------------------------------------------------------


def _dark(profiles: int = 12, ripple: float = 0.5) -> xr.Dataset:
    nothing = np.full(distance.size, -SKY)
    return archive(nothing, profiles=profiles, ripple=ripple, seed=8, first=START - 30 * MINUTE)


def test_the_dark_signal_is_subtracted_and_its_error_included() -> None:
    products = {"signal": {"channels": ["analog_532o"]}}
    raw = archive(ripple=0.5)
    uncorrected = carry_out(products, raw, channel="analog_532o")["signal"]
    corrected = carry_out(products, raw, channel="analog_532o", dark=_dark())["signal"]
    r2 = distance**2
    true = count_rate(distance) / RATIO * r2
    far = between(3000, 6000)
    error = corrected["signal_standard_error"].to_numpy()[:, far]
    score = (corrected["signal"].to_numpy() - true)[:, far] / error
    # A fixed dark signal has one error for all 20 profiles, stated for each of them.
    assert 0.85 < np.sqrt(np.mean(score**2)) < 1.15
    dark_signal = (uncorrected["signal"].to_numpy() - true)[:, far]
    assert np.sqrt(np.mean((dark_signal / error) ** 2)) > 5.0
    # Where it is not subtracted, the dark signal passes for noise.
    without = carry_out(products, archive(ripple=0.0), channel="analog_532o")["signal"]
    noise = without["signal_standard_error"].to_numpy()[:, far]
    np.testing.assert_allclose(np.median(error / noise), np.sqrt(1 + 1 / 12), rtol=0.02)


def test_means_of_many_profiles_keep_the_error_of_the_dark_signal() -> None:
    products = {"elastic": {**ELASTIC, "channels": ["analog_532o"], "average": "2h"}}
    raw = archive(count_rate(distance, constant=4e13), profiles=120)
    errors = {}
    for name, dark in (("without", None), ("with", _dark(profiles=3, ripple=0.0))):
        product = carry_out(products, raw, channel="analog_532o", dark=dark)["elastic"]
        assert product.sizes["time"] == 1
        inside = between(2000, 3000)
        errors[name] = np.nanmedian(
            product["aerosol_backscatter_error_noise"].to_numpy()[0, inside]
        )
    # 120 profiles average down, 3 dark files do not: sqrt((1/120 + 1/3) / (1/120)).
    assert errors["with"] / errors["without"] == pytest.approx(np.sqrt(41.0), rel=0.25)


def _glued(raw: xr.Dataset, **analog: object) -> xr.Dataset:
    channels = {
        "photon_532o": {"dead_time": DEAD_TIME},
        "analog_532o": {"noise_variance": 4e-4, **analog},
    }
    products = {"signal": {"channels": ["glued_532o"]}}
    return carry_out(products, raw, channel="glued_532o", channels=channels)["signal"]


@each(
    ("lag", "settings"),
    [
        (6, {"lag": 6}),
        (6, {"range_offset": -45.0}),
        (-4, {"range_offset": 30.0}),
        (6, {"lag": 4, "range_offset": -15.0}),
        (0, {}),
        (0, {"lag": "estimate"}),
    ],
)
def test_a_given_lag_is_corrected(lag: int, settings: dict[str, object]) -> None:
    """The campaign may give the lag or the range offset of the analog bins."""
    product = _glued(archive(lag=lag), **settings)
    score = (product["glue_slope"] - RATIO) / product["glue_slope_standard_error"]
    assert abs(float(score.mean())) < 1.0
    near = between(250, 600)
    true = count_rate(distance) * distance**2
    relative_error = product["signal"].to_numpy()[:, near] / true[near] - 1.0
    assert np.abs(np.nanmean(relative_error, axis=0)).max() < 0.03
    np.testing.assert_array_equal(product["range"], distance)


def test_a_lag_that_the_campaign_gives_is_not_estimated_for_the_dead_time() -> None:
    """Both records hold the same noise, 4 bins apart: an estimate of the lag finds it."""
    raw = archive()
    measured = raw["photon_532o"].to_numpy() / (SHOTS * 7.5 / 150.0)
    light = np.roll(measured / (1.0 - measured * DEAD_TIME * 1e6), 4, axis=1)
    voltage = np.rint((1.0 + light / RATIO) * SHOTS * 4096 / (1000 * INPUT_RANGE))
    raw["analog_532o"] = raw["analog_532o"].copy(data=da.from_array(voltage.astype(np.int32)))

    def estimate(**analog: object) -> float | None:
        channels = {"photon_532o": {"dead_time": "estimate"}, "analog_532o": analog}
        steps = planned(
            campaign({"signal": {"channels": ["photon_532o"]}}, channels=channels)
        ).steps
        return pipe.channel_signal(Source(raw, None, NONE, STATION), steps, "photon_532o").dead_time

    assert estimate(lag="estimate") == pytest.approx(DEAD_TIME, rel=0.1)
    assert estimate(lag=4) == pytest.approx(DEAD_TIME, rel=0.1)
    assert estimate(lag=0) != pytest.approx(DEAD_TIME, rel=0.1)


def test_an_uncorrected_lag_shows_near_the_lidar() -> None:
    product = _glued(archive(lag=6))
    near = between(250, 600)
    relative_error = (
        product["signal"].to_numpy()[:, near] / (count_rate(distance) * distance**2)[near] - 1.0
    )
    assert np.abs(np.nanmean(relative_error, axis=0)).max() > 0.05


def test_geometry_and_shots_go_with_every_product() -> None:
    products = {
        "signal": {"channels": ["photon_532o"]},
        "homogeneous": {"channels": ["photon_532o"], "sections": [[1500, 4500]]},
        "elastic": {**ELASTIC, "channels": ["photon_532o"]},
    }
    retrieved = carry_out(products, archive().assign_coords(azimuth=("time", np.full(20, 40.0))))
    assert set(retrieved) == {"signal", "homogeneous", "elastic"}
    for product in retrieved.values():
        assert {"time", "time_bnds", "zenith_angle", "azimuth"} <= set(product.coords)
        assert product["shots"].dims == ("time",)
        assert all(array.chunks is None for array in product.variables.values())
    assert int(retrieved["signal"]["shots"][0]) == SHOTS
    assert int(retrieved["elastic"]["shots"][0]) == 20 * SHOTS


def test_only_planned_products_are_made() -> None:
    retrieved = carry_out({"signal": {"channels": ["photon_532o"]}})
    assert list(retrieved) == ["signal"]


def test_a_planned_product_can_be_made() -> None:
    """The bins end just where the nearest reference window does."""
    products = {"elastic": {**ELASTIC, "reference": {"lowest": 3002.5, "highest": 8000}}}
    raw = archive(count_rate(7.5 * (np.arange(534) + 0.5)))
    plan = planned(campaign(products), bins=534)
    names = [step.name for step in plan.steps if step.channel == "photon_532o"]
    if "elastic" in names:
        assert carry_out(products, raw)["elastic"].sizes["time"] == 1


@pytest.mark.parametrize("zenith", [0.0, 20.0, 30.0, 60.0])
def test_a_single_window_that_the_plan_allows_is_used_at_any_angle(zenith: float) -> None:
    window = {"lowest": 2500, "highest": 3500, "width": 1000, "relative_error": 0.0}
    product = carry_out(
        {"elastic": {**ELASTIC, "reference": window}}, archive(zenith=zenith), zenith_angle=zenith
    )["elastic"]
    climb = np.cos(np.deg2rad(zenith))
    assert float(product["reference_bottom"][0]) * climb == pytest.approx(2500.0)
    assert float(product["reference_top"][0]) * climb == pytest.approx(3500.0)


def test_bins_nearer_than_full_overlap_are_flagged_and_excluded() -> None:
    products = {"signal": {"channels": ["photon_532o"]}, "elastic": ELASTIC}
    for channel in ("photon_532o", "glued_532o"):
        retrieved = carry_out(products, channel=channel, full_overlap_range=450.0)
        near = distance < 450.0
        for kind, product in retrieved.items():
            hit = (product["quality_flag"].to_numpy() & int(Quality.INCOMPLETE_OVERLAP)) != 0
            np.testing.assert_array_equal(hit, np.broadcast_to(near, hit.shape), err_msg=kind)
        elastic = retrieved["elastic"]["aerosol_backscatter"].to_numpy()
        assert np.isnan(elastic[:, near]).all()
        assert np.isfinite(elastic[:, between(900, 3000)]).all()


def test_the_background_follows_the_method_of_the_campaign() -> None:
    dim = archive(count_rate(distance, constant=4e12), profiles=20)
    backgrounds = {}
    for method in ("known_shape", "tail_mean"):
        products = {"elastic": {**ELASTIC, "background": method}}
        backgrounds[method] = float(carry_out(products, dim)["elastic"]["background"][0])
    tail_signal = count_rate(distance)[-120:].mean()
    assert backgrounds["known_shape"] == pytest.approx(SKY, abs=0.2 * tail_signal)
    assert backgrounds["tail_mean"] == pytest.approx(SKY + tail_signal, abs=0.2 * tail_signal)


def test_a_chunk_holds_the_channel_that_is_processed_and_leaves_the_source_lazy() -> None:
    lazy = archive(profiles=3)
    source = Source(lazy, None, NONE, STATION)
    (chunk,) = chunks(source, ["photon_532o"], (), 7)
    assert isinstance(chunk.counts["photon_532o"].data, np.ndarray)
    assert "analog_532o" not in chunk.counts
    assert isinstance(lazy["photon_532o"].data, da.Array)
    (glued,) = chunks(source, ["analog_532o", "photon_532o"], (), 7)
    assert {"photon_532o", "analog_532o"} <= set(glued.counts)


class _Ends(ProductStream):
    """A product that allows a chunk to end before some rows only."""

    def __init__(self, *rows: int) -> None:
        self._rows = np.array(rows)

    def ends(self) -> np.ndarray:
        return self._rows

    def add(self, chunk: Chunk) -> tuple[()]:
        """Take nothing."""
        return ()


@each(
    ("streams", "profiles", "edges"),
    [
        ((), 7, [7, 14, 20]),
        ((), 50, [20]),
        ((_Ends(3, 6, 9, 12),), 7, [6, 12, 20]),
        ((_Ends(3, 6, 9, 12),), 1, [3, 6, 9, 12, 20]),
        ((_Ends(3, 6, 9, 12), _Ends(2, 6, 10)), 1, [6, 20]),
        ((_Ends(3), _Ends(2)), 1, [20]),
    ],
)
def test_chunks_end_where_all_products_allow_it(
    streams: tuple[ProductStream, ...], profiles: int, edges: list[int]
) -> None:
    source = Source(archive(), None, NONE, STATION)
    made = list(chunks(source, ["photon_532o"], streams, profiles))
    assert [chunk.rows.stop for chunk in made] == edges
    assert [chunk.rows.start for chunk in made] == [0, *edges[:-1]]
