"""Synthetic products and run records, as the package would write them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import xarray as xr

from lidarops.flags import Quality
from lidarops.kinds import flags_of, kinds
from lidarops.records import (
    Granule,
    LeftOut,
    Plan,
    PlannedStep,
    ProductRecord,
    Role,
    RunRecord,
    SceneOutcome,
    Status,
)
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality

CHANNEL = "photon_532o"
SECTIONS = ((2500.0, 5000.0), (5000.0, 10500.0))
START = datetime(2024, 3, 1, tzinfo=UTC)


def times(start: datetime, count: int, seconds: float) -> np.ndarray:
    """Return the middle times of `count` profiles at an interval of `seconds`."""
    first = np.datetime64(start.replace(tzinfo=None), "ns")
    return first + ((np.arange(count) + 0.5) * seconds * 1e9).astype("timedelta64[ns]")


def true_extinction(time: np.ndarray) -> np.ndarray:
    """Return an extinction in m-1 that varies with the hour of the day."""
    hour = (time - time.astype("datetime64[D]")) / np.timedelta64(1, "h")
    return 1.0e-4 + 6.0e-5 * np.cos(2 * np.pi * (hour - 5) / 24)


def true_background(time: np.ndarray) -> np.ndarray:
    """Return a background in MHz that varies with the sun."""
    hour = (time - time.astype("datetime64[D]")) / np.timedelta64(1, "h")
    return 0.02 + 1.5 * np.clip(np.cos(2 * np.pi * (hour - 12) / 24), 0, None)


def homogeneous(
    time: np.ndarray, *, seed: int = 0, sections=SECTIONS, flagged: float = 0.1, scale: float = 1.0
) -> xr.Dataset:
    """Return a product of kind ``homogeneous`` with errors `scale` times the stated ones."""
    random = np.random.default_rng(seed)
    shape = (time.size, len(sections))
    truth = {
        "total_extinction": true_extinction(time)[:, None],
        "background": true_background(time)[:, None],
        "amplitude": np.full((time.size, 1), 2.0e7),
    }
    errors = {"total_extinction": 4e-6, "background": 4e-3, "amplitude": 3e5}
    flag = np.zeros(shape, dtype=np.int32)
    bad = random.random(shape) < flagged
    flag[bad] = random.choice(
        [
            int(HomogeneousQuality.POOR_FIT),
            int(Quality.LOW_SIGNAL | HomogeneousQuality.POORLY_DETERMINED),
        ],
        bad.sum(),
    )
    if flagged > 0:
        flag[random.random(shape) < flagged / 4] |= int(Quality.OUTLIER)
    data = {}
    units = {"total_extinction": "m-1", "background": "MHz", "amplitude": "MHz m2"}
    for name, value in truth.items():
        error = errors[name] * (0.7 + 0.6 * random.random(shape)) * (1 + np.arange(len(sections)))
        values = value + scale * error * random.standard_normal(shape)
        values = np.where(flag & flags_of("homogeneous").rejecting, values + 25 * error, values)
        if name != "amplitude":
            values[(flag & int(Quality.LOW_SIGNAL)) != 0] = np.nan
        attrs = {"units": units[name]}
        data[name] = (("time", "section"), values.astype(np.float32), attrs)
        data[f"{name}_standard_error"] = (("time", "section"), error.astype(np.float32), attrs)
    data["reduced_chi2"] = (("time", "section"), np.ones(shape, dtype=np.float32))
    data["valid_bins"] = (("time", "section"), np.full(shape, 300, dtype=np.int32))
    data["quality_flag"] = (("time", "section"), flag)
    bounds = np.array(sections, dtype=np.float64)
    data["section_bounds"] = (("section", "nv"), bounds)
    return xr.Dataset(
        data,
        coords={
            "time": ("time", time),
            "section_range": ("section", bounds.mean(axis=1), {"units": "m"}),
            "wavelength": ((), 532.0, {"units": "nm"}),
        },
        attrs={"lidarops_kind": "homogeneous"},
    )


def signal(
    time: np.ndarray,
    *,
    bins: int = 600,
    bin_width: float = 15.0,
    seed: int = 0,
    layer: float = 3000.0,
) -> xr.Dataset:
    """Return a product of kind ``signal``: boundary layer, cloud layer, saturated bins."""
    random = np.random.default_rng(seed)
    span = (np.arange(bins) + 0.5) * bin_width
    hour = (time - time.astype("datetime64[D]")) / np.timedelta64(1, "h")
    top = 1000.0 + 500.0 * np.sin(2 * np.pi * (hour - 8) / 24)
    beta = 0.15 * np.exp(-span / 8000.0)[None, :]
    beta = beta + 1.0 / (1.0 + np.exp((span[None, :] - top[:, None]) / 100.0))
    beta = (
        beta
        + 0.8
        * np.exp(-0.5 * ((span[None, :] - layer) / 150.0) ** 2)
        * ((hour > 6) & (hour < 15))[:, None]
    )
    error = 1e-3 * (span[None, :] ** 2) * np.sqrt(0.1 + true_background(time))[:, None] * 2e-2
    clean = 3e6 * beta * np.exp(-span / 9000.0) * 1e-3
    value = clean + error * random.standard_normal((time.size, bins))
    flag = np.zeros(value.shape, dtype=np.int32)
    flag[:, span < 150.0] |= int(Quality.INCOMPLETE_OVERLAP)
    flag[:, (span >= 150) & (span < 300.0)] |= int(Quality.PILE_UP)
    thick = clean > 1.3 * np.median(clean[:, min(20, bins - 1)])
    flag[thick] |= int(Quality.SATURATED)
    attrs = {"units": "MHz m2"}
    level = true_background(time)
    return xr.Dataset(
        {
            "signal": (("time", "range"), value.astype(np.float32), attrs),
            "signal_standard_error": (
                ("time", "range"),
                np.broadcast_to(error, value.shape).astype(np.float32),
                attrs,
            ),
            "background": ("time", level.astype(np.float32), {"units": "MHz"}),
            "noise_correlation_length": ("time", np.ones(level.size, np.float32), {"units": "1"}),
            "background_standard_error": (
                "time",
                np.full(time.size, 4e-3, np.float32),
                {"units": "MHz"},
            ),
            "quality_flag": (("time", "range"), flag),
        },
        coords={
            "time": ("time", time),
            "range": ("range", span, {"units": "m"}),
            "altitude": ("range", 120.0 + 0.94 * span, {"units": "m"}),
            "wavelength": ((), 532.0, {"units": "nm"}),
        },
        attrs={"lidarops_kind": "signal"},
    )


@dataclass
class Archive:
    """The product folder of a synthetic run."""

    root: Path

    def write(self, name: str, data: xr.Dataset, kind: str) -> ProductRecord:
        """Write a product and return its record, as the engine would."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data.to_netcdf(path)
        flag = data["quality_flag"].values
        flagged = {
            bit.word: int(((flag & int(bit)) != 0).sum())
            for bit in (flags_of(kind) if kind in kinds() else Quality)
            if ((flag & int(bit)) != 0).any()
        }
        return ProductRecord(
            path=name,
            kind=kind,
            channel=CHANNEL,
            sha256="a" * 64,
            size=path.stat().st_size,
            values=int(flag.size),
            flagged=flagged,
            unflagged=int((flag == 0).sum()),
        )


def granule(path: str, reason: str = "", *, instrument: str = "horizontal") -> Granule:
    """Return a granule, refused if a reason is given."""
    status = Status.REFUSED if reason else Status.GOOD
    return Granule(path, 1234, 1, instrument, Role.SIGNAL, status, reason)


def plan(scene: str, *left_out: LeftOut) -> Plan:
    """Return a plan of one step."""
    step = PlannedStep(
        "homogeneous", CHANNEL, {"method": "auto", "sections": [[2500, 5000]]}, "requested"
    )
    return Plan(scene, (step,), left_out)


def outcome(scene: str, start: datetime = START, **changes) -> SceneOutcome:
    """Return the outcome of a scene of 20 granules."""
    fields = {
        "station": "kyiv",
        "instrument": "horizontal",
        "granules": 20,
        "plan": plan(scene),
        "seconds": {"open": 0.5, "retrieve": 1.25},
    }
    return SceneOutcome(scene=scene, start=start, **(fields | changes))


def run_record(root: Path, scenes=(), **changes) -> RunRecord:
    """Return the record of a run over `scenes`."""
    fields = {
        "id": "20240302T000000-1a2b",
        "campaign": "demo",
        "title": "Demonstration campaign",
        "started": datetime(2024, 3, 2, tzinfo=UTC),
        "finished": datetime(2024, 3, 2, 0, 1, 30, tzinfo=UTC),
        "version": "0.1.0+abc123",
        "archive": "archive",
        "products": str(root),
        "refused": (),
    }
    return RunRecord(scenes=tuple(scenes), **(fields | changes))
