"""The writer is atomic, and writes the same bytes for the same data."""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import signal as signals
import stat
import subprocess
import sys
from pathlib import Path

import h5netcdf
import h5py
import netCDF4
import numpy as np
import pytest
import scipy.io
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context, homogeneous, signal
from support.products.stored_products import assert_stored, digests, of_noise, truth

from lidarops.errors import ProductError
from lidarops.netcdf import write as writer
from lidarops.netcdf.write import (
    CHUNK_BYTES,
    CONTIGUOUS_BYTES,
    chunk_sizes,
    write_plain,
    write_product,
)

TESTS = Path(__file__).parents[1]


@pytest.fixture
def product() -> xr.Dataset:
    return build_product(homogeneous(), context())


def test_products_are_read_as_written(product: xr.Dataset, tmp_path: Path):
    path = tmp_path / "new" / "folder" / "product.nc"
    written = write_product(product, path)
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


def test_every_library_reads_large_variables_as_written(tmp_path: Path):
    product = of_noise()
    path = tmp_path / "product.nc"
    write_product(product, path)
    assert_stored(path, product)
    with xr.open_dataset(path, decode_cf=False) as stored:
        xr.testing.assert_equal(stored, product)
    with h5py.File(path) as file:
        for name, variable in product.variables.items():
            assert file[name][...].tobytes() == variable.values.tobytes()


@pytest.mark.skipif(shutil.which("nccopy") is None, reason="needs the netCDF utilities")
def test_tools_of_another_netcdf_read_large_variables(tmp_path: Path):
    product = of_noise()
    write_product(product, tmp_path / "product.nc")
    nccopy = [shutil.which("nccopy"), "-k", "classic"]
    subprocess.run([*nccopy, tmp_path / "product.nc", tmp_path / "classic.nc"], check=True)
    with scipy.io.netcdf_file(tmp_path / "classic.nc", mmap=False) as file:
        assert file.dimensions["time"] is None
        for name, variable in product.variables.items():
            stored = file.variables[name].data
            assert stored.astype(variable.dtype).tobytes() == variable.values.tobytes(), name


def test_files_are_hardly_larger_than_those_of_netcdf(tmp_path: Path):
    written = write_product(of_noise(), tmp_path / "product.nc")
    with xr.open_dataset(tmp_path / "product.nc", decode_cf=False) as stored:
        storage = ("zlib", "complevel", "shuffle", "chunksizes")
        encoding = {
            name: {key: variable.encoding[key] for key in storage}
            for name, variable in stored.variables.items()
            if variable.dims and variable.dtype.kind != "S"
        }
        stored.to_netcdf(tmp_path / "plain.nc", encoding=encoding)
    assert written.size <= 1.05 * (tmp_path / "plain.nc").stat().st_size


def test_a_file_may_be_extended(tmp_path: Path):
    product = of_noise()
    path = tmp_path / "product.nc"
    write_product(product, path)
    with netCDF4.Dataset(path, "a") as file:
        file["time"][299:310] = 0.0
        assert file["signal"].shape == (310, 2000)
        # The file already held the rest of the last chunk.
        assert file["signal"][299:].mask.all()
        assert (file["quality_flag"][299:310].filled() == netCDF4.default_fillvals["i4"]).all()
        file["signal"][305] = 1.0
    with netCDF4.Dataset(path) as file:
        np.testing.assert_array_equal(file["signal"][:299].data, product["signal"])
        np.testing.assert_array_equal(file["signal"][305], 1.0)
        assert file["signal"][306].mask.all()


@settings(deadline=None, max_examples=25)
@given(data=st.data())
def test_arrays_of_any_type_layout_and_size_are_kept(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
):
    dtype = data.draw(st.sampled_from(["<f4", ">f4", "<f8", ">f8", "<i4", ">i2", "i1", "S1"]))
    rows = data.draw(st.sampled_from([1, 16_000, 32_000])) // np.dtype(dtype).itemsize // 100 + 1
    pattern = data.draw(npst.arrays(dtype, (7, 11)))
    values = np.resize(pattern, (rows + data.draw(st.integers(0, 2)), 100))
    if data.draw(st.booleans()):
        values = np.asfortranarray(values)
    values.setflags(write=False)
    fill_value = {"_FillValue": values.dtype.type(5)} if values.dtype.kind != "S" else {}
    dims = data.draw(st.permutations(["time", "range"]))
    dataset = xr.Dataset({"x": (dims, values, fill_value), "y": 1.0})
    dataset.encoding["unlimited_dims"] = data.draw(st.sampled_from([(), ("time",), ("range",)]))
    path = tmp_path_factory.mktemp("any") / "any.nc"
    write_product(dataset, path)
    assert_stored(path, dataset)
    assert write_product(dataset, path) == write_product(dataset.copy(deep=True), path)


@pytest.mark.parametrize("name", ["time", "range", "сигнал", "x"])
def test_large_variables_may_have_any_name(name: str, tmp_path: Path):
    # A variable with the name of another dimension has a different name in HDF5.
    variables = {
        "x": xr.Variable(("time", "range"), np.ones((2, 2))),
        name: xr.Variable("time", np.arange(20_000, dtype="f8")[: 2 if name == "x" else None]),
    }
    variables["x"] = xr.Variable(("time", "range"), np.ones((variables[name].size, 2)))
    dataset = xr.Dataset(variables)
    dataset.encoding["unlimited_dims"] = ("time",)
    write_plain(dataset, tmp_path / "any.nc")
    write_product(dataset, tmp_path / "any.nc")
    assert_stored(tmp_path / "any.nc", dataset)


def test_a_variable_takes_little_more_than_its_values_and_attributes(tmp_path: Path):
    product = build_product(MAKERS["raman"](zenith=0.0), context("raman"))
    path = tmp_path / "product.nc"
    size = write_product(product, path).size
    texts = [
        value for owner in (product, *product.variables.values()) for value in owner.attrs.values()
    ]
    stated = sum(len(str(text).encode()) for text in texts)
    with h5py.File(path) as file:
        datasets = [file[name] for name in file]
        stored = sum(found.id.get_storage_size() for found in datasets)
        for found in (file, *datasets):
            spent = h5py.h5o.get_info(found.id)
            # Attributes lie in the header of their variable, an index of chunks is a small node.
            assert spent.meta_size.attr.heap_size == spent.meta_size.attr.index_size == 0
            assert spent.meta_size.obj.heap_size + spent.meta_size.obj.index_size <= 216
    assert size < stated + stored + 1100 * len(datasets)
    with h5netcdf.File(path) as file:
        assert list(file.variables) == list(product.variables)
        for name, variable in product.variables.items():
            assert file.variables[name].dimensions == variable.dims
            assert set(file.variables[name].attrs) == set(variable.attrs)
        assert file.dimensions["time"].isunlimited()


@pytest.mark.parametrize("kind", list(MAKERS))
def test_xarray_decodes_times_flags_bounds_and_coordinates(kind: str, tmp_path: Path):
    data = MAKERS[kind](zenith=0.0)
    path = tmp_path / "product.nc"
    write_product(build_product(data, context(kind)), path)
    with xr.open_dataset(path, decode_coords="all") as stored:
        np.testing.assert_array_equal(stored["time"], data["time"])
        np.testing.assert_array_equal(stored["quality_flag"], data["quality_flag"])
        assert {"time_bnds", "altitude", "latitude", "wavelength"} <= set(stored.coords)
        assert stored["wavelength"].item() == 532.0


def test_files_are_classic_with_one_unlimited_dimension(product: xr.Dataset, tmp_path: Path):
    path = tmp_path / "product.nc"
    write_product(product, path)
    with netCDF4.Dataset(path) as file:
        assert file.data_model == "NETCDF4_CLASSIC"
        assert [name for name, dim in file.dimensions.items() if dim.isunlimited()] == ["time"]
        assert not file.groups


@pytest.mark.parametrize(("profiles", "bins"), [(1, 40), (5, 40), (100, 4096)])
def test_every_variable_has_the_declared_chunks_and_filters(
    profiles: int, bins: int, tmp_path: Path
):
    path = tmp_path / "product.nc"
    write_product(build_product(signal(profiles, bins), context("signal")), path)
    with netCDF4.Dataset(path) as file:
        for name, variable in file.variables.items():
            rows = "time" in variable.dimensions
            if not rows and variable[...].nbytes <= CONTIGUOUS_BYTES:
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
        env={
            **os.environ,
            "PYTHONPATH": str(TESTS),
            "OMP_NUM_THREADS": "1",
            **environment,
        },
        timeout=120,
        check=False,
    )


SHA = """
import sys
from pathlib import Path
from support.products.stored_products import digests
print(*digests(Path(sys.argv[1])))
"""


@pytest.mark.slow
def test_bytes_are_equal_in_any_process_at_any_time(tmp_path: Path):
    # MALLOC_PERTURB_ shows memory that goes into the file without having been set.
    other = {"PYTHONHASHSEED": "1", "TZ": "Asia/Tokyo", "MALLOC_PERTURB_": "85"}
    first = run(SHA, str(tmp_path / "a.nc"), **other)
    (tmp_path / "elsewhere").mkdir()
    assert first.returncode == 0, first.stderr
    hashes = first.stdout.split()
    assert len(set(hashes)) == len(MAKERS) + 2
    assert hashes == digests(tmp_path / "elsewhere" / "b.nc")


THREADS = """
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import h5py
from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK
from support.products.stored_products import assert_stored, of_noise
from lidarops.netcdf.write import write_product
product = of_noise(150)
def work(number):
    path = f"{sys.argv[1]}/{number}.nc"
    sha256 = write_product(product, path).sha256
    with NETCDF4_PYTHON_LOCK:
        assert_stored(Path(path), product)
        with h5py.File(path) as file:
            assert (file["signal"][...] == product["signal"].values).all()
    return sha256
with ThreadPoolExecutor(4) as pool:
    print(len(set(pool.map(work, range(16)))))
"""


@pytest.mark.slow
def test_threads_may_write_at_once_and_read_under_the_lock(tmp_path: Path):
    done = run(THREADS, str(tmp_path))
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == "1"


@pytest.mark.parametrize("failure", [OSError("no"), RuntimeError("NetCDF: HDF error")])
def test_a_failure_leaves_the_former_file(
    failure: Exception, product: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "product.nc"
    write_product(product, path)
    before = path.read_bytes()

    def fail(_: Path) -> None:
        assert len(list(tmp_path.iterdir())) == 2
        raise failure

    monkeypatch.setattr(writer, "_sync", fail)
    with pytest.raises(ProductError, match="disk has space") as caught:
        write_product(product, path)
    assert caught.value.file == str(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupt_leaves_nothing(
    product: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupt(_: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(writer, "_sync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_product(product, tmp_path / "product.nc")
    assert list(tmp_path.iterdir()) == []


KILLED = """
import os, signal, sys
from support.products.made_products import context, homogeneous
from lidarops.netcdf import write as writer
from support.products.encoded_products import build_product
writer._sync = lambda path: os.kill(os.getpid(), signal.SIGKILL)
writer.write_product(build_product(homogeneous(), context()), sys.argv[1])
"""


@pytest.mark.slow
def test_a_killed_process_leaves_no_product(tmp_path: Path):
    done = run(KILLED, str(tmp_path / "product.nc"))
    assert done.returncode == -signals.SIGKILL
    assert not list(tmp_path.glob("*.nc"))


FULL = """
import resource, signal, sys
from support.products.stored_products import of_noise
from lidarops.errors import ProductError
from lidarops.netcdf.write import write_product
product = of_noise()
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
# Nothing; enough for some variables, for all but their data, for half of these; all.
for room in (100, 10_000, 100_000, 1_000_000, resource.RLIM_INFINITY):
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    try:
        write_product(product, sys.argv[1])
        print("written")
    except ProductError as error:
        print(error)
"""


@pytest.mark.slow
def test_a_full_disk_is_an_error_that_names_the_file(tmp_path: Path):
    path = tmp_path / "product.nc"
    done = run(FULL, str(path))
    assert done.returncode == 0, done.stderr[-2000:]
    *full, last = done.stdout.splitlines()
    assert len(full) == 4
    for line in full:
        assert str(path) in line
        assert "disk has space" in line
    assert last == "written"
    assert list(tmp_path.iterdir()) == [path]


def test_an_impossible_folder_is_an_error(product: xr.Dataset, tmp_path: Path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ProductError, match="folder is writable"):
        write_product(product, tmp_path / "file" / "product.nc")
    (tmp_path / "taken.nc").mkdir()
    with pytest.raises(ProductError, match=r"taken\.nc"):
        write_product(product, tmp_path / "taken.nc")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "taken.nc"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_an_error(product: xr.Dataset, tmp_path: Path):
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        with pytest.raises(ProductError, match="folder is writable"):
            write_product(product, tmp_path / "product.nc")
    finally:
        tmp_path.chmod(stat.S_IRWXU)


def test_products_follow_the_umask_of_the_user(product: xr.Dataset, tmp_path: Path):
    before = os.umask(0o022)
    try:
        write_product(product, tmp_path / "product.nc")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "product.nc").stat().st_mode) == 0o644


def test_plain_datasets_are_read_as_written(tmp_path: Path):
    path = tmp_path / "truth.nc"
    write_plain(truth(), path)
    with xr.open_dataset(path) as stored:
        xr.testing.assert_identical(stored.load().drop_encoding(), truth())
        assert stored["label"].values.tolist() == ["hazy", "чисто"]
    assert list(tmp_path.iterdir()) == [path]


def test_plain_datasets_that_xarray_cannot_encode_are_refused(tmp_path: Path):
    bad = xr.Dataset({"x": ("n", np.array([{}, []], dtype=object))})
    with pytest.raises(ProductError, match=r"bad\.nc"):
        write_plain(bad, tmp_path / "bad.nc")
    assert list(tmp_path.iterdir()) == []
