"""The memory that a plan states for a Raman product is what means and retrieval take."""

from __future__ import annotations

import tracemalloc

import pytest

from benchmarks.throughput.raman_night import night, night_signals, screened_average
from lidarops.products.raman.retrieval import bytes_held
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman import labeled
from lidarops.retrieve.raman.settings import RamanReference, RamanSettings

WINDOW = RamanReference(lowest=3000.0, highest=6500.0)
NAMES = ("355", "387")


def peak(means: int, bins: int, cell: float) -> tuple[float, int]:
    """Return the peak of bytes beyond the profiles, and the number of cells."""
    counts = night(30 * means, bins)
    profiles = [profile.load() for profile in night_signals(counts, NAMES)]
    tracemalloc.start()
    average = screened_average(counts, NAMES)
    average.add(profiles)
    ((elastic, raman),) = average.completed()
    product = labeled.retrieve(
        elastic.assign_coords(zenith_angle=0.0),
        raman,
        molecules=MolecularProfile.us_standard(),
        station_altitude=100.0,
        wavelengths=(355e-9, 387e-9),
        settings=RamanSettings(cell=cell, highest=float(counts["range"][-1]), reference=WINDOW),
    )
    highest = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return float(highest), product.sizes["range"]


@pytest.mark.parametrize(("means", "bins", "cell"), [(8, 1000, 15.0), (8, 4000, 300.0)])
def test_the_stated_memory_is_that_of_means_and_retrieval(means, bins, cell):
    peak(1, bins, cell)  # Compiles, and fills caches.
    highest, cells = peak(means, bins, cell)
    assert 0.6 < highest / bytes_held(len(NAMES), means, bins, cells) < 1.1
