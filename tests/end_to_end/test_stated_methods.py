"""A product states the methods that made it: what they name is called, and no other method."""

from __future__ import annotations

import copy
import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import xarray as xr
import yaml
from support.archives import mixed_campaign
from support.cases import each

import lidarops
from lidarops.campaign.model import load_campaign
from lidarops.run.archive import Selection, reprocess
from lidarops.simulate.campaign import simulate_campaign

ROOT = Path(lidarops.__file__).parent / "retrieve"
BACKGROUND = {
    "tail_mean": "background/estimate:from_tail",
    "cubic": "background/estimate:from_cubic",
    "known_shape": "background/estimate:from_known_shape",
}
"""Functions of the methods that products state; a later one may call an earlier one too."""
RETRIEVAL = {
    "homogeneous": {
        "direct": "homogeneous/path_fit:solve_by_direct_fit",
        "cubic": "homogeneous/path_fit:solve_by_cubic",
        "known_background": "homogeneous/path_fit:solve_with_known_background",
        "linearized": "homogeneous/path_fit:solve_by_linearization",
        "known_extinction": "homogeneous/path_fit:solve_with_known_extinction",
    },
    "multiangle": {
        "two_angle": "multiangle/optical_depth:_two_angle",
        "kano_hamilton": "multiangle/optical_depth:_kano_hamilton",
        "joint": "multiangle/optical_depth:_joint",
        "mld": "multiangle/optical_depth:_mld",
    },
    "visibility": {
        "beams_with_prior": "network/_block_solution:solve_block",
        "beams_without_prior": "network/_block_solution:solve_alone",
        "triangles": "network/triangles:solve_triangles",
    },
}


class Calls:
    """Counts calls of Python functions of retrievals, as a profile function."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        file = frame.f_code.co_filename
        if event == "call" and file.startswith(str(ROOT)):
            place = Path(file).relative_to(ROOT).with_suffix("").as_posix()
            self.counts[f"{place}:{frame.f_code.co_name}"] += 1

    def of(self, functions: dict[str, str]) -> set[str]:
        """Return the methods whose functions were called."""
        return {method for method, function in functions.items() if self.counts[function]}


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and tree of a campaign of one lidar of each pointing, and of a network."""
    folder = tmp_path_factory.mktemp("stated")
    tree = mixed_campaign.tree(profiles=14, bins=2000)
    kept = ("clear-night", "vertical", "scanner", "west-lidar", "east-lidar", "north-lidar")
    for section in (tree["instruments"], tree["simulation"]["instruments"]):
        for name in section.keys() - set(kept):
            del section[name]
    raman = {"raman": {"gas": "nitrogen", "laser": 532}, "photon": {}}
    tree["simulation"]["instruments"]["vertical"]["detectors"].append(
        {"wavelength": 607, "signal_rate": 100, "background": {"night": 0.001, "day": 5}, **raman}
    )
    tree["instruments"]["vertical"]["facts"][0]["channels"]["photon_607o"] = {"dead_time": 3e-9}
    (folder / "c.yaml").write_text(yaml.safe_dump(tree))
    simulate_campaign(load_campaign(folder / "c.yaml"))
    return folder, tree


def _state(product: xr.Dataset, name: str) -> str:
    attrs = product[name].attrs
    meanings = dict(zip(attrs["flag_values"].tolist(), attrs["flag_meanings"].split(), strict=True))
    return str(meanings[product[name].item()])


def _made(
    simulated: tuple[Path, dict[str, Any]], kind: str, settings: dict[str, Any]
) -> tuple[xr.Dataset, Calls]:
    """Return a product made with settings, and the calls by which it was made."""
    folder, whole = simulated
    tree = copy.deepcopy(whole)
    name = {"homogeneous": "clear-night", "multiangle": "scanner"}.get(kind, "vertical")
    owner = tree["networks"]["valley"] if kind == "visibility" else tree["instruments"][name]
    # A network is not that of one instrument.
    chosen = () if kind == "visibility" else (name,)
    if kind == "visibility":
        owner[kind] |= settings
    else:
        asked = owner["products"].get(kind, {"channels": ["photon_532o"]})
        owner["products"] = {kind: asked | settings}
    output = folder / f"out{len(list(folder.iterdir()))}"
    (folder / "changed.yaml").write_text(yaml.safe_dump(tree | {"output": str(output)}))
    calls = Calls()
    campaign = load_campaign(folder / "changed.yaml")
    sys.setprofile(calls)
    try:
        reprocess(campaign, selection=Selection(instruments=chosen, kinds=(kind,)))
    finally:
        sys.setprofile(None)
    (path,) = campaign.products_root.rglob("*.nc")
    return xr.load_dataset(path), calls


@each(
    ("kind", "settings", "method"),
    [
        ("homogeneous", {}, "direct"),
        ("homogeneous", {"method": "direct"}, "direct"),
        ("homogeneous", {"method": "cubic"}, "cubic"),
        ("homogeneous", {"method": "known_background"}, "known_background"),
        ("homogeneous", {"method": "linearized", "extinction": 2e-4}, "linearized"),
        ("homogeneous", {"method": "known_extinction", "extinction": 2e-4}, "known_extinction"),
        ("multiangle", {}, "joint"),
        ("multiangle", {"method": "two_angle"}, "two_angle"),
        ("multiangle", {"method": "kano_hamilton"}, "kano_hamilton"),
        ("visibility", {}, "beams_with_prior"),
        ("visibility", {"prior": "none"}, "beams_without_prior"),
        ("visibility", {"multiplier": 1.0}, "triangles"),
    ],
)
def test_the_stated_retrieval_is_the_one_that_ran(
    simulated: tuple[Path, dict[str, Any]], kind: str, settings: dict[str, Any], method: str
) -> None:
    product, calls = _made(simulated, kind, settings)
    stated = _state(product, "retrieval_method")
    assert stated == method
    ran = calls.of(RETRIEVAL[kind])
    # The prior is an addition to the beams alone.
    assert ran - ({"beams_without_prior"} if stated == "beams_with_prior" else set()) == {stated}
    papers = product.attrs["references"]
    if kind == "homogeneous":
        assert ("Bobrovsky" in papers) == (method == "cubic")
        assert ("Potapova" in papers) == (method not in {"direct", "cubic"})
        assert f'"method":"{method}"' in product["provenance"].item().replace("\\", "")


@pytest.mark.slow
@each(
    ("kind", "settings", "method"),
    [
        ("signal", {}, "tail_mean"),
        ("signal", {"background": "cubic", "background_range": [3000, 9000]}, "cubic"),
        ("elastic", {}, "known_shape"),
        ("elastic", {"background": "tail_mean"}, "tail_mean"),
        ("raman", {}, "known_shape"),
        ("raman", {"background": "tail_mean"}, "tail_mean"),
        ("multiangle", {}, "known_shape"),
        ("multiangle", {"background": "tail_mean"}, "tail_mean"),
    ],
)
def test_the_stated_background_is_the_one_that_was_taken(
    simulated: tuple[Path, dict[str, Any]], kind: str, settings: dict[str, Any], method: str
) -> None:
    nitrogen = {"nitrogen": {"photon_532o": "photon_607o"}} if kind == "raman" else {}
    product, calls = _made(simulated, kind, settings | nitrogen)
    assert _state(product, "background_method") == method
    ran = calls.of(BACKGROUND)
    assert method in ran
    assert [later for later in BACKGROUND if later in ran][-1] == method
