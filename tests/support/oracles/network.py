"""Networks of lidars in known fields of extinction, and their signals, for tests."""

from __future__ import annotations

import numpy as np

from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.extinction_field import retrieve_network

NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)


def homogeneous(extinction=2e-3):
    return lambda x, y, z: extinction + 0.0 * x


def gradient(x, y, z):
    """Return a field that decreases with height: 14 percent spread over the triangle."""
    return 2e-3 * np.exp(-(z - 600.0) / 1010.0 + 0.0 * x)


def plume(x, y, z, east=-40.0):
    """Return 1.5 per km with a plume of 3.5 per km."""
    return 1.5e-3 + 2e-3 * np.exp(-((x - east) ** 2 + (z - 650.0) ** 2) / (2 * 110.0**2))


def fan(positions, elevations, **settings):
    """Return a network of lidars on a line at positions in m, with beams in one vertical plane."""
    origin, direction = [], []
    for x, angles in zip(positions, elevations, strict=True):
        for angle in angles:
            origin.append([x, 0.0, 0.0])
            direction.append([np.cos(np.radians(angle)), 0.0, np.sin(np.radians(angle))])
    settings = {"tolerance": 1e-3, **settings}
    return geometry.network_of_lines(origin, direction, **settings)


def triangle(second=60.0, l13=300.0, l23=500.0, first=120.0, third=90.0, **settings):
    """Return the paper's network: lidars 1, 2, 3 at l13, -l23 and 0 m."""
    return fan([l13, -l23, 0.0], [[first], [second], [third]], **settings)


def three_by_two():
    return fan([-500.0, 0.0, 400.0], [(50, 68), (78, 103), (112, 130)], farthest=1000.0)


def grid(net, step=5.0, start=100.3):
    return np.arange(start, max(net.passages.range) + 60.0, step)


def signals(net, range_, field, exponent=1.0):
    """Return (beam, bin) power of unit constants: Gauss-Legendre quadrature of optical depth."""
    power = np.empty((net.beams, range_.size))
    edges = np.concatenate([[0.0], range_])
    for beam in range(net.beams):

        def along(r, beam=beam):
            return field(*(net.origin[beam][:, None] + net.direction[beam][:, None] * r))

        # The first cell is long: divide it as finely as the others.
        cut = np.union1d(np.linspace(0.0, range_[0], 40), edges)
        middle, half = (cut[1:] + cut[:-1]) / 2, (cut[1:] - cut[:-1]) / 2
        points = (middle + half * NODES[:, None]).ravel()
        cells = (along(points).reshape(4, -1) * WEIGHTS[:, None]).sum(axis=0) * half
        depth = np.interp(range_, cut, np.concatenate([[0.0], np.cumsum(cells)]))
        power[beam] = along(range_) ** (1 / exponent) * np.exp(-2 * depth) / range_**2
    return power


def noisy(net, range_, power, relative, profiles, seed=1, additive=0.01):
    """Return (profile, beam, bin) power and variances: relative noise, and 1 % of the start."""
    first = [net.on_beam(beam)[1][0] for beam in range(net.beams)]
    level = np.array([np.interp(r, range_, p) for r, p in zip(first, power, strict=True)])
    deviation = np.hypot(relative * power, additive * level[:, None])
    rng = np.random.default_rng(seed)
    return power + deviation * rng.standard_normal((profiles, *power.shape)), deviation**2


def at_crossings(net, field):
    return field(*net.crossing.T)


FIELDS = {"homogeneous": homogeneous(), "gradient": gradient, "plume": plume}
QUIET = 1e-12
"""Relative variance of almost no noise."""


def without_noise(net, field, *, step=5.0, prior="none", **settings):
    r = grid(net, step)
    power = signals(net, r, field, settings.get("exponent", 1.0))
    return retrieve_network(
        power, r, net, prior=prior, variance=QUIET * power**2, full_overlap_range=100.0,
        **settings,
    )  # fmt: skip


def with_noise(net, field, relative, profiles=500, *, seed=1, step=5.0, **settings):
    r = grid(net, step)
    power, variance = noisy(net, r, signals(net, r, field), relative, profiles, seed)
    settings.setdefault("blocks", np.arange(profiles) // 50)
    return retrieve_network(power, r, net, variance=variance, full_overlap_range=100.0, **settings)


def relative_errors(result, truth):
    """Return errors of 1 / extinction, i.e. of visibility, clipped at 300 percent."""
    return np.clip(truth / result.extinction - 1.0, -3.0, 3.0)


def root_mean_square(values):
    """Return the root mean square over profiles; NaN at crossings that are never reported."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0.0) ** 2
    return np.where(count > 0, np.sqrt(total.sum(axis=0) / np.maximum(count, 1)), np.nan)


def cycle_start(start, end, integral, multiplier=1.0):
    """Return 1 / extinction at the start of a cycle of beams, equations 11 and 12 of drabenko2021.

    Rows, on the last axis, lead from each crossing to the next one and back to the first:
    start / sigma - end / sigma_next = integral, which is negative towards a lidar.
    """
    powers = multiplier ** np.arange(start.shape[-1])
    product = np.cumprod(end / start, axis=-1)
    before = np.concatenate([np.ones_like(product[..., :1]), product[..., :-1]], axis=-1)
    return np.sum(powers * before * integral / start, axis=-1) / (
        1.0 - powers[-1] * product[..., -1]
    )
