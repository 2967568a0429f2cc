"""The campaign file, a YAML file written by a person, as validated models.

`load_campaign` reads it. Most settings have a default. Facts about an instrument have validity
periods, because instruments change within an archive of years.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from datetime import UTC, datetime, timedelta
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

import yaml
from pydantic import (
    Field,
    PrivateAttr,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError

from lidarops.campaign.atmosphere import AtmosphereSource
from lidarops.campaign.simulation import SimulationSettings
from lidarops.campaign.yaml_errors import (
    Loader,
    duplicate_keys,
    explain_yaml_error,
    with_plain_numbers,
    with_quantities,
)
from lidarops.errors import CampaignError
from lidarops.kinds import Scope, kinds_of
from lidarops.records import file_channels
from lidarops.settings import (
    NO_UNIT,
    ChannelProduct,
    Identifier,
    Inside,
    Instant,
    Interval,
    Metres,
    NetworkProduct,
    Patterns,
    SettingsModel,
    located_error,
    nearest,
    ordered,
    quantity,
)
from lidarops.system.stores import refuse_keys

__all__ = [
    "Campaign",
    "ChannelFacts",
    "Instrument",
    "InstrumentFacts",
    "Metadata",
    "Network",
    "Products",
    "Scenes",
    "Station",
    "campaign_schema",
    "channel_facts",
    "editor_schema",
    "load_campaign",
]

ARCHIVE_VARIABLE = "LIDAROPS_ARCHIVE"
CATALOG_VARIABLE = "LIDAROPS_CATALOG"
OPERATION: Final = frozenset(
    {"archive", "output", "catalog", "superseded", "simulation", "periods", "vanished_share",
     "acknowledged"}
)  # fmt: skip
"""Settings of a campaign that change neither the scenes nor the content of a product."""


class Station(SettingsModel):
    """A site of instruments."""

    name: str = Field(description="in words, for products and pages")
    latitude: float = quantity(unit="degree", ge=-90, le=90, description="north")
    longitude: float = quantity(unit="degree", ge=-180, le=180, description="east")
    altitude: float = quantity(0.0, unit="m", ge=-500, le=9000, description="above the geoid")
    wigos_station_id: str = Field(
        default="",
        pattern=r"^(\d-\d{1,5}-\d{1,5}-[0-9A-Za-z]{1,16})?$",
        description="WIGOS station identifier, such as 0-20000-0-33837",
    )


_DeadTime = Annotated[float, Field(ge=1e-10, le=2e-7)]


class ChannelFacts(SettingsModel):
    """Facts about one channel in a validity period."""

    recorder: str | None = Field(
        default=None,
        min_length=1,
        description="such as BT5, by default that of the name in the files with most recorders",
    )
    wavelength: float | None = quantity(
        None, unit="m", gt=1e-7, lt=2e-5, description="where the header is wrong"
    )
    dead_time: _DeadTime | Literal[0, "estimate"] | None = quantity(
        None,
        unit="s",
        description="time after a photon in which the counter is blind, from its data sheet; 0 of"
        " counts that are corrected in the files; or 'estimate', against the analog channel of the"
        " same detector",
    )
    dead_time_uncertainty: float | None = quantity(
        None, unit="1", ge=0, le=1, description="relative standard error of dead_time; 0.2 if none"
    )
    range_offset: float | None = quantity(
        None, unit="m", ge=-500, le=500, description="added to the range of every bin"
    )
    noise_variance: float | None = quantity(
        None,
        unit="mV2",
        gt=0,
        allow_inf_nan=False,
        description="analog noise variance of one profile",
    )
    baseline_uncertainty: float | None = quantity(
        None,
        unit="mV",
        ge=0,
        le=10,
        description="standard error of the analog baseline; if none, as dark files or blocked"
        " beams show it, or 0.02 mV and 0.075 % of the largest voltage",
    )
    lag: Annotated[float, Field(ge=-100, le=100)] | Literal["estimate"] | None = quantity(
        None,
        unit="1",
        description="bins by which the analog record lags the photon-counting record of"
        " the same detector, besides range_offset; or 'estimate'; for glued channels, of which it"
        " is estimated by default",
    )
    water_vapour_calibration: float | None = quantity(
        None,
        unit="kg kg-1",
        gt=0,
        allow_inf_nan=False,
        description="of a Raman channel of water vapour: mixing ratio per ratio of its signal to"
        " that of nitrogen",
    )
    water_vapour_calibration_error: float | None = quantity(
        None,
        unit="kg kg-1",
        ge=0,
        allow_inf_nan=False,
        description="standard error of water_vapour_calibration, which needs it",
    )
    lidar_ratio: float | None = quantity(
        None,
        unit="sr",
        ge=1,
        le=200,
        description="of particles, instead of that of elastic; for a glued channel, that of its"
        " photon-counting channel",
    )
    lidar_ratio_standard_error: float | None = quantity(
        None, unit="sr", ge=0, le=100, description="of lidar_ratio, instead of that of elastic"
    )
    lidar_ratio_profile: Inside | None = Field(
        default=None,
        description="in place of both: CSV or NetCDF file of altitude (m above mean sea level),"
        " lidar_ratio and lidar_ratio_standard_error (sr), or a product raman, whose mean over time"
        " is used; beyond its altitudes, the end values hold",
    )

    @model_validator(mode="after")
    def _one_lidar_ratio(self) -> Self:
        both = (self.lidar_ratio, self.lidar_ratio_standard_error)
        if self.lidar_ratio_profile is not None and both != (None, None):
            raise ValueError(
                "lidar_ratio_profile is given together with lidar_ratio or its standard error; give"
                " one of the two"
            )
        return self

    @model_validator(mode="after")
    def _calibration_with_error(self) -> Self:
        if self.water_vapour_calibration and self.water_vapour_calibration_error is None:
            raise ValueError(
                "water_vapour_calibration is given without water_vapour_calibration_error; give its"
                " standard error in kg kg-1"
            )
        return self


class InstrumentFacts(SettingsModel):
    """Facts about an instrument in a validity period."""

    valid_from: Instant = Field(
        default=datetime.min.replace(tzinfo=UTC), description="first time to which the facts apply"
    )
    valid_to: Instant = Field(
        default=datetime.max.replace(tzinfo=UTC), description="end of the period, not included"
    )
    invalid: str | None = Field(
        default=None,
        pattern=r"\S",
        description="why no product is made of the files of the period, in words; they stay in"
        " catalog and reports",
    )
    zenith_angle: float | None = quantity(
        None,
        unit="degree",
        ge=0,
        le=180,
        description="of the beam, 0 upwards, 90 horizontal; by default that of the headers",
    )
    azimuth: float | None = quantity(
        None,
        unit="degree",
        ge=0,
        lt=360,
        description="of the beam, clockwise from north; by default that of the headers",
    )
    clock_offset: float = quantity(
        0.0,
        unit="s",
        ge=-86400,
        le=86400,
        description="clock of the raw files minus UTC; -18000 for files in the time of UTC-5",
    )
    pre_trigger: float = quantity(
        0.0,
        unit="m",
        ge=0,
        le=1e5,
        description="range of the record at which the pulse leaves; the bins before give the"
        " background where they are enough, and are in no product",
    )
    full_overlap_range: Metres = quantity(
        0.0,
        unit="m",
        description="range from which the telescope receives the whole beam; nearer values are"
        " flagged or left out",
    )
    full_overlap_assumed: bool = Field(
        default=False,
        description="whether nobody has checked full_overlap_range; plans and products state it",
    )
    overlap_profile: Inside | None = Field(
        default=None,
        description="CSV or NetCDF file of range (m) and overlap (0 to 1), or a product raman,"
        " whose mean over time is used",
    )
    molecular_profile: Inside | None = Field(
        default=None,
        description="CSV or NetCDF file of altitude (m), pressure (Pa or hPa), temperature (K); its"
        " path is relative to the campaign file",
    )
    channels: dict[str, ChannelFacts] = Field(
        default={}, description="facts about channels, by their names such as photon_532o"
    )

    _ordered = ordered("valid_from", "valid_to", "valid_to must be later than valid_from")

    @model_validator(mode="after")
    def _one_role_of_each_file(self) -> Self:
        ratios = {channel.lidar_ratio_profile for channel in self.channels.values()}
        for name in ({self.overlap_profile, self.molecular_profile} | ratios) - {None}:
            roles = {
                "overlap_profile": name == self.overlap_profile,
                "molecular_profile": name == self.molecular_profile,
                "lidar_ratio_profile": name in ratios,
            }
            given = [role for role, named in roles.items() if named]
            if len(given) > 1:
                raise ValueError(f"{' and '.join(given)} name the same file, {name}")
        return self


NO_FACTS: Final = InstrumentFacts()
"""Facts of the times that no period holds."""


def _fields(*scopes: Scope) -> dict[str, Any]:
    """Return the definition of one optional field for every kind of product of some scopes."""
    return {
        kind.name: (kind.settings | None, Field(default=None, description=kind.title))
        for kind in kinds_of(*scopes)
    }


class ChannelProducts(SettingsModel):
    """The requested products of an instrument; `Products` has a field for every kind."""

    @cached_property
    def requested(self) -> dict[str, ChannelProduct]:
        """The settings of each requested kind of product, by its name."""
        return {
            name: settings
            for name in type(self).model_fields
            if (settings := getattr(self, name)) is not None
        }


if TYPE_CHECKING:
    Products = ChannelProducts
else:
    Products = create_model(
        "Products",
        __base__=ChannelProducts,
        __doc__="The requested products of an instrument.",
        **_fields(Scope.CHANNEL, Scope.MONTH),
    )


class Instrument(SettingsModel):
    """A lidar: its station, its files, the facts about it and its requested products."""

    station: Identifier = Field(description="key of one of stations")
    name: str = Field(default="", description="in words, for products and pages")
    files: Patterns = Field(
        description="patterns of the raw files below archive, as of a shell: *, ?, [67], {a,b}; **"
        " crosses folders"
    )
    dark_files: Patterns = Field(
        default=[], description="patterns of the files with a covered telescope"
    )
    header_position: Literal["longitude_first", "latitude_first", "ignore"] = Field(
        default="longitude_first",
        description="order of the coordinates in headers; with ignore, a header may state any"
        " position and altitude",
    )
    header_pointing: Literal["stated", "elevation", "zenith_angle"] = Field(
        default="stated",
        description="angle in headers that state no scan: elevation, of any sign; zenith_angle,"
        " negative on the opposite side; stated: the latter, but -90 upwards, others refused",
    )
    name_times: Literal["checked", "ignored"] = Field(
        default="checked",
        description="whether a start is refused that contradicts the time in the name of its file",
    )
    position_tolerance: float = quantity(
        0.5,
        unit="degree",
        ge=0,
        le=180,
        description="largest difference between headers and station in latitude and longitude",
    )
    altitude_tolerance: float = quantity(
        100.0,
        unit="m",
        ge=0,
        le=1e4,
        description="largest difference between headers and station in altitude",
    )
    facts: list[InstrumentFacts] = Field(
        default=[InstrumentFacts()],
        min_length=1,
        description="about the instrument, one entry for each period; files outside all of them"
        " are refused",
    )
    products: Products = Products()

    @model_validator(mode="after")
    def _disjoint(self) -> Self:
        periods = sorted((fact.valid_from, fact.valid_to) for fact in self.facts)
        for (_, stop), (start, _) in pairwise(periods):
            if start < stop:
                raise ValueError(f"the validity periods of facts overlap at {start:%Y-%m-%d}")
        return self

    def facts_at(self, moment: datetime, *, by_clock: bool = False) -> InstrumentFacts:
        """Return the facts of a time, UTC or by the clock of the instrument.

        `NO_FACTS` where it is in none of the periods: its files are refused.
        """
        for fact in self.facts:
            behind = timedelta(seconds=fact.clock_offset if by_clock else 0.0)
            if fact.valid_from <= moment - behind < fact.valid_to:
                return fact
        return NO_FACTS


class NetworkMembers(SettingsModel):
    """Instruments whose beams cross, and the products that are retrieved from them together.

    `Network` has a field for every kind of product of a network.
    """

    name: str = Field(default="", description="in words, for products and pages")
    instruments: list[Identifier] = Field(
        min_length=2, description="keys of the instruments whose beams cross"
    )

    @model_validator(mode="after")
    def _fitting_instruments(self) -> Self:
        if len(set(self.instruments)) < len(self.instruments):
            raise ValueError("instruments lists an instrument twice")
        if not self.requested:
            kinds = ", ".join(kind.name for kind in kinds_of(Scope.NETWORK))
            raise ValueError(f"a network needs a product: {kinds}")
        for kind, settings in self.requested.items():
            try:
                settings.check_members(self.instruments)
            except PydanticCustomError as error:
                keys = (error.context or {}).get("keys", ())
                raise located_error(error.message(), kind, *keys) from error
            except ValueError as error:
                raise located_error(str(error), kind) from error
        return self

    @cached_property
    def requested(self) -> dict[str, NetworkProduct]:
        """The settings of each requested kind of product, by its name."""
        return {
            kind.name: settings
            for kind in kinds_of(Scope.NETWORK)
            if (settings := getattr(self, kind.name)) is not None
        }


if TYPE_CHECKING:
    Network = NetworkMembers
else:
    Network = create_model(
        "Network",
        __base__=NetworkMembers,
        __doc__="Instruments whose beams cross, and the products that are made of them together.",
        **_fields(Scope.NETWORK),
    )


class Metadata(SettingsModel):
    """Creator, publisher and terms of use: global attributes of every product (ACDD-1.3).

    Products lack the attributes of what is not given.
    """

    institution: str = Field(default="", description="of the creator")
    project: str = Field(default="", description="in which the data were taken")
    creator_name: str = Field(default="", description="who made the data")
    creator_email: str = Field(default="", description="address of the creator")
    creator_url: str = Field(default="", description="page of the creator")
    principal_investigator: str = Field(default="", description="who leads the measurements")
    publisher_name: str = Field(
        default="",
        description="who distributes the data; by default the creator",
    )
    publisher_email: str = Field(
        default="", description="address of the publisher; by default that of the creator"
    )
    publisher_url: str = Field(
        default="", description="page of the publisher; by default that of the creator"
    )
    naming_authority: str = Field(
        default="", description="who makes the id of a product unique, such as int.example.lidar"
    )
    license: str = Field(default="", description="terms of use, as a name or an address")
    acknowledgement: str = Field(default="", description="whom users are to thank")
    references: str = Field(default="", description="papers about the data, besides the methods")
    comment: str = Field(default="", description="what else users are to know")
    program: str = Field(
        default="", description="programme of the project; by default the project itself"
    )

    @property
    def lacking(self) -> tuple[str, ...]:
        """The recommended attributes of ACDD that are not given."""
        recommended = (
            "institution", "project", "creator_name", "creator_email", "creator_url",
            "naming_authority", "license", "acknowledgement",
        )  # fmt: skip
        return tuple(name for name in recommended if not getattr(self, name).strip())


class Scenes(SettingsModel):
    """How granules are grouped into scenes."""

    window: Literal["day"] | Interval = Field(
        default="day", description="length of a scene, which divides a day; at least 1 min"
    )
    time_limit: Interval | None = Field(
        default=None,
        description="after which a worker is ended with its scene, which another one tries again"
        " once; by default 10 min and 2 s for each MB of the files",
    )

    @model_validator(mode="after")
    def _divides_day(self) -> Self:
        if self.time_limit is not None and self.time_limit < timedelta(seconds=1):
            raise ValueError("time_limit must be at least 1 s")
        if isinstance(self.window, timedelta):
            seconds = self.window.total_seconds()
            if seconds < 60 or 86400 % seconds:
                raise ValueError("window must be at least 1 min and divide a day: 30min, 6h, day")
        return self


class CampaignPeriod(SettingsModel):
    """A period of a campaign."""

    since: Instant = Field(description="start")
    until: Instant = Field(description="end, not included")
    frozen: bool = Field(
        default=False,
        description="products of scenes that begin in the period are not replaced without --thaw",
    )

    _ordered = ordered("since", "until", "until must be later than since")


class Acknowledged(SettingsModel):
    """What is missing and known to be, so that runs go on without it."""

    what: Patterns = Field(
        min_length=1, description="patterns of raw files below archive, as in files"
    )
    reason: str = Field(pattern=r"\S", description="why this is right, in words")
    until: Instant | None = Field(default=None, description="end of the validity of the entry")

    @property
    def holds(self) -> bool:
        """Whether the entry is valid now."""
        return self.until is None or datetime.now(UTC) < self.until


def _refuse_unknown(what: str, name: str, known: Collection[str], *keys: str | int) -> None:
    if name not in known:
        others = f"{nearest(name, known)}known {what}s: {', '.join(sorted(known))}"
        raise located_error(f"unknown {what} {name!r}; {others}", *keys)


class Campaign(SettingsModel):
    """One campaign: stations, instruments, networks, raw files and requested products."""

    name: Identifier = Field(description="of the campaign, in products and the ledger")
    title: str = Field(description="of the campaign, in a line")
    summary: str = Field(default="", description="what was measured, in some sentences")
    archive: str = Field(description="folder of the raw files, relative to the campaign file")
    output: str = Field(description="folder of catalog, products and reports")
    metadata: Metadata = Metadata()
    stations: dict[Identifier, Station] = Field(
        min_length=1, description="sites of the instruments, by a key of your choice"
    )
    instruments: dict[Identifier, Instrument] = Field(
        min_length=1, description="lidars, by a key of your choice"
    )
    networks: dict[Identifier, Network] = Field(
        default={}, description="instruments whose beams cross, by a key of your choice"
    )
    atmosphere: dict[Identifier, list[AtmosphereSource]] = Field(
        default={},
        description="sources of the air over a station, by its key, in their order: the first one"
        " with a profile near enough counts, else the US Standard Atmosphere 1976; the"
        " molecular_profile of the facts counts before them",
    )
    scenes: Scenes = Scenes()
    periods: list[CampaignPeriod] = Field(
        default=[], description="periods whose products can be frozen"
    )
    vanished_share: float = quantity(
        0.05,
        unit=NO_UNIT,
        ge=0,
        le=1,
        description="products are kept as they are if more than one of their raw files and more"
        " than this share has vanished or cannot be read: of a product, or of all with such files",
    )
    acknowledged: list[Acknowledged] = Field(
        default=[], description="raw files that may vanish, as where old ones are moved away"
    )
    simulation: SimulationSettings | None = Field(
        default=None, description="what lidarops simulate makes the raw files of"
    )
    catalog: str | None = Field(
        default=None,
        description="SQLAlchemy URL of catalog and ledger; by default a file in the output folder",
    )
    superseded: Interval | Literal["keep", "remove"] = Field(
        default=timedelta(days=30),
        description="how long products that a rerun replaces are kept for `lidarops compare`;"
        " 'keep': for ever; 'remove': not at all",
    )
    all_steps: bool = Field(
        default=False,
        description="run every step, even those without effect, and read files in full",
    )
    _folder: str = PrivateAttr(default=".")

    @model_validator(mode="after")
    def _known_stations(self) -> Self:
        for key, instrument in self.instruments.items():
            _refuse_unknown(
                "station", instrument.station, self.stations, "instruments", key, "station"
            )
        for key in self.atmosphere:
            _refuse_unknown("station", key, self.stations, "atmosphere", key)
        return self

    @model_validator(mode="after")
    def _known_members(self) -> Self:
        for key, network in self.networks.items():
            if key in self.instruments or key in self.stations:
                raise located_error("is the key of an instrument or station", "networks", key)
            for index, member in enumerate(network.instruments):
                place = ("networks", key, "instruments", index)
                _refuse_unknown("instrument", member, self.instruments, *place)
        return self

    def is_frozen(self, moment: datetime) -> bool:
        """Return whether a moment lies in a frozen period."""
        return any(
            period.frozen and period.since <= moment < period.until for period in self.periods
        )

    @property
    def folder(self) -> Path:
        """Folder of the campaign file, to which paths of profiles are relative."""
        return Path(self._folder)

    @property
    def catalog_url(self) -> str:
        """SQLAlchemy URL of the campaign's catalog."""
        if self.catalog:
            return self.catalog
        return f"sqlite:///{Path(self.output) / 'catalog.sqlite'}"

    @property
    def products_root(self) -> Path:
        """Folder of the products."""
        return Path(self.output) / "products"

    @property
    def report_root(self) -> Path:
        """Folder of the run reports."""
        return Path(self.output) / "report"

    @property
    def truth_path(self) -> Path:
        """The truth file of a simulated campaign."""
        return Path(self.archive) / "truth.nc"


@cache
def campaign_schema() -> dict[str, Any]:
    """Return the JSON schema of campaign files, with the settings of every kind of product.

    Besides the standard keywords, ``unit`` is the unit of a number and of the numbers below, and
    ``words`` describes valid texts.
    """
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **Campaign.model_json_schema()}


def editor_schema() -> dict[str, Any]:
    """Return the JSON schema of campaign files for editors, which know no units."""
    schema: dict[str, Any] = with_quantities(campaign_schema())
    return schema


def load_campaign(
    path: str | Path,
    *,
    archive: str | Path | None = None,
    output: str | Path | None = None,
    catalog: str | None = None,
) -> Campaign:
    """Read and validate a campaign file.

    Parameters
    ----------
    path : path or str
        The YAML file.
    archive : path or str, optional
        Root of the raw files. Overrides the environment variable ``LIDAROPS_ARCHIVE``, which
        overrides the file.
    output : path or str, optional
        Folder of catalog, products and reports. Overrides the file.
    catalog : str, optional
        SQLAlchemy URL of catalog and ledger. Overrides the environment variable
        ``LIDAROPS_CATALOG``, which overrides the file.

    Returns
    -------
    Campaign
        With `archive` and `output` absolute.

    Raises
    ------
    CampaignError
        If the file cannot be used, with file, line, key and valid choices.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CampaignError(
            f"cannot be read: {error}", file=path, remedy="give the path of a campaign YAML file"
        ) from error
    try:
        loader = Loader(text)
        tree = loader.get_single_node()
        duplicates = duplicate_keys(tree)
        # Merges the mappings that `<<` names into the nodes.
        raw = None if tree is None else loader.construct_document(tree)
    except yaml.YAMLError as error:
        raise CampaignError(f"is not valid YAML: {error}", file=path) from error
    # Impossible dates, and nesting that is too deep.
    except (ValueError, RecursionError) as error:
        raise CampaignError(
            f"holds a value that YAML cannot read: {error}",
            file=path,
            remedy="look for an impossible date such as 2024-02-30, and quote texts like it",
        ) from error
    if duplicates:
        raise CampaignError(_listed("is not a valid campaign:", duplicates), file=path)
    if not isinstance(raw, dict):
        raise CampaignError(
            "is not a mapping of keys to values",
            file=path,
            remedy="see catalogs/demo.yaml for an example",
        )
    try:
        try:
            campaign = Campaign.model_validate(raw)
        except ValidationError:
            # The schema takes as long as all the rest, and few files hold quantities with units.
            campaign = Campaign.model_validate(with_plain_numbers(raw, campaign_schema))
    except ValidationError as error:
        nodes = yaml.compose(text, Loader=yaml.SafeLoader)
        lines = explain_yaml_error(error, nodes, campaign_schema())
        raise CampaignError(_listed("is not a valid campaign:", lines), file=path) from error
    base = path.resolve().parent
    if "://" in str(output or campaign.output):
        raise CampaignError(
            "is a URL, but catalog, products and reports need a folder",
            file=path,
            field="output",
            remedy="give a folder, and copy the products from there",
        )
    override = archive or os.environ.get(ARCHIVE_VARIABLE)
    loaded = campaign.model_copy(
        update={
            "archive": _located(str(override), Path.cwd())
            if override
            else _located(campaign.archive, base),
            "output": _located(str(output), Path.cwd())
            if output
            else _located(campaign.output, base),
            "catalog": catalog or os.environ.get(CATALOG_VARIABLE) or campaign.catalog,
        }
    )
    if "://" in loaded.archive:
        refuse_keys(loaded.archive)
    loaded._folder = str(base)  # noqa: SLF001 - set once, here
    return loaded


def _listed(problem: str, lines: Sequence[str]) -> str:
    return "\n  ".join([problem, *lines])


def _located(location: str, base: Path) -> str:
    if "://" in location:
        return location
    return str((base / Path(location).expanduser()).resolve())


def channel_facts(facts: InstrumentFacts, channel: str) -> ChannelFacts:
    """Return the facts about a channel, or empty facts.

    Of a glued one, those of its photon-counting channel, which defines its ranges.
    """
    return facts.channels.get(file_channels(channel)[-1]) or ChannelFacts()
