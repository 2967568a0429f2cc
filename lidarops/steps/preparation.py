"""Steps of several kinds of product, each with its own settings: background, average, air."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from typing import Final, Literal, Protocol

import xarray as xr

from lidarops.netcdf.variables import BACKGROUND_METHOD, MOLECULAR_SOURCE
from lidarops.records import Role
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.settings import SettingsModel, quantity
from lidarops.steps.case import ChannelCase, ProductCase
from lidarops.steps.data import BackgroundSettings, Data
from lidarops.steps.step import Datum, Decisions, Run, Step

BACKGROUND: Final = Datum[BackgroundSettings]("background")
AVERAGE: Final = Datum[float]("average")
"""s, length of the clock intervals over which profiles are averaged."""
MOLECULES: Final = Datum[MolecularProfile]("molecules")

FEWEST_BINS: Final = THRESHOLDS.fewest_bins
"""Fewest bins of a section, and of the range of a background."""


def with_methods(
    product: xr.Dataset, molecules: MolecularProfile, *, known_shape: bool
) -> xr.Dataset:
    """Return the product with the source of its air and the method of its backgrounds."""
    source = "standard_atmosphere" if molecules.standard else "sounding"
    return product.assign(
        molecular_source=MOLECULAR_SOURCE.code(source),
        background_method=BACKGROUND_METHOD.code("known_shape" if known_shape else "tail_mean"),
    )


def tail(case: ChannelCase, limits: tuple[float, float] | None) -> tuple[float, float]:
    """Return the limits in m of the far range whose mean is the background.

    By default the last tenth of the bins.
    """
    start, stop = limits or ((1.0 - THRESHOLDS.tail_share) * case.last, case.last)
    return start, min(stop, case.last)


class BackgroundRequest(Protocol):
    """What `Background` takes of the settings of a kind of product."""

    @property
    def background(self) -> Literal["tail_mean", "cubic", "known_shape"]:
        """How the background is estimated."""

    @property
    def background_range(self) -> tuple[float, float] | None:
        """Where, m; None for the last tenth of the bins."""


class Background(Step[ProductCase[BackgroundRequest], BackgroundSettings]):
    """State how and from which range the background is estimated."""

    name = "background"
    settings = BackgroundSettings
    outputs = (BACKGROUND,)

    def decide(self, case: ProductCase[BackgroundRequest]) -> Decisions:
        """Run always; the product is left out where the range holds too few bins."""
        method, limits = case.request.background, case.request.background_range
        start, stop = tail(case, limits)
        where = (
            "the last tenth of the bins" if limits is None else "background_range of the campaign"
        )
        reason = f"mean of {where}; signal there biases it"
        warning = ""
        if method == "cubic":
            # `test_the_cubic_doubts_weak_signals`
            reason = f"cubic of a homogeneous section, {where}; other sections bias it"
            warning = (
                "the cubic marks all values as uncertain where the signal of the first bin of its"
                " section is less than 30 times its noise, and some up to 300 times"
            )
        elif method == "known_shape":
            reason = (
                "fitted with the shape of clean air, which is assumed in the far range, and tested;"
                f" mean of {where} where the fit fails"
            )
        yield Run(
            reason,
            BackgroundSettings(method=method, range=(start, stop)),
            number=(stop - start) / case.channel.bin_width,
            warning=warning,
        )

    def carry_out(self, settings: BackgroundSettings, data: Data) -> None:
        """Give the range and the method."""
        data[BACKGROUND] = settings


class AverageSettings(SettingsModel):
    """Settings of the step ``average``."""

    seconds: float = quantity(unit="s")


class AverageRequest(Protocol):
    """What `Average` takes of the settings of a kind of product."""

    @property
    def average(self) -> timedelta:
        """Length of the clock intervals."""


class Average(Step[ProductCase[AverageRequest], AverageSettings]):
    """Average profiles over clock intervals."""

    name = "average"
    settings = AverageSettings
    outputs = (AVERAGE,)

    def __init__(self, reason: str) -> None:
        self._reason = reason

    def decide(self, case: ProductCase[AverageRequest]) -> Decisions:
        """Run always."""
        seconds = case.request.average.total_seconds()
        yield Run(self._reason, AverageSettings(seconds=seconds), number=seconds)

    def carry_out(self, settings: AverageSettings, data: Data) -> None:
        """Give the length of the intervals."""
        data[AVERAGE] = settings.seconds


class MolecularSettings(SettingsModel):
    """Settings of the step ``molecular``."""

    molecular_profile: str | None = None
    """Ancillary file of pressure and temperature; None for the US Standard Atmosphere 1976."""


class Molecular(Step[ChannelCase, MolecularSettings]):
    """Give the density of the air."""

    name = "molecular"
    settings = MolecularSettings
    outputs = (MOLECULES,)

    def decide(self, case: ChannelCase) -> Decisions:
        """Run always."""
        source = case.facts.molecular_profile
        reason = "given by the campaign"
        if not source:
            reason = "the campaign gives no molecular_profile; US Standard Atmosphere 1976 is used"
        yield Run(reason, MolecularSettings(molecular_profile=source or None))

    def carry_out(self, settings: MolecularSettings, data: Data) -> None:
        """Give the profile of the file, or of the standard atmosphere."""
        source = settings.molecular_profile
        profiles = data.source.ancillaries.profiles
        data[MOLECULES] = MolecularProfile.us_standard() if source is None else profiles[source]

    def files(self, settings: MolecularSettings) -> Mapping[str, Role]:
        """Return the file of pressure and temperature."""
        return {settings.molecular_profile: Role.MOLECULAR} if settings.molecular_profile else {}
