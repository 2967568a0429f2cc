"""Products to be stored, and checks of what files hold."""

from __future__ import annotations

from pathlib import Path

import netCDF4
import numpy as np
import xarray as xr

from lidarops.netcdf.write import CHUNK_BYTES, write_plain, write_product
from lidarops.system.files import sha256_of
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context, signal


def truth() -> xr.Dataset:
    return xr.Dataset(
        {
            "total_extinction": (("scene", "level"), np.array([[1e-5, np.nan], [2e-5, 3e-5]])),
            "label": ("scene", np.array(["hazy", "чисто"])),
            "weather": "fair",
            "good": ("scene", np.array([True, False])),
            "seed": ("scene", np.array([2**40, 1])),
            "nothing": ("scene", np.array(["", ""])),
        },
        coords={"scene": np.array(["2026-03-01", "2026-03-02"], "datetime64[ns]")},
        attrs={"title": "Truth", "seed": 7},
    )


def of_noise(profiles: int = 299, bins: int = 2000) -> xr.Dataset:
    """A signal product of several chunks, the last of them cut; its standard errors vary too."""
    rng = np.random.default_rng(5)
    data = signal(profiles, bins)
    level = np.exp(-np.arange(bins) / 500) * rng.uniform(0.5, 2, (profiles, 1)) * 1e6
    error = np.sqrt(level) * 10
    found = build_product(
        data.assign(
            signal=data["signal"].copy(data=rng.normal(level, error)),
            signal_standard_error=data["signal"].copy(
                data=error * rng.normal(1, 0.05, error.shape)
            ),
        ),
        context("signal"),
    )
    assert found["signal"].nbytes > CHUNK_BYTES
    return found


def assert_stored(path: Path, expected: xr.Dataset) -> None:
    """Assert that two files hold the same bytes, as read by netCDF4."""
    with netCDF4.Dataset(path) as file:
        file.set_auto_mask(False)
        file.set_auto_scale(False)
        file.set_auto_chartostring(False)
        assert list(file.variables) == [str(name) for name in expected.variables]
        for name, variable in expected.variables.items():
            assert file[name].shape == variable.shape, name
            native = variable.values.astype(variable.dtype.newbyteorder("="))
            assert file[name][...].tobytes() == native.tobytes(), name


def digests(path: Path) -> list[str]:
    """Return the SHA-256 of files of each kind, of several chunks, and of no product."""
    found = [
        write_product(build_product(maker(zenith=[0, 1, 2, 3, 4]), context(kind)), path).sha256
        for kind, maker in MAKERS.items()
    ]
    found.append(write_product(of_noise(), path).sha256)
    write_plain(truth(), path)
    return [*found, sha256_of(path)]
