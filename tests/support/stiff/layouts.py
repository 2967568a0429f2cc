"""Cases for the memory layout of arrays: every layout must give the same result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import labeled, path_fit
from lidarops.retrieve.network import extinction_field
from lidarops.retrieve.signal import counts_to_signal
from support.inversions import invert_elastic
from support.scan_arguments import retrieve_optical_depth
from support.stiff import elastic, networks, scans
from support.stiff.cases import Answer, Near, Refused, Retrieval, StiffCase
from support.stiff.homogeneous import CLEAR

Layout = Callable[[Any], Any]
Solver = Callable[..., Mapping[str, Any]]


def _read_only(array: Any) -> Any:
    copy = np.array(array)
    copy.flags.writeable = False
    return copy


def _strided(array: Any) -> Any:
    """Return a view of every second value of a longer array, its first axis reversed."""
    wide = np.zeros((*array.shape[:-1], 2 * array.shape[-1]), dtype=array.dtype)
    wide[..., ::2] = array
    turned = np.ascontiguousarray(wide[::-1])[::-1] if array.ndim > 1 else wide
    return turned[..., ::2]


LAYOUTS: Final[dict[str, Layout]] = {
    "big-endian": lambda array: array.astype(array.dtype.newbyteorder(">")),
    "read-only": _read_only,
    "with strides": _strided,
    "in Fortran order": np.asfortranarray,
    "masked, without masked values": np.ma.masked_array,
    "as a list": lambda array: array.tolist(),
}
REFUSED: Final[dict[str, Layout]] = {
    "objects": lambda array: array.astype(object),
    "complex numbers": lambda array: array.astype(complex),
    "strings": lambda array: array.astype(str),
    "booleans": lambda array: array.astype(bool),
}


def _homogeneous(array: Any, layout: Layout) -> Mapping[str, Any]:
    fit = path_fit.fit_homogeneous_path(layout(array), layout(CLEAR.range), variance=1.0)
    return {n: getattr(fit, n) for n in ("background", "extinction", "quality", "reduced_chi2")}


def _signal(array: Any, layout: Layout) -> Mapping[str, Any]:
    distance = 7.5 * np.arange(1, array.shape[-1] + 1, dtype=np.float64)
    signal = counts_to_signal.photon_signal(
        layout(array), layout(np.full(array.shape[0], 600)), layout(distance), bin_width=7.5,
        dead_time=4e-9,
    )  # fmt: skip
    return {n: getattr(signal, n) for n in ("power", "variance", "quality")}


def _elastic(array: Any, layout: Layout) -> Mapping[str, Any]:
    arguments = elastic.elastic_arguments(array.shape[0])
    changed = {n: layout(np.asarray(arguments[n])) for n in ("range", "molecular_backscatter")}
    solution = invert_elastic(**arguments | changed | {"power": layout(array)})
    return {n: getattr(solution, n) for n in ("backscatter", "backscatter_standard_error", "valid")}


def _scans(array: Any, layout: Layout) -> Mapping[str, Any]:
    arguments = scans.scan_arguments(profiles=array.shape[0])
    changed = {n: layout(np.asarray(arguments[n])) for n in ("zenith_angle", "altitude")}
    solution = retrieve_optical_depth(**arguments | changed | {"signal": layout(array)})
    return {n: getattr(solution, n) for n in ("optical_depth", "extinction", "quality")}


def _network(array: Any, layout: Layout) -> Mapping[str, Any]:
    arguments = networks.network_arguments()
    changed = {"power": layout(array), "range": layout(arguments["range"])}
    solution = extinction_field.retrieve_network(**arguments | changed)
    return {n: getattr(solution, n) for n in ("extinction", "extinction_standard_error")}


def _labeled(array: Any, chunk: int) -> Mapping[str, Any]:
    power = xr.DataArray(
        array,
        dims=("time", "range"),
        coords={"range": ("range", CLEAR.range, {"units": "m"})},
        attrs={"units": "mV"},
    )
    sections = [(2500.0, 6000.0), (6000.0, 10000.0)]
    if chunk:
        power = power.chunk({"time": chunk, "range": 50})
    result = labeled.fit_homogeneous_path(power, sections=sections, variance=1.0)
    return {str(name): result[name].to_numpy() for name in result.data_vars}


def _plain(array: Any) -> Any:
    return array


def _same_bits(solver: Solver, array: Callable[[], Any], *layouts: Any) -> Answer:
    """Return whether two layouts give the same bits."""
    reference, changed = (solver(array(), layout) for layout in layouts)
    same = [
        np.array_equal(reference[n], changed[n], equal_nan=reference[n].dtype.kind == "f")
        for n in reference
    ]
    return Answer({"same bits": float(all(same))})


def _single_precision(solver: Solver, name: str, error: str, array: Callable[[], Any]) -> Answer:
    """Return the largest change due to single precision, in standard errors."""
    reference = solver(array(), _plain)
    changed = solver(array().astype(np.float32), _plain)
    stated = (
        np.asarray(reference[error])
        if error in reference
        else np.abs(np.asarray(reference[name])) * 1e-3
    )
    change = np.abs(np.asarray(reference[name]) - np.asarray(changed[name])) / stated
    return Answer({"change": np.nanmax(change)})


def _counts() -> Any:
    rng = np.random.default_rng(61)
    return rng.poisson(600.0, (4, 300)).astype(np.int32)


_SOLVED: Final[dict[Retrieval, tuple[Solver, Callable[[], Any], str]]] = {
    Retrieval.HOMOGENEOUS: (_homogeneous, lambda: CLEAR.noisy(20), "power"),
    Retrieval.SIGNAL: (_signal, _counts, "counts"),
    Retrieval.ELASTIC: (_elastic, lambda: elastic.elastic_arguments(5)["power"], "power"),
    Retrieval.MULTIANGLE: (_scans, lambda: scans.scan_arguments()["signal"], "signal"),
    Retrieval.NETWORK: (
        _network,
        lambda: networks.network_arguments()["power"],
        "power",
    ),
}
_FLOAT32: Final = {
    Retrieval.HOMOGENEOUS: "extinction",
    Retrieval.ELASTIC: "backscatter",
    Retrieval.MULTIANGLE: "optical_depth",
    Retrieval.NETWORK: "extinction",
}


def _laid_out(retrieval: Retrieval, name: str, layout: Layout) -> StiffCase:
    solver, array, _ = _SOLVED[retrieval]
    return StiffCase(
        f"{retrieval.value}: arrays {name}",
        retrieval,
        dict,
        partial(_same_bits, solver, array, layout, _plain),
        (Near("same bits", 1.0, 0.0),),
    )


def _refused(retrieval: Retrieval, name: str, layout: Layout) -> StiffCase:
    solver, array, field = _SOLVED[retrieval]

    def signals_only(values: Any) -> Any:
        return layout(values) if np.ndim(values) > 1 else values

    return StiffCase(
        f"{retrieval.value}: signals as {name}",
        retrieval,
        dict,
        partial(_same_bits, solver, array, signals_only, _plain),
        (Refused(RetrievalInputError, field),),
    )


def _single(retrieval: Retrieval, quantity: str) -> StiffCase:
    solver, array, _ = _SOLVED[retrieval]
    return StiffCase(
        f"{retrieval.value}: float32",
        retrieval,
        dict,
        partial(_single_precision, solver, quantity, f"{quantity}_standard_error", array),
        (Near("change", 0.0, 1.0, relative=False),),
    )


def _whole_numbers() -> Answer:
    """Compare integers with the same values as floats."""
    power = np.rint(100.0 * CLEAR.noisy(20))
    reference = _homogeneous(power.astype(np.int64), _plain)
    changed = _homogeneous(power, _plain)
    return Answer(
        {"same bits": float(all(np.array_equal(reference[n], changed[n]) for n in reference))}
    )


def _blocks() -> Answer:
    """Compare a batch in which some profiles are NaN with a batch of valid profiles."""
    power = CLEAR.noisy(60)
    power[10:30] = np.nan
    fit = path_fit.fit_homogeneous_path(power, CLEAR.range, variance=1.0)
    clean = path_fit.fit_homogeneous_path(CLEAR.noisy(60), CLEAR.range, variance=1.0)
    kept = np.delete(np.arange(60), np.arange(10, 30))
    same = np.array_equal(fit.extinction[kept], clean.extinction[kept])
    lost = np.isnan(fit.extinction[10:30]).all()
    missing = (fit.quality[10:30] & int(Quality.INPUT_MISSING) != 0).all()
    return Answer({"same bits": float(same and lost and missing)})


def _turned() -> Answer:
    path_fit.fit_homogeneous_path(CLEAR.noisy(20)[:, ::-1], CLEAR.range[::-1], variance=1.0)
    return Answer({})


def memory_layout_cases() -> tuple[StiffCase, ...]:
    """Return all cases of memory layouts."""
    same = (Near("same bits", 1.0, 0.0),)
    chunks = tuple(
        StiffCase(f"dask, chunks of {label} by 50 bins", Retrieval.HOMOGENEOUS, dict,
             partial(_same_bits, _labeled, lambda: CLEAR.noisy(20), size, 0), same)
        for size, label in ((1, "one profile"), (7, "7 profiles"))
    )  # fmt: skip
    return (
        *(_laid_out(r, name, layout) for r in _SOLVED for name, layout in LAYOUTS.items()
          if not (r is Retrieval.SIGNAL and name == "as a list")),
        *(_refused(r, name, layout) for r in _SOLVED for name, layout in REFUSED.items()),
        *(_single(r, quantity) for r, quantity in _FLOAT32.items()),
        *chunks,
        StiffCase("whole numbers", Retrieval.HOMOGENEOUS, dict, _whole_numbers, same),
        StiffCase("blocks of all NaN", Retrieval.HOMOGENEOUS, dict, _blocks, same),
        StiffCase("descending ranges", Retrieval.HOMOGENEOUS, dict, _turned,
             (Refused(RetrievalInputError, "range"),)),
    )  # fmt: skip
