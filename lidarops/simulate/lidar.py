"""A lidar in physical units: from laser, telescope and detector to power and photoelectrons."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarops.constants import LICEL_RANGE_PER_MICROSECOND, PLANCK, SPEED_OF_LIGHT
from lidarops.simulate import _checks
from lidarops.simulate.overlap import Overlap, SineOverlap
from lidarops.simulate.pulse import Pulse, pulsed_signal

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lidar:
    """A monostatic lidar with one detector.

    Raises
    ------
    SimulationInputError
        If a number is impossible: no aperture, wavelengths in nm, an efficiency above 1.
    """

    energy: float
    """J, of one pulse."""
    aperture_diameter: float
    """m, of the telescope."""
    wavelength: float
    """m, of the laser."""
    optical_efficiency: float
    """Share of the photons on the aperture, within the field of view, that reach the detector."""
    quantum_efficiency: float
    """Photoelectrons per photon on the detector."""
    bin_width: float
    """m."""
    full_overlap_range: float = 0.0
    """m; used where no overlap is given."""
    pulse: Pulse | None = None
    """None for a pulse without length."""
    overlap: Overlap | None = None
    obstruction_diameter: float = 0.0
    """m, of the secondary mirror."""
    detected_wavelength: float | None = None
    """m, where scattering changes it (Raman)."""

    def __post_init__(self) -> None:
        _checks.between("energy", self.energy, 1e-12, 1e3, "J")
        _checks.between("aperture_diameter", self.aperture_diameter, 1e-3, 50.0, "m")
        _checks.wavelength_in_metres("wavelength", self.wavelength)
        if self.detected_wavelength is not None:
            _checks.wavelength_in_metres("detected_wavelength", self.detected_wavelength)
        for name in ("optical_efficiency", "quantum_efficiency"):
            _checks.positive(name, getattr(self, name))
            _checks.between(name, getattr(self, name), 0.0, 1.0)
        _checks.between("bin_width", self.bin_width, 1e-3, 1e4, "m")
        _checks.not_negative("full_overlap_range", self.full_overlap_range, "m")
        limit = self.aperture_diameter * (1.0 - 1e-9)
        _checks.between("obstruction_diameter", self.obstruction_diameter, 0.0, limit, "m")

    @property
    def area(self) -> float:
        """Area that collects light, m2."""
        return 0.25 * math.pi * (self.aperture_diameter**2 - self.obstruction_diameter**2)

    @property
    def photon_energy(self) -> float:
        """Energy of a photon at the detector, J."""
        return PLANCK * SPEED_OF_LIGHT / (self.detected_wavelength or self.wavelength)

    @property
    def power_constant(self) -> float:
        r"""K of the power on the detector, W m3 sr: :math:`E A \eta c / 2` (`vasylkivskyi2009`)."""
        return self.energy * self.area * self.optical_efficiency * 0.5 * SPEED_OF_LIGHT

    @property
    def system_constant(self) -> float:
        """K of the rate of photoelectrons, MHz m3 sr."""
        return self.power_constant * (self.quantum_efficiency / self.photon_energy) * 1e-6

    @property
    def bin_time(self) -> float:
        """Time for which a bin is open after one shot, s, at 150 m per microsecond."""
        return self.bin_width / LICEL_RANGE_PER_MICROSECOND * 1e-6

    def rate(
        self,
        distance: Array,
        *,
        extinction: Array,
        backscatter: Array,
        returning_extinction: Array | None = None,
        path: Array | None = None,
        resolution: float | None = None,
    ) -> Array:
        """Return the mean rate of photoelectrons in the bins, MHz; see `pulsed_signal`."""
        return self.system_constant * self._signal(
            distance, extinction, backscatter, returning_extinction, path, resolution
        )

    def power(
        self,
        distance: Array,
        *,
        extinction: Array,
        backscatter: Array,
        returning_extinction: Array | None = None,
        path: Array | None = None,
        resolution: float | None = None,
    ) -> Array:
        """Return the mean power on the detector in the bins, W; see `pulsed_signal`.

        Power times `bin_time` is the energy of `vasylkivskyi2009`, equation 14.
        """
        return self.power_constant * self._signal(
            distance, extinction, backscatter, returning_extinction, path, resolution
        )

    def _signal(
        self,
        distance: Array,
        extinction: Array,
        backscatter: Array,
        returning: Array | None,
        path: Array | None,
        resolution: float | None,
    ) -> Array:
        return pulsed_signal(
            distance,
            extinction=extinction,
            backscatter=backscatter,
            system_constant=1.0,
            pulse=self.pulse,
            bin_width=self.bin_width,
            overlap=self.overlap or SineOverlap(self.full_overlap_range),
            returning_extinction=returning,
            path=path,
            resolution=resolution,
        )
