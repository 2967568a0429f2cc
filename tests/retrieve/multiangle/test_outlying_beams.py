"""Standard errors are right where outliers remove beams and altitudes are correlated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.oracles.multiangle import cloud_scene


@pytest.mark.parametrize(("beams", "scatter"), [(4, 0.2), (10, 0.05)])
def test_altitudes_that_lost_a_beam_do_not_mislead_their_neighbours(beams, scatter):
    """If their extra noise counted as correlated, errors would be 1.3-1.6 times the stated ones."""
    cloud = replace(
        cloud_scene(0.92, largest=45.0),
        zenith_angle=np.linspace(0.0, 45.0, beams),
        inhomogeneity=scatter,
        outliers=0.05,
    )
    scores = []
    for seed in range(30):
        amount = np.exp(np.random.default_rng(seed).normal(0.0, 0.7, (8, 1)))
        scene = replace(
            cloud, extinction=0.5 * amount * cloud.extinction, backscatter=np.ones((8, 40))
        )
        result = scene.draw(8, seed, 7).retrieve()
        error = result.optical_depth - scene.optical_depth
        scores.append(error / result.optical_depth_standard_error)
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.25
