"""The page of the variables and flags of products, from their rows."""

from __future__ import annotations

from collections.abc import Iterator

from tables import table

from lidarops.flags import FIRST_OWN, PLACES, Quality
from lidarops.kinds import flags_of, kinds
from lidarops.netcdf.variables import NO_STANDARD_NAME, Row, layout_of


def page() -> str:
    """Return a section for each kind of product, and one for the bits of all."""
    return "\n".join([*_kinds(), *_bits()]) + "\n"


def _kinds() -> Iterator[str]:
    for kind in own_kinds():
        layout = layout_of(kind)
        yield f"\n## Variables of `{kind}`\n\n{layout.title}. {layout.comment}"
        rows = map(_cells, (*layout.coordinates, *layout.variables))
        yield from table(("variable", "what it is"), rows)


def own_kinds() -> list[str]:
    """Return the kinds of product of lidarops, without those that other packages add."""
    return [name for name, kind in kinds().items() if kind.package.startswith("lidarops.")]


def _cells(row: Row) -> tuple[str, ...]:
    units = (row.units or "").replace("{signal}", "mV or MHz")
    text = row.long_name + (" (not in every product)" if row.optional else "")
    if row.error_kind is not None and not row.uncertain:
        text += f"; {row.error_kind}"
    remark = (row.comment or "").replace(NO_STANDARD_NAME, "").strip()
    dims = ", ".join(row.dims) or "none"
    sentences = [f"{text}.", remark, f"*Unit:* {units or 'none'}. *Dimensions:* {dims}."]
    if row.standard_name:
        name, *modifier = row.standard_name.split(" ")
        sentences.append(f"*Standard name:* {' + '.join([f'`{name}`', *modifier])}.")
    return f"`{row.name}`", " ".join(filter(None, sentences))


def _bits() -> Iterator[str]:
    yield "\n## Bits of `quality_flag`"
    carriers: dict[tuple[int, str, str, str], list[str]] = {}
    for kind in own_kinds():
        for bit in flags_of(kind):
            row = (int(bit), bit.word, bit.severity.name.lower(), bit.description)
            carriers.setdefault(row, []).append(kind)
    yield from table(
        ("bit", "value", "severity", "meaning", "products"),
        [
            (f"`{word}`", str(value), severity, description, ", ".join(names))
            for (value, word, severity, description), names in sorted(carriers.items())
        ],
    )
    own = {kind: sum(bit >= 1 << FIRST_OWN for bit in flags_of(kind)) for kind in own_kinds()}
    left = [f"{PLACES - FIRST_OWN - count} in `{kind}`" for kind, count in own.items()]
    yield f"\nPlaces left for new bits: {FIRST_OWN - len(Quality)} in all kinds, {', '.join(left)}."
