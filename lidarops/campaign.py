"""The campaign file: what a person writes, as validated models.

A campaign is one YAML file. Everything has a default that a lidar scientist would choose.
Facts about an instrument carry validity periods, because an archive of ten years needs them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)

from lidarops.errors import CampaignError
from lidarops.simulate.settings import SimulationSettings

ARCHIVE_VARIABLE = "LIDAROPS_ARCHIVE"


def _utc(value: datetime) -> datetime:
    return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def _as_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _clean_pattern(value: str) -> str:
    if value.startswith(("/", "~")) or ".." in value.split("/"):
        raise ValueError(f"{value!r} must stay inside its folder: relative, without '..'")
    return value


def _as_interval(value: Any) -> Any:
    # YAML reads 1:30 as 90 and 3600 as seconds; people write 6h or 30min.
    if isinstance(value, str) and value != "day":
        units = {"s": 1, "min": 60, "h": 3600, "d": 86400}
        number = value.rstrip("abcdefghijklmnopqrstuvwxyz ")
        unit = value[len(number) :].strip()
        if unit in units:
            try:
                return timedelta(seconds=float(number) * units[unit])
            except OverflowError as error:
                raise ValueError(f"{value!r} is too long") from error
    return value


Instant = Annotated[datetime, AfterValidator(_utc)]
Patterns = Annotated[
    list[Annotated[str, AfterValidator(_clean_pattern)]], BeforeValidator(_as_list), Field()
]
Inside = Annotated[str, AfterValidator(_clean_pattern)]
"""Path relative to the campaign file, and below it."""
Identifier = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9-]*$", max_length=40)]
Metres = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Station(_Model):
    """A place where instruments stand."""

    name: str
    latitude: float = Field(ge=-90, le=90, description="degrees north")
    longitude: float = Field(ge=-180, le=180, description="degrees east")
    altitude: float = Field(default=0.0, ge=-500, le=9000, description="m above the geoid")


class ChannelFacts(_Model):
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


class InstrumentFacts(_Model):
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
    channels: dict[str, ChannelFacts] = {}

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.valid_to <= self.valid_from:
            raise ValueError("valid_to must be later than valid_from")
        return self


class SignalSettings(_Model):
    """The ``signal`` product: background-subtracted, range-corrected signals."""

    channels: list[str] | Literal["all"] = "all"
    background_range: tuple[Metres, Metres] | None = Field(
        default=None, description="m; the last tenth of the bins where not given"
    )

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if self.background_range and self.background_range[0] >= self.background_range[1]:
            raise ValueError("background_range must end farther than it starts")
        return self


class HomogeneousSettings(_Model):
    """The ``homogeneous`` product: background, amplitude and extinction of range sections."""

    channels: list[str] = Field(min_length=1)
    sections: list[tuple[Metres, Metres]] = Field(min_length=1, description="m")
    method: Literal["auto", "direct", "cubic"] = "auto"

    @model_validator(mode="after")
    def _rising(self) -> Self:
        for near, far in self.sections:
            if far <= near:
                raise ValueError(f"section [{near}, {far}] must end farther than it starts")
        return self


class ReferenceSettings(_Model):
    """Where the air is taken as free of aerosol."""

    lowest: Metres = Field(default=3000.0, description="m above the station")
    highest: Metres = Field(default=12_000.0, description="m above the station")
    width: float = Field(default=1000.0, ge=100, le=20_000, description="m")
    scattering_ratio: float = Field(default=1.0, ge=1, le=10)
    relative_error: float = Field(
        default=0.02, ge=0, le=1, description="standard error of the scattering ratio, relative"
    )

    @model_validator(mode="after")
    def _holds_a_window(self) -> Self:
        if self.highest - self.lowest < self.width:
            raise ValueError("highest must lie at least width above lowest")
        return self


class ElasticSettings(_Model):
    """The ``elastic`` product: backscatter and extinction of aerosol, from a lidar ratio."""

    channels: list[str] = Field(
        min_length=1,
        description="glued_532o joins analog_532o and photon_532o, which the files must hold",
    )
    lidar_ratio: Annotated[float, Field(ge=1, le=200)] = Field(default=50.0, description="sr")
    lidar_ratio_standard_error: float = Field(default=10.0, ge=0, le=100, description="sr")
    average: Annotated[timedelta, BeforeValidator(_as_interval)] = timedelta(minutes=30)
    background: Literal["known_shape", "tail_mean"] = "known_shape"
    reference: ReferenceSettings = ReferenceSettings()
    molecular_relative_error: float = Field(
        default=0.01, ge=0, le=1, description="standard error of the density of the air, relative"
    )

    @model_validator(mode="after")
    def _divides_day(self) -> Self:
        seconds = self.average.total_seconds()
        if seconds < 1 or 86400 % seconds:
            raise ValueError("average must be at least 1 s and divide a day: 5min, 30min, 2h")
        return self


class MultiAngleSettings(_Model):
    """The ``multiangle`` product: optical depth and extinction from scans over zenith angle."""

    channels: list[str] = Field(min_length=1)
    highest: Metres = Field(default=6000.0, description="m above the station")
    step: float = Field(default=60.0, ge=5, le=1000, description="m, between altitudes")
    method: Literal["auto", "joint", "kano_hamilton", "two_angle"] = "auto"
    largest_gradient: float = Field(
        default=5e-5,
        ge=0,
        le=1e-2,
        description="m-1, of the logarithm of backscatter along the horizontal, to allow for",
    )

    @model_validator(mode="after")
    def _holds_altitudes(self) -> Self:
        if self.highest < 10 * self.step:
            raise ValueError("highest must lie at least 10 steps up")
        return self


class Products(_Model):
    """Which products of an instrument are wanted, with which settings."""

    signal: SignalSettings | None = None
    homogeneous: HomogeneousSettings | None = None
    elastic: ElasticSettings | None = None
    multiangle: MultiAngleSettings | None = None


class Instrument(_Model):
    """A lidar, the files it wrote, what is known of it and what is wanted from it."""

    station: Identifier
    name: str = ""
    files: Patterns
    dark_files: Patterns = []
    header_position: Literal["longitude_first", "latitude_first", "ignore"] = "longitude_first"
    facts: list[InstrumentFacts] = [InstrumentFacts()]
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


class Metadata(_Model):
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


class Scenes(_Model):
    """How granules are cut into scenes."""

    window: Annotated[Literal["day"] | timedelta, BeforeValidator(_as_interval)] = "day"

    @model_validator(mode="after")
    def _divides_day(self) -> Self:
        if isinstance(self.window, timedelta):
            seconds = self.window.total_seconds()
            if seconds < 60 or 86400 % seconds:
                raise ValueError("window must be at least 1 min and divide a day: 30min, 6h, day")
        return self


class Campaign(_Model):
    """One campaign: stations, instruments, where the raw files are, which products."""

    name: Identifier
    title: str
    summary: str = ""
    archive: str = Field(description="folder of the raw files, relative to the campaign file")
    output: str = Field(description="folder of catalog, products and reports")
    metadata: Metadata = Metadata()
    stations: dict[Identifier, Station] = Field(min_length=1)
    instruments: dict[Identifier, Instrument] = Field(min_length=1)
    scenes: Scenes = Scenes()
    simulation: SimulationSettings | None = None
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

    @property
    def folder(self) -> Path:
        """Folder of the campaign file, which the paths of profiles start from."""
        return Path(self._folder)

    @property
    def catalog_url(self) -> str:
        """SQLAlchemy URL of the campaign's catalog."""
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


def load(
    path: str | Path, *, archive: str | Path | None = None, output: str | Path | None = None
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
    if not isinstance(raw, dict):
        raise CampaignError(
            "is not a mapping", file=path, remedy="see catalogs/demo.yaml for an example"
        )
    try:
        campaign = Campaign.model_validate(raw)
    except ValidationError as error:
        raise CampaignError(_explain(error, tree), file=path) from error
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
        }
    )
    loaded._folder = str(base)  # noqa: SLF001 - set once, here
    return loaded


def _located(location: str, base: Path) -> str:
    if "://" in location:
        return location
    return str((base / Path(location).expanduser()).resolve())


def _explain(error: ValidationError, tree: yaml.Node | None) -> str:
    lines = []
    for problem in error.errors():
        keys = [str(key) for key in problem["loc"]]
        line = _line_of(tree, keys)
        place = ".".join(keys) or "top level"
        lines.append(f"{f'line {line}: ' if line else ''}{place}: {problem['msg']}")
    return "\n  ".join(["is not a valid campaign:", *lines])


def _line_of(node: yaml.Node | None, keys: list[str]) -> int | None:
    line = None
    for key in keys:
        node = next((value for name, value in _children(node) if name == key), None)
        if node is None:
            break
        line = node.start_mark.line + 1
    return line


def _children(node: yaml.Node | None) -> Iterator[tuple[str, yaml.Node]]:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield str(key.value), value
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield str(index), value


def channel_facts(facts: InstrumentFacts, channel: str) -> ChannelFacts:
    """Return what `facts` say of `channel`, or empty facts."""
    return facts.channels.get(channel, ChannelFacts())


def as_settings(model: BaseModel) -> Mapping[str, Any]:
    """Return a model as plain JSON types, for provenance and hashes."""
    dumped: dict[str, Any] = model.model_dump(mode="json")
    return dumped
