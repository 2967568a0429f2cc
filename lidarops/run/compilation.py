"""Compile the retrievals ahead of their first use, by processing a small simulated campaign."""

from __future__ import annotations

import tempfile
from importlib import resources
from pathlib import Path
from typing import Final

from numba import config

from lidarops.campaign.model import load_campaign
from lidarops.errors import SceneError
from lidarops.netcdf.write import write_plain
from lidarops.run.archive import bring_up_to_date
from lidarops.simulate.campaign import plan_simulation, write_simulation

_CAMPAIGN: Final = "compile.yaml"


def compile_retrievals() -> Path:
    """Compile what products of all kinds need, and return the folder that keeps the result.

    Later processes load the compiled code from there. What is kept for another processor is not
    used, but compiled again.

    Returns
    -------
    Path
        Folder of compiled code, within ``NUMBA_CACHE_DIR`` if that is set.

    Raises
    ------
    SceneError
        If a product of the campaign is not made, so that its code was not compiled.
    """
    campaign_file = resources.files("lidarops.run") / _CAMPAIGN
    with (
        tempfile.TemporaryDirectory(prefix="lidarops-compile-") as folder,
        resources.as_file(campaign_file) as path,
    ):
        campaign = load_campaign(path, archive=f"{folder}/raw", output=f"{folder}/out")
        simulated = write_simulation(plan_simulation(campaign))
        write_plain(simulated.truth, campaign.truth_path)
        result = bring_up_to_date(campaign)
    if result.has_failures:
        raise SceneError(
            "not all products of the campaign for compilation were made",
            remedy="report it: the installation is incomplete, or lidarops has a bug",
        )
    return Path(str(vars(config)["CACHE_DIR"]))
