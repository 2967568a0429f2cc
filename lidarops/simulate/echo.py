"""Signal of the laser pulse that a campaign file describes."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.campaign.simulation import Pulse
from lidarops.constants import SPEED_OF_LIGHT
from lidarops.simulate import pulse as shapes
from lidarops.simulate.atmosphere import BeamPath
from lidarops.simulate.signal import bin_centres

Array = NDArray[np.float64]

_RECTANGLE: Final = "rectangle"
_GAUSSIAN: Final = "gaussian"


def pulse_echo(
    distance: Array,
    path: BeamPath,
    pulse: Pulse,
    *,
    system_constant: float,
    full_overlap_range: float,
) -> Array:
    """Return the mean rate of photoelectrons while each bin is open, MHz.

    Parameters
    ----------
    distance : ndarray, m, shape (bins,)
        Range of the bin centres, equally spaced; time zero is the centroid of the pulse.
    path : BeamPath
        Optical properties at the bin centres, linear between them.
    pulse : Pulse
    system_constant : float, MHz m3 sr
    full_overlap_range : float, m
        Must be positive: without overlap the signal at the lidar is infinite.

    Raises
    ------
    SimulationInputError
        See `lidarops.simulate.pulse.pulsed_signal`.

    References
    ----------
    `vasylkivskyi2009`, equations 20 to 23.
    """
    step = float(distance[1] - distance[0])
    shape, centroid = _shape_of(pulse)
    signal = shapes.pulsed_signal(
        distance + 0.5 * SPEED_OF_LIGHT * centroid,
        extinction=path.extinction,
        backscatter=path.backscatter,
        system_constant=system_constant,
        pulse=shape,
        bin_width=step,
        full_overlap_range=full_overlap_range,
        path=bin_centres(distance.size, step, float(distance[0]) - 0.5 * step),
    )
    return np.where(distance > 0.0, signal, 0.0)


def _shape_of(pulse: Pulse) -> tuple[shapes.Pulse, float]:
    """Return the pulse, and the time of its centroid, s."""
    if pulse.shape == _RECTANGLE:
        return shapes.RectangularPulse(pulse.width), 0.5 * pulse.width
    if pulse.shape == _GAUSSIAN:
        return shapes.GaussianPulse(pulse.width, shapes.Origin.PEAK), 0.0
    return shapes.ExponentialPulse(pulse.width), pulse.width
