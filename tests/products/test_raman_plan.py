"""Plans of Raman products: channels that fit the laser, and settings that leave a reference."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.archives.scene_jobs import catalogued_scenes

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.errors import CampaignError
from lidarops.records import Plan
from lidarops.scene.plan import plan_scene
from lidarops.simulate.campaign import simulate_campaign

CampaignWith = Callable[[dict[str, Any], dict[str, Any]], Campaign]


@pytest.fixture(scope="module")
def campaign_with(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> CampaignWith:
    """Return the campaign of 20 minutes with other settings of `raman` and facts of 408 nm."""
    folder = tmp_path_factory.mktemp("raman_plan")
    text = (repository / "catalogs/raman.yaml").read_text(encoding="utf-8")

    def campaign(settings: dict[str, Any], facts: dict[str, Any]) -> Campaign:
        tree = yaml.safe_load(text)
        tree["simulation"]["duration"] = 1200
        lidar = tree["instruments"]["valley-raman"]
        lidar["products"]["raman"] |= settings
        lidar["facts"][0]["channels"]["photon_408o"] = {"dead_time": 4e-9} | facts
        path = folder / "raman.yaml"
        path.write_text(yaml.safe_dump(tree), encoding="utf-8")
        return load_campaign(path, archive=folder / "raw", output=folder / "out")

    simulate_campaign(campaign({}, {}))
    return campaign


def plan_of(campaign: Campaign) -> Plan:
    (scene,) = catalogued_scenes(campaign)
    return plan_scene(scene, campaign)


def reasons(plan: Plan) -> list[str]:
    of_pair = (left for left in plan.left_out if left.channel == "photon_355o")
    return [left.reason for left in of_pair if left.name == "raman"]


CALIBRATION = {"water_vapour_calibration": 0.19, "water_vapour_calibration_error": 0.006}


def test_a_channel_of_another_line_is_no_nitrogen(campaign_with: CampaignWith) -> None:
    settings = {"nitrogen": {"photon_355o": "photon_408o"}, "water_vapour": {}}
    (reason,) = reasons(plan_of(campaign_with(settings, {})))
    assert "photon_408o measures 408 nm" in reason
    assert "Raman line of nitrogen for 355 nm is at 387.0 nm" in reason
    assert "correct wavelength in the facts" in reason
    # The facts know the wavelength better than the header.
    assert not reasons(plan_of(campaign_with(settings, {"wavelength": 386.7e-9})))


def test_a_channel_of_another_line_is_no_water_vapour(campaign_with: CampaignWith) -> None:
    for wavelength, remarks in ((408e-9, 0), (407e-9, 0), (402e-9, 1)):
        plan = plan_of(campaign_with({}, CALIBRATION | {"wavelength": wavelength}))
        assert len(reasons(plan)) == remarks
        assert any(step.name == "raman" for step in plan.steps)
    assert "Raman line of water vapour for 355 nm is at 408.0 nm" in reasons(plan)[0]


def test_a_highest_range_below_the_reference_window_is_refused(campaign_with: CampaignWith) -> None:
    with pytest.raises(CampaignError, match=r"highest: 5000 m is below .* give 9000 m or more"):
        campaign_with({"highest": 5000}, {})
    campaign_with({"highest": 9000}, {})


def test_a_calibration_without_its_error_is_refused(campaign_with: CampaignWith) -> None:
    with pytest.raises(CampaignError, match="give its standard error in kg kg-1"):
        campaign_with({}, {"water_vapour_calibration": 0.19})
