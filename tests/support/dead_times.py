"""Records of one detector by photon counting and analog: those of the stability benchmark."""

from __future__ import annotations

from benchmarks.scenes.recorded_signals import (
    DISTANCE,
    LAG,
    LIGHT,
    NONLINEAR,
    SCENES,
    draw_group,
    draw_scene,
)

__all__ = ["DISTANCE", "LAG", "LIGHT", "NONLINEAR", "SCENES", "draw_scene", "record"]


def record(
    rng, dead_time, *, light=LIGHT, sky=0.5, groups=4, shots=600, paralysable=False, baseline=0.0
):
    """Return groups of one profile each, of the same light."""
    return [
        draw_group(
            rng, dead_time, [light], [shots], sky, paralysable=paralysable, baseline=baseline
        )
        for _ in range(groups)
    ]
