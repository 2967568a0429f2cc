"""The site in a real browser: mouse, keyboard, no network, accessibility."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from support.archives.site_archive import CHROMIUM, add_unknown, browser, small_archive

from lidarops.site.build import build_site

AXE = Path(__file__).parent / "node_modules" / "axe-core" / "axe.min.js"
KINDS = ("signal", "homogeneous", "elastic", "multiangle")

pytest.importorskip("playwright", reason="playwright is not installed")
pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason="no Chromium here")


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
    build_site(output)
    return output / "site"


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as opened:
        yield opened


@pytest.fixture
def scheme(request: pytest.FixtureRequest) -> str:
    """The colour scheme; pages differ by it in colours only."""
    return str(getattr(request, "param", "light"))


both_schemes = pytest.mark.parametrize("scheme", ["light", "dark"], indirect=True)


@pytest.fixture
def watched(chromium: Any, scheme: str) -> Iterator[Watched]:
    size = {"width": 1280, "height": 900}
    context = chromium.new_context(viewport=size, color_scheme=scheme, accept_downloads=True)
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
    page.get_by_role("link", name="elastic, photon_532o").click()
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


@both_schemes
def test_calendar_to_download_by_keyboard(site: Path, watched: Watched) -> None:
    page = watched.page
    watched.open(site / "index.html")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    assert page.evaluate("document.activeElement.getBoundingClientRect().left") > 0
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"
    for words in ("March 2026", "usable, 6 products", "elastic, photon_532o"):
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


@pytest.mark.parametrize("width", [1280, 360])
def test_no_page_needs_sideways_scrolling(site: Path, watched: Watched, width: int) -> None:
    watched.page.set_viewport_size({"width": width, "height": 800})
    for name, file in _pages(site).items():
        watched.open(file)
        wide = watched.page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width, name


@both_schemes
def test_images_are_drawn_and_thumbnails_load(site: Path, watched: Watched) -> None:
    for file in _pages(site).values():
        watched.open(file)
        watched.page.evaluate("document.querySelectorAll('img').forEach(i => i.loading = 'eager')")
        _until(watched.page, "[...document.images].every(i => i.complete)")
        widths = watched.page.evaluate("[...document.images].map(i => i.naturalWidth)")
        assert all(width > 0 for width in widths), file
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
@pytest.mark.slow
@both_schemes
def test_axe_finds_nothing_serious(site: Path, chromium: Any, scheme: str) -> None:
    # The policy of the pages would block axe, as any script.
    context = chromium.new_context(color_scheme=scheme, bypass_csp=True)
    page = context.new_page()
    violations = []
    for name, file in _pages(site).items():
        page.goto(file.as_uri())
        page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        page.add_script_tag(path=AXE)
        result = page.evaluate("axe.run()")
        assert len(result["passes"]) > 10
        violations += [
            (name, item["id"], item["impact"], item["nodes"][0]["html"][:300])
            for item in result["violations"]
        ]
    context.close()
    assert not [item for item in violations if item[2] in {"serious", "critical"}], violations
    assert not violations, violations
