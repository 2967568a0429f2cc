"""Interpolation to common altitudes: against a known atmosphere, and its noise in simulations."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.multiangle import slant_paths
from lidarops.retrieve.multiangle._common_altitude import to_altitude

RANGE = 7.5 * np.arange(1, 1500)
ALTITUDE = np.arange(310.0, 2500.0, 30.0)
ANGLE = np.array([0.0, 20.0, 50.0, 75.0, 80.0])


def layer(height):
    return 0.08 * np.exp(-0.5 * ((height - 1500.0) / 50.0) ** 2) - height / 2000.0


def height_of(range_, angle):
    """Return the height at a range, from the triangle with the centre of the Earth."""
    slanted = range_ * np.cos(np.radians(angle))
    earth = slant_paths.EARTH_RADIUS
    sphere = np.sqrt(earth**2 + range_**2 + 2 * earth * slanted) - earth
    return slanted if angle <= slant_paths.SPHERICAL_BEYOND else sphere


def scan():
    return np.exp([layer(height_of(RANGE, angle)) for angle in ANGLE])


@pytest.mark.parametrize(("interpolation", "largest"), [("cubic", 3e-6), ("linear", 2e-4)])
def test_layer_is_reproduced(interpolation, largest):
    signal = scan()
    common = to_altitude(
        signal, RANGE, ANGLE, ALTITUDE, variance=1e-8 * signal**2, interpolation=interpolation
    )
    error = np.abs(np.log(common.signal) - layer(ALTITUDE))
    assert np.nanmax(error) < largest
    assert np.nanmax(error) > largest * 1e-3  # otherwise the bound would be too loose
    reached = RANGE[-1] >= slant_paths.slant_path(ANGLE, ALTITUDE) * ALTITUDE
    assert np.array_equal(np.isfinite(common.signal), reached)


@pytest.mark.parametrize("interpolation", ["cubic", "linear"])
@pytest.mark.parametrize("ratio", [3.0, 200.0])
def test_noise_is_propagated_without_bias(interpolation, ratio):
    rng = np.random.default_rng(11)
    mean = np.exp(-RANGE[:300] / 3000.0)
    signal = mean + mean / ratio * rng.normal(size=(8000, 1, 300))
    altitude = np.array([1001.0, 1003.75, 1499.0])
    common = to_altitude(
        signal,
        RANGE[:300],
        [0.0],
        altitude,
        variance=(mean / ratio) ** 2,
        interpolation=interpolation,
    )
    expected = np.exp(-altitude / 3000.0)
    scatter = common.signal[:, 0].std(axis=0)
    assert np.sqrt(common.variance[:, 0].mean(axis=0)) == pytest.approx(scatter, rel=0.04)
    bias = (common.signal[:, 0].mean(axis=0) - expected) / scatter
    assert np.all(np.abs(bias) < 4.5 / np.sqrt(8000))


def test_missing_bins_affect_their_neighbours_only():
    signal = scan()
    signal[0, 100] = np.nan
    altitude = RANGE[95:107] + 2.5
    common = to_altitude(signal, RANGE, ANGLE, altitude, variance=1e-8)
    missing = np.flatnonzero(np.isnan(common.signal[0]))
    assert (missing + 95).tolist() == [99, 100]
    on_the_bins = to_altitude(signal, RANGE, ANGLE, RANGE[95:107], variance=1e-8)
    assert (np.flatnonzero(np.isnan(on_the_bins.signal[0])) + 95).tolist() == [100]
    assert on_the_bins.signal[0, 0] == pytest.approx(signal[0, 95], rel=1e-14)


def test_noise_around_zero_is_kept():
    signal = np.where(np.arange(RANGE.size) % 2, -1.0, 3.0)[np.newaxis]
    common = to_altitude(signal, RANGE, [0.0], [1001.25], variance=100.0, interpolation="linear")
    assert common.signal[0, 0] == pytest.approx(1.0, rel=1e-9)
    assert common.variance[0, 0] == pytest.approx(50.0, rel=1e-9)


def test_accepts_other_array_types_and_shapes():
    signal = scan()
    plain = to_altitude(signal, RANGE, ANGLE, ALTITUDE, variance=1e-6)
    several = to_altitude(
        np.stack([signal, signal]).astype(">f8"),
        np.broadcast_to(RANGE, signal.shape),
        ANGLE,
        ALTITUDE + 50.0,
        variance=np.float32(1e-6),
        station_altitude=50.0,
    )
    assert several.signal[1] == pytest.approx(plain.signal, nan_ok=True, rel=1e-9)
    empty = to_altitude(np.full_like(signal, np.nan), RANGE, ANGLE, ALTITUDE, variance=1.0)
    assert np.all(np.isnan(empty.signal))
    beyond = to_altitude(signal, RANGE, [0.0, 20.0, 50.0, 75.0, 89.0], ALTITUDE, variance=1.0)
    assert np.all(np.isnan(beyond.signal[-1]))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"signal": np.ones((4, RANGE.size))}, "signal"),
        ({"range": RANGE[:-1]}, "range"),
        ({"range": RANGE[::-1]}, "range"),
        ({"range": np.ones((2, RANGE.size))}, "range"),
        ({"variance": -1.0}, "variance"),
        ({"variance": np.ones(3)}, "variance"),
        ({"interpolation": "spline"}, "interpolation"),
        ({"altitude": [-10.0, 5.0]}, "altitude"),
        ({"station_altitude": np.nan}, "station_altitude"),
    ],
)
def test_invalid_arguments_are_refused(change, field):
    arguments = {
        "signal": scan(),
        "range": RANGE,
        "zenith_angle": ANGLE,
        "altitude": ALTITUDE,
        "variance": 1e-6,
    }
    with pytest.raises(RetrievalInputError, match=field):
        to_altitude(**{**arguments, **change})
