"""Settings of the product ``integrated`` in a campaign file."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from lidarops.settings import ChannelProduct, Inside, Metres, quantity


class IntegratedSettings(ChannelProduct):
    """The ``integrated`` product: range-corrected signals, integrated over windows of range."""

    channels: list[str] = Field(min_length=1)
    windows: list[tuple[Metres, Metres]] = quantity(unit="m", min_length=1)
    background_range: tuple[Metres, Metres] | None = quantity(
        None, unit="m", description="by default the last tenth of the bins"
    )
    overlap_profile: Inside | None = None

    @model_validator(mode="after")
    def _rising(self) -> Self:
        limits = [*self.windows, *([self.background_range] if self.background_range else [])]
        for near, far in limits:
            if far <= near:
                raise ValueError(f"[{near:g}, {far:g}] must end farther than it starts")
        return self
