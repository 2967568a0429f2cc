"""Fixture with a small simulated campaign."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.archives.small_campaign import TREE

from lidarops.campaign.model import Campaign

Change = Callable[[dict[str, Any]], object]


@pytest.fixture
def small(tmp_path: Path) -> Callable[..., Campaign]:
    """Return a function that builds the small campaign; `changes` edit its settings."""

    def make(*changes: Change, archive: str = "raw") -> Campaign:
        tree = copy.deepcopy(TREE)
        tree["archive"], tree["output"] = str(tmp_path / archive), str(tmp_path / "out")
        for change in changes:
            change(tree)
        return Campaign.model_validate(tree)

    return make
