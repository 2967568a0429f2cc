"""Simulation settings: valid ones, and those that are refused."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from pydantic import ValidationError

from lidarops.campaign.simulated_air import DiurnalCourse, Layer
from lidarops.campaign.simulated_instrument import (
    Acquisition,
    AnalogRecorder,
    Background,
    DamageKind,
    Detector,
    Handling,
    PhotonCounter,
    Pointing,
)
from lidarops.campaign.simulation import SimulationSettings


def _coast(tree):
    return tree["simulation"]["instruments"]["coast-lidar"]


def test_the_small_campaign_counts_its_files(small):
    settings = small().simulation
    # Files that end in time: the last one starts 60 s before the end.
    assert settings.files("coast-lidar") == 20
    assert settings.files("hill-lidar") == 4
    assert settings.start_of("coast-lidar", 19) == datetime(2025, 1, 1, 0, 9, tzinfo=UTC)
    dark = [settings.start_of_dark("coast-lidar", index) for index in range(3)]
    assert dark == [
        datetime(2024, 12, 31, 23, 48, tzinfo=UTC),
        datetime(2024, 12, 31, 23, 49, tzinfo=UTC),
        datetime(2025, 1, 1, 0, 10, tzinfo=UTC),
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["simulation"].update(seed=-1), "seed"),
        (lambda t: t["simulation"].update(colour="red"), "colour"),
        (lambda t: t["simulation"].update(duration=30), "no file fits"),
        (lambda t: t["simulation"].update(duration=float("inf")), "duration"),
        (lambda t: t["simulation"].update(start="2024-01-01T00:00:00.5Z"), "whole second"),
        (lambda t: _coast(t).update(detectors=[]), "detectors"),
        (lambda t: _coast(t)["acquisition"].update(shots=605), "whole seconds"),
        (lambda t: _coast(t)["acquisition"].update(repetition_rate=7.5), "whole"),
        (lambda t: _coast(t)["acquisition"].update(interval=30), "longer than the interval"),
        (lambda t: _coast(t).update(damage=[{"kind": "bent", "index": 0}]), "truncated"),
        (lambda t: _coast(t).update(damage=[{"kind": "empty", "index": 20}]), "0 to 19"),
        (
            lambda t: _coast(t).update(
                damage=[{"kind": "empty", "index": 2}, {"kind": "garbage", "index": 2}]
            ),
            "one way only",
        ),
        (
            lambda t: _coast(t)["acquisition"].update(shots=600_000, repetition_rate=10_000),
            "32 bits",
        ),
        (
            lambda t: _coast(t)["atmosphere"]["homogeneous"]["extinction"].update(maximum=200),
            "km-1",
        ),
        (lambda t: _coast(t)["detectors"][0].update(signal_rate=float("nan")), "signal_rate"),
        (lambda t: _coast(t)["detectors"].append(_coast(t)["detectors"][0]), "share wavelength"),
    ],
)
def test_a_campaign_that_cannot_be_simulated_is_refused(small, change, message):
    with pytest.raises(ValidationError, match=message):
        small(change)


def test_impossible_settings_are_refused():
    with pytest.raises(ValidationError, match="digitiser steps"):
        AnalogRecorder(gain=0.1, noise=0.001, dark_offset=3.0, adc_range=500)
    with pytest.raises(ValidationError, match="clip noise at zero"):
        AnalogRecorder(gain=0.1, noise=0.5, dark_offset=1.0)
    with pytest.raises(ValidationError, match="day must be at least night"):
        Background(night=2.0, day=1.0)
    with pytest.raises(ValidationError, match="less than minimum"):
        DiurnalCourse(minimum=2.0, maximum=1.0)
    with pytest.raises(ValidationError, match="has no output"):
        Detector(wavelength=532, signal_rate=1, background=Background(night=0, day=1))
    with pytest.raises(ValidationError, match="later than start"):
        Layer(
            name="x", extinction=1e-4, height=1e3, depth=1e2,
            start="2024-01-02T00:00:00", stop="2024-01-01T00:00:00",
        )  # fmt: skip


def test_a_detector_may_be_read_in_one_way_only(small):
    settings = small(lambda t: _coast(t)["detectors"][0].pop("analog")).simulation
    assert settings.instruments["coast-lidar"].detectors[0].analog is None


def test_settings_are_frozen(small):
    settings = small().simulation
    with pytest.raises(ValidationError, match="frozen"):
        settings.seed = 3
    assert isinstance(settings, SimulationSettings)
    assert Acquisition(shots=1200, repetition_rate=20).duration == 60


def _as_lidar(tree, **keys):
    """Give the coast lidar another atmosphere, or none of its own."""
    coast = _coast(tree)
    del coast["atmosphere"]
    coast.update(keys)


_LEVEL = {"homogeneous": {"extinction": {"minimum": 1e-4, "maximum": 1e-4}}}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "has no atmosphere"),
        ({"atmosphere": {"haze": {}}}, "haze"),
        ({"atmosphere": {"boundary_layer": {"extinction": -1e-4}}}, "extinction"),
        ({"atmosphere": {"boundary_layer": {"aerosol": {"lidar_ratio": 0}}}}, "lidar_ratio"),
        (
            {"atmosphere": {"homogeneous": {"extinction": {"minimum": 1, "maximum": 100}}}},
            "0.1 km-1",
        ),
        (
            {
                "atmosphere": {
                    "clouds": [
                        {
                            "extinction": 0.01,
                            "base": 3000,
                            "top": 2000,
                            "start": "2025-01-01",
                            "stop": "2025-01-02",
                        }
                    ]
                }
            },
            "higher than base",
        ),
        ({"atmosphere": {"gradients": [{"extinction": 1e-4, "scale": 0}]}}, "scale"),
        (
            {
                "atmosphere": {
                    "plumes": [{"extinction": 1e-4, "horizontal_depth": -1, "vertical_depth": 1}]
                }
            },
            "horizontal_depth",
        ),
        (
            {
                "atmosphere": {
                    "turbulence": {"deviation": 0.1, "horizontal_length": 0, "vertical_length": 10}
                }
            },
            "horizontal_length",
        ),
        (
            {"atmosphere": {"profiles": [{"height": [0, 100, 50], "extinction": [0, 0, 0]}]}},
            "must ascend",
        ),
        (
            {"atmosphere": {"profiles": [{"height": [0, 100], "extinction": [1e-4] * 3}]}},
            "equal numbers",
        ),
        (
            {
                "atmosphere": {
                    "sounding": {
                        "altitude": [0, 1000],
                        "pressure": [1013, 900],
                        "temperature": [15, 10],
                    }
                }
            },
            "in K",
        ),
        (
            {
                "atmosphere": {
                    "sounding": {
                        "altitude": [0, 1000],
                        "pressure": [1e6, 9e4],
                        "temperature": [288, 280],
                    }
                }
            },
            "in Pa",
        ),
        ({"atmosphere": _LEVEL, "scan": {"zenith_angles": []}}, "zenith_angles"),
        ({"atmosphere": _LEVEL, "scan": {"zenith_angles": [95.55]}}, "one decimal"),
        ({"atmosphere": _LEVEL, "scan": {"zenith_angles": [200]}}, "zenith_angles"),
        ({"atmosphere": _LEVEL, "scan": {"zenith_angles": [5, 5]}}, "twice"),
        ({"atmosphere": _LEVEL, "scan": {"zenith_angles": [5], "azimuth": 360}}, "azimuth"),
        ({"atmosphere": _LEVEL, "pulse": {"width": 10.0}}, "pulse"),
        ({"atmosphere": _LEVEL, "pulse": {"width": 5e-6}}, "seconds"),
        ({"atmosphere": _LEVEL, "laser": {"jitter": 2}}, "jitter"),
    ],
)
def test_impossible_air_and_pointing_are_refused(small, keys, message):
    with pytest.raises(ValidationError, match=message):
        small(lambda tree: _as_lidar(tree, **keys))
    # The same lidar with possible air is accepted.
    assert small(lambda tree: _as_lidar(tree, atmosphere=_LEVEL)).simulation


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dialect": "martian"}, "dialect"),
        ({"gaps": [{"start": "2025-01-02", "stop": "2025-01-01"}]}, "later than start"),
        (
            {"clock": [{"at": "2025-01-02", "offset": 1}, {"at": "2025-01-01", "offset": 0}]},
            "must ascend",
        ),
        ({"clock": [{"at": "2025-01-02", "offset": 1e6}]}, "offset"),
        ({"changes": [{"at": "2025-01-01", "shots": 605}]}, "whole seconds"),
        ({"changes": [{"at": "2025-01-01", "shots": 90_000}]}, "longer than the interval"),
        ({"bins": 4}, "bins"),
        ({"bin_width": 0}, "bin_width"),
    ],
)
def test_impossible_acquisitions_are_refused(small, change, message):
    with pytest.raises(ValidationError, match=message):
        small(lambda tree: _coast(tree)["acquisition"].update(change))


def test_damage_needs_what_it_damages(small):
    def blind(tree, kind):
        del _coast(tree)["detectors"][0]["analog"]
        _coast(tree)["damage"] = [{"kind": kind, "index": 0}]

    with pytest.raises(ValidationError, match="'analog'"):
        small(lambda tree: blind(tree, "glitch"))
    assert small(lambda tree: blind(tree, "dead_photon")).simulation


def test_the_first_shot_may_fall_on_the_start():
    # As real instruments count: 101 shots at 10 Hz in 10 s.
    assert Acquisition(shots=101, repetition_rate=10).duration == 10
    assert Acquisition(shots=100, repetition_rate=10).duration == 10


def test_optics_give_the_strength_of_the_signal():
    def detector(**keys):
        return Detector(
            wavelength=532, background=Background(night=0, day=1),
            photon=PhotonCounter(), **keys,
        )  # fmt: skip

    optics = {"energy": 20e-3, "area": 0.03, "efficiency": 0.01}
    # 20 mJ of 532 nm are 5.356e16 photons, and 150 m of air return in a microsecond.
    photons = 20e-3 / (6.62607015e-34 * 299792458.0 / 532e-9)
    expected = photons * 0.01 * 0.03 / 1e3**2 * 1e-6 * 149.896229
    assert detector(optics=optics).strength == pytest.approx(expected, rel=1e-12)
    assert detector(optics=optics).system_constant == pytest.approx(expected * 1e12, rel=1e-12)
    for keys in ({}, {"optics": optics, "signal_rate": 1.0}):
        with pytest.raises(ValidationError, match="either signal_rate or optics"):
            detector(**keys)
    with pytest.raises(ValidationError, match="area"):
        detector(optics=optics | {"area": 0})


def test_a_two_sided_scan_crosses_the_zenith_once():
    scan = Pointing(zenith_angles=[0, 30, 60], azimuth=200, two_sided=True)
    assert scan.cycle() == ((60, 20), (30, 20), (0, 200), (30, 200), (60, 200))
    assert Pointing(zenith_angles=[80, 10]).cycle() == ((80, 0), (10, 0))


def test_every_kind_of_damage_has_a_handling():
    by_handling = dict.fromkeys(Handling, 0)
    for kind in DamageKind:
        by_handling[kind.handling] += 1
    assert by_handling == {
        Handling.KEEP: 9,
        Handling.FLAG: 5,
        Handling.SET_ASIDE: 1,
        Handling.REFUSE: 9,
    }
