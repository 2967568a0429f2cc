"""Draw the picture of the README from raw Licel files: ``python docs/overview.py RAW``.

RAW is the folder of 28 September 2017 of Sao Paulo (``signalsTest/Brazil/SPU`` of the repository
``juanpallotta/LPP``, MIT). The campaign is as ``lidarops init`` drafts it, and the panels are those
of ``lidarops plot``, side by side.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import replace
from importlib import reload
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib as mpl
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.figures import stills
from lidarops.figures.panels import COLOURS, Axis, Band, Curve, Figure, Panel
from lidarops.reports.plotting import draw_file, selection

HERE = Path(__file__).resolve().parent
STATION, HIGHEST = 0.757, 6.0
"""Altitudes, km."""


def figure(products: Path) -> Figure:
    """Return the signal against time and altitude, beside the profile retrieved from it."""
    chosen = selection("", "", "", f"{STATION}/{HIGHEST}")
    signal, *_ = draw_file(next(products.glob("**/*_signal_analog_532o_*.nc")), chosen)
    *_, profile = draw_file(next(products.glob("**/*_elastic_glued_532o_*.nc")), chosen)
    height = Axis("altitude (km)", STATION, HIGHEST)
    panels = signal.panels[0], above_the_sea(profile.panels[0])
    return Figure(
        "Sao Paulo, 28 September 2017, 532 nm",
        f"{signal.words}; {profile.words}",
        tuple(replace(panel, y=height) for panel in panels),
        beside=True,
    )


def above_the_sea(panel: Panel) -> Panel:
    """Return a profile over range as one over altitude."""
    layers: list[Band | Curve] = []
    for layer in panel.layers:
        if isinstance(layer, Band):
            layers.append(replace(layer, along=layer.along + STATION))
        elif isinstance(layer, Curve):
            layers.append(replace(layer, y=layer.y + STATION))
    return replace(panel, layers=tuple(layers))


def pictures(drawn: Figure) -> Iterator[tuple[str, bytes]]:
    """Give names and contents of the picture for light and for dark pages."""
    every = dict(COLOURS)
    for page, name in enumerate(("overview.png", "overview-dark.png")):
        COLOURS.update({key: (both[page],) * 2 for key, both in every.items()})
        ink, paper = COLOURS["ink"][0], COLOURS["page"][0]
        texts = ("text.color", "axes.labelcolor", "xtick.color", "ytick.color")
        mpl.rcParams |= dict.fromkeys(texts, ink)
        mpl.rcParams |= dict.fromkeys(("figure.facecolor", "axes.facecolor"), paper)
        # Its style holds colours.
        yield name, reload(stills).still(drawn, ".png")


def main(raw: str) -> None:
    """Write ``overview.png`` and ``overview-dark.png`` beside this script."""
    archive = str(Path(raw).resolve())
    with TemporaryDirectory() as folder, chdir(folder):
        for words in (["init", archive, "first.yaml"], ["reprocess", "first.yaml"]):
            CliRunner().invoke(app, words, catch_exceptions=False)
        drawn = figure(Path("out/products"))
    for name, content in pictures(drawn):
        (HERE / name).write_bytes(content)


if __name__ == "__main__":
    main(*sys.argv[1:])
