"""A simulated campaign: raw Licel files in an archive, and the truth behind them."""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from lidarops.campaign import Campaign
from lidarops.errors import CampaignError
from lidarops.records import DetectionMode, Role
from lidarops.simulate.files import (
    FileTruth,
    Site,
    channel_name,
    dead_time,
    simulate_file,
)
from lidarops.simulate.settings import SimulationSettings

Progress = Callable[[int], None]

_PATTERN = re.compile(r"(?P<folder>(?:[^*?\[\]/]+/)*)(?P<prefix>[A-Za-z][A-Za-z_]{0,9})\*")


@dataclass(frozen=True, slots=True)
class SimulatedCampaign:
    """What a simulation wrote."""

    archive: Path
    paths: tuple[str, ...]
    """Files in the archive, dark ones included, by instrument and time."""
    size: int
    """Bytes of the files."""
    truth: xr.Dataset
    """What a perfect retrieval would find; see `simulate`."""


def simulate(campaign: Campaign, *, progress: Progress | None = None) -> SimulatedCampaign:
    """Write the raw files of a simulated campaign into its archive.

    Parameters
    ----------
    campaign : Campaign
        With a `simulation`. Each simulated instrument needs ``files: <folder>/<prefix>*`` (and
        such `dark_files`, where it has any): folder and prefix name the files to be written.
    progress : callable, optional
        Called with the number of files done since the last call.

    Returns
    -------
    SimulatedCampaign
        Its `truth` has one dimension, ``granule`` (signal files, damaged ones included), and

        - ``path``, ``instrument``, ``time`` (middle of the file, UTC);
        - ``extinction`` (m-1; NaN where the path is not homogeneous), ``homogeneous`` (0 or 1);
        - ``damage`` (empty for good files), ``refused`` (1 where a correct reader must refuse);
        - per channel ``background_<channel>`` (sky light, MHz before dead time, or mV without
          the dark offset), ``amplitude_<channel>`` (B of P = P* + B R^-2 exp(-2 sigma R), MHz m2
          or mV m2) and for analog ``dark_offset_<channel>`` (mV): P* is the background where
          dark files were subtracted, background plus dark offset where not. NaN where the
          instrument has no such channel or the path is not homogeneous.

    Raises
    ------
    CampaignError
        If the campaign has no simulation, the simulation contradicts the campaign, or the
        archive is no local folder or holds files that the campaign would read, but that are
        not of this simulation.

    Notes
    -----
    A file of the same name is overwritten, complete under its final name or not at all. Nothing
    is removed: files of other names that match the patterns of a simulated instrument would mix
    with the simulation unseen, so the archive is refused.
    """
    sites = _sites(campaign)
    archive = Path(campaign.archive)
    if "://" in campaign.archive:
        raise CampaignError(
            "a simulation is written to a local folder",
            file=campaign.archive,
            field="archive",
            remedy="give a path",
        )
    orders = [(site, role, index) for site in sites for role, index in _order(site)]
    paths = tuple(site.name_of(role, index) for site, role, index in orders)
    _refuse_strangers(archive, sites, frozenset(paths))
    for folder in {path.rpartition("/")[0] for path in paths}:
        (archive / folder).mkdir(parents=True, exist_ok=True)

    size = 0
    granules: list[FileTruth] = []
    for site, role, index in orders:
        content, truth = simulate_file(site, role, index)
        _place(archive / truth.path, content)
        size += len(content)
        if role is Role.SIGNAL:
            granules.append(truth)
        if progress:
            progress(1)
    return SimulatedCampaign(archive, paths, size, _truth(campaign, granules))


def _sites(campaign: Campaign) -> list[Site]:
    settings = campaign.simulation
    if settings is None:
        raise CampaignError(
            f"campaign {campaign.name!r} has no simulation",
            field="simulation",
            remedy="see catalogs/demo.yaml for an example",
        )
    sites = [_site(campaign, settings, key) for key in settings.instruments]
    taken: dict[str, str] = {}
    for site in sites:
        for role, folder in site.folder.items():
            stem = folder + site.prefix[role]
            rival = next((key for other, key in taken.items() if _clash(stem, other)), None)
            if rival is not None:
                raise CampaignError(
                    f"its files {stem}* would be taken for those of {rival}",
                    field=f"instruments.{site.key}.files",
                    remedy="give every kind of file a folder or prefix of its own",
                )
            taken[stem] = f"{site.key} ({role.value})"
    return sites


def _clash(stem: str, other: str) -> bool:
    same_folder = stem.rpartition("/")[0] == other.rpartition("/")[0]
    return same_folder and (stem.startswith(other) or other.startswith(stem))


def _site(campaign: Campaign, settings: SimulationSettings, key: str) -> Site:
    if key not in campaign.instruments:
        known = ", ".join(sorted(campaign.instruments))
        raise CampaignError(
            f"instrument {key!r} is simulated, but not in the campaign",
            field=f"simulation.instruments.{key}",
            remedy=f"known: {known}",
        )
    instrument = campaign.instruments[key]
    patterns = {Role.SIGNAL: instrument.files}
    if settings.instruments[key].acquisition.dark_files:
        patterns[Role.DARK] = instrument.dark_files
    places = {role: _place_of(key, role, given) for role, given in patterns.items()}
    site = Site(
        key=key,
        settings=settings,
        instrument=instrument,
        station=campaign.stations[instrument.station],
        folder={role: folder for role, (folder, _) in places.items()},
        prefix={role: prefix for role, (_, prefix) in places.items()},
    )
    # All that can be wrong with the facts is said before the first file is written.
    for role, index in _order(site):
        for detector in site.simulated.detectors:
            if detector.photon is not None:
                name = channel_name(DetectionMode.PHOTON, detector)
                dead_time(site, site.start_of(role, index), name)
    return site


def _place_of(key: str, role: Role, patterns: list[str]) -> tuple[str, str]:
    field = "dark_files" if role is Role.DARK else "files"
    match = _PATTERN.fullmatch(patterns[0]) if len(patterns) == 1 else None
    if match is None:
        raise CampaignError(
            f"{patterns} does not say where to write the simulated files",
            field=f"instruments.{key}.{field}",
            remedy="give one pattern of the form folder/prefix*, such as coast/h*",
        )
    return match["folder"], match["prefix"]


def _order(site: Site) -> Iterator[tuple[Role, int]]:
    """Yield every file of an instrument."""
    for index in range(site.simulated.acquisition.dark_files):
        yield Role.DARK, index
    for index in range(site.settings.files(site.key)):
        yield Role.SIGNAL, index


def _refuse_strangers(archive: Path, sites: list[Site], expected: frozenset[str]) -> None:
    for site in sites:
        for role, folder in site.folder.items():
            found = (archive / folder).glob(f"{site.prefix[role]}*")
            names = {folder + path.name for path in found if path.is_file()}
            strangers = sorted(names - expected)
            if strangers:
                raise CampaignError(
                    f"holds {len(strangers)} files that are not of this simulation, such as"
                    f" {strangers[0]}",
                    file=archive,
                    remedy="remove them, or choose an empty archive",
                )


def _place(path: Path, content: bytes) -> None:
    # No fsync: a simulated file that a power cut loses is written again, byte for byte.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _truth(campaign: Campaign, files: list[FileTruth]) -> xr.Dataset:
    extinction = np.array([file.extinction for file in files])
    damage = [file.damage for file in files]
    truth = xr.Dataset(
        {
            "path": _row([file.path for file in files], "path of the raw file in the archive"),
            "instrument": _row([file.instrument for file in files], "instrument"),
            "time": _row(
                np.array([f.time.replace(tzinfo=None) for f in files], dtype="datetime64[ns]"),
                "middle of the file, UTC",
            ),
            "extinction": _row(
                extinction, "extinction coefficient of air, all of the homogeneous path", "m-1"
            ),
            "homogeneous": _row(
                np.isfinite(extinction).astype(np.int8), "1 where the path is homogeneous", "1"
            ),
            "damage": _row(
                ["" if kind is None else kind.value for kind in damage],
                "what is wrong with the raw file; empty where nothing is",
            ),
            "refused": _row(
                np.array([kind is not None and kind.refused for kind in damage], dtype=np.int8),
                "1 where a correct reader must refuse the raw file",
                "1",
            ),
        },
        attrs={
            "title": f"Truth of the simulated campaign {campaign.name}",
            "comment": "P = P* + B R^-2 exp(-2 sigma R) beyond full overlap, with sigma in"
            " extinction and B in amplitude. P* is the background (sky light) where dark files"
            " were subtracted, background plus dark_offset where not. Photon counting: rates"
            " before dead time.",
        },
    )
    for name in sorted({name for file in files for name in file.channels}):
        for quantity, (long_name, units) in _quantities(name).items():
            values = [
                getattr(file.channels[name], quantity) if name in file.channels else np.nan
                for file in files
            ]
            truth[f"{quantity}_{name}"] = _row(np.array(values), long_name, units)
    return truth


def _quantities(channel: str) -> dict[str, tuple[str, str]]:
    mode, _, label = channel.partition("_")
    analog = mode == DetectionMode.ANALOG
    units = "mV" if analog else "MHz"
    told = {
        "background": (f"sky light, {mode} {label}", units),
        "amplitude": (f"amplitude B of the backscattered signal, {mode} {label}", f"{units} m2"),
    }
    dark = {"dark_offset": (f"signal without any light, {mode} {label}", units)}
    return told | dark if analog else told


def _row(values: object, long_name: str, units: str = "") -> tuple[str, object, dict[str, str]]:
    attrs = {"long_name": long_name} | ({"units": units} if units else {})
    return "granule", values, attrs
