"""Small files of the formats in which soundings come, with the air of the standard atmosphere."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from types import MappingProxyType

import numpy as np
import xarray as xr

from lidarops.retrieve.air.molecular import us_standard

HEIGHTS = np.arange(100.0, 12_000.0, 700.0)
LATITUDE, LONGITUDE = 46.4, 30.7


def air(shift: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return altitude (m), pressure (Pa) and temperature (K), `shift` K warmer than the standard.

    In hydrostatic balance, from the pressure of the standard at the lowest level on.
    """
    pressure, temperature = us_standard(HEIGHTS)
    warm = temperature + shift
    mean = 0.5 * (warm[1:] + warm[:-1])
    drop = np.cumsum(-0.0341632 * np.diff(HEIGHTS) / mean)
    return HEIGHTS, pressure[0] * np.exp(np.concatenate([[0.0], drop])), warm


def wyoming(time: datetime, shift: float = 0.0) -> str:
    """Return a sounding as text of the University of Wyoming."""
    title = f"33837 Coast Observations at {time:%HZ %d} {time:%b} {time:%Y}\n"
    line = "-" * 77
    names = ("PRES", "HGHT", "TEMP", "DWPT", "RELH")
    heads = ["".join(f"{word:>7}" for word in row) for row in (names, ("hPa", "m", "C", "C", "%"))]
    rows = [
        f"{p / 100:7.1f}{z:7.0f}{t - 273.15:7.1f}{t - 283.15:7.1f}{50:7.0f}"
        for z, p, t in zip(*air(shift), strict=True)
    ]
    place = f"Station latitude: {LATITUDE}\n  Station longitude: {LONGITUDE}\n"
    parts = (
        title,
        line,
        *heads,
        line,
        *rows,
        "",
        "Station information and sounding indices",
        place,
    )
    return "\n".join(parts)


def page(time: datetime, shift: float = 0.0) -> str:
    """Return the same as a page."""
    text = wyoming(time, shift).replace("\n", "</H2>\n<PRE>\n", 1)
    return f"<HTML>\n<H2>{text.replace('Station information', '</PRE><H3>Station information')}"


def wyoming_csv(time: datetime, shift: float = 0.0) -> str:
    """Return a sounding as CSV of the University of Wyoming."""
    head = "time,longitude,latitude,pressure_hPa,geopotential height_m,temperature_C,"
    head += "dew point temperature_C,wind speed_m/s"
    rows = [
        f"{time:%Y-%m-%d %H:%M:%S},{LONGITUDE},{LATITUDE},{p / 100:.1f},{z:.0f},{t - 273.15:.1f},"
        f"{t - 283.15:.1f},   "
        for z, p, t in zip(*air(shift), strict=True)
    ]
    return "\n".join([head, *rows])


def spc(time: datetime, shift: float = 0.0) -> str:
    """Return a sounding as text of the Storm Prediction Center."""
    rows = [
        f" {p / 100:.2f}, {z:.2f}, {t - 273.15:.2f}, {t - 283.15:.2f}, -9999.00, -9999.00"
        for z, p, t in zip(*air(shift), strict=True)
    ]
    below = " 1020.00, 34.00, -9999.00, -9999.00, -9999.00, -9999.00"
    return "\n".join([f"%TITLE%\n ODS   {time:%y%m%d/%H%M}\n%RAW%", below, *rows, "%END%"])


def igra(time: datetime, shift: float = 0.0) -> str:
    """Return a sounding of IGRA 2, in which every second level states no height."""
    rows = [
        f"10 -9999 {p:6.0f}B{z if k % 2 == 0 else -9999:5.0f}B{10 * (t - 273.15):5.0f}B-9999"
        f" {100:5d}   300    50 "
        for k, (z, p, t) in enumerate(zip(*air(shift), strict=True))
    ]
    place = f"{LATITUDE * 1e4:7.0f} {LONGITUDE * 1e4:8.0f}"
    head = f"#UPM00033837 {time:%Y %m %d %H} {time:%H%M} {len(rows):4d} ncdc-gts          {place}"
    return "\n".join([head, *rows])


def gdas1(time: datetime, shift: float = 0.0) -> str:
    """Return a profile of GDAS1 as text, for the grid point 46 N, 31 E."""
    when = " ".join(f"{part:2d}" for part in (time.year % 100, time.month, time.day, time.hour, 0))
    rows = [
        f"{p / 100:6.0f}{z:6.0f}{t - 273.15:6.1f}   2.2  -4.7     0  50.0    292.1 335.2   5.2"
        for z, p, t in zip(*air(shift), strict=True)
    ]
    heads = (
        "        HGTS  TEMP  UWND  VWND  WWND  RELH     TPOT  WDIR  WSPD",
        "           m    oC   m/s   m/s  mb/h     %       oK   deg   m/s",
    )
    top = f"Profile Time:  {when}\n Used Nearest Grid Point (  32, 137) to Lat: 46.40, Lon: 30.70"
    return "\n".join([top, "        2D Fields", "", "        3D Fields", *heads, *rows, " "])


def chain(time: datetime, shift: float = 0.0) -> str:
    """Return a table without title line, time and place."""
    return "\n".join(f"{z},{t},{p}" for z, p, t in zip(*air(shift), strict=True))


TEXTS: Mapping[str, Callable[[datetime, float], str]] = MappingProxyType(
    {
        "wyoming.txt": wyoming,
        "wyoming.html": page,
        "wyoming.csv": wyoming_csv,
        "spc.oax": spc,
        "igra.txt": igra,
        "place.gdas1": gdas1,
        "chain.csv": chain,
    }
)
COLUMNS = ("altitude [m]", "temperature [K]", "pressure [Pa]")
"""Of `chain`."""


def cloudnet(path: Path, time: datetime, shifts: tuple[float, ...]) -> None:
    """Write hourly profiles of a model over a site of Cloudnet, 40 m above the sea."""
    columns = [air(shift) for shift in shifts]
    hours = np.arange(len(shifts), dtype=float)
    since = f"hours since {time:%Y-%m-%d %H:%M:%S} +00:00"
    levels = ("time", "level")
    xr.Dataset(
        {
            "height": (levels, [z - 40.0 for z, _, _ in columns], {"units": "m"}),
            "pressure": (levels, [p for _, p, _ in columns], {"units": "Pa"}),
            "temperature": (levels, [t for _, _, t in columns], {"units": "K"}),
            "q": (levels, [0.002 * p / p[0] for _, p, _ in columns], {"units": "1"}),
            "sfc_geopotential": ("time", 40.0 * 9.80665 + 0.0 * hours, {"units": "m2 s-2"}),
            "latitude": ((), LATITUDE, {"units": "degree_N"}),
            "longitude": ((), LONGITUDE, {"units": "degree_E"}),
        },
        coords={"time": ("time", hours, {"units": since})},
    ).to_netcdf(path)


def arm(path: Path, time: datetime) -> None:
    """Write a sounding of ARM, whose altitudes are geometric."""
    z, p, t = air()
    xr.Dataset(
        {
            "pres": ("time", p / 100.0, {"units": "hPa"}),
            "tdry": ("time", t - 273.15, {"units": "C"}),
            "dp": ("time", t - 283.15, {"units": "C"}),
            "alt": ("time", z, {"units": "m"}),
            "lat": ("time", LATITUDE + 0.01 * np.arange(z.size), {"units": "degree_N"}),
            "lon": ("time", LONGITUDE + 0.0 * z, {"units": "degree_E"}),
        },
        coords={"time": ("time", 2.0 * np.arange(z.size), {"units": f"seconds since {time}"})},
    ).to_netcdf(path)


def era5(path: Path, time: datetime) -> None:
    """Write pressure levels of ERA5 on a grid, whose point 46.5 N, 30.75 E has the air of `air`."""
    z, p, t = air()
    shape = (1, z.size, 2, 2)
    grid = ("valid_time", "pressure_level", "latitude", "longitude")
    away = np.array([[20.0, 20.0], [20.0, 0.0]])
    xr.Dataset(
        {
            "t": (grid, t[None, :, None, None] + away, {"units": "K"}),
            "z": (
                grid,
                np.broadcast_to(9.80665 * z[None, :, None, None], shape),
                {"units": "m**2 s**-2"},
            ),
            "r": (grid, np.full(shape, 50.0), {"units": "%"}),
        },
        coords={
            "valid_time": ("valid_time", [0], {"units": f"hours since {time}"}),
            "pressure_level": ("pressure_level", p / 100.0, {"units": "hPa"}),
            "latitude": ("latitude", [46.75, 46.5]),
            "longitude": ("longitude", [30.5, 30.75]),
        },
    ).to_netcdf(path)
