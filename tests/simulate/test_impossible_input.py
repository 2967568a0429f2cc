"""The simulator refuses impossible input instead of returning wrong numbers."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import numpy as np
import pytest
from pydantic import ValidationError

from lidarops.campaign.simulated_air import AtmosphereSettings
from lidarops.campaign.simulated_instrument import AnalogRecorder
from lidarops.campaign.simulation import SimulationSettings
from lidarops.retrieve.air.molecular import us_standard
from lidarops.simulate import analog
from lidarops.simulate.atmosphere import Air, solar_elevation
from lidarops.simulate.campaign import simulate_campaign
from lidarops.simulate.counting import count_photons, counter_moments, release
from lidarops.simulate.signal import SimulationInputError, backscatter_signal, bin_centres

BIN_WIDTH = 7.5
BIN_TIME = 50e-9
RECORDER = AnalogRecorder(gain=0.1, noise=0.3, dark_offset=3.0)


def count(rate, shots=600):
    light = release(np.asarray(rate, np.float64), shots=shots, bin_width=BIN_WIDTH, random=None)
    return count_photons(light, dead_time=4e-9, random=np.random.Generator(np.random.Philox(1)))


def digitise(rate, shots=600):
    light = release(np.asarray(rate, np.float64), shots=shots, bin_width=BIN_WIDTH, random=None)
    return analog.digitise(light, RECORDER, random=np.random.Generator(np.random.Philox(1)))


@pytest.mark.parametrize("record", [count, digitise])
@pytest.mark.parametrize("rate", [[1.0, np.nan], [1.0, -1.0]])
def test_impossible_rates_are_refused(record, rate):
    with pytest.raises(SimulationInputError, match="rate"):
        record(rate)


@pytest.mark.parametrize("record", [count, digitise])
def test_negative_shots_are_refused(record):
    with pytest.raises(SimulationInputError, match="shots"):
        record([1.0], shots=-5)


@pytest.mark.parametrize("record", [count, digitise])
def test_counts_never_wrap(record):
    # 2**31 shots of the strongest light: the sum does not fit into the word of a Licel file.
    with pytest.raises(SimulationInputError, match="32 bits"):
        record([250.0], shots=2**31)
    assert record([250.0], shots=600).min() > 0


def test_moments_of_an_impossible_rate_are_refused():
    with pytest.raises(SimulationInputError, match="rate"):
        counter_moments(np.array([np.nan]), dead_time=4e-9, bin_time=BIN_TIME)


def test_a_time_without_zone_is_refused():
    with pytest.raises(SimulationInputError, match="time zone"):
        solar_elevation(datetime(2024, 6, 21, 12), 49.0, 36.0)  # noqa: DTZ001
    assert solar_elevation(datetime(2024, 6, 21, 9, 36, tzinfo=UTC), 49.0, 36.0) > 60.0
    with pytest.raises(SimulationInputError, match="latitude"):
        solar_elevation(datetime(2024, 6, 21, tzinfo=UTC), 149.0, 36.0)


def test_impossible_ranges_are_refused():
    with pytest.raises(SimulationInputError, match="bin_width"):
        bin_centres(10, -7.5)
    r = bin_centres(10, 7.5)
    with pytest.raises(SimulationInputError, match="distance"):
        backscatter_signal(r[::-1], extinction=r * 0, backscatter=r * 0, system_constant=1.0)


def test_air_above_a_sounding_follows_the_standard_atmosphere():
    levels = np.array([0.0, 3000.0, 12_000.0])
    pressure, temperature = us_standard(levels)
    settings = AtmosphereSettings.model_validate(
        {
            "sounding": {
                "altitude": levels.tolist(),
                "pressure": (0.98 * pressure).tolist(),
                "temperature": temperature.tolist(),
            }
        }
    )
    start = datetime(2024, 6, 21, tzinfo=UTC)
    air = Air(settings, altitude=0.0, start=start, seed=1)
    clear = Air(AtmosphereSettings(), altitude=0.0, start=start, seed=1)
    high = np.array([12_000.0, 20_000.0, 30_000.0, 83_000.0])
    ratio = air.molecules(high, 532e-9) / clear.molecules(high, 532e-9)
    np.testing.assert_allclose(ratio, 0.98, rtol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ({"bin_width": 7.5}, {"bin_width": 7.49481145}, "four characters"),
        ({"adc_range": 500}, {"adc_range": 1e-5}, "adc_range"),
        ({"start": "2024-06-21"}, {"start": "9999-12-31"}, "age of lasers"),
    ],
)
def test_values_that_do_not_fit_a_raw_file_are_refused(old, new, message):
    settings = {
        "seed": 1,
        "start": "2024-06-21T00:00:00Z",
        "duration": 600,
        "instruments": {
            "lidar": {
                "atmosphere": {},
                "acquisition": {"bin_width": 7.5},
                "detectors": [
                    {
                        "wavelength": 532,
                        "signal_rate": 20,
                        "background": {"night": 0.02, "day": 10},
                        "analog": {"gain": 0.05, "noise": 0.3, "dark_offset": 3, "adc_range": 500},
                    }
                ],
            }
        },
    }
    SimulationSettings.model_validate(settings)
    text = json.dumps(settings)
    (key, good), (_, bad) = *old.items(), *new.items()
    good_text, bad_text = (json.dumps(value).strip('"') for value in (good, bad))
    changed = text.replace(f'"{key}": {good_text}', f'"{key}": {bad_text}')
    changed = changed.replace(f'"{key}": "{good_text}', f'"{key}": "{bad_text}')
    assert changed != text
    with pytest.raises(ValidationError, match=message):
        SimulationSettings.model_validate(json.loads(changed))


def test_an_archive_that_cannot_be_created_is_named(tmp_path, small):
    (tmp_path / "raw").write_text("a file")
    with pytest.raises(NotADirectoryError, match="raw/deeper"):
        simulate_campaign(small(archive="raw/deeper"))
