"""Made-up results of retrievals, as input of the builder."""

from __future__ import annotations

from dataclasses import fields
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import xarray as xr

from lidarops.campaign.model import Metadata, Station
from lidarops.flags import Quality
from lidarops.netcdf.context import Context
from lidarops.records import (
    DetectionMode,
    InputRecord,
    LeftOut,
    Plan,
    PlannedStep,
    Provenance,
    Role,
    Stamp,
)
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.network.flags import NetworkQuality
from lidarops.retrieve.raman.errors import BACKSCATTER_CAUSES, EXTINCTION_CAUSES
from lidarops.retrieve.raman.flags import CONCERNING, RamanQuality, concerning

START = datetime(2026, 3, 1, tzinfo=UTC)
SCENE = "lidar-1_20260301T000000"
STATION = Station(name="Одеса, hill", latitude=46.44, longitude=30.76, altitude=53.5)
METADATA = Metadata(
    institution="Université d'Été",
    creator_name="A. Person",
    creator_email="a.person@example.org",
    creator_url="https://example.org",
    project="Demo",
    naming_authority="org.example",
    acknowledgement="Those who swept the dome.",
    license="CC-BY-4.0",
    comment="A comment of the campaign.",
)


def provenance(kind: str = "homogeneous", **changes: Any) -> Provenance:
    plan = Plan(
        scene=SCENE,
        steps=(
            PlannedStep("read", "photon_532o", {"wavelength": 5.32e-7}, "the product needs it"),
            PlannedStep("background", "photon_532o", {"range": [1e4, 1.2e4]}, "the last tenth"),
            PlannedStep("homogeneous", "photon_532o", {"method": "auto"}, "requested"),
            PlannedStep("elastic", "photon_532o", {"lidar_ratio": 50.0}, "requested"),
            PlannedStep("multiangle", "photon_532o", {"method": "auto"}, "requested"),
            PlannedStep("visibility", "photon_532o", {"contrast": 0.05}, "requested"),
            PlannedStep(
                "read", "analog_1064o", {"wavelength": 1.064e-6}, "another channel needs it"
            ),
        ),
        left_out=(LeftOut("dark", "photon_532o", "photon counting has no dark\nsignal"),),
    )
    inputs = tuple(
        InputRecord(f"2026/03/a{number:02d}.dat", Role.SIGNAL, f"{number:064x}")
        for number in range(3)
    )
    fields = {
        "campaign": "demo",
        "scene": SCENE,
        "kind": kind,
        "channel": "photon_532o",
        "inputs": (*inputs, InputRecord("dark/d.dat", Role.DARK, "f" * 64)),
        "plan": plan,
        "settings": {"facts": {"full_overlap_range": 500.0}, "station": {"name": "Одеса"}},
        "versions": {"numpy": "2.4.6", "lidarops": "0.1.0"},
        "code_version": "0123456789abcdef",
    }
    return Provenance(**(fields | changes))


def context(kind: str = "homogeneous", **changes: Any) -> Context:
    about = {name: changes.pop(name) for name in ("channel", "scene") if name in changes}
    origin = changes.pop("provenance", None) or provenance(kind, **about)
    given = {
        **{item.name: getattr(origin, item.name) for item in fields(origin)},
        "mode": DetectionMode.PHOTON,
        "wavelength": 532e-9,
        "station_key": "odesa",
        "station": STATION,
        "instrument_key": "lidar-1",
        "instrument_name": "Lidar One",
        "metadata": METADATA,
        "title": "Demo campaign",
        "summary": "What the campaign is about.",
        "start": START,
        "stop": START + timedelta(days=1),
        "raw_format": "Licel",
        "notes": (),
        "stamp": Stamp(1, START + timedelta(days=2)),
    }
    return Context(**(given | changes))


def clock(profiles: int, zenith: Any = 90.0, azimuth: Any = None) -> dict[str, Any]:
    """Return the coordinates of all kinds: profiles of 10 minutes, zenith angle over time."""
    first = np.datetime64("2026-03-01T10:00:00", "ns")
    length = np.timedelta64(600, "s")
    starts = first + length * np.arange(profiles)
    found = {
        "time": ("time", starts + length // 2),
        "time_bnds": (("time", "nv"), np.stack([starts, starts + length], axis=-1)),
        "zenith_angle": ("time", np.broadcast_to(np.float64(zenith), (profiles,)).copy()),
    }
    if azimuth is not None:
        found["azimuth"] = ("time", np.broadcast_to(np.float64(azimuth), (profiles,)).copy())
    return found


def homogeneous(profiles: int = 5, sections: int = 2, **beam: Any) -> xr.Dataset:
    """Return a made-up result of `homogeneous.labeled.fit_homogeneous_path`."""
    rng = np.random.default_rng(1)
    shape = (profiles, sections)
    dims = ("time", "section")
    near = 500.0 + 1000.0 * np.arange(sections)
    extinction = rng.uniform(1e-6, 1e-3, shape)
    flags = np.zeros(shape, np.int32)
    flags[0, 0] = Quality.NO_SIGNAL | Quality.LOW_SIGNAL
    extinction[0, 0] = np.nan
    return xr.Dataset(
        {
            "total_extinction": (dims, extinction),
            "total_extinction_standard_error": (dims, np.abs(extinction) * 0.05),
            "total_extinction_model_error": (dims, np.abs(extinction) * 0.05 + 1e-5),
            "amplitude": (dims, rng.uniform(1e7, 1e12, shape)),
            "amplitude_standard_error": (dims, rng.uniform(1e5, 1e9, shape)),
            "background": (dims, rng.uniform(0.1, 2.0, shape)),
            "background_standard_error": (dims, rng.uniform(1e-4, 1e-3, shape)),
            "background_model_error": (dims, np.full(shape, 5e-4)),
            "slope_error": 0.05,
            "reduced_chi2": (dims, rng.uniform(0.8, 1.2, shape)),
            "retrieval_method": 0,
            "valid_bins": (dims, rng.integers(8, 500, shape)),
            "quality_flag": (dims, flags),
            "shots": ("time", np.full(profiles, 600, np.int64)),
        },
        coords={
            **clock(profiles, **beam),
            "section": ("section", np.arange(sections)),
            "section_range": ("section", near + 1000.0),
            "section_bounds": (("section", "nv"), np.stack([near, near + 2000.0], axis=-1)),
        },
    )


def signal(profiles: int = 5, bins: int = 40, **beam: Any) -> xr.Dataset:
    """Return a made-up background-subtracted, range-corrected signal."""
    rng = np.random.default_rng(2)
    dims = ("time", "range")
    shape = (profiles, bins)
    values = rng.normal(1e6, 1e4, shape)
    flags = np.zeros(shape, np.int32)
    flags[:, :3] = Quality.INCOMPLETE_OVERLAP
    flags[0, 0] |= Quality.INPUT_MISSING
    values[0, 0] = np.nan
    return xr.Dataset(
        {
            "signal": (dims, values),
            "signal_standard_error": (dims, np.full(shape, 1e4)),
            "background_method": 1,
            "signal_dead_time_error": (dims, np.full(shape, 2e3)),
            "background": ("time", rng.uniform(0.1, 2.0, profiles)),
            "noise_correlation_length": ("time", np.ones(profiles)),
            "background_standard_error": ("time", rng.uniform(1e-4, 1e-3, profiles)),
            "quality_flag": (dims, flags),
            "shots": ("time", np.full(profiles, 600, np.int32)),
        },
        coords={**clock(profiles, **beam), "range": ("range", 7.5 * (np.arange(bins) + 0.5))},
    )


def elastic(profiles: int = 5, bins: int = 40, **beam: Any) -> xr.Dataset:
    """Return a made-up result of `elastic.labeled.invert_elastic`."""
    rng = np.random.default_rng(3)
    dims = ("time", "range")
    shape = (profiles, bins)
    flags = np.zeros(shape, np.int32)
    flags[:, :3] = Quality.INCOMPLETE_OVERLAP
    flags[-1] |= np.int32(ElasticQuality.NO_REFERENCE)
    flags[0, 5:] |= np.int32(ElasticQuality.CLOUD)
    missing = (flags & int(Quality.INCOMPLETE_OVERLAP | ElasticQuality.NO_REFERENCE)) != 0
    scales = {
        "aerosol_backscatter": 1e-6,
        "aerosol_extinction": 5e-5,
        "scattering_ratio": 2.0,
        "attenuated_backscatter": 2e-6,
    }
    retrieved = {}
    for name, scale in scales.items():
        retrieved[name] = rng.normal(scale, 0.1 * scale, shape)
        retrieved[f"{name}_standard_error"] = np.full(shape, 0.1 * scale)
    for cause in (
        "noise",
        "background",
        "reference",
        "lidar_ratio",
        "molecular",
        "dead_time",
        "baseline",
    ):
        retrieved[f"aerosol_backscatter_error_{cause}"] = rng.normal(0.0, 5e-8, shape)
    window = np.where(np.arange(profiles) < profiles - 1, 200.0, np.nan)
    return xr.Dataset(
        {
            **{
                name: (dims, np.where(missing, np.nan, values))
                for name, values in retrieved.items()
            },
            "molecular_backscatter": ("range", np.linspace(1.5e-6, 1e-6, bins)),
            "molecular_extinction": ("range", np.linspace(1.3e-5, 1e-5, bins)),
            "lidar_ratio": ("range", np.full(bins, 50.0)),
            "lidar_ratio_standard_error": ("range", np.full(bins, 10.0)),
            "reference_bottom": ("time", window),
            "reference_top": ("time", window + 50.0),
            "reference_bottom_altitude": ("time", window + STATION.altitude),
            "reference_top_altitude": ("time", window + STATION.altitude + 50.0),
            "reference_scattering_ratio": 1.02,
            "reference_scattering_ratio_standard_error": 0.01,
            "vertical_resolution": 7.5,
            "atmospheric_molecular_calculation_source": 1,
            "molecular_profile_age": np.nan,
            "molecular_profile_distance": np.nan,
            "molecular_density_relative_error": 0.01,
            "background_method": 2,
            "reference_detection_limit": ("time", np.where(np.isnan(window), np.nan, 0.1)),
            "reference_rejections": ("time", np.zeros(profiles, np.int32)),
            "cloud_mask": (dims, ((flags & int(ElasticQuality.CLOUD)) != 0) * np.int8(2)),
            "cloud_fraction": (dims, ((flags & int(ElasticQuality.CLOUD)) != 0) * 1.0),
            **{
                f"cloud_{end}": ("time", np.where(np.arange(profiles) == 0, value, np.nan))
                for end, value in (
                    ("base_range", 40.0),
                    ("base_altitude", 140.0),
                    ("top_altitude", 200.0),
                )
            },
            "background": ("time", rng.uniform(0.1, 2.0, profiles)),
            "background_standard_error": ("time", rng.uniform(1e-4, 1e-3, profiles)),
            "glue_slope": ("time", np.full(profiles, 20.0)),
            "glue_slope_standard_error": ("time", np.full(profiles, 0.1)),
            "glue_bottom": ("time", np.full(profiles, 100.0)),
            "glue_top": ("time", np.full(profiles, 150.0)),
            "quality_flag": (dims, flags),
            "profiles": ("time", np.full(profiles, 10, np.int32)),
            "profiles_left_out": ("time", np.arange(profiles, dtype=np.int32)),
            "shots": ("time", np.full(profiles, 6000, np.int32)),
        },
        coords={**clock(profiles, **beam), "range": ("range", 7.5 * (np.arange(bins) + 0.5))},
    )


def raman(profiles: int = 5, bins: int = 40, **beam: Any) -> xr.Dataset:
    """Return a made-up result of `raman.labeled.retrieve`."""
    rng = np.random.default_rng(6)
    dims = ("time", "range")
    shape = (profiles, bins)
    flags = np.zeros(shape, np.int32)
    flags[:, :3] = (
        Quality.INCOMPLETE_OVERLAP | RamanQuality.NO_LIDAR_RATIO | RamanQuality.COMMON_OVERLAP
    )
    flags[-1] |= np.int32(RamanQuality.WEAK_SIGNAL | RamanQuality.NO_LIDAR_RATIO)
    flags[0, 5:] |= np.int32(RamanQuality.NO_REFERENCE | RamanQuality.NO_LIDAR_RATIO)
    scales = {
        "aerosol_extinction": 5e-5,
        "aerosol_backscatter": 1e-6,
        "lidar_ratio": 50.0,
        "water_vapour_mixing_ratio": 5e-3,
    }
    causes = {
        "aerosol_extinction": EXTINCTION_CAUSES,
        "aerosol_backscatter": BACKSCATTER_CAUSES,
        "lidar_ratio": ("random", "systematic"),
        "water_vapour_mixing_ratio": ("random", "systematic"),
    }
    values = {}
    for name, scale in scales.items():
        values[name] = rng.normal(scale, 0.1 * scale, shape)
        values[f"{name}_standard_error"] = np.full(shape, 0.1 * scale)
        for cause in causes[name]:
            share = 0.1 * scale / np.sqrt(len(causes[name]))
            values[f"{name}_error_{cause}"] = np.full(shape, share)
    values |= {
        "aerosol_extinction_smoothing_error": np.full(shape, 5e-6),
        "vertical_resolution": np.full(shape, 300.0),
    }
    for name in scales:
        missing = concerning(name, flags, flags) != 0
        for part in [part for part in values if part.startswith(name)]:
            values[part] = np.where(missing, np.nan, values[part])
    window = np.where(np.arange(profiles) < profiles - 1, 6000.0, np.nan)
    return xr.Dataset(
        {
            **{name: (dims, array) for name, array in values.items()},
            "overlap": (dims, np.where(flags & int(Quality.INCOMPLETE_OVERLAP), 0.5, 1.0)),
            "overlap_standard_error": (dims, np.full(shape, 0.01)),
            "molecular_backscatter": ("range", np.linspace(1.5e-6, 1e-6, bins)),
            "reference_bottom": ("time", window),
            "reference_top": ("time", window + 2000.0),
            "reference_bottom_altitude": ("time", window + STATION.altitude),
            "reference_top_altitude": ("time", window + STATION.altitude + 2000.0),
            "reference_scattering_ratio": 1.02,
            "reference_scattering_ratio_standard_error": 0.01,
            "atmospheric_molecular_calculation_source": 0,
            "molecular_profile_age": np.nan,
            "molecular_profile_distance": np.nan,
            "molecular_density_relative_error": 0.01,
            "background_method": 2,
            "reference_detection_limit": ("time", np.where(np.isnan(window), np.nan, 0.1)),
            "reference_rejections": ("time", np.zeros(profiles, np.int32)),
            "cloud_mask": (dims, np.zeros(shape, np.int8)),
            "cloud_fraction": (dims, np.zeros(shape)),
            **{
                f"cloud_{end}": ("time", np.full(profiles, np.nan))
                for end in ("base_range", "base_altitude", "top_altitude")
            },
            "background": ("time", rng.uniform(0.1, 2.0, profiles)),
            "background_standard_error": ("time", rng.uniform(1e-4, 1e-3, profiles)),
            **{
                f"{name.removeprefix('aerosol_extinction')}_quality_flag".strip("_"): (
                    dims,
                    concerning(name, flags, flags),
                )
                for name in CONCERNING
            },
            "profiles": ("time", np.full(profiles, 10, np.int32)),
            "profiles_left_out": ("time", np.arange(profiles, dtype=np.int32)),
            "shots": ("time", np.full(profiles, 6000, np.int32)),
        },
        coords={**clock(profiles, **beam), "range": ("range", 60.0 * (np.arange(bins) + 0.5))},
    )


def multiangle(
    profiles: int = 5,
    levels: int = 20,
    zenith: Any = (0.0, 30.0, 60.0),
    azimuth: Any = None,
    *,
    layers: bool = True,
) -> xr.Dataset:
    """Return a made-up result of `multiangle.labeled.retrieve_optical_depth`."""
    rng = np.random.default_rng(4)
    angles = np.atleast_1d(np.float64(zenith))
    dims = ("time", "altitude")
    shape = (profiles, levels)
    flags = np.full(shape, np.int32(MultiAngleQuality.NO_RESIDUAL))
    flags[0, 2 * levels // 3 :] = MultiAngleQuality.EXTRAPOLATED
    flags[-1, 0] |= np.int32(MultiAngleQuality.INTERPOLATED | MultiAngleQuality.POOR_STRATIFICATION)
    scales = {
        "vertical_optical_depth": 0.3,
        "vertical_optical_depth_standard_error": 0.01,
        "vertical_optical_depth_error_air": 0.003,
        "vertical_optical_depth_gradient_error": 0.005,
        "vertical_optical_depth_dead_time_error": 0.004,
        "total_extinction": 1e-4,
        "total_extinction_standard_error": 1e-5,
        "total_extinction_gradient_error": 5e-6,
        "total_extinction_dead_time_error": 4e-6,
        "log_intercept": 14.0,
        "log_intercept_standard_error": 0.02,
        "data_share": 0.99,
        "regularisation": 0.1,
        "prior_vertical_optical_depth": 0.2,
        "inhomogeneity": 0.03,
        "monotone_vertical_optical_depth": 0.3,
        "reduced_chi2": 1.0,
    }
    missing = (flags & int(MultiAngleQuality.EXTRAPOLATED)) != 0
    residual = rng.normal(0.0, 0.03, (profiles, angles.size, levels))
    residual[0, -1] = np.nan
    along = {} if azimuth is None else {"azimuth": azimuth}
    pointing = {
        f"beam_{name}": ("beam", np.broadcast_to(np.float64(values), angles.shape).copy())
        for name, values in {"zenith_angle": zenith, **along}.items()
    }
    times = {name: clock(profiles)[name] for name in ("time", "time_bnds")}
    found = xr.Dataset(
        {
            **{
                name: (dims, np.where(missing, np.nan, scale * rng.uniform(0.5, 1.5, shape)))
                for name, scale in scales.items()
            },
            "beam_signal": (("time", "beam", "altitude"), np.exp(14.0 + residual)),
            "beam_obstruction": (("time", "beam"), np.full((profiles, angles.size), np.nan)),
            "residual": (("time", "beam", "altitude"), residual),
            "retrieval_method": 0,
            "background_method": 0,
            "effective_degrees_of_freedom": ("time", np.full(profiles, 12.5)),
            "reach": ("time", np.full(profiles, 800.0)),
            "quality_flag": (dims, flags),
            "beams": ("time", np.full(profiles, angles.size, np.int32)),
            "shots": ("time", np.full(profiles, 6000, np.int32)),
        },
        coords={
            **times,
            **pointing,
            "beam": ("beam", np.arange(angles.size, dtype=np.int32)),
            "altitude": ("altitude", STATION.altitude + 60.0 * np.arange(1, levels + 1)),
        },
        attrs={"steps": "joint: extinction is requested"},
    )
    return with_baseline(with_planes(with_layers(found))) if layers else found


def with_planes(data: xr.Dataset) -> xr.Dataset:
    """Return data with profiles of two vertical planes."""
    names = ("vertical_optical_depth", "total_extinction")
    return data.assign(
        {
            f"plane_{name}{ending}": data[name + ending].expand_dims(plane=2, axis=1).copy()
            for name in names
            for ending in ("", "_standard_error", "_gradient_error")
        }
    ).assign_coords(
        plane=("plane", np.arange(2, dtype=np.int32)),
        plane_azimuth=("plane", np.array([20.0, 110.0])),
    )


def with_baseline(data: xr.Dataset) -> xr.Dataset:
    """Return data with the analog baseline that two blocked profiles show."""
    along = ("baseline_range",)
    return data.assign(
        analog_baseline=(along, np.array([3e-3, 2e-3, 1e-3])),
        analog_baseline_standard_error=(along, np.array([1e-3, 5e-4, 5e-4])),
        blocked_range=("blocked", np.array([150.0, 480.0])),
        blocked_zenith_angle=("blocked", np.array([87.0, 85.0])),
        blocked_azimuth=("blocked", np.array([40.0, 45.0])),
    ).assign_coords(baseline_range=("baseline_range", np.array([450.0, 750.0, 1050.0])))


def with_layers(data: xr.Dataset) -> xr.Dataset:
    """Return data with optical depths of two layers, the second one missing in the first cycle."""
    bounds = STATION.altitude + 60.0 * np.array([[0.0, 2.0], [1.0, 4.0]])
    dims, shape = ("time", "layer"), (data.sizes["time"], 2)
    missing = np.zeros(shape, np.bool_)
    missing[0, 1] = True
    scales = {"": 0.1, "_standard_error": 0.01, "_gradient_error": 0.005}
    return data.assign(
        {
            f"layer_vertical_optical_depth{error}": (dims, np.where(missing, np.nan, scale))
            for error, scale in scales.items()
        }
    ).assign_coords(
        layer_altitude=("layer", bounds.mean(axis=1)), layer_bnds=(("layer", "nv"), bounds)
    )


def visibility(
    profiles: int = 5, crossings: int = 3, zenith: Any = 90.0, azimuth: Any = None
) -> xr.Dataset:
    """Return a made-up result of `network.labeled.retrieve_network`."""
    rng = np.random.default_rng(5)
    beams = max(3, np.size(zenith))
    pair = ("time", "crossing")
    shape = (profiles, crossings)
    flags = np.zeros(shape, np.int32)
    flags[-1] = int(NetworkQuality.LOW_LEVERAGE)
    flags[0, 0] = int(Quality.INPUT_MISSING | Quality.LOW_SIGNAL)
    lost = flags[:, :] == flags[0, 0]
    extinction = rng.uniform(1e-4, 1e-3, shape)
    error, systematic = 0.02 * extinction, 0.03 * extinction
    both = np.hypot(error, systematic)
    law = -np.log(0.05)
    values = {
        "visibility_in_air": law / extinction,
        "visibility_in_air_standard_error": law * error / extinction**2,
        "visibility_in_air_lower": law / (extinction + both),
        "visibility_in_air_upper": law / (extinction - both),
        "total_extinction": extinction,
        "total_extinction_standard_error": error,
        "total_extinction_systematic_error": systematic,
        "condition": rng.uniform(1.0, 3.0, shape),
        "multiplier": np.full(shape, 0.95),
    }
    scalars = {"path_optical_depth": 0.8, "reduced_chi2": 1.1, "degrees_of_freedom": 1.0}
    distance = np.full((beams, crossings), np.nan)
    for crossing in range(crossings):
        meeting = [crossing % beams, (crossing + 1) % beams]
        distance[meeting, crossing] = 500.0 + 1000.0 * crossing + 100.0 * np.arange(2)
    beam_values = {
        "latitude": STATION.latitude + 0.01 * np.arange(beams),
        "longitude": STATION.longitude + 0.02 * np.arange(beams),
        "altitude": STATION.altitude + np.arange(beams),
        "zenith_angle": np.resize(np.float64(zenith), beams),
        "azimuth": np.resize(
            np.float64([70.0, 310.0, 190.0] if azimuth is None else azimuth), beams
        ),
    }
    crossing = np.arange(crossings)
    return xr.Dataset(
        {
            **{name: (pair, np.where(lost, np.nan, found)) for name, found in values.items()},
            **{name: ("time", np.full(profiles, found)) for name, found in scalars.items()},
            "retrieval_method": 0,
            "quality_flag": (pair, flags),
            "shots": ("time", np.full(profiles, 9000, np.int32)),
            "beam_range": (("beam", "crossing"), distance),
        },
        coords={
            **{name: clock(profiles)[name] for name in ("time", "time_bnds")},
            "crossing_id": ("crossing", crossing.astype(np.int32)),
            "latitude": ("crossing", STATION.latitude + 0.003 * (crossing + 1)),
            "longitude": ("crossing", STATION.longitude + 0.004 * (crossing + 1)),
            "altitude": ("crossing", STATION.altitude + 5.0 * crossing[::-1]),
            "beam": ("beam", np.arange(beams, dtype=np.int32)),
            **{f"beam_{name}": ("beam", found) for name, found in beam_values.items()},
        },
        attrs={"steps": "method iterative; beam 0: lidar-0, with the crossings 0 at 500 m"},
    )


MAKERS = {
    "signal": signal,
    "homogeneous": homogeneous,
    "elastic": elastic,
    "raman": raman,
    "multiangle": multiangle,
    "visibility": visibility,
}
PLACED = ("multiangle", "visibility")
"""Kinds whose values lie where several beams look, and not along one."""
