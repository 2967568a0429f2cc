"""What several kinds of product decide alike: background, average, and the words for them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from typing import Final, Literal

import numpy as np
import xarray as xr

from lidarops.flags import Quality
from lidarops.netcdf.variables import BACKGROUND_METHOD, MOLECULAR_SOURCE, whole_error
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.scene.case import ChannelCase, Entry
from lidarops.settings import SettingsModel, quantity

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


class BackgroundSettings(SettingsModel):
    """How a background is estimated."""

    method: Literal["tail_mean", "cubic", "known_shape"]
    range: tuple[float, float] = quantity(unit="m")


def background(
    case: ChannelCase,
    method: Literal["tail_mean", "cubic", "known_shape"],
    limits: tuple[float, float] | None = None,
) -> Entry:
    """Return how the background is estimated, and from which range, m; see `tail`.

    A product is to be left out where the range holds too few bins.
    """
    start, stop = tail(case, limits)
    where = "the last tenth of the bins" if limits is None else "background_range of the campaign"
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
    return case.run(
        "background",
        reason,
        BackgroundSettings(method=method, range=(start, stop)),
        number=(stop - start) / case.channel.bin_width,
        warning=warning,
    )


class AverageSettings(SettingsModel):
    """Clock intervals over which profiles are averaged."""

    seconds: float = quantity(unit="s")


def average(case: ChannelCase, interval: timedelta, reason: str) -> Entry:
    """Return over which clock intervals profiles are averaged, and why."""
    seconds = interval.total_seconds()
    return case.run("average", reason, AverageSettings(seconds=seconds), number=seconds)


def with_low_signal_to_noise(rows: xr.Dataset, names: Sequence[str], least: float) -> xr.Dataset:
    """Return rows with the bit LOW_SIGNAL_TO_NOISE where a value is small against its error.

    Parameters
    ----------
    rows : xr.Dataset
        With the variables, their standard errors, the errors by dead time and baseline beside these
        where there are some, and ``quality_flag``, of the same dimensions.
    names : sequence of str
        Variables, one of which is enough.
    least : float
        Least ratio of a value to its error without the bit; 0 for no bit.
    """
    dims, flags = rows["quality_flag"].dims, rows["quality_flag"].to_numpy()
    low = np.zeros(flags.shape, dtype=np.bool_)
    for name in names:
        value = rows[name].transpose(*dims).to_numpy()
        low |= np.abs(value) < least * whole_error(rows, name).transpose(*dims).to_numpy()
    bit = low * np.int32(Quality.LOW_SIGNAL_TO_NOISE)
    return rows.assign(quality_flag=rows["quality_flag"].copy(data=flags | bit))
