"""Draw the figure of the README from the products of the demo: ``python docs/overview.py``."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from lidarops.products.homogeneous.report_figures import overview

DEMO = Path(__file__).resolve().parents[1] / "demo"


def _day(kind: str) -> xr.Dataset:
    files = sorted(DEMO.glob(f"products/coast/*/{kind}/*/*_photon_532o_*.nc"))
    parts = [xr.load_dataset(file) for file in files]
    return xr.concat(parts, dim="time", data_vars="minimal", coords="minimal", compat="override")


def main() -> None:
    """Write ``docs/overview.png``."""
    truth = xr.load_dataset(DEMO / "raw" / "truth.nc")
    truth = truth.isel(granule=(truth["instrument"] == "coast-horizontal").values)
    figure = overview(_day("homogeneous"), truth, _day("signal"))
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=100)


if __name__ == "__main__":
    main()
