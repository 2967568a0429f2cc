"""Banded matrices in dense form, for comparison."""

from __future__ import annotations

import numpy as np


def dense(bands):
    """Return the symmetric matrix of its diagonal and upper off-diagonals, one or two."""
    matrix = np.diag(bands[0])
    for step in range(1, min(len(bands), bands.shape[1])):
        above = np.diag(bands[step][: bands.shape[1] - step], step)
        matrix = matrix + above + above.T
    return matrix
