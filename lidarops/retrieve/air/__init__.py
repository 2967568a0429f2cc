"""Air: its molecules and its visibility.

`molecular` gives number density, extinction and backscatter of molecules from the US Standard
Atmosphere or a sounding (`MolecularProfile`). `visibility` converts extinction to 550 nm
(`at_reference_wavelength`) and then to visibility (`visibility_from_extinction`).

`reference_window` selects the window in which a profile has the shape of clean air.

`visibility.visibility_of_extinction` does both, with a random and a systematic error.
"""

from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.air.visibility import at_reference_wavelength, visibility_from_extinction

__all__ = ["MolecularProfile", "at_reference_wavelength", "visibility_from_extinction"]
