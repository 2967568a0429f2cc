"""Product kind ``signal``: background-subtracted, range-corrected signals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, Self

from pydantic import Field, model_validator

from lidarops.kinds import Kind
from lidarops.settings import (
    BackgroundRange,
    ChannelProduct,
    SettingsModel,
    quantity,
    signal_to_noise_limit,
)

if TYPE_CHECKING:
    from lidarops.catalog.folder import InstrumentHeaders


class RangeCorrection(SettingsModel):
    """What follows the correction for range; also the settings of the entry ``signal``."""

    least_signal_to_noise: float = signal_to_noise_limit()


class SignalSettings(ChannelProduct, RangeCorrection):
    """The ``signal`` product: background-subtracted, range-corrected signals."""

    channels: list[str] | Literal["all"] = Field(
        default="all",
        description="names of channels; all means every channel of the files, without glued ones",
    )
    background_range: BackgroundRange | None = quantity(
        None, unit="m", description="by default the last tenth of the bins"
    )
    background: Literal["tail_mean", "cubic"] = Field(
        default="tail_mean",
        description="mean of background_range, or the cubic of a homogeneous section there",
    )

    @model_validator(mode="after")
    def _has_its_section(self) -> Self:
        if self.background == "cubic" and self.background_range is None:
            raise ValueError(
                "background: cubic needs background_range, the section in m where the air is"
                " homogeneous and the signal strong"
            )
        return self


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty where the headers hold no channel."""
    return ("signal: {channels: all}",) if headers.layout else ()


KIND: Final = Kind(
    name="signal",
    title="Range-corrected signals",
    package=__name__,
    settings=SignalSettings,
    rank=90,
    expects_usable=False,
    draft=_section,
)
