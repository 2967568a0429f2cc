"""Written files are read back; headers and counts that cannot be written are refused."""

from __future__ import annotations

import dataclasses
import pickle
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.cases import each
from support.licel_lines import new_dataset, new_header
from support.licel_strategies import datasets, files, headers, naive_read, raw_file

from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.licel_header import memories

MIXED = st.lists(
    datasets(kinds=st.sampled_from(list(licel.DatasetKind)[:-1]), active=st.booleans()),
    min_size=1,
    max_size=6,
)
ON_DISK = settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.slow
@given(files(headers(MIXED)))
def test_bytes_are_read_back(file):
    header, counts = file
    content = licel.encode(header, counts)
    again = licel.parse_header(content)
    assert len(content) == header.size
    assert again == header
    assert pickle.loads(pickle.dumps(again)) == header
    for dataset in again.datasets:
        if dataset.offset is not None:
            values = np.frombuffer(content, "<i4", dataset.bins, dataset.offset)
            np.testing.assert_array_equal(values, counts[dataset.name])


@given(files())
def test_the_naive_reader_agrees_on_what_is_written(file):
    header, counts = file
    lines, rows = naive_read(licel.encode(header, counts))
    assert all(len(line) >= 78 and line[0] == " " and line[1] != " " for line in lines)
    for dataset, (tokens, values) in zip(header.datasets, rows, strict=True):
        assert tuple(counts[dataset.name].tolist()) == values
        assert int(tokens[2]) == dataset.laser
        assert float(tokens[6]) == dataset.bin_width


@ON_DISK
@given(files())
def test_files_are_read_back_in_every_way(tmp_path, file):
    header, counts = file
    path = tmp_path / "file"
    path.write_bytes(licel.encode(header, counts))
    again, read = licel.read_counts(path)
    assert again == header
    with (
        xr.open_dataset(path, engine="licel", mask_and_scale=False) as raw,
        xr.open_dataset(path, engine="licel") as scaled,
    ):
        for dataset in header.channels:
            np.testing.assert_array_equal(read[dataset.name], counts[dataset.name])
        for group in memories(header.datasets):
            name = group[0].name
            added = sum(counts[memory.name].astype(np.int64) for memory in group)
            limits = np.iinfo(np.int32)
            np.testing.assert_array_equal(raw[name].values[0], added.clip(limits.min, limits.max))
            if len(group) == 1:
                expected = (counts[name] * group[0].scale).astype(np.float32)
                np.testing.assert_array_equal(scaled[name].values[0], expected)
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_memories_are_added_before_their_sum_is_limited(tmp_path):
    header = new(datasets=[dataset()] * 3)
    path = tmp_path / "file"
    values = (2**31 - 1, 2, -3)
    rows = [np.full(4, value, dtype=np.int32) for value in values]
    counts = {one.name: row for one, row in zip(header.datasets, rows, strict=True)}
    path.write_bytes(licel.encode(header, counts))
    with xr.open_dataset(path, engine="licel", mask_and_scale=False) as raw:
        assert np.all(raw[memories(header.datasets)[0][0].name].values == sum(values))


def new(**changes) -> licel.Header:
    start = datetime(2024, 10, 2, 17, 30, tzinfo=UTC)
    arguments = {
        "name": "h24A0217.301035",
        "site": "Pilar",
        "start": start,
        "stop": start + timedelta(seconds=10),
        "altitude": 411,
        "longitude": -64.1,
        "latitude": -31.2,
        "datasets": [dataset()],
        "lasers": [licel.Laser(101, 10), licel.Laser(101, 0)],
    }
    return new_header(**(arguments | changes))


def dataset(**changes) -> licel.Dataset:
    arguments = {"wavelength": 532e-9, "bins": 4, "bin_width": 7.5, "shots": 101}
    return new_dataset(**(arguments | changes))


def test_new_header_is_what_licel_writes():
    photon = dataset(
        kind=licel.DatasetKind.PHOTON, polarisation="s", discriminator=2 * 25e-3 / 63, device="BC3"
    )
    assert new(datasets=[dataset(high_voltage=800), photon]).source == (
        b" h24A0217.301035                                                              \r\n"
        b" Pilar    02/10/2024 17:30:00 02/10/2024 17:30:10 0411 -064.1 -031.2 00       \r\n"
        b" 0000101 0010 0000101 0000 02                                                 \r\n"
        b" 1 0 1 00004 1 0800 7.50 00532.o 0 0 00 000 12 000101 0.500 BT0               \r\n"
        b" 1 1 1 00004 1 0000 7.50 00532.s 0 0 00 000 00 000101 0.7937 BC3              \r\n"
        b"\r\n"
    )


def test_new_extended_header():
    header = new(
        zenith_angle=72.5,
        azimuth=180.0,
        longitude=-64.103125,
        custom="scan 3",
        lasers=[licel.Laser(1, 10), licel.Laser(2, 20), licel.Laser(3, 30)],
        timestamp=123,
    )
    lines = header.source.split(b"\r\n")
    assert lines[1].split(b"0411 ")[1].rstrip() == (b'-064.103125 -031.200000 72.5 180.0 "scan 3"')
    assert lines[2].rstrip() == b" 0000001 0010 0000002 0020 01 0000003 0030 0000000 0000 123"
    assert (header.zenith_angle, header.azimuth, header.timestamp) == (72.5, 180.0, "123")


def test_other_time_zones_are_written_in_utc():
    zone = timezone(timedelta(hours=-3))
    start = datetime(2024, 10, 2, 22, 30, tzinfo=zone)
    header = new(start=start, stop=start)
    assert b"03/10/2024 01:30:00" in header.source
    assert header.start == start


@each(
    ("changes", "match"),
    [
        ({"zenith_angle": 72.5}, "zenith angle"),
        ({"zenith_angle": 72.55, "azimuth": 0.0}, "zenith angle"),
        (
            {"azimuth": 10.0, "dialect": "classic"},
            "azimuth: a classic header has no place for it",
        ),
        ({"custom": "x"}, "azimuth"),
        ({"custom": "two\nlines", "azimuth": 1.0}, "does not print"),
        ({"temperature": 300.0}, "pressure: is needed in a raymetrics header"),
        (
            {"temperature": 300.0, "pressure": 1e5, "dialect": "classic"},
            "temperature: a classic header has no place for it",
        ),
        ({"start": datetime(2024, 10, 2, 17, 30)}, "aware"),  # noqa: DTZ001
        ({"start": datetime(2024, 10, 2, 17, 30, 0, 1, tzinfo=UTC)}, "whole seconds"),
        ({"stop": datetime(2024, 10, 2, 17, 29, tzinfo=UTC)}, "before the start"),
        ({"site": "two\r\nlines"}, "does not print"),
        ({"site": "\u4e0a\u6d77"}, "Latin-1"),
        ({"site": "a 02/10/2024 00:00:00 02/10/2024 00:00:10"}, "altitude"),
        ({"name": "two\nlines"}, "does not print"),
        ({"lasers": []}, "two or three"),
        ({"lasers": [licel.Laser(1, 10)] * 2, "timestamp": 3}, "timestamp"),
        ({"datasets": []}, "number of datasets"),
    ],
)
def test_headers_that_cannot_be_written(changes, match):
    with pytest.raises(RawFormatError, match=match):
        new(**changes)


@each(
    ("changes", "match"),
    [
        ({"bin_width": 7.4948}, "four characters"),
        ({"bin_width": 0.0}, "bin width"),
        ({"bins": 0}, "bins"),
        ({"shots": -1}, "shots"),
        ({"adc_bits": 40}, "ADC bits"),
        ({"input_range": 0.0}, "input range"),
        ({"input_range": 0.0335}, "input range"),
        ({"wavelength": 1.0}, "wavelength"),
        ({"device": "B T"}, "device"),
        ({"polarisation": "none"}, "wavelength"),
    ],
)
def test_datasets_that_cannot_be_written(changes, match):
    with pytest.raises(RawFormatError, match=match):
        dataset(**changes)


def test_an_edited_header_is_not_written():
    header = new()
    counts = {"analog_532o": np.zeros(4, np.int32)}
    licel.encode(header, counts)
    edited = dataclasses.replace(header, zenith_as_written=45.0)
    with pytest.raises(RawFormatError, match="contradict the text"):
        licel.encode(edited, counts)
    edited = dataclasses.replace(
        header, datasets=(dataclasses.replace(header.datasets[0], shots=1),)
    )
    with pytest.raises(RawFormatError, match="contradict the text"):
        licel.encode(edited, counts)


@pytest.mark.parametrize(
    ("counts", "match"),
    [
        ({}, "no counts"),
        ({"analog_532o": np.zeros(5, int)}, "shape"),
        ({"analog_532o": np.zeros(4)}, "float64"),
        ({"analog_532o": np.full(4, 2**31)}, "32 bits"),
        ({"analog_532o": np.full(4, -(2**31) - 1)}, "32 bits"),
        ({"analog_532o": np.zeros(4, int), "photon_532o": np.zeros(4, int)}, "not stored"),
    ],
)
def test_counts_that_cannot_be_written(counts, match):
    with pytest.raises(RawFormatError, match=match):
        licel.encode(new(), counts)


@given(st.integers(0, 437), st.integers(1, 255))
def test_a_flipped_byte_of_data_changes_that_count_only(position, flip):
    content = bytearray(raw_file())
    header = licel.parse_header(bytes(content))
    position = header.data_start + position % 34
    content[position] ^= flip
    assert licel.parse_header(bytes(content)) == dataclasses.replace(
        header, source=header.source, path=""
    )
