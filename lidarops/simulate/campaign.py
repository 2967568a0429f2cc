"""A simulated campaign: raw Licel files in an archive, and the truth behind them."""

from __future__ import annotations

import math
import re
import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

import xarray as xr

from lidarops.campaign.model import Campaign, Station
from lidarops.campaign.simulation import DamageKind, SimulationSettings
from lidarops.errors import CampaignError, CatalogError
from lidarops.records import DetectionMode, Role
from lidarops.simulate.files import Simulator
from lidarops.simulate.site import Order, Site, channel_name, dead_time
from lidarops.simulate.truth import FileTruth, TruthTable

if TYPE_CHECKING:
    from distributed import Client, Future

Progress = Callable[[int], None]

_BATCH: Final = 64
"""Files that one worker writes at a time."""

_QUEUE: Final = 4
"""Batches that wait for each worker: the work to come is never listed as a whole."""

_FLAT: Final = 300e3
"""m, up to which stations may share air that changes along the ground."""

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
    """What a perfect retrieval would find; see `simulate_campaign`."""


@dataclass(frozen=True, slots=True)
class SimulationPlan:
    """Every file that a simulation will write."""

    campaign: Campaign
    sites: tuple[Site, ...]
    orders: tuple[tuple[Order, ...], ...]
    """Of each site, dark files first, then in time."""
    paths: tuple[str, ...]
    """In the archive, by site and in the same order."""


@dataclass(frozen=True, slots=True)
class _Batch:
    """Files of one instrument that are written together, and their rows in the truth."""

    site: Site
    orders: tuple[Order, ...]
    rows: tuple[int | None, ...]
    """None for dark files."""


@dataclass(frozen=True, slots=True)
class _Written:
    """What became of a batch."""

    files: int
    size: int
    truths: tuple[tuple[int, FileTruth], ...]


def simulate_campaign(
    campaign: Campaign, *, client: Client | None = None, progress: Progress | None = None
) -> SimulatedCampaign:
    """Write the raw files of a simulated campaign into its archive.

    Parameters
    ----------
    campaign : Campaign
        With a `simulation`. Each simulated instrument needs ``files: <folder>/<prefix>*`` (and
        such `dark_files`, where it has any): folder and prefix name the files to be written.
    client : distributed.Client, optional
        Whose workers write the files, all into the same folder; this process where not given.
    progress : callable, optional
        Called with the number of files done since the last call.

    Returns
    -------
    SimulatedCampaign
        Its `truth` has one row (dimension ``granule``) for each signal file, damaged ones
        included:

        - ``path``, ``instrument``, ``time`` (middle of the file, UTC, by the true time);
        - ``zenith_angle``, ``azimuth`` (degree), ``clock_error`` (s), ``energy`` (of the laser,
          relative);
        - ``extinction`` (m-1; NaN where the path is not homogeneous, or not the same for all
          channels), ``homogeneous`` (0 or 1);
        - ``damage`` (empty for good files), ``handling`` (what a correct chain does with it),
          ``refused`` (1 where a correct reader must refuse);
        - per channel ``background_<channel>`` (sky light, MHz before dead time, or mV without
          the dark offset), ``amplitude_<channel>`` (B of P = P* + B R^-2 exp(-2 sigma R), MHz m2
          or mV m2) and for analog ``dark_offset_<channel>`` (mV): P* is the background where
          dark files were subtracted, background plus dark offset where not. NaN where the
          instrument has no such channel or the path is not homogeneous;
        - for instruments that do not look along homogeneous paths ``profile_extinction_<key>``,
          ``profile_backscatter_<key>`` and ``profile_optical_depth_<key>`` (profile, wavelength,
          range), with the rows they belong to in ``profile_granule_<key>``.

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
    with the simulation unseen, so the archive is refused. The bytes of a file depend on the seed,
    its instrument and its number alone, never on order, batches or workers. Memory holds the
    names of the files and their truth.
    """
    return write_simulation(plan_simulation(campaign), client=client, progress=progress)


def plan_simulation(campaign: Campaign) -> SimulationPlan:
    """Return which files `simulate_campaign` would write, after checking that it can.

    Raises
    ------
    CampaignError
        As `simulate_campaign`, but for what is in the archive.
    """
    if "://" in campaign.archive:
        raise CampaignError(
            "a simulation is written to a local folder",
            file=campaign.archive,
            field="archive",
            remedy="give a path",
        )
    sites = _sites(campaign)
    orders = tuple(tuple(site.orders()) for site in sites)
    for site, own in zip(sites, orders, strict=True):
        _check_air(site)
        _check_facts(site, own)
    return SimulationPlan(campaign, tuple(sites), orders, _paths(sites, orders))


def write_simulation(
    planned: SimulationPlan, *, client: Client | None = None, progress: Progress | None = None
) -> SimulatedCampaign:
    """Write the files of a plan; see `simulate_campaign`."""
    archive = Path(planned.campaign.archive)
    _refuse_strangers(archive, planned.sites, frozenset(planned.paths))
    for folder in {path.rpartition("/")[0] for path in planned.paths}:
        _make(archive / folder)
    rows = sum(order.role is Role.SIGNAL for own in planned.orders for order in own)
    table = TruthTable(rows, {site.key: Simulator(site).grid for site in planned.sites})
    size = 0
    work = _batches(planned)
    done = _serial(work, archive) if client is None else _distributed(work, archive, client)
    for written in done:
        size += written.size
        for row, truth in written.truths:
            table.add(row, truth)
        if progress:
            progress(written.files)
    told = table.dataset(planned.campaign.name)
    return SimulatedCampaign(archive, planned.paths, size, told)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CatalogError(
            f"cannot be made: {error.strerror}",
            file=folder,
            field="archive",
            remedy="give a folder that can be written",
        ) from error


def _batches(planned: SimulationPlan) -> Iterator[_Batch]:
    row = 0
    for site, orders in zip(planned.sites, planned.orders, strict=True):
        for first in range(0, len(orders), _BATCH):
            chosen = orders[first : first + _BATCH]
            rows: list[int | None] = []
            for order in chosen:
                rows.append(row if order.role is Role.SIGNAL else None)
                row += order.role is Role.SIGNAL
            yield _Batch(site, chosen, tuple(rows))


def _serial(work: Iterable[_Batch], archive: Path) -> Iterator[_Written]:
    simulator: Simulator | None = None
    for batch in work:
        if simulator is None or simulator.site is not batch.site:
            simulator = Simulator(batch.site)
        for order, row in zip(batch.orders, batch.rows, strict=True):
            yield _write(simulator, [(order, row)], archive)


def _distributed(work: Iterable[_Batch], archive: Path, client: Client) -> Iterator[_Written]:
    from distributed import as_completed  # noqa: PLC0415 - takes a second to import

    workers = max(1, len(client.scheduler_info()["workers"]))
    waiting = iter(work)
    futures = [_submit(client, batch, archive) for batch in islice(waiting, _QUEUE * workers)]
    stream = as_completed(futures)
    try:
        for future in stream:
            yield future.result()
            future.release()
            for batch in islice(waiting, 1):
                stream.add(_submit(client, batch, archive))
    finally:
        client.cancel(list(stream.futures))


def _submit(client: Client, batch: _Batch, archive: Path) -> Future[_Written]:
    return client.submit(_write_batch, batch, archive, pure=False)


def _write_batch(batch: _Batch, archive: Path) -> _Written:
    work = list(zip(batch.orders, batch.rows, strict=True))
    return _write(Simulator(batch.site), work, archive)


def _write(
    simulator: Simulator, work: Sequence[tuple[Order, int | None]], archive: Path
) -> _Written:
    size = 0
    truths = []
    for order, row in work:
        content, truth = simulator.file(order)
        _place(archive / truth.path, content)
        size += len(content)
        if row is not None:
            truths.append((row, truth))
    return _Written(len(work), size, tuple(truths))


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
    simulated = settings.instruments[key]
    patterns = {Role.SIGNAL: instrument.files}
    if simulated.acquisition.dark_files:
        patterns[Role.DARK] = instrument.dark_files
    places = {role: _place_of(key, role, given) for role, given in patterns.items()}
    station = campaign.stations[instrument.station]
    return Site(
        key=key,
        settings=settings,
        instrument=instrument,
        station=station,
        origin=station if simulated.air else _origin(campaign, settings),
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


def _check_air(site: Site) -> None:
    air = site.settings.air_of(site.key)
    east, north, _ = site.position
    away = math.hypot(east, north)
    if away > _FLAT and (air.gradients or air.plumes or air.turbulence):
        raise CampaignError(
            f"stands {away / 1e3:.0f} km from the origin of air that changes along the ground:"
            f" the Earth is flat here, which holds up to {_FLAT / 1e3:.0f} km",
            field=f"simulation.instruments.{site.key}",
            remedy="give it an atmosphere of its own, or simulation.origin a nearer station",
        )


def _check_facts(site: Site, orders: Iterable[Order]) -> None:
    """Say all that can be wrong with the facts before the first file is written."""
    field = f"instruments.{site.key}.facts"
    if site.simulated.pointing is not None:
        if not site.dialect.holds_azimuth:
            raise CampaignError(
                f"headers of the {site.simulated.acquisition.dialect} dialect do not hold where"
                " a scan looks",
                field=f"simulation.instruments.{site.key}.acquisition.dialect",
                remedy="scan with the dialect licel",
            )
        if any(fact.zenith_angle is not None for fact in site.instrument.facts):
            raise CampaignError(
                "give one zenith angle for a lidar that scans, and the facts win over headers",
                field=f"{field}.zenith_angle",
                remedy="leave zenith_angle and azimuth out",
            )
    counted = [
        channel_name(DetectionMode.PHOTON, detector)
        for detector in site.simulated.detectors
        if detector.photon is not None
    ]
    for order in orders:
        start = site.start_of(order.role, order.index)
        for name in counted:
            dead_time(site, start, name)
        if site.damage_of(order.index) is DamageKind.ZENITH_MINUS_90:
            _check_vertical(site, order)


def _check_vertical(site: Site, order: Order) -> None:
    facts = site.instrument.facts_at(site.start_of(order.role, order.index))
    if site.pointing_of(order, facts)[0] and facts.zenith_angle is None:
        raise CampaignError(
            f"file {order.index} does not look up: zenith_minus_90 would make it wrong unseen",
            field=f"simulation.instruments.{site.key}.damage",
            remedy="damage a vertical file in this way, or give zenith_angle in the facts",
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


def _paths(sites: Sequence[Site], orders: Sequence[Sequence[Order]]) -> tuple[str, ...]:
    paths: dict[str, None] = {}
    for site, own in zip(sites, orders, strict=True):
        for order in own:
            path = site.path_of(order)
            if path in paths:
                raise CampaignError(
                    f"two files of {site.key} would have the name {path}",
                    field=f"simulation.instruments.{site.key}.acquisition",
                    remedy="take files at longer intervals, or let the clock jump by another step",
                )
            paths[path] = None
    return tuple(paths)


def _refuse_strangers(archive: Path, sites: Sequence[Site], expected: frozenset[str]) -> None:
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
