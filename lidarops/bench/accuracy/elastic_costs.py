"""CPU time of the steps of the elastic retrieval, beside plain peers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.harness.timing import READ, StepCost, affordable, least_times

ALL_STEPS: Final = "all steps"
ELASTIC_LEVEL: Final = 1e4
"""Background of the timed profiles, counts per shot."""


def elastic_costs(batch: int, repeats: int) -> list[StepCost]:
    """Return the CPU time of each step and peer, the read first.

    Parameters
    ----------
    batch : int
        Profiles per call; slow peers get fewer.
    repeats : int
        Timed rounds.
    """
    steps, others = _steps(elastic_cases.simulated_sky().counts(ELASTIC_LEVEL, batch))
    sizes = {name: affordable(step, batch) for name, step in (steps | others).items()}
    sizes[READ] = batch
    calls = {name: partial(step, sizes[name]) for name, step in (steps | others).items()}
    times = least_times(calls, repeats)
    read = times[READ] / batch
    return [
        StepCost(
            step=name,
            batch=batch,
            profiles=sizes[name],
            nanoseconds=1e9 * seconds / sizes[name],
            reads=seconds / sizes[name] / read,
            ours=name in steps and name != READ,
        )
        for name, seconds in times.items()
    ]


_Step = Callable[[int], object]
"""Runs a step for a number of profiles."""


def _steps(counts: Any) -> tuple[dict[str, _Step], dict[str, _Step]]:
    """Return the steps of lidarops with the read, and the peers."""
    sky = elastic_cases.simulated_sky()
    methods = elastic_cases.background_methods()
    estimate = methods[elastic_cases.KNOWN_SHAPE](counts, sky)
    power, noise = (
        elastic_cases.subtract_background(counts, sky, estimate),
        elastic_cases.count_variance(counts),
    )
    # The peers allow no gaps: they get the bins of incomplete overlap too.
    whole = counts - estimate.background[:, np.newaxis]

    def solve_particles(few: int) -> object:
        return elastic_cases.invert_particles(
            power[:few],
            sky,
            elastic_cases.GIVEN_WINDOW,
            noise=noise[:few],
            background_error=estimate.standard_error[:few],
        )

    whole_chain = elastic_cases.Chain(elastic_cases.KNOWN_SHAPE, choose=True)

    def everything(few: int) -> object:
        first = counts[:few]
        return elastic_cases.invert(
            first, sky, methods[whole_chain.method](first, sky), whole_chain
        )

    ours: dict[str, _Step] = {
        READ: lambda few: np.max(counts[:few]),
        elastic_cases.TAIL_MEAN: lambda few: methods[elastic_cases.TAIL_MEAN](counts[:few], sky),
        elastic_cases.KNOWN_SHAPE: lambda few: methods[elastic_cases.KNOWN_SHAPE](
            counts[:few], sky
        ),
        elastic_cases.KNOWN_CLEAN_RANGE: lambda few: methods[elastic_cases.KNOWN_CLEAN_RANGE](
            counts[:few], sky
        ),
        "layers.screen": lambda few: elastic_cases.find_clouds(power[:few], noise[:few], sky),
        "reference.choose": lambda few: elastic_cases.choose_window(power[:few], noise[:few], sky),
        "elastic.solve": solve_particles,
        ALL_STEPS: everything,
    }
    others: dict[str, _Step] = {
        "background, numpy lstsq": lambda few: elastic_cases.lstsq_backgrounds(counts[:few], sky),
        "Klett, numpy": lambda few: elastic_cases.klett_numpy(whole[:few], sky),
        "Klett, Python": lambda few: elastic_cases.klett_python(whole[:few], sky),
    }
    return ours, others
