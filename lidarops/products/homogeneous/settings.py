"""Settings of the product ``homogeneous`` in a campaign file."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from lidarops.settings import (
    BackgroundRange,
    ChannelProduct,
    Metres,
    VisibilitySettings,
    located_error,
    quantity,
)


class HomogeneousSettings(ChannelProduct):
    """The ``homogeneous`` product: background, amplitude and extinction of range sections."""

    channels: list[str] = Field(min_length=1)
    sections: list[tuple[Metres, Metres]] = quantity(unit="m", min_length=1)
    method: Literal["auto", "direct", "cubic", "known_background"] = Field(
        default="auto",
        description="known_background takes the background from the far range, for paths that end"
        " there; the other methods retrieve it from the section",
    )
    background_range: BackgroundRange | None = quantity(
        None,
        unit="m",
        description="far range of known_background; the last tenth of the bins by default",
    )
    visibility: VisibilitySettings | None = Field(
        default=None, description="if given, adds visibility along the sections"
    )

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if len(set(self.sections)) < len(self.sections):
            raise ValueError("sections lists a section twice")
        for near, far in self.sections:
            if far <= near:
                raise ValueError(f"section [{near}, {far}] must end farther than it starts")
        if self.background_range is not None and self.method != "known_background":
            raise located_error("is used by the method known_background only", "background_range")
        return self
