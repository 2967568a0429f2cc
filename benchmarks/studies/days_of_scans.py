"""Optical depths of simulated days of scans: ``python -m benchmarks.studies.days_of_scans [DAYS]``.

Every day is simulated with a seed of its own, processed from raw files to products, and compared
with the truth. The table, which is written into the page of scans, states how often values without
flag, and values with one flag only, deviate by more than 1.96, 3 and 4 stated errors, with the
Monte Carlo error over the days. A day takes about 5 s of CPU time.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr
import yaml

# Its campaigns are those of tests.
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from support.archives.scan_campaign import ALTITUDE, TREE

from benchmarks.studies.ablation import PAGES, requested_number, write_table
from lidarops.campaign.model import load_campaign
from lidarops.flags import Quality
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.run.archive import reprocess
from lidarops.simulate.campaign import simulate_campaign

DAYS = 20
CLASSES = {"no flag": 0, "prior_dominated": int(MultiAngleQuality.PRIOR_DOMINATED)}
TERMS = ("standard", "gradient", "dead_time")
LIMITS = (1.96, 3.0, 4.0)


def day_of_scores(folder: Path, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (retrieved - true) / stated error of all optical depths of a day, and their flags."""
    simulation = TREE["simulation"] | {"duration": 86_400, "seed": seed}
    path = folder / "scans.yaml"
    path.write_text(yaml.safe_dump(TREE | {"simulation": simulation}), encoding="utf-8")
    campaign = load_campaign(path)
    truth = simulate_campaign(campaign).truth
    reprocess(campaign)
    granule = truth["profile_granule_scanner"].values
    upward = truth["zenith_angle"].values[granule] < 1.0
    time = truth["time"].values[granule][upward]
    depth = truth["profile_path_optical_depth_scanner"].values[upward, 0]
    ends = np.append(0.0, truth["range_end_scanner"].values)
    scores, flags = [], []
    for path in sorted(campaign.products_root.rglob("*.nc")):
        product = xr.load_dataset(path)
        nearest = np.abs(time - product["time"].values[:, np.newaxis]).argmin(axis=1)
        height = product["altitude"].values - ALTITUDE
        true = np.array([np.interp(height, ends, np.append(0.0, depth[k])) for k in nearest])
        terms = (product[f"vertical_optical_depth_{term}_error"].values for term in TERMS)
        error = np.sqrt(sum(term**2 for term in terms))
        scores.append(((product["vertical_optical_depth"].values - true) / error).ravel())
        # A bit that small values have would select the others by their noise.
        flags.append(product["quality_flag"].values.ravel() & ~int(Quality.LOW_SIGNAL_TO_NOISE))
    return np.concatenate(scores), np.concatenate(flags)


def main(days: int) -> None:
    """Write the table."""
    rates: dict[str, list[list[float]]] = {name: [] for name in CLASSES}
    for seed in range(1, days + 1):
        with tempfile.TemporaryDirectory() as folder:
            scores, flags = day_of_scores(Path(folder), seed)
        for name, bits in CLASSES.items():
            chosen = np.abs(scores[(flags == bits) & np.isfinite(scores)])
            shares = [100.0 * np.sum(chosen > k) / max(chosen.size, 1) for k in LIMITS]
            rates[name].append([chosen.size, *(shares if chosen.size else np.full(3, np.nan))])
    lines = [
        f"| {days} days, values with | a day | {' | '.join(f'> {k:g}, %' for k in LIMITS)} |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, rows in rates.items():
        table = np.array(rows)
        mean, error = np.nanmean(table, axis=0), np.nanstd(table, axis=0, ddof=1) / days**0.5
        cells = [f"{m:.3f} ± {e:.3f}" for m, e in zip(mean[1:], error[1:], strict=True)]
        lines.append(f"| {name} | {mean[0]:.0f} | {' | '.join(cells)} |")
    write_table(PAGES / "multiangle.md", "days", lines)


if __name__ == "__main__":
    main(requested_number(__doc__, DAYS))
