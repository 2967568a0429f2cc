"""Damaged files are read faithfully or refused, in bounded memory."""

from __future__ import annotations

import contextlib
import random
import tracemalloc

import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from support.licel_strategies import ANALOG, LINE_2, LINE_3, PHOTON, raw_file

from lidarops.errors import RawFormatError
from lidarops.raw import licel

MUTANTS = 10_400
SMALL_CONSTANT = 192 * 1024
HUGE = [b"99999", b"999999999", b"1000000", b"2147483648", b"-1", b"1e308", b"nan", b"0x7f"]

CONSTRUCTED = [
    raw_file(),
    raw_file((ANALOG, PHOTON, ANALOG, PHOTON.replace(" 1 1", " 0 1", 1)), last=b""),
    raw_file(
        line_2=LINE_2[:-2] + '72.5 180.0 "custom text"',
        line_3=LINE_3.format(2) + " 0000050 0005 0000000 0000 83417529",
    ),
    raw_file(line_2=LINE_2[:-2] + "-90 00 30.0 1013.0", last=b""),
]


def flip(content, rng):
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)


def overwrite(content, rng):
    content[rng.randrange(len(content))] = rng.randrange(256)


def truncate(content, rng):
    del content[rng.randrange(len(content)) :]


def insert(content, rng):
    position = rng.randrange(len(content) + 1)
    content[position:position] = rng.choice([b"\r\n", b" ", b"0", b'"', rng.randbytes(9)])


def delete(content, rng):
    position = rng.randrange(len(content))
    del content[position : position + rng.choice([1, 2, 4, 80])]


def swap_digit(content, rng):
    digits = [i for i, byte in enumerate(content[:400]) if 48 <= byte <= 57]
    if digits:
        content[rng.choice(digits)] = rng.choice(b"0123456789")


def enlarge(content, rng):
    blanks = [i for i, byte in enumerate(content[:1300]) if byte == 32]
    if blanks:
        start = rng.choice(blanks) + 1
        token = bytes(content[start:]).split(b" ", 1)[0][:12]
        content[start : start + len(token)] = rng.choice(HUGE)


def repeat(content, rng):
    start = rng.randrange(len(content))
    content[start:start] = content[start : start + rng.randrange(200)]


MUTATIONS = [flip, overwrite, truncate, insert, delete, swap_digit, enlarge, repeat]


def shrunk(path) -> bytes:
    """Return the bytes of a real file, cut to three bins per dataset."""
    header = licel.read_header(path)
    bins = f" {header.datasets[0].bins:05d} ".encode()
    text = header.source.replace(bins, b" 00003 ")
    return text + b"\x01\x02\r\n\x05\x06\x07\x08\xff\xff\xff\x7f\r\n" * len(header.datasets)


@pytest.fixture(scope="session")
def originals(data_root) -> list[bytes]:
    folders = ("manaus", "pilar/20241002", "saopaulo/20170928/signals", "synthetic/pappalardo")
    real = [
        shrunk(min(path for path in (data_root / folder).iterdir() if path.suffix != ".csv"))
        for folder in folders
    ]
    return CONSTRUCTED + real


@pytest.fixture
def measured():
    """Trace memory."""
    tracemalloc.start()
    yield
    tracemalloc.stop()


def survives(path, content) -> bool:
    """Return whether the file is accepted; then it must be written back unchanged."""
    rewrite(path, content)
    read, message, peak = measured_reading(path)
    limit = 10 * len(content) + SMALL_CONSTANT
    # Memory of other threads, and of caches filled for the first time, is not counted twice.
    assert min(peak, measured_reading(path)[2] if peak > limit else peak) <= limit
    if read is None:
        assert str(path) in message
        return False
    assert licel.encode(*read) == content
    return True


def measured_reading(path):
    """Return header and counts, the message of a refusal, and the peak memory."""
    read, message = None, ""
    before = start_measuring()
    try:
        read = licel.read_counts(path, stored(path))
    except RawFormatError as error:
        message = str(error)
    return read, message, peak_since(before)


def rewrite(path, content):
    # Truncating first, as write_bytes does, takes most of the time of this module.
    with path.open("r+b" if path.exists() else "wb") as file:
        file.write(content)
        file.truncate()


def start_measuring():
    tracemalloc.reset_peak()
    return tracemalloc.get_traced_memory()[0]


def peak_since(before):
    return tracemalloc.get_traced_memory()[1] - before


def stored(path):
    return [d.name for d in licel.read_header(path).datasets if d.offset is not None]


def test_originals_are_accepted(tmp_path, originals, measured):
    assert all(survives(tmp_path / "file", content) for content in originals)


@pytest.mark.slow
def test_mutants_are_read_or_refused(tmp_path, originals):
    rng = random.Random(20241002)
    path = tmp_path / "file"
    accepted = 0
    for number in range(MUTANTS):
        # Tracing makes reading ten times slower.
        if number % (MUTANTS // 8) == 0:
            tracemalloc.start()
        if number % (MUTANTS // 8) == 80:
            tracemalloc.stop()
        content = bytearray(originals[number % len(originals)])
        for mutate in rng.choices(MUTATIONS, k=rng.choice([1, 1, 2, 5])):
            if content:
                mutate(content, rng)
        accepted += survives(path, bytes(content))
    # Some mutants are refused, some are accepted.
    assert MUTANTS / 20 < accepted < MUTANTS / 2


def test_the_engine_reads_or_refuses(tmp_path, originals):
    rng = random.Random(7)
    path = tmp_path / "file"
    accepted = 0
    for number in range(200):
        content = bytearray(originals[number % len(originals)])
        rng.choice([flip, overwrite, swap_digit, enlarge])(content, rng)
        path.write_bytes(content)
        try:
            xr.open_dataset(path, engine="licel").load()
        except RawFormatError:
            continue
        accepted += 1
    assert 20 < accepted < 180


@given(st.binary(max_size=600))
def test_arbitrary_bytes(content):
    with pytest.raises(RawFormatError):
        licel.parse_header(content)


@given(st.binary(max_size=300), st.integers(0, 2**40))
def test_arbitrary_bytes_behind_a_true_beginning(content, size):
    beginning = raw_file()[:160]
    with contextlib.suppress(RawFormatError):
        assert licel.parse_header(beginning + content, size=size).size == size


@pytest.mark.parametrize(
    "content",
    [
        b" " * 100_000,
        b" x\r\n" + b"1/1/2020 00:00:00 " * 50 + b"\r\n" * 9,
        b" x\r\n" + b" " * 1000 + b"\r\n" * 9,
        b"\r\n" * 50_000,
        (b" 1 0 1 00001 1 0 7.5 1.o 0 0 0 0 8 1 1 B" + b"\r\n") * 2000,
    ],
)
def test_long_lines_are_refused_quickly(tmp_path, content, measured):
    assert not survives(tmp_path / "file", content)


def test_a_thousand_datasets_of_one_bin(tmp_path, measured):
    line = " 1 0 1 00001 1 0000 7.50 00532.o 0 0 00 000 12 000101 0.500 BT0"
    content = raw_file(
        [line] * 1000, line_3=" 0000101 0010 0000101 0000 1000", data=[b"abcd"] * 1000
    )
    path = tmp_path / "file"
    assert survives(path, content)
    assert licel.read_header(path).datasets[-1].name == "analog_532o_1000"
