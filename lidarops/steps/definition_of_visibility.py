"""The definition of visibility in a plan."""

from __future__ import annotations

from lidarops.retrieve.air.labeled import Definition
from lidarops.settings import LawName, SettingsModel, VisibilitySettings


class VisibilityDefinition(SettingsModel):
    """Definition of visibility, in the settings of a planned step."""

    contrast: float
    law: LawName
    angstrom_exponent: float | None = None
    exponent_standard_error: float

    @classmethod
    def of(cls, settings: VisibilitySettings) -> VisibilityDefinition:
        """Return the definition that a campaign requests."""
        return cls(
            contrast=settings.threshold,
            law=settings.law,
            angstrom_exponent=settings.angstrom_exponent,
            exponent_standard_error=settings.exponent_standard_error,
        )

    def at(self, wavelength: float) -> Definition:
        """Return the definition for extinction at a wavelength in m."""
        return Definition(
            wavelength=wavelength,
            contrast=self.contrast,
            law=self.law,
            angstrom_exponent=self.angstrom_exponent,
            exponent_standard_error=self.exponent_standard_error,
        )
