"""Settings of the product ``signal`` in a campaign file."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from lidarops.settings import ChannelProduct, Metres, quantity


class SignalSettings(ChannelProduct):
    """The ``signal`` product: background-subtracted, range-corrected signals."""

    channels: list[str] | Literal["all"] = "all"
    background_range: tuple[Metres, Metres] | None = quantity(
        None, unit="m", description="by default the last tenth of the bins"
    )
    background: Literal["tail_mean", "cubic"] = Field(
        default="tail_mean",
        description="mean of background_range, or the cubic of a homogeneous section there",
    )

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if self.background_range and self.background_range[0] >= self.background_range[1]:
            raise ValueError("background_range must end farther than it starts")
        return self

    @model_validator(mode="after")
    def _has_its_section(self) -> Self:
        if self.background == "cubic" and self.background_range is None:
            raise ValueError(
                "background: cubic needs background_range, the section in m where the air is"
                " homogeneous and the signal strong"
            )
        return self
