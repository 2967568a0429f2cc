"""Single bins of a network's beams that lie off their neighbours: found, bridged, or told."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator
from support.oracle_network import FIELDS, fan, grid, noisy, signals, three_by_two, triangle

from lidarops.retrieve.network import _condensed_signals, _fit_layout
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.noise import outlying_bins, outlying_runs

BINS = 7


def narrow(x, y, z):
    """Return a plume of 50 m, of four times the air about it, below layers of 300 m."""
    apart = ((x + 40.0) ** 2 + (z - 650.0) ** 2) / (2 * 50.0**2)
    return 1e-3 * (1 + 3 * np.exp(-apart)) * np.exp(-z / 300.0)


ALL = {**FIELDS, "narrow plume": narrow}


def scene(field=ALL["homogeneous"], relative=0.01, profiles=50, step=5.0, seed=3, additive=0.01):
    net = triangle()
    r = grid(net, step)
    power, variance = noisy(net, r, signals(net, r, field), relative, profiles, seed, additive)
    return net, r, power, variance


def solved(net, r, power, variance, **settings):
    settings = {"full_overlap_range": 100.0, **settings}
    return retrieve_network(power, r, net, variance=variance, **settings)


def condensed(net, r, power, variance, *, screened=True, relative=False, nearest=100.0):
    ranges = np.tile(r, (net.beams, 1))
    layout = _fit_layout.lay_out_fits(net, ranges, None, np.full(net.beams, nearest), BINS)
    rows = np.broadcast_to(variance, (1, *power.shape[1:]))
    data = _condensed_signals.condense(
        power, np.ascontiguousarray(rows), np.zeros(len(power), dtype=np.intp),
        np.ones(net.beams), layout, relative=relative, screened=screened,
    )  # fmt: skip
    return data, layout


def hit(power, variance, profile, beam, bin, size):
    """Return power with bins of a beam moved by so many standard errors."""
    out = power.copy()
    out[profile, beam, bin] += size * np.sqrt(np.broadcast_to(variance, power.shape[1:])[beam, bin])
    return out


def bin_at(r, where):
    return int(np.argmin(np.abs(r - where)))


def apart(one, other):
    """Return by how many of its standard errors the one differs from the other."""
    return np.abs(one.extinction - other.extinction) / one.extinction_standard_error


# Where nothing is wrong ---------------------------------------------------------------------


@pytest.mark.parametrize("name", list(ALL))
@pytest.mark.parametrize("step", [5.0, 7.5])
def test_air_and_noise_are_left_alone_to_the_bit(name, step):
    for relative in (1e-3, 0.02, 0.1, 0.3):
        net, r, power, variance = scene(ALL[name], relative, 60, step)
        screened, _ = condensed(net, r, power, variance)
        plain, _ = condensed(net, r, power, variance, screened=False)
        assert not screened.bridged.any()
        for one in ("log_value", "integral", "usable", "covariance", "slope", "status"):
            np.testing.assert_array_equal(getattr(screened, one), getattr(plain, one))


@pytest.mark.parametrize("relative", [2e-3, 0.01, 0.05, 0.2])
def test_what_is_left_of_bins_is_normal(relative):
    """So that the threshold means what it says: beyond 6, once in 5e8 bins."""
    rng = np.random.default_rng(5)
    rows, count = 400, 200
    slope = -0.01 * np.arange(count)
    plain = np.exp(slope) * (1 + relative * rng.standard_normal((rows, count)))
    codes, limits = np.zeros(count, dtype=np.uint8), np.array([[0, count]])
    ranges = 5.0 * np.arange(1.0, count + 1)
    planned = np.zeros((1, count, 6), np.intp), np.zeros((1, count, 6)), np.zeros((1, count))
    outlying_bins.plan_neighbours(ranges[None], limits, *planned)
    nodes, shares, air = (one[0] for one in planned)
    off = np.empty((rows, count))
    for n in range(rows):
        noise = (relative * np.exp(slope) / plain[n]) ** 2
        row = np.log(np.maximum(plain[n], 1e-9)), noise, plain[n], (relative * np.exp(slope)) ** 2
        outlying_bins._measure_deviations(
            row, 1.0, False, ranges, codes, (0, count, 0, count), (nodes, shares, 0.0 * air), off[n]
        )
    for many, chance in ((2.0, 4.55e-2), (3.0, 2.7e-3), (4.0, 6.3e-5)):
        expected = chance * off.size
        # A bin of noise shows in 7 of them: so many fewer are independent.
        assert abs(np.sum(off > many) - expected) < 4 * np.sqrt(7 * expected) + 3
    assert off.max() < outlying_bins.OUTLYING_SIGMAS


def test_counts_at_low_light_are_not_taken_for_outliers():
    rng = np.random.default_rng(6)
    net = triangle()
    r = grid(net)
    level = signals(net, r, ALL["homogeneous"])
    counts = rng.poisson(np.maximum(60 * level / level[:, [60]], 15), (300, *level.shape))
    found = solved(net, r, counts.astype(float), counts.astype(float))
    assert not found.flags.bridged.any()
    assert not found.flags.outlying.any()


# Where bins are hit ------------------------------------------------------------------------


@pytest.mark.parametrize("relative", [1e-3, 0.02, 0.1])
@pytest.mark.parametrize("size", [15.0, 40.0, 1e3, 1e9])
def test_a_spike_at_a_crossing_is_bridged_and_told(relative, size):
    net, r, power, variance = scene(relative=relative)
    at = bin_at(r, net.on_beam(0)[1][0])
    clean = solved(net, r, power, variance)
    found = solved(net, r, hit(power, variance, 7, 0, at, size), variance)
    mine = net.on_beam(0)[0]
    assert found.flags.bridged[7, mine].all()
    assert not found.flags.bridged[np.arange(50) != 7].any()
    np.testing.assert_array_equal(found.flags.flagged, clean.flags.flagged)
    assert np.nanmax(apart(found, clean)[7]) < 1.0
    np.testing.assert_allclose(
        found.extinction_standard_error[7], clean.extinction_standard_error[7], rtol=0.3
    )


@pytest.mark.parametrize("size", [-20.0, 15.0, 100.0])
def test_a_spike_in_the_middle_of_a_long_beam_costs_nothing(size):
    net, r, power, variance = scene(relative=0.02)
    low, high = net.on_beam(1)[1][[0, -1]]
    at = bin_at(r, (low + high) / 2)
    clean = solved(net, r, power, variance)
    found = solved(net, r, hit(power, variance, 3, 1, at, size), variance)
    np.testing.assert_array_equal(found.flags.flagged, clean.flags.flagged)
    assert np.nanmax(apart(found, clean)[3]) < 0.3


def spiked(net, r, power, variance, sizes):
    """Put spikes side by side on the first beam of all profiles, where beams meet."""
    at = bin_at(r, net.on_beam(0)[1][0])
    for k, size in enumerate(sizes):
        power = hit(power, variance, slice(None), 0, at + k, size)
    return power


@pytest.mark.parametrize("sizes", [(40.0, 40.0), (90.0, 30.0), (25.0, -25.0), (60.0, 0.0, 60.0)])
def test_spikes_that_lie_together_are_told_and_left(sizes):
    """They may be the edge of a layer, which is air."""
    net, r, power, variance = scene(relative=0.02)
    damaged = spiked(net, r, power, variance, sizes)
    found, _ = condensed(net, r, damaged, variance)
    plain, _ = condensed(net, r, damaged, variance, screened=False)
    assert found.bridged[:, 0].mean() > 0.95
    left = np.all(found.log_value == plain.log_value, axis=1)
    assert left.mean() > 0.95


@pytest.mark.parametrize("place", ["first", "last"])
def test_the_ends_of_a_beam_are_looked_at_too(place):
    """Beyond the last crossing a bin is missing; before the first there are none."""
    net, r, power, variance = scene(relative=0.02)
    ranges = net.on_beam(0)[1]
    first, last = bin_at(r, ranges[0]), bin_at(r, ranges[-1])
    if place == "first":
        at, nearest = first - 3, np.array([r[first - 3] - 0.1, 100.0, 100.0])
    else:
        at, nearest = last + 3, 100.0
        power[:, 0, last + 4 :] = np.nan
    clean = solved(net, r, power, variance, full_overlap_range=nearest)
    found = solved(
        net, r, hit(power, variance, 9, 0, at, 120.0), variance, full_overlap_range=nearest
    )
    assert (found.flags.bridged | found.flags.outlying)[9, net.on_beam(0)[0]].any()
    kept = ~found.flags.flagged & ~clean.flags.flagged & np.isfinite(found.extinction)
    assert (apart(found, clean)[9][kept[9]] < 1.5).all()


def test_gaps_among_neighbours_are_passed_over():
    net, r, power, variance = scene(relative=0.02)
    last = bin_at(r, net.on_beam(0)[1][-1])
    power[:, 0, last + 5] = np.nan
    clean = solved(net, r, power, variance)
    found = solved(net, r, hit(power, variance, 9, 0, last + 3, 60.0), variance)
    assert found.flags.bridged[9, net.on_beam(0)[0]].all()
    assert np.nanmax(apart(found, clean)[9]) < 1.0


def test_a_crowd_of_spikes_is_told_and_left():
    net, r, power, variance = scene(relative=0.01)
    ranges = net.on_beam(0)[1]
    at = bin_at(r, (ranges[0] + ranges[-1]) / 2)
    rng = np.random.default_rng(1)
    damaged = power.copy()
    damaged[4, 0, at : at + 6] *= rng.uniform(0.3, 3.0, 6)
    found, _ = condensed(net, r, damaged, variance)
    plain, _ = condensed(net, r, damaged, variance, screened=False)
    assert found.bridged[4, 0]
    assert found.bridged.sum() == 1
    np.testing.assert_array_equal(found.integral, plain.integral)


def run(net, r, power, variance, after, bins, size=40.0):
    """Move bins side by side on the first beam of all profiles, so many behind where beams meet."""
    at = bin_at(r, net.on_beam(0)[1][0]) + after
    for k in range(bins):
        power = hit(power, variance, slice(None), 0, at + k, size)
    return power


@pytest.mark.parametrize(("after", "bins"), [(-3, 6), (-6, 12), (9, 12), (5, 20), (0, 30)])
def test_a_run_of_wild_bins_is_part_of_the_standard_error(after, bins):
    """Only its edges show: those in the middle lie on one curve."""
    net, r, power, variance = scene(relative=0.02)
    damaged = run(net, r, power, variance, after, bins)
    told, layout = condensed(net, r, damaged, variance)
    plain, _ = condensed(net, r, damaged, variance, screened=False)
    clean, _ = condensed(net, r, power, variance)
    np.testing.assert_array_equal(told.integral, plain.integral)
    np.testing.assert_array_equal(told.log_value, plain.log_value)
    assert told.bridged[:, 0].all()
    added = (told.covariance - plain.covariance)[:, : layout.offset[1]].reshape(-1, 3, 3)
    moved = plain.log_value[:, 1] - clean.log_value[:, 1]
    stated = np.sqrt(added[:, 0, 0] + added[:, 1, 1] - 2.0 * added[:, 0, 1])
    assert np.all(np.abs(moved) < 1.5 * stated + 1e-9)
    found = solved(net, r, damaged, variance)
    score = (found.extinction - 2e-3) / found.extinction_standard_error
    kept = ~found.flags.flagged & np.isfinite(found.extinction)
    assert np.all(np.abs(score[kept]) < 3.0)
    assert np.isfinite(found.extinction[:, found.near_crossing]).mean() > 0.9


def test_a_line_goes_through_the_good_bins_on_either_side():
    grid_, noise = 5.0 * np.arange(20.0), np.full(20, 0.09)
    logs, codes = 1.0 - 0.02 * grid_, np.zeros(20, dtype=np.uint8)
    expected, wild = logs.copy(), slice(6, 15)
    logs[wild] += 3.0
    codes[[6, 14]] = outlying_bins.BRIDGED
    outlying_runs.draw_lines(logs, noise, grid_, codes, (0, 20))
    np.testing.assert_allclose(logs, expected, atol=1e-12)
    assert np.all(codes[wild] == outlying_bins.LOST)
    assert np.all(codes[[5, 15]] == outlying_bins.GOOD)
    # Of two means of 3 bins: in the middle, a half of each.
    assert noise[10] == pytest.approx(0.09 / 6.0)


def test_what_no_line_can_be_drawn_across_stays_as_it_is():
    logs, noise = np.arange(30.0), np.ones(30)
    for marked, expected in (
        ([2, 3], logs),
        (np.arange(30), logs),
        # Beyond the last good bins, the signal stays as there.
        (np.arange(20, 30), np.where(logs < 20.0, logs, 18.0)),
    ):
        codes = np.zeros(30, dtype=np.uint8)
        codes[marked] = outlying_bins.BRIDGED
        told = logs.copy()
        outlying_runs.draw_lines(told, noise.copy(), np.arange(30.0), codes, (0, 30))
        np.testing.assert_array_equal(told, expected)


def test_of_beams_with_many_bins_off_nothing_is_told():
    """Those on one curve may be the wild ones."""
    marked = np.arange(0, 30, 2)
    logs = np.zeros(30)
    out, codes = lined(logs, marked)
    np.testing.assert_array_equal(out, logs)
    assert np.all(codes == outlying_bins.BRIDGED)


def lined(logs, marked, noise=1e-4):
    """Return logarithms across whose runs lines are drawn, and what became of the bins."""
    codes = np.zeros(logs.size, dtype=np.uint8)
    codes[marked] = outlying_bins.BRIDGED
    out = logs.copy()
    spread = np.full(logs.size, noise)
    outlying_runs.draw_lines(out, spread, 5.0 * np.arange(logs.size), codes, (0, logs.size))
    return out, codes


@pytest.mark.parametrize("slope", [-0.08, 0.0, 0.08])
@pytest.mark.parametrize("rise", [-0.3, 0.3])
@pytest.mark.parametrize("marked", [[40, 59], [39, 40, 59, 60], [40], [59]])
def test_a_run_jumps_and_jumps_back(slope, rise, marked):
    """Also where the slope of air hides the jump, and where but one of its edges is marked."""
    air = slope * np.arange(100.0)
    logs = air.copy()
    logs[40:60] += rise
    out, codes = lined(logs, marked)
    np.testing.assert_allclose(out, air, atol=1e-12)
    assert np.all(codes[40:60] == outlying_bins.LOST)
    assert np.count_nonzero(codes) <= 24


@pytest.mark.parametrize("apart", [5, 10, 25, 32])
def test_single_bins_make_no_run(apart):
    """However many they are: a line would take the air between them away."""
    logs = np.exp(-(((np.arange(200.0) - 100.0) / 22.0) ** 2))
    marked = np.arange(4, 196, apart)
    logs[marked] += 0.3
    out, codes = lined(logs, marked)
    np.testing.assert_array_equal(out, logs)
    assert np.all(codes[marked] == outlying_bins.BRIDGED)
    assert np.count_nonzero(codes) == marked.size


@pytest.mark.parametrize("bins", [6, 12, 30])
@pytest.mark.parametrize("slope", [-0.08, 0.08])
@pytest.mark.parametrize("end", ["first", "last"])
@pytest.mark.parametrize("more", [0, 1])
def test_of_a_run_at_the_end_of_a_beam_the_jump_is_taken_out(bins, slope, end, more):
    """Also where two bins are marked at its only edge."""
    air = slope * np.arange(100.0)
    logs = air.copy()
    logs[:bins] += 0.4
    marked = [bins - 1, bins][: 1 + more]
    if end == "last":
        logs, air, marked = logs[::-1], air[::-1], [99 - g for g in marked]
    out, codes = lined(logs, marked)
    good = codes == outlying_bins.GOOD
    np.testing.assert_allclose(np.ptp((out - air)[good]), 0.0, atol=1e-12)
    assert np.count_nonzero(~good) == 1 + more


def test_a_jump_far_from_the_ends_is_air():
    logs = np.where(np.arange(100) < 50, 0.0, 0.4)
    out, _ = lined(logs, [50])
    np.testing.assert_array_equal(out, logs)


def test_behind_a_run_another_begins():
    air = np.zeros(120)
    logs = air.copy()
    logs[20:40] += 0.5
    logs[55:75] += 0.5
    out, codes = lined(logs, [20, 39, 55, 74])
    np.testing.assert_allclose(out, air, atol=1e-12)
    assert not codes[40:55].any()


def test_edges_far_apart_are_no_run():
    logs = np.zeros(200)
    logs[80:120] += 0.5
    out, codes = lined(logs, [80, 119])
    np.testing.assert_array_equal(out, logs)
    assert np.count_nonzero(codes) == 2


def layer(x, y, z):
    """Stand 1.5 per km, with a layer of 60 m of three times the air about it."""
    return 1.5e-3 + 3e-3 * np.exp(-((z - 600.0) ** 2) / (2 * 60.0**2)) + 0.0 * x


@pytest.mark.parametrize("step", [5.0, 2.0])
@pytest.mark.parametrize(("field", "most"), [(ALL["plume"], 4.0), (layer, 6.0)])
def test_single_wild_bins_in_curved_air_cost_little(field, most, step):
    """Lines from one to the next would take the plume away, and state errors for it."""
    net = three_by_two()
    r = grid(net, step)
    power, variance = noisy(net, r, signals(net, r, field), 0.01, 60, 3, 0.003)
    clean = solved(net, r, power, variance)
    rng = np.random.default_rng(5)
    wild = np.zeros(power.shape, dtype=bool)
    for beam in wild.reshape(-1, r.size):
        beam[rng.integers(5, 25) : -4 : 25] = True
    found = solved(net, r, power + wild * 30.0 * np.sqrt(variance), variance)
    near = found.near_crossing
    dearer = (found.extinction_standard_error / clean.extinction_standard_error)[:, near]
    assert np.nanmedian(dearer) < most


@pytest.mark.parametrize("share", [0.02, 0.04])
@pytest.mark.parametrize("step", [5.0, 2.0])
@pytest.mark.parametrize("field", [ALL["plume"], layer])
def test_wild_bins_in_curved_air_leave_values_within_their_errors(field, step, share):
    net = three_by_two()
    r = grid(net, step)
    power, variance = noisy(net, r, signals(net, r, field), 0.01, 150, 3, 0.003)
    rng = np.random.default_rng(50)
    wild = 30.0 * (rng.random(power.shape) < share)
    found = solved(
        net, r, power + wild * np.sqrt(variance), variance, blocks=np.arange(150) // 50
    )  # fmt: skip
    near = found.near_crossing
    kept = (~found.flags.flagged & np.isfinite(found.extinction))[:, near]
    score = (found.extinction - field(*net.crossing.T)) / found.extinction_standard_error
    assert kept.mean() > 0.95
    assert np.mean(np.abs(score[:, near][kept]) > 4.0) <= 7e-3


@pytest.mark.parametrize("step", [0.3, 1.1, 4.0])
def test_an_edge_of_a_layer_is_no_crowd(step):
    net, r, power, variance = scene(relative=0.01)
    ranges = net.on_beam(0)[1]
    beyond = r > (ranges[0] + ranges[-1]) / 2
    power[:, 0, beyond] *= step
    variance[0, beyond] *= step**2
    found, _ = condensed(net, r, power, variance)
    plain, _ = condensed(net, r, power, variance, screened=False)
    np.testing.assert_array_equal(found.integral, plain.integral)


@pytest.mark.parametrize("step", [0.1, 0.5, 3.0, 20.0])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_an_edge_inside_a_bin_stays_as_it_is(step, share):
    net, r, power, variance = scene(relative=0.01)
    at = bin_at(r, net.on_beam(0)[1][0]) + 1
    scale = np.where(np.arange(r.size) > at, step, 1.0)
    scale[at] = 1.0 + share * (step - 1.0)
    power[:, 0] *= scale
    variance[0] *= scale**2
    found, _ = condensed(net, r, power, variance)
    plain, _ = condensed(net, r, power, variance, screened=False)
    np.testing.assert_array_equal(found.integral, plain.integral)
    np.testing.assert_array_equal(found.log_value, plain.log_value)


def test_a_layer_may_fill_one_wide_bin():
    net, r, power, variance = scene(relative=0.01)
    wide = slice(None, None, 4)
    at = r[wide].size // 3
    layer = power[..., wide].copy()
    layer[:, 0, at] *= 5.0
    found, _ = condensed(net, r[wide], layer, variance[..., wide])
    assert not found.bridged.any()


def test_noise_far_above_what_is_stated_is_told():
    net, r, power, variance = scene(relative=0.05)
    found = solved(net, r, power, variance / 400.0)
    used = np.isfinite(found.extinction)
    assert (found.flags.outlying | found.flags.poor_fit | ~used).all()


@pytest.mark.parametrize("variance", [0.0, None])
def test_noise_that_is_not_stated_alarms_nobody(variance):
    net, r, power, _ = scene(ALL["plume"], relative=0.02)
    found = solved(net, r, power, variance)
    assert not found.flags.bridged.any()
    assert not found.flags.outlying.any()


def test_spikes_are_seen_where_signals_tell_the_noise():
    net, r, power, variance = scene(relative=0.01, additive=0.0)
    at = bin_at(r, net.on_beam(0)[1][0])
    clean = solved(net, r, power, None)
    found = solved(net, r, hit(power, variance, 7, 0, at, 60.0), None)
    assert found.flags.bridged[7, net.on_beam(0)[0]].all()
    assert np.nanmax(apart(found, clean)[7]) < 1.0


@pytest.mark.parametrize(("wild", "left"), [((0, 1, -2, -1), True), ((0, 1), False)])
def test_a_beam_nothing_good_is_left_of_is_not_believed(wild, left):
    """Between wild bins at either end of a short beam, all may be wild; nothing lies beyond."""
    net = fan([-30.0, 0.0, 40.0], [(60,), (90,), (120,)])
    r = np.arange(20.0, 140.0, 4.0)
    field = ALL["homogeneous"]
    power, variance = noisy(net, r, signals(net, r, field), 2e-3, 50, 3, 0.0)
    ends = net.on_beam(0)[1][[0, -1]]
    used = np.arange(bin_at(r, ends[0]) - 3, bin_at(r, ends[1]) + 4)
    power[:, 0, used[-1] + 1 :] = np.nan
    nearest = np.array([r[used[0]] - 1.0, 20.0, 20.0])
    damaged = hit(power, variance, 4, 0, used[list(wild)], 60.0)
    data, layout = condensed(net, r, damaged, variance, nearest=nearest)
    mine = slice(layout.first_passage[0], layout.first_passage[1])
    others = np.arange(50) != 4
    assert (data.usable[others, mine] == 1).all()
    assert not data.bridged[others].any()
    assert data.bridged[4, 0]
    assert (data.status[4, 0] == _condensed_signals.OUTLYING) == left
    assert (data.usable[4, mine] == 0).all() == left
    found = solved(net, r, damaged, variance, full_overlap_range=nearest)
    assert found.flags.outlying[4, net.on_beam(0)[0]].all() == left
    assert not found.flags.outlying[others].any()


# Honesty ------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["crossing", "between"])
@pytest.mark.parametrize("relative", [0.01, 0.2])
def test_variances_of_bridged_beams_are_those_of_many_draws(where, relative):
    net, r, power, variance = scene(relative=relative, profiles=3000)
    ranges = net.on_beam(0)[1]
    at = bin_at(r, ranges[0] if where == "crossing" else (ranges[0] + ranges[-1]) / 2)
    damaged = hit(power, variance, slice(None), 0, [at, at + 5], 100.0)
    data, layout = condensed(net, r, damaged, variance)
    plain, _ = condensed(net, r, damaged, variance, screened=False)
    assert data.bridged[:, 0].all()
    left = np.all(data.integral == plain.integral, axis=1)
    assert left.mean() < 0.1
    first, last = layout.first_passage[:2]
    count = last - first
    size = 2 * count - 1
    told = data.covariance[:, layout.offset[0] : layout.offset[1]].reshape(-1, size, size)
    good = (data.usable[:, first:last] == 1).all(axis=1) & ~left
    truth, _ = condensed(
        net, r, signals(net, r, ALL["homogeneous"])[None], variance, screened=False
    )
    for c in range(1, count):
        # The far value less the near one, and the integral, in units of the near value.
        difference = data.log_value[good, first + c] - truth.log_value[0, first + c]
        spread = told[good, c, c] + told[good, 0, 0] - 2 * told[good, 0, c]
        assert np.std(difference / np.sqrt(spread)) == pytest.approx(1.0, abs=0.08)
        assert (
            abs(np.mean(difference))
            < 4 * np.std(difference) / np.sqrt(good.sum()) + 0.02 * relative
        )


def test_shares_are_those_of_polynomials():
    rng = np.random.default_rng(2)
    x = np.cumsum(rng.uniform(3.0, 9.0, 9))
    nodes, shares = np.array([0, 1, 3, 5, 6, 8, 0, 0]), np.empty(8)
    y = rng.standard_normal(9)
    outlying_bins._fit_shares(x, 4, nodes, 6, 5, shares)
    through = BarycentricInterpolator(x[nodes[:6]], y[nodes[:6]])(x[4])
    assert shares[:6] @ y[nodes[:6]] == pytest.approx(through, rel=1e-10)
    outlying_bins._fit_shares(x, 4, nodes, 6, 3, shares)
    fitted = np.polynomial.Polynomial.fit(x[nodes[:6]], y[nodes[:6]], 3)(x[4])
    assert shares[:6] @ y[nodes[:6]] == pytest.approx(fitted, rel=1e-10)


def test_results_do_not_depend_on_what_else_is_solved():
    net, r, power, variance = scene(relative=0.05, profiles=24)
    rng = np.random.default_rng(8)
    damaged = power + (rng.random(power.shape) < 0.02) * 50 * np.sqrt(variance)
    together = solved(net, r, damaged, variance, prior="none")
    assert together.flags.bridged.any()
    for n in (0, 11, 23):
        alone = solved(net, r, damaged[n], variance, prior="none")
        np.testing.assert_array_equal(alone.extinction, together.extinction[n])
        np.testing.assert_array_equal(alone.flags.bridged, together.flags.bridged[n])
    turned = solved(net, r, damaged[::-1], variance, prior="none")
    np.testing.assert_array_equal(turned.extinction[::-1], together.extinction)


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.6])
def test_one_percent_of_wild_bins_leaves_values_within_their_errors(exponent):
    net = fan([-500.0, 0.0, 400.0], [(50, 68), (78, 103), (112, 130)], farthest=1000.0)
    r = grid(net)
    clean = signals(net, r, ALL["homogeneous"], exponent)
    power, variance = noisy(net, r, clean, 0.02, 150)
    rng = np.random.default_rng(9)
    wild = (rng.random(power.shape) < 0.01) * rng.uniform(5.0, 100.0, power.shape)
    found = solved(
        net, r, power + wild * np.sqrt(variance), variance, exponent=exponent,
        blocks=np.arange(150) // 50,
    )  # fmt: skip
    kept = ~found.flags.flagged & np.isfinite(found.extinction)
    score = ((found.extinction - 2e-3) / found.extinction_standard_error)[kept]
    assert kept[:, found.near_crossing].mean() > 0.9
    assert np.mean(np.abs(score) > 4.0) <= 3e-3


@pytest.mark.parametrize("sizes", [(40.0, 40.0), (90.0, 30.0), (60.0, 0.0, 60.0)])
def test_spikes_that_are_left_are_part_of_the_standard_error(sizes):
    net, r, power, variance = scene(relative=0.02)
    damaged = spiked(net, r, power, variance, sizes)
    found, layout = condensed(net, r, damaged, variance)
    plain, _ = condensed(net, r, damaged, variance, screened=False)
    clean, _ = condensed(net, r, power, variance)
    size = 2 * int(layout.first_passage[1]) - 1
    told, own = (
        each.covariance[:, : layout.offset[1]].reshape(-1, size, size) for each in (found, plain)
    )
    left = (found.bridged[:, 0] == 1) & np.all(found.log_value == plain.log_value, axis=1)
    assert left.all()
    added = (told - own)[left]
    # One direction, by as much as the spikes have moved the beam, but for noise.
    assert np.all(np.linalg.matrix_rank(added, tol=1e-9 * np.abs(added).max()) == 1)
    moved = (plain.log_value - clean.log_value)[left, 1]
    stated = np.sqrt(added[:, 0, 0] + added[:, 1, 1] - 2.0 * added[:, 0, 1])
    np.testing.assert_allclose(stated, np.abs(moved), rtol=0.3)
    assert not np.allclose(told[left], own[left], rtol=0.1)


def test_beams_that_show_nothing_keep_their_covariance():
    net, r, power, variance = scene(ALL["narrow plume"], relative=0.02)
    found, _ = condensed(net, r, power, variance)
    plain, _ = condensed(net, r, power, variance, screened=False)
    quiet = found.bridged == 0
    assert quiet.mean() > 0.99
    whole = quiet.all(axis=1)
    np.testing.assert_array_equal(found.covariance[whole], plain.covariance[whole])
