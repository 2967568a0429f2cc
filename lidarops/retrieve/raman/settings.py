"""What a Raman retrieval assumes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.raman.scattering import particle_ratio


@dataclass(frozen=True, slots=True)
class RamanSettings:
    """What is assumed, with standard errors."""

    wavelength: float
    """m, of the laser."""
    raman_wavelength: float
    """m."""
    angstrom_exponent: float
    """Of particle extinction between both wavelengths."""
    angstrom_standard_error: float
    lowest: float
    """m, least range of the reference window."""
    highest: float
    """m, largest range of the reference window."""
    width: float
    """m, of the reference window."""
    scattering_ratio: float
    """Total over molecular backscatter in the reference window."""
    reference_relative_error: float
    molecular_relative_error: float
    """Of the density of air."""
    overlap_relative_error: float = 0.0
    """Of one minus the overlap."""
    molecular_slope_error: float = 0.0
    """m-1 along the beam, of the derivative of the logarithm of the density of air."""

    @property
    def ratio(self) -> float:
        """Particle extinction at the Raman wavelength over that at the laser's."""
        return particle_ratio(self.angstrom_exponent, self.wavelength, self.raman_wavelength)

    @property
    def ratio_error(self) -> float:
        """Standard error of `ratio`."""
        colour = abs(float(np.log(self.wavelength / self.raman_wavelength)))
        return self.ratio * colour * self.angstrom_standard_error
