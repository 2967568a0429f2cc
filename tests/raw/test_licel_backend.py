"""The xarray engine: data model, laziness, pickling, options."""

from __future__ import annotations

import os
import pickle
import struct

import numpy as np
import pytest
import xarray as xr
from support.cases import each
from support.licel_strategies import ANALOG, LINE_2, PHOTON, raw_file
from support.physical import read_physical

from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.backend import LicelBackendEntrypoint


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "h24A0217.301035"
    path.write_bytes(raw_file())
    return path


def write(tmp_path, **changes):
    path = tmp_path / "x.dat"
    path.write_bytes(raw_file(**changes))
    return path


@pytest.fixture
def reads(monkeypatch):
    """Return a list that collects (offset, bytes) of every read."""
    seen = []
    pread = os.pread

    def record(descriptor, length, offset):
        content = pread(descriptor, length, offset)
        seen.append((offset, len(content)))
        return content

    monkeypatch.setattr(os, "pread", record)
    return seen


def test_data_model(file):
    opened = xr.open_dataset(file, engine="licel")
    assert dict(opened.sizes) == {"time": 1, "range": 4, "nv": 2}
    assert set(opened.data_vars) == {
        "analog_532p",
        "analog_532p_shots",
        "analog_532p_input_range",
        "photon_532p",
        "photon_532p_shots",
    }
    assert set(opened.coords) == {
        "time",
        "time_bnds",
        "range",
        "zenith_angle",
        "latitude",
        "longitude",
        "altitude",
    }
    assert opened.time.dtype == "datetime64[ns]"
    assert opened.time.values[0] == np.datetime64("2024-10-02T17:30:05", "ns")
    assert opened.time_bnds.values.tolist() == [
        [np.datetime64(f"2024-10-02T17:30:{s}", "ns").item() for s in ("00", "10")]
    ]
    assert opened.range.values.tolist() == [3.75, 11.25, 18.75, 26.25]
    assert opened.range.attrs["units"] == "m"
    assert (opened.latitude, opened.longitude, opened.altitude) == (-31.2, -64.1, 411)
    assert opened.zenith_angle.values.tolist() == [0.0]
    assert opened.encoding["engine"] == "licel"
    assert opened.attrs == {"source_format": "Licel", "site": "LidarPi"}


def test_channels(file):
    opened = xr.open_dataset(file, engine="licel")
    analog, photon = opened.analog_532p, opened.photon_532p
    assert analog.dims == photon.dims == ("time", "range")
    assert analog.dtype == photon.dtype == np.float32
    counts = np.arange(4)
    np.testing.assert_allclose(analog[0], counts * 500 / (101 * 4096), rtol=1e-7)
    np.testing.assert_allclose(photon[0], (10 + counts) * 20 / 101, rtol=1e-7)
    assert opened.analog_532p_shots.dtype == np.int32
    assert opened.analog_532p_shots.values.tolist() == [101]
    assert opened.analog_532p_input_range.values.tolist() == [0.5]
    assert opened.analog_532p_input_range.attrs["units"] == "V"
    attributes = dict(analog.attrs)
    assert attributes.pop("wavelength") == pytest.approx(532e-9, rel=1e-12)
    assert attributes == {
        "units": "mV",
        "long_name": "analog signal at 532 nm, parallel polarisation",
        "detection_mode": "analog",
        "wavelength_label": "00532.p",
        "polarisation": "parallel",
        "bin_width": 7.5,
        "adc_bits": 12,
        "conversion": licel.CONVENTION,
        "device": "BT0",
        "full_scale": 500 * 4095 / 4096,
        "laser": 1,
        "high_voltage": 800.0,
        "bin_shift": 0.0,
    }
    assert photon.attrs["units"] == "MHz"
    assert photon.attrs["discriminator"] == pytest.approx(0.7937e-3)
    assert "full_scale" not in photon.attrs


def test_raw_counts_and_their_scale(file):
    opened = xr.open_dataset(file, engine="licel", mask_and_scale=False)
    assert opened.analog_532p.dtype == np.int32
    assert opened.analog_532p.values.tolist() == [[0, 1, 2, 3]]
    assert opened.analog_532p.attrs["units"] == "count"
    assert opened.analog_532p.attrs["full_scale"] == 101 * 4095
    scaled = xr.open_dataset(file, engine="licel")
    for name, units in (("analog_532p", "mV"), ("photon_532p", "MHz")):
        scale = opened[f"{name}_scale"]
        assert scale.attrs["units"] == units
        product = (opened[name] * scale).astype(np.float32)
        np.testing.assert_array_equal(product, scaled[name])


def test_extreme_counts_are_not_hidden(tmp_path):
    extremes = [2**31 - 1, -(2**31 - 1), -(2**31), 101 * 4095]
    path = write(tmp_path, datasets=(ANALOG,), data=[struct.pack("<4i", *extremes)])
    raw = xr.open_dataset(path, engine="licel", mask_and_scale=False)
    assert raw.analog_532p.values.tolist() == [extremes]
    signal = xr.open_dataset(path, engine="licel").analog_532p
    saturated = signal.values[0] >= signal.attrs["full_scale"]
    assert saturated.tolist() == [True, False, False, True]
    assert np.isfinite(signal).all()


@pytest.mark.parametrize("input_range", ["0.020", "0.100", "0.500", "0.033"])
def test_a_saturated_value_compares_equal_to_full_scale(tmp_path, input_range):
    for shots in (1, 51, 101, 301, 600, 601, 999_999):
        for bits in (8, 12, 13, 14, 16):
            check_full_scale(tmp_path, shots, bits, input_range)


def check_full_scale(tmp_path, shots, bits, input_range):
    full = shots * (2**bits - 1)
    if full >= 2**31:
        return
    line = ANALOG.replace("000101", f"{shots:06d}").replace(" 12 ", f" {bits:02d} ")
    path = write(
        tmp_path,
        datasets=(line.replace("0.500", input_range),),
        data=[struct.pack("<4i", full, full - 1, 0, 0)],
    )
    signal = xr.open_dataset(path, engine="licel").analog_532p
    assert signal.values[0, 0] == np.float32(signal.attrs["full_scale"])
    assert signal.attrs["full_scale"] == pytest.approx(
        float(input_range) * 1e3 * (2**bits - 1) / 2**bits, rel=1e-7
    )


def test_only_the_needed_bins_are_read(data_root, reads):
    path = data_root / "pilar/20241002/h24A0217.301035"
    opened = xr.open_dataset(path, engine="licel")
    assert sum(length for _, length in reads) <= 16_384
    offset = licel.read_header(path).datasets[7].offset
    reads.clear()
    profile = opened.photon_532p.isel(range=slice(100, 110)).values
    assert reads == [(offset + 400, 40)]
    reads.clear()
    value = opened.photon_532p[0, 103].item()
    assert reads == [(offset + 412, 4)]
    assert value == profile[0, 3]
    reads.clear()
    assert opened.photon_532p.isel(range=slice(5, 5)).shape == (1, 0)
    assert opened.photon_532p.isel(range=slice(5, 5)).values.size == 0
    assert reads == []


@each(
    "key",
    [
        (slice(None), slice(None)),
        (0, slice(1, 4000, 7)),
        (slice(0, 0), slice(None)),
        (slice(None), slice(None, None, -1)),
        (slice(None), slice(4000, 10, -13)),
        (0, -1),
        (-1, [5, 3, 3, 4095]),
        ([0, 0], slice(2, 5)),
        (slice(None), np.array([-1, 0])),
        (0, 7),
    ],
)
def test_lazy_indexing_is_numpy_indexing(data_root, key):
    path = data_root / "pilar/20241002/h24A0217.301035"
    _, values = read_physical([path])
    lazy = xr.open_dataset(path, engine="licel", cache=False).analog_355s
    np.testing.assert_array_equal(lazy[key].values, values["analog_355s"][key])


def test_pickling_does_not_read_or_hold_the_file(data_root, reads):
    path = data_root / "pilar/20241002/h24A0217.301035"
    opened = xr.open_dataset(path, engine="licel")
    reads.clear()
    content = pickle.dumps(opened.drop_vars("range"))
    assert reads == []
    assert len(content) < 40_000
    again = pickle.loads(content)
    np.testing.assert_array_equal(again.analog_532p, opened.analog_532p)


def test_works_with_dask_chunks(file):
    opened = xr.open_dataset(file, engine="licel", chunks={"range": 3})
    np.testing.assert_array_equal(
        opened.photon_532p.compute(scheduler="synchronous"),
        xr.open_dataset(file, engine="licel").photon_532p,
    )


def test_a_changed_file_is_refused(file):
    opened = xr.open_dataset(file, engine="licel")
    file.write_bytes(raw_file() + b"more")
    with pytest.raises(RawFormatError, match="had 438 bytes"):
        opened.analog_532p.load()
    file.unlink()
    with pytest.raises(RawFormatError, match="cannot be opened"):
        opened.photon_532p.load()


def test_the_position_of_a_whole_profile_is_checked(tmp_path):
    content = bytearray(raw_file())
    content[licel.parse_header(bytes(content)).datasets[1].offset - 1] = 0
    path = tmp_path / "x"
    path.write_bytes(content)
    opened = xr.open_dataset(path, engine="licel")
    with pytest.raises(RawFormatError, match="no CRLF follows"):
        opened.analog_532p.load()


def test_the_engine_is_guessed_from_content(file, tmp_path):
    assert "photon_532p" in xr.open_dataset(file)
    assert "licel" in xr.backends.list_engines()
    entry = LicelBackendEntrypoint()
    other = tmp_path / "other"
    for content in (b"", b"CDF\x01" * 200, b" one\r\n two\r\n", b"\n" * 300):
        other.write_bytes(content)
        assert not entry.guess_can_open(other)
    assert not entry.guess_can_open(tmp_path / "absent")
    assert not entry.guess_can_open(tmp_path)
    assert not entry.guess_can_open(3)


def test_every_real_dialect_is_guessed(data_root):
    entry = LicelBackendEntrypoint()
    for folder in ("manaus", "pilar/20241002", "saopaulo/20170928/dark", "synthetic/boeckmann"):
        path = min(p for p in (data_root / folder).iterdir() if p.suffix != ".csv")
        assert entry.guess_can_open(path)
        assert entry.guess_can_open(str(path))
    assert not entry.guess_can_open(data_root / "synthetic/boeckmann/molecular_profile_hPa.csv")


def test_channels_and_dropped_variables(file):
    opened = xr.open_dataset(file, engine="licel", channels=["photon_532p"])
    assert set(opened.data_vars) == {"photon_532p", "photon_532p_shots"}
    opened = xr.open_dataset(file, engine="licel", channels="photon_532p")
    assert set(opened.data_vars) == {"photon_532p", "photon_532p_shots"}
    opened = xr.open_dataset(file, engine="licel", drop_variables=["analog_532p", "absent"])
    assert "analog_532p" not in opened
    opened = xr.open_dataset(file, engine="licel", drop_variables="latitude")
    assert "latitude" not in opened.coords
    with pytest.raises(RawFormatError, match="stored: analog_532p, photon_532p"):
        xr.open_dataset(file, engine="licel", channels=["photon_355p"])


def test_header_position(tmp_path):
    path = write(tmp_path, line_2=LINE_2.replace("-064.1 -031.2", "0048.7 0102.2"))
    opened = xr.open_dataset(path, engine="licel", header_position="latitude_first")
    assert (opened.latitude, opened.longitude) == (48.7, 102.2)
    opened = xr.open_dataset(path, engine="licel", header_position="ignore")
    assert not {"latitude", "longitude"} & set(opened.coords)
    with pytest.raises(RawFormatError, match="is not a place on Earth"):
        xr.open_dataset(path, engine="licel")
    with pytest.raises(RawFormatError, match="longitude_first, latitude_first, ignore"):
        xr.open_dataset(path, engine="licel", header_position="swapped")


def test_direction_and_notes(tmp_path):
    path = write(tmp_path, line_2=LINE_2[:-2] + "-72.5 123.4")
    opened = xr.open_dataset(path, engine="licel")
    assert np.isnan(opened.zenith_angle.values).all()
    assert opened.azimuth.values.tolist() == [123.4]
    assert "the pointing -72.5 degree may be an elevation" in opened.attrs["notes"]


def test_channels_on_other_grids(tmp_path):
    lines = (
        ANALOG.replace("7.50", "15.0"),
        PHOTON,
        PHOTON.replace("00532.p", "00387.o"),
        PHOTON.replace("00532.p", "00607.o").replace("00004", "00002"),
    )
    data = [struct.pack(f"<{n}i", *range(n)) for n in (4, 4, 4, 2)]
    opened = xr.open_dataset(write(tmp_path, datasets=lines, data=data), engine="licel")
    assert opened.photon_532p.dims == opened.photon_387o.dims == ("time", "range")
    assert opened.analog_532p.dims == ("time", "range_2")
    assert opened.photon_607o.dims == ("time", "range_3")
    assert opened.range_2.values.tolist() == [7.5, 22.5, 37.5, 52.5]
    assert opened.range_3.values.tolist() == [3.75, 11.25]


def test_an_impossible_wavelength_is_not_an_attribute(tmp_path):
    path = write(tmp_path, datasets=(ANALOG.replace("00532.p", "53200.o"),))
    attributes = xr.open_dataset(path, engine="licel").analog_53200o.attrs
    assert "wavelength" not in attributes
    assert attributes["wavelength_label"] == "53200.o"


def test_datasets_that_are_no_signal_are_not_opened(tmp_path):
    overflow = " 1 5 0 00004 0 0000 7.50 00000.o 0 0 00 000 00 000101 0.0000 OF0"
    path = write(tmp_path, datasets=(overflow, ANALOG))
    assert "overflow_0o" not in xr.open_dataset(path, engine="licel")
    with pytest.raises(RawFormatError, match="has no channel overflow_0o"):
        xr.open_dataset(path, engine="licel", channels=["overflow_0o"])


def test_other_objects_are_refused():
    with pytest.raises(RawFormatError, match="local path"):
        LicelBackendEntrypoint().open_dataset(b"bytes")
