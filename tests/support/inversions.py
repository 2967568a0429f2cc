"""The elastic inversion with all its arguments on one level, as tests vary them one by one."""

from __future__ import annotations

from typing import Any

from lidarops.retrieve.elastic import inversion
from lidarops.retrieve.elastic.inversion import Air, ElasticResult, LidarRatio, Reference


def invert_elastic(
    power: Any,
    range: Any,  # noqa: A002 - the field's word
    *,
    molecular_backscatter: Any,
    molecular_extinction: Any,
    lidar_ratio: Any,
    reference: Any,
    **others: Any,
) -> ElasticResult:
    """Return the inversion; errors of air, lidar ratio and reference are among the others."""
    return inversion.invert_elastic(
        power,
        range,
        air=Air(
            molecular_backscatter, molecular_extinction, others.pop("molecular_relative_error", 0.0)
        ),
        lidar_ratio=LidarRatio(lidar_ratio, others.pop("lidar_ratio_standard_error", 0.0)),
        reference=Reference(
            reference,
            others.pop("reference_scattering_ratio", 1.0),
            others.pop("reference_relative_error", 0.0),
        ),
        **others,
    )
