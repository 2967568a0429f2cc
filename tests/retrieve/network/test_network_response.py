"""How networks follow small changes of their signals, against solving again."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.network import (
    gradient,
    grid,
    noisy,
    plume,
    signals,
    three_by_two,
    triangle,
)

from lidarops.retrieve.network._beam_signals import SignalChange
from lidarops.retrieve.network.extinction_field import retrieve_network

PROFILES = 12
WAYS = {
    "block": {},
    "no prior": {"prior": "none"},
    "triangles": {"multiplier": 0.95},
}


def clean(net, r, factor=1.0):
    """Return powers without noise, in a gradient that grows to a multiple of itself."""
    gain = factor ** np.linspace(-0.5, 0.5, PROFILES)
    return np.stack(
        [signals(net, r, lambda x, y, z, each=each: each * gradient(x, y, z)) for each in gain]
    )


def solved(net, r, power, variance, exponent=1.0, **settings):
    return retrieve_network(
        power, r, net, variance=variance, exponent=exponent, full_overlap_range=100.0, **settings
    )


def changes(net, r, power, size):
    """Return causes, and the powers and exponents that they make."""
    relative = np.interp(r, net.on_beam(0)[1][[0, -1]], [size, 0.0])
    added = size * power[:, 1, -1:] * np.ones(r.size)
    changed = {}
    for name, beam, cause in (
        ("overlap", 0, SignalChange(relative=relative)),
        ("background", 1, SignalChange(power=added)),
    ):
        after = power.copy()
        after[:, beam] += added if cause.relative is None else relative * power[:, beam]
        changed[name] = {beam: cause}, after, 1.0
    every = dict.fromkeys(range(net.beams), SignalChange(exponent=size))
    return {**changed, "exponent": (every, power, 1.0 + size)}


@pytest.mark.parametrize("factor", [1.0, 1.2, 3.0])
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("build", [triangle, three_by_two])
def test_the_response_is_the_first_order_of_solving_again(build, way, factor):
    net = build()
    r = grid(net)
    power = clean(net, r, factor)
    variance = (0.003 * power) ** 2
    before = solved(net, r, power, variance, **WAYS[way])
    near = net.near_crossing & np.isfinite(before.extinction).all(axis=0)
    left = []
    for size in (2e-3, 1e-3):
        rest = {}
        for name, (cause, after, exponent) in changes(net, r, power, size).items():
            change = solved(net, r, after, variance, exponent, **WAYS[way]).extinction
            change = (change - before.extinction)[:, near]
            response = before.respond([cause])[..., 0][:, near]
            assert np.abs(change).max() > 0.02 * size * before.extinction[:, near].max()
            # Air that changes is linear about fields that are followed until they stay.
            most = 0.01 if factor == 1.0 or way != "block" else 0.15
            atol = (most + 10.0 * size) * np.abs(change).max()
            atol += 0.3 * most * size * before.extinction[:, near].max()
            np.testing.assert_allclose(response, change, atol=atol)
            rest[name] = np.abs(response - change).max()
        left.append(rest)
    if factor == 1.0 and way != "block":
        for name, most in left[0].items():
            assert left[1][name] < 0.3 * most + 1e-9


def test_a_profile_at_the_threshold_has_errors():
    """Solved again with changed signals, it is bad and has no value."""
    net, bad = three_by_two(), 7
    r = grid(net)
    power, variance = noisy(net, r, signals(net, r, plume), 0.01, PROFILES, additive=1e-3)
    behind = 1.0 / (1.0 + np.exp((net.on_beam(0)[1].mean() - r) / 30.0))

    def damaged(size):
        changed = power.copy()
        changed[bad, 0] *= 1.0 + size * behind
        return solved(net, r, changed, variance)

    def is_bad(result):
        return np.isnan(result.extinction[bad]).all()

    low, high = 0.0, 1.0
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if is_bad(damaged(middle)) else (middle, high)
    result, near = damaged(low), net.near_crossing
    assert is_bad(damaged(low + 0.002))
    added = np.zeros((PROFILES, r.size))
    added[bad] = 0.002 * behind * power[bad, 0]
    response = result.respond([{0: SignalChange(power=added)}])[..., 0][:, near]
    change = (result.extinction - damaged(low - 0.002).extinction)[:, near]
    np.testing.assert_allclose(response, change, atol=0.15 * np.abs(change).max())
