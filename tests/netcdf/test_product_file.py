"""Products are written some profiles at a time, with bytes that do not depend on how many."""

from __future__ import annotations

import hashlib
import tracemalloc
from datetime import UTC, datetime
from itertools import pairwise, repeat
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context, elastic, homogeneous, signal

from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.netcdf import context as contexts
from lidarops.netcdf import write as writer
from lidarops.netcdf.product_file import ProductWriter, create_product
from lidarops.netcdf.write import CHUNK_BYTES, write_product
from lidarops.records import ProductRecord, Stamp

PROFILES, BINS = 53, 9000
"""A signal has 29 profiles a chunk, and its last chunk is cut."""
MIB = 1 << 20


def framed(data: xr.Dataset) -> xr.Dataset:
    """Return what is known before the first profile."""
    measured = [name for name, array in data.data_vars.items() if "time" in array.dims]
    return data.drop_vars(measured)


def added(data: xr.Dataset, kind: str, path: Path, cuts: list[int]) -> ProductRecord:
    """Write a product, cut before some of its profiles."""
    with create_product(framed(data), context(kind), path) as product:
        for first, last in pairwise([0, *cuts, data.sizes["time"]]):
            product.add(data.isel(time=slice(first, last)))
    return product.record


def whole(data: xr.Dataset, kind: str, path: Path) -> bytes:
    write_product(build_product(data, context(kind)), path)
    return path.read_bytes()


@pytest.fixture(scope="module")
def large() -> xr.Dataset:
    """A signal of a beam that moves, so that altitudes are over time too."""
    data = signal(PROFILES, BINS, zenith=np.linspace(0.0, 80.0, PROFILES))
    rng = np.random.default_rng(3)
    data["signal_standard_error"][:] = rng.uniform(1e3, 1e4, (PROFILES, BINS))
    data["quality_flag"][:, 100:] |= rng.choice(
        [0, 0, Quality.SATURATED, Quality.PILE_UP], (PROFILES, BINS - 100)
    ).astype(np.int32)
    return data


@pytest.fixture(scope="module")
def large_at_once(large: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    content = whole(large, "signal", tmp_path_factory.mktemp("whole") / "whole.nc")
    assert 4 * PROFILES * BINS > CHUNK_BYTES
    return content


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cuts=st.sets(st.integers(1, PROFILES - 1)).map(sorted))
def test_bytes_do_not_depend_on_the_number_of_profiles_at_a_time(
    cuts: list[int], large: xr.Dataset, large_at_once: bytes, tmp_path: Path
):
    written = added(large, "signal", tmp_path / "product.nc", cuts)
    content = (tmp_path / "product.nc").read_bytes()
    assert content == large_at_once
    assert written.sha256 == hashlib.sha256(content).hexdigest()
    assert written.size == len(content)


@pytest.mark.parametrize("kind", list(MAKERS))
@pytest.mark.parametrize("cuts", [[], [1, 2, 3, 4], [3]])
def test_every_kind_may_be_added_in_pieces(kind: str, cuts: list[int], tmp_path: Path):
    data = MAKERS[kind](zenith=[0.0, 30.0, 60.0, 30.0, 90.0])
    added(data, kind, tmp_path / "product.nc", cuts)
    assert (tmp_path / "product.nc").read_bytes() == whole(data, kind, tmp_path / "whole.nc")


def test_flags_are_counted(large: xr.Dataset, tmp_path: Path):
    written = added(large, "signal", tmp_path / "product.nc", [10, 40])
    flags = large["quality_flag"].to_numpy()
    assert written.values == flags.size
    assert written.unflagged == np.count_nonzero(flags == 0)
    assert written.usable == np.count_nonzero((flags & flags_of("signal").rejecting) == 0)
    assert written.flagged == {
        bit.name: np.count_nonzero(flags & bit) for bit in flags_of("signal") if (flags & bit).any()
    }
    assert list(written.flagged) == [
        "INPUT_MISSING", "SATURATED", "PILE_UP", "INCOMPLETE_OVERLAP"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("pieces", "field", "problem"),
    [
        (lambda data: [data.isel(time=slice(4))], None, "4 of 5 rows"),
        (lambda data: [], None, "no profiles"),
        (lambda data: [data, data], "time", "more profiles"),
        (lambda data: [data.isel(time=slice(0, 0)), data], "quality_flag", "empty"),
        (lambda data: [data.isel(time=slice(2)), data.isel(time=slice(3, 5))], "time", "continue"),
        (
            lambda data: [data.isel(time=[0]), data.isel(time=slice(1, 5)).drop_vars("shots")],
            "shots",
            "missing",
        ),
        (
            lambda data: [
                data.isel(time=[0]),
                data.isel(time=slice(1, 5)).assign(glue_top=data["shots"]),
            ],
            "glue_top",
            "not in others",
        ),
        (lambda data: [data.isel(range=slice(39))], "signal", "39 values along range"),
        (lambda data: [data.assign(extra=data["shots"])], "extra", "not a variable"),
        (lambda data: [data.chunk()], "quality_flag", "dask"),
        (lambda data: [data.assign(signal=data["signal"] * np.nan)], "signal", "quality bit"),
        (lambda data: [data.assign(quality_flag=data["quality_flag"] * 0 - 1)], None, "bits"),
        (lambda data: [data.assign(shots=-data["shots"])], "shots", "valid range"),
    ],
)
def test_profiles_that_do_not_fit_leave_the_former_file(pieces, field, problem, tmp_path: Path):
    data, path = signal(), tmp_path / "product.nc"
    path.write_text("former")

    def write(product: ProductWriter) -> None:
        for piece in pieces(data):
            product.add(piece)

    with (
        pytest.raises(ProductError, match=problem) as caught,
        create_product(framed(data), context("signal"), path) as product,
    ):
        write(product)
    assert field is None or caught.value.field == field
    assert path.read_text() == "former"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ProductError, match=r"no profiles|not written"):
        _ = product.record


def test_profiles_decide_on_optional_variables(tmp_path: Path):
    data = elastic()
    glued = [name for name in data if str(name).startswith("glue_")]
    for absent in ([], glued):
        added(data.drop_vars(absent), "elastic", tmp_path / "product.nc", [2])
        with xr.open_dataset(tmp_path / "product.nc") as stored:
            assert ("glue_slope" in stored) == (not absent)


def test_a_failed_check_takes_nothing_of_its_profiles(tmp_path: Path):
    data, path = homogeneous(), tmp_path / "product.nc"
    bad = data.isel(time=slice(2)).assign(shots=("time", [-1, -1]))
    with create_product(framed(data), context("homogeneous"), path) as product:
        with pytest.raises(ProductError, match="valid range"):
            product.add(bad)
        product.add(data)
    assert path.read_bytes() == whole(data, "homogeneous", tmp_path / "whole.nc")


def test_errors_of_the_block_are_raised_as_they_are(tmp_path: Path):
    data = signal()

    def fail_after_some(product: ProductWriter) -> None:
        product.add(data.isel(time=slice(2)))
        assert len(list(tmp_path.iterdir())) == 1
        raise FileNotFoundError("raw file")

    with (
        pytest.raises(FileNotFoundError, match="raw"),
        create_product(framed(data), context("signal"), tmp_path / "product.nc") as product,
    ):
        fail_after_some(product)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path):
    (tmp_path / "file").write_text("no folder")
    with (
        pytest.raises(ProductError, match="folder is writable"),
        create_product(signal(), context("signal"), tmp_path / "file/product.nc") as product,
    ):
        product.add(signal())


@pytest.mark.parametrize(
    "room",
    [
        pytest.param(room, marks=[pytest.mark.slow] if room % 148_000 else [])
        for room in range(0, 900_000, 37_000)
    ],
)
def test_a_disk_that_fills_is_an_error_and_no_crash(
    room: int, large: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    class Full(writer.QuietFile):
        """A file on a disk with space for `room` bytes of chunks and of what HDF5 adds."""

        left = room

        def _write_some(self, data: memoryview) -> int:
            if not self.left:
                raise OSError(28, "No space left on device")
            size = super()._write_some(data[: self.left])
            self.left -= size
            return size

    monkeypatch.setattr(writer, "QuietFile", Full)
    with pytest.raises(ProductError, match=r"No space left.*disk has space"):
        added(large, "signal", tmp_path / "product.nc", [20, 40])
    assert list(tmp_path.iterdir()) == []


def test_memory_does_not_grow_with_the_number_of_profiles(tmp_path: Path):
    def peak(profiles: int) -> int:
        zenith = np.linspace(0.0, 80.0, profiles)
        frame = framed(signal(1, 8000)).drop_vars(["time", "time_bnds", "zenith_angle"])
        times = framed(signal(profiles, 1, zenith=zenith)).drop_vars("range")
        block = signal(20, 8000).drop_vars(["time", "time_bnds", "zenith_angle"])
        tracemalloc.start()
        path = tmp_path / "product.nc"
        with create_product(frame.merge(times), context("signal"), path) as product:
            for _ in range(profiles // 20):
                product.add(block)
        highest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return highest

    short, long = peak(100), peak(800)
    assert long < short + MIB
    assert long < 20 * MIB


def test_a_product_states_one_time_of_writing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not that of each question for it."""
    times = map(datetime.fromtimestamp, range(100), repeat(UTC))
    monkeypatch.setattr(contexts, "writing_time", lambda: next(times))
    unstamped = context(stamp=Stamp())
    assert unstamped.written == unstamped.written == unstamped.stamp.written
