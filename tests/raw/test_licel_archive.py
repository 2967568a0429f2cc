"""Many files as one Dataset equal the stack of the single files."""

from __future__ import annotations

import os
import pickle
import random
from dataclasses import replace
from pathlib import Path

import dask
import numpy as np
import pytest
import xarray as xr
from support.cases import each
from support.licel_strategies import ANALOG, LINE_2, PHOTON, raw_file

import lidarops
from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.archive import open_archive
from lidarops.raw.formats import RawFile
from lidarops.records import Granule, Role, Status

SYNCHRONOUS = {"scheduler": "synchronous"}


@pytest.fixture(scope="session")
def pilar(data_root) -> list[Path]:
    return sorted((data_root / "pilar/20241002").iterdir())[:13]


@pytest.fixture(scope="session")
def stacked(pilar) -> xr.Dataset:
    names = {"data_vars": "minimal", "coords": "minimal", "compat": "override", "join": "exact"}
    return xr.concat([xr.open_dataset(p, engine="licel") for p in pilar], "time", **names).load()


def make(tmp_path, name="a", minute=30, **changes):
    """Write a small file that starts at 17:minute; return its path."""
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    line = changes.pop("line_2", LINE_2).replace("17:30:", f"17:{minute:02d}:")
    path.write_bytes(raw_file(line_2=line, **changes))
    return path


@each("profiles", [None, 1, 4, 5, 13, 100])
def test_archive_is_the_stack_of_its_files(pilar, stacked, profiles):
    archive = open_archive(pilar, profiles_per_chunk=profiles)
    computed = archive.compute(**SYNCHRONOUS)
    assert set(computed.variables) == set(stacked.variables)
    for name, variable in computed.variables.items():
        expected = stacked.variables[name]
        assert variable.dims == expected.dims, name
        assert variable.dtype == expected.dtype == archive.variables[name].dtype, name
        assert variable.attrs == expected.attrs, name
        np.testing.assert_array_equal(variable.values, expected.values, err_msg=name)
    lengths = archive.analog_532p.chunks[0]
    assert lengths[:-1] == (min(profiles or 13, 13),) * (len(lengths) - 1)
    assert archive.analog_532p.chunks[1] == (4096,)


def test_counts_are_those_of_the_files(pilar):
    archive = open_archive(pilar, mask_and_scale=False, profiles_per_chunk=3)
    assert archive.photon_387o.dtype == np.int32
    values = archive.photon_387o.compute(**SYNCHRONOUS)
    for index, path in enumerate(pilar):
        single = xr.open_dataset(path, engine="licel", mask_and_scale=False)
        np.testing.assert_array_equal(values[index], single.photon_387o[0])
        assert archive.photon_387o_scale[index] == single.photon_387o_scale[0]


def test_order_of_input_does_not_matter(pilar):
    ordered = open_archive(pilar)
    shuffled = list(pilar)
    random.Random(3).shuffle(shuffled)
    assert shuffled != pilar
    again = open_archive(shuffled)
    assert again.chunks == ordered.chunks
    assert again.analog_532p.data.name == ordered.analog_532p.data.name
    xr.testing.assert_identical(again.compute(**SYNCHRONOUS), ordered.compute(**SYNCHRONOUS))


def test_sorted_by_start_then_path(tmp_path):
    for name, minute, shots in (("c", 10, 1), ("a", 50, 2), ("b", 10, 3)):
        datasets = [line.replace("000101", f"{shots:06d}") for line in (ANALOG, PHOTON)]
        make(tmp_path, name, minute, datasets=datasets)
    archive = open_archive(tmp_path)
    assert archive.analog_532p_shots.values.tolist() == [3, 1, 2]
    signal = archive.analog_532p.compute(**SYNCHRONOUS).values[:, 1]
    np.testing.assert_allclose(signal, 500 / 4096 / np.array([3, 1, 2]), rtol=1e-7)


def test_the_graph_is_small(pilar):
    archive = open_archive(pilar, profiles_per_chunk=5)
    # Three chunks of a channel, and what they read from.
    graph = dict(archive.analog_532p.__dask_graph__())
    assert len(graph) == 4
    assert len(archive.__dask_graph__()) == 4 * 12
    assert all(len(pickle.dumps(task)) < 3000 for task in graph.values())


def test_default_chunks_hold_about_16_megabytes(data_root):
    paths = sorted((data_root / "pilar/20241002").iterdir())
    assert open_archive(paths).analog_532p.chunks[0] == (len(paths),)
    chunk = 16_000_000 // (4 * 4096)
    assert 1e6 < 4 * 4096 * chunk <= 64e6


def test_a_task_reads_only_its_channel_and_files(pilar, monkeypatch):
    archive = open_archive(pilar, profiles_per_chunk=4)
    read, pread = [], os.pread
    monkeypatch.setattr(os, "pread", lambda d, n, at: read.append(n) or pread(d, n, at))
    archive.analog_532p[4:8].compute(**SYNCHRONOUS)
    assert read == [2 + 4 * 4096 + 2] * 4


def test_threads_and_pickled_graphs_agree(pilar, stacked):
    archive = open_archive(pilar, channels="photon_532s", profiles_per_chunk=2)
    with dask.config.set(num_workers=2):
        threads = archive.photon_532s.compute(scheduler="threads")
    np.testing.assert_array_equal(threads, stacked.photon_532s)
    again = pickle.loads(pickle.dumps(archive))
    np.testing.assert_array_equal(again.photon_532s.compute(**SYNCHRONOUS), stacked.photon_532s)


def test_only_the_nearest_bins_are_read(pilar, stacked, monkeypatch):
    near = open_archive(pilar, stretches={"photon_532s": ((0, 100),)}, profiles_per_chunk=4)
    whole = near.analog_532p
    assert near.photon_532s.shape == (len(pilar), 100)
    read = []
    pread = os.pread
    monkeypatch.setattr(os, "pread", lambda d, n, at: read.append(n) or pread(d, n, at))
    values = near.photon_532s.values
    assert read == [400] * len(pilar)
    monkeypatch.undo()
    assert np.array_equal(values, stacked.photon_532s.values[:, :100])
    assert np.array_equal(near[near.photon_532s.dims[1]], stacked.range[:100])
    assert np.array_equal(whole, stacked.analog_532p)
    every = stacked.photon_532s.shape[1]
    assert (
        open_archive(pilar, stretches={"photon_532s": ((0, every + 5),)}).photon_532s.shape[1]
        == every
    )


def test_stretches_of_bins_lie_where_their_ranges_say(pilar, stacked):
    some = open_archive(pilar, stretches={"photon_532s": ((3, 40), (200, 201), (900, 1000))})
    kept = np.r_[3:40, 200, 900:1000]
    grid = some.photon_532s.dims[1]
    assert np.array_equal(some.photon_532s, stacked.photon_532s.values[:, kept])
    assert np.array_equal(some[grid], stacked.range[kept])
    assert np.array_equal(some.analog_532p, stacked.analog_532p)


@each(
    "stretches",
    [
        {"photon_1o": ((0, 4),)},
        {"photon_532s": ((0, 0),)},
        {"photon_532s": ()},
        {"photon_532s": ((-3, 4),)},
        {"photon_532s": ((0, 8), (7, 9))},
        {"photon_532s": ((10**6, 10**6 + 1),)},
    ],
)
def test_stretches_that_cannot_be_kept(pilar, stretches):
    with pytest.raises(RawFormatError, match="cannot be kept"):
        open_archive(pilar, stretches=stretches)


def test_sources(tmp_path):
    first = make(tmp_path, "day1/a", 10)
    second = make(tmp_path, "day2/b", 20)
    make(tmp_path, ".hidden/c", 30)
    (tmp_path / "day1/.part").write_bytes(b"x")
    granules = [
        Granule(
            path=path,
            size=0,
            mtime_ns=0,
            instrument="i",
            role=Role.SIGNAL,
            status=Status.GOOD,
        )
        for path in ("day2/b", "day1/a")
    ]
    expected = open_archive([first, second])
    assert expected.sizes["time"] == 2
    for opened in (
        open_archive(tmp_path),
        open_archive(str(tmp_path)),
        open_archive(".", root=tmp_path),
        open_archive(f"{tmp_path}/day*/*"),
        open_archive("day*/[ab]", root=tmp_path),
        open_archive("**/[ab]", root=tmp_path),
        open_archive(["day2/b", Path("day1/a")], root=tmp_path),
        open_archive(iter(granules), root=tmp_path),
        lidarops.open_archive(tmp_path),
    ):
        xr.testing.assert_identical(opened.compute(**SYNCHRONOUS), expected.compute(**SYNCHRONOUS))
    assert open_archive(first).sizes["time"] == 1


def catalogued(folder: Path, paths: list[Path]) -> list[Granule]:
    """Return the granules of files, as in a catalog."""
    granules = []
    for path in paths:
        header = licel.read_header(path)
        granules.append(
            Granule(
                path=str(path.relative_to(folder)),
                size=header.size,
                mtime_ns=path.stat().st_mtime_ns,
                instrument="i",
                role=Role.SIGNAL,
                status=Status.GOOD,
                notes=header.notes,
                start=header.start,
                stop=header.stop,
                zenith_angle=header.zenith_angle,
                azimuth=header.azimuth,
                altitude=header.altitude,
                header_digest=header.header_digest,
            )
        )
    return granules


@pytest.fixture
def headers_read(monkeypatch) -> list[str]:
    """Return a list that collects the paths of the headers read."""
    headers_seen: list[str] = []
    read = RawFile.read_header
    monkeypatch.setattr(
        RawFile,
        "read_header",
        lambda file, parse: headers_seen.append(file.path) or read(file, parse),
    )
    return headers_seen


def test_one_header_is_read_of_files_with_equal_digests(tmp_path, headers_read):
    other_shots = [line.replace("000101", "000102") for line in (ANALOG, PHOTON)]
    paths = [make(tmp_path, f"a{k}", k, line_2=f"{LINE_2[:-2]}{k:02d}") for k in (5, 1, 3)]
    paths += [make(tmp_path, f"b{k}", k, datasets=other_shots) for k in (4, 2)]
    paths.append(make(tmp_path, "c", 6, line_2=LINE_2.replace("LidarPi", "Elsewhere")))
    paths.append(make(tmp_path, "d", 7, last=b""))
    paths.append(make(tmp_path, "e", 8, line_1=" a longer name than the eighty bytes " + "x" * 50))
    granules = catalogued(tmp_path, paths)
    headers_read.clear()
    known = open_archive(granules, root=tmp_path, header_position="ignore", mask_and_scale=False)
    assert [Path(path).name for path in headers_read] == ["a1", "b2", "c", "d", "e"]
    read = open_archive(paths, header_position="ignore", mask_and_scale=False)
    assert known.zenith_angle.values[:3].tolist() == [1.0, 0.0, 3.0]
    assert known.analog_532p_shots.values.tolist() == [101, 102, 101, 102, 101, 101, 101, 101]
    xr.testing.assert_identical(known.compute(**SYNCHRONOUS), read.compute(**SYNCHRONOUS))
    assert known.analog_532p.data.name == read.analog_532p.data.name


def test_a_header_is_read_if_the_catalog_lacks_a_value(tmp_path, headers_read):
    paths = [make(tmp_path, f"a{k}", k) for k in range(4)]
    granules = catalogued(tmp_path, paths)
    headers_read.clear()
    # With a requested position: the catalog may hold that of the station.
    open_archive(granules, root=tmp_path)
    assert len(headers_read) == 4
    headers_read.clear()
    unknown = [granules[0], replace(granules[1], header_digest=None), *granules[2:]]
    open_archive(unknown, root=tmp_path, header_position="ignore")
    assert [Path(path).name for path in headers_read] == ["a0", "a1"]
    headers_read.clear()
    # The first file has changed since the scan, so its header stands for no other.
    make(tmp_path, "a0", 0, line_2=LINE_2.replace("LidarPi", "LidarPo"))
    open_archive(granules, root=tmp_path, header_position="ignore")
    assert [Path(path).name for path in headers_read] == ["a0", "a1"]


def test_sources_that_cannot_be_opened(tmp_path):
    make(tmp_path, "a")
    for source in ("absent", "b*", "a\0", []):
        with pytest.raises(RawFormatError, match="no files are found"):
            open_archive(source, root=tmp_path)
    with pytest.raises(RawFormatError, match="cannot be opened"):
        open_archive(["absent"], root=tmp_path)
    with pytest.raises(RawFormatError, match="a: is given 2 times"):
        open_archive(["a", "a"], root=tmp_path)
    with pytest.raises(RawFormatError, match="profiles_per_chunk"):
        open_archive(tmp_path, profiles_per_chunk=0)
    (tmp_path / "b").write_bytes(b"not Licel")
    with pytest.raises(RawFormatError, match="b: "):
        open_archive(tmp_path)


def test_layouts_must_agree_in_the_opened_channels(tmp_path):
    make(tmp_path, "a", 10)
    make(tmp_path, "b", 20)
    make(tmp_path, "odd", 15, datasets=(PHOTON, ANALOG.replace("7.50", "15.0")))
    with pytest.raises(RawFormatError, match="odd: analog_532p: is of another layout"):
        open_archive(tmp_path)
    opened = open_archive(tmp_path, channels=["photon_532p"])
    signal = opened.photon_532p.compute(**SYNCHRONOUS).values * 101 / 20
    np.testing.assert_allclose(signal[:, 0], [10, 0, 10], atol=1e-5)
    make(tmp_path, "less", 40, datasets=(ANALOG,))
    with pytest.raises(RawFormatError, match="less: channels: has no channel photon_532p"):
        open_archive(tmp_path, channels=["photon_532p"])
    with pytest.raises(RawFormatError, match="layout"):
        open_archive([tmp_path / "a", tmp_path / "less"])


def test_channels_in_another_order_are_the_same_channels(tmp_path):
    make(tmp_path, "a", 10)
    make(tmp_path, "b", 20, datasets=(PHOTON, ANALOG))
    opened = open_archive(tmp_path).compute(**SYNCHRONOUS)
    np.testing.assert_allclose(opened.photon_532p[:, 0] * 101 / 20, [10, 0], atol=1e-5)
    np.testing.assert_allclose(opened.analog_532p[:, 0] * 101 * 4096 / 500, [0, 10], atol=1e-4)


def test_properties_that_vary_are_variables(tmp_path):
    photon = PHOTON.replace("BC0", "BC1")
    make(tmp_path, "a", 10, datasets=(ANALOG, photon))
    other = ANALOG.replace("0800", "0900").replace("0.500", "0.020")
    make(tmp_path, "b", 20, datasets=(other.replace("000101", "000099"), photon))
    opened = open_archive(tmp_path)
    assert opened.analog_532p_high_voltage.values.tolist() == [800.0, 900.0]
    assert opened.analog_532p_input_range.values.tolist() == [0.5, 0.02]
    assert opened.analog_532p_shots.values.tolist() == [101, 99]
    assert not {"high_voltage", "full_scale"} & set(opened.analog_532p.attrs)
    assert opened.analog_532p.attrs["device"] == "BT0"
    assert opened.photon_532p.attrs["high_voltage"] == 800.0
    signal = opened.analog_532p.compute(**SYNCHRONOUS).values[:, 1]
    np.testing.assert_allclose(signal, [500 / 101 / 4096, 20 / 99 / 4096], rtol=1e-7)


def test_a_moving_and_turning_lidar(tmp_path):
    make(tmp_path, "a", 10, line_2=LINE_2[:-2] + "10.0 090.0")
    make(tmp_path, "b", 20, line_2=LINE_2.replace("-031.2 00", "-031.3 20"))
    opened = open_archive(tmp_path)
    assert opened.latitude.dims == ("time",)
    assert opened.latitude.values.tolist() == [-31.2, -31.3]
    assert opened.longitude.dims == ()
    assert opened.zenith_angle.values.tolist() == [10.0, 20.0]
    np.testing.assert_array_equal(opened.azimuth, [90.0, np.nan])


def test_zero_shots_are_nan_in_that_file_only(tmp_path):
    make(tmp_path, "a", 10)
    make(tmp_path, "b", 20, datasets=(ANALOG.replace("000101", "000000"), PHOTON))
    opened = open_archive(tmp_path).compute(**SYNCHRONOUS)
    assert np.isnan(opened.analog_532p).all("range").values.tolist() == [False, True]
    assert np.isfinite(opened.photon_532p).all()
    assert "no shots" in opened.attrs["notes"]


def test_changed_and_vanished_files_are_refused_when_read(tmp_path):
    make(tmp_path, "a", 10)
    path = make(tmp_path, "b", 20)
    opened = open_archive(tmp_path, profiles_per_chunk=1)
    path.write_bytes(path.read_bytes() + b"\0" * 8)
    with pytest.raises(RawFormatError, match="b: size: had 438 bytes"):
        opened.analog_532p.compute(**SYNCHRONOUS)
    assert np.isfinite(opened.analog_532p[0].compute(**SYNCHRONOUS)).all()
    path.unlink()
    with pytest.raises(RawFormatError, match="b: cannot be opened"):
        opened.analog_532p.compute(**SYNCHRONOUS)


def test_a_changed_file_is_not_taken_from_a_cache(tmp_path):
    path = make(tmp_path, "a", 10)
    before = open_archive(tmp_path).analog_532p.data.name
    assert open_archive(tmp_path).analog_532p.data.name == before
    os.utime(path, ns=(1, 1))
    assert open_archive(tmp_path).analog_532p.data.name != before
