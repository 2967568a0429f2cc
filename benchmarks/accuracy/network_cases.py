"""Simulated networks of lidars in known air, and solvers for its extinction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from benchmarks.harness.figure import Array
from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.extinction_field import (
    FieldPrior,
    NetworkResult,
    retrieve_network,
)
from lidarops.simulate.signal import backscatter_signal

STEP: Final = 5.0
"""m, of the range bins."""
FULL_OVERLAP: Final = 100.0
"""m."""
NOISES: Final = (0.02, 0.05, 0.1)
"""Relative standard deviation of a bin."""
PEER_NOISE: Final = NOISES[1]
"""Noise of the profiles that peers solve too."""
ADDITIVE: Final = 0.01
"""Additional standard deviation of every bin, over the power at the first crossing of the beam."""
BLOCK: Final = 50
"""Profiles that share a prior."""
_FIRST_BIN: Final = 100.3
"""m, range of the first bin."""
_BEYOND: Final = 60.0
"""m, length of a signal after the last crossing."""
_CELLS: Final = 5
"""Cells of a bin, over which the optical depth is summed."""


# Networks -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LidarLine:
    """Lidars on a line with beams in one vertical plane."""

    name: str
    east: tuple[float, ...]
    """m, of each lidar."""
    elevations: tuple[tuple[float, ...], ...]
    """degree, of the beams of each lidar, from the eastern horizon over the zenith."""
    farthest: float = np.inf
    """m, largest range of the signals."""

    def network(self) -> geometry.Network:
        """Return beams and crossings."""
        pairs = [(x, a) for x, fan in zip(self.east, self.elevations, strict=True) for a in fan]
        angle = np.radians([a for _, a in pairs])
        return geometry.network_of_lines(
            [[x, 0.0, 0.0] for x, _ in pairs],
            np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1),
            tolerance=1e-3,
            farthest=self.farthest,
        )


TRIANGLE: Final = LidarLine("triangle", (300.0, -500.0, 0.0), ((120.0,), (60.0,), (90.0,)))
"""The triangle of the paper (drabenko2021): lidars 1, 2 and 3."""
THREE_BY_TWO: Final = LidarLine(
    "3 x 2 beams",
    (-500.0, 0.0, 400.0),
    ((50.0, 68.0), (78.0, 103.0), (112.0, 130.0)),
    farthest=1000.0,
)
LIDAR_LINES: Final = (TRIANGLE, THREE_BY_TWO)


# Air ------------------------------------------------------------------------------------------

Extinction = Callable[[Array, Array], Array]
"""Function from east and up in m to extinction in m-1."""


@dataclass(frozen=True, slots=True)
class Air:
    """A field of extinction that may move from profile to profile."""

    name: str
    at: Callable[[int], Extinction]
    """Field of a profile of the block."""
    moving: bool = False

    def fields(self) -> list[Extinction]:
        """Return the fields of the profiles of a block; one field if it does not move."""
        return [self.at(profile) for profile in range(BLOCK if self.moving else 1)]


def _homogeneous(extinction: float) -> Extinction:
    return lambda _, up: np.full_like(up, extinction)


def _gradient(_: Array, up: Array) -> Array:
    return np.asarray(2e-3 * np.exp(-(up - 600.0) / 1010.0))


def _plume(east: float) -> Extinction:
    def plume(x: Array, up: Array) -> Array:
        square_distance = ((x - east) ** 2 + (up - 650.0) ** 2) / (2.0 * 110.0**2)
        return np.asarray(1.5e-3 + 2e-3 * np.exp(-square_distance))

    return plume


THIN: Final = Air("homogeneous, 0.2 per km", lambda _: _homogeneous(2e-4))
"""Air of which noise hides the attenuation."""
AIRS: Final = (
    Air("homogeneous", lambda _: _homogeneous(2e-3)),
    Air("gradient", lambda _: _gradient),
    Air("plume", lambda _: _plume(-40.0)),
    Air("drifting plume", lambda profile: _plume(-200.0 + 300.0 * profile / BLOCK), moving=True),
    THIN,
)
"""The gradient is 2 per km at 600 m with a scale height of 1 km. The plume has 3.5 per km in air
of 1.5 per km, and drifts by 300 m in a block."""


# Signals --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """Signals of the lidars of a network without noise."""

    network: geometry.Network
    range: Array
    """m."""
    power: Array
    """(field, beam, range) for lidar constants of 1."""
    extinction: Array
    """(field, crossing) m-1, the truth."""

    def draw(
        self, noise: float, profiles: int, *seed: int, additive: float = ADDITIVE
    ) -> tuple[Array, Array]:
        """Return (profile, beam, range) noisy power and its variance, reproducible by the seed."""
        fields = np.arange(profiles) % len(self.power)
        deviation = np.hypot(noise * self.power, additive * self._first[..., np.newaxis])[fields]
        random = np.random.default_rng(seed)
        power = self.power[fields] + deviation * random.standard_normal(deviation.shape)
        return power, deviation**2

    def truth(self, profiles: int) -> Array:
        """Return (profile, crossing) extinction, m-1."""
        return self.extinction[np.arange(profiles) % len(self.extinction)]

    @property
    def _first(self) -> Array:
        """(field, beam) power at the first crossing of each beam."""
        power = np.empty(self.power.shape[:2])
        for beam in range(self.network.beams):
            first_range = self.network.on_beam(beam)[1][0]
            power[:, beam] = [
                np.interp(first_range, self.range, field[beam]) for field in self.power
            ]
        return power


def signals(net: geometry.Network, air: Air, first_bin: float = _FIRST_BIN) -> Signals:
    """Return signals, with optical depth summed over cells of a fifth of a bin."""
    bins = np.arange(first_bin, float(net.passages.range.max()) + _BEYOND, STEP)
    fields = air.fields()
    return Signals(
        net,
        bins,
        np.stack([_power(net, bins, field) for field in fields]),
        np.stack([field(net.crossing[:, 0], net.crossing[:, 2]) for field in fields]),
    )


def _power(net: geometry.Network, bins: Array, extinction: Extinction) -> Array:
    cell = STEP / _CELLS
    before = int(bins[0] // cell)
    cells = bins[0] + cell * np.arange(-before, _CELLS * (bins.size - 1) + 1)
    power = np.empty((net.beams, bins.size))
    for beam in range(net.beams):
        origin, direction = net.origin[beam], net.direction[beam]
        east, up = (origin[axis] + direction[axis] * cells for axis in (0, 2))
        scattering = extinction(east, up)
        power[beam] = backscatter_signal(
            cells, extinction=scattering, backscatter=scattering, system_constant=1.0
        )[before::_CELLS]
    return power


# Solvers --------------------------------------------------------------------------------------


def _solve(power: Array, variance: Array, signals: Signals, prior: FieldPrior) -> NetworkResult:
    """Solve profiles (profile, beam, range), block by block."""
    return retrieve_network(
        power,
        signals.range,
        signals.network,
        variance=variance,
        full_overlap_range=FULL_OVERLAP,
        blocks=np.arange(len(power)) // BLOCK,
        prior=prior.value,
    )


NO_PRIOR: Final = "network, no prior"
NETWORK: Final = "network"
SOLVERS: Final = {
    NO_PRIOR: partial(_solve, prior=FieldPrior.NONE),
    NETWORK: partial(_solve, prior=FieldPrior.BLOCK),
}
"""The retrieval with its priors, by name."""
