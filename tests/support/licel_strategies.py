"""Hypothesis strategies and hand-made bytes for Licel files."""

from __future__ import annotations

import struct
from datetime import UTC, datetime, timedelta

import numpy as np
from hypothesis import strategies as st

from lidarops.raw import licel
from support.licel_lines import new_dataset, new_header

ANALOG = " 1 0 1 00004 1 0800 7.50 00532.p 0 0 00 000 12 000101 0.500 BT0"
PHOTON = " 1 1 1 00004 1 0800 7.50 00532.p 0 0 00 000 00 000101 0.7937 BC0"
LINE_2 = " LidarPi  02/10/2024 17:30:00 02/10/2024 17:30:10 0411 -064.1 -031.2 00"
LINE_3 = " 0000101 0010 0000101 0000 {:02d}"


def raw_file(
    datasets=(ANALOG, PHOTON),
    *,
    line_1=" h24A0217.301035",
    line_2=LINE_2,
    line_3=None,
    data=None,
    last=b"\r\n",
) -> bytes:
    """Return the bytes of a file, built without the writer under test."""
    lines = [line_1, line_2, line_3 or LINE_3.format(len(datasets)), *datasets]
    head = b"".join(line.ljust(78).encode("latin-1") + b"\r\n" for line in lines) + b"\r\n"
    if data is None:
        data = [struct.pack("<4i", *(10 * k + j for j in range(4))) for k in range(len(datasets))]
    return head + b"\r\n".join(data) + last


def naive_read(content: bytes):
    """Read a classic file in the simplest way; return lines and rows of (tokens, counts)."""
    lines, position = [], 0
    while True:
        end = content.index(b"\r\n", position)
        line, position = content[position:end].decode(), end + 2
        if not line:
            break
        lines.append(line)
    rows = []
    for line in lines[3:]:
        tokens = line.split()
        bins = int(tokens[3])
        rows.append((tokens, struct.unpack_from(f"<{bins}i", content, position)))
        position += 4 * bins
        assert content[position : position + 2] == b"\r\n"
        position += 2
    assert position == len(content)
    return lines, rows


def naive_physical(tokens, counts):
    """Return mV or MHz by the formulas of the format description."""
    shots, width = int(tokens[13]), float(tokens[6])
    if tokens[1] == "0":
        return [c * float(tokens[14]) * 1000 / (shots * 2 ** int(tokens[12])) for c in counts]
    return [c / shots * (150.0 / width) for c in counts]


SIGNALS = st.sampled_from([licel.DatasetKind.ANALOG, licel.DatasetKind.PHOTON])
ACTIVE = st.just(True)
WIDTHS = st.sampled_from([0.75, 1.5, 3.75, 7.5, 15.0, 30.0, 60.0])
WORDS = st.text(st.sampled_from("abcXYZ019_-"), min_size=1, max_size=12)


@st.composite
def datasets(draw, kinds=SIGNALS, active=ACTIVE):
    return new_dataset(
        kind=draw(kinds),
        wavelength=draw(st.sampled_from([355, 387, 532, 607, 1064, 1550, 53200])) * 1e-9,
        bins=draw(st.integers(1, 40)),
        bin_width=draw(WIDTHS),
        # A file in which one channel contradicts the shots of all others is refused.
        shots=draw(st.one_of(st.just(0), st.shared(st.integers(1, 999_999), key="shots"))),
        polarisation=draw(st.sampled_from("opsrl")),
        laser=draw(st.integers(1, 3)),
        high_voltage=draw(st.integers(0, 1500)),
        adc_bits=draw(st.integers(8, 16)),
        input_range=draw(st.sampled_from([0.02, 0.1, 0.5])),
        discriminator=draw(st.integers(0, 63)) * 25e-3 / 63,
        device=draw(st.sampled_from(["BT0", "BC1", "S2A3"])),
        active=draw(active),
        laser_polarisation=draw(st.integers(0, 4)),
        bin_shift=draw(st.integers(0, 99_999)) / 1000,
    )


def _place(draw):
    dialect = draw(st.sampled_from(["classic", "extended", "raymetrics"]))
    if dialect == "extended":
        return {
            "zenith_angle": draw(st.integers(-900, 900)) / 10,
            "azimuth": draw(st.integers(0, 3599)) / 10,
            "custom": draw(st.none() | WORDS),
        }
    if dialect == "raymetrics":
        return {
            "zenith_angle": draw(st.sampled_from([-90.0, 0.0, 45.0])),
            "temperature": draw(st.integers(-300, 400)) / 10 + 273.15,
            "pressure": draw(st.integers(6000, 10800)) * 10.0,
        }
    return {"zenith_angle": float(draw(st.integers(-90, 90)))}


DATASETS = st.lists(datasets(), min_size=1, max_size=5)


@st.composite
def headers(draw, datasets=DATASETS):
    start = draw(
        st.datetimes(datetime(1990, 1, 1), datetime(2060, 1, 1), timezones=st.just(UTC))  # noqa: DTZ001
    ).replace(microsecond=0)
    laser = st.builds(licel.Laser, st.integers(0, 9_999_999), st.integers(0, 9999))
    return new_header(
        name=draw(WORDS),
        site=" ".join(draw(st.lists(WORDS, min_size=1, max_size=2))),
        start=start,
        stop=start + timedelta(seconds=draw(st.integers(0, 4000))),
        altitude=draw(st.integers(-100, 8000)),
        longitude=draw(st.integers(-1800, 1800)) / 10,
        latitude=draw(st.integers(-900, 900)) / 10,
        datasets=draw(datasets),
        lasers=draw(st.lists(laser, min_size=2, max_size=3)),
        **_place(draw),
    )


HEADERS = headers()


@st.composite
def files(draw, headers=HEADERS):
    """Draw a header, and counts for all datasets that it stores."""
    header = draw(headers)
    seed = draw(st.integers(0, 2**32 - 1))
    random = np.random.default_rng(seed)
    counts = {}
    for dataset in header.datasets:
        if dataset.offset is not None:
            values = random.integers(-(2**31), 2**31, dataset.bins, dtype=np.int64)
            # CRLF inside the data, and the extreme values.
            values[random.integers(dataset.bins)] = random.choice(
                [0x0A0D0A0D, 0x0A0D, -(2**31), 2**31 - 1]
            )
            counts[dataset.name] = values.astype(np.int32)
    return header, counts
