"""Regenerate ``docs/accuracy.md``: ``python docs/accuracy_table.py BENCH/result.json``.

The file is that of ``lidarops bench accuracy --out BENCH``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from lidarops.bench.harness.rows import Row, Unit, table

PAGE = Path(__file__).with_name("accuracy.md")
BEST = "The most accurate of our methods and of the peers"
HEAD = """# Error against run time

From `lidarops bench accuracy`: RMSE with its Monte Carlo error, share of the values in the stated
95 % interval, and CPU time of a profile on one core ({processor}, shared), of one run ({date}).

"""


def page(result: dict[str, Any]) -> str:
    """Return the page of a result of the benchmark."""
    rows = [Row(**{**row, "unit": Unit(row["unit"])}) for row in result["tables"][BEST]]
    best = table(BEST, rows, case="RMSE of")
    lines = [best.columns, tuple("---" for _ in best.columns), *best.rows]
    head = HEAD.format(processor=result["machine"]["processor"], date=result["date"])
    return head + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))), "utf-8")
