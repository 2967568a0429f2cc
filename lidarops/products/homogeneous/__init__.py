"""Product kind ``homogeneous``: extinction and amplitude of homogeneous range sections."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from lidarops.constants import FIXED
from lidarops.kinds import Kind
from lidarops.settings import (
    NO_UNIT,
    BackgroundRange,
    ChannelProduct,
    Metres,
    SettingsModel,
    VisibilitySettings,
    located_error,
    quantity,
)

if TYPE_CHECKING:
    from lidarops.catalog.folder import InstrumentHeaders

NonNegative = Annotated[float, Field(ge=0)]
Method = Literal["auto", "direct", "cubic", "known_background", "linearized", "known_extinction"]
_GIVEN_EXTINCTION: Final = ("linearized", "known_extinction")
"""Methods that start from a given extinction."""
_OF_METHOD: Final = {
    "background_range": "known_background", "background": "known_background", "lag": "cubic"
}  # fmt: skip
"""Key -> the only method that uses it."""


class PathAssumptions(SettingsModel):
    """How a section is solved, and what is assumed of it."""

    method: Method = Field(
        default="auto",
        description="known_background takes the background from the far range, for paths that end"
        " there, or from background; auto does the former where the beam moves and the sections end"
        " before the last tenth of the bins, and is direct elsewhere; the other methods retrieve it"
        " from the section. linearized takes one step from extinction, known_extinction takes it"
        " as exact",
    )
    extinction: float | None = quantity(
        None,
        unit="m-1",
        ge=0,
        le=0.1,
        description="of molecules and particles, for linearized (known to some percent) and"
        " known_extinction",
    )
    lag: int | None = quantity(
        None,
        unit=NO_UNIT,
        ge=1,
        description="bins between those of a triple of the method cubic; by default 0.4 of the bins"
        " of the section, at 1 the published cubic",
    )
    slope_error: float | None = quantity(
        None,
        unit=NO_UNIT,
        ge=0,
        le=1,
        description="standard error of the logarithmic slope of the signal by air that is not"
        " homogeneous, as a share of 2 (extinction + 1 / mean range); model errors are in"
        " proportion to it. The default is chosen by the violations of simulated scenes, most of"
        " which it covers; the page of results states the rest. State less where air is known to be"
        " calm",
    )
    visibility: VisibilitySettings | None = Field(
        default=None, description="if given, adds visibility along the sections"
    )


class HomogeneousSettings(ChannelProduct, PathAssumptions):
    """The ``homogeneous`` product: background, amplitude and extinction of range sections."""

    channels: list[str] = Field(min_length=1, description="names of channels, such as photon_532o")
    sections: list[tuple[Metres, Metres]] = quantity(
        unit="m",
        min_length=1,
        description="near and far end of each section whose air is homogeneous",
    )
    background_range: BackgroundRange | None = quantity(
        None,
        unit="m",
        description="far range of known_background; the last tenth of the bins by default",
    )
    background: dict[str, tuple[float, NonNegative]] | None = quantity(
        None,
        unit="MHz or mV",
        description="of known_background, in place of the far range: the background of each"
        " channel, measured separately, and its standard error; MHz for photon counting, mV for"
        " analog, with dead time and dark signal corrected",
    )

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if len(set(self.sections)) < len(self.sections):
            raise ValueError("sections lists a section twice")
        for near, far in self.sections:
            if far <= near:
                raise ValueError(f"section [{near}, {far}] must end farther than it starts")
        for key, method in _OF_METHOD.items():
            if getattr(self, key) is not None and self.method != method:
                raise located_error(f"is used by the method {method} only", key)
        if (self.extinction is not None) != (self.method in _GIVEN_EXTINCTION):
            raise located_error(
                f"is required by {' and '.join(_GIVEN_EXTINCTION)}, and used by no other method",
                "extinction",
            )
        if self.background is not None and self.background_range is not None:
            raise located_error("is given together with background; give one", "background_range")
        if self.background is not None and self.background.keys() != set(self.channels):
            named = ", ".join(self.channels)
            raise located_error(f"must state each of the channels: {named}", "background")
        return self


_LEVEL: Final = 1.9
"""degree above or below the horizon, at which 3 km of path climb 100 m."""


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty where no fixed beam is level."""
    channels = ", ".join(headers.elastic_channels)
    if not channels or headers.zenith_span > FIXED or abs(headers.zenith_angle - 90.0) > _LEVEL:
        return ()
    return (
        "homogeneous:",
        f"  channels: [{channels}]",
        "  sections: [[1000, 4000]]  # ? m, where the air is homogeneous and the signal strong",
    )


KIND: Final = Kind(
    name="homogeneous",
    title="Extinction of homogeneous sections",
    package=__name__,
    settings=HomogeneousSettings,
    rank=20,
    expects_usable=False,
    draft=_section,
)
