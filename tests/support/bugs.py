"""A bug in a retrieval, that shows in the scenes of one day."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import xarray as xr

from lidarops.products.homogeneous import retrieval
from lidarops.products.homogeneous.retrieval import RETRIEVAL
from lidarops.retrieve.homogeneous import labeled
from lidarops.run import executor
from lidarops.scene.case import ChannelCase, Entries
from lidarops.scene.retrieval import Workload


def insert(error: BaseException, day: str, patch: pytest.MonkeyPatch | None = None) -> None:
    """Make the homogeneous retrieval raise an error in the scenes of a day.

    Parameters
    ----------
    error : BaseException
    day : str
        As ``2026-03-02``.
    patch : MonkeyPatch, optional
        Undoes the change at the end of a test; not needed in a worker, which ends with it.
    """
    fit = labeled.fit_homogeneous_path

    def fit_with_a_bug(power: xr.DataArray, **settings: Any) -> xr.Dataset:
        if str(power["time"].to_numpy()[0]).startswith(day):
            raise error
        return fit(power, **settings)

    (patch or pytest.MonkeyPatch()).setattr(labeled, "fit_homogeneous_path", fit_with_a_bug)


def insert_in_planning(error: BaseException, day: str, patch: pytest.MonkeyPatch) -> None:
    """Raise an error when the homogeneous products of the scenes of a day are planned."""

    def decide_with_a_bug(case: ChannelCase) -> Entries:
        if f"{case.scene.start:%Y-%m-%d}" == day:
            raise error
        return RETRIEVAL.needs(case)

    patch.setattr(retrieval, "RETRIEVAL", replace(RETRIEVAL, needs=decide_with_a_bug))


def insert_in_the_estimate(error: BaseException, day: str, patch: pytest.MonkeyPatch) -> None:
    """Raise an error when the memory of homogeneous products of a day is estimated."""

    def held_with_a_bug(settings: retrieval.HomogeneousPlan, work: Workload) -> float:
        if f"{work.scene.start:%Y-%m-%d}" == day:
            raise error
        return RETRIEVAL.held(settings, work)

    patch.setattr(retrieval, "RETRIEVAL", replace(RETRIEVAL, held=held_with_a_bug))


def insert_in_the_worker(error: BaseException, day: str) -> None:
    """Make a worker raise an error outside the processing of the scenes of a day."""
    attempt = executor.attempt

    def attempt_with_a_bug(job: Any) -> Any:
        if f"{job.scene.start:%Y-%m-%d}" == day:
            raise error
        return attempt(job)

    executor.attempt = attempt_with_a_bug
