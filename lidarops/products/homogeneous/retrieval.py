"""The product ``homogeneous``: its decision, and its making."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np
import xarray as xr

from lidarops.constants import CUBIC_PAPER, LEAST_SQUARES_PAPER
from lidarops.flags import Quality
from lidarops.products.homogeneous import HomogeneousSettings, Method, PathAssumptions
from lidarops.products.homogeneous.variables import LAYOUT
from lidarops.records import DetectionMode, is_glued
from lidarops.retrieve.air.visibility import VisibilityDefinition, visibility_of_extinction
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.homogeneous import labeled
from lidarops.retrieve.homogeneous.path_fit import Noise
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH, baseline_error, counts_per_power
from lidarops.scene.case import ALL_STEPS, REQUESTED, ChannelCase, Entries, Entry, NoSettings
from lidarops.scene.profiles import ChannelSignal, Chunk, ProductStream
from lidarops.scene.retrieval import (
    ANALOG_NOISE,
    WINDOW,
    Retrieval,
    WindowSettings,
    bins_within,
    moves,
    tail,
)
from lidarops.settings import SettingsModel, quantity

Case = ChannelCase[HomogeneousSettings]

Section = tuple[float, float]

LEVEL: Final = THRESHOLDS.level * (1.0 + 1e-6)
"""m, largest climb along a section. Headers and campaign files round angles differently."""


def _method(case: Case, level: Sequence[Section]) -> Method:
    """Return the method that runs: `auto` is the direct fit, or of a moving beam the far range.

    A beam of a scan has few shots, and a section cannot tell its background from its extinction.
    Bins of the far range are no part of a section.
    """
    if case.request.method != "auto":
        return case.request.method
    start = tail(case, None)[0]
    apart = all(far <= start for _, far in level)
    return "known_background" if apart and moves(case) else "direct"


def _window(case: Case, level: Sequence[Section], method: Method) -> Entry:
    """Read only the bins that the sections of a photon-counting channel need."""
    if case.channel.mode is not DetectionMode.PHOTON:
        return case.leave(WINDOW, ANALOG_NOISE)
    if case.all_steps:
        return case.leave(WINDOW, ALL_STEPS)
    if method == "known_background" and not case.request.background:
        return case.leave(WINDOW, "the background is that of the far range")
    bins = bins_within(0.0, max(far for _, far in level), case)[1]
    if not 0 < bins < case.channel.bins:
        reason = "a section extends to the last bin"
        return case.leave(WINDOW, reason, number=float(case.channel.bins))
    reason = "neither homogeneous sections nor the noise of their counts need farther bins"
    return case.run(WINDOW, reason, WindowSettings(bins=((0, bins),)), number=float(bins))


class PathSettings(PathAssumptions):
    """Settings of the entry ``homogeneous``, whose method is the one that runs."""

    sections: tuple[Section, ...] = quantity(unit="m")
    background_range: tuple[float, float] | None = quantity(
        None, unit="m", description="far range of `known_background`"
    )
    background: tuple[float, float] | None = quantity(
        None, unit="MHz or mV", description="given one of `known_background`, and its error"
    )


class HomogeneousPlan(SettingsModel):
    """What a plan states of a product."""

    range_window: WindowSettings | None = None
    along_path: NoSettings | None = None
    homogeneous: PathSettings


_BACKGROUNDS: Final = {
    "known_background": "comes from the far range",
    "known_extinction": "is retrieved at the extinction of the campaign",
    "cubic": "is that of the cubic",
}
"""Where the background comes from, by method, unless from the section with extinction."""
_PAPERS: Final = {
    "cubic": CUBIC_PAPER,
    **dict.fromkeys(("linearized", "known_background", "known_extinction"), LEAST_SQUARES_PAPER),
}
"""Papers of the methods that have one."""
_WARNINGS: Final = {
    # `test_the_cubic_needs_a_strong_signal`
    "cubic": "the cubic rejects all values where the signal of the first bin of a section is less"
    " than 30 times its noise, and some up to 300 times",
}
"""What `lidarops plan` warns of, by method."""


def _needs(case: Case) -> Entries:
    """Retrieve background, amplitude and extinction of range sections.

    Of those that lie within the bins, along a nearly level path.
    """
    if is_glued(case.channel.name):
        reason = "not made of glued channels: each record is fitted with its own background"
        yield case.leave("homogeneous", reason, rule="channel_present")
        return
    request, files = case.request, len(case.scene.granules)
    # Those that a fit needs, and a triple of the cubic.
    lagged = 0 if request.lag is None else 2 * request.lag + 1
    fewest = max(COMMON.fewest_bins, lagged)
    inside = [
        (near, far)
        for near, far in request.sections
        if far <= case.last and (far - near) / case.channel.bin_width >= fewest
    ]
    # Climbs of the beam of each file, m: infinite where its zenith angle is unknown, so that the
    # beam does not count as level.
    angles = [granule.zenith_angle for granule in case.scene.granules]
    rises = [math.inf if a is None else abs(math.cos(math.radians(a))) for a in angles]
    climbs = {(near, far): [(far - near) * rise for rise in rises] for near, far in inside}
    steep = {section: sum(height > LEVEL for height in climbs[section]) for section in inside}
    level = [section for section in inside if case.all_steps or steep[section] < files]
    method = _method(case, level)
    if level:
        yield _window(case, level, method)
        if (visibility := request.visibility) is None:
            reason = "the campaign requests no visibility along the sections"
            yield case.leave("along_path", reason)
        else:
            reason = "the campaign requests visibility along the sections"
            yield case.run("along_path", reason, number=visibility.threshold)
    for section in request.sections:
        if section not in inside:
            yield _outside(case, *section, fewest)
    for section in inside:
        if section not in level:
            yield _slanted(case, *section, min(climbs[section]))
        elif steep[section]:
            yield _partly_slanted(case, *section, steep[section])
    if level:
        yield _retrieved(case, level, method)


def _retrieved(case: Case, level: list[Section], method: Method) -> Entry:
    settings = case.request
    definition = settings.visibility
    given = (settings.background or {}).get(case.channel.name)
    far = method == "known_background" and given is None
    return case.run(
        "homogeneous",
        f"{REQUESTED}; background {_whence(settings, method)}",
        PathSettings.taken_from(
            settings,
            method=method,
            sections=tuple(level),
            background_range=tail(case, settings.background_range) if far else None,
            background=given,
            visibility=definition and definition.resolved,
        ),
        needs=("read", "overlap", "noise", WINDOW, "along_path"),
        number=float(len(level)),
        warning=_WARNINGS.get(settings.method, ""),
    )


def _whence(settings: HomogeneousSettings, method: Method) -> str:
    """Return in words where the background comes from."""
    if settings.background:
        return "is given by the campaign"
    whence = _BACKGROUNDS.get(method, "is retrieved together with extinction")
    if method == "known_background" and settings.method == "auto":
        return f"{whence}, because the beam moves and the sections end before it"
    return whence if settings.lag is None else f"{whence} with a lag of {settings.lag} bins"


def _outside(case: Case, near: float, far: float, fewest: int) -> Entry:
    bins = (min(far, case.last) - near) / case.channel.bin_width
    reason = (
        f"section {near:g}-{far:g} m extends beyond the last bin at {case.last:g} m, or"
        f" holds fewer than {fewest} bins"
    )
    if fewest > COMMON.fewest_bins and far <= case.last:
        reason = (
            f"section {near:g}-{far:g} m holds {bins:.0f}, fewer than {fewest} bins, which the"
            f" cubic needs for lag: {case.request.lag}"
        )
    return case.leave("homogeneous", reason, number=bins, rule="section_inside")


def _slanted(case: Case, near: float, far: float, least: float) -> Entry:
    slope = (
        "neither headers nor campaign give the zenith angle"
        if math.isinf(least)
        else f"the beam climbs {least:.0f} m (limit {THRESHOLDS.level:g} m)"
    )
    reason = f"section {near:g}-{far:g} m: {slope}; a vertical gradient would mimic extinction"
    number = None if math.isinf(least) else least
    return case.leave("homogeneous", reason, number=number, rule="section_level")


def _partly_slanted(case: Case, near: float, far: float, steep: int) -> Entry:
    reason = (
        f"section {near:g}-{far:g} m: values of {steep} of {len(case.scene.granules)} files are"
        f" rejected, whose beams climb more than {THRESHOLDS.level:g} m; a vertical gradient would"
        " mimic extinction"
    )
    return case.leave("homogeneous", reason, number=float(steep), rule="beam_level")


class _Sections(ProductStream):
    """Values of the sections of each profile."""

    def __init__(self, settings: HomogeneousPlan, signal: ChannelSignal) -> None:
        self._settings, self._signal = settings.homogeneous, signal

    def add(self, chunk: Chunk) -> list[xr.Dataset]:
        """Return the sections of the next profiles, with visibility where it is requested."""
        settings, profiles = self._settings, self._signal.profiles
        shots = profiles.shots(chunk.counts)
        sections = self._retrieved(chunk.profiles(profiles), shots)
        slanted = labeled.not_level(sections, chunk.geometry["zenith_angle"])
        stated = settings.slope_error
        stated = THRESHOLDS.model_error if stated is None else stated
        # Errors of the model are proportional to it.
        scale = stated / THRESHOLDS.model_error
        errors = {
            name: scale * sections[name]
            for name in ("total_extinction_model_error", "background_model_error")
        }
        sections = sections.assign(
            {
                **errors,
                "quality_flag": sections["quality_flag"] | slanted,
                "shots": shots,
                "slope_error": stated,
                "retrieval_method": LAYOUT.rows["retrieval_method"].code(settings.method),
            }
        )
        if settings.visibility is not None:
            wavelength = self._signal.wavelength
            definition = VisibilityDefinition(wavelength, **dict(settings.visibility))
            sections = _with_visibility(sections, definition)
        rows = sections.assign_coords(chunk.geometry.variables)
        if chunk.rows.start:
            return [rows]
        paper = _PAPERS.get(settings.method)
        frame = sections.drop_dims("time").assign_attrs(references=paper or "")
        return [frame.assign_coords(self._signal.source.geometry.variables), rows]

    def _retrieved(self, conditioned: xr.Dataset, shots: xr.DataArray) -> xr.Dataset:
        settings, quality = self._settings, conditioned["quality"]
        overlap = self._signal.overlap_at(conditioned["range"].to_numpy())
        if overlap is not None:
            # The signal still holds its background, so it cannot be divided by the overlap: bins
            # with partial overlap are excluded.
            partial_overlap = np.where(
                overlap >= THRESHOLDS.full_overlap, 0, int(Quality.INCOMPLETE_OVERLAP)
            )
            quality = quality | xr.DataArray(partial_overlap.astype(np.int32), dims="range")
        # An estimated variance scatters, which must not count as misfit.
        estimated = self._signal.relative_variance
        counts = None if estimated else counts_per_power(conditioned, shots, glued=True)
        fit = partial(
            labeled.fit_homogeneous_path,
            sections=settings.sections,
            background_range=settings.background_range,
            background=settings.background,
            lag=settings.lag,
            variance=conditioned["variance"],
            quality=quality,
            method=settings.method,
            extinction=settings.extinction,
            noise=Noise(
                relative=estimated,
                correlation_length=conditioned[CORRELATION_LENGTH],
                exposure=None if counts is None else xr.DataArray(counts, dims="time"),
            ),
        )
        fitted = fit(conditioned["power"])
        error = baseline_error(conditioned, decaying=True)
        if error is None:
            return fitted
        power = conditioned["power"]
        moved = fit((power + error).assign_attrs(power.attrs))
        name = "total_extinction"
        return fitted.assign({f"{name}_baseline_error": np.abs(moved[name] - fitted[name])})


def _with_visibility(sections: xr.Dataset, definition: VisibilityDefinition) -> xr.Dataset:
    systematic = sections["total_extinction_model_error"]
    if "total_extinction_baseline_error" in sections:
        of_baseline = sections["total_extinction_baseline_error"].fillna(0.0)
        systematic = (systematic**2 + of_baseline**2) ** 0.5
    visibility = visibility_of_extinction(
        sections["total_extinction"].to_numpy(),
        sections["total_extinction_standard_error"].to_numpy(),
        systematic.to_numpy(),
        definition,
    )
    along = {name: (systematic.dims, values) for name, values in visibility.items()}
    return sections.assign(along).assign_attrs(steps=definition.words)


RETRIEVAL: Final = Retrieval(settings=HomogeneousPlan, needs=_needs, stream=_Sections)
