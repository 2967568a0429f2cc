"""Run a campaign in a separate process, to be killed: ``python crash_runs.py FOLDER MODE``."""

from __future__ import annotations

import sys
from pathlib import Path

from lidarops.campaign.model import load_campaign
from lidarops.run.archive import Options, bring_up_to_date


def run(folder: Path, mode: str) -> int:
    """Process the campaign of a folder by the function or flow that `mode` names."""
    if mode == "flow":
        from flows.reprocess import reprocess

        result, _ = reprocess(str(folder / "campaign.yaml"), wait=60.0)
        return int(result.has_failures)
    campaign = load_campaign(folder / "campaign.yaml")
    workers = 2 if mode == "cluster" else 1
    result = bring_up_to_date(campaign, options=Options(workers=workers, wait=60.0))
    return 128 + result.signal if result.signal else int(result.has_failures)


if __name__ == "__main__":
    raise SystemExit(run(Path(sys.argv[1]), sys.argv[2]))
