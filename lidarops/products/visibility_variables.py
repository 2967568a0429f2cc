"""The rows of visibility, which products of homogeneous paths and of networks share."""

from __future__ import annotations

from lidarops.netcdf.variables import NO_NAME, Coverage, Row


def visibility(
    dims: tuple[str, ...], *, called: str, ancillaries: tuple[str, ...], optional: bool
) -> tuple[Row, ...]:
    """Return the rows of visibility and of its interval.

    Parameters
    ----------
    dims : tuple of str
    called : str
        What it is of, in words.
    ancillaries : tuple of str
        Of the extinction that it is made of.
    optional : bool
        Whether a product may lack it.
    """
    limits = ("visibility_in_air_lower", "visibility_in_air_upper")
    return (
        Row(
            name="visibility_in_air",
            dims=dims,
            dtype="f4",
            units="m",
            standard_name="visibility_in_air",
            long_name=f"visibility {called}",
            coverage=Coverage.PHYSICAL,
            cell_methods="time: mean",
            ancillaries=(*limits, *ancillaries),
            uncertain=True,
            optional=optional,
            comment="-ln(contrast) / extinction of the interval, which is no mean of visibilities."
            " lidarops_steps tells the contrast, and how extinction was brought to 550 nm where it"
            " was. Missing where extinction is not positive.",
        ),
        *(
            Row(
                name=f"visibility_in_air_{end}",
                dims=dims,
                dtype="f4",
                units="m",
                long_name=f"{end} end of the interval of visibility {called}",
                coverage=Coverage.QUALITY,
                valid_min=0.0,
                optional=optional,
                comment=f"Of extinction {sign} its random and systematic error, as the root of the"
                f" sum of squares; the interval is not symmetric. {NO_NAME}",
            )
            for end, sign in (("lower", "plus"), ("upper", "minus"))
        ),
    )
