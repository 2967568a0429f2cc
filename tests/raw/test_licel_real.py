"""The reader and writer against real files and an independent reader."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from support.licel_lines import new_dataset, new_header
from support.licel_strategies import naive_physical, naive_read
from support.physical import read_physical

from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.formats import parse_raw_header
from lidarops.raw.licel_header import memories


@pytest.fixture(scope="session")
def files(data_root) -> list[Path]:
    other_suffixes = {".csv", ".nc", ".txt"}
    paths = [
        path
        for folder in ("manaus", "manaus_raman", "pilar", "saopaulo", "synthetic")
        for path in sorted((data_root / folder).rglob("*"))
        if path.is_file() and path.suffix not in other_suffixes
    ]
    assert len(paths) >= 201
    return paths


def rebuild(header: licel.Header) -> licel.Header:
    """Return the same header, rebuilt from its numbers."""
    datasets = [
        new_dataset(
            kind=d.kind,
            wavelength=int(d.wavelength_label[:5]) * 1e-9,
            bins=d.bins,
            bin_width=d.bin_width,
            shots=d.shots,
            polarisation=d.polarisation,
            laser=d.laser,
            high_voltage=d.high_voltage,
            adc_bits=d.adc_bits,
            input_range=d.input_range or 0.0,
            discriminator=d.discriminator or 0.0,
            device=d.device,
            active=d.active,
            laser_polarisation=d.laser_polarisation,
            bin_shift=d.bin_shift,
        )
        for d in header.datasets
    ]
    return new_header(
        name=header.name,
        site=header.site,
        start=header.start,
        stop=header.stop,
        altitude=header.altitude,
        longitude=header.longitude,
        latitude=header.latitude,
        zenith_angle=header.zenith_as_written,
        temperature=header.temperature,
        pressure=header.pressure,
        lasers=header.lasers,
        datasets=datasets,
    )


def test_every_file_reads_like_the_naive_reader_and_is_written_back(files):
    for path in files:
        content = path.read_bytes()
        header, counts = licel.read_counts(path)
        _, rows = naive_read(content)
        assert len(header.datasets) == len(header.channels) == len(rows)
        for dataset, (tokens, expected) in zip(header.channels, rows, strict=True):
            assert counts[dataset.name].dtype == np.int32
            np.testing.assert_array_equal(counts[dataset.name], expected)
            assert (dataset.device, dataset.shots) == (tokens[15], int(tokens[13]))
        assert licel.encode(header, counts) == content, path


def test_physical_values_equal_the_formulas(files):
    for path in files[::7]:
        _, rows = naive_read(path.read_bytes())
        (header,), values = read_physical([path], dtype=np.float64)
        _, single = read_physical([path])
        for dataset, (tokens, counts) in zip(header.channels, rows, strict=True):
            expected = np.array(naive_physical(tokens, counts))
            np.testing.assert_allclose(values[dataset.name][0], expected, rtol=1e-14)
            np.testing.assert_allclose(single[dataset.name][0], expected, rtol=6.1e-8)


def test_headers_are_what_instruments_write(files):
    # Rebuilt from numbers, byte for byte; one source writes its altitude in another way.
    for path in files:
        header = licel.read_header(path)
        rebuilt = rebuild(header)
        if header.site == "Papapardo_Sim":
            expected = header.source.replace(
                b" 07.5 -058.4 -034.6 00  ", b" 0008 -058.4 -034.6 00  "
            )
        else:
            expected = header.source
        assert rebuilt.source == expected, path


def test_manaus(data_root):
    header = licel.read_header(data_root / "manaus" / "RM10C1315.162")
    assert (header.name, header.site) == ("RM10C1315.162", "Manaus")
    assert header.start == datetime(2010, 12, 13, 15, 15, 24, tzinfo=UTC)
    assert header.stop == datetime(2010, 12, 13, 15, 16, 24, tzinfo=UTC)
    assert header.zenith_as_written == -90.0
    assert header.zenith_angle == 0.0
    assert header.azimuth is None
    assert header.temperature == pytest.approx(303.15, abs=1e-9)
    assert header.pressure == pytest.approx(101_300.0, abs=1e-6)
    assert header.notes == ("zenith angle -90 taken as vertical",)
    assert header.position() == (-3.1, -60.0)
    assert header.lasers == ((600, 10.0), (600, 10.0))
    assert [d.name for d in header.channels] == [
        "analog_355o",
        "photon_355o",
        "analog_387o",
        "photon_387o",
        "photon_408o",
    ]


def test_manaus_glitch_lies_above_full_scale(data_root):
    header, counts = licel.read_counts(data_root / "manaus" / "RM10C1315.162")
    dataset = header.channels[0]
    assert dataset.full_scale == 2_457_000
    assert counts[dataset.name][0] == 7_413_700
    above = [
        d.name for d in header.channels if d.full_scale and counts[d.name].max() > d.full_scale
    ]
    assert above == ["analog_355o"]


def test_sao_paulo(data_root):
    path = min((data_root / "saopaulo/20170928/signals").iterdir())
    header = licel.read_header(path)
    assert header.site == "Sao Paul"
    assert header.position() == (-23.6, -46.7)
    assert header.lasers == ((0, 10.0), (601, 10.0))
    assert {d.laser for d in header.datasets} == {2}
    assert {d.high_voltage for d in header.datasets} == {0.0}
    assert [d.adc_bits for d in header.datasets[:3]] == [13, 0, 12]


def test_pilar(data_root):
    header = licel.read_header(data_root / "pilar/20241002/h24A0217.301035")
    assert header.site == "LidarPi"
    assert header.position() == (-31.2, -64.1)
    assert header.altitude == 411.0
    assert (header.data_start, header.size) == (1202, 197_834)
    analog = header.datasets[10]
    assert analog.name == "analog_53200o"
    assert math.isnan(analog.wavelength)
    assert header.datasets[1].wavelength == pytest.approx(387e-9, rel=1e-12)
    assert header.datasets[1].discriminator == pytest.approx(2 * 25e-3 / 63, rel=1e-4)
    assert header.datasets[0].full_scale == 101 * 4095


def test_layout(data_root):
    channels = licel.read_header(data_root / "pilar/20241002/h24A0217.301035").layout
    assert len(channels) == 12
    assert channels[3].name == "photon_408o"
    assert (channels[3].bins, channels[3].bin_width, channels[3].adc_bits) == (4096, 7.5, 0)
    assert channels[0].mode == "analog"


def _measured(data_root: Path) -> Iterator[tuple[str, licel.Header, dict[str, np.ndarray]]]:
    for folder in ("manaus", "manaus_raman", "pilar", "saopaulo", "savant"):
        for path in sorted((data_root / folder).rglob("*")):
            if path.is_file() and path.suffix not in {".csv", ".nc", ".txt"}:
                # Notes and settings of the instruments lie among them.
                with suppress(RawFormatError):
                    yield path.name, *licel.read_counts(path)


def test_checks_of_headers_follow_from_what_measured_files_state(data_root):
    """All channels have the same shots, and one file has one bin beyond full scale."""
    files, as_line_3, beyond = 0, 0, {}
    for name, header, counts in _measured(data_root):
        files += 1
        shots = {sum(d.shots for d in group) for group in memories(header.datasets)}
        assert len(shots - {0}) <= 1, name
        as_line_3 += shots - {0} <= {laser.shots for laser in header.lasers}
        for channel in header.channels:
            if channel.full_scale is not None and channel.shots:
                bins = int(np.count_nonzero(counts[channel.name] > channel.full_scale))
                if bins:
                    beyond[name, channel.name] = bins
    assert (files, as_line_3) == (272, 180)
    assert beyond == {("RM10C1315.162", "analog_355o"): 1}


def test_simulated_signals_that_are_scaled_to_32_bits_are_read(data_root):
    """Those of Böckmann exceed the full scale of their header by design."""
    scaled = set()
    for path in (data_root / "synthetic").rglob("*"):
        if path.is_file() and path.suffix not in {".csv", ".nc", ".txt"}:
            header, counts = licel.read_counts(path)
            for channel in header.channels:
                values = counts[channel.name]
                if channel.full_scale and np.count_nonzero(values > channel.full_scale) > 1:
                    assert values.max() == np.iinfo(np.int32).max
                    content = path.read_bytes()
                    parse_raw_header(content, file=path.name, size=len(content))
                    scaled.add(path.relative_to(data_root / "synthetic").parts[0])
    assert scaled == {"boeckmann"}
