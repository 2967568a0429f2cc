"""A photon counter with dead time, event by event."""

from __future__ import annotations

import numpy as np


def registered(arrivals, dead_time, paralyzable=False):
    """Return the arrival times, rising, at which the counter counts.

    A paralyzable counter is blind after every event, another one after counted events only.
    """
    if paralyzable:
        return arrivals[np.diff(arrivals, prepend=-1.0) >= dead_time]
    kept, last = [], -1.0
    for arrival in arrivals.tolist():
        if arrival - last >= dead_time:
            kept.append(arrival)
            last = arrival
    return np.array(kept)


def counts(rate, *, bins, bin_time, shots, dead_time, random, paralyzable=False):
    """Return the counts of steady light of a rate in Hz, summed over shots, (bins,)."""
    edges = np.arange(bins + 1) * bin_time
    total = np.zeros(bins, np.int64)
    for _ in range(shots):
        # The counter has been at work for some time before the first bin.
        start = -20.0 * dead_time
        span = edges[-1] - start
        arrivals = start + span * np.sort(random.random(random.poisson(rate * span)))
        total += np.histogram(registered(arrivals, dead_time, paralyzable), edges)[0]
    return total
