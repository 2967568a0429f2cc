"""A stand-in for processing: its products contain exactly what real products depend on."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.errors import LidarOpsError
from lidarops.records import ProductRecord, SceneOutcome
from lidarops.run.leftovers import product_file
from lidarops.run.staleness import settings_digest
from lidarops.scene import dependence
from lidarops.scene.input_files import check_files
from lidarops.scene.job import Failure, Job, recorded_settings

REFUSED = "\n# The stand-in refuses this file.\n"
"""End of an ancillary file that can be read, but ends the scenes that use it."""


def attempt(job: Job) -> tuple[SceneOutcome, bool]:
    """Stand in for `lidarops.scene.processing.attempt`."""
    scene, inputs, refused = check_files(
        job.scene, Path(job.campaign.archive), read_all=job.campaign.all_steps
    )
    if refused:
        error = "" if scene.granules else "no granule of the scene can be read"
        failed = Failure(error).outcome(job.scene, job.plan)
        return replace(failed, refused=refused, inputs=inputs), False
    files = dependence.ancillary_files(job.plan.steps)
    for name in files:
        if (job.campaign.folder / name).read_text().endswith(REFUSED):
            return Failure(f"{name}: is refused").outcome(job.scene, job.plan), True
    try:
        inputs += Ancillaries.read(job.campaign.folder, files).inputs
    except LidarOpsError as error:
        return Failure(str(error)).outcome(job.scene, job.plan), True
    products = []
    for kind, channel in job.plan.product_keys:
        closure = dependence.plan_closure(job.plan, [(kind, channel)])
        used = sorted(record.sha256 for record in dependence.product_inputs(closure, inputs))
        settings = recorded_settings(job, job.scene, closure, (kind, channel))
        fields = [closure.as_dict(), settings_digest(settings), used]
        content = json.dumps(fields, sort_keys=True).encode()
        path = product_file(scene, (kind, channel))
        target = job.campaign.products_root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{target.name}.tmp")
        temporary.write_bytes(content)
        temporary.replace(target)
        sha256 = hashlib.sha256(content).hexdigest()
        products.append(ProductRecord(path, kind, channel, sha256, len(content), 1, {}, 1))
    outcome = replace(
        Failure("").outcome(job.scene, job.plan),
        products=tuple(products),
        inputs=inputs,
        seconds={"digest": 0.5, "retrieve": 1.0, "write": 0.25},
    )
    return outcome, True
