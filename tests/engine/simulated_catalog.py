"""A catalog of many granules and products, without their raw files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import factories

from lidarops import dependence
from lidarops.campaign import Campaign
from lidarops.catalog import scan as scan_module
from lidarops.catalog.ledger import Entry, NewProduct, Run, RunStatus
from lidarops.catalog.lock import Lock
from lidarops.catalog.rows import row_of
from lidarops.catalog.sources import RawFile, Source
from lidarops.catalog.store import Store
from lidarops.plans import plan
from lidarops.records import Granule, InputRecord, ProductRecord, Role, SceneOutcome
from lidarops.scenes import cut
from lidarops.staleness import Judge

A_DAY = 288
"""Granules a day and instrument: one every 5 minutes."""


@dataclass(frozen=True)
class Simulated:
    """A campaign whose archive exists in the catalog only."""

    campaign: Campaign
    instruments: int
    days: int

    @property
    def granules(self) -> int:
        return self.instruments * self.days * A_DAY

    def day(self, day: int) -> Iterator[Granule]:
        """Granules of one day, by path."""
        for number in range(self.instruments):
            for k in range(A_DAY):
                minutes = day * 1440 + k * 5
                path = f"d{day:05d}/i{number:02d}/h{k:03d}"
                yield factories.granule(
                    minutes,
                    path=path,
                    instrument=f"i{number:02d}",
                    sha256=hashlib.sha256(path.encode()).hexdigest(),
                )

    def files(self, *_: object) -> Iterator[RawFile]:
        """What the file system would list."""
        for day in range(self.days):
            for number in range(self.instruments):
                for k in range(A_DAY):
                    yield RawFile(f"d{day:05d}/i{number:02d}/h{k:03d}", 1000, 1)


def make(folder: Path, *, instruments: int, days: int) -> Simulated:
    """Write the catalog, small product files and their ledger rows."""
    (folder / "raw").mkdir(parents=True)
    template = factories.campaign().model_dump()
    instrument = template["instruments"].pop("lidar")
    for number in range(instruments):
        files = [f"d*/i{number:02d}/h*"]
        template["instruments"][f"i{number:02d}"] = {
            **instrument,
            "files": files,
            "dark_files": [],
        }
    campaign = Campaign.model_validate(template).model_copy(
        update={"archive": str(folder / "raw"), "output": str(folder / "out")}
    )
    simulated = Simulated(campaign, instruments, days)
    keys = {claim.instrument: claim.scan_key for claim in scan_module._claims(campaign)}
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        judge = Judge(campaign, store)
        began = factories.DAY + timedelta(days=days)
        run = Run("r", began, began, RunStatus.FINISHED, "nobody", "0", "0")
        store.begin_run(run, lock.token)
        for day in range(days):
            granules = list(simulated.day(day))
            rows = [row_of(each, store.campaign, keys[each.instrument]) for each in granules]
            store.replace(rows)
            for scene in cut(campaign, granules).scenes:
                store.record(_entry(judge, campaign, scene), "r", lock.token)
    return simulated


def _entry(judge, campaign, scene) -> Entry:
    whole = plan(scene, campaign)
    files = [InputRecord(g.path, Role.SIGNAL, str(g.sha256)) for g in scene.granules]
    ((kind, channel),) = dependence.wanted(whole)
    path = f"{scene.instrument}/{scene.id}.nc"
    target = campaign.products_root / path
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(b"product")
    depends_on, used = judge.depends_on(scene, whole, (kind, channel), files)
    record = ProductRecord(path, kind, channel, hashlib.sha256(b"product").hexdigest(), 7, 1, {}, 1)
    outcome = SceneOutcome(
        scene.id, scene.station, scene.instrument, scene.start, len(scene.granules), whole,
        products=(record,),
    )  # fmt: skip
    new = NewProduct(record, target.stat().st_mtime_ns, depends_on, used)
    judged = judge.judgement(scene, whole)
    return Entry(outcome, judged.day, judge.key(judged), final=True, products=(new,))


def listed(simulated: Simulated) -> None:
    """Let a scan list the files of the catalog, which are not there."""
    Source.files = simulated.files
