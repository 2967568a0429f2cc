"""Whole or not at all, and the same bytes every time."""

from __future__ import annotations

import hashlib
import math
import os
import signal as signals
import stat
import subprocess
import sys
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from made_products import MAKERS, context, homogeneous, signal

from lidarops.errors import ProductError
from lidarops.products import write as writer
from lidarops.products.build import build
from lidarops.products.write import CHUNK_BYTES, chunk_sizes, write, write_plain
from lidarops.records import ProductKind

HERE = Path(__file__).parent


@pytest.fixture
def product() -> xr.Dataset:
    return build(homogeneous(), context())


def truth() -> xr.Dataset:
    return xr.Dataset(
        {
            "extinction": (("scene", "level"), np.array([[1e-5, np.nan], [2e-5, 3e-5]])),
            "label": ("scene", np.array(["hazy", "чисто"])),
            "weather": "fair",
            "good": ("scene", np.array([True, False])),
            "seed": ("scene", np.array([2**40, 1])),
            "nothing": ("scene", np.array(["", ""])),
        },
        coords={"scene": np.array(["2026-03-01", "2026-03-02"], "datetime64[ns]")},
        attrs={"title": "Truth", "seed": 7},
    )


def test_what_is_written_is_what_is_read(product: xr.Dataset, tmp_path: Path):
    path = tmp_path / "new" / "folder" / "product.nc"
    written = write(product, path)
    assert written.size == path.stat().st_size
    assert written.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    with xr.open_dataset(path, decode_cf=False) as stored:
        assert set(stored.variables) == set(product.variables)
        for name, variable in product.variables.items():
            np.testing.assert_array_equal(stored[name].values, variable.values)
            assert stored[name].dtype == variable.dtype
            assert set(stored[name].attrs) == set(variable.attrs)
        assert set(stored.attrs) == set(product.attrs)
        assert stored.attrs["institution"] == "Université d'Été"


@pytest.mark.parametrize("kind", list(ProductKind))
def test_xarray_decodes_times_flags_bounds_and_coordinates(kind: ProductKind, tmp_path: Path):
    data = MAKERS[kind](zenith=0.0)
    path = tmp_path / "product.nc"
    write(build(data, context(kind)), path)
    with xr.open_dataset(path, decode_coords="all") as stored:
        np.testing.assert_array_equal(stored["time"], data["time"])
        np.testing.assert_array_equal(stored["quality_flag"], data["quality_flag"])
        assert {"time_bnds", "altitude", "latitude", "wavelength"} <= set(stored.coords)
        assert stored["wavelength"].item() == 532.0


def test_files_are_classic_with_one_unlimited_dimension(product: xr.Dataset, tmp_path: Path):
    path = tmp_path / "product.nc"
    write(product, path)
    with netCDF4.Dataset(path) as file:
        assert file.data_model == "NETCDF4_CLASSIC"
        assert [name for name, dim in file.dimensions.items() if dim.isunlimited()] == ["time"]
        assert not file.groups


@pytest.mark.parametrize(("profiles", "bins"), [(1, 40), (5, 40), (100, 4096)])
def test_every_variable_has_the_declared_chunks_and_filters(
    profiles: int, bins: int, tmp_path: Path
):
    path = tmp_path / "product.nc"
    write(build(signal(profiles, bins), context(ProductKind.SIGNAL)), path)
    with netCDF4.Dataset(path) as file:
        for name, variable in file.variables.items():
            if not variable.dimensions:
                assert variable.chunking() == "contiguous"
                continue
            filters = variable.filters()
            assert (filters["zlib"], filters["complevel"], filters["shuffle"]) == (True, 4, True)
            assert tuple(variable.chunking()) == chunk_sizes(
                variable.shape, variable.dtype.itemsize
            ), name
        rows = min(profiles, CHUNK_BYTES // (4 * bins))
        assert file["signal"].chunking() == [rows, bins]


@settings(deadline=None)
@given(
    shape=st.lists(st.integers(1, 10**5), min_size=1, max_size=3).map(tuple),
    itemsize=st.sampled_from([1, 2, 4, 8]),
)
def test_chunks_fit_and_are_whole_rows(shape: tuple[int, ...], itemsize: int):
    chunk = chunk_sizes(shape, itemsize)
    assert math.prod(chunk) * itemsize <= CHUNK_BYTES
    assert all(1 <= part <= whole for part, whole in zip(chunk, shape, strict=True))
    if math.prod(shape) * itemsize <= CHUNK_BYTES:
        assert chunk == shape
    else:
        # One axis is cut, where not one row more would fit; those before it are single.
        axis = max(i for i, whole in enumerate(shape) if chunk[i] < whole)
        assert chunk[:axis] == (1,) * axis
        assert chunk[axis + 1 :] == shape[axis + 1 :]
        assert (chunk[axis] + 1) * math.prod(shape[axis + 1 :]) * itemsize > CHUNK_BYTES


def run(script: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", script, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1", **environment},
        timeout=120,
        check=False,
    )


SHA = """
import sys
from made_products import MAKERS, context
from test_write import truth
from lidarops.products.build import build
from lidarops.products.write import write, write_plain
for kind, maker in MAKERS.items():
    print(write(build(maker(zenith=[0, 1, 2, 3, 4]), context(kind)), sys.argv[1]).sha256)
print(write_plain(truth(), sys.argv[1]).sha256)
"""


def test_bytes_are_equal_in_any_process_at_any_time(tmp_path: Path):
    first = run(SHA, str(tmp_path / "a.nc"), PYTHONHASHSEED="1", TZ="Asia/Tokyo")
    (tmp_path / "elsewhere").mkdir()
    second = run(SHA, str(tmp_path / "elsewhere" / "b.nc"), PYTHONHASHSEED="2", TZ="UTC")
    assert first.returncode == 0, first.stderr
    hashes = first.stdout.split()
    assert len(set(hashes)) == 3
    assert hashes == second.stdout.split()


THREADS = """
import sys
from concurrent.futures import ThreadPoolExecutor
from made_products import context, signal
from lidarops.products.build import build
from lidarops.products.write import write
from lidarops.records import ProductKind
product = build(signal(40, 2000), context(ProductKind.SIGNAL))
def work(number):
    return write(product, f"{sys.argv[1]}/{number}.nc").sha256
with ThreadPoolExecutor(4) as pool:
    print(len(set(pool.map(work, range(16)))))
"""


def test_threads_may_write_at_once(tmp_path: Path):
    done = run(THREADS, str(tmp_path))
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == "1"


@pytest.mark.parametrize("failure", [OSError("no"), RuntimeError("NetCDF: HDF error")])
def test_a_failure_leaves_what_was_there(
    failure: Exception, product: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "product.nc"
    write(product, path)
    before = path.read_bytes()

    def fail(_: Path) -> None:
        assert len(list(tmp_path.iterdir())) == 2
        raise failure

    monkeypatch.setattr(writer, "_settle", fail)
    with pytest.raises(ProductError, match="disk has space") as caught:
        write(product, path)
    assert caught.value.file == str(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupt_leaves_nothing(
    product: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupt(_: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(writer, "_settle", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(product, tmp_path / "product.nc")
    assert list(tmp_path.iterdir()) == []


KILLED = """
import os, signal, sys
from made_products import context, homogeneous
from lidarops.products import write as writer
from lidarops.products.build import build
writer._settle = lambda path: os.kill(os.getpid(), signal.SIGKILL)
writer.write(build(homogeneous(), context()), sys.argv[1])
"""


def test_a_killed_process_leaves_no_product(tmp_path: Path):
    done = run(KILLED, str(tmp_path / "product.nc"))
    assert done.returncode == -signals.SIGKILL
    assert not list(tmp_path.glob("*.nc"))


FULL = """
import resource, signal, sys
from made_products import context, signal as make
from lidarops.errors import ProductError
from lidarops.products.build import build
from lidarops.products.write import write
from lidarops.records import ProductKind
product = build(make(50, 4000), context(ProductKind.SIGNAL))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, resource.RLIM_INFINITY))
try:
    write(product, sys.argv[1])
except ProductError as error:
    print(error)
"""


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path: Path):
    path = tmp_path / "product.nc"
    done = run(FULL, str(path))
    assert done.returncode == 0, done.stderr[-2000:]
    assert str(path) in done.stdout
    assert "disk has space" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_is_an_error(product: xr.Dataset, tmp_path: Path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ProductError, match="folder can be written"):
        write(product, tmp_path / "file" / "product.nc")
    (tmp_path / "taken.nc").mkdir()
    with pytest.raises(ProductError, match=r"taken\.nc"):
        write(product, tmp_path / "taken.nc")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "taken.nc"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_an_error(product: xr.Dataset, tmp_path: Path):
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        with pytest.raises(ProductError, match="folder can be written"):
            write(product, tmp_path / "product.nc")
    finally:
        tmp_path.chmod(stat.S_IRWXU)


def test_products_have_the_permissions_that_the_user_wants(product: xr.Dataset, tmp_path: Path):
    before = os.umask(0o022)
    try:
        write(product, tmp_path / "product.nc")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "product.nc").stat().st_mode) == 0o644


@pytest.mark.parametrize("function", [write, write_plain])
def test_dask_arrays_are_refused(function, product: xr.Dataset, tmp_path: Path):
    lazy = product.assign(extinction=product["extinction"].chunk())
    with pytest.raises(ProductError, match="load the dataset") as caught:
        function(lazy, tmp_path / "product.nc")
    assert caught.value.field == "extinction"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        (np.array(["text"]), "NetCDF cannot hold"),
        (np.array(["2026-01-01"], "datetime64[ns]"), "NetCDF cannot hold"),
        (np.zeros(0), "empty"),
    ],
)
def test_what_netcdf_cannot_hold_is_refused(values, problem, tmp_path: Path):
    with pytest.raises(ProductError, match=problem):
        write(xr.Dataset({"x": ("n", values)}), tmp_path / "product.nc")
    assert list(tmp_path.iterdir()) == []


def test_plain_datasets_read_back_as_they_were(tmp_path: Path):
    path = tmp_path / "truth.nc"
    written = write_plain(truth(), path)
    assert written.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    with xr.open_dataset(path) as stored:
        xr.testing.assert_identical(stored.load().drop_encoding(), truth())
        assert stored["label"].values.tolist() == ["hazy", "чисто"]
    assert list(tmp_path.iterdir()) == [path]


def test_plain_datasets_that_xarray_cannot_encode_are_refused(tmp_path: Path):
    bad = xr.Dataset({"x": ("n", np.array([{}, []], dtype=object))})
    with pytest.raises(ProductError, match=r"bad\.nc"):
        write_plain(bad, tmp_path / "bad.nc")
    assert list(tmp_path.iterdir()) == []
