"""Random damages of an archive: products stay as they are, or something named tells why not."""

from __future__ import annotations

import os
import random
import re
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import yaml
from support.licel_lines import new_dataset, new_header

from lidarops.campaign.model import load_campaign
from lidarops.catalog.store import Store
from lidarops.raw import licel
from lidarops.reports.findings import finding_rows
from lidarops.run.archive import bring_up_to_date

FILES, BINS = 8, 400
DAY = datetime.fromisoformat("2026-03-01T10:00:00+00:00")
RECORDERS = {"BT0": licel.DatasetKind.ANALOG, "BC0": licel.DatasetKind.PHOTON,
             "BC1": licel.DatasetKind.PHOTON}  # fmt: skip
DRAWS = 20
"""Of each kind, for each sort of names."""
SEED = os.environ.get("LIDAROPS_DAMAGES", "")
"""Text with which other damages are drawn."""
Rows = dict[tuple[str, str], bytes]
"""Recorder, which a product states, and time of a profile -> its ranges, values and flags."""


def named(moment: datetime) -> str:
    return f"h{moment:%y}{moment.month:X}{moment:%d%H}.{moment:%M%S}00"


def content(number: int, start: datetime, stop: datetime, **changes: Any) -> bytes:
    """Return a file of a fixed beam with three recorders."""
    common = {"wavelength": 532e-9, "bins": BINS, "bin_width": 7.5, "shots": 600}
    datasets = [new_dataset(kind=kind, device=name, **common) for name, kind in RECORDERS.items()]
    place = {"site": "Coast", "altitude": 20.0, "latitude": 46.4, "longitude": 30.7}
    header = new_header(
        **({"name": named(start), "zenith_angle": 30.0} | place | changes),
        start=start,
        stop=stop,
        datasets=datasets,
        lasers=[licel.Laser(600, 10), licel.Laser(0, 0)],
    )
    rng = np.random.default_rng(number)
    names = [dataset.name for dataset in header.datasets]
    light = 100.0 + 5e4 / (1.0 + np.arange(BINS) / 20.0) ** 2
    return licel.encode(header, {one: rng.poisson(light).astype(np.int32) for one in names})


def counted(moment: datetime) -> str:
    """Return a name that tells no time."""
    return f"p{(moment - DAY) // timedelta(minutes=1) + 500:06}.dat"


class Archive:
    """Files of some minutes, and a campaign that reads them; `name` names the files."""

    def __init__(self, folder: Path, name: Callable[[datetime], str] = named) -> None:
        self.folder, self.name = folder, name
        self.files: dict[str, bytes] = {}
        for number in range(FILES):
            self.files[name(DAY + timedelta(minutes=number))] = self.content(number)
        self.facts: list[dict[str, Any]] = [{"full_overlap_range": 300.0}]

    def content(self, number: int, **changes: Any) -> bytes:
        """Return a file as it was recorded, but for some changes."""
        start = DAY + timedelta(minutes=number)
        changes = {"name": self.name(start)} | changes
        return content(number, start, start + timedelta(minutes=1), **changes)

    def result(self) -> tuple[Rows, set[str]]:
        """Return the profiles of all products, and what is named of files and facts."""
        for name, data in self.files.items():
            path = self.folder / "raw" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        station = {"name": "Coast", "latitude": 46.4, "longitude": 30.7, "altitude": 20.0}
        tree = {
            "name": "damaged",
            "title": "Damaged",
            "archive": "raw",
            "output": "out",
            "stations": {"coast": station},
            "instruments": {
                "lidar": {
                    "station": "coast",
                    "files": "**",
                    "facts": self.facts,
                    "products": {"signal": {"channels": "all"}},
                }
            },
        }
        path = self.folder / "campaign.yaml"
        path.write_text(yaml.safe_dump(tree), encoding="utf-8")
        campaign = load_campaign(path)
        result = bring_up_to_date(campaign)
        with Store(campaign.catalog_url, campaign.name) as store:
            told = {granule.reason for granule in store.refused()}
        told |= {
            *result.set_aside.values(),
            *(row.problem for row in finding_rows(result.findings)),
        }
        told |= set(map(str, result.findings.unmet))
        for scene in result.scenes:
            told |= {scene.error, *scene.notes}
        rows: Rows = {}
        for product in campaign.products_root.rglob("*.nc"):
            with xr.open_dataset(product) as signal:
                recorder = signal.attrs["lidarops_recorder"]
                told |= set(signal.attrs.get("lidarops_unused_inputs", "").splitlines())
                names = ("signal", "signal_standard_error", "quality_flag", "zenith_angle")
                for time in signal["time"].values:
                    own = signal.sel(time=time)
                    parts = (own[name].values.tobytes() for name in (*names, "range"))
                    rows[recorder, str(time)] = b"".join(parts)
        return rows, told - {""}


def one_name(archive: Archive, rng: random.Random) -> None:
    """Rename a file, copy it, or exchange the names of two."""
    first, second = rng.sample(sorted(archive.files), 2)
    moment = DAY + timedelta(hours=rng.choice([-30, -3, 1, 5, 24, 400]), minutes=rng.randrange(60))
    other = rng.choice([archive.name(moment), first.upper(), f"old/{first}", "temp.dat"])
    action = rng.choice(["rename", "copy", "exchange"])
    if action == "copy":
        archive.files[other] = archive.files[first]
    elif action == "rename":
        archive.files[other] = archive.files.pop(first)
    else:
        one, two = archive.files[first], archive.files[second]
        archive.files |= {first: two, second: one}


def one_time(archive: Archive, rng: random.Random) -> None:
    """Give a file another start or stop."""
    # Where names tell no time, the first and the last file may be of another session.
    ends = 0 if archive.name is named else 1
    number = rng.randrange(ends, FILES - ends)
    name = sorted(archive.files)[number]
    start = DAY + timedelta(minutes=number)
    shift = timedelta(seconds=rng.choice([-1, 1]) * rng.choice([90, 600, 3600, 86400, 1e6, 3.2e7]))
    moved = rng.choice([(shift, shift), (shift, timedelta()), (timedelta(), abs(shift))])
    start, stop = start + moved[0], start + timedelta(minutes=1) + moved[1]
    old = archive.files[name]
    line = old.split(b"\r\n")[1]
    text = f"{start:%d/%m/%Y %H:%M:%S} {stop:%d/%m/%Y %H:%M:%S}".encode()
    new = re.sub(rb"\d\d/\d\d/\d{4} .{8} \d\d/\d\d/\d{4} .{8}", text, line)
    if rng.random() < 0.3:
        year = rng.choice([b"1970", b"1999", b"2106"])
        new = new.replace(b"/2026", b"/" + year)
    archive.files[name] = old.replace(line, new, 1)


_CHANGES = {
    "laser": [(b" 1 ", b" 2 ")],
    "inactive": [(b" 1 ", b" 0 ")],
    "wavelength": [(b"00532", new) for new in (b"00355", b"01064", b"00533")],
    "polarisation": [(b".o", new) for new in (b".p", b".s")],
    "bin width": [(b" 7.50 ", b" 3.75 "), (b" 7.50 ", b" 15.0 ")],
    "range and bits": [(b" 0.500 ", b" 0.100 "), (b" 12 000600 ", b" 16 000600 ")],
    "shots": [(b" 000600 ", b" 000300 "), (b" 000600 ", b" 006000 ")],
}
"""Property of a recorder -> what a line states, and what in place of it."""


def one_recorder(archive: Archive, rng: random.Random) -> None:
    """Exchange, rename or lose a recorder in one file, or state other properties of it."""
    name = rng.choice(sorted(archive.files))
    data = archive.files[name]
    first, second = rng.sample(sorted(RECORDERS), 2)
    action = rng.choice(["exchange", "rename", *_CHANGES])
    if action == "exchange":
        swapped = data.replace(first.encode(), b"###").replace(second.encode(), first.encode())
        data = swapped.replace(b"###", second.encode())
    elif action == "rename":
        data = data.replace(first.encode(), first[:2].encode() + b"7", 1)
    else:
        line = next(
            one
            for one in data.split(b"\r\n")
            if one.endswith(first.encode() + b" ") or first.encode() in one
        )
        old, new = rng.choice(_CHANGES[action])
        data = data.replace(line, line.replace(old, new, 1), 1)
    archive.files[name] = data


def one_pointing(archive: Archive, rng: random.Random) -> None:
    """Give a file another pointing or position."""
    name = rng.choice(sorted(archive.files))
    number = sorted(archive.files).index(name)
    change = rng.choice(
        [{"zenith_angle": angle} for angle in (0.0, 29.0, 31.0, 60.0, -30.0, 90.0)]
        + [{"latitude": 30.7, "longitude": 46.4}, {"altitude": 900.0}, {"site": "Hill"}]
    )
    archive.files[name] = archive.content(number, **change)


def one_fact(archive: Archive, rng: random.Random) -> None:
    """State periods of facts with a gap, invalid ones, or facts that headers contradict."""
    edge = f"2026-03-01T10:0{rng.randrange(1, 8)}:00Z"
    late = f"2026-03-01T1{rng.randrange(1, 9)}:00:00Z"
    fact = archive.facts[0]
    archive.facts = rng.choice(
        [
            [{**fact, "valid_to": edge}, {**fact, "valid_from": late}],
            [{**fact, "valid_to": edge}, {"valid_from": edge, "invalid": "fog"}],
            [{**fact, "valid_from": edge}],
            [{**fact, "zenith_angle": rng.choice([0.0, 45.0])}],
            [{**fact, "channels": {"photon_532o": {"recorder": "BC1"}}}],
            [{**fact, "channels": {"photon_532o": {"recorder": "BC5"}}}],
            [{**fact, "channels": {"photon_355o": {"dead_time": 4e-9}}}],
            [{**fact, "channels": {"photon_532o": {"wavelength": 5.35e-7}}}],
        ]
    )


KINDS: dict[str, Callable[[Archive, random.Random], None]] = {
    "names": one_name,
    "times": one_time,
    "recorders": one_recorder,
    "pointing": one_pointing,
    "facts": one_fact,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [named, counted])
@pytest.mark.parametrize("kind", KINDS)
def test_no_damage_changes_the_meaning_of_a_value_silently(
    kind: str, name: Callable[[datetime], str], tmp_path: Path
) -> None:
    """In archives whose names tell the time of a file, and in those whose names count files."""
    expected, usual = Archive(tmp_path / "undamaged", name).result()
    assert len(expected) == 3 * FILES
    silent = []
    for draw in range(DRAWS):
        archive = Archive(tmp_path / str(draw), name)
        KINDS[kind](archive, random.Random(f"{kind} {draw}{SEED}"))
        rows, told = archive.result()
        if rows != expected and not told - usual:
            changed = {key for key in rows.keys() | expected if rows.get(key) != expected.get(key)}
            silent.append((draw, sorted(changed)[:3]))
    assert silent == []
