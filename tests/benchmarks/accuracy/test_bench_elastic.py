"""The elastic benchmark: signals, bounds, scores, peers and pages."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from typer.testing import CliRunner

from benchmarks.__main__ import BENCHMARKS, app, measure
from benchmarks.accuracy import elastic
from benchmarks.accuracy.elastic import background_score, inversion_score
from benchmarks.harness.results import Effort
from benchmarks.scenes import elastic_skies
from lidarops.errors import CampaignError
from lidarops.retrieve.air.molecular import MolecularProfile

pytestmark = pytest.mark.slow

DRAWS = 60


@pytest.fixture(scope="module")
def sky():
    return elastic_skies.simulated_sky()


@pytest.fixture(scope="module")
def accuracy(request):
    """Return the accuracy benchmark, with the published files where they are."""
    try:
        folder = request.getfixturevalue("data_root") / "synthetic" / "boeckmann"
    except pytest.skip.Exception:
        folder = None
    effort = Effort(quick=True)
    return elastic.measure_elastic_accuracy(replace(effort, data=folder), draws=DRAWS)


# Signals --------------------------------------------------------------------------------------


def test_the_signal_obeys_the_lidar_equation(sky):
    """Two bins differ by backscatter, range and an optical depth that scipy integrates."""
    air = MolecularProfile.us_standard()
    near, far = 60, 700

    def extinction(z):
        loss = elastic_skies.LIDAR_RATIO * float(elastic_skies.particles(z))
        return loss + float(air.extinction(z, elastic_skies.WAVELENGTH))

    bends = [1750.0, 3900.0, 5700.0, 6000.0]
    depth = quad(extinction, sky.range[near], sky.range[far], points=bends, epsrel=1e-9)[0]
    total = sky.backscatter + sky.air.backscatter(sky.range, elastic_skies.WAVELENGTH)
    expected = total[far] / total[near] * (sky.range[near] / sky.range[far]) ** 2
    ratio = sky.signal[far] / sky.signal[near]
    assert ratio == pytest.approx(expected * math.exp(-2.0 * depth), rel=1e-4)


def test_the_set_is_like_the_intercomparison(sky):
    assert sky.signal.max() == pytest.approx(elastic_skies.BRIGHTEST)
    clean = sky.range >= elastic_skies.CLEAN_FROM
    assert not np.any(sky.backscatter[clean])
    assert np.all(sky.backscatter[sky.range < 2000.0] > 1e-6)
    depth = elastic_skies.LIDAR_RATIO * np.sum(sky.backscatter) * 15.0
    assert depth == pytest.approx(1.4, abs=0.05)
    assert sky.signal[-1] == pytest.approx(2.15, rel=0.8)


def test_counts_are_means_of_poisson_counts_and_repeat(sky):
    level, draws = 50.0, 4000
    counts = sky.counts(level, draws, 3)
    assert np.array_equal(counts, sky.counts(level, draws, 3))
    assert not np.array_equal(counts[:5], sky.counts(level, 5, 4))
    assert np.allclose(counts * elastic_skies.SHOTS, np.round(counts * elastic_skies.SHOTS))
    mean = sky.signal + level
    error = np.sqrt(mean / elastic_skies.SHOTS / draws)
    deviation = (counts.mean(axis=0) - mean) / error
    assert np.std(deviation) == pytest.approx(1.0, abs=0.1)
    spread = counts.var(axis=0) / (mean / elastic_skies.SHOTS)
    assert spread.mean() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("level", [1.0, 1e4, 1e8])
def test_the_bound_is_that_of_a_weighted_straight_line(sky, level):
    """The bound is the textbook variance of an intercept, and the scatter of fits above 6 km."""
    far = sky.range >= elastic_skies.CLEAN_FROM
    x, w = sky.shape[far] * 1e15, elastic_skies.SHOTS / (sky.signal[far] + level)
    determinant = w.sum() * (w * x * x).sum() - (w * x).sum() ** 2
    bound = elastic_skies.least_error(sky, level)
    assert bound == pytest.approx(math.sqrt((w * x * x).sum() / determinant), rel=1e-6)
    estimates = elastic.background_methods()[elastic_skies.KNOWN_CLEAN_RANGE](
        sky.counts(level, 400, 9), sky
    )
    assert np.std(estimates.background) == pytest.approx(bound, rel=0.15)


# Peers ----------------------------------------------------------------------------------------


def klett_python(power, sky):
    """Return the backscatter of particles by loops over profiles and bins (fernald1984)."""
    distance = sky.range.tolist()
    wavelength = elastic_skies.WAVELENGTH
    air = sky.air.backscatter(sky.range, wavelength).tolist()
    loss = sky.air.extinction(sky.range, wavelength).tolist()
    low, high = elastic_skies.GIVEN_WINDOW
    inside = [k for k, r in enumerate(distance) if low <= r <= high]
    rows = [_klett(row, distance, air, loss, inside) for row in power.tolist()]
    return np.asarray(rows)


def _klett(power, distance, air, loss, inside):
    start, size = inside[len(inside) // 2], len(power)
    excess = [a - elastic_skies.LIDAR_RATIO * b for a, b in zip(loss, air, strict=True)]
    corrected, integral = [0.0] * size, [0.0] * size
    for step in (1, -1):
        depth = total = 0.0
        last = start
        corrected[start] = power[start] * distance[start] ** 2
        for k in range(start + step, size if step > 0 else -1, step):
            width = distance[k] - distance[last]
            depth += 0.5 * width * (excess[k] + excess[last])
            corrected[k] = power[k] * distance[k] ** 2 * math.exp(2.0 * depth)
            total += 0.5 * width * elastic_skies.LIDAR_RATIO * (corrected[k] + corrected[last])
            integral[k] = total
            last = k
    ratio = sum(corrected[k] / air[k] for k in inside) / len(inside)
    return [q / (ratio - 2.0 * i) - b for q, i, b in zip(corrected, integral, air, strict=True)]


def test_the_peers_agree(sky):
    counts = sky.counts(1e3, 3, 1)
    estimates = elastic.background_methods()[elastic_skies.KNOWN_CLEAN_RANGE](counts, sky)
    difference = elastic.linear_backgrounds(counts, sky).background - estimates.background
    # Its weights are those of the mean of all profiles.
    assert np.abs(difference).max() < 0.1 * elastic_skies.least_error(sky, 1e3)
    clean = sky.signal[np.newaxis] + 10.0
    level = elastic.linear_backgrounds(clean, sky).background
    looped = klett_python(clean - level[:, np.newaxis], sky)
    ours = elastic_skies.invert(clean, sky, **elastic_skies.CHAINS[elastic_skies.GIVEN])
    difference = np.abs(looped - ours["aerosol_backscatter"].to_numpy())[:, sky.compared]
    # They treat the window as one point, with attenuation linear across it.
    assert difference.max() < 3e-3 * sky.backscatter[sky.compared].mean()


# Scores ---------------------------------------------------------------------------------------


def test_background_scores_of_known_errors():
    error = np.array([3.0, -1.0, 1.0, 50.0, np.nan])
    rejected = np.array([False, False, False, True, False])
    score = background_score(error, np.array([1.0, 2.0, 0.8, 1.0, 1.0]), rejected)
    assert score["mean error"].value == pytest.approx(1.0)
    # The scatter of the sums of five profiles, two of which have no value.
    assert score["mean error"].error == pytest.approx(math.sqrt(8 * 5 / 4) / 3)
    assert score["RMSE"].value == pytest.approx(math.sqrt(11 / 3))
    assert score["stated"] == pytest.approx(1.0)
    assert score["within 1"].value == pytest.approx(1 / 3)
    assert score["95 %"].value == pytest.approx(2 / 3)
    assert background_score(error[:1], np.ones(1), rejected[:1]) == {}


def test_inversion_scores_of_known_errors(sky):
    scale = sky.backscatter[sky.compared].mean()
    error = scale * np.array([[2.0, -1.0], [np.nan, 3.0], [np.nan, np.nan], [1.0, 1.0]])
    stated = scale * np.array([[1.0, 1.5], [1.0, 4.0], [1.0, 1.0], [0.6, np.nan]])
    scored = inversion_score(np.stack([error, stated]), sky)
    score = {name: figure.value for name, figure in scored.items()}
    assert score == pytest.approx(
        {
            "solved": 4 / 8,
            "mean error": 5.0 / 4,
            "RMSE": math.sqrt((4.0 + 1.0 + 9.0 + 1.0) / 4),
            "stated": math.sqrt((1.0 + 2.25 + 16.0 + 0.36) / 4),
            "within 1": 0.5,
            "95 %": 3.0 / 4,
        }
    )
    assert inversion_score(np.stack([error[1:3], stated[1:3]]), sky) == {}
    assert inversion_score(np.stack([error[1:2], stated[1:2]]), sky)["solved"].value == 0.5


# Results --------------------------------------------------------------------------------------


@pytest.mark.parametrize("decade", range(9))
def test_the_tail_is_biased_by_its_signal_and_the_shape_is_not(sky, decade):
    tail = sky.signal[-(sky.range.size // 10) :].mean()
    works = {
        work.method: work
        for work in elastic.measure_level(decade, DRAWS)
        if work.quantity == "background, counts"
    }
    known = works[elastic_skies.KNOWN_CLEAN_RANGE].more
    assert abs(known["mean error"].value) < 4.5 * known["mean error"].error
    assert known["stated"] == pytest.approx(known["bound"], rel=0.05)
    assert works[elastic_skies.KNOWN_CLEAN_RANGE].error.value == pytest.approx(
        known["stated"], rel=0.4
    )
    bias = works[elastic_skies.TAIL_MEAN].more["mean error"]
    assert abs(bias.value - tail) < 4.5 * bias.error
    bias = works[elastic_skies.KNOWN_SHAPE].more["mean error"]
    assert decade > 6 or abs(bias.value) < 4.5 * bias.error


@pytest.mark.parametrize("decade", range(9))
def test_backscatter_has_the_stated_error_with_a_given_window(sky, decade):
    counts = sky.counts(10.0**decade, DRAWS, decade)
    score = {}
    for name, chain in elastic_skies.CHAINS.items():
        inverted = elastic_skies.invert(counts, sky, **chain)
        figures = inversion_score(elastic._errors(inverted, sky), sky)
        score[name] = {quantity: figure.value for quantity, figure in figures.items()}
    given_window = score[elastic_skies.GIVEN]
    if decade <= 5:
        assert given_window["solved"] == 1.0
        assert abs(given_window["mean error"]) < 0.01
        assert given_window["RMSE"] == pytest.approx(given_window["stated"], rel=0.35)
        assert given_window["95 %"] > 0.9
    if decade <= 3:
        # What a tail mean leaves differs from air in the window, which the tests see.
        assert score["tail_mean, given"].get("solved", 0.0) < 0.3
    if decade == 8:
        assert given_window.get("solved", 0.0) < 0.3


def test_errors_without_noise_are_small(sky):
    """The signal is summed over ninths of a bin, the inversion and the shape over bins of 15 m."""
    for level in (0.0, 1.0, 1e4):
        counts = (sky.signal + level)[np.newaxis]
        found = elastic.background_methods()[elastic_skies.KNOWN_CLEAN_RANGE](counts, sky)
        assert abs(found.background[0] - level) < 1e-6
        solved = elastic_skies.invert(counts, sky, **elastic_skies.CHAINS[elastic_skies.GIVEN])
        error = (solved["aerosol_backscatter"].to_numpy()[0] - sky.backscatter)[sky.compared]
        error /= sky.backscatter[sky.compared].mean()
        assert abs(error.mean()) < 2e-4
        assert np.abs(error).max() < 1e-3


def test_published_files_are_reproduced(data_root, accuracy):
    sky, files = elastic_skies.read_published_profiles(data_root / "synthetic" / "boeckmann")
    truths = {file.level: file for file in files}
    assert sorted(truths) == [file.level for file in files]
    noisiest = truths[1e8]
    assert noisiest.background - 1e8 == pytest.approx(250.0, abs=2.0)
    assert noisiest.background_error == pytest.approx(math.sqrt(1e8 / 1000 / 945), rel=0.05)
    assert np.all(np.isfinite(sky.backscatter[sky.inverted]))
    backgrounds = accuracy.figures("Background of published files, counts per shot")
    inversions = accuracy.figures("Backscatter of published files, percent of its mean")
    for level in truths:
        name = f"1e{round(math.log10(level))}"
        assert abs(backgrounds[name, elastic_skies.KNOWN_SHAPE, "error / stated"].value) < 3.0
        error = backgrounds[name, elastic_skies.KNOWN_SHAPE, "error"].value
        assert level > 1e5 or abs(error) < 1.0
        assert level > 1e5 or abs(inversions[name, elastic_skies.GIVEN, "mean error"].value) < 0.01
        tail = backgrounds[name, elastic_skies.TAIL_MEAN, "error"].value
        assert level > 1e4 or tail == pytest.approx(2.75, abs=0.1)


# Pages and the command ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("what", "data", "message"),
    [("luck", None, "accuracy or throughput"), ("throughput", "folder", "leave it out")],
)
def test_wrong_use_is_refused(what, data, message):
    with pytest.raises(CampaignError, match=message):
        measure(what, "homogeneous", Effort(data=data))


def test_folders_without_the_published_files_are_refused(tmp_path):
    with pytest.raises(CampaignError, match="no files background_1e"):
        elastic_skies.read_published_profiles(tmp_path)


def test_the_command_prints_writes_and_refuses(monkeypatch, accuracy, tmp_path):
    passed = []

    def stand_in(effort):
        passed.append((effort.quick, effort.data))
        return accuracy

    monkeypatch.setitem(BENCHMARKS["accuracy"], "elastic", stand_in)
    words = ["accuracy", "--case", "elastic", "--quick", "--data", str(tmp_path)]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert passed == [(True, tmp_path)]
    assert json.loads((tmp_path / "result.json").read_text())["tables"]
    refused = CliRunner().invoke(
        app, ["accuracy", "--case", "homogeneous", "--data", str(tmp_path)]
    )
    assert refused.exit_code == 2
    assert "elastic" in refused.output
