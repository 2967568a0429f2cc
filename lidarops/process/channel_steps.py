"""Carry out the steps of a plan for one channel: from raw counts to the data of its products."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from dask.base import compute

from lidarops.campaign.ancillary_files import Ancillaries
from lidarops.flags import Quality
from lidarops.plan import scan_rules
from lidarops.plan.preview import OMITTED
from lidarops.plan.rules import WHOLE, StepName
from lidarops.plan.signal_rules import GLUED, glued_parts
from lidarops.records import Plan, Step
from lidarops.retrieve.air import labeled as labeled_visibility
from lidarops.retrieve.air.labeled import Definition
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.elastic import labeled as labeled_elastic
from lidarops.retrieve.homogeneous import labeled
from lidarops.retrieve.multiangle import labeled as labeled_multiangle
from lidarops.retrieve.multiangle import labeled_altitudes
from lidarops.retrieve.signal import (
    labeled as labeled_signal,
)
from lidarops.retrieve.signal import (
    labeled_averaging,
    labeled_gluing,
)

Array = npt.NDArray[np.float64]

FULL_OVERLAP: Final = 0.99
"""Smallest overlap at which a homogeneous section may begin."""

IN_MEMORY: Final = 2_000_000
"""Bytes of counts up to which a scene is loaded at once: below, lazy arrays cost more than they
save; above, the arrays no longer fit into the processor cache."""
_GEOMETRY: Final = ("time", "time_bnds", "zenith_angle", "azimuth")


@dataclass(frozen=True, slots=True)
class SceneData:
    """The data of a scene on which the steps of all its channels work."""

    plan: Plan
    archive: xr.Dataset
    """Raw counts of the scene, lazy."""
    dark: xr.Dataset | None
    """Raw counts of its dark files, lazy."""
    ancillaries: Ancillaries
    station_altitude: float
    """m above mean sea level."""

    def steps(self, channel: str) -> Mapping[str, Step]:
        """Return the steps of a channel by name."""
        return {step.name: step for step in self.plan.steps if step.channel == channel}


def process_channel(scene_data: SceneData, channel: str) -> dict[str, xr.Dataset]:
    """Carry out the steps of a channel.

    Parameters
    ----------
    scene_data : SceneData
    channel : str

    Returns
    -------
    dict of str to xr.Dataset
        In memory, with the variables of `lidarops.netcdf.variables` and the geometry of the beam.

    Raises
    ------
    LidarOpsError
        If the data do not agree with the plan.
    """
    steps = scene_data.steps(channel)
    if _is_read(steps):
        read = glued_parts(channel) if channel.startswith(GLUED) else (channel,)
        scene_data = load_small(scene_data, read)
    source = channel_source(scene_data, channel)
    lazy: dict[str, xr.Dataset] = {}
    if StepName.SIGNAL in steps:
        lazy["signal"] = _signal(source, steps, scene_data.ancillaries)
    if StepName.HOMOGENEOUS in steps:
        lazy["homogeneous"] = _homogeneous(scene_data, channel, source)
    for kind, data in lazy.items():
        lazy[kind] = data.assign(shots=source.shots).assign_coords(source.geometry.variables)
    if StepName.ELASTIC in steps:
        lazy["elastic"] = source.averages(steps[StepName.AVERAGE].settings["seconds"])
    if StepName.MULTIANGLE in steps:
        lazy["multiangle"] = _beams(source, steps, scene_data)
    # Computed together, so that the products of a channel share one reading of the files.
    computed = dict(zip(lazy, compute(*lazy.values()), strict=True))  # type: ignore[no-untyped-call]
    sections = computed.get("homogeneous")
    if sections is not None and "visibility" in steps[StepName.HOMOGENEOUS].settings:
        computed["homogeneous"] = _with_visibility(sections, steps)
    if "elastic" in computed:
        averages = source.glued(computed["elastic"])
        computed["elastic"] = _elastic(averages, steps, scene_data)
    if "multiangle" in computed:
        settings = steps[StepName.MULTIANGLE].settings
        computed["multiangle"] = labeled_multiangle.retrieve_optical_depth(
            computed["multiangle"],
            station_altitude=scene_data.station_altitude,
            method=settings["method"],
            largest_gradient=settings["largest_gradient"],
            layers=[
                (low + scene_data.station_altitude, high + scene_data.station_altitude)
                for low, high in settings["layers"]
            ],
        )
    return computed


def load_small(scene_data: SceneData, channels: Sequence[str]) -> SceneData:
    """Return the data with the counts of channels in memory, if they are at most `IN_MEMORY`."""
    counts = scene_data.archive[[name for name in channels if name in scene_data.archive]]
    if counts.nbytes > IN_MEMORY:
        return scene_data
    return replace(scene_data, archive=scene_data.archive.assign(counts.compute()))


def _is_read(steps: Mapping[str, Step]) -> bool:
    """Whether a step uses the counts of the channel."""
    if any(name in steps for name in WHOLE):
        return True
    settings = steps[StepName.HOMOGENEOUS].settings if StepName.HOMOGENEOUS in steps else {}
    return len(settings.get(OMITTED, ())) < len(settings.get("sections", ()))


def channel_source(scene_data: SceneData, channel: str) -> FileChannel | GluedChannel:
    """Return the source of the profiles of a channel."""
    kind = GluedChannel if channel.startswith(GLUED) else FileChannel
    return kind(scene_data, channel)


class FileChannel:
    """A channel that the files hold."""

    def __init__(self, scene_data: SceneData, channel: str) -> None:
        self._channel = channel
        archive, steps = scene_data.archive, scene_data.steps(channel)
        self._dark: labeled_signal.DarkSignals | None = None
        if scene_data.dark is not None and StepName.DARK in steps:
            method = steps[StepName.DARK].settings["method"]
            self._dark = labeled_signal.read_dark(scene_data.dark, channel, method=method)
        self._archive = archive
        self._settings = {
            "dead_time": _setting(steps, StepName.DEAD_TIME, "dead_time"),
            "noise_variance": _setting(steps, StepName.NOISE, "noise_variance"),
            "dark": self._dark,
            "range_offset": _setting(steps, StepName.RANGE_OFFSET, "range_offset") or 0.0,
            "full_overlap_range": _setting(steps, StepName.OVERLAP, "full_overlap_range") or 0.0,
        }
        self.geometry = archive[[name for name in _GEOMETRY if name in archive]]
        self.shots = archive[f"{channel}_shots"]

    def profiles(self) -> xr.Dataset:
        """Return power, variance and quality of every profile."""
        return labeled_signal.condition(self._archive, self._channel, **self._settings)

    def signals(self, background_range: tuple[float, float]) -> xr.Dataset:
        """Return background-subtracted, range-corrected signals of every profile."""
        return labeled_signal.range_corrected_signals(
            self._archive, self._channel, background_range=background_range, **self._settings
        )

    def averages(self, seconds: float) -> xr.Dataset:
        """Return means over clock intervals."""
        conditioned = self.profiles().assign_coords(self.geometry.variables)
        shared = None if self._dark is None else self._dark.variance
        averages = labeled_averaging.clock_average(
            conditioned, seconds=seconds, shots=self.shots, shared_variance=shared
        )
        angles = {
            name: float(self.geometry[name][0])
            for name in ("zenith_angle", "azimuth")
            if name in self.geometry
        }
        return averages.assign_coords(angles)

    def glued(self, averages: xr.Dataset) -> xr.Dataset:
        """Return computed averages as they are: there is nothing to glue."""
        return averages


class GluedChannel:
    """A channel that is glued from an analog and a photon-counting one."""

    def __init__(self, scene_data: SceneData, channel: str) -> None:
        steps = scene_data.steps(channel)
        parts = steps[StepName.GLUE].settings
        self._analog = FileChannel(scene_data, parts["analog"])
        self._photon = FileChannel(scene_data, parts["photon"])
        self.geometry, self.shots = self._photon.geometry, self._photon.shots
        self._lag = self._find_lag(steps.get(StepName.LAG))

    def profiles(self) -> xr.Dataset:
        """Return power, variance and quality of every profile."""
        return labeled_gluing.glue(self._analog.profiles(), self._photon.profiles(), lag=self._lag)

    def signals(self, background_range: tuple[float, float]) -> xr.Dataset:
        """Return background-subtracted, range-corrected signals of every profile."""
        joined = self.profiles()
        return labeled_signal.correct_for_range(joined, background_range).assign(_gluing(joined))

    def averages(self, seconds: float) -> xr.Dataset:
        """Return means over clock intervals, of both parts of the channel."""
        parts = {"analog": self._analog, "photon": self._photon}
        named = [
            part.averages(seconds).rename(
                {name: f"{prefix}_{name}" for name in ("power", "variance", "quality")}
            )
            for prefix, part in parts.items()
        ]
        shortest = min(part.sizes["range"] for part in named)
        analog, photon = (part.isel(range=slice(shortest)) for part in named)
        only = analog[[f"analog_{name}" for name in ("power", "variance", "quality")]]
        return photon.assign({name: (v.dims, v.data, v.attrs) for name, v in only.items()})

    def glued(self, averages: xr.Dataset) -> xr.Dataset:
        """Return computed averages of both parts, glued to one channel."""
        parts = [
            averages.rename(
                {f"{prefix}_{name}": name for name in ("power", "variance", "quality")}
            )[["power", "variance", "quality"]]
            for prefix in ("analog", "photon")
        ]
        glued = labeled_gluing.glue(*parts, lag=self._lag)
        parted = [name for name in averages if str(name) not in ("shots", "profiles")]
        return averages.drop_vars(parted).assign(glued.variables)

    def _find_lag(self, step: Step | None) -> float:
        parts = self._analog.profiles(), self._photon.profiles()
        if step is not None and step.settings["method"] == "estimate":
            return labeled_gluing.estimate_lag(*parts)
        # A given lag has already shifted the ranges of the analog part.
        return labeled_gluing.range_lag(*parts)


def _setting(steps: Mapping[str, Step], name: StepName, key: str) -> Any:
    step = steps.get(name)
    return None if step is None else step.settings.get(key)


def _signal(
    source: FileChannel | GluedChannel, steps: Mapping[str, Step], ancillaries: Ancillaries
) -> xr.Dataset:
    start, stop = steps[StepName.BACKGROUND].settings["range"]
    result = source.signals((start, stop))
    overlap = overlap_at(steps, ancillaries, result["range"].to_numpy())
    if overlap is None:
        return result
    along = xr.DataArray(overlap.astype(np.float32), dims="range")
    lost = along.isnull().astype(np.int32) * np.int32(Quality.INCOMPLETE_OVERLAP)
    return result.assign(
        signal=result["signal"] / along,
        signal_standard_error=result["signal_standard_error"] / along,
        quality_flag=result["quality_flag"] | lost,
    )


def _gluing(profiles: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the variables that describe the gluing; none where profiles are not glued."""
    return {str(name): array for name, array in profiles.items() if str(name).startswith("glue_")}


def _homogeneous(
    scene_data: SceneData, channel: str, source: FileChannel | GluedChannel
) -> xr.Dataset:
    steps = scene_data.steps(channel)
    settings = steps[StepName.HOMOGENEOUS].settings
    omitted = {(near, far): Quality[bit] for near, far, bit in settings.get(OMITTED, ())}
    sections = [(near, far) for near, far in settings["sections"]]
    kept = [section for section in sections if section not in omitted]
    parts = []
    if kept:
        parts.append(_retrieved(source.profiles(), kept, steps, scene_data.ancillaries))
    if omitted:
        unit = labeled_signal.channel_unit(scene_data.archive, channel)
        parts.append(_empty_sections(source.shots, unit, omitted))
    result = parts[0]
    if len(parts) > 1:
        order = [[*kept, *omitted].index(section) for section in sections]
        number = np.arange(len(sections), dtype=np.int32)
        joined: xr.Dataset = xr.concat(parts, dim="section")
        result = joined.isel(section=order).assign_coords(section=("section", number))
    slanted = labeled.not_level(result, source.geometry["zenith_angle"])
    return result.assign(quality_flag=result["quality_flag"] | slanted)


def _empty_sections(
    shots: xr.DataArray, unit: str, omitted: Mapping[tuple[float, float], Quality]
) -> xr.Dataset:
    """Return omitted sections, without values but with their quality bits."""
    empty = labeled.empty_fit(shots, unit=unit, sections=list(omitted))
    bits = np.array([int(bit) for bit in omitted.values()], dtype=np.int32)
    missing = np.where(shots.to_numpy() > 0, np.int32(0), np.int32(Quality.INPUT_MISSING))
    flags = bits | missing[:, np.newaxis]
    return empty.assign(quality_flag=empty["quality_flag"].copy(data=flags))


def _retrieved(
    conditioned: xr.Dataset,
    sections: list[tuple[float, float]],
    steps: Mapping[str, Step],
    ancillaries: Ancillaries,
) -> xr.Dataset:
    quality = conditioned["quality"]
    overlap = overlap_at(steps, ancillaries, conditioned["range"].to_numpy())
    if overlap is not None:
        # The signal still holds its background, so it cannot be divided by the overlap: bins with
        # partial overlap are excluded.
        partial = np.where(overlap >= FULL_OVERLAP, 0, int(Quality.INCOMPLETE_OVERLAP))
        quality = quality | xr.DataArray(partial.astype(np.int32), dims="range")
    return labeled.fit_homogeneous_path(
        conditioned["power"],
        sections=sections,
        variance=conditioned["variance"],
        quality=quality,
        method=steps[StepName.HOMOGENEOUS].settings["method"],
        # An estimated variance scatters, which must not count as misfit.
        relative_variance=steps[StepName.NOISE].settings["method"] == "differences",
    )


def _with_visibility(result: xr.Dataset, steps: Mapping[str, Step]) -> xr.Dataset:
    """Return computed sections with visibility along them."""
    settings = steps[StepName.HOMOGENEOUS].settings
    definition = Definition(
        wavelength=steps[StepName.READ].settings["wavelength"], **settings["visibility"]
    )
    visibility = labeled_visibility.visibility_of_extinction(
        result["extinction"],
        result["extinction_standard_error"],
        result["extinction_model_error"],
        definition,
    )
    return result.assign(visibility.data_vars).assign_attrs(steps=definition.words)


def _elastic(averages: xr.Dataset, steps: Mapping[str, Step], scene_data: SceneData) -> xr.Dataset:
    settings = steps[StepName.ELASTIC].settings
    window = steps[StepName.REFERENCE].settings
    inverted = labeled_elastic.invert_elastic(
        averages,
        molecules=_molecules(steps, scene_data.ancillaries),
        wavelength=steps[StepName.READ].settings["wavelength"],
        station_altitude=scene_data.station_altitude,
        lidar_ratio=settings["lidar_ratio"],
        lidar_ratio_standard_error=settings["lidar_ratio_standard_error"],
        molecular_relative_error=settings["molecular_relative_error"],
        reference=labeled_elastic.Reference(
            lowest=window["lowest"],
            highest=window["highest"],
            width=window["width"],
            scattering_ratio=window["scattering_ratio"],
            relative_error=window["relative_error"],
        ),
        known_shape=StepName.KNOWN_SHAPE in steps,
        overlap=overlap_at(steps, scene_data.ancillaries, averages["range"].to_numpy()),
    )
    return inverted.assign(_gluing(averages))


def _beams(
    source: FileChannel | GluedChannel, steps: Mapping[str, Step], scene_data: SceneData
) -> xr.Dataset:
    """Return the beams of every scan cycle on common altitudes, as lazy arrays."""
    settings = steps[StepName.MULTIANGLE].settings
    profiles, geometry = source.profiles(), source.geometry
    near, far = settings["background_range"]
    heights = scan_rules.altitude_steps(settings["step"], settings["highest"])
    return labeled_altitudes.on_altitudes(
        profiles,
        zenith_angle=geometry["zenith_angle"].to_numpy(),
        azimuth=geometry["azimuth"].to_numpy() if "azimuth" in geometry else None,
        time_bnds=geometry["time_bnds"].to_numpy(),
        shots=source.shots.to_numpy(),
        altitude_grid=scene_data.station_altitude + heights,
        station_altitude=scene_data.station_altitude,
        background=labeled_altitudes.Background(
            (near, far),
            _molecules(steps, scene_data.ancillaries),
            steps[StepName.READ].settings["wavelength"],
        ),
        overlap=overlap_at(steps, scene_data.ancillaries, profiles["range"].to_numpy()),
    )


def overlap_at(
    steps: Mapping[str, Step], ancillaries: Ancillaries, distance: Array
) -> Array | None:
    """Return the overlap at ranges in m; None where the campaign gives no profile."""
    source = _setting(steps, StepName.OVERLAP, "overlap_profile")
    return None if source is None else ancillaries.overlaps[source].at(distance)


def _molecules(steps: Mapping[str, Step], ancillaries: Ancillaries) -> MolecularProfile:
    source = steps[StepName.MOLECULAR].settings.get("molecular_profile")
    return MolecularProfile.us_standard() if source is None else ancillaries.profiles[source]
