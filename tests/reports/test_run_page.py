"""The report of a run: complete, self-contained, escaped; damaged inputs do not stop it."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote_to_bytes

import pytest
from support.products import fabricated as fab
from support.products.fabricated import (
    CHANNEL,
    START,
    homogeneous,
    outcome,
    run_record,
    signal,
    times,
)

from lidarops.errors import CatalogError
from lidarops.figures.wording import (
    counted,
    duration,
    named_shares,
    percent,
    size,
    verdicts_in_words,
)
from lidarops.flags import Severity
from lidarops.kinds import flags_of
from lidarops.records import (
    FileNote,
    Findings,
    IdlePattern,
    LeftOut,
    LostFiles,
    Plan,
    PlannedStep,
    ProductRecord,
    Unmade,
    Unmet,
    UnusableFile,
)
from lidarops.reports import run_page, run_tables
from lidarops.reports import run_record as record

VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """A parsed page: text, links, ids, headings. Tags that do not nest fail."""

    def __init__(self, path: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.folder = path.parent
        self.open: list[str] = []
        self.links: list[str] = []
        self.sources: list[str] = []
        self.scripts: list[str] = []
        self.figures = 0
        self.ids: list[str] = []
        self.tags: list[str] = []
        self.words: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        self.ids += [attributes["id"]] if "id" in attributes else []
        self.links += [attributes["href"]] if "href" in attributes else []
        self.sources += [attributes["src"]] if "src" in attributes else []
        self.scripts += [attributes.get("type", "")] if tag == "script" else []
        self.figures += attributes.get("class") == "fig"

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in {"style", "script"}:
            self.words.append(data)

    def target(self, link: str) -> Path:
        return self.folder / os.fsdecode(unquote_to_bytes(link))


def built(run, folder: Path, **options) -> Page:
    """Build a page and check what must hold for every page."""
    path = run_page.build_report(run, folder, **options).page
    assert path == folder / "index.html"
    page = Page(path)
    assert page.tags.count("h1") == 1
    assert len(page.ids) == len(set(page.ids))
    # One script, which draws the data.
    assert page.scripts == ["", *["application/json"] * page.figures]
    assert page.sources == ["figures.js"]
    for link in [*page.links, *page.sources]:
        assert not link.startswith(("http:", "https:", "//", "data:", "javascript:"))
        if link.startswith("#"):
            assert link[1:] in page.ids
        else:
            assert page.target(link).is_file(), link
    text = path.read_text()
    assert "http" not in text.replace("http-equiv", "")
    # Only the script and the style sheet beside the page apply, whatever a name or text of the
    # archive holds.
    assert "<style" not in text
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="(.*?)"', text)
    assert policy.startswith("default-src 'none'; style-src 'self' file:; script-src 'self' file:;")
    assert " style=" not in text
    return page


class TestSimulatedRun:
    def test_has_every_section_and_figure_and_is_reproducible(self, simulated, tmp_path):
        page = built(simulated, tmp_path / "report")
        again = run_page.build_report(simulated, tmp_path / "report-again").page.parent
        files = [path.relative_to(page.folder) for path in page.folder.rglob("*.*")]
        for path in files:
            assert (page.folder / path).read_bytes() == (again / path).read_bytes()
        for words in (
            "Demonstration campaign", "20240302T000000-1a2b", "0.1.0+abc123", "1 min 30 s",
            "Processed scenes", "Steps left out", "Flagged values", "Refused files",
            "Failed scenes", "Provenance",
            simulated.scenes[0].plan.hash, "a" * 64,
        ):  # fmt: skip
            assert words in page.text
        # Retrieval, quicklook.
        assert page.figures == 2
        products = [link for link in page.links if link.endswith(".nc")]
        assert [page.target(link).resolve().name for link in products] == [
            "extinction.nc", "signal.nc",
        ]  # fmt: skip

    def test_counts_are_those_of_the_products(self, simulated, tmp_path):
        page = built(simulated, tmp_path / "report", figures=0)
        for product in simulated.scenes[0].products:
            good, care, reject = (percent(n / product.values) for n in product.verdicts)
            shares = f"{good} good, {care} care, {reject} reject of {product.values:,} values"
            assert f"Quality, {product.kind} {shares}" in page.text
            for name, count in product.flagged.items():
                bit = flags_of(product.kind).named(name)
                row = f"{product.kind} {name} "
                row += "use with care" if bit.severity is Severity.CARE else "do not use"
                row += f" {bit.description} {count:,} {percent(count / product.values)} 1"
                assert row in page.text

    def test_run_record_is_linked_if_it_exists(self, simulated, tmp_path):
        assert "run.json" not in built(simulated, tmp_path / "report", figures=0).links
        record.save_run_record(simulated, tmp_path / "report")
        assert "run.json" in built(simulated, tmp_path / "report", figures=0).links


class TestUnusableFiles:
    def test_are_listed_and_do_not_stop_the_report(self, simulated, archive, tmp_path):
        time = times(START, 6, 60.0)
        write = archive.write
        kinds = {
            "gone.nc": write("gone.nc", homogeneous(time), "homogeneous"),
            "garbage.nc": write("garbage.nc", homogeneous(time), "homogeneous"),
            "cut.nc": write("cut.nc", signal(time), "signal"),
            "foreign.nc": write("foreign.nc", homogeneous(time), "homogeneous"),
            "swapped.nc": replace(
                write("swapped.nc", homogeneous(time), "homogeneous"),
                kind="signal",
            ),
            "empty.nc": write("empty.nc", signal(time), "signal"),
            "rotten.nc": write("rotten.nc", signal(time), "signal"),
        }
        (archive.root / "gone.nc").unlink()
        (archive.root / "garbage.nc").write_bytes(b"\x00garbage")
        whole = (archive.root / "cut.nc").read_bytes()
        (archive.root / "cut.nc").write_bytes(whole[: len(whole) // 2])
        homogeneous(time).drop_vars("background").to_netcdf(archive.root / "foreign.nc")
        (archive.root / "empty.nc").write_bytes(b"")
        # A file that opens, but whose data fail their checksum.
        rotten = archive.root / "rotten.nc"
        encoding = {"signal": {"fletcher32": True, "chunksizes": (6, 600)}}
        signal(time).to_netcdf(rotten, encoding=encoding)
        values = signal(time)["signal"].values.tobytes()
        whole = rotten.read_bytes()
        assert values in whole
        rotten.write_bytes(whole.replace(values, b"\x01" * len(values)))
        scene = outcome("bad", products=tuple(kinds.values()))
        page = built(replace(simulated, scenes=(*simulated.scenes, scene)), tmp_path / "report")
        start = page.text.index("Files that this report could not use")
        listed = page.text[start : page.text.index("Processed scenes", start)]
        assert all(name in listed for name in kinds)
        assert "gone.nc the file is missing" in listed
        assert "foreign.nc background: is missing from the product" in listed
        assert str(archive.root) not in listed
        assert "(file missing)" in page.text
        assert page.figures == 2

    def test_folder_that_cannot_be_written(self, simulated, tmp_path):
        (tmp_path / "file").write_text("in the way")
        with pytest.raises(CatalogError, match="file"):
            run_page.build_report(simulated, tmp_path / "file")


class TestDegenerateRuns:
    def test_no_scene(self, tmp_path):
        page = built(run_record(tmp_path), tmp_path / "report")
        assert "There was no scene to process." in page.text
        assert page.figures == 0
        assert run_tables.instruments(run_record(tmp_path)) == []
        assert run_page.build_report(run_record(tmp_path), tmp_path / "q").quicklook is None

    def test_failures_only(self, tmp_path):
        scenes = [
            outcome(f"s{i}", plan=None, error=f"reason number {i}", seconds={}) for i in range(3)
        ]
        refused = [fab.granule(f"raw/{i}", f"cause {i % 2}") for i in range(9)]
        refused[0] = replace(refused[0], start=datetime(2026, 3, 1, tzinfo=UTC))
        run = run_record(tmp_path, scenes, refused=tuple(refused))
        page = built(run, tmp_path / "report")
        assert "3 scenes failed and 9 files refused." in page.text
        assert "while cataloguing 2026-03-01 raw/0" in page.text
        assert "while cataloguing not known raw/1" in page.text
        for i in range(3):
            assert f"reason number {i}" in page.text
        for granule in refused:
            assert granule.path in page.text
        (row,) = run_tables.instruments(run)
        assert (row["scenes"], row["failed"], row["refused"]) == (3, 3, 9)
        assert row["quality"] == "no value"

    def test_internal_errors_stand_apart_from_failed_scenes(self, tmp_path):
        trace = "Traceback (most recent call last):\n  File <a>\nTypeError: no"
        bug = outcome("s1", error="internal error: TypeError: no", internal=trace, seconds={})
        scenes = [outcome("s0", error="bad data", seconds={}), bug]
        run = run_record(tmp_path, scenes)
        page = built(run, tmp_path / "report")
        assert "1 scene ended with an internal error and 1 scene failed." in page.text
        failed, _, internal = page.text.partition("Internal errors These scenes")
        assert "bad data" in failed.rpartition("Failed scenes")[2]
        assert "TypeError" not in failed.rpartition("Failed scenes")[2]
        assert "traceback Traceback (most recent call last): File <a> TypeError: no" in internal
        (row,) = run_tables.instruments(run)
        assert (row["scenes"], row["failed"], row["internal errors"]) == (2, 1, 1)
        assert run_tables.outcome_word(bug) == "internal error"
        without = built(run_record(tmp_path, scenes[:1]), tmp_path / "without")
        assert "internal" not in without.ids

    def test_a_scene_without_products_is_not_done(self, tmp_path):
        page = built(run_record(tmp_path, [outcome("quiet")]), tmp_path / "report")
        assert "20 no product" in page.text

    @pytest.mark.parametrize(("second", "shown"), [(0, "18:30"), (5, "18:30:05")])
    def test_the_start_of_a_scene_is_shown_to_the_second(self, tmp_path, second, shown):
        scene = replace(outcome("s"), start=datetime(2026, 3, 1, 18, 30, second, tzinfo=UTC))
        built(run_record(tmp_path, [scene]), tmp_path / "report")
        page = (tmp_path / "report" / "index.html").read_text()
        assert f">2026-03-01 {shown}</td>" in page

    def test_product_without_values(self, tmp_path):
        empty = ProductRecord("x.nc", "homogeneous", "c", "", 0, 0, {}, 0)
        page = built(run_record(tmp_path, [outcome("s", products=(empty,))]), tmp_path / "report")
        assert "x.nc" in page.text

    def test_what_the_data_did_not_give_is_in_verdict_and_findings(self, tmp_path):
        note = "dead_time: estimate of photon_355o: the data give none"
        run = run_record(tmp_path, [replace(outcome(name), notes=(note,)) for name in "ab"])
        assert note in run_tables.verdict(run)
        assert built(run, tmp_path / "report").text.count(note) >= 2

    def test_a_scene_without_a_usable_value_is_a_problem_in_the_verdict(self, tmp_path):
        bad = ProductRecord("x.nc", "elastic", "c", "", 0, 9, {}, 0, 0)
        good = replace(bad, path="y.nc", usable=5)
        idle = replace(bad, path="z.nc", kind="homogeneous")
        scenes = [outcome("cloudy", products=(bad,)), outcome("clear", products=(good, idle))]
        run = run_record(tmp_path, scenes)
        verdict = "1 scene without a usable value: cloudy. 2 of 3 products have no usable value."
        assert verdict in built(run, tmp_path / "report").text
        assert run_tables.outcome_word(scenes[0]) == "no usable value"
        assert run_tables.outcome_word(scenes[1]) == "done"
        refused = replace(run, refused=(fab.granule("raw/0", "cause"),))
        assert run_tables.verdict(refused).startswith("1 file refused and 1 scene without a")
        only_idle = replace(run, scenes=scenes[1:])
        verdict = "1 of 2 products has no usable value. All files were read."
        assert run_tables.verdict(only_idle) == verdict
        assert run_tables.outcome_class(only_idle) == "care"

    def test_unknown_bits_are_shown(self, tmp_path):
        odd = ProductRecord("x.nc", "signal", "c", "", 0, 10, {"cosmic": 4}, 6)
        page = built(run_record(tmp_path, [outcome("s", products=(odd,))]), tmp_path / "report")
        assert "cosmic unknown bit unknown to this version of lidarops 4 40.0 % 1" in page.text


class TestDecisions:
    def test_rule_and_number_of_a_step_are_shown(self, archive, tmp_path):
        step = PlannedStep("dark", CHANNEL, {}, "16 dark files", rule="dark", number=16.0)
        plan = replace(fab.plan("one"), steps=(step,))
        scene = outcome("one", START, plan=plan, cpu_seconds=3.0)
        page = built(run_record(archive.root, [scene]), tmp_path / "report")
        assert f"dark 16 dark files dark 16 {CHANNEL}" in page.text
        assert "CPU time of scenes 3.0 s" in page.text


class TestManyScenes:
    @pytest.fixture
    def many(self, archive, tmp_path):
        """300 scenes of two instruments with 6 real products and few distinct reasons."""
        scenes = []
        for i in range(300):
            start = START + timedelta(days=i)
            name = ("horizontal", "vertical")[i % 2]
            left = (
                LeftOut("dark", CHANNEL, "no dark files within 24 h of the scene"),
                LeftOut("dark", "analog_355o", "no dark files within 24 h of the scene"),
                LeftOut(
                    "overlap",
                    CHANNEL,
                    f"the campaign gives none for {name}",
                    rule="overlap",
                    number=float(i // 100),
                ),
            )
            products = ()
            if i % 50 == 0:
                product = homogeneous(times(start, 30, 60.0), seed=i)
                products = (archive.write(f"{i}.nc", product, "homogeneous"),)
            scenes.append(
                outcome(
                    f"{name}_{i:03d}", start, instrument=name, products=products,
                    plan=fab.plan(f"{name}_{i:03d}", *left),
                    refused=(fab.granule(f"raw/{i}", "is truncated"),),
                )
            )  # fmt: skip
        return run_record(archive.root, scenes)

    def test_reasons_are_grouped_and_every_scene_is_listed(self, many, tmp_path):
        page = built(many, tmp_path / "report")
        for scene in many.scenes:
            assert scene.scene in page.text
            assert scene.refused[0].path in page.text
        reason = "no dark files within 24 h of the scene"
        assert page.text.count(reason) == 1
        assert f"dark {reason} analog_355o, {CHANNEL} horizontal, vertical 300" in page.text
        row_text = "the campaign gives none for vertical overlap 0 to 2 photon_532o vertical 150"
        assert row_text in page.text
        assert page.text.count("is truncated") == 1
        assert "300 files" in page.text
        # One figure for the instrument over all its scenes.
        assert len(page.sources) == 1

    def test_scenes_without_product_and_missing_channels_are_listed(self, many, tmp_path):
        """What no plan states: kinds and channels left out altogether, scenes without product."""
        idle = LeftOut("homogeneous", "analog_532o", "it climbs by 3750 m", rule="section_level")
        more = replace(
            many,
            scenes=tuple(replace(scene, left_out=(idle,)) for scene in many.scenes),
            empty_scenes={f"idle_{k}": "nothing to do: it climbs" for k in range(7)},
            more_empty_scenes=1200,
            findings=Findings(
                unmet=(
                    Unmet(
                        "vertical", "photon_533o", "facts", "the files hold no such", 150, 150, 0
                    ),
                    Unmet(
                        "vertical", "photon_607o", "signal", "the files hold no such", 20, 150, 130
                    ),
                )
            ),
        )
        page = built(more, tmp_path / "report")
        row_text = "it climbs by 3750 m section_level analog_532o horizontal, vertical 300"
        assert row_text in page.text
        assert "7 scenes" in page.text
        assert all(f"idle_{k}" in page.text for k in range(7))
        assert "1,200 more without product" in page.text
        assert "photon_533o facts the files hold no such all 150 files" in page.text
        assert "photon_607o signal the files hold no such 20 of 150 files" in page.text
        verdict = run_tables.verdict(more)
        assert "1,207 scenes without product" in verdict
        assert "1 requested channel in no file: photon_533o" in verdict
        # The hashes of the plans stay the same.
        hashes = [[scene.plan.hash for scene in run.scenes] for run in (many, more)]
        assert hashes[0] == hashes[1]

    def test_a_range_window_without_effect_is_marked(self, tmp_path):
        window = PlannedStep(
            "range_window",
            CHANNEL,
            {"bins": [[0, 9]]},
            "sections need no farther bins",
            product="homogeneous",
        )
        signal = PlannedStep("signal", CHANNEL, {}, "requested", product="signal")
        scenes = [
            outcome(name, plan=Plan(name, steps, ()))
            for name, steps in (("alone", (window,)), ("both", (window, signal)))
        ]
        scenes_by_reason = {
            row["reason"]: row["scenes"]
            for row in run_tables.carried_out(run_record(tmp_path, scenes))
        }
        assert scenes_by_reason == {
            "requested": 1,
            "sections need no farther bins": 1,
            "sections need no farther bins; no effect: signal needs all bins": 1,
        }

    def test_long_tables_are_cut_with_a_note(self, many, tmp_path, monkeypatch):
        monkeypatch.setattr(run_page, "ROWS", 40)
        page = built(many, tmp_path / "report")
        assert "The first 40 of 300 scenes; all are in the run record." in page.text
        assert "The first 40 of 300 files; all are" in page.text
        # The hashes of 300 plans and 6 products.
        assert "The first 40 of 306 rows; all are" in page.text
        assert "raw/99" not in page.text

    def test_figures_are_limited_and_the_other_channels_are_listed(self, archive, tmp_path):
        time = times(START, 5, 60.0)
        names = [f"photon_{300 + i}o" for i in range(3)]
        products = tuple(
            replace(
                archive.write(f"{name}.nc", signal(time, bins=50), "signal"),
                channel=name,
            )
            for name in names
        )
        run = run_record(archive.root, [outcome("s", products=products)])
        page = built(run, tmp_path / "report", figures=1)
        assert page.figures == 1
        assert "2 channels are not drawn" in page.text
        assert all(name in page.text for name in names)

    def test_scenes_lead_to_the_figures_of_each_of_many_instruments(self, archive, tmp_path):
        product = archive.write("p.nc", signal(times(START, 5, 60.0), bins=50), "signal")
        names = [f"lidar-{number}" for number in range(10)]
        scenes = [outcome(name, instrument=name, products=(product,)) for name in names]
        page = built(run_record(archive.root, scenes), tmp_path / "report")
        assert {f"#figures-{number}" for number in range(1, 11)} <= set(page.links)

    def test_a_quicklook_comes_first_and_what_is_not_usable_is_folded(self, archive, tmp_path):
        time = fab.times(START, 12, 900.0)
        made = {
            ("signal", "a"): {"unflagged": 10},
            ("signal", "b"): {"unflagged": 20},
            ("homogeneous", "a"): {"usable": 5},
            ("homogeneous", "b"): {"usable": 0, "flagged": {"poor_fit": 12}, "values": 12},
        }
        products = tuple(
            replace(
                archive.write(f"{kind}_{channel}.nc", getattr(fab, kind)(time), kind),
                channel=channel,
                **changes,
            )
            for (kind, channel), changes in made.items()
        )
        run = run_record(archive.root, [outcome("s", products=products)])
        run_page.build_report(run, tmp_path / "report")
        text = (tmp_path / "report/index.html").read_text("utf-8")
        shown, folded = text.split("figures of products without usable values")
        found = re.findall(r"<summary>(Range|Extinction)", shown)
        assert found == ["Range", "Extinction", "Range"]
        pictures = run_page.gallery.fill(run).pictures
        assert [(one.caption.split()[0], bool(one.lacking)) for one in pictures] == [
            ("Range-corrected", False),
            ("Extinction", False),
            ("Range-corrected", False),
            ("Extinction", True),
        ]
        assert "<summary>Extinction" in folded
        reason = flags_of("homogeneous").named("poor_fit").description
        assert f"{reason} (100 %)" in folded

    def test_more_sections_than_a_panel_holds(self, archive, tmp_path):
        sections = tuple((1000.0 * k, 1000.0 * k + 900.0) for k in range(1, 8))
        product = homogeneous(times(START, 9, 60.0), sections=sections)
        written = archive.write("x.nc", product, "homogeneous")
        run = run_record(archive.root, [outcome("s", products=(written,))])
        page = built(run, tmp_path / "report")
        assert page.figures == 2
        for near, far in sections:
            assert f"{near / 1e3:g}\N{EN DASH}{far / 1e3:g} km" in page.text


NASTY = [
    "<script>alert(1)</script>", "\"><img src=x onerror='y'>", "a&amp;b &lt; c", "{{ 7 * 7 }}",
    "línea ЛИДАР 雷达", "with space#and?query%41", "tab\tand\nline", "\x07bell\x1b[31m",
    "\udcff\udcfe", "\u202egnp.exe", "$x^$", "..", "'; DROP TABLE scenes; --",
]  # fmt: skip


def nasty_run(nasty: str, archive):
    """Return a run with the same nasty text in every field."""
    written = archive.write("x.nc", homogeneous(times(START, 4, 60.0)), "homogeneous")
    scene = outcome(
        nasty,
        station=nasty,
        instrument=nasty,
        products=(replace(written, channel=nasty, flagged={nasty: 3}),),
        refused=(fab.granule(nasty, nasty),),
        plan=fab.plan(nasty, LeftOut(nasty, nasty, nasty)),
        seconds={nasty: 1.0},
    )
    failed = replace(scene, scene="failed", products=(), error=nasty)
    return run_record(
        archive.root, [scene, failed], id=nasty, campaign=nasty, title=nasty, version=nasty,
        archive=nasty, refused=(fab.granule(nasty, nasty, instrument=nasty),),
        empty_scenes={nasty: nasty},
        findings=Findings(
            unmet=(Unmet(nasty, nasty, nasty, nasty, 3, 4, 1),),
            file_notes=(FileNote(nasty, nasty, True, 3),),
            idle_patterns=(IdlePattern(nasty, nasty, nasty),),
            unusable_files=(UnusableFile(nasty, nasty, nasty, nasty),),
            unmade=(Unmade(nasty, nasty, nasty, nasty),),
            lost_files=(LostFiles(nasty, 5, 9, (nasty, nasty), 2),),
        ),
    )  # fmt: skip


@pytest.mark.parametrize("nasty", NASTY)
def test_every_text_is_escaped(nasty, archive, tmp_path):
    # Drawing is slow, and done for all at once below.
    page = built(nasty_run(nasty, archive), tmp_path / "report", figures=0)
    calm = built(nasty_run("calm", archive), tmp_path / "calm", figures=0)
    assert page.tags == calm.tags
    shown = nasty.replace("\x07", "\\x07").replace("\x1b", "\\x1b")
    shown = shown.replace("\udcff\udcfe", "\\udcff\\udcfe").replace("\u202e", "\\u202e")
    shown = " ".join(shown.split())
    # The page shows bit names in lower case.
    assert page.text.lower().count(shown.lower()) == calm.text.count("calm")


def test_every_title_can_be_drawn(archive, tmp_path):
    runs = [nasty_run(nasty, archive) for nasty in NASTY[5:9]]
    scenes = tuple(scene for run in runs for scene in run.scenes)
    page = built(run_record(archive.root, scenes), tmp_path / "report")
    assert page.figures == 4


def test_product_names_with_special_characters_are_linked(archive, tmp_path):
    name = "odd #1 %41?/a&b <c> \N{CYRILLIC SMALL LETTER ZHE}.nc"
    written = archive.write(name, homogeneous(times(START, 4, 60.0)), "homogeneous")
    run = run_record(archive.root, [outcome("s", products=(written,))])
    page = built(run, tmp_path / "report folder")
    (link,) = [link for link in page.links if link.endswith(".nc")]
    assert page.target(link).resolve() == (archive.root / name).resolve()


def test_long_reasons_fold(tmp_path):
    reason = "because " * 2000
    scenes = [outcome("s", error=reason, plan=fab.plan("s", LeftOut("dark", "c", reason)))]
    page = built(run_record(tmp_path, scenes), tmp_path / "report")
    assert page.tags.count("details") >= 2
    assert page.text.count("because") >= 4000


def test_many_rejected_values_are_named_with_the_setting(archive, tmp_path):
    product = replace(
        archive.write("a.nc", homogeneous(times(START, 20, 60.0)), "homogeneous"),
        flagged={"saturated": 30},
        values=40,
    )
    step = PlannedStep("dead_time", CHANNEL, {}, "as the campaign states")
    scene = outcome("s", products=(product,), plan=replace(fab.plan("s"), steps=(step,)))
    page = built(run_record(archive.root, [scene]), tmp_path / "report", figures=0)
    words = f"homogeneous {CHANNEL} of {scene.instrument} saturated 75.0 % dead_time: as the"
    assert words in page.text


def test_quicklook_is_the_first_picture(simulated, tmp_path):
    report = run_page.build_report(simulated, tmp_path / "q")
    first, *_ = run_page.gallery.fill(simulated).pictures
    assert report.quicklook.text == first.figure.text


def test_summary_rows_are_plain(simulated):
    (row,) = run_tables.instruments(simulated)
    product = simulated.scenes[0].products[0]
    assert row == {
        "station": "kyiv",
        "instrument": "horizontal",
        "scenes": 1,
        "failed": 0,
        "internal errors": 0,
        "granules": 96,
        "refused": 0,
        "products": 2,
        "retrieved values": 192,
        "quality": verdicts_in_words(product.verdicts),
    }


@pytest.mark.parametrize(
    ("share", "words"),
    [(0, "0 %"), (1e-5, "<0.1 %"), (0.5, "50.0 %"), (0.99999, ">99.9 %"), (1, "100 %"),
     (float("nan"), "no value")],
)  # fmt: skip
def test_percent_never_rounds_to_all_or_nothing(share, words):
    assert percent(share) == words


def test_the_two_most_frequent_descriptions_are_named_and_none_of_no_value():
    counts = [("dark", 0), ("weak", 1), ("saturated", 3), ("near", 1)]
    assert named_shares(counts, 4) == "saturated (75.0 %); weak (25.0 %)"
    assert named_shares([("dark", 0)], 0) == ""


def test_percent_of_equal_shares_has_the_same_words():
    assert percent(85 / 400) == percent(0.2125 + 1e-15) == "21.3 %"


def test_words():
    assert [duration(s) for s in (0.0123, 1.26, 61, 3725, 90_000)] == [
        "12 ms", "1.3 s", "1 min 01 s", "1 h 02 min", "25 h 00 min",
    ]  # fmt: skip
    assert [size(n) for n in (0, 999, 1500, 2.5e6, 3e9, 4.2e15)] == [
        "0 B", "999 B", "1.5 kB", "2.5 MB", "3 GB", "4,200.0 TB",
    ]  # fmt: skip
    assert [counted(n, "scene") for n in (0, 1, 1200)] == ["0 scenes", "1 scene", "1,200 scenes"]
