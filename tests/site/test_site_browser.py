"""The site in a real browser: mouse, keyboard, no network, accessibility."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.archives.site_archive import CHROMIUM, add_unknown, browser, small_archive
from support.products import fabricated as fab
from support.products.fabricated import START

from lidarops.records import Change, Grade, Stamp
from lidarops.reports.run_page import build_report
from lidarops.reports.run_record import save_run_record
from lidarops.site.build import build_site

AXE = Path(__file__).parent / "node_modules" / "axe-core" / "axe.min.js"
KINDS = ("signal", "homogeneous", "elastic", "multiangle", "visibility", "raman")
ELASTIC = "Backscatter of elastic profiles, 532 nm"
MOST_CLICKS = 5
"""Most clicks of a task for someone who knows nothing of the archive."""

pytest.importorskip("playwright", reason="playwright is not installed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no Chromium here"),
]


@dataclass
class Watched:
    """A page with its requests and error messages."""

    page: Any
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def failed(self, request: Any) -> None:
        # A download aborts the request for a page.
        if request.failure != "net::ERR_ABORTED" or not request.url.endswith(".nc"):
            self.complaints.append(request.url)

    def open(self, file: Path) -> None:
        self.page.goto(file.as_uri())


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = small_archive(tmp_path_factory.mktemp("browsed") / "out")
    add_unknown(output)
    (output / "products" / "damaged.nc").write_bytes(b"CDF")
    for folder in ("20260303T000000-1", "20260304T000000-1"):
        _report(output, folder)
    build_site(output)
    return output / "site"


def _report(output: Path, folder: str) -> None:
    """Write the report of a run with a problem of every sort."""
    start = START if folder < "20260304" else START + timedelta(days=1)
    archive = fab.Archive(output / "runs")
    good = archive.write("good.nc", fab.homogeneous(fab.times(START, 40, 600.0)), "homogeneous")
    change = Change(Grade.MAJOR, 4.0, "total_extinction", 0.1, ("settings",))
    changed = replace(good, usable=0, stamp=Stamp(2), change=change)
    scenes = [
        fab.outcome("one", START, products=(changed,)),
        fab.outcome("two", START, error="the far range is empty", seconds={}),
    ]
    refused = (fab.granule("raw/9", "is truncated"),)
    run = fab.run_record(archive.root, scenes, id=folder, started=start, refused=refused)
    save_run_record(run, output / "report" / folder)
    build_report(run, output / "report" / folder)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as opened:
        yield opened


@pytest.fixture
def watched(chromium: Any) -> Iterator[Watched]:
    size = {"width": 1280, "height": 900}
    context = chromium.new_context(viewport=size, accept_downloads=True)
    watched_page = Watched(context.new_page())
    watched_page.page.on("request", lambda request: watched_page.requests.append(request.url))
    watched_page.page.on("requestfailed", watched_page.failed)
    watched_page.page.on("console", lambda message: watched_page.complaints.append(message.text))
    watched_page.page.on("pageerror", lambda error: watched_page.complaints.append(str(error)))
    yield watched_page
    context.close()


def _pages(site: Path) -> dict[str, Path]:
    of_kind = {kind: next(site.glob(f"product/**/{kind}/**/*.html")) for kind in KINDS}
    return {
        "first": site / "index.html",
        "year": next(site.glob("station/*/2026.html")),
        "day": next(site.glob("station/*/*/2026-03-01.html")),
        "unknown": site / "product/odesa/wind.html",
        "report": site.parent / "report/20260304T000000-1/index.html",
        **of_kind,
    }


def _quiet(watched: Watched) -> None:
    assert not watched.complaints
    assert watched.requests
    assert {url.partition(":")[0] for url in watched.requests} <= {"file", "data"}


def test_calendar_to_download_by_mouse(site: Path, watched: Watched) -> None:
    page = watched.page
    watched.open(site / "index.html")
    page.get_by_role("link", name="March 2026").click()
    page.get_by_role("link", name="usable, 6 products").first.click()
    assert "2026-03-01" in page.get_by_role("heading", level=1).inner_text()
    page.get_by_role("link", name=ELASTIC).click()
    assert "Backscatter" in page.get_by_role("heading", level=1).inner_text()
    page.get_by_role("link", name="Provenance").click()
    provenance = page.get_by_role("heading", name="Provenance")
    assert provenance.is_visible()
    assert page.evaluate("location.hash") == "#provenance"
    with page.expect_download() as download:
        page.get_by_role("link", name="Download NetCDF").click()
    content = Path(download.value.path()).read_bytes()
    assert content == next(site.parent.glob("products/**/elastic/**/*20260301*.nc")).read_bytes()
    _quiet(watched)


def _until(page: Any, condition: str) -> None:
    """Wait for a condition; the pages forbid Playwright's own way, which evaluates text."""
    for _ in range(200):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"never true: {condition}")


def _tab_to(page: Any, words: str) -> None:
    for _ in range(60):
        page.keyboard.press("Tab")
        focused = page.evaluate(
            "document.activeElement.tagName === 'A' ? document.activeElement.textContent : ''"
        )
        if words in " ".join(focused.split()):
            outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
            assert outline == "solid", f"the focus on {words} cannot be seen"
            return
    raise AssertionError(f"the keyboard does not reach {words!r}")


def test_calendar_to_download_by_keyboard(site: Path, watched: Watched) -> None:
    page = watched.page
    watched.open(site / "index.html")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    assert page.evaluate("document.activeElement.getBoundingClientRect().left") > 0
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"
    for words in ("March 2026", "usable, 6 products", ELASTIC):
        _tab_to(page, words)
        with page.expect_navigation():
            page.keyboard.press("Enter")
    _tab_to(page, "Provenance")
    page.keyboard.press("Enter")
    _until(page, "location.hash === '#provenance'")
    watched.open(Path(page.url.removeprefix("file://").partition("#")[0]))
    _tab_to(page, "Download NetCDF")
    with page.expect_download() as download:
        page.keyboard.press("Enter")
    assert download.value.suggested_filename.endswith(".nc")
    _quiet(watched)


def test_no_page_needs_sideways_scrolling(site: Path, watched: Watched) -> None:
    for name, file in _pages(site).items():
        watched.open(file)
        for width in (1280, 390, 360):
            watched.page.set_viewport_size({"width": width, "height": 800})
            wide = watched.page.evaluate("document.documentElement.scrollWidth")
            assert wide <= width, (name, width)


def test_names_in_tables_are_not_broken_on_a_phone(site: Path, watched: Watched) -> None:
    watched.page.set_viewport_size({"width": 390, "height": 800})
    for name, file in _pages(site).items():
        watched.open(file)
        watched.page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        lines = watched.page.evaluate(
            """[...document.querySelectorAll('th code, td li code')]
                .map(e => [e.getClientRects().length, e.textContent])"""
        )
        assert [text for count, text in lines if count > 1] == [], name


def test_figures_are_drawn(site: Path, watched: Watched) -> None:
    for file in _pages(site).values():
        watched.open(file)
        watched.page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        for figure in watched.page.locator("div.fig").all():
            figure.scroll_into_view_if_needed()
        _until(
            watched.page,
            "[...document.querySelectorAll('div.fig')]"
            ".every(f => f.querySelector('canvas')?.height > 150)",
        )
    _quiet(watched)


def test_paper_has_the_figures_that_nobody_scrolled_to(site: Path, watched: Watched) -> None:
    page = watched.page
    watched.open(_pages(site)["elastic"])
    shapes = """[...document.querySelectorAll('div.fig canvas')]
        .map(c => [c.clientWidth, c.clientHeight, c.width / c.height])"""
    _until(page, "[...document.querySelectorAll('div.fig canvas')].every(c => c.height > 150)")
    assert page.evaluate("scrollY") == 0
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 700, "height": 900})
    drawn = page.evaluate(shapes)
    assert len(drawn) == 2
    for width, height, shape in drawn:
        assert width / height == pytest.approx(shape, rel=0.02)
    _quiet(watched)


def test_policy_blocks_other_sources(site: Path, watched: Watched) -> None:
    watched.open(site / "index.html")
    loaded = watched.page.evaluate(
        """() => new Promise(done => {
            const image = new Image();
            image.onload = () => done(true);
            image.onerror = () => done(false);
            image.src = 'http://127.0.0.1:9/pixel.png';
        })"""
    )
    assert not loaded
    assert any("Content Security Policy" in words for words in watched.complaints)


@pytest.mark.skipif(not AXE.exists(), reason="axe-core is not installed: npm ci in tests/site")
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing(site: Path, chromium: Any, scheme: str, width: int) -> None:
    # The policy of the pages would block axe, as any script.
    size = {"width": width, "height": 900}
    context = chromium.new_context(viewport=size, color_scheme=scheme, bypass_csp=True)
    page = context.new_page()
    violations = []
    for name, file in _pages(site).items():
        page.goto(file.as_uri())
        page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        page.wait_for_timeout(300)
        page.add_script_tag(path=AXE)
        result = page.evaluate("axe.run()")
        assert len(result["passes"]) > 10
        violations += [
            (name, item["id"], item["impact"], item["nodes"][0]["html"][:300])
            for item in result["violations"]
        ]
    context.close()
    assert not violations, violations


# Tasks of somebody who knows nothing of the archive --------------------------------------------


@dataclass
class Visitor:
    """Somebody who begins at the first page, and counts clicks."""

    page: Any
    clicks: int = 0

    def click(self, words: str, role: str = "link") -> Visitor:
        """Click what the words name."""
        if role == "summary":
            self.page.locator("summary", has_text=words).first.click()
        else:
            self.page.get_by_role(role, name=words).first.click()
        self.clicks += 1
        assert self.clicks <= MOST_CLICKS
        return self

    def reads(self, words: str) -> bool:
        """Return whether the words are visible on the page."""
        return bool(self.page.get_by_text(words).first.is_visible())

    def product(self, title: str) -> Visitor:
        """Go to a product of 1 March 2026."""
        return self.click("March 2026").click("usable, 6 products").click(title)


@pytest.fixture
def visitor(site: Path, watched: Watched) -> Visitor:
    watched.open(site / "index.html")
    return Visitor(watched.page)


def drawn(page: Any) -> Any:
    """Return the first figure of a page, drawn."""
    canvas = page.locator("div.fig canvas").first
    canvas.scroll_into_view_if_needed()
    _until(page, "document.querySelector('div.fig canvas').height > 200")
    return canvas


def test_find_the_extinction_at_a_time_as_a_number(site: Path, visitor: Visitor) -> None:
    visitor.product("Extinction of homogeneous sections")
    size = drawn(visitor.page).bounding_box()
    visitor.page.mouse.move(size["x"] + size["width"] / 2, size["y"] + 150)
    words = visitor.page.locator("div.fig output").first.inner_text()
    time, number, error = re.search(
        r"2026-03-01 (10:\d5):00 UTC, total extinction ([\d.]+) km.¹ ± ([\d.]+)", words
    ).groups()
    file = next(site.parent.glob("products/**/homogeneous/**/*20260301*.nc"))
    with xr.open_dataset(file) as product:
        one = product.sel(time=f"2026-03-01T{time}", method="nearest")
        shown = 1e3 * one["total_extinction"].values
        errors = 1e3 * one["total_extinction_standard_error"].values
    place = int(np.nanargmin(np.abs(shown - float(number))))
    assert float(number) == pytest.approx(shown[place], rel=0.01)
    assert float(error) == pytest.approx(errors[place], rel=0.1)


def test_a_figure_is_read_and_zoomed_by_keyboard_and_mouse(visitor: Visitor) -> None:
    page = visitor.product("Backscatter of elastic profiles").page
    canvas, words = drawn(page), page.locator("div.fig output").first
    canvas.focus()
    page.keyboard.press("ArrowRight")
    assert "aerosol backscatter" in words.inner_text()
    first = words.inner_text()
    page.keyboard.press("ArrowUp")
    assert words.inner_text() != first
    show_all = page.get_by_role("button", name="Show all").first
    assert not show_all.is_visible()
    for zoom in ("key", "mouse"):
        before = canvas.screenshot()
        if zoom == "key":
            page.keyboard.press("+")
        else:
            size = canvas.bounding_box()
            page.mouse.move(size["x"] + 200, size["y"] + 100)
            page.mouse.down()
            page.mouse.move(size["x"] + 400, size["y"] + 200)
            page.mouse.up()
        assert canvas.screenshot() != before
        assert show_all.is_visible()
        canvas.press("Escape")
        assert not show_all.is_visible()


def test_find_out_whether_it_was_cloudy(visitor: Visitor) -> None:
    visitor.product("Backscatter of elastic profiles")
    assert visitor.page.get_by_role("row", name="cloud").first.is_visible()


def test_find_a_setting_that_was_used(visitor: Visitor) -> None:
    visitor.product("Backscatter of elastic profiles").click("steps with settings", "summary")
    assert visitor.reads("lidar_ratio: 50.0")


def test_find_what_is_different_since_the_last_run(visitor: Visitor) -> None:
    visitor.click("Report of the last run")
    assert visitor.reads("1 product with other content")
    assert visitor.reads("0 files newly refused")


def test_find_how_to_cite(visitor: Visitor) -> None:
    visitor.product("Backscatter of elastic profiles").click("Citation and licence")
    assert visitor.reads("A. Person (20")
    assert visitor.reads("Licence: CC-BY-4.0")


def test_find_the_list_of_a_month(visitor: Visitor) -> None:
    visitor.click("March 2026").click("List of all files of the month")
    text = visitor.page.evaluate("document.body.innerText")
    assert text.count(".nc") == 13


def test_find_how_to_open_all_values(visitor: Visitor) -> None:
    visitor.product("Backscatter of elastic profiles").click("File")
    assert visitor.reads('xarray.open_dataset("odesa_lidar-1_elastic_photon_532o_')


def test_values_under_the_pointer_are_those_of_the_file(site: Path, visitor: Visitor) -> None:
    visitor.product("Backscatter of elastic profiles")
    size = drawn(visitor.page).bounding_box()
    file = next(site.parent.glob("products/**/elastic/**/*20260301*.nc"))
    with xr.open_dataset(file, decode_timedelta=False) as product:
        usable = product["usable"] < 2
        stored = 1e6 * product["aerosol_backscatter"].where(usable).astype(float).load()
    output, compared = visitor.page.locator("div.fig output").first, 0
    for across, up in itertools.product(np.linspace(0.15, 0.85, 8), np.linspace(0.1, 0.5, 8)):
        visitor.page.mouse.move(size["x"] + across * size["width"], size["y"] + up * size["height"])
        place = re.match(r"(\S+ \S+) UTC, range ([\d.]+) km: ([^;]*)", output.inner_text())
        if place is None:
            continue
        # What is read is rounded, maybe into the next bin.
        values = [
            float(stored.sel(time=place[1], range=1e3 * float(place[2]) + shift, method="nearest"))
            for shift in (-6.0, 0.0, 6.0)
        ]
        number = re.match(r"aerosol backscatter ([\d.]+) Mm.*sr⁻¹$", place[3])
        if number is None:
            end = place[3].endswith(("less", "more"))
            assert end or any(not value > 0.0 for value in values), place[0]
        else:
            assert any(value == pytest.approx(float(number[1]), rel=0.02) for value in values)
            compared += 1
    assert compared > 10


def test_go_to_the_next_day_of_a_channel(visitor: Visitor) -> None:
    visitor.product("Backscatter of elastic profiles").click("2026-03-02 10:00 UTC")
    assert visitor.reads("2026-03-02, 10:00 to")


def test_go_to_another_channel_or_kind_of_the_same_time(visitor: Visitor) -> None:
    visitor.product("Backscatter of elastic profiles").click("Other kinds", "summary")
    visitor.click("Range-corrected signals")
    assert visitor.reads("2026-03-01, 10:00 to")


def test_find_where_the_station_is_and_its_data(visitor: Visitor) -> None:
    assert visitor.reads("46.44\u00b0 N, 30.76\u00b0 E")


def test_choose_another_date(visitor: Visitor) -> None:
    visitor.click("March 2026").click("usable, 6 products").click("Choose another day", "summary")
    visitor.page.locator("table.days a:not([aria-current])").first.click()
    assert visitor.page.url.endswith("2026-03-02.html")


def test_see_the_failures_of_the_last_run(visitor: Visitor) -> None:
    visitor.click("Report of the last run").click("Failed")
    assert visitor.reads("the far range is empty")
