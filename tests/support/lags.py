"""The lag of all profiles of two channels at once."""

from __future__ import annotations

from typing import Any

from lidarops.retrieve.signal.lag import ChannelLag, estimate_lag, profile_groups


def lag_of(analog: Any, photon: Any) -> ChannelLag:
    """Return the lag of analog behind photon counting, (..., time, range) each."""
    groups = profile_groups(analog.shape[-2])
    return estimate_lag((analog[..., rows, :], photon[..., rows, :]) for rows in groups)
