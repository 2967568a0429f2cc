"""The site as files: which pages are made, kept or refused; equal archives give equal sites."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import netCDF4
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.archives.site_archive import add, add_unknown, contents, small_archive
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.errors import CatalogError, ProductError
from lidarops.flags import Quality
from lidarops.site import build, paths
from lidarops.site.build import build_site
from lidarops.site.product_entry import GRADES, Problem, grade_of
from lidarops.system.files import product_paths, within

FIRST_PAGE = 300_000
"""Most bytes that the first page may load."""


class _Page(HTMLParser):
    """Collects tags with their attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attrs for name, attrs in self.tags if name == tag]


def _page(file: Path) -> _Page:
    return _Page(file.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = small_archive(tmp_path_factory.mktemp("site") / "out")
    add_unknown(output)
    return output


@pytest.fixture(scope="module")
def site(archive: Path) -> Path:
    made = build_site(archive)
    assert made.products == made.made == 20
    assert [problem.path for problem in made.problems] == ["odesa/wind.nc"]
    return archive / "site"


def _copy(archive: Path, target: Path) -> Path:
    shutil.copytree(archive, target, ignore=shutil.ignore_patterns("site"))
    return target


def test_every_link_leads_to_a_file_of_the_output(archive: Path, site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    # The first page, two years, days, products.
    assert len(pages) == 1 + 2 + 4 + 20
    for page in pages:
        tags = _page(page)
        targets = [
            attrs.get("href") or attrs.get("src") or ""
            for tag, attrs in tags.tags
            if tag in {"a", "img", "link"}
        ]
        identifiers = {attrs["id"] for _, attrs in tags.tags if "id" in attrs}
        assert targets
        for target in targets:
            parts = urlsplit(target)
            assert not parts.scheme, target
            assert not parts.netloc, target
            if parts.path:
                file = (page.parent / unquote(parts.path)).resolve()
                assert file.is_file(), (page, target)
                assert file.is_relative_to(archive.resolve())
            elif parts.fragment != "main":
                assert parts.fragment in identifiers, (page, target)


def test_no_page_names_another_host_or_holds_a_script(site: Path) -> None:
    for name, content in contents(site).items():
        text = content.decode()
        scripts = [attrs for attrs in _Page(text).all("script") if name.endswith(".html")]
        assert [Path(attrs.get("src") or "").name for attrs in scripts[:1]] in ([], ["figures.js"])
        assert all(attrs["type"] == "application/json" for attrs in scripts[1:])
        assert not re.search(r"(?:src|href)=\"(?:https?:)?//", text), name
        if name.endswith(".html"):
            policy = [
                attrs
                for attrs in _Page(text).all("meta")
                if attrs.get("http-equiv") == "Content-Security-Policy"
            ]
            assert len(policy) == 1
            assert "default-src 'none'" in (policy[0]["content"] or "")
            assert "script-src 'self' file:;" in (policy[0]["content"] or "")
            assert "http" not in (policy[0]["content"] or "")


@pytest.mark.parametrize(
    "pattern", ["index.html", "station/*/*.html", "station/*/*/*.html", "product/**/*.html"]
)
def test_pages_have_what_a_screen_reader_needs(site: Path, pattern: str) -> None:
    for file in site.glob(pattern):
        page = _page(file)
        assert page.all("html")[0]["lang"] == "en"
        for once in ("header", "main", "footer", "h1"):
            assert len(page.all(once)) == 1, once
        assert page.all("a")[0] == {"class": "skip", "href": "#main"}
        levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch(r"h[1-6]", tag)]
        assert all(after <= before + 1 for before, after in pairwise(levels))
        assert not page.all("img")
        assert all(attrs.get("scope") for attrs in page.all("th"))


def test_product_page_has_flags_provenance_and_download(archive: Path, site: Path) -> None:
    page = next(site.glob("product/odesa/lidar-1/elastic/2026/*20260301T000000.html"))
    text = page.read_text(encoding="utf-8")
    for words in (
        "incomplete_overlap",
        Quality.INCOMPLETE_OVERLAP.description,
        "do not use",
        "use with care",
        "2026/03/a00.dat",
        f"{2:064x}",
        "photon counting has no dark",
        "numpy 2.4.6",
        "0123456789abcdef",
        "full_overlap_range",
    ):
        assert words in text, words
    download = next(a["href"] for a in _page(page).all("a") if "download" in a)
    file = (page.parent / unquote(download or "")).resolve()
    assert file == archive.resolve() / "products" / page.relative_to(site / "product").with_suffix(
        ".nc"
    )
    # An image and a profile, with the quality below the first.
    assert text.count('<div class="fig"') == 2
    assert "On average" in text
    assert f'xarray.open_dataset("{file.name}")' in text.replace("&#34;", '"')


def test_counts_of_quality_are_those_of_the_file(archive: Path, site: Path) -> None:
    known = {
        row["path"]: row for row in json.loads((site / "manifest.json").read_text())["products"]
    }
    for path, row in known.items():
        if "wind" in path:
            continue
        with netCDF4.Dataset(archive / "products" / path) as file:
            judges = [name for name in file.variables if name.endswith("quality_flag")]
            flags = [file[name][:].filled() for name in judges]
            summaries = (name.removesuffix("quality_flag") + "usable" for name in judges)
            usable = [file[name][:].filled() for name in summaries if name in file.variables]
        # Of all quantities that have flags of their own.
        assert row["values"] == sum(values.size for values in flags)
        assert row["unflagged"] == sum(int((values == 0).sum()) for values in flags)
        if usable:
            assert row["usable"] == sum(int((values < 2).sum()) for values in usable)


def test_a_product_of_unknown_kind_gets_a_figure_and_a_problem(site: Path) -> None:
    text = (site / "product/odesa/wind.html").read_text(encoding="utf-8")
    assert "Product of kind wind" in text
    assert "the product has no provenance" in text
    assert text.count('<div class="fig"') == 1
    assert "4 of 6 series" in text


def test_first_page_and_its_files_are_small(site: Path) -> None:
    index = site / "index.html"
    page = _page(index)
    loaded = [page.all("link")[0]["href"], page.all("script")[0]["src"]]
    sizes = [(site / unquote(name or "")).stat().st_size for name in loaded]
    assert index.stat().st_size + sum(sizes) <= FIRST_PAGE


@pytest.mark.usefixtures("server")
def test_equal_archives_give_equal_bytes_for_any_number_of_workers(
    archive: Path, site: Path, tmp_path: Path
) -> None:
    other = _copy(archive, tmp_path / "elsewhere")
    # Workers also finish in another order.
    build_site(other, workers=2)
    assert contents(other / "site") == contents(site)


_PAGE = build._page


def _deadly_page(kept: build._Kept, task: build._Task) -> build._Outcome:
    if task[0] == sorted(product_paths(kept[0]))[0]:
        os._exit(9)
    return _PAGE(kept, task)


@pytest.mark.usefixtures("server")
def test_a_product_that_crashes_its_process_is_a_problem_and_the_others_have_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "deadly"
    for days in range(3):
        add(output, "signal", days)
    monkeypatch.setattr(build, "_page", _deadly_page)
    built = build_site(output, workers=2)
    (first, *_) = sorted(product_paths(output / "products"))
    assert Problem(first, "reading it crashed the process") in built.problems
    assert built.products == 3 - 1
    assert first in built.index.read_text()


def test_unchanged_pages_are_kept_and_pages_of_removed_products_deleted(
    archive: Path, tmp_path: Path
) -> None:
    output = _copy(archive, tmp_path / "out")
    build_site(output)
    whole = contents(output / "site")
    pages = {path: path.stat().st_mtime_ns for path in (output / "site").rglob("*.*")}
    again = build_site(output)
    assert again.made == 0
    assert contents(output / "site") == whole
    assert pages == {path: path.stat().st_mtime_ns for path in pages}

    tampered = next((output / "site/product").rglob("*elastic*.html"))
    tampered.write_text("edited")
    changed = add(output, "signal", 1, title="Another title")
    gone = next((output / "products").rglob("*homogeneous*2027*.nc"))
    gone.unlink()
    third = build_site(output)
    assert third.made == 2
    assert third.products == 19
    assert "Another title" in (
        output / "site" / paths.product_page(changed.relative_to(output / "products").as_posix())
    ).read_text(encoding="utf-8")
    assert not list((output / "site").rglob("*2027*"))

    fresh = _copy(output, tmp_path / "fresh")
    build_site(fresh)
    assert contents(fresh / "site") == contents(output / "site")


def test_damaged_products_are_listed_and_the_others_shown(tmp_path: Path) -> None:
    output = tmp_path / "out"
    whole = add(output, "signal")
    cut = add(output, "elastic")
    cut.write_bytes(cut.read_bytes()[:20_000])
    (output / "products" / "empty.nc").write_bytes(b"")
    foreign = add_unknown(output, "multiangle")
    result = CliRunner().invoke(app, ["site", str(output), "--json"])
    assert result.exit_code == 1
    output_json = json.loads(result.stdout)
    assert output_json["products"] == 2
    products = output / "products"
    expected = sorted(path.relative_to(products).as_posix() for path in (cut, foreign))
    assert [problem["path"] for problem in output_json["problems"]] == sorted(
        [*expected, "empty.nc"]
    )
    index = (output / "site/index.html").read_text(encoding="utf-8")
    assert all(path in index for path in [*expected, "empty.nc"])
    assert str(tmp_path) not in index
    page = products.relative_to(output) and paths.product_page(
        whole.relative_to(products).as_posix()
    )
    assert (output / "site" / page).is_file()
    damaged = (output / "site/product/odesa/multiangle.html").read_text(encoding="utf-8")
    assert "it cannot be drawn as multiangle" in damaged


@pytest.mark.parametrize("damage", [b"{", b"["])
def test_damaged_provenance_is_a_problem(tmp_path: Path, damage: bytes) -> None:
    """Brackets nest too deep for the parser."""
    output = tmp_path / "out"
    path = add(output, "homogeneous")
    with netCDF4.Dataset(path, "a") as file:
        file["provenance"][...] = (
            damage * file["provenance"].shape[0] if file["provenance"].ndim else "{"
        )
    made = build_site(output)
    assert made.products == 1
    assert "provenance" in made.problems[0].reason


def test_text_from_files_is_escaped(tmp_path: Path) -> None:
    output = tmp_path / "out"
    evil = '<script>alert(1)</script>"><img src=x onerror=alert(2)>\u202e'
    add_unknown(
        output, "k", platform=evil, lidarops_channel=evil, lidarops_kind=evil, title=evil,
        lidarops_station="../../../up", lidarops_instrument=evil, lidarops_campaign=evil,
    )  # fmt: skip
    build_site(output)
    site = output / "site"
    for name, content in contents(site).items():
        if name.endswith(".html"):
            text = content.decode()
            assert "<script>" not in text
            assert "alert(1)</" not in text
            assert "<img src=x" not in text
            assert "\u202e" not in text
    assert {path.name for path in tmp_path.iterdir()} == {"out"}
    assert {path.name for path in output.iterdir()} == {"products", "site"}


def test_links_out_of_the_products_are_not_followed(tmp_path: Path) -> None:
    output = tmp_path / "out"
    kept = add(output, "signal")
    outside = tmp_path / "outside.nc"
    shutil.copy(kept, outside)
    (output / "products" / "link.nc").symlink_to(outside)
    made = build_site(output)
    assert made.products == 1
    assert made.problems[0].path == "link.nc"
    assert "leads out" in made.problems[0].reason


def test_a_folder_with_other_content_is_refused(tmp_path: Path) -> None:
    output = tmp_path / "out"
    add(output, "signal")
    (output / "site").mkdir()
    (output / "site" / "thesis.txt").write_text("mine")
    with pytest.raises(CatalogError, match="no site of lidarops"):
        build_site(output)
    assert contents(output / "site") == {"thesis.txt": b"mine"}
    with pytest.raises(ProductError, match="products"):
        build_site(tmp_path / "nothing")


def test_pages_are_not_written_through_a_link(tmp_path: Path) -> None:
    output = tmp_path / "out"
    add(output, "signal")
    build_site(output)
    shutil.rmtree(output / "site/product")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (output / "site/product").symlink_to(elsewhere)
    made = build_site(output)
    assert made.problems
    assert not list(elsewhere.iterdir())


def test_an_edited_manifest_only_costs_time(tmp_path: Path) -> None:
    output = tmp_path / "out"
    add(output, "signal")
    build_site(output)
    manifest = output / "site/manifest.json"
    whole = contents(output / "site")
    document: dict[str, Any] = json.loads(manifest.read_text())
    document["products"][0]["page"] = "../../../etc/passwd"
    for text in (json.dumps(document), "{", json.dumps({"format": "other"}), "[]"):
        manifest.write_text(text)
        assert build_site(output).made == 1
        assert contents(output / "site") == whole


def test_an_archive_without_products_has_a_site(tmp_path: Path) -> None:
    (tmp_path / "products").mkdir()
    made = build_site(tmp_path)
    assert made.products == 0
    assert "There is no product" in made.index.read_text(encoding="utf-8")


@given(st.text(min_size=1))
def test_slugs_are_safe_parts_of_paths(name: str) -> None:
    slug = paths.slug(name)
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", slug)
    assert slug not in {".", ".."}
    assert paths.slug(slug) == slug


@given(st.text(min_size=1).filter(lambda s: "\0" not in s), st.sampled_from(["", "a/", "a/b/"]))
def test_hrefs_lead_back_to_their_target(name: str, folder: str) -> None:
    target = f"product/{paths.slug(name)}.html"
    link = unquote(paths.href(target, f"{folder}page.html"))
    assert os.path.normpath(folder + link) == target


@pytest.mark.parametrize("path", ["/etc/passwd", "../x.nc", "a/../../x.nc", ""])
def test_paths_that_lead_out_are_refused(tmp_path: Path, path: str) -> None:
    with pytest.raises(ProductError, match="not a path inside"):
        within(tmp_path, path)


@pytest.mark.parametrize(
    ("share", "grade"),
    [
        (None, "unknown"),
        (0.0, "none"),
        (1e-9, "few"),
        (0.25, "some"),
        (0.75, "most"),
        (1.0, "most"),
    ],
)
def test_grades_cover_every_share(share: float | None, grade: str) -> None:
    assert grade_of(share) == grade
    assert grade in GRADES


_KILLED = """
import multiprocessing, os, signal, sys
from pathlib import Path
from lidarops.site.build import build_site

def kill(done):
    numbers = [str(child.pid) for child in multiprocessing.active_children()]
    Path(sys.argv[2]).write_text(" ".join(numbers))
    os.kill(os.getpid(), signal.SIGKILL)

if __name__ == "__main__":
    build_site(sys.argv[1], workers=2, progress=kill)
"""


def test_processes_end_with_a_killed_build(tmp_path: Path) -> None:
    for name in ("a.nc", "b.nc", "c.nc"):
        (tmp_path / "out/products").mkdir(parents=True, exist_ok=True)
        (tmp_path / "out/products" / name).write_bytes(b"no product")
    script = tmp_path / "killed.py"
    script.write_text(_KILLED)
    numbers = tmp_path / "numbers"
    command = [sys.executable, str(script), str(tmp_path / "out"), str(numbers)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    processes = [int(number) for number in numbers.read_text().split()]
    assert len(processes) == 2
    give_up = time.monotonic() + 20
    while any(Path(f"/proc/{process}").exists() for process in processes):
        assert time.monotonic() < give_up
        time.sleep(0.05)


def test_a_folder_without_products_is_wrong_use(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["site", str(tmp_path)])
    assert (result.exit_code, "holds no folder `products`" in result.output) == (2, True)
