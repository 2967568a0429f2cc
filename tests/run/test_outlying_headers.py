"""A header that all files around it contradict is refused or noted, and moves no other product."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from support.archives.small_archive import DAY, Archive

from lidarops.campaign.model import load_campaign
from lidarops.catalog.raw_files import misdated, out_of_order
from lidarops.catalog.scan import scan_archive
from lidarops.catalog.store import Store
from lidarops.raw.formats import RawFile, read_raw_header
from lidarops.raw.header import RawHeader
from lidarops.records import Granule, RunRecord, Status, day_of
from lidarops.reports.findings import finding_rows
from lidarops.run import staleness
from lidarops.run.archive import Result, bring_up_to_date
from lidarops.run.outlying_headers import Outlying, outlying_headers
from lidarops.run.reproduction import reproduce_product

FILES = 5
ANALOG = b" 1 0 1 01500 1 0000 7.50 00532.o 0 0 00 000 12 000600 0.500 BT0"
PHOTON = b" 1 1 1 01500 1 0000 7.50 00532.o 0 0 00 000 00 000600 3.1746 BC0"


def _archive(folder: Path, minutes: list[float]) -> Archive:
    archive = Archive(folder, days=0)
    del archive.tree["instruments"]["rich"]
    for number, minute in enumerate(minutes):
        archive.raw(f"poor/h{number}", minute, seed=number)
    archive.write()
    return archive


def _damage(archive: Archive, number: int, old: bytes, new: bytes) -> None:
    path = archive.folder / f"raw/poor/h{number}"
    content = path.read_bytes()
    assert old in content
    assert len(old) == len(new)
    path.write_bytes(content.replace(old, new, 1))


def _run(archive: Archive) -> tuple[Result, set[str]]:
    result = bring_up_to_date(archive.write())
    record = result.record
    return result, _products(record)


def _products(record: RunRecord | None) -> set[str]:
    return {
        product.path for scene in (record.scenes if record else ()) for product in scene.products
    }


@pytest.mark.parametrize(
    ("line", "old", "new", "said", "number"),
    [
        (ANALOG, b"00532", b"00537", "channels analog_537o, photon_532o, the files around it", 2),
        (ANALOG, b" 1 0 1", b" 1 1 1", "channels photon_532o", 2),
        (ANALOG, b" 12 ", b" 16 ", "analog_532o adc_bits 16, the files around it 12", 0),
        (ANALOG, b"0.500", b"0.100", "analog_532o input_range 0.1, the files around it 0.5", 2),
        (ANALOG, b"7.50", b"3.50", "analog_532o bin_width 3.5, the files around it 7.5", 4),
        (PHOTON, b"7.50", b"7.40", "photon_532o bin_width 7.4, the files around it 7.5", 3),
    ],
)
def test_a_file_that_all_around_it_contradict_is_refused_and_renames_no_product(
    tmp_path: Path, line: bytes, old: bytes, new: bytes, said: str, number: int
) -> None:
    minutes = [600.0 + k for k in range(FILES)]
    archive = _archive(tmp_path / "damaged", minutes)
    _damage(archive, number, line, line.replace(old, new, 1))
    result, products = _run(archive)
    assert list(result.set_aside) == [f"poor/h{number}"]
    assert said in result.set_aside[f"poor/h{number}"]
    assert result.has_failures
    undamaged, expected = _run(_archive(tmp_path / "whole", minutes))
    assert products == expected
    assert not undamaged.has_failures
    assert result.record is not None
    assert {scene.granules for scene in result.record.scenes} == {FILES - 1}


@pytest.mark.parametrize(
    ("line", "old", "new", "said"),
    [
        (ANALOG, b" 0000 7", b" 0800 7", "analog_532o high_voltage 800.0"),
        (PHOTON, b"3.1746", b"3.1748", "photon_532o discriminator"),
        (b" Coast ", b"Coast", b"C0ast", "site C0ast, the files around it Coast"),
    ],
)
def test_what_changes_no_value_is_noted(
    tmp_path: Path, line: bytes, old: bytes, new: bytes, said: str
) -> None:
    archive = _archive(tmp_path, [600.0 + k for k in range(FILES)])
    _damage(archive, 2, line, line.replace(old, new, 1))
    result, products = _run(archive)
    assert not result.has_failures
    assert result.record is not None
    for findings in (result.findings, result.record.findings):
        [row] = [row for row in finding_rows(findings) if said in row.problem]
        assert row.subject == "1 file"
    product = archive.folder / "out/products" / min(products)
    with xr.open_dataset(product) as opened:
        assert said in opened.attrs["lidarops_input_notes"]
        assert opened.sizes["time"] == FILES
    assert reproduce_product(product).identical


def test_other_shots_are_no_damage(tmp_path: Path) -> None:
    """The last file of a run is often shorter."""
    archive = _archive(tmp_path, [600.0 + k for k in range(FILES)])
    _damage(archive, 2, b" 0000600 0010", b" 0000540 0010")
    for line in (ANALOG, PHOTON):
        _damage(archive, 2, line, line.replace(b"000600", b"000540"))
    result, products = _run(archive)
    assert not result.has_failures
    with xr.open_dataset(archive.folder / "out/products" / min(products)) as opened:
        assert "lidarops_input_notes" not in opened.attrs


def test_a_change_of_the_lidar_is_no_damage(tmp_path: Path) -> None:
    archive = _archive(tmp_path, [600.0 + k for k in range(2 * FILES)])
    for number in range(FILES, 2 * FILES):
        _damage(archive, number, ANALOG, ANALOG.replace(b" 12 ", b" 16 "))
    result, products = _run(archive)
    assert not result.set_aside
    assert len(products) == 4


def test_two_files_do_not_outvote_one(tmp_path: Path) -> None:
    archive = _archive(tmp_path, [600.0, 601.0, 602.0])
    _damage(archive, 1, ANALOG, ANALOG.replace(b" 12 ", b" 16 "))
    assert not _run(archive)[0].set_aside


@pytest.mark.parametrize("at_a_time", [1, 50_000])
def test_neighbouring_days_are_compared_whatever_is_judged_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_a_time: int
) -> None:
    monkeypatch.setattr(staleness, "MOST_GRANULES", at_a_time)
    # Two files on each day but the third, which has one.
    minutes = [600.0, 601.0, DAY + 600.0, DAY + 601.0, 2 * DAY + 600.0, 3 * DAY + 600.0]
    archive = _archive(tmp_path, [*minutes, 3 * DAY + 601.0])
    _damage(archive, 4, ANALOG, ANALOG.replace(b"0.500", b"0.100"))
    result, _ = _run(archive)
    assert list(result.set_aside) == ["poor/h4"]


def test_a_new_state_is_accepted_when_more_files_have_it(tmp_path: Path) -> None:
    changed = ANALOG.replace(b"0.500", b"0.100")
    minutes = [600.0 + k for k in range(FILES)]
    archive = _archive(tmp_path, [*minutes, DAY - 0.5])
    _damage(archive, FILES, ANALOG, changed)
    assert list(_run(archive)[0].set_aside) == [f"poor/h{FILES}"]
    archive.raw(f"poor/h{FILES + 1}", DAY + 1.0, seed=9)
    _damage(archive, FILES + 1, ANALOG, changed)
    result, _ = _run(archive)
    assert not result.set_aside
    assert not result.has_failures


@pytest.mark.parametrize("changed", ["shots", "length of the header"])
def test_files_that_differ_in_shots_or_length_only_are_alike(tmp_path: Path, changed: str) -> None:
    """Recorders of real lidars miss shots, and azimuths of scans have two or three digits."""
    archive = _archive(tmp_path, [600.0 + k for k in range(FILES)])
    for number in range(FILES):
        path = archive.folder / f"raw/poor/h{number}"
        content = path.read_bytes()
        if changed == "shots":
            content = content.replace(b"000600", b"%06d" % (590 + number))
        elif number % 2:
            content = content.replace(b" Coast ", b" Coast  ", 1)
        path.write_bytes(content)
    shots = b"000592" if changed == "shots" else b"000600"
    line = ANALOG.replace(b"000600", shots)
    _damage(archive, 2, line, line.replace(b"0.500", b"0.100", 1))
    result, _ = _run(archive)
    assert "analog_532o input_range 0.1, the files around" in result.set_aside["poor/h2"]


def test_a_pointing_that_no_other_file_has_is_refused(tmp_path: Path) -> None:
    """It would make a scan of a fixed beam."""
    archive = _archive(tmp_path, [600.0 + k for k in range(FILES)])
    _damage(archive, 2, b" 0046.4 00", b" 0046.4 70")
    result, _ = _run(archive)
    assert list(result.set_aside) == ["poor/h2"]
    assert "states the pointing zenith angle 70" in result.set_aside["poor/h2"]


def test_a_pointing_that_occurs_once_in_a_scan_is_noted(tmp_path: Path) -> None:
    archive = _archive(tmp_path, [600.0 + k for k in range(9)])
    angles = [b"00", b"30"] * 4 + [b"37"]
    for number, angle in enumerate(angles):
        _damage(archive, number, b" 0046.4 00", b" 0046.4 " + angle)
    result, products = _run(archive)
    assert not result.has_failures
    with xr.open_dataset(archive.folder / "out/products" / min(products)) as opened:
        assert "the pointing zenith angle 37 alone" in opened.attrs["lidarops_input_notes"]


@pytest.mark.parametrize("angles", [[b"00", b"30", b"37"] * 2, [b"00"] * 3 + [b"30"] * 2])
def test_scans_and_repeated_pointings_are_no_damage(tmp_path: Path, angles: list[bytes]) -> None:
    archive = _archive(tmp_path, [600.0 + k for k in range(len(angles))])
    for number, angle in enumerate(angles):
        _damage(archive, number, b" 0046.4 00", b" 0046.4 " + angle)
    result, products = _run(archive)
    assert not result.has_failures
    with xr.open_dataset(archive.folder / "out/products" / min(products)) as opened:
        assert "pointing" not in opened.attrs.get("lidarops_input_notes", "")


@pytest.mark.parametrize(
    ("old", "new", "refused", "text"),
    [
        (
            b"10:03:00 0020",
            b"10:23:00 0020",
            True,
            "1260 s for 600 shots, the files around it 60 s",
        ),
        (b"2026 10:02:00 01", b"2026 09:02:00 01", True, "3660 s for 600 shots"),
        (b"10:03:00 0020", b"10:02:30 0020", False, "30 s for 600 shots"),
    ],
)
def test_an_interval_that_the_shots_contradict_is_refused_or_noted(
    tmp_path: Path, old: bytes, new: bytes, refused: bool, text: str
) -> None:
    """It is refused where it would mean that two files were recorded at the same time."""
    archive = _archive(tmp_path, [600.0 + k for k in range(FILES)])
    _damage(archive, 2, old, new)
    result, products = _run(archive)
    assert list(result.set_aside) == (["poor/h2"] if refused else [])
    if refused:
        assert text in result.set_aside["poor/h2"]
        return
    with xr.open_dataset(archive.folder / "out/products" / min(products)) as opened:
        assert text in opened.attrs["lidarops_input_notes"]


def test_a_file_that_is_shorter_by_its_shots_is_no_damage(tmp_path: Path) -> None:
    archive = _archive(tmp_path, [600.0 + k for k in range(FILES)])
    _damage(archive, 4, b"10:05:00 0020", b"10:04:30 0020")
    for line in (ANALOG, PHOTON):
        _damage(archive, 4, line, line.replace(b"000600", b"000300"))
    _damage(archive, 4, b" 0000600 0010", b" 0000300 0010")
    result, products = _run(archive)
    assert not result.has_failures
    with xr.open_dataset(archive.folder / "out/products" / min(products)) as opened:
        assert "interval" not in opened.attrs.get("lidarops_input_notes", "")


@pytest.mark.parametrize(
    ("hours", "names_differ", "refused"),
    [
        ({2: "12"}, 0, ["poor/h2630110.020000"]),
        ({2: "12", 4: "07"}, 0, ["poor/h2630110.020000", "poor/h2630110.040000"]),
        # Names are by local time: all are six hours off.
        ({2: "12"}, 6, ["poor/h2630104.020000"]),
        # A clock was set: names and headers are its own.
        ({3: "12", 4: "12"}, 0, []),
        # Summer time of names or of headers.
        ({3: "11"}, 0, []),
    ],
)
def test_a_start_that_its_name_and_all_around_it_contradict_is_refused(
    tmp_path: Path, hours: dict[int, str], names_differ: int, refused: list[str]
) -> None:
    archive = Archive(tmp_path, days=0)
    del archive.tree["instruments"]["rich"]
    for k in range(FILES):
        path = archive.raw(f"poor/h26301{10 - names_differ:02d}.{k:02d}0000", 600.0 + k, seed=k)
        if k in hours:
            for minute in (k, k + 1):
                old, new = (f"{hour}:{minute:02d}:00".encode() for hour in ("10", hours[k]))
                path.write_bytes(path.read_bytes().replace(old, new))
    archive.write()
    result, _ = _run(archive)
    assert sorted(result.set_aside) == refused
    assert all(
        "its name and the files around it have it" in why for why in result.set_aside.values()
    )


def test_a_clock_that_the_facts_state_contradicts_no_name(tmp_path: Path) -> None:
    """One file before the clock was set by three hours, the others after it."""
    archive = Archive(tmp_path, days=0)
    edge = "2026-03-01T21:00:00Z"
    facts = [{"clock_offset": 10_800, "valid_to": edge}, {"valid_from": edge}]
    archive.tree["instruments"] = {"poor": {**archive.tree["instruments"]["poor"], "facts": facts}}
    archive.raw("poor/h2630123.300000", 1410.0, seed=0)
    for k in range(FILES):
        archive.raw(f"poor/h2630202.{k:02d}0000", 1560.0 + k, seed=k + 1)
    result, _ = _run(archive)
    assert not result.set_aside


@pytest.mark.parametrize(
    ("minutes", "noted"),
    [
        ([0, 1, 182, 3, 4, 5], "13:02"),
        ([0, 1, 2, -177, 4, 5], "07:03"),
        # Another sort of names, and too few files.
        ([3, 4, 5, 0, 1, 2], ""),
        ([0, 1, 182, 3, 4], ""),
    ],
)
def test_a_start_out_of_the_order_of_names_is_noted_where_these_tell_no_time(
    tmp_path: Path, minutes: list[float], noted: str
) -> None:
    archive = _archive(tmp_path, [600.0 + minute for minute in minutes])
    result, products = _run(archive)
    assert not result.has_failures
    with xr.open_dataset(archive.folder / "out/products" / min(products)) as opened:
        notes = opened.attrs.get("lidarops_input_notes", "")
    words = f"states the start 2026-03-01 {noted}:00 UTC, out of the order of names: 1 of 6 files"
    assert (words in notes) == bool(noted)
    assert ("out of the order" in notes) == bool(noted)


@given(data=st.data(), count=st.integers(10, 60), sessions=st.integers(1, 4))
def test_wrong_dates_are_found_among_names_in_order(
    data: st.DataObject, count: int, sessions: int
) -> None:
    """Up to an eighth of the files, also neighbours, while another file is hours out of order."""
    first = datetime(2024, 1, 1, 23, tzinfo=UTC)
    starts = [
        first + timedelta(days=20 * (k * sessions // count), minutes=5 * (k // 2))
        for k in range(count)
    ]
    assert not out_of_order(_counted(starts), timedelta(days=1))
    swapped = data.draw(st.integers(1, count - 1))
    starts[swapped] -= timedelta(hours=6)
    assert not out_of_order(_counted(starts), timedelta(days=1))
    # As many files in order come first, or nothing tells which of both are wrong.
    inner = st.integers(count // 8 + 2, count - 1)
    wrong = data.draw(st.sets(inner, min_size=1, max_size=count // 8))
    for place in wrong:
        starts[place] -= timedelta(days=365)
    found = out_of_order(_counted(starts), timedelta(days=1))
    assert list(found) == [f"raw/f{place:03}" for place in sorted(wrong)]


@pytest.mark.parametrize("days", [2, 3, 7])
def test_names_that_count_anew_each_day_tell_no_order(days: int) -> None:
    first = datetime(2024, 1, 1, tzinfo=UTC)
    starts = [
        first + timedelta(days=day, minutes=number) for number in range(20) for day in range(days)
    ]
    assert not out_of_order(_counted(starts))
    assert not out_of_order(_counted(starts), timedelta(days=1))


def test_only_names_that_agree_but_for_numbers_have_an_order():
    first = datetime(2024, 1, 1, tzinfo=UTC)
    starts = _counted([first + timedelta(minutes=k) for k in range(12)])
    starts["raw/f003"] = first + timedelta(days=30)
    assert out_of_order(starts) == {"raw/f003": ["raw/f002", "raw/f004"]}
    starts["raw/f-renamed"] = starts.pop("raw/f003")
    assert not out_of_order(starts)


def test_numbers_of_names_follow_each_other_whatever_their_digits():
    """A session two days later goes on counting: f11 lies between f1 and f2 by letters alone."""
    first = datetime(2024, 1, 1, tzinfo=UTC)
    starts = {f"raw/f{k}": first + timedelta(days=2 * (k > 10), minutes=k) for k in range(2, 12)}
    assert not out_of_order(starts, timedelta(days=1))


def _counted(starts: list[datetime]) -> dict[str, datetime]:
    """Return the starts of files whose names only count."""
    return {f"raw/f{place:03}": start for place, start in enumerate(starts)}


@pytest.mark.parametrize("name", ["pilar", "saopaulo", "manaus", "savant"])
def test_no_measured_file_lies_off_those_around_it(
    name: str, data_root: Path, tmp_path: Path
) -> None:
    """The times of five lidars jitter by a second, and the scans are of many pointings."""
    path = Path(__file__).parents[1] / f"end_to_end/campaigns/{name}.yaml"
    archive = data_root if name == "manaus" else data_root / name
    campaign = load_campaign(path, archive=archive, output=tmp_path)
    store = Store(campaign.catalog_url, campaign.name)
    scan_archive(campaign, store)
    granules = store.granules(status=Status.GOOD)
    store.close()

    def header(granule: Granule) -> RawHeader:
        with RawFile(archive / granule.path) as file:
            return read_raw_header(file)

    days = {day_of(granule.start) for granule in granules if granule.start}
    assert len(granules) > 25
    outlying = set(outlying_headers(granules, days, header, lambda _: 0.0).values())
    # One file of the test archive stems from elsewhere.
    foreign = Outlying("", "site CHICAGO, the files around it U-C_VOL_")
    assert outlying == ({foreign} if name == "savant" else set())


DATES = {
    "the second of all": ([0, -60, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], {1}),
    "two of eleven": ([0, 0, 0, 100, 0, 0, 0, 60, 0, 0, 0], {3, 7}),
    "four neighbours of sixteen": ([0] * 6 + [300] * 4 + [0] * 6, {6, 7, 8, 9}),
    "numbers that begin again": ([3] * 80 + [0] * 10, set()),
}
"""Days by which files of one night are off, and the places of those that are wrong."""


@pytest.mark.parametrize(("days", "wrong"), DATES.values(), ids=DATES)
def test_a_date_is_wrong_where_files_on_both_sides_contradict_it(
    days: list[int], wrong: set[int]
) -> None:
    first = datetime(2024, 6, 1, tzinfo=UTC)
    starts = [first + timedelta(days=off, minutes=k) for k, off in enumerate(days)]
    assert set(misdated(_counted(starts))) == {f"raw/f{place:03}" for place in wrong}


def test_names_of_one_number_are_in_an_order_of_their_own() -> None:
    first = datetime(2024, 6, 1, tzinfo=UTC)
    starts = _counted([first + timedelta(minutes=k) for k in range(9)])
    starts["raw/f4"] = first + timedelta(days=90)
    turned = dict(reversed(starts.items()))
    assert misdated(turned) == misdated(starts) != {}
