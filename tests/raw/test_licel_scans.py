"""Files of scanning lidars of Raymetrics: pointing, interval and memories."""

from __future__ import annotations

import struct
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import xarray as xr
from support.cases import each
from support.licel_lines import new_header
from support.licel_strategies import naive_read, raw_file

from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.archive import open_archive
from lidarops.raw.formats import parse_raw_header

LINE_2 = " SCAN 18/10/2018 {} {} 0170 23.7534 38.0631 {} {} 15.0 1013.0"
GRID = " 37.0 162.0 25.0  00.0 -10.0 00.2  {}"
LASERS = " 0000014 0020 0000014 0000 04"
ANALOG = " 1 0 1 00004 1 0780 3.75 00355.p 0 0 09 000 12 {:06d} 0.500 BT0"
PHOTON = " 1 1 1 00004 1 0780 3.75 00355.p 0 0 00 000 00 {:06d} 4.3651 BC0"
CHANNELS = tuple(line.format(shots) for shots in (14, 13) for line in (ANALOG, PHOTON))
START = datetime(2018, 10, 18, 2, 59, 43, tzinfo=UTC)


def scan_file(
    elevation="-10.0",
    azimuth="37.0",
    *,
    offset="00.0",
    stop="18/10/2018 02:59:43",
    lasers=LASERS,
    **changes,
):
    """Return the bytes of a file of a scan, built without the writer under test."""
    line_2 = LINE_2.format("02:59:43", stop, elevation, azimuth)
    grid = GRID.format(offset)
    lines = {"line_2": line_2, "line_3": f"{grid.ljust(78)}\r\n{lasers}"}
    lines |= {"line_1": " R18A1802.594306", "datasets": CHANNELS}
    return raw_file(**(lines | changes))


@pytest.fixture
def saved(tmp_path):
    def save(content, name="R18A1802.594306"):
        (tmp_path / name).write_bytes(content)
        return tmp_path / name

    return save


@each(
    ("elevation", "azimuth", "offset", "expected"),
    [
        ("-10.0", "37.0", "00.0", (80.0, 37.0)),
        ("-3.4", "162.0", "00.0", (86.6, 162.0)),
        ("0.0", "87.0", "10.5", (90.0, 97.5)),
        ("-5.0", "137.0", "300.0", (85.0, 77.0)),
        # Off the grid: below and beyond it, between its steps, and at another azimuth.
        ("5.0", "37.0", "00.0", None),
        ("-20.0", "37.0", "00.0", None),
        ("-3.0", "50.0", "00.0", None),
        ("-3.0", "0.0", "00.0", None),
    ],
)
def test_elevations_of_a_scan_become_zenith_angles(elevation, azimuth, offset, expected):
    header = licel.parse_header(scan_file(elevation, azimuth, offset=offset))
    assert header.zenith_as_written == float(elevation)
    assert (header.temperature, header.pressure) == (288.15, 101_300.0)
    if expected is None:
        assert (header.zenith_angle, header.azimuth) == (None, None)
        assert f"{float(elevation):g} degree at azimuth {float(azimuth):g}" in header.doubt
    else:
        assert (header.zenith_angle, header.azimuth) == pytest.approx(expected)
        assert not header.doubt


def test_seven_values_without_a_grid_are_no_elevation():
    header = licel.parse_header(scan_file("-90.0", line_3=LASERS))
    assert (header.zenith_angle, header.scan) == (0.0, None)
    assert licel.parse_header(scan_file("10.0", line_3=LASERS)).zenith_angle == 10.0
    assert licel.parse_header(scan_file("-10.0", line_3=LASERS)).zenith_angle is None


@pytest.mark.parametrize("line", [GRID.format("00.0").replace("00.2", "2"), " 1.0" * 6, " 1.0" * 8])
def test_other_lines_are_no_grid(line):
    with pytest.raises(RawFormatError, match=r"header line 3|laser shots|number of datasets"):
        licel.parse_header(scan_file(line_3=f"{line}\r\n{LASERS}"))


@pytest.mark.parametrize(
    ("stop", "seconds", "notes"),
    [
        ("18/10/2018 02:59:43", 27 / 20, 0),
        ("18/10/2018 02:59:42", 27 / 20, 1),
        ("18/10/2018 02:59:48", 5.0, 0),
    ],
)
def test_the_interval_without_a_duration_follows_from_the_shots(stop, seconds, notes):
    header = licel.parse_header(scan_file(stop=stop))
    assert header.start == START
    assert header.stop == START + timedelta(seconds=seconds)
    assert sum("stop lies 1 s before start" in note for note in header.notes) == notes


def test_a_stop_long_before_the_start_is_refused():
    with pytest.raises(RawFormatError, match="before the start"):
        licel.parse_header(scan_file(stop="18/10/2018 02:59:41"))


def test_an_unknown_repetition_rate_gives_no_interval():
    header = licel.parse_header(scan_file(line_3=LASERS.replace("0020", "0000")))
    assert header.stop == header.start


@pytest.mark.parametrize("second", ["empty", "used"])
def test_counts_and_shots_of_both_memories_are_added(saved, second):
    rng = np.random.default_rng(1)
    counts = rng.integers(0, 4095 * 27 // 2, (4, 4), dtype=np.int32)
    if second == "empty":
        counts[2:] = 0
    path = saved(scan_file(data=[struct.pack("<4i", *row) for row in counts]))
    for opened in (
        open_archive(path, mask_and_scale=False),
        xr.open_dataset(path, engine="licel", mask_and_scale=False),
    ):
        assert sorted(set(opened) & {"analog_355p", "photon_355p", "analog_355p_2"}) == [
            "analog_355p",
            "photon_355p",
        ]
        for row, name in enumerate(("analog_355p", "photon_355p")):
            np.testing.assert_array_equal(opened[name].values[0], counts[row] + counts[row + 2])
            assert opened[f"{name}_shots"].item() == 27
            near = opened[name].isel(range=slice(0, 2)).values[0]
            np.testing.assert_array_equal(near, (counts[row] + counts[row + 2])[:2])
    physical = open_archive(path)["analog_355p"].values[0]
    np.testing.assert_allclose(physical, (counts[0] + counts[2]) * 500.0 / 27 / 4096, rtol=1e-6)


def test_memories_of_one_channel_only_are_added(saved):
    lines = (
        *CHANNELS[:2],
        CHANNELS[2].replace("BT0", "BT1"),
        CHANNELS[3].replace("1 1 1", "1 1 2"),
    )
    opened = open_archive(saved(scan_file(datasets=lines)))
    assert {"analog_355p", "analog_355p_2", "photon_355p", "photon_355p_2"} <= set(opened)


def test_the_shots_of_both_memories_are_compared_with_those_of_other_channels():
    third = tuple(line.replace("00355.p", "00387.o") for line in (CHANNELS[1], CHANNELS[3]))
    lines = (*CHANNELS, *third)
    lasers = LASERS.replace(" 04", " 06")
    assert licel.parse_header(scan_file(datasets=lines, lasers=lasers)).datasets
    damaged = (*lines[:-1], lines[-1].replace("000013", "000093"))
    with pytest.raises(RawFormatError, match="states 107 shots, all other channels 27") as error:
        licel.parse_header(scan_file(datasets=damaged, lasers=lasers))
    assert error.value.field == "shots of photon_387o"


def test_a_sum_beyond_32_bits_stays_above_full_scale(saved):
    largest = np.iinfo(np.int32).max
    data = [struct.pack("<4i", 1, 2, 3, largest)] * 4
    opened = open_archive(saved(scan_file(data=data)), mask_and_scale=False)
    assert opened["analog_355p"].values[0].tolist() == [2, 4, 6, largest]


@pytest.mark.parametrize(("peaks", "refused"), [(2, True), (1, False)])
def test_saturation_at_full_scale_of_other_shots_is_refused(peaks, refused):
    """A recorder saturates at full scale of the shots that it added."""
    counts = [4095 * 40] * peaks + [100] * (4 - peaks)
    content = scan_file(data=[struct.pack("<4i", *counts), *[bytes(16)] * 3])
    if refused:
        with pytest.raises(RawFormatError, match=r"states 27 shots.*full scale of 40") as error:
            parse_raw_header(content, file="a", size=len(content))
        assert error.value.field == "shots of analog_355p"
    else:
        parse_raw_header(content, file="a", size=len(content))


def test_saturation_at_full_scale_of_the_shots_is_accepted():
    content = scan_file(data=[struct.pack("<4i", *[4095 * 27] * 4), *[bytes(16)] * 3])
    assert parse_raw_header(content, file="a", size=len(content)).channels[0].shots == 27


# Real files


def real(data_root, path):
    file = data_root / "savant" / path
    content = file.read_bytes()
    return parse_raw_header(content, file=str(file), size=len(content))


TRAPS = {
    "2018-10-16-0347/R18A1603.485309": (None, None, 28, 1.4),
    "2018-10-18-0148-37dTo162/R18A1802.102165": (80.0, 162.0, 28, 1.4),
    "2018-10-18-0254/R18A1802.584599": (83.0, 37.0, 27, 1.35),
    "2018-10-18-0254/R18A1802.594306": (80.0, 37.0, 27, 1.35),
    "2018-10-18-0254/R18A1803.042664": (87.0, 87.0, 26, 1.3),
    "2018-10-18-0340hORIZONTALsCAN/R18A1803.413054": (90.0, 20.0, 27, 1.35),
    "2018-10-18-0500VerticalAgain/R18A1805.033420": (None, None, 115, 5.75),
    "2018-10-18-0755bACKGROUND90DEGREE/2018A18/RM18A1807.585": (0.0, 15.0, 101, 5.0),
}
"""Zenith angle, azimuth, shots and duration of real files."""


@each("path", TRAPS)
def test_real_files_state_pointing_shots_and_interval(path, data_root):
    zenith, azimuth, shots, seconds = TRAPS[path]
    header = real(data_root, path)
    assert (header.zenith_angle, header.azimuth) == (zenith, azimuth)
    assert bool(header.doubt) == (zenith is None)
    names = ["analog_355p", "photon_355p", "analog_355s", "photon_355s", "photon_387o"]
    assert [channel.name for channel in header.channels] == names
    assert {channel.shots for channel in header.channels} == {shots}
    assert header.stop - header.start == timedelta(seconds=seconds)


def test_real_analog_channels_saturate_at_full_scale_of_both_memories(data_root):
    path = data_root / "savant" / "2018-10-18-0500VerticalAgain/R18A1805.033420"
    opened = open_archive(path, mask_and_scale=False, header_position="ignore")
    counts = opened["analog_355s"].values[0]
    assert counts.max() == 115 * 4095 == opened["analog_355s"].attrs["full_scale"]
    raw = naive_read(
        path.read_bytes().replace(GRID.format("00.0").ljust(78).encode() + b"\r\n", b"")
    )
    of_memories = [values for tokens, values in raw[1] if tokens[-1] == "BT1"]
    np.testing.assert_array_equal(counts, np.add(*of_memories))


@pytest.mark.parametrize("name", ["3D_1.ini", "datalog.dat"])
def test_other_files_of_the_instrument_are_no_raw_files(name, data_root):
    (path,) = (data_root / "savant").rglob(name)
    with pytest.raises(RawFormatError, match="no known raw format"):
        parse_raw_header(path.read_bytes(), file=name, size=path.stat().st_size)


def test_real_scans_are_written_again_byte_by_byte(data_root):
    """From their counts, and their header text from numbers alone."""
    paths = sorted((data_root / "savant").rglob("R18*"))
    assert len(paths) >= 80
    for path in paths:
        content = path.read_bytes()
        header, counts = licel.read_counts(path)
        assert licel.encode(header, counts) == content
        text = new_header(
            name=header.name,
            site=header.site,
            start=header.start,
            stop=header.start,
            altitude=header.altitude,
            longitude=header.longitude,
            latitude=header.latitude,
            zenith_angle=header.zenith_as_written,
            azimuth=header.azimuth_as_written,
            temperature=header.temperature,
            pressure=header.pressure,
            scan=header.scan,
            lasers=header.lasers,
            datasets=header.datasets,
        ).source
        stated = f"{header.start:%d/%m/%Y %H:%M:%S}".encode()
        early = f"{header.start - timedelta(seconds=1):%d/%m/%Y %H:%M:%S}".encode()
        is_early = any("before start" in note for note in header.notes)
        if is_early:
            text = text.replace(stated + b" " + stated, stated + b" " + early)
        assert text == header.source
