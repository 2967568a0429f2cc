"""From simulated files to products: photon counting with less than one count in a bin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
import yaml
from support.archives import mixed_campaign

from lidarops.campaign.model import load_campaign
from lidarops.flags import Quality
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.run.archive import reprocess
from lidarops.simulate.campaign import simulate_campaign


def test_paths_of_few_counts_are_not_outlying(tmp_path: Path) -> None:
    """One count in a bin that expects 0.05: by the limits of normal noise 3 of 4 are outlying."""
    tree = mixed_campaign.tree(profiles=60, bins=600)
    simulated = tree["simulation"]["instruments"]["haze"]
    simulated["acquisition"] |= {"shots": 20, "repetition_rate": 20}
    tree["simulation"]["instruments"] = {"haze": simulated}
    request = {"channels": ["photon_532o"], "sections": [[750, 4000]]}
    tree["instruments"] = {
        "haze": {**tree["instruments"]["haze"], "products": {"homogeneous": request}}
    }
    del tree["networks"]
    path = tmp_path / "campaign.yaml"
    path.write_text(yaml.dump(tree), encoding="utf-8")
    campaign = load_campaign(path)
    simulate_campaign(campaign)
    (scene,) = reprocess(campaign).scenes
    (made,) = scene.products
    product = xr.load_dataset(campaign.products_root / made.path)
    bits = product["quality_flag"].values
    assert np.isfinite(product["total_extinction"].values).all()
    assert np.mean(bits & int(Quality.OUTLIER | HomogeneousQuality.POOR_FIT) != 0) < 0.05
