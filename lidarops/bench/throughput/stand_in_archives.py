"""Archives of empty files that stand for others: catalog and ledger are as after a run."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import yaml

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.catalog.ledger import Entry, NewProduct, Run, RunStatus
from lidarops.catalog.lock import Lock
from lidarops.catalog.rows import row_of
from lidarops.catalog.scan import scan_keys
from lidarops.catalog.store import Store
from lidarops.plan import product_dependence
from lidarops.plan.scene_plan import plan_scene
from lidarops.plan.scenes import cut_scenes
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    Granule,
    InputRecord,
    ProductRecord,
    Role,
    Scene,
    SceneOutcome,
    Status,
)
from lidarops.run.staleness import Judge

A_DAY: Final = 288
"""Files of an instrument a day: one every 5 minutes."""
_FIRST: Final = datetime(2025, 1, 1, tzinfo=UTC)
_LASTS: Final = timedelta(days=1) / A_DAY
_CHANNEL: Final = ChannelLayout("photon_532o", DetectionMode.PHOTON, 532e-9, 2000, 7.5, 0)
_CONTENT: Final = b"stands for a product"
_RUN: Final = "simulated"


@dataclass(frozen=True, slots=True)
class StandIns:
    """Size of such an archive."""

    instruments: int
    days: int

    @property
    def files(self) -> int:
        """Number of files."""
        return self.instruments * self.days * A_DAY


def enter(standing: StandIns, path: Path) -> Campaign:
    """Write campaign, empty files, catalog and ledger of an archive in which nothing is stale.

    Parameters
    ----------
    standing : StandIns
    path : Path
        Of the campaign file, in a folder of its own.

    Returns
    -------
    Campaign
    """
    path.write_text(yaml.safe_dump(_settings(standing)), encoding="utf-8")
    campaign = load_campaign(path)
    keys = scan_keys(campaign)
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        store.begin_run(
            Run(_RUN, _FIRST, _FIRST, RunStatus.FINISHED, "nobody", "0", "0"), lock.token
        )
        judge = Judge(campaign, store)
        for day in range(standing.days):
            granules = [
                granule
                for name in campaign.instruments
                for granule in _granules(campaign, name, day)
            ]
            store.replace(
                [
                    row_of(each, store.campaign, keys[str(each.instrument), each.role])
                    for each in granules
                ]
            )
            for scene in cut_scenes(campaign, granules).scenes:
                store.record(_entry(judge, campaign, scene), _RUN, lock.token)
    return campaign


def _settings(standing: StandIns) -> dict[str, Any]:
    instrument = {
        "station": "here",
        "facts": [{"zenith_angle": 90, "full_overlap_range": 300}],
        "products": {"signal": {}},
    }
    return {
        "name": "stand-ins",
        "title": "Archive of a benchmark",
        "archive": "raw",
        "output": "out",
        "stations": {"here": {"name": "Here", "latitude": 50, "longitude": 10, "altitude": 100}},
        "instruments": {
            f"i{number:02d}": instrument | {"files": f"*/i{number:02d}/h*"}
            for number in range(standing.instruments)
        },
        "scenes": {"window": "24h"},
    }


def _granules(campaign: Campaign, instrument: str, day: int) -> Iterator[Granule]:
    station = campaign.stations[campaign.instruments[instrument].station]
    folder = f"d{day:05d}/{instrument}"
    within = Path(campaign.archive) / folder
    within.mkdir(parents=True)
    for number in range(A_DAY):
        name = f"h{number:03d}"
        file = within / name
        file.touch()
        about = file.stat()
        start = _FIRST + timedelta(days=day) + number * _LASTS
        yield Granule(
            path=f"{folder}/{name}",
            size=about.st_size,
            mtime_ns=about.st_mtime_ns,
            instrument=instrument,
            role=Role.SIGNAL,
            status=Status.GOOD,
            start=start,
            stop=start + _LASTS,
            zenith_angle=90.0,
            latitude=station.latitude,
            longitude=station.longitude,
            altitude=station.altitude,
            layout=(_CHANNEL,),
            sha256=hashlib.sha256(f"{folder}/{name}".encode()).hexdigest(),
        )


def _entry(judge: Judge, campaign: Campaign, scene: Scene) -> Entry:
    whole = plan_scene(scene, campaign)
    files = [InputRecord(each.path, Role.SIGNAL, str(each.sha256)) for each in scene.granules]
    products = tuple(
        _product(judge, campaign, scene, wanted, files)
        for wanted in product_dependence.wanted(whole)
    )
    outcome = SceneOutcome(
        scene.id,
        scene.station,
        scene.instrument,
        scene.start,
        len(scene.granules),
        whole,
        products=tuple(each.record for each in products),
    )
    judged = judge.judgement(scene, whole)
    return Entry(outcome, judged.day, judge.key(judged), final=True, products=products)


def _product(
    judge: Judge,
    campaign: Campaign,
    scene: Scene,
    wanted: product_dependence.Wanted,
    files: Sequence[InputRecord],
) -> NewProduct:
    kind, channel = wanted
    path = f"{scene.instrument}/{scene.id}_{kind}_{channel}.nc"
    target = campaign.products_root / path
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(_CONTENT)
    content = hashlib.sha256(_CONTENT).hexdigest()
    depends_on, used = judge.depends_on(scene, plan_scene(scene, campaign), wanted, files)
    record = ProductRecord(path, kind, channel, content, len(_CONTENT), 1, {}, 1)
    return NewProduct(record, target.stat().st_mtime_ns, depends_on, used)
