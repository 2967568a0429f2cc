"""Thresholds of outlying bins and clouds, each with what set it."""

from __future__ import annotations

from typing import Final, NamedTuple


class Thresholds(NamedTuple):
    """Limits of outlying bins, clouds and the overlap."""

    # Isolated outlying bins
    least_contrast: float = 6.0
    """Distance of an outlier from its neighbours over their spread in excess of noise. Peaks with a
    full width at half maximum of 1.5 bins or more have less."""
    most_equal: int = 4
    """Neighbours of equal power: more of them mean few counts, whose noise is not normal. Assumed.
    """

    step_by_noise: float = 4.0
    """Standard deviations of the noise of a bin, or 5.7 of the difference of the means of 4, by
    which the signal may change across a bin. Assumed."""

    # Clouds
    window_lengths: tuple[float, ...] = (60.0, 120.0, 240.0, 480.0, 960.0, 1920.0)
    """m; in which signals are averaged below and above a base: the longest finds cirrus that rises
    within 2 km."""
    least_fall: float = 0.1
    """Fall of the ratio to air within a layer, in least excesses of a cloud. Assumed: aerosol
    above a cloud falls slower."""
    visible_fall: float = 0.25
    """Fall that noise must not hide in a window at the top, in least excesses. With 0.5, longer
    parts of weak layers are missed; with 0.15, windows reach the top of aerosol above a cloud."""
    windows_beyond: int = 8
    """Length of the air that a window is compared with, in windows. With 4, a third of the bins
    above the peak of a deep cirrus is missed (`test_layers.py`)."""
    windows_below: int = 4
    """The same, below a layer. With 2, up to 225 m of the lower part of a deep cirrus is missed;
    with 8, every tenth altocumulus above dust begins with the dust (`test_layers.py`)."""
    cloud_margin: float = 300.0
    """m before the first and beyond the last bin of a cloud, whose thin edges extend beyond it.
    Values there are to be used with care, and neither background nor reference window is sought
    there: noise hides up to 260 m of the upper part of a cirrus (`test_layers.py`)."""
    visible_depth: float = 480.0
    """m; depth of the layer that noise must not hide where a bin is stated to be clear. By
    definition; a cirrus of optical depth 0.05 is deeper (`test_layers.py`)."""
    visible_excess: float = 2.0
    """Its excess over the least one of a cloud. By definition; with 1, noise hides every layer."""


THRESHOLDS: Final = Thresholds()
