r"""Tables that reduce the homogeneous path to a few linear functionals of a profile.

The shapes :math:`\varphi_\tau(x) = e^{-2 \tau x} (R_0 / R)^2` of all extinctions span, within
rounding, a space of few dimensions. With its orthonormal basis U, y = U^T P holds all information
of a profile on the extinction. The best extinction is the maximum of
:math:`F(\tau) = q(\tau) \cdot y` with :math:`q = U^T \varphi / |U^T \varphi|`, whose derivative
within a cell of extinctions is a polynomial with coefficients linear in y.

The projection is linear, and the tables project the shapes with the same numbers that multiply
the profiles. What the basis lacks therefore costs information, but never biases a result. The
tables are computed in the longest float type.

Variables are scaled as in `lidarops.retrieve.homogeneous._projection`: x = (R - R_0) / L and
tau = extinction * L.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_Long = npt.NDArray[np.longdouble]

CELLS: Final = 128
DEGREE: Final = 6
"""Degree of the polynomials within a cell; the interpolation error of an extinction is 1e-11."""
START_BINS: Final = 2048
SIZE: Final = 11
"""Dimensions of the basis: they lose a millionth of the information on extinction."""
COLUMNS: Final = 12
"""Basis and mean."""
_WIDEST_SCALE: Final = 0.3

_TRAINING: Final = 400
_ROOM: Final = 2**17
"""Most numbers in one array of shapes: 2 MB."""

# Columns of `Tables.scalars`.
INVERSE_NORM: Final = 0
MEAN_SHAPE: Final = 1
INVERSE_SLOPE: Final = 2
COUPLING: Final = 3
LEVEL_SLOPE: Final = 4
LEVEL_SHAPE: Final = 5
DECAY: Final = 6
BACKGROUND_BEND: Final = 7
EXTINCTION_BEND: Final = 8
SCALARS: Final = 12
"""Columns, padded to whole vectors."""


class Tables(NamedTuple):
    """Tables for all profiles of one range grid, one set of weights and one pair of bounds."""

    size: int
    """Dimensions K of the basis."""
    columns: Array
    """(bin, K + 1): weighted basis vectors, then the weights of the mean."""
    starts: Array
    """(cell, K, 4): q and h dq/dtau at the centre of the cell, h its half width, zeros."""
    slopes: Array
    """(cell, K, 8): q at the centre, then the polynomial of h dq/dtau."""
    directions: Array
    """(cell, power, K + 1): polynomials of q."""
    squares: Array
    """(cell, power, K + 1): polynomials of the unit vector along the part of ``phi^2`` that is
    orthogonal to the model."""
    scalars: Array
    """(cell, power, SCALARS): polynomials of the scalars that the results need beside y."""
    steepness: Array
    """(cell,): squared length of h dq/dtau at the centre."""
    centres: Array
    """(cell,): tau."""
    halves: Array
    """(cell,): half widths in tau."""
    lookup: npt.NDArray[np.int64]
    """Cell by the direction of (y_0, y_1)."""
    envelope: Array
    """``(R_0 / R)^2``, padded to whole steps of `_vector_loops.residuals`."""
    total_weight: float
    unit: float
    """Power of two by which the weights were divided."""
    start: float
    """R_0, m."""
    length: float
    """L, m."""
    mean_range: float
    """Weighted, m."""
    monotonic: bool
    """Whether the direction of (y_0, y_1) determines the extinction. If not, the tables cannot be
    used."""


def make_tables(range_: Array, weights: Array, bounds: tuple[float, float]) -> Tables:
    """Return the tables of a range grid, from a cache if they were made before.

    Parameters
    ----------
    range_ : (bin,) float
        m, ascending and uniform.
    weights : (bin,) float
        Positive and finite.
    bounds : (float, float)
        Lowest and highest extinction, m-1.
    """
    return _cached(range_.tobytes(), weights.tobytes(), bounds)


@lru_cache(maxsize=64)
def _cached(range_bytes: bytes, weight_bytes: bytes, bounds: tuple[float, float]) -> Tables:
    return _make(np.frombuffer(range_bytes), np.frombuffer(weight_bytes), bounds)


class _Family:
    """The shapes of all extinctions and their projections."""

    def __init__(self, range_: Array, weights: Array) -> None:
        distance = range_.astype(np.longdouble)
        self.length = distance[-1] - distance[0]
        self.x = (distance - distance[0]) / self.length
        self.envelope = (distance[0] / distance) ** 2
        self.weights = weights.astype(np.longdouble)
        self.root = np.sqrt(self.weights)
        self.total = self.weights.sum()

    def blocks(self, count: int) -> Iterator[slice]:
        """Split a number of shapes into blocks of limited size."""
        step = max(_ROOM // self.x.size, 1)
        return (slice(first, first + step) for first in range(0, count, step))

    def shapes(self, tau: _Long) -> tuple[_Long, _Long]:
        """Return the shapes and their derivatives by tau, (tau, bin)."""
        shape = np.exp(-2 * tau[:, np.newaxis] * self.x) * self.envelope
        return shape, -2 * self.x * shape

    def centred(self, shapes: _Long) -> _Long:
        """Return shapes in units of the noise, without their mean."""
        mean = (shapes * self.weights).sum(axis=1) / self.total
        return np.asarray(self.root * (shapes - mean[:, np.newaxis]), np.longdouble)

    def basis(self, tau: _Long) -> Array:
        """Return the basis, (bin, `SIZE`), orthonormal and free of the mean."""
        both = np.empty((2, tau.size, self.x.size))
        for rows in self.blocks(tau.size):
            shape, slope = (self.centred(family) for family in self.shapes(tau[rows]))
            shape = shape / _norm(shape)[:, np.newaxis]
            slope = slope - (slope * shape).sum(axis=1)[:, np.newaxis] * shape
            both[0, rows], both[1, rows] = shape, slope / _norm(slope)[:, np.newaxis]
        both = both.reshape(2 * tau.size, self.x.size)
        basis = np.linalg.svd(both.T, full_matrices=False)[0][:, :SIZE]
        level = (self.root / np.sqrt(self.total)).astype(np.float64)
        # Vectors of small singular values keep traces of the mean; two passes remove them.
        for _ in range(2):
            basis = np.linalg.qr(basis - np.outer(level, level @ basis))[0]
        upright: Array = basis * np.where(basis[0] < 0, -1.0, 1.0)
        return upright


class _Projected(NamedTuple):
    """Projections of shapes, one row for each tau."""

    direction: _Long
    slope: _Long
    """Derivative of the direction by tau."""
    scalars: _Long
    square: _Long
    """Unit vector along the part of the squared shape orthogonal to level, shape and slope."""


def _norm(rows: _Long) -> _Long:
    return np.asarray(np.sqrt((rows * rows).sum(axis=1)), np.longdouble)


def _project(family: _Family, columns: Array, tau: _Long) -> _Projected:
    blocks = [_project_block(family, columns, tau[rows]) for rows in family.blocks(tau.size)]
    return _Projected(*(np.concatenate(arrays) for arrays in zip(*blocks, strict=True)))


def _project_block(family: _Family, columns: Array, tau: _Long) -> _Projected:
    shapes, slopes = family.shapes(tau)
    exact = columns.astype(np.longdouble)
    # Shapes are relative to their last bin, like profiles.
    shape = (shapes - shapes[:, -1:]) @ exact
    slope = (slopes - slopes[:, -1:]) @ exact
    mean, mean_slope = shape[:, SIZE] + shapes[:, -1], slope[:, SIZE] + slopes[:, -1]
    shape, slope = shape[:, :SIZE], slope[:, :SIZE]
    norm = _norm(shape)
    direction = shape / norm[:, np.newaxis]
    along = (slope * direction).sum(axis=1)
    turning = (slope - along[:, np.newaxis] * direction) / norm[:, np.newaxis]
    turn = _norm(turning)
    coupling = along / norm
    step = np.longdouble(1) / (family.x.size - 1)
    scalars = [
        1 / norm,
        mean,
        1 / turn,
        coupling / (norm * turn),
        (mean_slope - coupling * mean) / (norm * turn),
        mean / norm,
        np.exp(-2 * tau * step),
        *_bend(family, shapes),
    ]
    scalars += [np.zeros_like(norm)] * (SCALARS - len(scalars))
    square = shapes * shapes
    square = (square - square[:, -1:]) @ exact[:, :SIZE]
    turned = turning / turn[:, np.newaxis]
    # Twice, since the remainder is small.
    for _ in range(2):
        square = square - (square * direction).sum(axis=1)[:, np.newaxis] * direction
        square = square - (square * turned).sum(axis=1)[:, np.newaxis] * turned
    square = square / _norm(square)[:, np.newaxis]
    return _Projected(direction, turning, np.stack(scalars, axis=-1), square)


def _bend(family: _Family, shapes: _Long) -> tuple[_Long, _Long]:
    """Return the effect of a signal bent by ``(x - 1/2)^2`` on background and tau, by amplitude.

    By the normal equations of level, phi and phi x for a right-hand side of phi x^2, with x from
    the middle.
    """
    powers = (family.x - np.longdouble(0.5))[:, np.newaxis] ** np.arange(4)
    powers *= family.weights[:, np.newaxis]
    once, twice = (shapes @ powers[:, :3]).T, ((shapes * shapes) @ powers).T

    def centred_product(i: int, j: int) -> _Long:
        """Return the product of phi x^i and phi x^j without their means."""
        return np.asarray(twice[i + j] - once[i] * once[j] / family.total, np.longdouble)

    along = centred_product(0, 1) / centred_product(0, 0)
    slope = (centred_product(1, 2) - along * centred_product(0, 2)) / (
        centred_product(1, 1) - along * centred_product(0, 1)
    )
    shape = (centred_product(0, 2) - slope * centred_product(0, 1)) / centred_product(0, 0)
    level = (once[2] - shape * once[0] - slope * once[1]) / family.total
    return np.asarray(level, np.longdouble), np.asarray(-slope / 2, np.longdouble)


def _interpolation(nodes: _Long) -> _Long:
    """Return the matrix that maps values at nodes to coefficients of the polynomial."""
    matrix = np.zeros((nodes.size, nodes.size), np.longdouble)
    for i, node in enumerate(nodes):
        coefficients = np.ones(1, np.longdouble)
        for other in np.delete(nodes, i):
            factor = np.array([-other, 1], np.longdouble) / (node - other)
            coefficients = np.convolve(coefficients, factor)
        matrix[:, i] = coefficients
    return matrix


def _make(range_: Array, weights: Array, bounds: tuple[float, float]) -> Tables:
    unit = math.ldexp(1.0, math.frexp(float(weights.max()))[1])
    family = _Family(range_, weights / unit)
    lowest, highest = (bound * float(family.length) for bound in bounds)
    # Cells are uniform in asinh(tau / scale). In a thin section the shape is nearly a line, whose
    # slope vanishes at tau = -L / R: the cells have to be small against the distance to that.
    scale = min(_WIDEST_SCALE, _WIDEST_SCALE * float(family.length) / float(range_[0]))
    ends = np.arcsinh(np.array([lowest, highest]) / scale)

    def spread(count: int) -> _Long:
        even = np.linspace(ends[0], ends[1], count).astype(np.longdouble)
        tau = np.asarray(scale * np.sinh(even), np.longdouble)
        tau[0], tau[-1] = lowest, highest
        return tau

    columns = np.zeros((range_.size, COLUMNS))
    basis = family.basis(spread(_TRAINING))
    columns[:, :SIZE] = family.root.astype(np.float64)[:, np.newaxis] * basis
    columns[:, SIZE] = (family.weights / family.total).astype(np.float64)

    edges = spread(CELLS + 1)
    centres = np.asarray((edges[1:] + edges[:-1]) / 2, np.longdouble)
    halves = np.asarray((edges[1:] - edges[:-1]) / 2, np.longdouble)
    order = DEGREE + 1
    nodes = np.cos((2 * np.arange(order) + 1) * np.pi / (2 * order)).astype(np.longdouble)
    inside = (centres[:, np.newaxis] + halves[:, np.newaxis] * nodes).ravel()
    matrix = _interpolation(nodes)
    inner = _project(family, columns, inside)
    middle = _project(family, columns, centres)
    turning = (np.repeat(halves, order)[:, np.newaxis] * inner.slope).reshape(CELLS, order, SIZE)

    slopes = np.empty((CELLS, SIZE, order + 1))
    slopes[:, :, 0] = middle.direction
    slopes[:, :, 1:] = np.einsum("ij,cjk->cki", matrix, turning)
    # F is q . y: the integral of the slopes is the direction itself.
    directions = np.zeros((CELLS, order + 1, columns.shape[1]))
    directions[:, :, :SIZE] = np.swapaxes(slopes, 1, 2)
    directions[:, 1:] /= np.arange(1, order + 1)[:, np.newaxis]
    squares = np.zeros_like(directions)
    squares[:, :order, :SIZE] = np.einsum(
        "ij,cjk->cik", matrix, inner.square.reshape(CELLS, order, SIZE)
    )
    starts = np.zeros((CELLS, SIZE, 4))
    starts[:, :, :2] = slopes[:, :, :2]
    scalars = np.einsum("ij,cjk->cik", matrix, inner.scalars.reshape(CELLS, order, -1))
    steepness = (halves * _norm(middle.slope)) ** 2
    lookup, monotonic = _lookup(middle.direction.astype(np.float64))
    padded = np.zeros(-(-range_.size // 16) * 16)
    padded[: range_.size] = family.envelope
    return Tables(
        size=SIZE,
        columns=columns,
        starts=starts,
        slopes=slopes,
        directions=directions,
        squares=squares,
        scalars=np.ascontiguousarray(scalars.astype(np.float64)),
        steepness=steepness.astype(np.float64),
        centres=centres.astype(np.float64),
        halves=halves.astype(np.float64),
        lookup=lookup,
        envelope=padded,
        total_weight=float(family.total),
        unit=unit,
        start=float(range_[0]),
        length=float(family.length),
        mean_range=float(range_[0] + family.length * (family.weights @ family.x) / family.total),
        monotonic=monotonic,
    )


def _lookup(direction: Array) -> tuple[npt.NDArray[np.int64], bool]:
    """Return the cell for each direction of (y_0, y_1), and whether directions are monotonic."""
    angle = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
    turns = np.diff(angle)
    monotonic = bool(np.all(turns > 0) or np.all(turns < 0)) and np.ptp(angle) < np.pi
    # The diamond angle: piecewise rational in (y_0, y_1), -2 to 2 for a full turn.
    diamond = -2.0 + 4.0 * (np.arange(START_BINS) + 0.5) / START_BINS
    first = 1.0 - np.abs(diamond)
    second = np.where(np.abs(diamond) <= 1.0, diamond, np.copysign(2.0 - np.abs(diamond), diamond))
    middle = 0.5 * (angle.min() + angle.max())
    target = np.arctan2(second, first)
    target = middle + np.remainder(target - middle + np.pi, 2.0 * np.pi) - np.pi
    order = np.argsort(angle)
    cell = np.interp(target, angle[order], order.astype(np.float64))
    return np.rint(cell).astype(np.int64), monotonic
