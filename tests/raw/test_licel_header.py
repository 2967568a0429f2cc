"""Variants of the header, and refused headers."""

from __future__ import annotations

import math
import os
import struct
import tracemalloc
from datetime import UTC, datetime

import numpy as np
import pytest
from support.cases import each
from support.licel_strategies import ANALOG, LINE_2, LINE_3, PHOTON, raw_file
from support.physical import read_physical

from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.archive import open_archive
from lidarops.raw.formats import parse_raw_header, read_start
from lidarops.records import DetectionMode

DATES = "02/10/2024 17:30:00 02/10/2024 17:30:10"


def parse(**changes) -> licel.Header:
    return licel.parse_header(raw_file(**changes), file="x.dat")


def place(text: str) -> licel.Header:
    return parse(line_2=f" LidarPi  {DATES} {text}")


@each(
    ("written", "site"),
    [
        (" LidarPi  ", "LidarPi"),
        (" Manaus ", "Manaus"),
        (" Sao Paul ", "Sao Paul"),
        (" Papapardo_Sim ", "Papapardo_Sim"),
        (" S\xe3o Paulo lab 2 ", "S\xe3o Paulo lab 2"),
        (" ", ""),
    ],
)
def test_site(written, site):
    header = parse(line_2=f"{written}{DATES} 0411 -064.1 -031.2 00")
    assert header.site == site
    assert header.start == datetime(2024, 10, 2, 17, 30, tzinfo=UTC)
    assert header.stop == datetime(2024, 10, 2, 17, 30, 10, tzinfo=UTC)
    assert (header.altitude, header.longitude, header.latitude) == (411.0, -64.1, -31.2)


def test_classic_place():
    header = place("07.5 -058.4 -034.6 72")
    assert header.altitude == 7.5
    assert header.zenith_angle == 72.0
    assert (header.azimuth, header.temperature, header.pressure) == (None, None, None)
    assert header.notes == ()


def test_raymetrics_place():
    header = place("0100 -060.0 -003.1 -90 00 30.0 1013.0")
    assert header.azimuth is None
    assert header.temperature == pytest.approx(303.15)
    assert header.pressure == pytest.approx(101_300.0)
    assert header.zenith_angle == 0.0


def test_impossible_weather_is_ignored():
    header = place("0100 -060.0 -003.1 00 00 00.0 0000.0")
    assert (header.temperature, header.pressure) == (None, None)
    assert "impossible" in header.notes[0]


def test_newer_place():
    header = place('0411 -064.103125 -031.667812 72.5 359.9 "scan 3, ""north"" "')
    assert (header.longitude, header.latitude) == (-64.103125, -31.667812)
    assert (header.zenith_angle, header.azimuth) == (72.5, 359.9)
    assert header.custom == 'scan 3, ""north"" '


@pytest.mark.parametrize(("text", "azimuth"), [("000.0", 0.0), ("-10.0", 350.0), ("270", 270.0)])
def test_fifth_value_is_the_azimuth(text, azimuth):
    assert place(f"0411 -064.1 -031.2 10.0 {text}").azimuth == azimuth


def test_seven_values_with_azimuth():
    header = place("0411 -064.1 -031.2 10.0 270.0 20.0 1000.0")
    assert (header.azimuth, header.temperature) == (270.0, pytest.approx(293.15))


def test_surplus_values_are_noted():
    assert "2 values" in place("0411 -064.1 -031.2 10 1 2").notes[0]


def test_decimal_comma():
    header = parse(
        line_2=f" X {DATES} 0411 -064,1 -031,2 10,5 090,0",
        datasets=(ANALOG.replace("7.50", "7,50").replace("0.500", "0,500"),),
    )
    assert header.position() == (-31.2, -64.1)
    assert (header.zenith_angle, header.azimuth) == (10.5, 90.0)
    assert header.datasets[0].bin_width == 7.5
    assert header.datasets[0].input_range == 0.5


@each(
    ("written", "angle", "notes"),
    [("00", 0, 0), ("-90.0", 0, 1), ("90", 90, 0), ("-30", None, 0), ("-45.5", None, 0)],
)
def test_zenith_angle(written, angle, notes):
    header = place(f"0411 -064.1 -031.2 {written}")
    assert header.zenith_angle == angle
    assert header.zenith_as_written == float(written)
    assert len(header.notes) == notes
    assert bool(header.doubt) == (angle is None)


def test_position_order_and_refusal():
    header = place("0048 0048.7 0102.2 00")
    assert header.position("latitude_first") == (48.7, 102.2)
    with pytest.raises(RawFormatError, match="header_position") as error:
        header.position()
    assert error.value.file == "x.dat"


@pytest.mark.parametrize(
    ("line", "lasers", "timestamp"),
    [
        (LINE_3.format(2), ((101, 10.0), (101, 0.0)), None),
        (
            " 0000101 0010 0000101 0000 02 0000050 0005",
            ((101, 10.0), (101, 0.0), (50, 5.0)),
            None,
        ),
        (
            " 0000101 0010 0000101 0000 02 0000050 0005 0000000 0000",
            ((101, 10.0), (101, 0.0), (50, 5.0)),
            None,
        ),
        (
            " 0000101 0010 0000101 0000 02 0000050 0005 0000000 0000 83417529",
            ((101, 10.0), (101, 0.0), (50, 5.0)),
            "83417529",
        ),
    ],
)
def test_lasers(line, lasers, timestamp):
    header = parse(line_3=line)
    assert (header.lasers, header.timestamp, header.notes) == (lasers, timestamp, ())


def test_surplus_laser_values_are_noted():
    assert "line 3" in parse(line_3=LINE_3.format(2) + " 7").notes[0]


@pytest.mark.parametrize(("text", "width"), [("7.50", 7.5), ("15.0", 15.0), ("0015", 15.0)])
def test_bin_width(text, width):
    assert parse(datasets=(ANALOG.replace("7.50", text),)).datasets[0].bin_width == width


def test_datasets():
    analog, photon = parse().datasets
    assert (analog.name, photon.name) == ("analog_532p", "photon_532p")
    assert analog.mode is DetectionMode.ANALOG
    assert photon.mode is DetectionMode.PHOTON
    assert analog.wavelength == pytest.approx(532e-9, rel=1e-12)
    assert (analog.input_range, analog.discriminator) == (0.5, None)
    assert photon.input_range is None
    assert photon.discriminator == pytest.approx(0.7937e-3)
    assert photon.offset == analog.offset + 4 * 4 + 2
    assert analog.scale == pytest.approx(500 / (101 * 4096), rel=1e-15)
    assert photon.scale == pytest.approx(20 / 101, rel=1e-15)
    assert (analog.full_scale, photon.full_scale) == (101 * 4095, None)


def test_bin_shift_and_comment():
    line = ANALOG.replace("00 000 12", "08 625 12") + " far range"
    dataset = parse(datasets=(line,)).datasets[0]
    assert dataset.bin_shift == 8.625
    assert dataset.comment == "far range"


def test_equal_names_are_numbered():
    header = parse(datasets=(ANALOG, PHOTON, ANALOG, ANALOG))
    names = [dataset.name for dataset in header.datasets]
    assert names == ["analog_532p", "photon_532p", "analog_532p_2", "analog_532p_3"]


def test_mistyped_wavelength():
    dataset = parse(datasets=(ANALOG.replace("00532.p", "53200.o"),)).datasets[0]
    assert dataset.name == "analog_53200o"
    assert math.isnan(dataset.wavelength)


@each(
    ("shots", "refused"),
    [
        (("101", "101", "101"), False),
        (("101", "181", "101"), True),
        # The lasers fired 101 times; a recorder of two datasets may have missed triggers.
        (("100", "100", "101"), False),
        # Line 3 states 101, as the other channel of the same recorder.
        (("101", "181"), True),
        (("000", "101", "101"), False),
    ],
)
def test_shots_that_all_other_channels_contradict_are_refused(shots, refused):
    lines = (ANALOG, PHOTON, ANALOG.replace("00532.p", "00355.o"))
    data = tuple(
        line.replace("000101", number.zfill(6)) for line, number in zip(lines, shots, strict=False)
    )
    if refused:
        with pytest.raises(
            RawFormatError, match="states 181 shots, all other channels 101"
        ) as error:
            parse(line_3=LINE_3.format(len(data)), datasets=data)
        assert error.value.field == "shots of photon_532p"
    else:
        assert parse(line_3=LINE_3.format(len(data)), datasets=data).datasets


@pytest.mark.parametrize(
    ("analog", "photon", "recorder"), [("101", "100", "BC3"), ("100", "181", "BC0")]
)
def test_a_channel_of_another_recorder_or_line_3_alone_contradict_no_shots(
    analog, photon, recorder
):
    first = ANALOG.replace("000101", analog.zfill(6))
    second = PHOTON.replace("000101", photon.zfill(6)).replace("BC0", recorder)
    assert parse(line_3=LINE_3.format(2), datasets=(first, second)).datasets


def test_shots_of_a_single_channel_that_line_3_contradicts_are_noted():
    note = "photon_532p states 601 shots, line 3 101"
    assert note in parse(datasets=(PHOTON.replace("000101", "000601"),)).notes
    for line_3, shots in ((LINE_3, "000101"), (LINE_3.replace("0000101", "0000000"), "000601")):
        header = parse(line_3=line_3.format(1), datasets=(PHOTON.replace("000101", shots),))
        assert header.notes == ()


def test_an_interval_of_more_than_a_day_is_refused():
    """A damaged date; a file from midnight to midnight is none."""
    parse(line_2=" LidarPi  02/10/2024 00:00:00 03/10/2024 00:00:00 0411 -064.1 -031.2 00")
    with pytest.raises(RawFormatError, match=r"lies 1\.0 days after the start") as error:
        parse(line_2=f" LidarPi  {DATES.replace(' 02/', ' 03/')} 0411 -064.1 -031.2 00")
    assert error.value.field == "stop"


@pytest.mark.parametrize(
    ("name", "refused"),
    [
        ("h24A0217.301035", False),
        # By local time, or of the stop.
        ("h24A0122.301035", False),
        ("RM24A0217.301", False),
        ("h24A0317.304512", True),
        ("h23A0217.301035", True),
        ("RM2490217.301", True),
        # Names that tell no time.
        ("morning.dat", False),
        ("h24A4217.301035", False),
        ("2024100217.3010", False),
        # Of the last century.
        ("a99A0217.301035", True),
    ],
)
def test_a_start_far_from_the_time_in_the_name_is_refused(name, refused):
    content = raw_file(line_1=f" {name}")
    if not refused:
        assert licel.parse_header(content).start == datetime(2024, 10, 2, 17, 30, tzinfo=UTC)
        return
    header = licel.parse_header(content)
    with pytest.raises(RawFormatError, match=f"states 2024-10-02 17:30.*{name}") as error:
        header.check_time()
    assert error.value.field == "start"
    assert read_start(content) is None


def test_years_before_the_first_recorders_are_refused():
    with pytest.raises(RawFormatError, match="1970 is not within 1990") as error:
        parse(line_2=" LidarPi  01/01/1970 00:00:00 01/01/1970 00:00:10 0411 -064.1 -031.2 00")
    assert error.value.field == "start"
    line = " LidarPi  01/01/1970 00:00:00 01/01/1970 00:00:10 0411 -064.1 -031.2 00"
    with pytest.raises(
        RawFormatError, match=r"a24A0217.301035\) 2024-10-02 17:30 \(leave the file"
    ):
        parse(line_1=" a24A0217.301035", line_2=line)


def test_values_without_shots_are_nan(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(raw_file((ANALOG.replace("000101", "000000"), PHOTON)))
    (header,), values = read_physical([path])
    assert np.isnan(values["analog_532p"]).all()
    assert np.isfinite(values["photon_532p"]).all()
    assert "no shots" in header.notes[0]


OTHERS = (
    " 1 2 1 00004 1 0800 7.50 00532.p 0 0 00 000 12 000101 0.500 S2A0",
    " 1 3 1 00003 1 0800 7.50 00532.p 0 0 00 000 00 000101 0.7937 S2P0",
    " 1 4 0 00002 0 0000 0.00 00000.o 0 0 00 000 00 000101 0.0000 PD0",
    " 1 5 0 00004 0 0000 7.50 00000.o 0 0 00 000 00 000101 0.0000 OF0",
)


def test_datasets_that_are_no_signal_do_not_move_the_others(tmp_path):
    lengths = (4, 4, 3, 2, 4, 4)
    data = [struct.pack(f"<{n}i", *range(100 * k, 100 * k + n)) for k, n in enumerate(lengths)]
    content = raw_file((ANALOG, *OTHERS, PHOTON), data=data)
    path = tmp_path / "x"
    path.write_bytes(content)
    header, counts = licel.read_counts(path)
    assert [d.name for d in header.channels] == ["analog_532p", "photon_532p"]
    assert counts["photon_532p"].tolist() == [500, 501, 502, 503]
    assert [d.mode for d in header.datasets[1:5]] == [None] * 4
    assert header.notes == ("dataset PD0 cannot be a signal and is left out",)
    assert all(math.isnan(d.scale) for d in header.datasets[1:5])
    assert len(header.layout) == 2
    every = [dataset.name for dataset in header.datasets]
    _, counts = licel.read_counts(path, every)
    assert counts["power_meter_0o"].tolist() == [300, 301]
    assert licel.encode(header, counts) == content


INACTIVE = ANALOG.replace(" 1 0", " 0 0", 1)


@pytest.mark.parametrize(
    "line",
    [
        ANALOG.replace(" 12 0", " 00 0"),
        ANALOG.replace(" 12 0", " 00 0").replace("0.500", "0.000"),
        ANALOG.replace(" 1 0", " 1 2", 1).replace(" 12 0", " 00 0"),
        ANALOG.replace(" 1 0", " 1 6", 1).replace("BT0", "PD0"),
        ANALOG.replace("00532.p", "green").replace("BT0", "PD1"),
        ANALOG.replace("7.50", "none").replace("BT0", "PM0"),
    ],
)
def test_a_dataset_that_cannot_be_a_signal_costs_itself_alone(tmp_path, line):
    path = tmp_path / "x"
    path.write_bytes(raw_file(datasets=(line, PHOTON)))
    header = licel.read_header(path)
    assert [channel.name for channel in header.channels] == ["photon_532p"]
    # The first dataset holds 0 to 3, the second one 10 to 13.
    with open_archive(path) as archive:
        np.testing.assert_array_equal(archive["photon_532p"].values[0] > 0, [True] * 4)
    device = line.split()[-1]
    (note,) = header.notes
    assert device in note
    assert ("states 0 bits" in note) == (device == "BT0")
    assert note.endswith(" is left out")


def test_the_letter_of_older_files_is_parallel_but_beside_letters_of_newer_ones():
    """Whether the detector of the other polarisation is on does not matter: names stay."""
    lines = [line.replace("532.p", f"532.{letter}") for letter in "ls" for line in (ANALOG, PHOTON)]
    header = parse(datasets=tuple(lines))
    names = ["analog_532p", "photon_532p", "analog_532s", "photon_532s"]
    assert [channel.name for channel in header.channels] == names
    assert "polarisation l of analog_532p means parallel" in " ".join(header.notes)
    circular = parse(datasets=tuple(line.replace("532.s", "532.r") for line in lines))
    assert circular.channels[0].name == "analog_532l"
    # Letters of another wavelength tell nothing.
    of_355 = [line.replace("532.s", "355.r") for line in lines]
    assert parse(datasets=tuple(of_355)).channels[0].name == "analog_532p"
    beside = (*lines, ANALOG.replace("532", "355"))
    assert parse(datasets=beside).channels[0].name == "analog_532p"
    alone = parse(datasets=tuple(lines[:2]))
    assert alone.channels[0].name == "analog_532p"


@pytest.mark.parametrize("lines", [slice(None), slice(1, 3)])
def test_lines_that_end_with_lf_are_read_where_the_size_proves_the_header(tmp_path, lines):
    whole = raw_file()
    head, data = whole.split(b"\r\n\r\n", 1)
    ends = [b"\r\n"] * 6
    ends[lines] = [b"\n"] * len(ends[lines])
    mixed = b"".join(map(bytes.__add__, [*head.split(b"\r\n"), b""], ends)) + data
    path = tmp_path / "x"
    path.write_bytes(mixed)
    header, usual = licel.read_header(path), licel.parse_header(whole)
    assert header.channels[0].bins == usual.channels[0].bins
    assert header.start == usual.start
    assert "LF instead of CRLF" in " ".join(header.notes)
    assert usual.notes == ()
    usual_path = tmp_path / "whole"
    usual_path.write_bytes(whole)
    (_, values), (_, expected) = (read_physical([each]) for each in (path, usual_path))
    assert values.keys() == expected.keys()
    for name, row in expected.items():
        np.testing.assert_array_equal(values[name], row)


@pytest.mark.parametrize("of_header", [b"\n", b"\r\n"])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_datasets_that_end_with_lf_are_read_where_the_size_proves_it(tmp_path, number, of_header):
    """Of one and two, lines of the header tell it from a missing last CRLF."""
    data = [struct.pack("<4i", k, 0x0D0A, 0x0A0D0A, 0x0D) for k in range(number)]
    datasets = tuple(ANALOG.replace("532", str(532 + k)) for k in range(number))
    head = raw_file(datasets=datasets, data=[], last=b"").replace(b"\r\n", of_header)
    path = tmp_path / "x"
    path.write_bytes(head + b"\n".join(data) + b"\n")
    if number < 3 and of_header == b"\r\n":
        with pytest.raises(RawFormatError, match="no CRLF follows the counts"):
            licel.read_counts(path)
        return
    header, counts = licel.read_counts(path)
    assert [row.tobytes() for row in counts.values()] == data
    assert "datasets end with LF instead of CRLF" in header.notes
    assert licel.encode(header, counts) == path.read_bytes()
    if number > 1:
        # As by a transfer as text, which changes counts too.
        path.write_bytes(path.read_bytes().replace(b"\r\n", b"\n"))
        with pytest.raises(RawFormatError, match="truncated"):
            licel.read_counts(path)


def test_a_file_that_lacks_a_byte_for_each_dataset_does_not_end_with_lf(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(raw_file((ANALOG, PHOTON, ANALOG.replace("532", "355")))[:-3])
    with pytest.raises(RawFormatError, match="no CRLF follows the counts"):
        licel.read_counts(path)


def test_a_lost_byte_of_counts_is_no_line_end_in_lf(tmp_path):
    """The CR behind them is then their last byte; the first count of the next dataset is 10."""
    content = bytearray(raw_file())
    del content[licel.parse_header(bytes(content)).datasets[0].offset]
    path = tmp_path / "x"
    path.write_bytes(content)
    with pytest.raises(RawFormatError, match="no CRLF follows the counts"):
        licel.read_counts(path)


def test_inactive_datasets_are_not_stored(tmp_path):
    data = [struct.pack("<4i", 1, 2, 3, 4), struct.pack("<4i", 5, 6, 7, 8)]
    path = tmp_path / "x"
    path.write_bytes(raw_file((INACTIVE, ANALOG, PHOTON), data=data))
    header, counts = licel.read_counts(path)
    # The stored dataset keeps the plain name.
    assert [d.name for d in header.datasets] == ["analog_532p_2", "analog_532p", "photon_532p"]
    assert header.datasets[0].offset is None
    assert counts["analog_532p"].tolist() == [1, 2, 3, 4]
    with pytest.raises(RawFormatError, match="stored: analog_532p, photon_532p"):
        licel.read_counts(path, ["analog_532p_2"])


def test_stored_inactive_datasets_are_skipped(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(raw_file((INACTIVE, ANALOG, PHOTON)))
    header, counts = licel.read_counts(path)
    assert counts["analog_532p"].tolist() == [10, 11, 12, 13]
    assert header.notes == ("inactive datasets are stored",)


def test_only_inactive_datasets(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(raw_file((INACTIVE,), data=[], last=b""))
    header = licel.read_header(path)
    assert header.channels == ()
    with pytest.raises(RawFormatError, match="no channels"):
        licel.read_counts(path)


@pytest.mark.parametrize(("last", "cut"), [(b"", 2), (b"\r", 1)])
def test_missing_last_crlf_is_noted(tmp_path, last, cut):
    path = tmp_path / "x"
    content = raw_file(last=last)
    path.write_bytes(content)
    header, counts = licel.read_counts(path)
    assert header.notes == ("the last CRLF is missing",)
    assert counts["photon_532p"].tolist() == [10, 11, 12, 13]
    assert header.size == len(raw_file()) - cut
    assert licel.encode(header, counts) == content


def test_crlf_inside_the_data(tmp_path):
    path = tmp_path / "x"
    data = [b"\r\n" * 8, b"\x00\r\n\x00" + b"\r\n\r\n" * 3]
    path.write_bytes(raw_file(data=data))
    _, counts = licel.read_counts(path)
    assert counts["analog_532p"].tobytes() == data[0]
    assert counts["photon_532p"].tobytes() == data[1]


def test_data_that_are_not_where_the_header_says(tmp_path):
    path = tmp_path / "x"
    content = bytearray(raw_file())
    content[licel.parse_header(bytes(content)).datasets[1].offset - 1] = 0
    path.write_bytes(content)
    with pytest.raises(RawFormatError, match="no CRLF follows"):
        licel.read_counts(path)


def test_every_truncation_and_every_extension_is_refused():
    content = raw_file()
    for length in range(len(content) - 2):
        with pytest.raises(RawFormatError):
            licel.parse_header(content[:length])
    for surplus in (b"\x1a", b"\r\n", b"\x00" * 7):
        with pytest.raises(RawFormatError, match="surplus"):
            licel.parse_header(content + surplus)


def test_truncation_names_expected_and_found_bytes(tmp_path):
    content = raw_file()
    path = tmp_path / "cut.dat"
    path.write_bytes(content[:-9])
    with pytest.raises(RawFormatError) as error:
        licel.read_header(path)
    text = str(error.value)
    assert "cut.dat" in text
    assert f"promises {len(content)} bytes" in text
    assert f"has {len(content) - 9}" in text
    assert "truncated" in text


@each(
    ("changes", "field"),
    [
        ({"line_2": " no date at all"}, "header line 2"),
        ({"line_2": LINE_2.replace("17:30:10", "17:29:10")}, "stop"),
        ({"line_2": LINE_2.replace("02/10/2024", "31/02/2024", 1)}, "start"),
        ({"line_2": LINE_2.replace("2024 17:30:10", "9024 17:30:10")}, "stop"),
        ({"line_2": LINE_2.replace("17:30:00", "17:61:00")}, "start"),
        ({"line_2": LINE_2[:-3]}, "header line 2"),
        ({"line_2": LINE_2.replace("0411", "nan ")}, "altitude"),
        ({"line_2": LINE_2.replace("-064.1", "1e999 ")}, "longitude"),
        ({"line_2": LINE_2[:-2] + "999"}, "zenith angle"),
        ({"line_2": LINE_2 + " 400.0"}, "azimuth"),
        ({"line_2": LINE_2 + ' 000.0 "open'}, "header line 2"),
        ({"line_3": " 0000101 0010 0000101 02"}, "header line 3"),
        ({"line_3": " 0000101 0010 0000101 0000 xx"}, "number of datasets"),
        ({"line_3": LINE_3.format(0)}, "number of datasets"),
        ({"line_3": LINE_3.format(1001)}, "number of datasets"),
        ({"line_3": LINE_3.format(1)}, "number of datasets"),
        ({"line_3": LINE_3.format(3)}, None),
        ({"datasets": (ANALOG.replace("00004", "00000"),)}, "dataset 1, bins"),
        ({"datasets": (ANALOG.replace("00004", "-0004"),)}, "dataset 1, bins"),
        ({"datasets": (ANALOG, ANALOG.replace("00004", "1000001"))}, "dataset 2, bins"),
        ({"datasets": (ANALOG.replace("7.50", "0.00"),)}, "dataset 1, bin width"),
        ({"datasets": (ANALOG.replace("7.50", "1001"),)}, "dataset 1, bin width"),
        ({"datasets": (ANALOG.replace("7.50", "7.5m"),)}, "dataset 1, bin width"),
        ({"datasets": (ANALOG.replace(" 12 0", " 33 0"),)}, "dataset 1, ADC bits"),
        ({"datasets": (ANALOG.replace("000101", "-00101"),)}, "dataset 1, shots"),
        ({"datasets": (ANALOG.replace("0.500", "0.000"),)}, "dataset 1, input range"),
        ({"datasets": (ANALOG.replace("00532.p", "green"),)}, "dataset 1, wavelength"),
        ({"datasets": (ANALOG.replace(" 1 0", " 1 6", 1),)}, "dataset 1, type"),
        ({"datasets": (ANALOG.replace(" 1 0", " 2 0", 1),)}, "dataset 1, active"),
        ({"datasets": (ANALOG[: -len(" BT0")],)}, "dataset 1, line"),
        ({"datasets": (ANALOG + " " + "x" * 1100,)}, "header"),
    ],
)
def test_impossible_headers_are_refused(changes, field):
    with pytest.raises(RawFormatError) as error:
        parse(**changes)
    assert error.value.file == "x.dat"
    if field is not None:
        assert error.value.field == field


@pytest.mark.parametrize(
    "content", [b"", b"\r\n", b"\r\n" * 500, b"\x00" * 5000, b"a" * 5000, b"\r\n\r\n \r\n 1"]
)
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "x"
    path.write_bytes(content)
    with pytest.raises(RawFormatError, match="x: "):
        licel.read_header(path)


def test_only_regular_files_are_opened(tmp_path):
    with pytest.raises(RawFormatError, match="cannot be opened"):
        licel.read_header(tmp_path / "absent")
    with pytest.raises(RawFormatError, match="not a regular file"):
        licel.read_header(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RawFormatError, match="not a regular file"):
        licel.read_header(tmp_path / "pipe")
    with pytest.raises(RawFormatError, match="cannot be opened"):
        licel.read_header("nul\0byte")


def test_promised_bins_are_not_allocated(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(raw_file((ANALOG.replace("00004", "1000000"),) * 9, data=[], last=b""))
    tracemalloc.start()
    with pytest.raises(RawFormatError, match="promises 36000"):
        licel.read_counts(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 200_000


def test_header_longer_than_the_first_read(tmp_path):
    lines = [ANALOG.replace("00532", f"{300 + k:05d}") for k in range(400)]
    path = tmp_path / "x"
    path.write_bytes(raw_file(lines))
    header, counts = licel.read_counts(path)
    assert len(header.channels) == 400
    assert counts["analog_699p"].tolist() == [3990, 3991, 3992, 3993]


def test_layouts_must_agree(tmp_path):
    variants = {
        "a": (ANALOG, PHOTON),
        "b": (ANALOG, PHOTON.replace("7.50", "15.0")),
        "c": tuple(line.replace("000101", "000099") for line in (ANALOG, PHOTON)),
    }
    for name, lines in variants.items():
        (tmp_path / name).write_bytes(raw_file(lines))
    a, b, c = (tmp_path / name for name in "abc")
    with pytest.raises(RawFormatError, match=r"b: photon_532p: is of another layout"):
        open_archive([a, b])
    values = open_archive([a, b, c], channels="analog_532p")["analog_532p"].values
    np.testing.assert_allclose(values[2] * 99, values[0] * 101, rtol=1e-6)


def test_counts_need_channels(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(raw_file())
    with pytest.raises(RawFormatError, match="has no channel analog_1o"):
        licel.read_counts(path, ["analog_1o"])


def test_physical_values_are_scaled_in_double_precision(tmp_path):
    path = tmp_path / "x"
    counts = [2**31 - 1, -(2**31), 413_595, 16_777_217]
    path.write_bytes(raw_file((ANALOG,), data=[struct.pack("<4i", *counts)]))
    _, values = read_physical([path])
    expected = [np.float32(count * 500 / (101 * 4096)) for count in counts]
    assert values["analog_532p"][0].tolist() == pytest.approx(expected, rel=6e-8)
    # Full scale is exactly 4095 / 4096 of the input range.
    assert values["analog_532p"][0, 2] == 500 * 4095 / 4096


@pytest.mark.parametrize("end", [b"\r\n", b""], ids=["with the empty line", "without"])
def test_a_text_export_is_named_as_one(end):
    header = licel.parse_header(raw_file())
    table = b"\r\n".join(b"%.4e\t%.4e" % (k, k / 7) for k in range(64))
    whole = header.source.removesuffix(b"\r\n") + end + table
    with pytest.raises(RawFormatError, match="as text") as caught:
        licel.parse_header(whole, file="export.txt")
    assert "leave it out" in str(caught.value)


@pytest.mark.parametrize(
    ("data", "text"),
    [(b"range signal\n" * 20, True), (b"", False), (bytes(5000), False), (b"short", False)],
)
def test_a_file_of_no_known_format_is_called_text_only_if_it_is(data, text):
    with pytest.raises(RawFormatError, match="no known raw format") as caught:
        parse_raw_header(data, file="x", size=len(data))
    assert ("it is text" in str(caught.value)) is text


def test_a_signal_that_is_none_by_its_type_is_noted():
    """A damaged type would lose one of two memories in silence."""
    damaged = PHOTON.replace(" 1 1 1 ", " 1 4 1 ")
    assert parse(datasets=(ANALOG, damaged)).notes == (
        "power_meter_532p is no signal by its type, and one by its device BC0",
    )
    meter = damaged.replace("BC0", "PD0")
    (note,) = parse(datasets=(ANALOG, meter)).notes
    assert note == "dataset PD0 cannot be a signal and is left out"
