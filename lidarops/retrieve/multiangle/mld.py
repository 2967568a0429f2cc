r"""Method "mld": regularised differentiation of the logarithm along the slant path (historical).

The method of `gobrusenko1989`.

The slope of :math:`\ln S` over the slant path x is taken as constant between neighbouring beams,
:math:`y_l - c = \int_{x_0}^{x_l} \varphi\,dx`, and kept small (order 0) or constant (order 1) by a
penalty of strength :math:`\alpha`. Its mean over the path gives :math:`\tau = -\bar\varphi / 2`.

With order 0, the penalty pulls the optical depth towards zero, or towards a prior that is
subtracted first; the data share is the part that comes from the data. With order 1, the optical
depth lies between that of the end beams and that of the regression on the slant path.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs

Array = npt.NDArray[np.float64]

STRENGTHS: Final[Array] = 10.0 ** np.linspace(-6.0, 6.0, 97)
"""Strengths of the penalty to choose from; dimensionless, for paths scaled to a span of 1."""
_SAME_NODE: Final = 1e-4
"""Distance of scaled slant paths up to which beams share a node."""


class StrengthChoice(StrEnum):
    """Rule by which the strength of the penalty is chosen."""

    DISCREPANCY = "discrepancy"
    """Largest strength with residuals not larger than the noise."""
    CP = "cp"
    """Least Mallows' Cp, for known noise."""
    GCV = "gcv"
    """Least score of generalised cross-validation, for unknown noise."""
    FIXED = "fixed"
    """`Regularisation.strength`."""


class Average(StrEnum):
    """Mean of the slope that gives the optical depth."""

    PATH = "path"
    """Over the slant path."""
    ANGLES = "angles"
    """Over the intervals between beams; worse, because the short intervals near the zenith weigh
    as much as the long ones."""


@dataclass(frozen=True, slots=True)
class Regularisation:
    """Settings of the methods "mld" and "mld_prior".

    Raises
    ------
    RetrievalInputError
        For an order other than 0 and 1, or a strength that contradicts the choice.
    """

    order: int = 0
    """0 keeps the slope small, 1 keeps it constant."""
    choice: str = "discrepancy"
    """A `StrengthChoice`."""
    strength: float | None = None
    """Strength of the penalty, only with "fixed"."""
    average: str = "path"
    """An `Average`."""

    def __post_init__(self) -> None:
        if self.order not in {0, 1}:
            raise RetrievalInputError(
                f"is {self.order}", field="regularisation.order", remedy="choose 0 or 1"
            )
        fixed = (
            inputs.choice(self.choice, StrengthChoice, "regularisation.choice")
            is StrengthChoice.FIXED
        )
        inputs.choice(self.average, Average, "regularisation.average")
        if fixed != (self.strength is not None):
            raise RetrievalInputError(
                f"is {self.strength} with choice {self.choice!r}",
                field="regularisation.strength",
                remedy="give a strength with 'fixed', and only then",
            )
        if self.strength is not None and not self.strength >= 0:
            raise RetrievalInputError(
                f"is {self.strength}", field="regularisation.strength", remedy="give zero or more"
            )

    @property
    def strengths(self) -> Array:
        """Strengths to choose from, ascending."""
        return STRENGTHS if self.strength is None else np.array([self.strength])

    def choose(self, rss: Array, freedom: Array, beams: int) -> npt.NDArray[np.intp]:
        """Return the indices of the strengths that the rule chooses, (profile,).

        Parameters
        ----------
        rss : (profile, strength) float
            Sums of squared residuals over their variances.
        freedom : (strength,) float
            Degrees of freedom.
        beams : int
        """
        if self.choice == StrengthChoice.CP:
            return np.asarray(np.argmin(rss + 2.0 * freedom, axis=1))
        left = beams - 1.0 - freedom
        if self.choice == StrengthChoice.GCV:
            with np.errstate(divide="ignore", invalid="ignore"):
                scores = np.where(left > 1e-9, rss / left**2, np.inf)
            return np.asarray(np.argmin(scores, axis=1))
        within = rss <= beams - 1.0
        last = within.shape[1] - 1 - np.argmax(within[:, ::-1], axis=1)
        return np.where(within.any(axis=1), last, 0)


@dataclass(frozen=True, slots=True)
class Operator:
    """Linear operator from the logarithms of one set of beams to optical depth."""

    coordinates: Array
    """(component, beam): turns logarithms into uncorrelated coordinates b."""
    penalty: Array
    """(component,): the regularisation keeps the share f = 1 / (1 + strength * penalty) of b."""
    gain: Array
    """(component,): optical depth = sum of gain * f * b."""
    condition: float
    """Condition number of the system for the slopes."""


def make_operator(path: Array, regularisation: Regularisation) -> Operator:
    """Return the operator for beams of equal weight.

    Parameters
    ----------
    path : (beam,) float
        Slant over vertical paths, in any order, at least two different ones.
    regularisation : Regularisation
    """
    order = np.argsort(path, kind="stable")
    low, span = path[order[0]], path[order[-1]] - path[order[0]]
    position = (path - low) / span
    node = np.empty(path.size, dtype=np.intp)
    node[order] = np.cumsum(np.diff(position[order], prepend=0.0) > _SAME_NODE)
    nodes = np.array([position[node == i].mean() for i in range(node.max() + 1)])
    width = np.diff(nodes)
    matrix = np.where(np.arange(width.size) < node[:, np.newaxis], width, 0.0)
    matrix -= matrix.mean(axis=0)
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    back = right.T / values
    rough = _roughness(width, regularisation.order) @ back
    free = (values[:, np.newaxis] * right).sum(axis=1)[:, np.newaxis]
    penalty, basis = _modes(rough, free if regularisation.order == 1 else free[:, :0])
    mean = width if Average(regularisation.average) is Average.PATH else _equal(width)
    return Operator(
        np.ascontiguousarray((left @ basis).T),
        penalty,
        -0.5 / span * (mean @ back @ basis),
        float(values[0] / values[-1]),
    )


def _modes(rough: Array, free: Array) -> tuple[Array, Array]:
    """Return the eigenvalues and eigenvectors of the penalty, those without penalty first.

    The free modes are an input: computed from the penalty, their eigenvalues would not be exactly
    zero, and a large strength would amplify the rounding error.

    Parameters
    ----------
    rough : (row, component) float
    free : (component, 0 or 1) float
        Modes without penalty.
    """
    whole = np.linalg.qr(np.hstack([free, np.eye(rough.shape[1])]))[0]
    bound = whole[:, free.shape[1] : rough.shape[1]]
    penalty, basis = np.linalg.eigh((rough @ bound).T @ (rough @ bound))
    modes = np.hstack([whole[:, : free.shape[1]], bound @ basis])
    return np.append(np.zeros(free.shape[1]), np.maximum(penalty, 0.0)), modes


def _equal(width: Array) -> Array:
    return np.full(width.size, 1.0 / width.size)


def _roughness(width: Array, order: int) -> Array:
    """Return the matrix whose squared product with the slopes is the penalty."""
    if order == 0:
        return np.diag(np.sqrt(width))
    distance = 0.5 * (width[1:] + width[:-1])
    return np.diff(np.eye(width.size), axis=0) / np.sqrt(distance)[:, np.newaxis]
