"""Simulate a campaign: write raw Licel files into an archive, and return their truth."""

from __future__ import annotations

import math
import re
import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import xarray as xr

from lidarops.campaign.model import Campaign, Station
from lidarops.campaign.simulated_instrument import DamageKind, PhotonCounter
from lidarops.campaign.simulation import SimulationSettings
from lidarops.errors import CampaignError
from lidarops.records import Role
from lidarops.simulate.files import Simulator
from lidarops.simulate.planned_files import PlannedFile, SimulatedInstrument, photon_dead_time
from lidarops.simulate.truth import FileTruth, TruthTable
from lidarops.system.processes import Processes

Progress = Callable[[int], None]
_Batch = tuple[SimulatedInstrument, Sequence[PlannedFile]]
"""Files of one instrument that are written together."""
_Plan = Sequence[tuple[SimulatedInstrument, Sequence[PlannedFile]]]
"""Every instrument with its files: dark ones first, then signal files in time."""

_BATCH: Final = 64
"""Files that one worker writes at a time."""

_FLAT_EARTH_LIMIT: Final = 300e3
"""m, largest distance of a station from the origin in horizontally varying air."""

_PATTERN = re.compile(r"(?P<folder>(?:[^*?\[\]/]+/)*)(?P<prefix>[A-Za-z][A-Za-z_]{0,9})\*")


@dataclass(frozen=True, slots=True)
class SimulatedCampaign:
    """Files and truth that a simulation wrote."""

    archive: Path
    paths: tuple[str, ...]
    """Files in the archive, dark ones included, by instrument and time."""
    truth: xr.Dataset
    """True values of every signal file; see `simulate_campaign`."""


def simulate_campaign(
    campaign: Campaign,
    *,
    workers: int = 1,
    progress: Progress | None = None,
    expect: Progress | None = None,
) -> SimulatedCampaign:
    """Write the raw files of a simulated campaign into its archive.

    Parameters
    ----------
    campaign : Campaign
        With a `simulation`. Each simulated instrument needs ``files: <folder>/<prefix>*`` (and
        such `dark_files`, where it has any): folder and prefix name the files to be written.
    workers : int, optional
        Number of local processes that write the files; by default this process does.
    progress : callable, optional
        Called with the number of files written since the last call.
    expect : callable, optional
        Called with the number of files, before the first one is written.

    Returns
    -------
    SimulatedCampaign
        Its `truth` has one row (dimension ``granule``) per signal file, damaged files included:

        - ``path``, ``instrument``, ``time`` (middle of the file, true UTC);
        - ``zenith_angle``, ``azimuth`` (degree), ``clock_error`` (s), ``energy`` (of the laser,
          relative);
        - ``total_extinction`` (m-1; NaN if the path is not homogeneous, or channels differ),
          ``homogeneous`` (0 or 1);
        - ``damage`` (empty for good files), ``handling`` (correct handling of the damage),
          ``refused`` (1 if a correct reader must refuse the file);
        - per channel ``background_<channel>`` (sky light, MHz before dead time, or mV without
          the dark offset), ``amplitude_<channel>`` (B of P = P* + B R^-2 exp(-2 sigma R), MHz m2
          or mV m2) and for analog ``dark_offset_<channel>`` (mV): P* is the background if dark
          files were subtracted, else background plus dark offset. NaN if the instrument has no
          such channel or the path is not homogeneous;
        - for paths that are not homogeneous ``profile_total_extinction_<key>``,
          ``profile_total_backscatter_<key>`` and ``profile_path_optical_depth_<key>`` (profile,
          wavelength, range), with their rows in ``profile_granule_<key>``.

    Raises
    ------
    CampaignError
        If the campaign has no simulation, the simulation contradicts the campaign, the archive
        is not a local folder, or it holds other files that the campaign would read.

    Notes
    -----
    A file of the same name is replaced as a whole or not at all. Nothing is removed. An archive
    with other files that match the patterns of a simulated instrument is refused, because they
    would mix with the simulated ones unnoticed. The bytes of a file depend only on the seed, its
    instrument and its number, not on order, batches or workers. Memory holds the names of the
    files and their truth.
    """
    plan = _plan(campaign)
    archive, paths = Path(campaign.archive), [file.path for _, files in plan for file in files]
    _refuse_foreign_files(archive, [site for site, _ in plan], frozenset(paths))
    for folder in {path.rpartition("/")[0] for path in paths}:
        (archive / folder).mkdir(parents=True, exist_ok=True)
    if expect:
        expect(len(paths))
    rows = sum(planned.role is Role.SIGNAL for _, files in plan for planned in files)
    table = TruthTable(rows, {site.key: Simulator(site).grid for site, _ in plan})
    with Processes(workers, archive) as processes:
        for (_, files), truths in processes.map_items(_write_batch, _batches(plan), at_a_time=1):
            for file_truth in truths:
                table.add(file_truth)
            if progress:
                progress(len(files))
    return SimulatedCampaign(archive, tuple(paths), table.dataset(campaign.name))


def _plan(campaign: Campaign) -> _Plan:
    """Return the files to write, after all checks but those of the archive."""
    if "://" in campaign.archive:
        raise CampaignError(
            "a simulation is written to a local folder",
            file=campaign.archive,
            field="archive",
            remedy="give a path",
        )
    plan = [(site, tuple(site.planned_files())) for site in _sites(campaign)]
    for site, planned_files in plan:
        _check_air(site)
        _check_facts(site, planned_files)
        _check_names(site, planned_files)
    return plan


def _batches(plan: _Plan) -> Iterator[_Batch]:
    for site, files in plan:
        for first in range(0, len(files), _BATCH):
            yield site, files[first : first + _BATCH]


def _write_batch(archive: Path, batch: _Batch) -> list[FileTruth]:
    """Write some files, and return the truth of the signal files."""
    site, files = batch
    simulator = Simulator(site)
    truths = []
    for planned in files:
        content, truth = simulator.simulate(planned)
        _write_whole(archive / planned.path, content)
        if planned.role is Role.SIGNAL:
            truths.append(truth)
    return truths


def _sites(campaign: Campaign) -> list[SimulatedInstrument]:
    settings = campaign.simulation
    if settings is None:
        raise CampaignError(
            f"campaign {campaign.name!r} has no simulation",
            field="simulation",
            remedy="see catalogs/demo.yaml for an example",
        )
    sites = [_site(campaign, settings, key) for key in settings.instruments]
    owners: dict[str, str] = {}
    for site in sites:
        for role, folder in site.folder.items():
            stem = folder + site.prefix[role]
            owner = next((key for other, key in owners.items() if _clash(stem, other)), None)
            if owner is not None:
                raise CampaignError(
                    f"its files {stem}* would be taken for those of {owner}",
                    field=f"instruments.{site.key}.files",
                    remedy="give every kind of file a folder or prefix of its own",
                )
            owners[stem] = f"{site.key} ({role.value})"
    return sites


def _clash(stem: str, other: str) -> bool:
    same_folder = stem.rpartition("/")[0] == other.rpartition("/")[0]
    return same_folder and (stem.startswith(other) or other.startswith(stem))


def _site(campaign: Campaign, settings: SimulationSettings, key: str) -> SimulatedInstrument:
    if key not in campaign.instruments:
        known = ", ".join(sorted(campaign.instruments))
        raise CampaignError(
            f"instrument {key!r} is simulated, but not in the campaign",
            field=f"simulation.instruments.{key}",
            remedy=f"known: {known}",
        )
    instrument = campaign.instruments[key]
    simulated = settings.instruments[key]
    patterns = {Role.SIGNAL: instrument.files}
    if simulated.acquisition.dark_files:
        patterns[Role.DARK] = instrument.dark_files
    places = {role: _place_of(key, role, globs) for role, globs in patterns.items()}
    station = campaign.stations[instrument.station]
    return SimulatedInstrument(
        key=key,
        settings=settings,
        instrument=instrument,
        station=station,
        origin=station if simulated.atmosphere else _origin(campaign, settings),
        folder={role: folder for role, (folder, _) in places.items()},
        prefix={role: prefix for role, (_, prefix) in places.items()},
        damage={damage.index: damage.kind for damage in simulated.damage},
    )


def _origin(campaign: Campaign, settings: SimulationSettings) -> Station:
    key = settings.origin or next(iter(campaign.stations))
    if key not in campaign.stations:
        raise CampaignError(
            f"station {key!r} is not in the campaign",
            field="simulation.origin",
            remedy=f"known: {', '.join(sorted(campaign.stations))}",
        )
    return campaign.stations[key]


def _check_air(site: SimulatedInstrument) -> None:
    air = site.settings.air_of(site.key)
    east, north, _ = site.position
    distance = math.hypot(east, north)
    if distance > _FLAT_EARTH_LIMIT and (air.gradients or air.plumes or air.turbulence):
        raise CampaignError(
            f"stands {distance / 1e3:.0f} km from the origin of horizontally varying air: the"
            f" simulation takes the Earth as flat, up to {_FLAT_EARTH_LIMIT / 1e3:.0f} km",
            field=f"simulation.instruments.{site.key}",
            remedy="give it an atmosphere of its own, or a nearer station as simulation.origin",
        )


def _check_facts(site: SimulatedInstrument, files: Iterable[PlannedFile]) -> None:
    """Check the facts at every file before the first file is written."""
    field = f"instruments.{site.key}.facts"
    if site.scan is not None:
        if not site.dialect.holds_azimuth:
            raise CampaignError(
                f"headers of the {site.simulated.acquisition.dialect} dialect do not hold the"
                " azimuth of a scan",
                field=f"simulation.instruments.{site.key}.acquisition.dialect",
                remedy="use the dialect licel or raymetrics_scan for scans",
            )
        if any(fact.zenith_angle is not None for fact in site.instrument.facts):
            raise CampaignError(
                "give one zenith angle for a scanning lidar, and facts override headers",
                field=f"{field}.zenith_angle",
                remedy="leave zenith_angle and azimuth out of the facts",
            )
    elif site.dialect.scans:
        raise CampaignError(
            f"the {site.simulated.acquisition.dialect} dialect states a scan, but there is none",
            field=f"simulation.instruments.{site.key}.scan",
            remedy="give the zenith angles of a scan, or use another dialect",
        )
    counted = [
        name
        for detector in site.simulated.detectors
        for name, recorder in detector.recorders.items()
        if isinstance(recorder, PhotonCounter)
    ]
    for planned in files:
        for name in counted:
            photon_dead_time(site, planned.start, name)
        if planned.damage is DamageKind.ZENITH_MINUS_90:
            _check_vertical(site, planned)
        if planned.damage is DamageKind.STALE_POINTING and not site.dialect.scans:
            raise CampaignError(
                "stale_pointing needs the grid of a scan in the headers",
                field=f"simulation.instruments.{site.key}.damage",
                remedy="use the dialect raymetrics_scan, or another damage",
            )


def _check_vertical(site: SimulatedInstrument, planned: PlannedFile) -> None:
    facts = site.instrument.facts_at(planned.start)
    if site.pointing_of(planned, facts)[0] and facts.zenith_angle is None:
        raise CampaignError(
            f"file {planned.index} is not vertical: zenith_minus_90 would falsify it unnoticed",
            field=f"simulation.instruments.{site.key}.damage",
            remedy="use this damage on vertical files, or give zenith_angle in the facts",
        )


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


def _check_names(site: SimulatedInstrument, files: Iterable[PlannedFile]) -> None:
    # Those of other instruments have another folder or prefix.
    for path, uses in Counter(planned.path for planned in files).most_common(1):
        if uses > 1:
            raise CampaignError(
                f"two files of {site.key} would have the name {path}",
                field=f"simulation.instruments.{site.key}.acquisition",
                remedy="take files at longer intervals, or change the jumps of the clock",
            )


def _refuse_foreign_files(
    archive: Path, sites: Sequence[SimulatedInstrument], expected: frozenset[str]
) -> None:
    for site in sites:
        for role, folder in site.folder.items():
            matches = (archive / folder).glob(f"{site.prefix[role]}*")
            names = {folder + path.name for path in matches if path.is_file()}
            foreign = sorted(names - expected)
            if foreign:
                raise CampaignError(
                    f"holds {len(foreign)} files that this simulation does not write, such as"
                    f" {foreign[0]}",
                    file=archive,
                    remedy="remove them, or choose an empty archive",
                )


def _write_whole(path: Path, content: bytes) -> None:
    # No fsync: a file that a power cut loses can be simulated again, byte for byte.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
