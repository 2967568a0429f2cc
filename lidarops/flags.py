"""Quality of a retrieved or measured value: the one source of every CF flag attribute.

A value is a bit mask; 0 means that no test failed.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag


class Severity(IntEnum):
    """What a raised bit asks of the person who uses the value."""

    CARE = 1
    """Use with care: the value stands, its uncertainty may be understated."""
    REJECT = 2
    """Do not use: the value does not mean what its name says."""


class Quality(IntFlag):
    """Quality bits of every product. Names become CF ``flag_meanings`` in lower case."""

    INPUT_MISSING = 1 << 0
    SATURATED = 1 << 1
    PILE_UP = 1 << 2
    INCOMPLETE_OVERLAP = 1 << 3
    TOO_FEW_BINS = 1 << 4
    NO_SIGNAL = 1 << 5
    LOW_SIGNAL = 1 << 6
    POORLY_DETERMINED = 1 << 7
    NEGATIVE_AMPLITUDE = 1 << 8
    AT_BOUND = 1 << 9
    POOR_FIT = 1 << 10
    NOT_HOMOGENEOUS = 1 << 11
    OUTLIER = 1 << 12
    NO_REAL_SOLUTION = 1 << 13
    NOT_LEVEL = 1 << 14
    BACKGROUND_UNCERTAIN = 1 << 15
    NO_GLUING = 1 << 16
    CLOUD = 1 << 17
    NO_REFERENCE = 1 << 18
    UNSTABLE_INVERSION = 1 << 19
    NO_LEVERAGE = 1 << 20
    POOR_STRATIFICATION = 1 << 21
    PRIOR_DOMINATED = 1 << 22
    EXTRAPOLATED = 1 << 23
    INTERPOLATED = 1 << 24
    ONE_SIDED = 1 << 25
    LOW_LEVERAGE = 1 << 26
    NO_RESIDUAL = 1 << 27
    UNDERSMOOTHED = 1 << 28
    HIGH_CORRELATION = 1 << 29
    HORIZONTAL_GRADIENT = 1 << 30

    @property
    def description(self) -> str:
        """One sentence on what the single bit means."""
        return _ABOUT[self][1]

    @property
    def severity(self) -> Severity:
        """What the single bit asks of the user."""
        return _ABOUT[self][0]

    @classmethod
    def rejecting(cls) -> Quality:
        """Return the union of the bits whose severity is `Severity.REJECT`."""
        union = cls(0)
        for bit in cls:
            if bit.severity is Severity.REJECT:
                union |= bit
        return union


_ABOUT: dict[Quality, tuple[Severity, str]] = {
    Quality.INPUT_MISSING: (Severity.REJECT, "the raw data are missing or not finite"),
    Quality.SATURATED: (
        Severity.REJECT,
        (
            "the digitiser is at full scale, in some shots at least, or the photon counter is"
            " paralysed"
        ),
    ),
    Quality.PILE_UP: (
        Severity.CARE,
        (
            "the dead-time effect on the count rate exceeds 10 percent, or 1 percent where the"
            " dead time is not known"
        ),
    ),
    Quality.INCOMPLETE_OVERLAP: (
        Severity.REJECT,
        "nearer than the range of full overlap of beam and telescope",
    ),
    Quality.TOO_FEW_BINS: (Severity.REJECT, "fewer than 8 valid range bins in the section"),
    Quality.NO_SIGNAL: (Severity.REJECT, "the profile is constant: it holds no backscatter"),
    Quality.LOW_SIGNAL: (
        Severity.REJECT,
        (
            "the backscattered signal is less than 5 times its standard error,"
            " or so small that noise may have moved the root of the cubic"
        ),
    ),
    Quality.POORLY_DETERMINED: (
        Severity.REJECT,
        "the standard error of extinction exceeds 15 percent of extinction plus 1 / mean range",
    ),
    Quality.NEGATIVE_AMPLITUDE: (Severity.REJECT, "the fitted amplitude is not positive"),
    Quality.AT_BOUND: (Severity.REJECT, "the extinction lies at a bound of its physical range"),
    Quality.POOR_FIT: (
        Severity.REJECT,
        "the residuals are larger or smaller than the noise allows (reduced chi-square)",
    ),
    Quality.NOT_HOMOGENEOUS: (
        Severity.REJECT,
        "the residuals vary systematically along range: the path is not homogeneous",
    ),
    Quality.OUTLIER: (Severity.CARE, "at least one bin lies more than 5 standard errors off"),
    Quality.NO_REAL_SOLUTION: (
        Severity.REJECT,
        "the estimating equation has no admissible real root",
    ),
    Quality.NOT_LEVEL: (
        Severity.REJECT,
        (
            "the path changes its height by more than 100 m along the section, so that extinction"
            " cannot be told from backscatter that changes with height"
        ),
    ),
    Quality.BACKGROUND_UNCERTAIN: (
        Severity.CARE,
        (
            "the far range does not look like air without aerosol, so that signal may be left in"
            " the background"
        ),
    ),
    Quality.NO_GLUING: (
        Severity.REJECT,
        "no range where analog and photon counting signals are both linear: they are not joined",
    ),
    Quality.CLOUD: (
        Severity.CARE,
        (
            "in a cloud, or behind one as seen from where the inversion starts, where the lidar"
            " ratio of aerosol does not hold"
        ),
    ),
    Quality.NO_REFERENCE: (
        Severity.REJECT,
        "no range window passes the tests of air without aerosol, so that nothing is calibrated",
    ),
    Quality.UNSTABLE_INVERSION: (
        Severity.REJECT,
        "the inversion divides by nearly nothing, or lies beyond what its boundary value reaches",
    ),
    Quality.NO_LEVERAGE: (
        Severity.REJECT,
        "the angles are too few or too much alike for an optical depth",
    ),
    Quality.POOR_STRATIFICATION: (
        Severity.REJECT,
        "the air differs along the slant paths more than layers that are level allow for",
    ),
    Quality.PRIOR_DOMINATED: (
        Severity.CARE,
        "smoothness, or another prior, decides the extinction more than the data do",
    ),
    Quality.EXTRAPOLATED: (
        Severity.REJECT,
        "beyond the reach of the signals, where only the prior would speak",
    ),
    Quality.INTERPOLATED: (
        Severity.CARE,
        "in a gap of the data, bridged from the heights above and below",
    ),
    Quality.ONE_SIDED: (
        Severity.CARE,
        (
            "the scan looks to one side only, so that a horizontal gradient is not seen; its"
            " systematic error is given apart"
        ),
    ),
    Quality.LOW_LEVERAGE: (
        Severity.CARE,
        "the slant paths differ little, so that small errors of the signal count much",
    ),
    Quality.NO_RESIDUAL: (
        Severity.CARE,
        "as many unknowns as angles: nothing tests the result",
    ),
    Quality.UNDERSMOOTHED: (
        Severity.CARE,
        "more structure over height than the errors allow for",
    ),
    Quality.HIGH_CORRELATION: (
        Severity.CARE,
        "errors of neighbouring heights are alike by more than 0.85: intervals are too narrow",
    ),
    Quality.HORIZONTAL_GRADIENT: (
        Severity.REJECT,
        "the residuals over angle show a horizontal gradient",
    ),
}
