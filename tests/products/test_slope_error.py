"""The error of the slope on which the model errors of homogeneous paths rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
import yaml

from lidarops.campaign.model import load_campaign
from lidarops.run.archive import reprocess
from lidarops.simulate.campaign import simulate_campaign


def test_a_campaign_states_its_own_and_the_product_tells(repository: Path, tmp_path: Path):
    tree = yaml.safe_load((repository / "tests/architecture/campaigns/one_file.yaml").read_text())
    for section in (tree["instruments"], tree["simulation"]["instruments"]):
        del section["elastic"]
    path = tmp_path / "campaign.yaml"
    request = tree["instruments"]["homogeneous"]["products"]["homogeneous"]
    request["visibility"] = {}
    products = []
    for stated in (None, 0.01):
        request |= {} if stated is None else {"slope_error": stated}
        path.write_text(yaml.safe_dump(tree), encoding="utf-8")
        campaign = load_campaign(path)
        if stated is None:
            simulate_campaign(campaign)
        (scene,) = reprocess(campaign).scenes
        products.append(xr.load_dataset(campaign.products_root / scene.products[0].path))
    assumed, known = products
    assert assumed["slope_error"] == np.float32(0.05)
    assert known["slope_error"] == np.float32(0.01)
    for name in ("total_extinction_model_error", "background_model_error"):
        np.testing.assert_allclose(known[name], 0.2 * assumed[name], rtol=1e-6)
    for name in ("total_extinction", "total_extinction_standard_error"):
        np.testing.assert_array_equal(known[name], assumed[name])
    widths = [one["visibility_in_air_upper"] - one["visibility_in_air_lower"] for one in products]
    assert (widths[1] < 0.5 * widths[0]).all()
