"""Run records as JSON: exact round trip; anything else is refused."""

from __future__ import annotations

import json
import math
import tracemalloc
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.products import fabricated as fab

from lidarops.errors import CatalogError, LidarOpsError
from lidarops.kinds import kinds
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    FileNote,
    Findings,
    Granule,
    IdlePattern,
    InputRecord,
    LeftOut,
    LostFiles,
    Plan,
    PlannedStep,
    ProductRecord,
    Role,
    RunRecord,
    SceneOutcome,
    Status,
    Unmade,
    Unmet,
    UnusableFile,
)
from lidarops.reports.run_record import FILE_NAME, load_run_record, save_run_record

# File names are bytes; those that are not UTF-8 are read as unpaired surrogates.
text = st.text(st.characters(codec=None), max_size=6)
number = st.floats(allow_nan=False)
whole = st.integers(-(2**63), 2**63)
when = st.datetimes(
    timezones=st.one_of(
        st.none(),
        st.just(UTC),
        st.integers(-14 * 60, 14 * 60).map(lambda m: timezone(timedelta(minutes=m))),
    )
)
plain = st.recursive(
    st.none() | st.booleans() | whole | st.floats(allow_nan=False, allow_infinity=False) | text,
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(text, inner, max_size=2),
    max_leaves=3,
)
mapping = st.dictionaries(text, plain, max_size=2)


def some(items):
    return st.lists(items, max_size=2).map(tuple)


layouts = st.builds(
    ChannelLayout, text, st.sampled_from(DetectionMode), number, whole, number, whole
)
granules = st.builds(
    Granule,
    path=text,
    size=whole,
    mtime_ns=whole,
    instrument=text,
    role=st.sampled_from(Role),
    status=st.sampled_from(Status),
    reason=text,
    notes=some(text),
    contradictions=some(text),
    start=st.none() | when,
    stop=st.none() | when,
    zenith_angle=st.none() | number,
    azimuth=st.none() | number,
    latitude=st.none() | number,
    longitude=st.none() | number,
    altitude=st.none() | number,
    layout=some(layouts),
    sha256=st.none() | text,
)
left_out = st.builds(LeftOut, text, text, text, rule=text, number=st.none() | number)
plans = st.builds(
    Plan,
    text,
    some(st.builds(PlannedStep, text, text, mapping, text)),
    some(left_out),
)
products = st.builds(
    ProductRecord,
    path=text,
    kind=st.sampled_from(list(kinds())),
    channel=text,
    sha256=text,
    size=whole,
    values=whole,
    flagged=st.dictionaries(text, whole, max_size=2),
    unflagged=whole,
)
outcomes = st.builds(
    SceneOutcome,
    scene=text,
    station=text,
    instrument=text,
    start=when,
    granules=whole,
    plan=st.none() | plans,
    products=some(products),
    refused=some(granules),
    inputs=some(st.builds(InputRecord, text, st.sampled_from(Role), text)),
    error=text,
    internal=text,
    seconds=st.dictionaries(text, st.floats(allow_nan=False, allow_infinity=False), max_size=3),
    left_out=some(left_out),
)
findings = st.builds(
    Findings,
    unmet=some(st.builds(Unmet, text, text, text, text, whole, whole, whole)),
    file_notes=some(st.builds(FileNote, text, text, st.booleans(), whole)),
    idle_patterns=some(st.builds(IdlePattern, text, text, text)),
    unusable_files=some(st.builds(UnusableFile, text, text, text, text)),
    unmade=some(st.builds(Unmade, text, text, text, text)),
    lost_files=some(st.builds(LostFiles, text, whole, whole, some(text), whole)),
)
records = st.builds(
    RunRecord,
    id=text,
    campaign=text,
    title=text,
    started=when,
    finished=when,
    version=text,
    archive=text,
    products=text,
    scenes=some(outcomes),
    refused=some(granules),
    findings=findings,
    empty_scenes=st.dictionaries(text, text, max_size=2),
    more_empty_scenes=whole,
)


@pytest.mark.slow
@given(record=records)
@settings(
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
def test_a_loaded_record_equals_the_saved_one(record, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / "there-and-back"
    path = save_run_record(record, folder)
    back = load_run_record(path)
    assert back == record
    assert load_run_record(folder) == back
    json.loads(path.read_text(), parse_constant=pytest.fail)


def test_types_survive(tmp_path):
    granule = replace(
        fab.granule("raw/a", "broken"),
        latitude=50.0,
        notes=("odd",),
        layout=(ChannelLayout("photon_0o", DetectionMode.PHOTON, math.nan, 4, -math.inf, 0),),
        start=datetime(2024, 2, 29, 23, 59, 59, 999999, tzinfo=UTC),
    )
    record = fab.run_record(
        tmp_path, [fab.outcome("s", refused=(granule,))], refused=(granule, granule)
    )
    back = load_run_record(save_run_record(record, tmp_path))
    loaded = back.scenes[0].refused[0]
    assert math.isnan(loaded.layout[0].wavelength)
    assert loaded.layout[0].bin_width == -math.inf
    assert isinstance(loaded.layout[0].mode, DetectionMode)
    assert isinstance(loaded.status, Status)
    assert isinstance(loaded.notes, tuple)
    assert loaded.start == granule.start
    assert loaded.start.utcoffset() == timedelta(0)
    assert back.scenes[0].plan.hash == record.scenes[0].plan.hash
    assert repr(back) == repr(record)


def test_tuples_within_settings_keep_the_hash(tmp_path):
    plan = Plan("s", (PlannedStep("homogeneous", "c", {"sections": ((1, 2), (3, 4))}, "why"),), ())
    back = load_run_record(
        save_run_record(fab.run_record(tmp_path, [fab.outcome("s", plan=plan)]), tmp_path)
    )
    assert back.scenes[0].plan.hash == plan.hash
    assert back.scenes[0].plan.steps[0].settings == {"sections": [[1, 2], [3, 4]]}


@pytest.mark.parametrize("value", [math.nan, math.inf, {1, 2}, object(), b"x"])
def test_settings_outside_json_are_refused(tmp_path, value):
    plan = Plan("s", (PlannedStep("a", "c", {"x": [value]}, "why"),), ())
    record = fab.run_record(tmp_path, [fab.outcome("s", plan=plan)])
    with pytest.raises(CatalogError, match="settings"):
        save_run_record(record, tmp_path / "run")
    assert not list((tmp_path / "run").iterdir())


def test_saving_takes_little_memory_whatever_the_scenes(tmp_path):
    record = fab.run_record(tmp_path, [fab.outcome(f"s{number}") for number in range(1000)])
    tracemalloc.start()
    try:
        size = save_run_record(record, tmp_path).stat().st_size
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # All of it as one text would take more than the file.
    assert peak < 0.5 * size


def test_saving_replaces_the_file_and_leaves_no_other(tmp_path):
    save_run_record(fab.run_record(tmp_path, [fab.outcome("s" * 5000)]), tmp_path)
    small = fab.run_record(tmp_path)
    save_run_record(small, tmp_path)
    assert load_run_record(tmp_path) == small
    assert [path.name for path in tmp_path.iterdir()] == [FILE_NAME]


def test_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CatalogError, match="cannot be written"):
        save_run_record(fab.run_record(tmp_path), tmp_path / "file" / "run")


def _tree(tmp_path: Path) -> tuple[Path, dict]:
    scene = fab.outcome("s", products=(ProductRecord("p", "signal", "c", "", 1, 2, {}, 2),))
    path = save_run_record(fab.run_record(tmp_path, [scene]), tmp_path)
    return path, json.loads(path.read_text())


def _set(tree: dict, keys: list, value: object) -> None:
    for key in keys[:-1]:
        tree = tree[key]
    tree[keys[-1]] = value


@pytest.mark.parametrize(
    ("keys", "value", "field"),
    [
        (["title"], 3, "record.title"),
        (["started"], "yesterday", "record.started"),
        (["started"], 12.5, "record.started"),
        (["scenes"], {}, "record.scenes"),
        (["scenes"], None, "record.scenes"),
        (["scenes", 0], [], r"record.scenes\[0\]"),
        (["scenes", 0, "granules"], True, r"record.scenes\[0\].granules"),
        (["scenes", 0, "granules"], 3.0, r"record.scenes\[0\].granules"),
        (["scenes", 0, "seconds"], {"open": "NAN"}, r"record.scenes\[0\].seconds.open"),
        (["scenes", 0, "seconds"], {"open": 10**400}, r"record.scenes\[0\].seconds.open"),
        (["scenes", 0, "seconds"], [], r"record.scenes\[0\].seconds"),
        (["scenes", 0, "products", 0, "kind"], ["signal"], r"products\[0\].kind"),
        (["scenes", 0, "products", 0, "flagged"], {"a": None}, r"products\[0\].flagged.a"),
        (["scenes", 0, "plan", "steps"], [{"name": "x"}], r"plan.steps\[0\].channel"),
        (["extra"], 1, "record.extra: expected no such field"),
    ],
)
def test_damaged_field_is_named(tmp_path, keys, value, field):
    path, tree = _tree(tmp_path)
    _set(tree["record"], keys, value)
    path.write_text(json.dumps(tree))
    with pytest.raises(CatalogError, match=field) as caught:
        load_run_record(tmp_path)
    assert caught.value.file == str(path)


@pytest.mark.parametrize("name", ["id", "scenes", "finished"])
def test_missing_field_is_named(tmp_path, name):
    path, tree = _tree(tmp_path)
    del tree["record"][name]
    path.write_text(json.dumps(tree))
    with pytest.raises(CatalogError, match=f"record.{name}: expected this field"):
        load_run_record(path)


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"[]", b"null", b"3", b"\xff\xfe\x00", b'{"format": "other"}', b"NaN",
        b'{"format": "lidarops run record", "version": 1}',
        b'{"format": "lidarops run record", "version": 1, "record": []}',
        b'{"format": "lidarops run record", "version": 2, "record": {}}',
        b"[" * 100_000, b"1" * 10_000,
    ],
)  # fmt: skip
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / FILE_NAME
    path.write_bytes(content)
    with pytest.raises(LidarOpsError, match=FILE_NAME):
        load_run_record(tmp_path)


def test_truncated_anywhere_is_refused(tmp_path):
    path, _ = _tree(tmp_path)
    whole_file = path.read_bytes()
    for size in range(0, len(whole_file) - 1, 97):
        path.write_bytes(whole_file[:size])
        with pytest.raises(CatalogError):
            load_run_record(path)


@pytest.mark.parametrize("name", ["nothing", "folder"])
def test_missing_file(tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(CatalogError, match=name):
        load_run_record(tmp_path / name)
