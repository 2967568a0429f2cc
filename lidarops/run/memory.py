"""Fit the chunks of a scene into the memory limit of the process that processes it."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from lidarops.errors import SceneError
from lidarops.scene.job import Job
from lidarops.scene.memory import scene_memory

USABLE: Final = 0.9
"""Share of a limit that a scene may use; dask ends a worker at 0.95."""
_MEGABYTE: Final = 1e6


def fitted(job: Job, limit: int | None) -> Job:
    """Return a job with chunks that fit into a limit; results do not depend on chunks.

    Parameters
    ----------
    job : Job
        Unchanged where it states the profiles of a chunk.
    limit : int or None
        Bytes of the process; None for no limit.

    Raises
    ------
    SceneError
        If the scene does not fit even with one profile in a chunk.
    """
    if limit is None or job.profiles_per_chunk is not None:
        return job
    memory = scene_memory(job.scene, job.plan)
    if memory.total <= USABLE * limit:
        return job
    profiles = memory.profiles_within(USABLE * limit)
    if not profiles:
        megabytes = {
            name: f"{size / _MEGABYTE:.0f} MB"
            for name, size in {
                "all": memory.of(1),
                "process": memory.process,
                "held": memory.held,
                "limit": limit,
                "least": memory.of(1) / USABLE,
            }.items()
        }
        raise SceneError(
            f"needs about {megabytes['all']} of memory even with one profile in a chunk"
            f" ({megabytes['process']} for the process, {megabytes['held']} held for the whole"
            f" scene); {USABLE:.0%} of the limit of {megabytes['limit']} may be used",
            remedy=f"raise --memory-limit, or the limit of the workers, to {megabytes['least']};"
            " or give a shorter window of scenes or longer averaging intervals in the campaign"
            " file; --profiles-per-chunk 1 tries it nevertheless",
        )
    return replace(job, profiles_per_chunk=profiles)
