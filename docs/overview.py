"""Draw the figure of the README from the products of the demo: ``python docs/overview.py``."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import xarray as xr

from lidarops.figures.kind_figures import figures_of
from lidarops.figures.panels import Curve, Figure, Panel
from lidarops.figures.raster import COLUMNS
from lidarops.figures.stills import still
from lidarops.figures.time_axis import days

DEMO = Path(sys.argv[1] if sys.argv[1:] else Path(__file__).resolve().parents[1] / "demo")


def _panel(kind: str) -> Panel:
    """Return the main panel of all products of a kind."""
    files = sorted(DEMO.glob(f"products/coast/*/{kind}/*/*_photon_532o_*.nc"))
    figures = figures_of(kind)
    if figures is None or not files:
        raise SystemExit(f"{DEMO} holds no {kind} products: run make demo")
    view = figures.views[0]
    contents = [view.read(xr.load_dataset(file), COLUMNS) for file in files]
    figure, *_ = view.draw([content for content in contents if content is not None])
    return figure.panels[0]


def main() -> None:
    """Write ``docs/overview.svg``."""
    truth = xr.load_dataset(DEMO / "raw" / "truth.nc")
    truth = truth.isel(granule=truth["instrument"].values == "coast-horizontal").sortby("time")
    place, true_values = days(truth["time"].values), 1e3 * truth["total_extinction"].values
    curve = Curve(place, true_values, "ink d1", label="simulated truth")
    signal, extinction = _panel("signal"), _panel("homogeneous")
    extinction = replace(extinction, x=signal.x, layers=(*extinction.layers, curve))
    figure = Figure("One day of the demo", "extinction and signal", (extinction, signal))
    Path(__file__).with_suffix(".svg").write_bytes(still(figure, ".svg"))


if __name__ == "__main__":
    main()
