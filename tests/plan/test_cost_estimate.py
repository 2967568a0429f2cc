"""Estimates of run times: amounts of a plan, costs of a machine, sums of a run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import factories

from lidarops.errors import CatalogError
from lidarops.kinds import kinds
from lidarops.plan import cost_estimate
from lidarops.plan.cost_estimate import (
    Costs,
    Tally,
    Term,
    amounts,
    default_costs,
    figure_term,
    load_term,
    value_term,
)
from lidarops.plan.scene_plan import plan_scene
from lidarops.plan.scenes import cut_scenes
from lidarops.records import ChannelLayout, Plan, Role, Scene
from lidarops.reports import gallery

SECTIONS = {"channels": ["photon_532o"], "sections": [[750, 4500]]}
LEVEL = {"homogeneous": SECTIONS}
DEFAULTS = default_costs()
UNITS = dict.fromkeys(DEFAULTS, 1.0)


def planned(
    count: int = 10, *, products: dict[str, Any] | None = None, dark: int = 0, **changes: Any
) -> tuple[Scene, Plan]:
    granules = [factories.granule(5.0 * k, **changes) for k in range(count)]
    granules += [
        factories.granule(-30.0 - k, path=f"dark/{k}", role=Role.DARK) for k in range(dark)
    ]
    campaign = factories.campaign(products=LEVEL if products is None else products)
    scene = cut_scenes(campaign, granules).scenes[0]
    return scene, plan_scene(scene, campaign)


def of(**changes: Any) -> dict[str, float]:
    return amounts(*planned(**changes))


# Amounts --------------------------------------------------------------------------------------


def test_amounts_of_sections():
    counts = of(count=10)
    (window,) = (s for s in planned()[1].steps if s.name == "range_window")
    assert counts[Term.FILE] == 10
    assert counts[Term.DIGEST] == 10 * 1000
    assert counts[Term.CHANNEL] == counts["homogeneous"] == counts[Term.LOOK] == 1
    assert counts[Term.VALUE] == 10 * window.number
    assert counts[value_term("homogeneous")] == 10 * (4500 - 750) / 7.5
    assert "signal" not in counts


def test_known_digests_cost_nothing():
    assert Term.DIGEST not in of(sha256="0" * 64)
    scene, made = planned(sha256="0" * 64)
    assert amounts(scene, made, whole=True)[Term.DIGEST] == 10 * 1000


def test_sections_beside_a_product_of_all_bins_read_all_of_them():
    signal = {"signal": {"channels": ["photon_532o"]}}
    assert of(products={**signal, **LEVEL})[Term.VALUE] == of(products=signal)[Term.VALUE]
    assert of(products=LEVEL)[Term.VALUE] < of(products=signal)[Term.VALUE]


def test_dark_files_cost_where_they_are_subtracted():
    analog = {"signal": {"channels": ["analog_532o"]}}
    photon = {"signal": {"channels": ["photon_532o"]}}
    assert of(products=analog, dark=3)[Term.FILE] == 13
    assert of(products=analog, dark=3)[Term.DARK] == 1
    assert of(products=photon, dark=3)[Term.FILE] == 10


def test_a_glued_channel_reads_both_parts():
    up = {"zenith_angle": 0.0}
    joined = of(products={"elastic": {"channels": ["glued_532o"]}}, **up)
    alone = of(products={"elastic": {"channels": ["photon_532o"]}}, **up)
    assert joined[Term.VALUE] == 2 * alone[Term.VALUE] == 10 * 2 * 2000
    # Ten profiles, 5 min apart, in two averages of 30 min.
    assert joined[value_term("elastic")] == alone[value_term("elastic")] == 2 * 2000


def test_nothing_to_do_costs_nothing():
    assert of(products={}) == {}


@given(st.integers(1, 60), st.integers(1, 60), st.sampled_from([1000, 2000, 4000]))
def test_more_profiles_and_bins_never_cost_less(few, more, bins):
    layout = tuple(replace(channel, bins=bins) for channel in (factories.PHOTON, factories.ANALOG))
    wider: tuple[ChannelLayout, ...] = tuple(replace(channel, bins=2 * bins) for channel in layout)
    model = Costs(DEFAULTS)
    products = {"signal": {}, **LEVEL}
    one = model.of(of(count=few, products=products, layout=layout))
    assert model.of(of(count=few + more, products=products, layout=layout)) > one
    assert model.of(of(count=few, products=products, layout=wider)) > one


# Sums -----------------------------------------------------------------------------------------


def test_a_run_adds_what_it_costs_once():
    tally = Tally(Costs(UNITS))
    assert tally.parts == {"scenes": 0.0, "start": 0.0, "report": 0.0, "all": 0.0}
    first = tally.add(*planned(count=3))
    tally.add(*planned(count=3))
    assert tally.scenes == 2 * first
    # The process, what any scene loads, what homogeneous sections load.
    assert tally.start == 3
    # The page and the figures of one channel, though of two scenes.
    assert tally.report == 2
    assert tally.total == pytest.approx(2 * first + 5)
    tally.add(*planned(products={}))
    assert tally.count == 2


def test_figures_are_limited_as_those_of_reports():
    assert cost_estimate.MOST_FIGURES == gallery.FIGURES


# Calibrations ---------------------------------------------------------------------------------


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return cost_estimate.calibration_path()


def test_a_calibration_is_read_as_written(cache: Path):
    seconds = {term: 0.1 * number for number, term in enumerate(DEFAULTS)}
    kept = cost_estimate.save_calibration(
        Costs(seconds, processor=cost_estimate.processor(), date="2026-01-02")
    )
    assert kept == cache
    calibration = cost_estimate.load_calibration()
    assert calibration.seconds == seconds
    assert calibration.words == "calibrated on this machine on 2026-01-02"
    assert [path.name for path in cache.parent.iterdir()] == [cache.name]


def test_the_note_states_a_missing_calibration(cache: Path):
    calibration = cost_estimate.load_calibration()
    assert calibration.seconds == DEFAULTS
    assert calibration.words.startswith("not calibrated on this machine")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"processor": "abacus"}, "another processor, abacus"),
        ({"format": "letter"}, "not a calibration"),
        ({"seconds": {}}, "run"),
        ({"seconds": dict.fromkeys(DEFAULTS, -1.0)}, "not a finite, non-negative time"),
        ({"seconds": dict.fromkeys(DEFAULTS, "soon")}, "soon"),
    ],
)
def test_an_invalid_calibration_is_reported_and_not_used(cache: Path, change: Any, message: str):
    cost_estimate.save_calibration(
        Costs(DEFAULTS, processor=cost_estimate.processor(), date="2026-01-02")
    )
    cache.write_text(json.dumps({**json.loads(cache.read_text()), **change}))
    calibration = cost_estimate.load_calibration()
    assert calibration.seconds == DEFAULTS
    assert "not calibrated" in calibration.note
    assert message in calibration.note


@pytest.fixture
def homeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A container that runs as a user that its system does not know."""

    def unknown(*_: object) -> None:
        raise KeyError("getpwuid(): uid not found")

    for name in ("XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", unknown)


@pytest.mark.usefixtures("homeless")
def test_without_a_home_there_is_no_calibration():
    calibration = cost_estimate.load_calibration()
    assert calibration.seconds == DEFAULTS
    assert "XDG_CACHE_HOME" in calibration.words
    with pytest.raises(CatalogError, match="XDG_CACHE_HOME"):
        cost_estimate.save_calibration(Costs(DEFAULTS))


def test_all_terms_have_defaults():
    assert set(Term) < set(DEFAULTS)
    for kind in kinds():
        assert {kind, value_term(kind), load_term(kind), figure_term(kind)} <= set(DEFAULTS)
    loads = {load_term(kind) for kind in kinds()}
    assert all(seconds > 0 for term, seconds in DEFAULTS.items() if term not in loads)
