"""How much of the time of the compressed solver its second look at the bins takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final
from unittest import mock

import numba
import numpy as np

from lidarops.bench.harness.rows import Scores, share
from lidarops.retrieve.homogeneous import _compressed, path_fit

NAME: Final = "second look of the compressed solver at the bins"
SHARE: Final = "share"
_PROFILES: Final = 4096
_BINS: Final = 225
_take_residuals: Final = _compressed._take_residuals  # noqa: SLF001 - no public function has the parts of the solver


@numba.njit(cache=True)
def _look(block: Any, scratch: Any, times: int) -> None:
    for _ in range(times):
        _take_residuals(block, scratch, want_differences=False)


def measure_second_look(repeats: int) -> Scores:
    """Return the time for the residuals over that for the solution, both of dense profiles.

    Parameters
    ----------
    repeats : int
        The least times of these count.
    """
    arguments = _arguments()
    power, root, envelope, tables, mode, limits, *_ = arguments
    block = power[: _compressed.BLOCK]
    scratch = _compressed._scratch(power, root, envelope)  # noqa: SLF001
    _compressed._solve_block(block, tables, scratch, mode, limits)  # noqa: SLF001
    blocks = _PROFILES // _compressed.BLOCK
    calls: dict[str, Callable[[], object]] = {
        "look": lambda: _look(block, scratch, blocks),
        "all": lambda: _compressed.solve_compressed(*arguments),
    }
    least = {name: _least_time(call, repeats) for name, call in calls.items()}
    return {("", NAME): {SHARE: share(least["look"] / least["all"])}}


def _arguments() -> tuple[Any, ...]:
    """Return what the public function gives to the solver."""
    distance = 2500.0 + 37.5 * np.arange(_BINS)
    fall = 1e9 / distance**2 * np.exp(-6e-5 * distance)
    noise = np.random.default_rng(0).standard_normal((_PROFILES, _BINS))
    power = (300.0 + fall + noise).astype(np.float32)
    with mock.patch.object(
        _compressed, "solve_compressed", wraps=_compressed.solve_compressed
    ) as solver:
        path_fit.fit_homogeneous_path(power, distance, variance=1.0)
    return tuple(solver.call_args.args)


def _least_time(call: Callable[[], object], repeats: int) -> float:
    # The first call compiles.
    call()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return min(times)
