"""Product kind ``raman``: extinction, backscatter and lidar ratio, from Raman signals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Self

from pydantic import Field, model_validator

from lidarops.kinds import Kind
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.settings import (
    ChannelProduct,
    PartOfDay,
    average_interval,
    located_error,
    signal_to_noise_limit,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from lidarops.catalog.folder import InstrumentHeaders


class RamanProduct(ChannelProduct, RamanSettings):
    """The ``raman`` product: extinction, backscatter and lidar ratio without an assumed one.

    Beside what the retrieval assumes, the channels that it is made of, and what is done to signals
    before and to values after it.
    """

    channels: list[str] = Field(
        min_length=1, description="elastic channels, each with its Raman channel under nitrogen"
    )
    nitrogen: dict[str, str] = Field(
        description="elastic channel -> channel of the vibrational Raman lines of nitrogen, such as"
        " photon_355o: photon_387o"
    )
    water_vapour: dict[str, str] = Field(
        default={},
        description="elastic channel -> channel of the Raman lines of water vapour, whose facts"
        " give water_vapour_calibration",
    )
    average: PartOfDay = average_interval()
    least_signal_to_noise: float = signal_to_noise_limit()

    @model_validator(mode="after")
    def _has_raman_channels(self) -> Self:
        for name in self.channels:
            if name not in self.nitrogen:
                raise located_error(f"names no Raman channel of {name}", "nitrogen")
        return self

    @model_validator(mode="after")
    def _reaches_a_reference_window(self) -> Self:
        least = self.reference.lowest + self.reference.width
        if self.highest < least:
            raise located_error(
                f"{self.highest:g} m is below the end of the lowest reference window,"
                f" {least:g} m: give {least:g} m or more, or a smaller reference.lowest",
                "highest",
            )
        return self

    def companions(self, channel: str) -> tuple[str, ...]:
        """Return the Raman channels of an elastic channel."""
        pairs = (self.nitrogen, self.water_vapour)
        return tuple(pair[channel] for pair in pairs if channel in pair)


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty without a nitrogen channel or a steep beam."""
    pairs = headers.nitrogen_channels
    if not pairs or not headers.reaches_clean_air:
        return ()
    seen = headers.look.raman if headers.look else frozenset()
    if seen:
        return _lines({name: raman for name, raman in pairs.items() if name in seen})
    return (
        "# ? Needs dark nights: use it if these were measured at night.",
        *(f"# {line}" for line in _lines(pairs)),
    )


def _lines(pairs: Mapping[str, str]) -> tuple[str, ...]:
    nitrogen = ", ".join(f"{elastic}: {raman}" for elastic, raman in pairs.items())
    return ("raman:", f"  channels: [{', '.join(pairs)}]", f"  nitrogen: {{{nitrogen}}}")


KIND: Final = Kind(
    name="raman",
    title="Extinction and lidar ratio of Raman signals",
    package=__name__,
    settings=RamanProduct,
    rank=45,
    expects_usable=False,
    draft=_section,
)
