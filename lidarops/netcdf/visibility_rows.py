"""The variables of visibility, which the products ``homogeneous`` and ``visibility`` share."""

from __future__ import annotations

from lidarops.netcdf.variables import NO_STANDARD_NAME, Coverage, Row


def visibility_rows(
    dims: tuple[str, ...], *, place: str, ancillaries: tuple[str, ...], optional: bool
) -> tuple[Row, ...]:
    """Return the rows of visibility and of the limits of its uncertainty interval.

    Parameters
    ----------
    dims : tuple of str
    place : str
        Where the visibility applies, as the end of a phrase.
    ancillaries : tuple of str
        Ancillary variables of the extinction from which visibility follows.
    optional : bool
        Whether a product may lack the variables.
    """
    limits = ("visibility_in_air_lower", "visibility_in_air_upper")
    return (
        Row(
            name="visibility_in_air",
            dims=dims,
            dtype="f4",
            units="m",
            standard_name="visibility_in_air",
            long_name=f"visibility {place}",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=(*limits, *ancillaries),
            uncertain=True,
            lower_end=limits[0],
            optional=optional,
            comment="-ln(contrast) / extinction of the averaging interval, not a mean of"
            " visibilities. lidarops_steps states the contrast and, where applied, the conversion"
            " of extinction to 550 nm. Missing where extinction is not positive.",
        ),
        *(
            Row(
                name=f"visibility_in_air_{end}",
                dims=dims,
                dtype="f4",
                units="m",
                long_name=f"{end} limit of the uncertainty interval of visibility {place}",
                coverage=Coverage.QUALITY,
                valid_min=0.0,
                optional=optional,
                comment=f"Visibility for extinction {sign} its combined random and systematic error"
                " (root of the sum of squares); the interval is not symmetric."
                f" {NO_STANDARD_NAME}",
            )
            for end, sign in (("lower", "plus"), ("upper", "minus"))
        ),
    )
