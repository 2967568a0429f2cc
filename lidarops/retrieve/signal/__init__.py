"""Raw counts to signals with known noise.

In this order:

1. `DarkSignals` gives the dark signal of analog channels at the time of each profile.
2. `analog_signal` converts ADC counts to mV and subtracts the dark signal. `photon_signal`
   converts photon counts to MHz and corrects for dead time: here and nowhere else.
3. `estimate_lag` and `shift_signal` align analog with photon counting.
4. `glue` joins analog (near) and photon counting (far).
5. `RunningMean` averages profiles.
6. `labeled.correct_for_range` subtracts the background and multiplies with the square of range.

`labeled`, `labeled_gluing` and `labeled_averaging` do the same on `xarray` data; import them as
modules, so that the numerics stay free of xarray.
"""

from lidarops.retrieve.signal.averaging import Averages, RunningMean
from lidarops.retrieve.signal.counts_to_signal import (
    Signal,
    analog_signal,
    difference_variance,
    photon_signal,
)
from lidarops.retrieve.signal.dark import DarkSignals
from lidarops.retrieve.signal.gluing import GluedSignal, glue
from lidarops.retrieve.signal.lag import ChannelLag, estimate_lag, shift_signal

__all__ = [
    "Averages",
    "ChannelLag",
    "DarkSignals",
    "GluedSignal",
    "RunningMean",
    "Signal",
    "analog_signal",
    "difference_variance",
    "estimate_lag",
    "glue",
    "photon_signal",
    "shift_signal",
]
