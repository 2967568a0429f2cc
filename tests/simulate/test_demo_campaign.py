"""The demo campaign: its extinction can be retrieved, and it is small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidarops.campaign.model import load_campaign
from lidarops.raw import licel
from lidarops.simulate.campaign import simulate_campaign


@pytest.fixture(scope="module")
def demo(repository, tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    # Not beside the products of other tests, which look for raw files there.
    campaign = load_campaign(
        repository / "catalogs/demo.yaml", archive=folder / "raw", output=folder / "out"
    )
    return campaign, simulate_campaign(campaign)


def test_the_demo_is_small(demo):
    campaign, result = demo
    assert 500 < len(result.paths) < 2000
    assert sum((Path(campaign.archive) / path).stat().st_size for path in result.paths) < 80e6


def test_the_demo_covers_night_and_day(demo):
    truth = demo[1].truth
    coast = truth.isel(granule=truth["instrument"].values == "coast-horizontal")
    sky = coast["background_photon_532o"].values
    assert (sky < 0.1).mean() > 0.3
    assert (sky > 1.0).mean() > 0.3
    sigma = coast["total_extinction"].values
    assert sigma.min() == pytest.approx(5e-5, rel=0.02)
    assert sigma.max() == pytest.approx(4e-4, rel=0.02)


def _counts(result, path, channel):
    content = (result.archive / path).read_bytes()
    header = licel.parse_header(content, file=path)
    dataset = next(d for d in header.channels if d.name == channel)
    return header, dataset, np.frombuffer(content, "<i4", dataset.bins, dataset.offset)


def _fit(distance, power, variance, guess):
    """Converged least squares of {1, f, df/dsigma}, independent of the package."""
    p = np.array(guess)
    for _ in range(8):
        f = np.exp(-2 * p[2] * distance) / distance**2
        jacobian = np.stack([np.ones_like(f), f * guess[1], -2 * distance * p[1] * f * guess[2]])
        scale = np.array([1.0, guess[1], guess[2]])
        weighted = jacobian / np.sqrt(variance)
        residual = (power - p[0] - p[1] * f) / np.sqrt(variance)
        p = p + scale * np.linalg.lstsq(weighted.T, residual, rcond=None)[0]
    error = np.sqrt(np.diag(np.linalg.inv(weighted @ weighted.T))) * scale
    return p[2], error[2], (residual**2).sum() / (distance.size - 3)


@pytest.mark.parametrize("section", [(750, 4500), (1500, 7500)])
@pytest.mark.parametrize("channel", ["photon_532o", "analog_532o"])
def test_the_homogeneous_path_is_retrievable(demo, section, channel):
    campaign, result = demo
    instrument = campaign.instruments["coast-horizontal"]
    truth = result.truth
    good = (truth["instrument"].values == "coast-horizontal") & (truth["refused"].values == 0)
    scores, relative, peak, misfit = [], [], [], []
    for index in np.flatnonzero(good):
        header, dataset, counts = _counts(result, str(truth["path"].values[index]), channel)
        power = counts * dataset.scale
        distance = (np.arange(dataset.bins) + 0.5) * dataset.bin_width
        inside = (distance >= section[0]) & (distance <= section[1])
        known = [float(truth[f"{q}_{channel}"][index]) for q in ("background", "amplitude")]
        sigma = float(truth["total_extinction"][index])
        model = known[0] + known[1] * np.exp(-2 * sigma * distance) / distance**2
        exposure = dataset.shots * 0.05
        if channel.startswith("photon"):
            facts = instrument.facts_at(header.start).channels[channel]
            live = 1 - power * facts.dead_time * 1e6
            power = power / live
            variance = model / exposure * (1 + model * facts.dead_time * 1e6)
            peak.append(model[inside].max() * facts.dead_time * 1e6)
        else:
            assert counts[inside].max() < 0.5 * dataset.full_scale
            step = 100 / 4096
            variance = (0.3**2 + step**2 / 12) / dataset.shots + 1.2 * 0.05 * model / exposure
            known[0] += float(truth[f"dark_offset_{channel}"][index])
        estimate, error, chi2 = _fit(
            distance[inside], power[inside], variance[inside], (*known, sigma)
        )
        scores.append((estimate - sigma) / error)
        relative.append(error / (sigma + 1 / distance[inside].mean()))
        misfit.append(chi2)
    scores = np.array(scores)
    assert scores.size > 280
    # Correct within three standard errors, which are neither too small nor too large.
    assert (np.abs(scores) < 3).mean() >= 0.99
    assert scores.std() == pytest.approx(1, abs=0.15)
    assert abs(scores.mean()) < 0.25
    assert np.mean(misfit) == pytest.approx(1, abs=0.02)
    # Well determined by night and mostly by day.
    assert (np.array(relative) < 0.1).mean() > 0.95
    # Dead time stays where it is a small correction, so that nothing needs a flag for it.
    assert not peak or max(peak) < 0.095


def test_the_vertical_path_is_clearly_not_homogeneous(demo):
    # The best homogeneous fit on a grid of extinction leaves far more than noise, always.
    _, result = demo
    truth = result.truth
    vertical = (truth["instrument"].values == "hill-vertical") & (truth["refused"].values == 0)
    for index in np.flatnonzero(vertical)[::9]:
        _, dataset, counts = _counts(result, str(truth["path"].values[index]), "analog_532o")
        distance = (np.arange(dataset.bins) + 0.5) * dataset.bin_width
        inside = (distance >= 750) & (distance <= 4500)
        r, power = distance[inside], counts[inside] * dataset.scale
        exposure = dataset.shots * 0.05
        deviation = np.sqrt(
            0.3**2 / dataset.shots + 1.2 * 0.05 * np.maximum(power - 3, 0.01) / exposure
        )
        best = np.inf
        for sigma in np.linspace(-1e-4, 3e-3, 60):
            f = (r[0] / r) ** 2 * np.exp(-2 * sigma * (r - r[0]))
            design = np.stack([np.ones_like(f), f], axis=1) / deviation[:, np.newaxis]
            rest = power / deviation
            rest = rest - design @ np.linalg.lstsq(design, rest, rcond=None)[0]
            best = min(best, (rest**2).sum() / (r.size - 3))
        assert best > 5
        assert np.isnan(truth["total_extinction"].values[index])
