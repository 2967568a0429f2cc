"""Quality flags: the bits of ``quality_flag``, with their severity and description.

The CF flag attributes of every product follow from this module. A value of ``quality_flag`` is a
bit mask; 0 means that no test failed. The retrievals in `lidarops.retrieve` and the steps in
`lidarops.process` raise the bits. `lidarops/products/KIND/variables.py` lists the bits that a kind
of product can carry.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag


class Severity(IntEnum):
    """What a raised bit means for the use of the value."""

    CARE = 1
    """Use with care: the value is valid, but its stated uncertainty may be too small."""
    REJECT = 2
    """Do not use: the value does not represent the named quantity."""


class Quality(IntFlag):
    """Quality bits of all products. Their names in lower case are the CF ``flag_meanings``."""

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
        """What a single bit means, as a phrase without a full stop."""
        return _ABOUT[self][1]

    @property
    def severity(self) -> Severity:
        """Severity of a single bit."""
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
    Quality.INPUT_MISSING: (
        Severity.REJECT,
        "the raw data are missing or not finite",
    ),
    Quality.SATURATED: (
        Severity.REJECT,
        (
            "the digitiser is at full scale in at least some shots, or the photon counter is "
            "paralysed"
        ),
    ),
    Quality.PILE_UP: (
        Severity.CARE,
        (
            "the dead-time effect on the count rate exceeds 10 percent, or 1 percent where the "
            "dead time is unknown"
        ),
    ),
    Quality.INCOMPLETE_OVERLAP: (
        Severity.REJECT,
        (
            "the range is shorter than that of full overlap between laser beam and telescope "
            "field of view"
        ),
    ),
    Quality.TOO_FEW_BINS: (
        Severity.REJECT,
        "the section has fewer than 8 valid range bins",
    ),
    Quality.NO_SIGNAL: (
        Severity.REJECT,
        "the profile is constant: it contains no backscatter",
    ),
    Quality.LOW_SIGNAL: (
        Severity.REJECT,
        (
            "the backscatter signal is less than 5 times its standard error, or so small that "
            "noise may have shifted the root of the cubic"
        ),
    ),
    Quality.POORLY_DETERMINED: (
        Severity.REJECT,
        "the standard error of extinction exceeds 15 percent of (extinction + 1 / mean range)",
    ),
    Quality.NEGATIVE_AMPLITUDE: (
        Severity.REJECT,
        "the fitted amplitude is not positive",
    ),
    Quality.AT_BOUND: (
        Severity.REJECT,
        "the extinction lies at a bound of its physical range",
    ),
    Quality.POOR_FIT: (
        Severity.REJECT,
        "the residuals do not match the stated noise: too large or too small (reduced chi-square)",
    ),
    Quality.NOT_HOMOGENEOUS: (
        Severity.REJECT,
        "the residuals vary systematically with range: the path is not homogeneous",
    ),
    Quality.OUTLIER: (
        Severity.CARE,
        "at least one bin deviates by more than 5 standard errors",
    ),
    Quality.NO_REAL_SOLUTION: (
        Severity.REJECT,
        "the estimating equation has no admissible real root",
    ),
    Quality.NOT_LEVEL: (
        Severity.REJECT,
        (
            "the altitude of the path changes by more than 100 m along the section, so a vertical "
            "gradient of backscatter would mimic extinction"
        ),
    ),
    Quality.BACKGROUND_UNCERTAIN: (
        Severity.CARE,
        (
            "the background may contain signal: signal before the far range implies some there, or "
            "the bins of the background do not look like what its method assumes"
        ),
    ),
    Quality.NO_GLUING: (
        Severity.REJECT,
        (
            "there is no range in which the analog and the photon-counting signal are both "
            "linear, so they are not glued"
        ),
    ),
    Quality.CLOUD: (
        Severity.CARE,
        (
            "in a cloud, or behind one as seen from the start of the inversion, where the lidar "
            "ratio of aerosol does not hold"
        ),
    ),
    Quality.NO_REFERENCE: (
        Severity.REJECT,
        ("no range window passes the tests for aerosol-free air, so the profile is not calibrated"),
    ),
    Quality.UNSTABLE_INVERSION: (
        Severity.REJECT,
        (
            "numerically unstable (near-zero denominator), or beyond the range that the boundary "
            "value constrains"
        ),
    ),
    Quality.NO_LEVERAGE: (
        Severity.REJECT,
        "the zenith angles are too few or too similar to determine an optical depth",
    ),
    Quality.POOR_STRATIFICATION: (
        Severity.REJECT,
        "the signals of the slant paths differ by more than level layers allow",
    ),
    Quality.PRIOR_DOMINATED: (
        Severity.CARE,
        "smoothness or another prior determines the extinction more than the data do",
    ),
    Quality.EXTRAPOLATED: (
        Severity.REJECT,
        "beyond the reach of the signals, where only the prior would determine the value",
    ),
    Quality.INTERPOLATED: (
        Severity.CARE,
        "in a gap of the data, interpolated from the altitudes above and below",
    ),
    Quality.ONE_SIDED: (
        Severity.CARE,
        (
            "the scan covers one side of the zenith only, so a horizontal gradient cannot be "
            "detected and its systematic error is stated separately"
        ),
    ),
    Quality.LOW_LEVERAGE: (
        Severity.CARE,
        "the slant paths differ little, so the result is sensitive to small signal errors",
    ),
    Quality.NO_RESIDUAL: (
        Severity.CARE,
        "there are as many unknowns as angles, so no residual tests the result",
    ),
    Quality.UNDERSMOOTHED: (
        Severity.CARE,
        "the profile has more vertical structure than its errors explain",
    ),
    Quality.HIGH_CORRELATION: (
        Severity.CARE,
        (
            "errors of neighbouring altitudes are correlated by more than 0.85: confidence "
            "intervals are too narrow"
        ),
    ),
    Quality.HORIZONTAL_GRADIENT: (
        Severity.REJECT,
        "the residuals over zenith angle show a horizontal gradient",
    ),
}
