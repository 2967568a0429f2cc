"""Licel files written again in the raw format ``csv`` of the package in ``tests/plugin``."""

from __future__ import annotations

from pathlib import Path

from lidarops.raw import licel


def as_csv(path: Path) -> str:
    """Return the counts of a Licel file with one number of bins and shots as CSV."""
    header, counts = licel.read_counts(path)
    first = header.channels[0]
    lines = [
        f"# start: {header.start.isoformat()}",
        f"# stop: {header.stop.isoformat()}",
        f"# zenith_angle: {header.zenith_angle}",
        f"# shots: {first.shots}",
        f"# bins: {first.bins}",
        f"# bin_width: {first.bin_width}",
    ]
    for channel in header.channels:
        analog = f" adc_bits={channel.adc_bits} input_range={channel.input_range}"
        lines.append(f"# channel: {channel.name}{analog if channel.adc_bits else ''}")
    rows = zip(*(counts[channel.name].tolist() for channel in header.channels), strict=True)
    return "\n".join([*lines, *(",".join(map(str, row)) for row in rows)]) + "\n"


def convert(source: Path, target: Path) -> list[Path]:
    """Write all Licel files of a folder as CSV files of the same names in another folder."""
    written = []
    for path in sorted(path for path in source.rglob("*") if path.is_file()):
        file = target / path.relative_to(source)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(as_csv(path), encoding="ascii")
        written.append(file)
    return written
