"""Counts of light along range: those of the stability benchmark."""

from __future__ import annotations

from benchmarks.scenes.recorded_signals import RANGE, SHAPE, draw_counts

__all__ = ["RANGE", "SHAPE", "draw_counts"]
