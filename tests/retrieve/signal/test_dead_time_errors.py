"""Photon counting with a dead time that is off: unflagged signals hold their stated errors."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.products.signal.variables import FLAGS
from lidarops.retrieve.signal.labeled import condition, correct_for_range
from lidarops.retrieve.signal.labeled_averaging import ClockAverage, IntervalSums
from lidarops.retrieve.signal.labeled_gluing import glue
from lidarops.simulate.counting import count_photons, release

BIN_WIDTH = 7.5
RANGE = BIN_WIDTH * (np.arange(2000) + 0.5)
SHOTS = 20_000
DEAD_TIME = 4e-9
PROFILES = 20
TAIL = (13_500.0, 15_000.0)
SEEN = TAIL[0] > RANGE


def light(constant):
    """Return the count rate of hazy air without sky, MHz; the same nearer than 300 m."""
    r = np.maximum(RANGE, 300.0)
    return constant * np.exp(-r / 1500.0) / (r + 60.0) ** 2


def archive(rate, dead_time, *, paralyzable=False, seed=1):
    """Return raw counts of a photon-counting and an analog recorder of the same light."""
    rng = np.random.default_rng(seed)
    released = release(rate, shots=SHOTS, bin_width=BIN_WIDTH, random=None)
    counter = {"dead_time": dead_time, "paralyzable": paralyzable, "random": rng}
    photon = np.stack([count_photons(released, **counter) for _ in range(PROFILES)])
    voltage = rate / 20.0 + 2.0 + 0.005 * rng.standard_normal(photon.shape)
    counts = {"photon": photon, "analog": np.rint(voltage * SHOTS * 4096 / 500.0)}
    attributes = {
        "photon": {"detection_mode": "photon", "bin_width": BIN_WIDTH},
        "analog": {"detection_mode": "analog", "bin_width": BIN_WIDTH, "adc_bits": 12},
    }
    shots = ("time", np.full(PROFILES, SHOTS, np.int32))
    return xr.Dataset(
        {k: (("time", "range"), v.astype(np.int32), attributes[k]) for k, v in counts.items()},
        coords={"range": RANGE, "time": np.arange(PROFILES).astype("datetime64[ns]")},
    ).assign(photon_shots=shots, analog_shots=shots, analog_input_range=("time", np.full(20, 0.5)))


def joined(data, **settings):
    settings = {"dead_time": DEAD_TIME} | settings
    return glue(condition(data, "analog"), condition(data, "photon", **settings))


def scores(result, truth):
    """Return errors over stated ones of signals before the tail, (time, range)."""
    stated = np.hypot(result["signal_standard_error"], result["signal_dead_time_error"])
    return ((result["signal"] - truth * RANGE**2) / stated).to_numpy()[:, SEEN]


def passes(result, rejected_only=False):
    flags = result["quality_flag"].to_numpy()[:, SEEN]
    return (flags & FLAGS.rejecting) == 0 if rejected_only else flags == 0


OFF = [(0.8, False), (1.2, False), (1.0, True)]
"""Dead time over the stated one, and whether the counter is paralyzable."""


@pytest.mark.parametrize(("share", "paralyzable"), OFF)
@pytest.mark.parametrize("sky", [0.2, 8.0])
def test_joined_channels_hold_their_errors_with_the_dead_time_off(sky, share, paralyzable):
    truth = light(2e7)
    data = archive(truth + sky, DEAD_TIME * share, paralyzable=paralyzable)
    glued = joined(data)
    result = correct_for_range(glued, TAIL)
    score, unflagged = scores(result, truth), passes(result)
    assert unflagged.mean() > 0.8
    near = RANGE[SEEN] < 2500.0
    for bins in (near, ~near):
        covered = np.abs(score[:, bins][unflagged[:, bins]]) < 1.96
        assert covered.mean() >= 0.93


@pytest.mark.parametrize(("share", "paralyzable"), OFF)
@pytest.mark.parametrize("sky", [0.2, 20.0, 60.0])
def test_photon_counting_holds_its_errors_with_the_dead_time_off(sky, share, paralyzable):
    truth = light(2e7)
    data = archive(truth + sky, DEAD_TIME * share, paralyzable=paralyzable)
    result = correct_for_range(condition(data, "photon", dead_time=DEAD_TIME), TAIL)
    accepted = passes(result, rejected_only=True)
    assert accepted.mean() > 0.5
    assert (np.abs(scores(result, truth)[accepted]) < 1.96).mean() > 0.93


def test_rates_are_rejected_beyond_the_stated_share_and_not_by_their_noise():
    result = []
    for uncertainty, measured in ((0.2, 75.0), (0.2, 65.0), (0.05, 75.0), (None, 22.0)):
        data = archive(np.full(RANGE.size, measured), 0.0)
        settings = {} if uncertainty is None else {"dead_time_uncertainty": uncertainty}
        dead_time = None if uncertainty is None else DEAD_TIME
        conditioned = condition(data, "photon", dead_time=dead_time, **settings)
        saturated = (conditioned["quality"].to_numpy() & np.int32(Quality.SATURATED)) != 0
        assert saturated.all() == saturated.any()
        result.append(bool(saturated.any()))
    # r sigma is 0.08 of the rate at x = 0.286, 71.4 MHz; at 0.615 for 5 %; at 18.5 MHz unknown.
    assert result == [True, False, False, True]
    # At the limit the bins of a steady tail are not chosen by their noise.
    data = archive(np.full(RANGE.size, 71.4), 0.0)
    conditioned = condition(data, "photon", dead_time=DEAD_TIME)
    kept = np.isfinite(conditioned["power"].to_numpy())
    rate = data["photon"].to_numpy() / (SHOTS * 0.05)
    assert 0.05 < kept.mean() < 0.95
    error = rate.std() / np.sqrt(kept.sum() / 100.0)
    assert abs(rate[kept].mean() - rate.mean()) < 0.15 * rate.std() + 4.0 * error


def test_the_error_of_the_dead_time_does_not_average_down():
    truth = light(2e7)
    data = archive(truth + 1.0, DEAD_TIME * 1.2)
    single = correct_for_range(joined(data), TAIL)
    conditioned = joined(data)
    times = data["time"].to_numpy()
    bounds = np.stack([times, times + np.timedelta64(1, "ns")], axis=-1)
    geometry = xr.Dataset(coords={"time": times, "time_bnds": (("time", "nv"), bounds)})
    parts = []
    for part in (
        condition(data, "analog"),
        condition(data, "photon", dead_time=DEAD_TIME),
    ):
        sums = IntervalSums(geometry, RANGE, seconds=600.0, shots=data["photon_shots"])
        means = ClockAverage([sums])
        means.add([part])
        ((whole,),) = means.completed()
        parts.append(whole)
    mean = correct_for_range(glue(*parts), TAIL)
    inside = (RANGE > 300.0) & (RANGE < 3000.0)
    assert conditioned.sizes["time"] == 20
    of_mean, of_single = (
        np.abs(x["signal_dead_time_error"].to_numpy()[:, inside]).mean() for x in (mean, single)
    )
    assert of_mean == pytest.approx(of_single, rel=0.1)
    assert (
        mean["signal_standard_error"].to_numpy()[:, inside].mean()
        < 0.4 * single["signal_standard_error"].to_numpy()[:, inside].mean()
    )


@pytest.mark.parametrize("uncertainty", [-0.1, 1.5, np.nan])
def test_an_impossible_uncertainty_is_refused(uncertainty):
    data = archive(np.full(RANGE.size, 1.0), 0.0)
    with pytest.raises(RetrievalInputError) as caught:
        condition(data, "photon", dead_time=DEAD_TIME, dead_time_uncertainty=uncertainty)
    assert caught.value.field == "dead_time_uncertainty"
