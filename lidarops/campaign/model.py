"""The campaign file: what a person writes, as validated models.

A campaign is one YAML file. Everything has a default that a lidar scientist would choose.
Facts about an instrument carry validity periods, because an archive of ten years needs them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)

from lidarops.campaign.product_settings import (
    IDENTIFIER,
    ElasticSettings,
    HomogeneousSettings,
    Identifier,
    Inside,
    Instant,
    Metres,
    MultiAngleSettings,
    NetworkVisibilitySettings,
    Patterns,
    Products,
    SettingsModel,
    SignalSettings,
    as_interval,
)
from lidarops.campaign.simulation import SimulationSettings
from lidarops.campaign.yaml_errors import duplicate_keys, explain_yaml_error
from lidarops.errors import CampaignError

__all__ = [
    "Campaign",
    "ChannelFacts",
    "ElasticSettings",
    "HomogeneousSettings",
    "Instrument",
    "InstrumentFacts",
    "Metadata",
    "MultiAngleSettings",
    "Network",
    "NetworkVisibilitySettings",
    "Products",
    "Scenes",
    "SignalSettings",
    "Station",
    "as_settings",
    "channel_facts",
    "load_campaign",
]

ARCHIVE_VARIABLE = "LIDAROPS_ARCHIVE"
CATALOG_VARIABLE = "LIDAROPS_CATALOG"
_IDENTIFIERS = "letters, digits and hyphens that begin with a letter or a digit"


class Station(SettingsModel):
    """A place where instruments stand."""

    name: str
    latitude: float = Field(ge=-90, le=90, description="degrees north")
    longitude: float = Field(ge=-180, le=180, description="degrees east")
    altitude: float = Field(default=0.0, ge=-500, le=9000, description="m above the geoid")


class ChannelFacts(SettingsModel):
    """What is known of one channel over a validity period."""

    wavelength: float | None = Field(
        default=None, gt=1e-7, lt=2e-5, description="m, where the header is wrong"
    )
    dead_time: float | None = Field(default=None, gt=0, lt=1e-6, description="s")
    range_offset: float | None = Field(
        default=None, ge=-500, le=500, description="m added to the range of every bin"
    )
    noise_variance: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="analog noise variance of one profile, mV^2",
    )
    lag: Annotated[float, Field(ge=-100, le=100)] | Literal["estimate"] | None = Field(
        default=None,
        description="bins by which an analog record lies farther than the photon counting one"
        " of the same light, besides range_offset; or 'estimate', for joined channels",
    )


class InstrumentFacts(SettingsModel):
    """What is known of an instrument over a validity period."""

    valid_from: Instant = datetime.min.replace(tzinfo=UTC)
    valid_to: Instant = datetime.max.replace(tzinfo=UTC)
    zenith_angle: float | None = Field(default=None, ge=0, le=180, description="degree")
    azimuth: float | None = Field(default=None, ge=0, lt=360, description="degree")
    full_overlap_range: Metres = Field(default=0.0, description="m")
    overlap_profile: Inside | None = Field(
        default=None, description="CSV or NetCDF file of range (m) and overlap (0 to 1)"
    )
    molecular_profile: Inside | None = Field(
        default=None,
        description="CSV or NetCDF file of altitude (m), pressure (Pa or hPa), temperature (K)",
    )
    channels: dict[str, ChannelFacts] = Field(default={})

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.valid_to <= self.valid_from:
            raise ValueError("valid_to must be later than valid_from")
        return self


class Instrument(SettingsModel):
    """A lidar, the files it wrote, what is known of it and what is wanted from it."""

    station: Identifier
    name: str = ""
    files: Patterns
    dark_files: Patterns = Field(default=[])
    header_position: Literal["longitude_first", "latitude_first", "ignore"] = "longitude_first"
    facts: list[InstrumentFacts] = Field(default=[InstrumentFacts()])
    products: Products = Products()

    @model_validator(mode="after")
    def _disjoint(self) -> Self:
        periods = sorted((fact.valid_from, fact.valid_to) for fact in self.facts)
        for (_, stop), (start, _) in pairwise(periods):
            if start < stop:
                raise ValueError(f"validity periods of facts overlap at {start:%Y-%m-%d}")
        return self

    def facts_at(self, moment: datetime) -> InstrumentFacts:
        """Return the facts that are valid at `moment`, or empty ones."""
        for fact in self.facts:
            if fact.valid_from <= moment < fact.valid_to:
                return fact
        return InstrumentFacts()


class Network(SettingsModel):
    """Instruments that look at the same air, and what is wanted from them together."""

    name: str = ""
    instruments: list[Identifier] = Field(min_length=2)
    visibility: NetworkVisibilitySettings

    @model_validator(mode="after")
    def _told_apart(self) -> Self:
        if len(set(self.instruments)) < len(self.instruments):
            raise ValueError("an instrument stands twice in instruments")
        strange = sorted(set(self.visibility.exponents) - set(self.instruments))
        if strange:
            raise ValueError(f"exponents of {', '.join(strange)}, not in instruments")
        return self


class Metadata(SettingsModel):
    """Who made the data: global attributes of every product (ACDD-1.3)."""

    institution: str = "unknown institution"
    project: str = "lidarops"
    creator_name: str = "unknown creator"
    creator_email: str = "unknown@example.org"
    creator_url: str = "https://example.org"
    publisher_name: str = ""
    publisher_email: str = ""
    publisher_url: str = ""
    naming_authority: str = "org.example"
    license: str = "Not stated. Ask the creator before use."
    acknowledgement: str = "Not stated."
    references: str = ""
    comment: str = ""
    program: str = ""


class Scenes(SettingsModel):
    """How granules are cut into scenes."""

    window: Annotated[Literal["day"] | timedelta, BeforeValidator(as_interval)] = "day"

    @model_validator(mode="after")
    def _divides_day(self) -> Self:
        if isinstance(self.window, timedelta):
            seconds = self.window.total_seconds()
            if seconds < 60 or 86400 % seconds:
                raise ValueError("window must be at least 1 min and divide a day: 30min, 6h, day")
        return self


class Campaign(SettingsModel):
    """One campaign: stations, instruments, where the raw files are, which products."""

    name: Identifier
    title: str
    summary: str = ""
    archive: str = Field(description="folder of the raw files, relative to the campaign file")
    output: str = Field(description="folder of catalog, products and reports")
    metadata: Metadata = Metadata()
    stations: dict[Identifier, Station] = Field(min_length=1)
    instruments: dict[Identifier, Instrument] = Field(min_length=1)
    networks: dict[Identifier, Network] = Field(default={})
    scenes: Scenes = Scenes()
    simulation: SimulationSettings | None = None
    catalog: str | None = Field(
        default=None,
        description="SQLAlchemy URL of catalog and ledger; a file in the output folder else",
    )
    superseded: Literal["keep", "remove"] = Field(
        default="remove", description="what becomes of products that a rerun replaces"
    )
    all_steps: bool = Field(
        default=False,
        description="whether steps run too that by all signs give nothing, and every file is"
        " read whole again",
    )
    _folder: str = PrivateAttr(default=".")

    @model_validator(mode="after")
    def _known_stations(self) -> Self:
        for key, instrument in self.instruments.items():
            if instrument.station not in self.stations:
                known = ", ".join(sorted(self.stations))
                raise ValueError(
                    f"instrument {key!r} stands at unknown station {instrument.station!r};"
                    f" known: {known}"
                )
        return self

    @model_validator(mode="after")
    def _known_members(self) -> Self:
        for key, network in self.networks.items():
            if key in self.instruments or key in self.stations:
                raise ValueError(f"network {key!r} has the key of an instrument or station")
            for member in network.instruments:
                if member not in self.instruments:
                    known = ", ".join(sorted(self.instruments))
                    raise ValueError(
                        f"network {key!r} names unknown instrument {member!r}; known: {known}"
                    )
        return self

    @property
    def folder(self) -> Path:
        """Folder of the campaign file, which the paths of profiles start from."""
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
        Root of the raw files; wins over the environment variable ``LIDAROPS_ARCHIVE``, which
        wins over the file.
    output : path or str, optional
        Folder of catalog, products and reports; wins over the file.
    catalog : str, optional
        SQLAlchemy URL of catalog and ledger; wins over the environment variable
        ``LIDAROPS_CATALOG``, which wins over the file.

    Returns
    -------
    Campaign
        With `archive` and `output` absolute.

    Raises
    ------
    CampaignError
        With file, line, key and the valid choices, where the file cannot be used.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CampaignError(
            f"cannot be read: {error}", file=path, remedy="give the path of a campaign YAML file"
        ) from error
    try:
        tree = yaml.compose(text, Loader=yaml.SafeLoader)
        raw = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CampaignError(f"is not valid YAML: {error}", file=path) from error
    # A date that no calendar has, and nesting that no person writes.
    except (ValueError, RecursionError) as error:
        raise CampaignError(
            f"holds something that is not YAML: {error}",
            file=path,
            remedy="look for a date such as 2024-02-30; quote what is no date",
        ) from error
    if twice := duplicate_keys(tree):
        raise CampaignError(_listed("is not a valid campaign:", twice), file=path)
    if not isinstance(raw, dict):
        raise CampaignError(
            "is not a mapping", file=path, remedy="see catalogs/demo.yaml for an example"
        )
    try:
        campaign = Campaign.model_validate(raw)
    except ValidationError as error:
        told = explain_yaml_error(error, tree, Campaign, {IDENTIFIER: _IDENTIFIERS})
        raise CampaignError(_listed("is not a valid campaign:", told), file=path) from error
    base = path.resolve().parent
    if "://" in str(output or campaign.output):
        raise CampaignError(
            "is a URL; catalog, products and reports are written to a folder",
            file=path,
            field="output",
            remedy="give a folder, and copy the products from there",
        )
    chosen = archive or os.environ.get(ARCHIVE_VARIABLE)
    loaded = campaign.model_copy(
        update={
            "archive": _located(str(chosen), Path.cwd())
            if chosen
            else _located(campaign.archive, base),
            "output": _located(str(output), Path.cwd())
            if output
            else _located(campaign.output, base),
            "catalog": catalog or os.environ.get(CATALOG_VARIABLE) or campaign.catalog,
        }
    )
    loaded._folder = str(base)  # noqa: SLF001 - set once, here
    return loaded


def _listed(problem: str, told: Sequence[str]) -> str:
    return "\n  ".join([problem, *told])


def _located(location: str, base: Path) -> str:
    if "://" in location:
        return location
    return str((base / Path(location).expanduser()).resolve())


def channel_facts(facts: InstrumentFacts, channel: str) -> ChannelFacts:
    """Return what `facts` say of `channel`, or empty facts."""
    return facts.channels.get(channel, ChannelFacts())


def as_settings(model: BaseModel) -> Mapping[str, Any]:
    """Return a model as plain JSON types, for provenance and hashes."""
    dumped: dict[str, Any] = model.model_dump(mode="json")
    return dumped
