"""Draw the figure of the README from the products of the demo: ``python docs/overview.py``."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import xarray as xr

from lidarops.figures.kind_figures import ProductSource, figures_of
from lidarops.figures.panels import Figure, Panel
from lidarops.figures.stills import still

DEMO = Path(sys.argv[1] if sys.argv[1:] else Path(__file__).resolve().parents[1] / "demo")


def _panel(kind: str, source: ProductSource) -> Panel:
    """Return the main panel of all products of a kind."""
    files = sorted(DEMO.glob(f"products/coast/*/{kind}/*/*_photon_532o_*.nc"))
    figures = figures_of(kind)
    if figures is None or not files:
        raise SystemExit(f"{DEMO} holds no {kind} products: run make demo")
    view = figures.views[0]
    contents = [view.read(xr.load_dataset(file), source) for file in files]
    figure, *_ = view.draw([content for content in contents if content is not None])
    return figure.panels[0]


def main() -> None:
    """Write ``docs/overview.svg``."""
    truth = xr.load_dataset(DEMO / "raw" / "truth.nc")
    source = ProductSource("coast-horizontal", "photon_532o", truth=truth)
    signal = _panel("signal", source)
    extinction = replace(_panel("homogeneous", source), x=signal.x)
    figure = Figure("One day of the demo", "extinction and signal", (extinction, signal))
    Path(__file__).with_suffix(".svg").write_bytes(still(figure, ".svg"))


if __name__ == "__main__":
    main()
