"""Look at the data of a folder that no campaign describes yet: some files are processed as drafted.

What gives no usable value is not proposed, and what headers do not state is taken from the data.
"""

from __future__ import annotations

import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
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
from lidarops.errors import LidarOpsError, SceneError
from lidarops.netcdf.read import open_product
from lidarops.raw.archive import open_archive
from lidarops.records import Scene, SceneOutcome, file_channels, is_glued
from lidarops.reports.rejections import rejection_rows
from lidarops.retrieve.signal.light import FEWEST, MEDIAN_OF_NORMAL
from lidarops.run.archive import bring_up_to_date
from lidarops.scene.job import Job
from lidarops.scene.plan import plan_scene
from lidarops.scene.processing import process_scene
from lidarops.scene.profiles import lightless_profiles

_MOST_FILES: Final = 96
"""Files of a look: all of half an hour of minutes, or four of each hour of a day."""
_MOST_DARK: Final = 20
_HIGHEST: Final = 8000.0
"""m; usable values count below."""
_NEAREST: Final = 60.0
_FARTHEST: Final = 3000.0
"""m; signals are expected to stop rising between these."""
_SMOOTH: Final = 60.0
"""m; length of the running mean."""
_FALL: Final = 200.0
"""m; a signal that no longer rises stays below its maximum so long."""
_STEP: Final = 10.0
"""m; multiples of which a full overlap is given as."""
_LATEST: Final = 1000.0
"""m; light of the nearest telescope begins before, unless a record begins before the pulse. Of one
that sees only far air it begins at 750 m."""
_LIGHT: Final = 10.0
"""Standard errors of a bin by which three bins in a row show light."""

_OF_ONE_PROFILE: Final = ("overlap:", "dead_time:", "lag:", "read:")
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
        self.files = _sample(headers)
        dark = [path for group in headers.groups if group.dark for path in group.files]
        for place, paths in (("raw", self.files), ("dark", dark[:_MOST_DARK])):
            for path in paths:
                link = folder / place / path
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to((root / path).resolve())

    def result(self) -> FirstLook:
        full_overlap, begins = self._ranges()
        candidates = [name for names in self.headers.candidates for name in names]
        nitrogen = self.headers.nitrogen_channels
        if begins is not None and begins > _LATEST:
            reason = f"light begins at {begins:.0f} m"
            reasons = dict.fromkeys(candidates, reason)
            return FirstLook(len(self.files), {}, reasons, frozenset(), None, begins)
        products: dict[str, Any] = {
            "elastic": {**self.drafted["instruments"][self.key]["products"]["elastic"]}
        }
        products["elastic"]["channels"] = candidates
        if nitrogen:
            products["raman"] = {"channels": list(nitrogen), "nitrogen": nitrogen}
        scenes = self._processed(products, full_overlap or 0.0)
        shares = {
            channel: share
            for channel, path in self._made(scenes, "elastic")
            if (share := _usable_share(path)) > 0.0
        }
        raman = (name for name, path in self._made(scenes, "raman") if _usable_share(path) > 0.0)
        reasons = {name: self._reason(scenes, name) for name in candidates if name not in shares}
        return FirstLook(len(self.files), shares, reasons, frozenset(raman), full_overlap)

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

    def _ranges(self) -> tuple[float | None, float | None]:
        """Return from where no signal rises any more, and where light begins, m.

        None where signals do not show it.
        """
        # The last one is analog where there is such a record, which counts no pile-up.
        channels = [names[-1] for names in self.headers.candidates]
        scenes = self._processed({"signal": {"channels": channels}}, 0.0)
        ends: dict[str, list[float]] = defaultdict(list)
        begins: list[float] = []
        for channel, path in self._made(scenes, "signal"):
            with open_product(path, ("signal", "range")) as product:
                known = np.isfinite(product["signal"].values)
                total = np.where(known, product["signal"].values, 0.0).sum(axis=0)
                mean = np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
                ranges = np.asarray(product["range"].values, float)
            if (end := rise_ends(ranges, mean)) is not None:
                ends[channel].append(end)
            if (begin := light_begins(ranges, mean)) is not None:
                begins.append(begin)
        earliest = min(begins, default=None)
        if not ends:
            return None, earliest
        farthest = max(float(np.median(found)) for found in ends.values())
        return float(np.ceil(farthest / _STEP) * _STEP), earliest


def empty_in_first_files(
    campaign: Campaign, scenes: Iterable[Scene]
) -> Iterator[tuple[str, str, str, str]]:
    """Yield the products of scenes that their first file leaves without a usable value, and why.

    Product, flag, share of the values and settings, but not what a longer average may change.
    """
    for scene in scenes:
        first = replace(scene, granules=scene.granules[:1])
        with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
            own = campaign.model_copy(update={"output": folder})
            outcome = process_scene(Job(own, first, plan_scene(first, own)))
        empty = tuple(product for product in outcome.products if product.usable == 0)
        for row in rejection_rows([replace(outcome, products=empty)]):
            if row[-1].startswith(_OF_ONE_PROFILE):
                yield row


def without_light(contents: FolderContents, root: Path) -> FolderContents:
    """Return what a folder holds, with groups told apart whose files show no light of a laser."""
    groups = (
        replace(group, purpose=Purpose.UNLIT)
        if group.purpose is Purpose.MEASUREMENT and _is_unlit(group, root)
        else group
        for group in contents.groups
    )
    return replace(contents, groups=tuple(groups))


def _is_unlit(group: FileGroup, root: Path) -> bool:
    """Return whether some files of a group show no light, in no channel."""
    if len(group.files) < FEWEST:
        return False
    paths = [root / path for path in group.files[:: len(group.files) // FEWEST]]
    try:
        archive = open_archive(paths, mask_and_scale=False, header_position="ignore")
        dark = lightless_profiles(archive, None).values()
    except LidarOpsError:
        # What cannot be read is refused with its reason when it is processed.
        return False
    return bool(dark) and all(bool(rows.all()) for rows in dark)


def _sample(headers: InstrumentHeaders) -> list[str]:
    """Return some signal files of the day with most hours, equally many of each hour."""
    hours: dict[datetime, dict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
    group = headers.main
    files = zip(group.files, group.headers, strict=True)
    for path, header in sorted(files, key=lambda one: one[1].start):
        midnight = header.start.replace(hour=0, minute=0, second=0, microsecond=0)
        hours[midnight][header.start.hour].append(path)
    of_day = max(hours.values(), key=lambda day: (len(day), sum(map(len, day.values()))))
    each = max(_MOST_FILES // len(of_day), 1)
    return [path for paths in of_day.values() for path in paths[:each]]


def rise_ends(ranges: Floats, signal: Floats) -> float | None:
    """Return where a range-corrected signal stops rising, m; None where it does not by 3 km.

    Below full overlap a signal rises, and in any air beyond it falls on the mean. It is the first
    place whose running mean no place in the next 200 m exceeds.

    Parameters
    ----------
    ranges : (range,) float
        m.
    signal : (range,) float
        NaN where missing or saturated.
    """
    step = ranges[1] - ranges[0]
    width, ahead = (max(round(float(length / step)), 1) for length in (_SMOOTH, _FALL))
    near = ranges < _FARTHEST + _SMOOTH + _FALL
    values, place = signal[near], ranges[near]
    known = np.isfinite(values)
    weight = np.convolve(known, np.ones(width), "same")
    smooth = np.convolve(np.where(known, values, 0.0), np.ones(width), "same")
    smooth = np.where(weight > 0.5 * width, smooth / np.maximum(weight, 1.0), -np.inf)
    for k in np.flatnonzero((place >= _NEAREST) & (place <= _FARTHEST)):
        beyond = smooth[k + 1 : k + 1 + ahead]
        if np.isfinite(smooth[k]) and smooth[k] > 0.0 and beyond.size and smooth[k] >= beyond.max():
            return float(place[k])
    return None


def light_begins(ranges: Floats, signal: Floats) -> float | None:
    """Return from where a range-corrected signal shows light, m; None where it shows none.

    Parameters
    ----------
    ranges : (range,) float
        m.
    signal : (range,) float
        NaN where missing or saturated, which is light.
    """
    power = signal / np.square(ranges)
    far = power[-power.size // 4 :]
    far = far[np.isfinite(far)]
    if not far.size:
        return None
    noise = np.median(np.abs(np.diff(far))) / (MEDIAN_OF_NORMAL * np.sqrt(2.0))
    light = ~(power <= np.median(far) + _LIGHT * noise)
    first = np.flatnonzero(light[:-2] & light[1:-1] & light[2:])
    return float(ranges[first[0]]) if first.size else None


def _usable_share(path: Path) -> float:
    """Return the share of usable values of a product in the lowest 8 km."""
    names = ("range", "usable", "aerosol_backscatter", "aerosol_extinction")
    with open_product(path, names) as product:
        low = product["range"].values < _HIGHEST
        main = product["aerosol_extinction" if "raman" in path.name else "aerosol_backscatter"]
        usable = np.isfinite(main.values) & (product["usable"].values <= 1)
    shares: Sequence[float] = usable[..., low].mean(axis=-1)
    return float(np.mean(shares))
