"""The compressed solver against exact shapes, converged least squares and plain loops."""

import numpy as np
import pytest
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from scipy import stats
from support.oracles.homogeneous import GEOMETRIES, lowest_errors, section, signal

from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import (
    _compressed,
    _functional_tables,
    _routing,
    _vector_loops,
)
from lidarops.retrieve.homogeneous._functional_tables import make_tables
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import HomogeneousResult, fit_homogeneous_path

KM = 1e-3
LONG = section(2500.0, 8000.0)
FIELDS = tuple(HomogeneousResult.__dataclass_fields__)
SOLVERS = ("compressed", "fast")


def bounds(r):
    return -0.3 / r[-1], 60.0 / (r[-1] - r[0])


def tables(r, size, weights=None):
    return make_tables(r, np.ones(r.size) if weights is None else weights, bounds(r), size)


# The tables ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "loss"), [(11, 2e-6), (7, 7.5e-3)])
@pytest.mark.parametrize(("start", "length"), GEOMETRIES)
def test_basis_holds_the_information_of_a_profile_on_extinction(start, length, size, loss):
    r = section(start, length)
    table = tables(r, size)
    columns = table.columns[:, : size + 1] * np.append(np.full(size, table.unit**0.5), 1.0)
    np.testing.assert_allclose(columns[:, :size].T @ columns[:, :size], np.eye(size), atol=1e-13)
    np.testing.assert_allclose(columns[:, :size].sum(axis=0), 0.0, atol=1e-12)
    assert columns[:, size].sum() == pytest.approx(1.0, rel=1e-14)
    basis = np.linalg.qr(np.column_stack([np.ones(r.size), columns[:, :size]]))[0]
    for tau in np.concatenate([[0.0], np.geomspace(0.01, 60.0, 60)]):
        x = (r - r[0]) / length
        shape = np.exp(-2.0 * tau * x) * (r[0] / r) ** 2
        kept = []
        for project in (np.eye(r.size), basis @ basis.T):
            one, level, slope = (
                project @ values for values in (shape, np.ones(r.size), -2.0 * x * shape)
            )
            others = np.column_stack([one, level])
            remainder = slope - others @ np.linalg.lstsq(others, slope, rcond=None)[0]
            kept.append(remainder @ remainder)
        assert kept[1] >= (1.0 - loss) * kept[0]


@pytest.mark.parametrize("room", [1, 500, 10**9])
def test_tables_do_not_depend_on_the_block_size(monkeypatch, room):
    r, weights = LONG, np.linspace(1.0, 2.0, LONG.size)
    whole = _functional_tables._make(r, weights, bounds(r), 11)
    monkeypatch.setattr(_functional_tables, "_ROOM", room)
    for one, other in zip(whole, _functional_tables._make(r, weights, bounds(r), 11), strict=True):
        np.testing.assert_array_equal(one, other)


def test_long_profiles_are_solved_without_tables(monkeypatch):
    r = 2500.0 + 2.0 * np.arange(_routing.MOST_BINS + 1.0)
    power = signal(r, 100.0, 3e-5) + np.random.default_rng(8).standard_normal((3, r.size))
    made = []
    monkeypatch.setattr(_routing, "make_tables", lambda *arguments: made.append(arguments))
    fit, direct = (
        fit_homogeneous_path(power, r, variance=1.0, method=name) for name in ("auto", "direct")
    )
    assert not made
    np.testing.assert_allclose(
        fit.extinction, direct.extinction, atol=1e-3 * direct.extinction_standard_error.min()
    )
    np.testing.assert_array_equal(fit.quality, direct.quality)


def test_tables_are_made_once():
    assert tables(LONG, 11) is tables(LONG.copy(), 11)
    assert tables(LONG, 11) is not tables(LONG, 7)


# Compiled vectors ---------------------------------------------------------------------------


@intrinsic
def fused(context, x, y, z):
    signature = types.float64(types.float64, types.float64, types.float64)

    def generate(target, builder, _, arguments):
        double = ir.DoubleType()
        kind = ir.FunctionType(double, [double] * 3)
        return builder.call(
            cgutils.get_or_insert_function(builder.module, kind, "llvm.fma.f64"), arguments
        )

    return signature, generate


@njit
def plainly(values, matrix):
    out = np.zeros((values.shape[0], matrix.shape[1]))
    for row in range(values.shape[0]):
        for column in range(matrix.shape[1]):
            for i in range(matrix.shape[0]):
                out[row, column] = fused(values[row, i], matrix[i, column], out[row, column])
    return out


@njit
def in_registers(values, matrix, out):
    address, width = values.ctypes.data, 8 * values.shape[1]
    if values.shape[0] == 6:
        _vector_loops.project_6_8(
            address, width, matrix.ctypes.data, matrix.shape[0], out.ctypes.data, address, 8
        )
    elif values.shape[0] == 4:
        _vector_loops.project_4_12(
            address, width, matrix.ctypes.data, matrix.shape[0], out.ctypes.data, address, 8
        )
    elif matrix.shape[1] == 8:
        _vector_loops.project_1_8(
            address, width, matrix.ctypes.data, matrix.shape[0], out.ctypes.data, address, 8
        )
    else:
        _vector_loops.project_1_4(
            address, width, matrix.ctypes.data, matrix.shape[0], out.ctypes.data, address, 8
        )


@pytest.mark.parametrize(("rows", "columns"), [(6, 8), (4, 12), (1, 8), (1, 4)])
@pytest.mark.parametrize("terms", [1, 7, 225])
def test_projection_has_the_bits_of_a_plain_loop(rows, columns, terms):
    random = np.random.default_rng(0)
    values, matrix = random.normal(size=(rows, terms)), random.normal(size=(terms, columns))
    out = np.empty((rows, columns))
    in_registers(values, matrix, out)
    np.testing.assert_array_equal(out, plainly(values, matrix))


@njit
def take_residuals(row, tail, envelope, root, decay, amplitude, background, out):
    steps = envelope.size // 16
    e2 = decay * decay
    e4 = e2 * e2
    return _vector_loops.residuals(
        row,
        row.ctypes.data,
        tail.ctypes.data,
        steps,
        envelope.ctypes.data,
        root.ctypes.data,
        decay,
        e2,
        e4,
        e4 * e4,
        amplitude,
        background,
        out.ctypes.data,
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("bins", [1, 16, 17, 225])
def test_residuals_are_those_of_the_model(dtype, bins):
    random = np.random.default_rng(1)
    padded = -(-bins // 16) * 16
    envelope, root = np.zeros(padded, dtype), np.zeros(padded, dtype)
    envelope[:bins], root[:bins] = random.uniform(0.5, 1.0, (2, bins))
    row = random.normal(size=bins).astype(dtype)
    rest = bins - (padded - 16)
    tail = np.full(16, 3.0, dtype)
    tail[:rest] = row[bins - rest :]
    out = np.empty(padded, dtype)
    energy, largest = take_residuals(row, tail, envelope, root, 0.98, 5.0, 3.0, out)
    model = 3.0 + 5.0 * 0.98 ** np.arange(bins) * envelope[:bins].astype(float)
    expected = (row.astype(float) - model) * root[:bins]
    close = {"rtol": 1e-5, "atol": 1e-5} if dtype == np.float32 else {"rtol": 1e-12}
    np.testing.assert_allclose(out[:bins], expected, **close)
    assert np.all(out[bins:] == 0.0)
    assert energy == pytest.approx(expected @ expected, rel=close["rtol"])
    assert largest == pytest.approx(np.abs(expected).max(), rel=close["rtol"])


# Exactness ----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize("level", [0.0, 1.0, 10.0, 100.0])
@pytest.mark.parametrize(
    ("start", "length", "bins"),
    [*((*geometry, 225) for geometry in GEOMETRIES), (500.0, 200.0, 32), (30.0, 15e3, 2000)],
)
def test_noise_free_extinction_is_exact(start, length, bins, level, method):
    r = np.linspace(start, start + length, bins)
    truth = np.geomspace(1e-5, 50.0 / length, 300)[:, np.newaxis]
    power = level + np.exp(-2.0 * truth * (r - start)) * (start / r) ** 2
    fit = fit_homogeneous_path(power, r, method=method)
    np.testing.assert_allclose(fit.extinction, truth[:, 0], rtol=1e-9)
    assert np.max(np.abs(fit.background - level)) < 1e-9
    if bins == 225:
        rounded = fit_homogeneous_path(power.astype(np.float32), r, method=method)
        apart = np.abs(rounded.extinction / truth[:, 0] - 1.0)
        assert apart.max() < 5e-5 * max(1.0, level) or apart.max() < 2e-3
        assert apart.max() < 5e-5 * max(1.0, 10.0 * level)


@pytest.mark.parametrize(("method", "apart"), [("compressed", 0.01), ("fast", 0.35)])
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(("start", "length"), GEOMETRIES)
def test_result_is_that_of_converged_least_squares(start, length, known, method, apart):
    r = section(start, length)
    random = np.random.default_rng(2)
    count = 3000
    extinction = np.exp(random.uniform(np.log(1e-5), np.log(5e-3), count))[:, np.newaxis]
    height = np.exp(random.uniform(np.log(30.0), np.log(1e5), count))[:, np.newaxis]
    power = height * np.exp(-2.0 * extinction * (r - start)) * (start / r) ** 2
    power += 370.0 + random.normal(size=power.shape)
    variance = 1.0 if known else None
    exact = fit_homogeneous_path(power, r, variance=variance, method="direct")
    fit = fit_homogeneous_path(power, r, variance=variance, method=method)
    undetermined = (
        Quality.LOW_SIGNAL | HomogeneousQuality.POORLY_DETERMINED | HomogeneousQuality.AT_BOUND
    )
    valid = (exact.quality & int(undetermined)) == 0
    assert valid.sum() > 1000
    for name in ("extinction", "background", "amplitude"):
        error = getattr(exact, f"{name}_standard_error")[valid]
        difference = np.abs(getattr(fit, name) - getattr(exact, name))[valid]
        assert np.max(difference / error) < apart
        ratio = getattr(fit, f"{name}_standard_error")[valid] / error
        np.testing.assert_allclose(ratio, 1.0, rtol=5e-3 if method == "compressed" else 0.2)
    same = (fit.quality & int(undetermined)) == (exact.quality & int(undetermined))
    assert np.mean(same) > 0.998
    if not np.isnan(fit.reduced_chi2).all():
        np.testing.assert_allclose(fit.reduced_chi2[valid], exact.reduced_chi2[valid], rtol=1e-3)


# Statistics ---------------------------------------------------------------------------------


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize(
    ("start", "length", "height", "extinction"),
    [
        (2500.0, 8000.0, 107.0, 0.03),
        (2500.0, 8000.0, 1e5, 0.03),
        (2500.0, 1700.0, 1e4, 0.03),
        (2500.0, 8000.0, 1e4, 5.0),
        (10500.0, 2500.0, 3e4, 0.1),
    ],
)
def test_scatter_is_the_least_possible_and_stated(start, length, height, extinction, method):
    r = section(start, length)
    count = 10_000
    power = 370.0 + signal(r, height, extinction * KM)
    power = power + np.random.default_rng(3).normal(size=(count, r.size))
    fit = fit_homogeneous_path(power, r, variance=1.0, method=method)
    lowest = lowest_errors(r, height, extinction * KM)
    amplitude = height * start**2 * np.exp(2.0 * extinction * KM * start)
    truths = {"background": 370.0, "extinction": extinction * KM, "amplitude": amplitude}
    for name, truth in truths.items():
        pull = (getattr(fit, name) - truth) / getattr(fit, f"{name}_standard_error")
        assert 0.94 <= np.mean(np.abs(pull) < 1.96) <= 0.96
    error = fit.extinction - extinction * KM
    assert np.sqrt(np.mean(error**2)) < 1.04 * lowest[2]
    assert abs(np.mean(error)) < 0.05 * lowest[2]


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize("height", [100.0, 1e6])
def test_curvature_misfit_is_chi_square(height, method):
    power = 370.0 + signal(LONG, height, 0.03 * KM)
    power = power + np.random.default_rng(4).normal(size=(20_000, 225))
    fit = fit_homogeneous_path(power, LONG, variance=1.0, method=method)
    dof = _compressed.CURVATURES - 2
    assert np.mean(fit.curvature_misfit) == pytest.approx(dof, rel=0.02)
    assert stats.kstest(fit.curvature_misfit, stats.chi2(dof).cdf).pvalue > 1e-4


def test_common_weights_serve_counts():
    shots = 51
    mean = 10.0 + signal(LONG, 20.0, 0.03 * KM)
    power = np.random.default_rng(5).poisson(shots * mean, (10_000, 225)) / shots
    fit = fit_homogeneous_path(power, LONG, variance=mean / shots, method="compressed")
    direct = fit_homogeneous_path(power[:300], LONG, variance=mean / shots, method="direct")
    apart = np.abs(fit.extinction[:300] - direct.extinction)
    assert np.max(apart / direct.extinction_standard_error) < 0.01
    pull = (fit.extinction - 0.03 * KM) / fit.extinction_standard_error
    assert 0.94 <= np.mean(np.abs(pull) < 1.96) <= 0.96


# Bits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("variance", [1.0, None])
def test_bits_do_not_depend_on_size_or_start_of_the_batch(dtype, variance, method):
    power = 370.0 + signal(LONG, 50.0, 0.1 * KM)
    power = (power + np.random.default_rng(6).normal(size=(1000, 225))).astype(dtype)
    power[17, 30] = np.nan
    power[400] = 5.0
    whole = fit_homogeneous_path(power, LONG, variance=variance, method=method)
    for size in (*range(1, 100), *range(100, 1000, 37)):
        batch = fit_homogeneous_path(power[:size], LONG, variance=variance, method=method)
        np.testing.assert_array_equal(batch.extinction, whole.extinction[:size])
    for start in range(1, 120, 7):
        batch = fit_homogeneous_path(
            power[start : start + 60], LONG, variance=variance, method=method
        )
        for name in FIELDS:
            np.testing.assert_array_equal(
                getattr(batch, name), getattr(whole, name)[start : start + 60], err_msg=name
            )


@pytest.mark.parametrize("scale", [1e-150, 1e-30, 1e30, 1e150])
@pytest.mark.parametrize("method", SOLVERS)
def test_scale_of_the_power_does_not_matter(scale, method):
    power = 370.0 + signal(LONG, 100.0, 0.1 * KM)
    power = power + np.random.default_rng(7).normal(size=(20, 225))
    expected = fit_homogeneous_path(power, LONG, method=method)
    fit = fit_homogeneous_path(power * scale, LONG, method=method)
    # Beyond 1e140 the squares leave the float range, and the direct fit takes over.
    close = 1e-9 if 1e-50 < scale < 1e50 else 1e-2
    np.testing.assert_allclose(fit.extinction, expected.extinction, rtol=close)
    np.testing.assert_allclose(fit.background, expected.background * scale, rtol=close)
    np.testing.assert_array_equal(fit.quality, expected.quality)
    if 1e-38 < scale < 1e30:
        single = fit_homogeneous_path((power * scale).astype(np.float32), LONG, method=method)
        np.testing.assert_allclose(single.extinction, expected.extinction, rtol=1e-2)
        np.testing.assert_array_equal(single.quality, expected.quality)


@pytest.mark.parametrize("method", SOLVERS)
def test_profiles_without_tables_are_solved_by_the_direct_fit(method):
    uneven = LONG + np.linspace(0.0, 3.0, 225) ** 2
    thin = section(10_500.0, 50.0)
    short = LONG[:20]
    for r in (uneven, thin, short):
        power = 370.0 + signal(r, 1e4, 0.1 * KM)
        power = power + np.random.default_rng(8).normal(size=(3, r.size))
        fit = fit_homogeneous_path(power, r, variance=1.0, method=method)
        exact = fit_homogeneous_path(power, r, variance=1.0, method="direct")
        np.testing.assert_array_equal(fit.extinction, exact.extinction)


@pytest.mark.parametrize(
    ("start", "length", "step", "extinction", "amplitude"),
    [
        (10_000.0, 200.0, 3.75, 5e-6, 3e5),
        (5000.0, 200.0, 6.06, 1e-6, 3e4),
        (5000.0, 200.0, 6.06, -1e-5, 1e5),
        (6000.0, 300.0, 3.75, 1e-5, 1e5),
        (10_000.0, 110.0, 2.5, 3e-5, 1e6),
    ],
)
def test_a_thin_section_settles_far_from_its_start(start, length, step, extinction, amplitude):
    r = np.arange(start, start + length, step)
    shape = (start / r) ** 2 * np.exp(-2.0 * extinction * (r - start))
    noise = np.random.default_rng(5).normal(size=(400, r.size))
    power = 50.0 + amplitude * shape + noise
    for method in ("auto", "fast"):
        fit = fit_homogeneous_path(power, r, variance=1.0, method=method)
        exact = fit_homogeneous_path(power, r, variance=1.0, method="direct")
        off = np.abs(fit.extinction - exact.extinction) / exact.extinction_standard_error
        assert off.max() < (0.01 if method == "auto" else 0.1)
