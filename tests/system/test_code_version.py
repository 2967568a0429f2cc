"""Code versions: what changes that of a kind of product, and what does not."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.sources import Copy

from lidarops.errors import LidarOpsError
from lidarops.kinds import Kind, kinds
from lidarops.settings import ChannelProduct
from lidarops.system import code_version as versions
from lidarops.system.code_version import (
    _APART,
    Sources,
    code_version,
    joint_code_version,
    pages_version,
    source_roots,
    version_of,
)

ALL = set(kinds())
OWN = sorted(kind.name for kind in kinds().values() if kind.package.startswith("lidarops."))


@pytest.fixture
def copy(repository: Path, tmp_path: Path) -> Copy:
    """A copy of the sources."""
    return Copy(repository, tmp_path)


@pytest.fixture(scope="module")
def growing(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Copy:
    """A copy of the sources to which several tests append."""
    return Copy(repository, tmp_path_factory.mktemp("growing"))


def test_a_copy_has_the_versions_of_the_installation(copy: Copy):
    assert copy.versions() == {kind: code_version(kind) for kind in ALL}
    assert len(set(copy.versions().values())) == len(ALL)


def test_line_ends_change_nothing(copy: Copy):
    before = copy.versions()
    for path in copy.root.rglob("*.py"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert copy.versions() == before


@pytest.mark.parametrize(
    ("module", "counts"),
    [
        ("records.py", True),
        ("netcdf/stored_flags.py", True),
        ("netcdf/variables.py", True),
        ("figures/raster.py", True),
        ("products/raman/figures.py", True),
        ("retrieve/elastic/flags.py", True),
        ("site/quality.py", True),
        ("site/templates/site.css", True),
        ("figures/figures.js", True),
        ("figures/templates/page.css", True),
        ("reports/run_record.py", False),
        ("products/raman/retrieval.py", False),
        ("run/staleness.py", False),
        ("catalog/scan.py", False),
    ],
)
def test_a_change_of_what_pages_are_made_of_changes_their_version(
    growing: Copy, module: str, *, counts: bool
):
    before = pages_version(growing.sources())
    growing.change(module)
    assert (pages_version(growing.sources()) != before) == counts


@pytest.mark.parametrize(
    ("module", "kind"),
    [
        ("retrieve/elastic/inversion.py", "elastic"),
        ("retrieve/elastic/__init__.py", "elastic"),
        ("retrieve/homogeneous/path_fit.py", "homogeneous"),
        ("retrieve/multiangle/smooth_profile.py", "multiangle"),
        ("retrieve/network/outlying_bins.py", "visibility"),
        *((f"products/{kind}/settings.py", kind) for kind in OWN),
        *((f"products/{kind}/retrieval.py", kind) for kind in OWN),
        *((f"products/{kind}/variables.py", kind) for kind in OWN),
    ],
)
def test_a_change_of_a_kind_changes_its_version_and_no_other(growing: Copy, module: str, kind: str):
    assert growing.changed(module) == {kind}


@pytest.mark.parametrize(
    "package",
    ["aggregate", "catalog", "cli", "figures", "reports", "run", "simulate", "site",
     "system"],
)  # fmt: skip
def test_what_makes_no_product_changes_no_version(growing: Copy, package: str):
    modules = [
        str(path.relative_to(growing.root)) for path in (growing.root / package).rglob("*.py")
    ]
    assert modules
    assert growing.changed(*modules) == set()


@pytest.mark.parametrize(
    "module",
    ["campaign/simulation.py", "campaign/yaml_errors.py", "run/scenes.py",
     "site/templates/day.html"],
)  # fmt: skip
def test_neighbours_of_what_makes_products_change_no_version(growing: Copy, module: str):
    assert growing.changed(module) == set()


@pytest.mark.parametrize(
    "module",
    ["scene/processing.py", "netcdf/product_file.py", "netcdf/write.py",
     "netcdf/read.py", "netcdf/__init__.py", "raw/licel_format.py", "raw/licel_header.py",
     "records.py", "flags.py", "__init__.py"],
)  # fmt: skip
def test_what_every_product_passes_through_changes_all_versions(growing: Copy, module: str):
    assert growing.changed(module) == ALL


def test_a_new_module_counts_as_soon_as_it_is_imported(copy: Copy):
    before = copy.versions()
    copy.write("retrieve/elastic/tails.py", "STEEPEST = 2\n")
    assert copy.versions() == before
    copy.change(
        "retrieve/elastic/inversion.py",
        "if TYPE_CHECKING:\n    from lidarops.retrieve.elastic import tails",
    )
    for_types = copy.versions()
    copy.write("retrieve/elastic/tails.py", "STEEPEST = 1\n")
    assert copy.versions() == for_types
    copy.change(
        "retrieve/elastic/inversion.py",
        "def late():\n    from lidarops.retrieve.elastic import tails\n    return tails",
    )
    imported = copy.versions()
    assert imported["elastic"] != before["elastic"]
    copy.write("retrieve/elastic/tails.py", "STEEPEST = 3\n")
    assert copy.versions()["elastic"] not in {before["elastic"], imported["elastic"]}


def test_a_table_of_a_retrieval_counts(copy: Copy):
    copy.write("retrieve/elastic/ratios.csv", "sr\r\n50\r\n")
    before = copy.versions()
    copy.write("retrieve/elastic/ratios.csv", "sr\n50\n")
    assert copy.versions() == before
    copy.write("retrieve/elastic/ratios.csv", "sr\n60\n")
    assert copy.versions()["elastic"] != before["elastic"]


def test_files_that_python_writes_do_not_count(copy: Copy):
    before = copy.versions()
    folder = copy.root / "retrieve/elastic"
    (folder / "__pycache__").mkdir()
    for name in ("__pycache__/inversion.nbi", "inversion.pyc", ".inversion.py.swp"):
        (folder / name).write_bytes(b"\0")
    assert copy.versions() == before


def test_a_kind_of_another_package_counts_its_own_modules(copy: Copy, tmp_path: Path):
    package = tmp_path / "other"
    (package / "clouds" / "tables").mkdir(parents=True)
    for name, text in {
        "__init__.py": "",
        "unused.py": "",
        "optics.py": "from lidarops.retrieve.elastic import inversion\n",
        "clouds/__init__.py": "",
        "clouds/retrieval.py": "from .. import optics\nfrom .heights import top\n",
        "clouds/heights.py": "top = 1\n",
        "clouds/figures.py": "",
        "clouds/tables/base.csv": "1",
    }.items():
        (package / name).write_text(text)
    kind = Kind("clouds", "Clouds", "other.clouds", ChannelProduct, 50)

    def versions() -> tuple[str, str]:
        sources = Sources({**source_roots(), "lidarops": (copy.root,), "other": (package,)})
        return version_of(kind, sources), version_of(kinds()["signal"], sources)

    first = versions()
    for name in ("unused.py", "clouds/figures.py"):
        (package / name).write_text("a = 1\n")
        assert versions() == first
    seen = {first[0]}
    for name in ("optics.py", "clouds/heights.py", "clouds/tables/base.csv", "clouds/__init__.py"):
        with (package / name).open("a") as file:
            file.write("b = 2\n")
        assert versions()[1] == first[1]
        assert versions()[0] not in seen
        seen.add(versions()[0])
    copy.change("retrieve/elastic/inversion.py")
    assert versions()[0] not in seen


def test_a_raw_format_of_another_package_counts_for_every_kind(
    copy: Copy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    reader = tmp_path / "raymetrics.py"
    reader.write_text("FORMAT = 1\n")
    monkeypatch.setattr(versions, "_formats", lambda: ("raymetrics",))

    def now() -> dict[str, str]:
        sources = Sources({**source_roots(), "lidarops": (copy.root,), "raymetrics": (reader,)})
        return {kind.name: version_of(kind, sources) for kind in kinds().values()}

    before = now()
    reader.write_text("FORMAT = 2\n")
    assert all(version != before[kind] for kind, version in now().items())


def test_modules_that_are_kept_apart_are_imported(copy: Copy):
    """Otherwise they need not be named."""
    sources = Sources({"lidarops": (copy.root,)}, apart=())
    closure = sources.closure(["lidarops.scene.processing"])
    assert set(_APART) <= set(closure)


def test_joint_versions_depend_on_their_kinds(copy: Copy):
    assert joint_code_version() == joint_code_version(sorted(ALL))
    assert joint_code_version(["signal"]) != joint_code_version(["elastic"])
    assert joint_code_version(["signal", "elastic"]) == joint_code_version(["elastic", "signal"])
    assert code_version("signal", "lidarops.aggregate.means") != code_version("signal")


def test_a_missing_source_of_every_product_is_an_error(copy: Copy):
    (copy.root / "scene/processing.py").unlink()
    with pytest.raises(LidarOpsError, match=r"lidarops\.scene\.processing is missing"):
        copy.versions()
