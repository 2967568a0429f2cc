"""Chunks that are deflated here are equal to those of HDF5's own filters."""

from __future__ import annotations

import itertools
import zlib

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from support.cases import each

from lidarops.netcdf.write import _planes, deflate_chunks

DTYPES = ["i1", "u1", "i2", "i4", "i8", "f4", "f8"]


def unshuffled(data: bytes, dtype: np.dtype, chunk: tuple[int, ...]) -> np.ndarray:
    """Return the values of a chunk, inflated by the standard library."""
    raw = np.frombuffer(zlib.decompress(data), np.uint8)
    return np.ascontiguousarray(raw.reshape(dtype.itemsize, -1).T).view(dtype).reshape(chunk)


def assembled(values: np.ndarray, chunk: tuple[int, ...], fill_value) -> np.ndarray:
    """Return the array of all chunks, including the parts beyond its edges."""
    grid = [-(-size // step) * step for size, step in zip(values.shape, chunk, strict=True)]
    whole = np.zeros(grid, values.dtype)
    seen = set()
    for offset, data in deflate_chunks(values, chunk, fill_value):
        assert offset not in seen
        seen.add(offset)
        place = tuple(slice(at, at + step) for at, step in zip(offset, chunk, strict=True))
        whole[place] = unshuffled(data, values.dtype, chunk)
    assert len(seen) == np.prod([all_ // step for all_, step in zip(grid, chunk, strict=True)])
    return whole


@st.composite
def cut_arrays(draw: st.DrawFn) -> tuple[np.ndarray, tuple[int, ...]]:
    shape = draw(npst.array_shapes(max_dims=3, max_side=9))
    values = draw(npst.arrays(draw(st.sampled_from(DTYPES)), shape))
    return values, tuple(draw(st.integers(1, size)) for size in shape)


@settings(deadline=None)
@given(cut=cut_arrays())
@example(cut=(np.array([np.nan, -0.0, np.inf], "f4"), (2,)))
def test_chunks_hold_the_array_and_beyond_its_edge_the_fill_value(cut):
    values, chunk = cut
    fill_value = values.dtype.type(77)
    whole = assembled(values, chunk, fill_value)
    inside = tuple(slice(size) for size in values.shape)
    # As bytes: NaN and the sign of zero count.
    assert whole[inside].tobytes() == values.tobytes()
    whole[inside] = fill_value
    assert (whole == fill_value).all()


def test_text_is_cut_into_chunks_like_numbers():
    text = np.frombuffer(b"provenance" * 7, "S1")
    whole = assembled(text, (64,), b"\0")
    assert whole.tobytes() == text.tobytes() + bytes(128 - 70)


@each("dtype", DTYPES)
def test_layout_in_memory_does_not_matter(dtype: str):
    values = np.arange(12 * 50).reshape(12, 50).astype(dtype)
    read_only = values.copy()
    read_only.setflags(write=False)
    strided = np.zeros((24, 100), dtype)[::2, ::2]
    strided[:] = values
    expected = list(deflate_chunks(values, (5, 50), 0))
    for other in (read_only, strided, np.asfortranarray(values), values[::-1][::-1]):
        assert list(deflate_chunks(other, (5, 50), 0)) == expected


def test_planes_are_the_bytes_of_the_elements_in_order():
    values = np.array([[1.0, -2.5], [3e-300, np.pi]])
    expected = np.frombuffer(values.tobytes(), np.uint8).reshape(4, 8).T
    np.testing.assert_array_equal(list(_planes(values)), expected)


def test_the_last_chunk_is_cut_at_every_edge():
    values = np.arange(7 * 5, dtype="i4").reshape(7, 5)
    offsets = [offset for offset, _ in deflate_chunks(values, (3, 2), -1)]
    assert offsets == list(itertools.product((0, 3, 6), (0, 2, 4)))


def test_bytes_do_not_depend_on_what_was_compressed_before():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(64, 1024)).astype("f4")
    expected = list(deflate_chunks(values, (64, 1024), 0))
    for _ in range(20):
        other = rng.integers(0, 9, (64, int(rng.integers(100, 4000))), "i4")
        list(deflate_chunks(other, other.shape, 0))
        assert list(deflate_chunks(values, (64, 1024), 0)) == expected


@pytest.mark.parametrize("bits", [8, 12, 23])
def test_rounded_noise_compresses_as_well_as_with_zlib(bits: int):
    values = np.random.default_rng(4).normal(1e6, 1e4, (64, 4096)).astype("f4")
    step = np.uint32(1 << (23 - bits))
    rounded = (values.view("u4") // step * step).view("f4")
    size = sum(len(data) for _, data in deflate_chunks(rounded, rounded.shape, 0))
    shuffled = rounded.reshape(-1).view(np.uint8).reshape(-1, 4).T.tobytes()
    assert size <= 1.03 * len(zlib.compress(shuffled, 4))


def test_a_constant_takes_next_to_nothing():
    values = np.full((128, 4096), 9.96921e36, "f4")
    size = sum(len(data) for _, data in deflate_chunks(values, (64, 4096), 0))
    assert size < values.nbytes / 500
