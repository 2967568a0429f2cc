"""Shares of false values that comments of products state, from the committed results.

``python docs/_extensions/measured_shares.py`` writes `lidarops/netcdf/measured_shares.py`; so does
``make golden``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import before_after
import benchmark_results
import verdicts

from lidarops.bench.harness.figure import share_text
from lidarops.bench.stability.random_scenes import (
    BROKEN,
    FALSE_PLAIN,
    FALSE_RANDOM,
    TARGET,
    VIOLATED,
)

FILE: Final = Path(benchmark_results.__file__).parents[2] / "lidarops/netcdf/measured_shares.py"
TABLES: Final = ("homogeneous",)
"""Tables of that benchmark of which comments state all violations."""
_LIDAR_RATIO: Final = ("stability", "networks, varying lidar ratio", "extinction")
BESIDE: Final[dict[tuple[str, str], list[Any]]] = {
    ("background, known shape", "shape of hazy air"): [
        *("stability", "signal chain", "background, known shape", "shape of hazy air", FALSE_PLAIN)
    ],
    ("voltage", "analog noise below half a step"): [
        *("stability", "signal chain", "voltage", "analog noise below half a step", FALSE_PLAIN)
    ],
    ("background", "near the cut"): [
        *("stability", "near the cut", "background", "near the limit of POORLY_DETERMINED"),
        FALSE_RANDOM,
    ],
    ("backscatter", "more haze than stated"): [
        *("stability", "elastic", "backscatter", "more haze than stated", FALSE_PLAIN)
    ],
    ("lidar ratio", "model holds"): ["stability", "Raman", "lidar ratio", "none", FALSE_RANDOM],
    ("scans", "layer"): [
        *("stability", "multi-angle", "extinction", "layer of a few altitudes", FALSE_RANDOM)
    ],
    ("scans", "layer, blocks of 2"): [
        *("stability", "scans, blocks of 2", "extinction"),
        *("layer of a few altitudes, blocks of 2", FALSE_RANDOM),
    ],
    ("network", "plume, blocks of 1"): [
        *("stability", "networks, plume, blocks of 1", "extinction", "plume, blocks of 1"),
        FALSE_RANDOM,
    ],
    ("network", "layered, blocks of 1"): [
        *("stability", "networks, layered, blocks of 1", "extinction", "layered, blocks of 1"),
        FALSE_RANDOM,
    ],
    ("network", "lidar ratio, 2 % declared"): [
        *(*_LIDAR_RATIO, "lidar ratio varies by 10 %, 2 %, the default, declared", FALSE_PLAIN)
    ],
    ("network", "lidar ratio, 10 % declared"): [
        *(*_LIDAR_RATIO, "lidar ratio varies by 10 %, 10 % declared", FALSE_PLAIN)
    ],
}
"""Other shares: their names, and where they stand in the results."""

_HEAD: Final = '''\
"""Measured shares of false values, as `docs/_extensions/measured_shares.py` writes them.

By quantity and class of simulated scenes: percent of the values that differ by more than 4 stated
errors, and the standard error of that. `false_shares` puts them into words.
"""

from __future__ import annotations

from typing import Final

SHARES: Final[dict[tuple[str, str], tuple[float, float]]] = {
'''


def text() -> str:
    """Return the module of shares."""
    shares = {}
    for title, rows in benchmark_results.read("stability")["tables"].items():
        if not title.endswith(tuple(f": {name}" for name in TABLES)):
            continue
        violated = {
            (row.case, row.method)
            for row in rows
            if row.quantity == TARGET
            and (judged := verdicts.judgement(row))
            and judged.limits == share_text(VIOLATED)
        }
        shares |= {
            (row.case, row.method): row
            for row in rows
            if row.quantity == FALSE_PLAIN
            and (row.case, row.method) in violated
            and row.method != BROKEN
        }
    figures = shares | {name: before_after.measured(place) for name, place in BESIDE.items()}
    lines = [
        f"    ({json.dumps(quantity)}, {json.dumps(name)}):"
        f" ({100.0 * figure.value:.3g}, {100.0 * figure.error:.2g}),\n"
        for (quantity, name), figure in figures.items()
    ]
    return f"{_HEAD}{''.join(lines)}}}\n"


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
