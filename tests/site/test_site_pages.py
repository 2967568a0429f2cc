"""What pages show: neighbours, downloads, citation."""

from __future__ import annotations

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
import xarray as xr
from netCDF4 import Dataset
from support.archives.site_archive import add, contents, small_archive
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.errors import CatalogError
from lidarops.figures import image_panels
from lidarops.figures.panels import Axis
from lidarops.reports.product_contents import campaign, citation
from lidarops.site import build
from lidarops.site.build import build_site


class _Links(HTMLParser):
    """Collects links with their text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: dict[str, str] = {}
        self._href: str | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "a":
            self._href = dict(attrs).get("href")
            self.found.setdefault(self._href or "", "")

    def handle_data(self, data: str) -> None:
        if self._href is not None:
            self.found[self._href] += data

    def handle_endtag(self, tag: str) -> None:
        if tag == "a":
            self._href = None


def links(page: Path) -> dict[str, str]:
    """Return the text of links by what they lead to."""
    return _Links(page.read_text(encoding="utf-8")).found


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = small_archive(tmp_path_factory.mktemp("pages") / "out")
    build_site(made)
    return made


def page_of(output: Path, kind: str, day: str = "20260301") -> Path:
    return next((output / "site").glob(f"product/odesa/lidar-1/{kind}/**/*{day}T*.html"))


def test_what_cannot_be_shown_does_not_cost_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise MemoryError("no memory")

    monkeypatch.setattr(build, "read_quality", fail)
    output = tmp_path / "out"
    add(output, "signal")
    made = build_site(output)
    assert made.products == 1
    assert made.problems[0].reason.endswith(": no memory")
    assert "no memory" in page_of(output, "signal").read_text("utf-8")


def test_an_axis_that_is_not_finite_is_a_problem_of_the_product(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "out"
    add(output, "signal")
    monkeypatch.setattr(image_panels, "time_axis", lambda *_: Axis("time", 0.0, np.nan))
    made = build_site(output)
    assert made.products == 1
    assert "it cannot be drawn as signal" in made.problems[0].reason
    assert "NaN" not in page_of(output, "signal").read_text("utf-8")


def test_a_product_leads_to_the_previous_the_next_and_its_siblings(output: Path) -> None:
    pages = [page_of(output, "elastic", day) for day in ("20260301", "20260302", "20260410")]
    for place, page in enumerate(pages):
        text = page.read_text(encoding="utf-8")
        ends = {
            rel: (page.parent / unquote(href)).resolve()
            for rel, href in re.findall(r'<a rel="(prev|next)" href="([^"]+)"', text)
        }
        expected = dict(zip(("prev", "next"), (pages[place - 1 :: 1][:1], pages[place + 1 :][:1]),
                            strict=True))  # fmt: skip
        if place == 0:
            expected["prev"] = []
        assert ends == {rel: other[0].resolve() for rel, other in expected.items() if other}
        siblings = [page_of(output, "signal", page.stem[-15:-7]), page_of(output, "raman",
                    page.stem[-15:-7])]  # fmt: skip
        targets = {(page.parent / unquote(href)).resolve() for href in links(page)}
        assert {sibling.resolve() for sibling in siblings} <= targets


def test_a_new_product_changes_only_the_links_of_its_neighbours(tmp_path: Path) -> None:
    output = tmp_path / "out"
    for day in (0, 2):
        add(output, "signal", day)
    build_site(output)
    add(output, "signal", 1)
    again = build_site(output)
    assert (again.made, again.products) == (1, 3)
    first = page_of(output, "signal", "20260301").read_text("utf-8")
    assert "2026-03-02 10:00 UTC" in first
    fresh = tmp_path / "fresh"
    shutil.copytree(output / "products", fresh / "products")
    build_site(fresh)
    assert contents(fresh / "site") == contents(output / "site")


def test_metadata_come_after_figure_and_quality_and_are_folded(output: Path) -> None:
    text = page_of(output, "elastic").read_text(encoding="utf-8")
    marks = ("class=\"cell g-", '<div class="fig"', 'id="quality"', 'id="use"',
             'id="provenance"', 'id="variables"')  # fmt: skip
    order = [text.index(mark) for mark in marks]
    assert order == sorted(order)
    for words in ("Steps carried out</h3>\n<details>", "</h2>\n<details><summary>4 files"):
        assert words in text


def test_citation_and_licence_are_those_of_the_file(output: Path) -> None:
    page = page_of(output, "elastic")
    file = output / "products" / page.relative_to(output / "site/product").with_suffix(".nc")
    text = page.read_text(encoding="utf-8")
    cited = text[text.index('class="cite"') :].partition("</p>")[0]
    with xr.open_dataset(file, decode_timedelta=False) as product:
        for name in ("creator_name", "id", "product_version"):
            assert str(product.attrs[name]) in cited
        assert product.attrs["date_issued"][:4] in cited
        assert f"Licence: {product.attrs['license']}" in text
        contact = ", ".join(product.attrs[f"creator_{part}"] for part in ("name", "email"))
        assert f"Contact: {contact}" in text


def test_a_citation_without_an_author_begins_with_the_title() -> None:
    attributes = {"title": "Mini: signals.", "date_issued": "2026-03-02", "id": "a"}
    assert citation(xr.Dataset(attrs=attributes)) == "Mini: signals (2026). a."
    assert citation(xr.Dataset(attrs={"title": "Mini"})) == "Mini."


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("https://data.example.org/lidar/", "https://data.example.org/lidar/odesa/"),
        ("..", "../../../../../../odesa/"),
    ],
)
def test_downloads_lead_where_products_are_published(
    tmp_path: Path, place: str, expected: str
) -> None:
    output = tmp_path / "out"
    file = add(output, "signal")
    result = CliRunner().invoke(app, ["site", str(output), "--products-at", place])
    assert result.exit_code == 0, result.output
    name = file.relative_to(output / "products").as_posix()
    (href,) = (h for h, words in links(page_of(output, "signal")).items() if "NetCDF" in words)
    assert href == f"{expected}{name.removeprefix('odesa/')}"
    (listing,) = (output / "site").rglob("2026-03.txt")
    assert listing.read_text().endswith(f"{name}\n")


@pytest.mark.parametrize("place", ["javascript:alert(1)", "/etc", "a b", '"><script>', "ftp://x"])
def test_other_places_are_refused(tmp_path: Path, place: str) -> None:
    add(tmp_path, "signal")
    with pytest.raises(CatalogError, match="neither an address nor a relative place"):
        build_site(tmp_path, products_at=place)
    with pytest.raises(CatalogError, match="neither an address nor a relative place"):
        build_site(tmp_path, reports_at=place)


def test_a_month_can_be_downloaded_from_its_list(output: Path) -> None:
    site = output / "site"
    listing = site / "station/odesa/2026-03.txt"
    files = [(listing.parent / unquote(line)).resolve() for line in listing.read_text().split()]
    assert sorted(files) == sorted((output / "products").resolve().rglob("*202603*.nc"))
    assert "2026-03.txt" in links(site / "station/odesa/2026.html")


def test_days_lead_to_the_others_of_their_month(output: Path) -> None:
    assert "2026-03-02.html" in links(output / "site/station/odesa/2026/2026-03-01.html")


def test_human_names_stand_beside_identifiers(output: Path) -> None:
    text = page_of(output, "signal").read_text("utf-8")
    assert "<h1>Range-corrected signals, 532 nm, photon counting (photon_532o)</h1>" in text
    assert "Одеса, hill; Lidar One; 2026-03-01, 10:00 to 10:50\u00a0UTC" in text
    assert "532 nm, photon counting (photon_532o)</" in text


def test_the_stac_item_is_linked_where_it_exists(tmp_path: Path) -> None:
    output = tmp_path / "out"
    add(output, "signal")
    build_site(output)
    assert "STAC" not in page_of(output, "signal").read_text("utf-8")
    pytest.importorskip("pystac")
    assert CliRunner().invoke(app, ["aggregate", str(output), "--stac"]).exit_code == 0
    build_site(output)
    page = page_of(output, "signal")
    (item,) = (href for href, words in links(page).items() if words == "STAC item")
    document = json.loads((page.parent / unquote(item)).read_text())
    assert document["id"] == page.stem
    index = output / "site/index.html"
    (catalog,) = (href for href, words in links(index).items() if words == "STAC catalog")
    assert (index.parent / catalog).is_file()


@pytest.mark.slow
def test_a_published_site_links_catalog_and_report_where_they_are(tmp_path: Path) -> None:
    output = tmp_path / "out"
    add(output, "signal")
    catalog, report = output / "aggregates/stac/catalog.json", output / "report/run-1/index.html"
    for file in (catalog, report):
        file.parent.mkdir(parents=True)
        file.write_text("{}")

    def shown(*options: str) -> dict[str, str]:
        result = CliRunner().invoke(app, ["site", str(output), "--products-at", "..", *options])
        assert result.exit_code == 0, result.output
        return {words: href for href, words in links(output / "site/index.html").items()}

    assert not {"STAC catalog", "Report of the last run"} & shown().keys()
    places = shown("--stac-at", "https://example.org/stac", "--reports-at", "../../reports")
    assert places["STAC catalog"] == "https://example.org/stac/catalog.json"
    assert places["Report of the last run"] == "../../reports/run-1/index.html"


def test_stations_have_their_position(output: Path) -> None:
    text = (output / "site/index.html").read_text("utf-8")
    assert 'id="s-odesa"' in text
    assert "46.44° N, 30.76° E, 53.5 m" in text


def test_a_network_is_in_the_middle_of_its_crossings(output: Path) -> None:
    manifest = json.loads((output / "site/manifest.json").read_text())
    (entry, *_) = (row for row in manifest["products"] if row["kind"] == "visibility")
    with xr.open_dataset(output / "products" / entry["path"], decode_timedelta=False) as product:
        assert entry["latitude"] == pytest.approx(float(product["latitude"].mean()))
        assert entry["longitude"] == pytest.approx(float(product["longitude"].mean()))


def test_the_first_page_is_titled_by_the_campaign() -> None:
    key = {"lidarops_campaign": "demo"}
    title = {"title": "Demonstration: a day: Aerosol backscatter, channel glued_532o, hill"}
    assert campaign(xr.Dataset(attrs=key | title)) == "Demonstration: a day"
    assert campaign(xr.Dataset(attrs=key)) == "demo"


def test_a_product_without_bits_says_so(tmp_path: Path) -> None:
    output = small_archive(tmp_path / "out")
    product = next((output / "products").rglob("*elastic*.nc"))
    with Dataset(product, "a") as opened:
        opened["quality_flag"][:] = 0
    build_site(output)
    page = output / "site/product" / product.relative_to(output / "products").with_suffix(".html")
    section = page.read_text(encoding="utf-8").partition('<h2 id="quality">')[2]
    assert section.partition("</section>")[0].endswith("<p>No value has a quality bit.</p>\n")
