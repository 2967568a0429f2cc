"""What a campaign file may say of its simulation."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from pydantic import ValidationError

from lidarops.simulate.settings import (
    Acquisition,
    AnalogRecorder,
    Background,
    DamageKind,
    Detector,
    DiurnalCourse,
    HorizontalPath,
    Layer,
    SimulationSettings,
)


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
    ("change", "said"),
    [
        (lambda t: t["simulation"].update(seed=-1), "seed"),
        (lambda t: t["simulation"].update(colour="red"), "colour"),
        (lambda t: t["simulation"].update(duration=30), "no file fits"),
        (lambda t: t["simulation"].update(duration=float("inf")), "duration"),
        (lambda t: t["simulation"].update(start="2024-01-01T00:00:00.5Z"), "whole second"),
        (lambda t: _coast(t).update(kind="diagonal"), "diagonal"),
        (lambda t: _coast(t).update(detectors=[]), "detectors"),
        (lambda t: _coast(t)["acquisition"].update(shots=601), "whole seconds"),
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
        (lambda t: _coast(t)["aerosol_extinction"].update(maximum=200), "per km"),
        (lambda t: _coast(t)["detectors"][0].update(signal_rate=float("nan")), "signal_rate"),
        (lambda t: _coast(t)["detectors"].append(_coast(t)["detectors"][0]), "share wavelength"),
        (
            lambda t: _coast(t)["detectors"].append(
                {**_coast(t)["detectors"][0], "wavelength": 355}
            ),
            "one wavelength",
        ),
    ],
)
def test_a_campaign_that_cannot_be_simulated_is_told(small, change, said):
    with pytest.raises(ValidationError, match=said):
        small(change)


def test_models_refuse_what_physics_refuses():
    with pytest.raises(ValidationError, match="half a digitiser step"):
        AnalogRecorder(gain=0.1, noise=0.01, dark_offset=3.0, adc_range=500)
    with pytest.raises(ValidationError, match="clip noise at zero"):
        AnalogRecorder(gain=0.1, noise=0.5, dark_offset=1.0)
    with pytest.raises(ValidationError, match="darker than night"):
        Background(night=2.0, day=1.0)
    with pytest.raises(ValidationError, match="less than minimum"):
        DiurnalCourse(minimum=2.0, maximum=1.0)
    with pytest.raises(ValidationError, match="nobody reads it"):
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
    assert isinstance(settings.instruments["coast-lidar"], HorizontalPath)
    assert Acquisition(shots=1200, repetition_rate=20).duration == 60


def test_only_the_missing_newline_is_harmless():
    assert {kind for kind in DamageKind if not kind.refused} == {DamageKind.NO_FINAL_NEWLINE}
