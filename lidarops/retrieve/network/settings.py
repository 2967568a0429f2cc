"""What the retrieval of a network assumes, as the campaign states it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from pydantic import Field

from lidarops.settings import quantity

EXPONENTS: Final = (0.1, 10.0)
"""Smallest and largest exponent m of backscatter ~ extinction^(1/m); assumed."""

Multiplier = Annotated[float, Field(ge=0, le=1)] | Literal["chosen"]


@dataclass(frozen=True, kw_only=True)
class NetworkAssumptions:
    """Where beams meet, how a network is solved, and relative errors for its systematic errors."""

    tolerance: Annotated[
        float,
        quantity(unit="m", gt=0, le=1000, description="largest distance of beams at a crossing"),
    ] = 15.0
    smallest_angle: Annotated[
        float,
        quantity(unit="degree", gt=0, lt=90, description="least angle between beams at a crossing"),
    ] = 2.0
    prior: Annotated[
        Literal["block", "none"],
        Field(
            description="block: the averages of a block are one field that changes slowly; none:"
            " each average is solved alone"
        ),
    ] = "block"
    multiplier: Annotated[
        Multiplier | None,
        quantity(
            unit="1",
            description="lambda of Drabenko et al., 0 to 1 or chosen: solve one triangle of beams"
            " at each crossing instead of all beams together",
        ),
    ] = None
    exponent_relative_error: Annotated[
        float, quantity(unit="1", ge=0, le=0.5, description="relative error of the exponent")
    ] = 0.1
    lidar_ratio_relative_error: Annotated[
        float,
        quantity(
            unit="1",
            ge=0,
            le=0.5,
            description="relative error of the lidar ratio of a crossing against the others, from"
            " aerosol mixtures and humidity",
        ),
    ] = 0.07
    overlap_relative_error: Annotated[
        float,
        quantity(
            unit="1",
            ge=0,
            le=0.5,
            description="relative error of the overlap at the nearest crossing of a beam, from"
            " where it falls linearly to 0 at the farthest",
        ),
    ] = 0.003
