"""Linear algebra of networks, against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.network import _matrices


def definite(rng, *shape):
    root = rng.standard_normal((*shape, shape[-1] + 2))
    return root @ root.swapaxes(-1, -2)


@pytest.mark.parametrize("size", [1, 2, 7, 40])
def test_products_inverses_and_roots_agree_with_numpy(size):
    rng = np.random.default_rng(size)
    a, b = rng.standard_normal((3, 1, size, 5)), rng.standard_normal((4, 5, 2))
    np.testing.assert_allclose(_matrices.product(a, b), a @ b, rtol=1e-12, atol=1e-12)
    matrices = definite(rng, 2, 3, size)
    inverse, determinant = _matrices.inverse_and_determinant(matrices)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrices), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(determinant, np.linalg.slogdet(matrices)[1], rtol=1e-9, atol=1e-9)
    root = np.linalg.cholesky(matrices[0, 0])
    np.testing.assert_allclose(_matrices.lower_root(matrices[0, 0]), root, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan])
def test_a_matrix_that_is_not_positive_definite_has_no_inverse(bad):
    matrices = definite(np.random.default_rng(1), 2, 3)
    matrices[1, 2, 2] = bad
    inverse, determinant = _matrices.inverse_and_determinant(matrices)
    assert np.isnan(inverse[1]).all()
    assert np.isnan(determinant[1])
    np.testing.assert_allclose(inverse[0], np.linalg.inv(matrices[0]))


@pytest.mark.parametrize("rank", [1, 3, 12])
def test_eigenvectors_diagonalise(rank):
    root = np.random.default_rng(rank).standard_normal((12, rank))
    matrix = root @ root.T
    size, vectors = _matrices.eigenvectors(matrix)
    np.testing.assert_allclose((vectors * size) @ vectors.T, matrix, atol=1e-12 * size.max())
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(12), atol=1e-12)
    np.testing.assert_allclose(np.sort(size), np.linalg.eigvalsh(matrix), atol=1e-12 * size.max())
