"""Archives of empty stand-in files, with catalog and ledger as after a complete run."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import yaml

from benchmarks.throughput.campaigns import campaign_settings
from lidarops.campaign.model import Campaign, load_campaign
from lidarops.catalog.headers import row_of
from lidarops.catalog.lock import Lock
from lidarops.catalog.scan import scan_keys
from lidarops.catalog.store import NewProduct, Run, RunStatus, SceneEntry, Store
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
from lidarops.run.leftovers import product_file
from lidarops.run.scenes import cut_scenes
from lidarops.run.staleness import Judge
from lidarops.scene import dependence
from lidarops.scene.plan import plan_scene

FILES_PER_DAY: Final = 288
"""Files per instrument and day: one every 5 minutes."""
_FIRST: Final = datetime(2025, 1, 1, tzinfo=UTC)
_INTERVAL: Final = timedelta(days=1) / FILES_PER_DAY
_CHANNEL: Final = ChannelLayout("photon_532o", DetectionMode.PHOTON, 532e-9, 2000, 7.5, 0)
_CONTENT: Final = b"stands for a product"
_RUN: Final = "simulated"


@dataclass(frozen=True, slots=True)
class StandIns:
    """Size of an archive of stand-ins."""

    instruments: int
    days: int

    @property
    def files(self) -> int:
        """Number of files."""
        return self.instruments * self.days * FILES_PER_DAY


def write_stand_ins(size: StandIns, path: Path) -> Campaign:
    """Write campaign, empty files, catalog and ledger of an archive that is up to date.

    Parameters
    ----------
    size : StandIns
    path : Path
        Campaign file, in its own folder.

    Returns
    -------
    Campaign
    """
    path.write_text(yaml.safe_dump(_settings(size)), encoding="utf-8")
    campaign = load_campaign(path)
    keys = scan_keys(campaign)
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store) as lock:
        lock.acquire()
        store.begin_run(
            Run(_RUN, _FIRST, _FIRST, RunStatus.FINISHED, "nobody", "0", "0", "", ""), lock.token
        )
        judge = Judge(campaign, store)
        for day in range(size.days):
            granules = [
                granule
                for name in campaign.instruments
                for granule in _granules(campaign, name, day)
            ]
            store.replace(
                [
                    row_of(granule, store.campaign, keys[str(granule.instrument), granule.role])
                    for granule in granules
                ]
            )
            for scene in cut_scenes(campaign, granules).scenes:
                store.record(_entry(judge, campaign, scene), _RUN, lock.token)
    return campaign


def _settings(size: StandIns) -> dict[str, Any]:
    instrument = {
        "station": "here",
        "facts": [{"zenith_angle": 90, "full_overlap_range": 300}],
        "products": {"signal": {}},
    }
    names = (f"i{number:02d}" for number in range(size.instruments))
    instruments = {name: instrument | {"files": f"*/{name}/h*"} for name in names}
    return campaign_settings("stand-ins", instruments, scenes={"window": "24h"})


def _granules(campaign: Campaign, instrument: str, day: int) -> Iterator[Granule]:
    station = campaign.stations[campaign.instruments[instrument].station]
    folder = f"d{day:05d}/{instrument}"
    directory = Path(campaign.archive) / folder
    directory.mkdir(parents=True)
    for number in range(FILES_PER_DAY):
        name = f"h{number:03d}"
        file = directory / name
        file.touch()
        status = file.stat()
        start = _FIRST + timedelta(days=day) + number * _INTERVAL
        yield Granule(
            path=f"{folder}/{name}",
            size=status.st_size,
            mtime_ns=status.st_mtime_ns,
            instrument=instrument,
            role=Role.SIGNAL,
            status=Status.GOOD,
            start=start,
            stop=start + _INTERVAL,
            zenith_angle=90.0,
            latitude=station.latitude,
            longitude=station.longitude,
            altitude=station.altitude,
            layout=(_CHANNEL,),
            sha256=hashlib.sha256(f"{folder}/{name}".encode()).hexdigest(),
        )


def _entry(judge: Judge, campaign: Campaign, scene: Scene) -> SceneEntry:
    plan = plan_scene(scene, campaign)
    files = [
        InputRecord(granule.path, Role.SIGNAL, str(granule.sha256)) for granule in scene.granules
    ]
    products = tuple(_product(judge, campaign, scene, key, files) for key in plan.product_keys)
    outcome = SceneOutcome(
        scene.id,
        scene.station,
        scene.instrument,
        scene.start,
        len(scene.granules),
        plan,
        products=tuple(product.record for product in products),
    )
    judgement = judge.judgement(scene, plan, dependence.ancillary_files(plan.steps))
    return SceneEntry(outcome, judgement.day, judge.key(judgement), final=True, products=products)


def _product(
    judge: Judge,
    campaign: Campaign,
    scene: Scene,
    key: dependence.ProductKey,
    files: Sequence[InputRecord],
) -> NewProduct:
    kind, channel = key
    path = product_file(scene, key)
    target = campaign.products_root / path
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(_CONTENT)
    content = hashlib.sha256(_CONTENT).hexdigest()
    depends_on, used = judge.depends_on(scene, plan_scene(scene, campaign), key, files)
    record = ProductRecord(path, kind, channel, content, len(_CONTENT), 1, {}, 1)
    return NewProduct(record, target.stat().st_mtime_ns, depends_on, used)
