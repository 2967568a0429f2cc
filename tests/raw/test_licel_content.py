"""Counts that contradict the header of their file, or that are lost, refuse it."""

from __future__ import annotations

import numpy as np
import pytest
from support.archives import raw_archives

from lidarops.errors import RawFormatError
from lidarops.raw.formats import parse_raw_header

BINS = 1500
SHOTS = 600
FULL = SHOTS * 4095


def _parsed(analog: np.ndarray, photon: np.ndarray, old: bytes = b"", new: bytes = b"") -> None:
    """Read a whole file with these counts, in which the header is changed."""
    head, _, _ = raw_archives.content(0.0, bins=BINS).partition(b"\r\n\r\n")
    blocks = [counts.astype("<i4").tobytes() + b"\r\n" for counts in (analog, photon)]
    content = b"".join([head.replace(old, new), b"\r\n\r\n", *blocks])
    parse_raw_header(content, file="a", size=len(content))


def _analog(seed: int = 1) -> np.ndarray:
    """A signal of up to 0.9 of full scale."""
    light = 0.9 * FULL * np.exp(-np.arange(BINS) / 200.0)
    return np.round(light + np.random.default_rng(seed).normal(9000, 50, BINS))


def _photon(rate: float) -> np.ndarray:
    return np.random.default_rng(2).poisson(rate, BINS)


@pytest.mark.parametrize(
    ("old", "new"), [(b" 12 000600 0.5", b" 11 000600 0.5"), (b"000600", b"000200")]
)
def test_counts_beyond_full_scale_are_refused(old: bytes, new: bytes) -> None:
    analog, photon = _analog(), _photon(9.0)
    _parsed(analog, photon)
    with pytest.raises(RawFormatError, match=r"shots or ADC bits of analog_532o: \d+ bins hold"):
        _parsed(analog, photon, old, new)


def test_a_single_bin_may_be_wrong_in_itself() -> None:
    analog = _analog()
    analog[700] = 3 * FULL
    _parsed(analog, _photon(9.0))


def test_signals_scaled_to_32_bits_are_no_counts_of_a_recorder() -> None:
    analog = np.linspace(1.0, np.iinfo(np.int32).max, BINS)
    _parsed(analog, _photon(9.0))


@pytest.mark.parametrize("channel", ["analog_532o", "photon_532o"])
def test_a_block_of_zeros_among_counts_is_refused(channel: str) -> None:
    counts = {"analog_532o": _analog(), "photon_532o": _photon(30.0)}
    counts[channel][500:628] = 0
    with pytest.raises(RawFormatError, match=f"counts of {channel}: bins 500 to 627"):
        _parsed(*counts.values())
    counts[channel][1400:] = 0
    with pytest.raises(RawFormatError, match=f"counts of {channel}: bins 500 to 627"):
        _parsed(*counts.values())
    # Fewer than a disk loses, or with zeros beside them.
    counts[channel][500] = 1
    _parsed(*counts.values())
    counts[channel][499:628] = 0
    counts[channel][640] = 0
    _parsed(*counts.values())


@pytest.mark.parametrize("lost", [slice(None), slice(1000, None), slice(0, 200)])
def test_a_recorder_that_is_off_or_stops_early_is_read(lost: slice) -> None:
    """Profiles of zeros only are flagged as missing (`analog_signal`)."""
    analog = _analog()
    analog[lost] = 0
    _parsed(analog, _photon(30.0))


def test_few_photons_are_no_lost_block() -> None:
    photon = _photon(0.01)
    photon[300:500] = 0
    _parsed(_analog(), photon)
