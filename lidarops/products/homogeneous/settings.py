"""Settings of the product ``homogeneous`` in a campaign file."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from lidarops.settings import ChannelProduct, Metres, VisibilitySettings, quantity


class HomogeneousSettings(ChannelProduct):
    """The ``homogeneous`` product: background, amplitude and extinction of range sections."""

    channels: list[str] = Field(min_length=1)
    sections: list[tuple[Metres, Metres]] = quantity(unit="m", min_length=1)
    method: Literal["auto", "direct", "cubic"] = "auto"
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
        return self
