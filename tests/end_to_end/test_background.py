"""From simulated files to products: the background of signals comes back within its error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml
from support.archives import mixed_campaign

from lidarops.campaign.model import load_campaign
from lidarops.constants import CUBIC_PAPER
from lidarops.flags import Quality
from lidarops.run.archive import reprocess
from lidarops.simulate.campaign import simulate_campaign

SKY = 2.0
"""MHz of photoelectrons, by day and by night."""
BACKGROUND = {"photon_532o": SKY, "analog_532o": 0.05 * SKY + 3.0}
"""MHz, and mV with the dark offset."""


@pytest.fixture(scope="module")
def products(tmp_path_factory: pytest.TempPathFactory) -> Mapping[tuple[str, str, str], xr.Dataset]:
    """Return the products of a horizontal beam in clear air, by instrument, kind and channel.

    The signal reaches the last bin, so that it adds to the mean of the tail.
    """
    folder = tmp_path_factory.mktemp("background")
    tree = mixed_campaign.tree(profiles=40, bins=600)
    facts = tree["instruments"]["clear-night"]
    simulated = tree["simulation"]["instruments"]["clear-night"]
    simulated["acquisition"] |= {"shots": 20_000, "repetition_rate": 400}
    simulated["detectors"][0] |= {"signal_rate": 2.0, "background": {"night": SKY, "day": SKY}}
    cubic = {"background": "cubic", "background_range": [450, 3000]}
    path = {"channels": ["photon_532o"], "sections": [[450, 3000]]}
    given = {"method": "known_background", "background": {"photon_532o": [SKY, 0.01]}}
    requests = {
        "cubic": {"signal": cubic, "homogeneous": {**path, "method": "cubic", "lag": 60}},
        "tail": {"signal": {}, "homogeneous": {**path, **given}},
    }
    tree["instruments"] = {
        name: {**facts, "files": f"{name}/m*", "products": request}
        for name, request in requests.items()
    }
    tree["simulation"]["instruments"] = dict.fromkeys(requests, simulated)
    del tree["networks"]
    file = folder / "campaign.yaml"
    # Without anchors, which campaign files need not allow.
    dumper = type("Plain", (yaml.SafeDumper,), {"ignore_aliases": lambda *_: True})
    file.write_text(yaml.dump(tree, Dumper=dumper))
    campaign = load_campaign(file)
    simulate_campaign(campaign)
    record = reprocess(campaign)
    return {
        (scene.instrument, product.kind, product.channel): xr.load_dataset(
            Path(record.products) / product.path
        )
        for scene in record.scenes
        for product in scene.products
    }


def score(product: xr.Dataset, channel: str) -> np.ndarray:
    error = product["background"] - BACKGROUND[channel]
    return (error / product["background_standard_error"]).to_numpy()


@pytest.mark.parametrize("channel", BACKGROUND)
def test_the_cubic_gives_the_background_within_its_error(products, channel):
    product = products["cubic", "signal", channel]
    deviations = score(product, channel)
    assert deviations.shape == (40,)
    assert np.abs(deviations).max() < 4.0
    assert 0.7 < np.sqrt(np.mean(deviations**2)) < 1.3
    assert product.attrs["lidarops_steps"].startswith("background: cubic of a homogeneous section")
    assert CUBIC_PAPER in product.attrs["references"]


@pytest.mark.parametrize("channel", BACKGROUND)
def test_a_mean_of_the_tail_that_holds_signal_is_flagged(products, channel):
    product = products["tail", "signal", channel]
    flags = product["quality_flag"].to_numpy() & np.int32(Quality.BACKGROUND_UNCERTAIN)
    wrong = np.abs(score(product, channel)) > 4.0
    assert wrong.mean() > 0.9
    assert (flags[wrong] != 0).all()
    assert product.attrs["lidarops_steps"].startswith("background: mean of the bins")


def test_a_campaign_gives_the_lag_of_the_cubic(products):
    product = products["cubic", "homogeneous", "photon_532o"]
    assert "the cubic with a lag of 60 bins" in product.attrs["history"]
    section = product.isel(section=0)
    assert np.abs(score(section, "photon_532o")[section["usable"] < 2]).max(initial=0.0) < 4.0
    # A short lag scatters more than 0.4 of the 340 bins.
    best = products["cubic", "signal", "photon_532o"]["background_standard_error"].median()
    assert 1.2 * best < section["background_standard_error"].median() < 5.0 * best


def test_a_campaign_gives_a_background_that_was_measured_separately(products):
    product = products["tail", "homogeneous", "photon_532o"].isel(section=0)
    assert "background is given by the campaign" in product.attrs["history"]
    np.testing.assert_allclose(product["background"], SKY)
    np.testing.assert_allclose(product["background_standard_error"], 0.01)
    assert (product["usable"] < 2).all()
