"""The background that the product ``signal`` requests, and what a plan makes of it."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError
from support import factories

from lidarops.run.scenes import cut_scenes
from lidarops.scene.plan import plan_scene


def requested(**settings: Any) -> Any:
    return factories.campaign(products={"signal": {"channels": ["photon_532o"], **settings}})


@pytest.mark.parametrize(
    ("settings", "method", "words"),
    [
        ({}, "tail_mean", "mean of the last tenth of the bins"),
        ({"background_range": [9000, 9900]}, "tail_mean", "mean of background_range"),
        ({"background": "cubic", "background_range": [900, 5000]}, "cubic", "homogeneous section"),
    ],
)
def test_the_background_is_planned_as_requested(settings, method, words):
    campaign = requested(**settings)
    (scene,) = cut_scenes(campaign, [factories.granule(0)]).scenes
    steps = plan_scene(scene, campaign).steps
    (step,) = (step for step in steps if step.name == "background")
    assert step.settings["method"] == method
    assert words in step.reason
    if settings:
        assert list(step.settings["range"]) == settings["background_range"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"background": "cubic"}, "cubic needs background_range"),
        ({"background": "known_shape"}, "'tail_mean' or 'cubic'"),
        ({"background_range": [900, 900]}, "must end farther"),
        ({"background_range": [27, 30]}, "must span at least 60 m, not 3 m: is it in km?"),
    ],
)
def test_an_impossible_request_is_refused(settings, words):
    with pytest.raises(ValidationError, match=words):
        requested(**settings)
