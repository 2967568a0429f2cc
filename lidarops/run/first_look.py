"""Look at the data of a folder that no campaign describes yet: some files are processed as drafted.

What gives no usable value is not proposed, and what headers do not state is taken from the data.
"""

from __future__ import annotations

import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
import yaml
from numpy.typing import NDArray

from lidarops.campaign.model import Campaign, campaign_schema
from lidarops.campaign.yaml_errors import with_plain_numbers
from lidarops.catalog.draft import drafted_instruments
from lidarops.catalog.folder import (
    FileGroup,
    FirstLook,
    FolderContents,
    InstrumentHeaders,
    Purpose,
)
from lidarops.errors import LidarOpsError, RawFormatError, SceneError
from lidarops.netcdf.read import open_product
from lidarops.raw.archive import open_archive, open_counts
from lidarops.raw.formats import RawFile, read_all_counts
from lidarops.raw.header import RawHeader
from lidarops.records import Granule, Scene, SceneOutcome, file_channels, is_glued
from lidarops.reports.rejections import UNLIT, rejection_rows
from lidarops.retrieve.signal.light import light_begins, rise_ends
from lidarops.run.archive import bring_up_to_date
from lidarops.run.scenes import scan_cycles_of
from lidarops.scene.dependence import scene_facts
from lidarops.scene.job import Job
from lidarops.scene.plan import plan_scene
from lidarops.scene.processing import process_scene
from lidarops.scene.profiles import bin_ranges, lightless_profiles
from lidarops.simulate.atmosphere import clock_of_sky

_MOST_FILES: Final = 96
"""Files of a look: all of half an hour of minutes, or four of each hour of a day."""
_FEW: Final = 5
"""Files that tell what an instrument gives, and parts that tell how that scatters."""
_MOST_DARK: Final = 20
_HIGHEST: Final = 8000.0
"""m; usable values count below."""
_STEP: Final = 10.0
"""m; a full overlap is not known better."""
_OF_ONE: Final = 100.0
"""m; to which one profile shows it."""
_LATEST: Final = 1000.0
"""m; light of the nearest telescope begins before, unless a record begins before the pulse. Of one
that sees only far air it begins at 750 m."""
_AT_ONCE: Final = 100.0
"""m; light of one channel at least begins before, unless the record begins before the pulse, or no
telescope sees near air."""
_FEW_COUNTS: Final = 100.0
"""Counts of a file that tell nothing of the sky."""
_OF_ONE_PROFILE: Final = ("overlap:", "dead_time:", "lag:", "none:")
"""Entries of a plan whose flags a longer average does not change."""

Floats = NDArray[np.float64]
Scenes = tuple[SceneOutcome, ...]


def look_at_data(
    text: str, contents: FolderContents, root: str, progress: Callable[[int], object]
) -> tuple[dict[str, FirstLook], dict[str, str]]:
    """Return what the data of the instruments of a draft show, and why others give no look, by key.

    Of instruments for which `elastic` is drafted: a fixed beam that reaches clean air.

    Parameters
    ----------
    text : str
        The draft, by the headers alone.
    contents : FolderContents
    root : str
        Folder of the raw files.
    progress : callable
        Called with the number of instruments done.

    Raises
    ------
    KeyboardInterrupt
        If the process is asked to stop.
    """
    drafted = with_plain_numbers(yaml.safe_load(text), campaign_schema)
    looks: dict[str, FirstLook] = {}
    failed: dict[str, str] = {}
    for key, headers in drafted_instruments(contents).items():
        if "elastic" in drafted["instruments"][key]["products"]:
            with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
                try:
                    looks[key] = _Look(drafted, key, headers, Path(root), Path(folder)).result()
                except LidarOpsError as error:
                    failed[key] = str(error)
        progress(1)
    return looks, failed


class _Look:
    """Processes a sample of the files of one instrument in a folder of its own."""

    def __init__(
        self,
        drafted: Mapping[str, Any],
        key: str,
        headers: InstrumentHeaders,
        root: Path,
        folder: Path,
    ) -> None:
        self.drafted, self.key, self.headers, self.folder = drafted, key, headers, folder
        sample = _sample(headers)
        self.files = [path for path, header in sample if _is_readable(root / path, header)]
        dark = [path for group in headers.groups if group.dark for path in group.files]
        for place, paths in (("raw", self.files), ("dark", dark[:_MOST_DARK])):
            for path in paths:
                link = folder / place / path
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to((root / path).resolve())

    def result(self) -> FirstLook:
        candidates = [name for names in self.headers.candidates for name in names]
        nitrogen = self.headers.nitrogen_channels
        seen = self._seen()
        if seen.begins is not None and seen.begins > _LATEST:
            reasons = dict.fromkeys(candidates, f"light begins at {seen.begins:.0f} m")
            return replace(seen, reasons=reasons, full_overlap=None)
        products: dict[str, Any] = {
            "elastic": {**self.drafted["instruments"][self.key]["products"]["elastic"]}
        }
        products["elastic"]["channels"] = candidates
        if nitrogen:
            products["raman"] = {"channels": list(nitrogen), "nitrogen": nitrogen}
        scenes = self._processed(products, seen.full_overlap or 0.0)
        elastic = list(self._made(scenes, "elastic"))
        shares = {name: share for name, path in elastic if (share := _usable_share(path)) > 0.0}
        raman = (name for name, path in self._made(scenes, "raman") if _usable_share(path) > 0.0)
        return replace(
            seen,
            shares=shares,
            reasons={name: self._reason(scenes, name) for name in candidates if name not in shares},
            raman=frozenset(raman),
            lags=dict(_lags(elastic)),
        )

    def _seen(self) -> FirstLook:
        """Return what raw counts show of the laser, of the telescope and of the sky."""
        files = [self.folder / "raw" / path for path in self.files]
        archive = open_archive(files, mask_and_scale=False, header_position="ignore")
        unlit = _unlit(archive)
        lit = archive.isel(time=~unlit if not unlit.all() else unlit)
        names = dict(zip((c.name for c in self.headers.layout), _channels(archive), strict=True))
        # The last one is analog where there is such a record, which counts no pile-up.
        full_overlap, within = _full_overlap(lit, [names[c[-1]] for c in self.headers.candidates])
        return FirstLook(
            files=len(files),
            full_overlap=full_overlap,
            within=within,
            begins=_late_light(lit),
            unlit=tuple(path for path, dark in zip(self.files, unlit, strict=True) if dark),
            clock=self._clock(archive),
        )

    def _clock(self, archive: xr.Dataset) -> tuple[float, float] | None:
        """Return the clocks minus UTC that the light of the sky fits, h; None where it tells none.

        Of the photon-counting channel with the greatest contrast.
        """
        counts = (archive[name] for name in _channels(archive) if name.startswith("photon"))
        far = (every[:, -every.shape[1] // 8 :] for every in counts)
        skies = [_FEW_COUNTS + part.sum("range").to_numpy() for part in far]
        sky = max(skies, key=lambda light: light.max() / light.min(), default=np.ones(1))
        station = self.drafted["stations"][self.drafted["instruments"][self.key]["station"]]
        moments = archive["time"].values.astype("datetime64[s]").tolist()
        return clock_of_sky(sky, moments, float(station["latitude"]), float(station["longitude"]))

    def _processed(self, products: Mapping[str, Any], full_overlap: float) -> Scenes:
        """Process the sample with these products, and dead times that are estimated."""
        drafted = self.drafted["instruments"][self.key]
        facts = {**drafted["facts"][0], "full_overlap_range": full_overlap}
        for pair in filter(is_glued, (name for names in self.headers.candidates for name in names)):
            photon = file_channels(pair)[-1]
            facts["channels"] = {
                **facts["channels"],
                photon: {**(facts["channels"][photon] or {}), "dead_time": "estimate"},
            }
        dark = {"dark_files": ["dark/**"]} if "dark_files" in drafted else {}
        instrument = {**drafted, **dark, "files": ["raw/**"], "facts": [facts]}
        campaign = Campaign.model_validate(
            {
                **{name: self.drafted[name] for name in ("name", "title", "stations")},
                "archive": str(self.folder),
                "output": str(self.folder / "out"),
                "instruments": {self.key: {**instrument, "products": products}},
            }
        )
        result = bring_up_to_date(campaign)
        if result.signal:
            raise KeyboardInterrupt
        errors = [scene.error for scene in result.scenes if scene.error]
        if errors:
            raise SceneError(errors[0])
        return result.scenes

    def _made(self, scenes: Scenes, kind: str) -> Iterator[tuple[str, Path]]:
        for scene in scenes:
            for product in scene.products:
                if product.kind == kind:
                    yield product.channel, self.folder / "out/products" / product.path

    def _reason(self, scenes: Scenes, channel: str) -> str:
        """Return why a channel has no usable value: flags, or what its plan left out."""
        flags: Counter[str] = Counter()
        left_out: list[str] = []
        for scene in scenes:
            for product in scene.products:
                if (product.kind, product.channel) == ("elastic", channel):
                    flags.update(product.flagged)
            omissions = scene.plan.left_out if scene.plan else ()
            left_out += [left.reason for left in omissions if left.channel == channel]
        frequent = [name.lower() for name, _ in flags.most_common(2)]
        return ", ".join(frequent) or next(iter(left_out), "no product")


def empty_in_first_files(
    campaign: Campaign, scenes: Iterable[Scene]
) -> Iterator[tuple[str, str, str, str]]:
    """Yield what the first files of scenes leave without a usable value, and why.

    Product, flag, share of the values and settings, but not what a longer average may change. Of a
    scan the files are those of its first cycle of most beams. With that, ranges without light.
    """
    for scene in scenes:
        cycles = scan_cycles_of(scene.granules)
        ((whole, beams),) = Counter(cycles).most_common(1)
        own = (g for g, cycle in zip(scene.granules, cycles, strict=True) if cycle == whole)
        begin = scene.granules[: _MOST_DARK + _FEW]
        lit = begin if beams > 1 else _lit(campaign, scene, begin)
        if dark := len(begin) - len(lit):
            share = f"{dark} of the first {len(begin)} files"
            yield f"all of {scene.instrument}", "no light", share, UNLIT
        first = replace(scene, granules=tuple(own) if beams > 1 else lit[:_FEW])
        if "pre_trigger" not in scene_facts(campaign, first).model_fields_set:
            yield from _without_near_light(campaign, first)
        with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
            here = campaign.model_copy(update={"output": folder})
            outcome = process_scene(Job(here, first, plan_scene(first, here)))
        empty = tuple(product for product in outcome.products if product.usable == 0)
        for row in rejection_rows([replace(outcome, products=empty)]):
            if beams > 1 or row[-1].startswith(_OF_ONE_PROFILE):
                yield row


def _lit(campaign: Campaign, scene: Scene, some: tuple[Granule, ...]) -> tuple[Granule, ...]:
    """Return those of some files of a scene that show light of the laser; all if none does."""
    unlit = np.ones(len(some), bool)
    with suppress(LidarOpsError):
        names = [channel.name for channel in scene.layout]
        unlit = _unlit(open_counts(some, root=Path(campaign.archive), channels=names))
    return tuple(file for file, dark in zip(some, unlit, strict=True) if not dark) or some


def _without_near_light(campaign: Campaign, scene: Scene) -> Iterator[tuple[str, str, str, str]]:
    """Yield that all channels show light late, if they do; not of files that cannot be read."""
    names = [channel.name for channel in scene.layout]
    with suppress(LidarOpsError):
        archive = open_counts(scene.granules, root=Path(campaign.archive), channels=names)
        if late := _late_light(archive):
            words = "pre_trigger: none is stated; 0 where the pulse leaves as the record begins"
            yield f"all of {scene.instrument}", "no light", f"below {late:.0f} m", words


def _channels(archive: xr.Dataset) -> list[str]:
    return [name for name in map(str, archive) if f"{name}_shots" in archive]


def _mean(archive: xr.Dataset, channel: str) -> tuple[Floats, Floats]:
    """Return ranges and the range-corrected mean of raw counts above the far range, (range,)."""
    ranges, counts = bin_ranges(archive, channel, 0.0), archive[channel].to_numpy().mean(axis=0)
    return ranges, np.square(ranges) * (counts - np.median(counts[-counts.size // 4 :]))


def _full_overlap(lit: xr.Dataset, channels: Iterable[str]) -> tuple[float | None, float]:
    """Return where the last of some channels stops rising, m, or None, and how parts scatter, m.

    Both are rounded up: the scatter of parts of the time to a digit, the range to multiples of it.
    """
    ends = {name: end for name in channels if (end := rise_ends(*_mean(lit, name))) is not None}
    if not ends:
        return None, _OF_ONE
    last = max(ends, key=ends.__getitem__)
    parts = np.array_split(np.arange(lit.sizes["time"]), min(_FEW, lit.sizes["time"]))
    known = [rise_ends(*_mean(lit.isel(time=part), last)) for part in parts]
    apart = [end for end in known if end is not None]
    scatter = max(float(np.std(apart, ddof=1)), _STEP) if len(apart) > 1 else _OF_ONE
    digit = 10.0 ** np.floor(np.log10(scatter))
    within = float(np.ceil(scatter / digit) * digit)
    return float(np.ceil(ends[last] / within) * within), within


def _late_light(archive: xr.Dataset) -> float | None:
    """Return where light begins, m; None where it begins at once or is not seen."""
    begins = (light_begins(*_mean(archive, name)) for name in _channels(archive))
    earliest = min(filter(None, begins), default=0.0)
    return earliest if earliest > _AT_ONCE else None


def without_light(contents: FolderContents, root: Path) -> FolderContents:
    """Return what a folder holds, with groups told apart whose files show no light of a laser."""
    groups = (
        replace(group, purpose=Purpose.UNLIT)
        if group.purpose is Purpose.MEASUREMENT and _is_unlit(group, contents.groups, root)
        else group
        for group in contents.groups
    )
    return replace(contents, groups=tuple(groups))


def _is_unlit(group: FileGroup, groups: Iterable[FileGroup], root: Path) -> bool:
    """Return whether some files of a group show no light, in no channel.

    A few files tell that beside those of the largest group with the same channels alone.
    """
    members = list(zip(group.files, group.headers, strict=True))
    if len(members) < _FEW:
        alike = (g for g in groups if (g.purpose, g.layout) == (group.purpose, group.layout))
        largest = max(alike, key=lambda one: len(one.files))
        members += zip(largest.files, largest.headers, strict=True)
    step = len(members) // (2 * _FEW) or 1
    starts = {path: header.start for path, header in (*members[:_FEW], *members[::step])}
    try:
        paths = [root / path for path in starts]
        unlit = _unlit(open_archive(paths, mask_and_scale=False, header_position="ignore"))
    except LidarOpsError:
        # What cannot be read is refused with its reason when it is processed.
        return False
    # The archive sorts by start, then path.
    ordered = sorted(starts, key=lambda path: (starts[path], path))
    return all(dark for path, dark in zip(ordered, unlit, strict=True) if path in group.files)


def _unlit(archive: xr.Dataset) -> NDArray[np.bool_]:
    """Return which profiles show no light in all channels that tell, (time,)."""
    dark = list(lightless_profiles(archive, None).values())
    unlit: NDArray[np.bool_] = np.all(dark or [np.zeros(archive.sizes["time"], bool)], axis=0)
    return unlit


def _lags(elastic: Iterable[tuple[str, Path]]) -> Iterator[tuple[str, float]]:
    """Yield analog channels, and bins by which they lag in the products of their glued channels."""
    for name, path in elastic:
        if is_glued(name):
            with open_product(path, ("glue_lag",)) as product:
                lags = product["glue_lag"].values
            known = lags[np.isfinite(lags) & (lags != 0.0)]
            if known.size:
                yield file_channels(name)[0], float(np.median(known))


def _sample(headers: InstrumentHeaders) -> list[tuple[str, RawHeader]]:
    """Return some signal files of the day with most hours, equally many of each hour."""
    hours: dict[datetime, dict[int, list[tuple[str, RawHeader]]]]
    hours = defaultdict(lambda: defaultdict(list))
    group = headers.main
    files = zip(group.files, group.headers, strict=True)
    for path, header in sorted(files, key=lambda one: (one[1].start, one[0])):
        midnight = header.start.replace(hour=0, minute=0, second=0, microsecond=0)
        hours[midnight][header.start.hour].append((path, header))
    of_day = max(hours.values(), key=lambda day: (len(day), sum(map(len, day.values()))))
    each = max(_MOST_FILES // len(of_day), 1)
    return [one for files in of_day.values() for one in files[:each]]


def _is_readable(path: Path, header: RawHeader) -> bool:
    """Return whether the counts of a file can be read; others are refused with their reason."""
    try:
        with RawFile(path) as file:
            read_all_counts(file, header)
    except RawFormatError:
        return False
    return True


def _usable_share(path: Path) -> float:
    """Return the share of usable values of a product in the lowest 8 km."""
    names = ("range", "usable", "aerosol_backscatter", "aerosol_extinction")
    with open_product(path, names) as product:
        low = product["range"].values < _HIGHEST
        main = product["aerosol_extinction" if "raman" in path.name else "aerosol_backscatter"]
        usable = np.isfinite(main.values) & (product["usable"].values <= 1)
    shares: Sequence[float] = usable[..., low].mean(axis=-1)
    return float(np.mean(shares))
