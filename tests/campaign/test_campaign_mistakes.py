"""Messages on mistakes in campaign files, and the JSON schema that they are made from."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from typer.testing import CliRunner

from lidarops.campaign.model import campaign_schema, load_campaign
from lidarops.cli import app
from lidarops.errors import CampaignError
from lidarops.units import written

CAMPAIGN = """\
name: small
title: A small campaign
archive: raw
output: out
stations:
  coast: {name: Coast, latitude: 46.4, longitude: 30.7}
instruments:
  lidar:
    station: coast
    files: ["h*"]
    facts:
      - zenith_angle: 90
        valid_to: 2024-01-01
        channels: {photon_532o: {dead_time: 4.0e-9, lag: 0}}
    products:
      signal: {channels: all}
      elastic: {channels: [glued_532o], lidar_ratio: 50, background: known_shape}
      homogeneous: {channels: [photon_532o], sections: [[750, 4500]]}
scenes: {window: day}
all_steps: false
"""


def _message(folder: Path, text: str) -> str:
    path = folder / "campaign.yaml"
    path.write_text(text)
    with pytest.raises(CampaignError) as caught:
        load_campaign(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "dead_time: 4.0e-9",
            "dead_time: 3.0e-6",
            (
                "line 14: instruments.lidar.facts.0.channels.photon_532o.dead_time: must be a"
                " number from 0.1 ns to 200 ns or 0 or 'estimate', not 3.0e-6"
            ),
        ),
        (
            "dead_time: 4.0e-9",
            "dead_time: 4.0e-9, dead_time_uncertainty: 20",
            "photon_532o.dead_time_uncertainty: must be a number from 0 to 1 (no unit), not 20",
        ),
        # A unit of another dimension, and one too large.
        ("dead_time: 4.0e-9", "dead_time: 4 m", "to 200 ns or 0 or 'estimate', not '4 m'"),
        ("dead_time: 4.0e-9", "dead_time: 4 us", "to 200 ns or 0 or 'estimate', not 4 us"),
        # In ps, km and mm.
        ("dead_time: 4.0e-9", "dead_time: 4.0e-12", "to 200 ns or 0 or 'estimate', not 4.0e-12"),
        ("[[750, 4500]]", "[[0.75, 4.5]]", "must be 0, or at least 10 m, not 0.75 m: is it in km?"),
        ("[[750, 4500]]", "[[750, 4500000]]", "from 0 to 150000 m, not 4500000"),
        (
            "dead_time: 4.0e-9",
            "dead_time: 3e-6",
            "from 0.1 ns to 200 ns or 0 or 'estimate', not '3e-6'",
        ),
        (
            "latitude: 46.4",
            "latitude: north",
            "line 6: stations.coast.latitude: must be a number from -90 to 90 degree, not 'north'",
        ),
        # Between braces, a comma ends the value.
        ("latitude: 46.4", "latitude: '46,4'", "not '46,4'; decimals stand behind a point: 46.4"),
        ("dead_time: 4.0e-9", "dead_time: '4,5 ns'", "decimals stand behind a point: 4.5 ns"),
        ("dead_time: 4.0e-9", "dead_time: 4,5 ns", "decimals stand behind a point: 4.5 ns"),
        ("latitude: 46.4", "latitude: '46,400'", "to 90 degree, not '46,400'"),
        ("latitude: 46.4", "latitude: yes", "from -90 to 90 degree, not 'yes'"),
        # YAML 1.1 reads 46 min 24 s as 2784, or 46.4 h as a number of minutes.
        ("latitude: 46.4", "latitude: 0:24", "from -90 to 90 degree, not '0:24'"),
        ("latitude: 46.4", "latitude: -1:00.5", "from -90 to 90 degree, not '-1:00.5'"),
        ("latitude: 46.4", "lattitude: 46.4", "unknown key; did you mean 'latitude'? keys here"),
        ("latitude: 46.4, ", "", "line 6: stations.coast.latitude: is required: a number from -90"),
        (
            "lidar_ratio: 50",
            "lidar_ratio: 201",
            (
                "line 17: instruments.lidar.products.elastic."
                "lidar_ratio: must be a number from 1 to 200 sr, not 201"
            ),
        ),
        (
            "lidar_ratio: 50",
            "Lidar-Ratio: 50",
            (
                "Lidar-Ratio: unknown key; did you mean"
                " 'lidar_ratio'? keys here are lidar_ratio, average"
            ),
        ),
        ("lidar_ratio: 50", "lidar_ratio: [50]", "must be a number from 1 to 200 sr, not [50]"),
        (
            "background: known_shape",
            "background: known_shap",
            "must be 'known_shape' or 'tail_mean', not 'known_shap'; did you mean 'known_shape'?",
        ),
        (
            "channels: [glued_532o]",
            "channels: 5",
            "must be a list of at least 1 values, each text, not 5",
        ),
        (
            "channels: all",
            "channels: al",
            "must be a list of values, each text or 'all', not 'al'; did you mean 'all'?",
        ),
        ("channels: all", "channels: [1]", "signal.channels.0: must be text, not 1"),
        (
            "[[750, 4500]]",
            "[[750, -1]]",
            (
                "line 18: instruments.lidar.products.homogeneous.sections."
                "0.1: must be a number from 0 to 150000 m, not -1"
            ),
        ),
        (
            "channels: {photon_532o: {dead_time: 4.0e-9, lag: 0}}",
            "channels: {photon_532o: {lidar_ratio_profile: o.csv}}\n        overlap_profile: o.csv",
            "overlap_profile and lidar_ratio_profile name the same file, o.csv",
        ),
        ("[[750, 4500]]", "[[750, off]]", "from 0 to 150000 m, not 'off'"),
        (
            "lag: 0",
            "lag: estimated",
            (
                "must be a number from -100 to 100 (no unit) or 'estimate',"
                " not 'estimated'; did you mean 'estimate'?"
            ),
        ),
        ("lidar:\n", "my_lidar:\n", "line 8: instruments.my_lidar: must be letters, digits and"),
        (
            "station: coast",
            "station: caost",
            (
                "line 9: instruments.lidar.station: unknown station"
                " 'caost'; did you mean 'coast'? known stations: coast"
            ),
        ),
        ("signal: {channels", "sginal: {channels", "unknown key; did you mean 'signal'? keys here"),
        ("signal: {channels: all}", "signal: all", "signal: must be a mapping of keys to values"),
        (
            "window: day",
            "window: fortnight",
            "must be 'day' or an interval such as 30min, 6h or 1d or a number s, not 'fortnight'",
        ),
        (
            "valid_to: 2024-01-01",
            "valid_to: 2024",
            (
                "line 13: instruments.lidar.facts.0.valid_to:"
                " must be a time such as 2024-09-21T12:00:00Z"
            ),
        ),
        ("all_steps: false", "all_steps: maybe", "line 20: all_steps: must be true or false"),
        (
            "scenes: {window: day}",
            ("networks: {pair: {instruments: [lidar, lidra], visibility: {channel: photon_532o}}}"),
            (
                "line 19: networks.pair.instruments.1: unknown instrument"
                " 'lidra'; did you mean 'lidar'?"
            ),
        ),
        (
            "scenes: {window: day}",
            (
                "networks: {pair: {instruments: [lidar, b], visibility:"
                " {channel: a, exponents: {lidra: 1}}}}"
            ),
            (
                "line 19: networks.pair.visibility.exponents."
                "lidra: not in instruments; did you mean 'lidar'?"
            ),
        ),
        (
            "scenes: {window: day}",
            ("networks: {pair: {instruments: [lidar, b], visibility: {channel: a, average: 1s}}}"),
            "line 19: networks.pair.visibility: block must hold at most 500 averages",
        ),
    ],
)
def test_a_mistake_is_located_and_explained(
    tmp_path: Path, old: str, new: str, expected: str
) -> None:
    assert CAMPAIGN.count(old) == 1
    assert expected in _message(tmp_path, CAMPAIGN.replace(old, new))


@pytest.mark.parametrize("files", ["&a [*a]", "&a {b: *a}", "[&a [[*a]]]"])
def test_a_value_that_holds_itself_is_a_mistake_like_others(tmp_path: Path, files: str) -> None:
    message = _message(tmp_path, CAMPAIGN.replace('["h*"]', files))
    assert "line 10: instruments.lidar.files" in message


def test_a_number_without_a_point_is_read(tmp_path: Path) -> None:
    """YAML 1.1 reads 4e-9 as a text."""
    path = tmp_path / "campaign.yaml"
    path.write_text(CAMPAIGN.replace("4.0e-9", "4e-9"))
    facts = load_campaign(path).instruments["lidar"].facts[0]
    assert facts.channels["photon_532o"].dead_time == 4e-9


@pytest.mark.parametrize("text", ["044", "+44", "44"])
def test_a_number_with_a_zero_before_it_is_decimal(tmp_path: Path, text: str) -> None:
    """YAML 1.1 reads 044 as 36."""
    path = tmp_path / "campaign.yaml"
    path.write_text(CAMPAIGN.replace("latitude: 46.4", f"latitude: {text}"))
    assert load_campaign(path).stations["coast"].latitude == 44.0


@pytest.mark.parametrize("word", ["yes", "no", "on", "off"])
def test_a_name_or_key_may_be_a_word_that_yaml_takes_for_a_boolean(
    tmp_path: Path, word: str
) -> None:
    path = tmp_path / "campaign.yaml"
    stations = f"{word}: {{name: {word}, latitude: 46.4"
    text = CAMPAIGN.replace("name: small", f"name: {word}")
    text = text.replace("coast: {name: Coast, latitude: 46.4", stations)
    path.write_text(text.replace("station: coast", f"station: {word}"))
    campaign = load_campaign(path)
    assert campaign.name == word
    assert campaign.stations[word].name == word


@pytest.mark.parametrize(
    ("word", "expected"),
    [("yes", True), ("1", True), ("'true'", True), ("no", False), ("0", False), ("off", False)],
)
def test_a_key_of_true_or_false_takes_words_and_numbers(
    tmp_path: Path, word: str, *, expected: bool
) -> None:
    path = tmp_path / "campaign.yaml"
    path.write_text(CAMPAIGN.replace("all_steps: false", f"all_steps: {word}"))
    assert load_campaign(path).all_steps is expected


Place = tuple[tuple[Any, ...], dict[str, Any], str | None]


def _numbers(
    schema: dict[str, Any], definitions: dict[str, Any], keys: tuple[Any, ...], unit: str | None
) -> Iterator[Place]:
    """Yield keys, schema and unit of every number; a pair of keys also sets the kind of a union."""
    unit = schema.get("unit", unit)
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        yield from _numbers(definitions[name], definitions, keys, unit)
    for inner in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
        yield from _numbers(inner, definitions, keys, unit)
    kind = schema.get("properties", {}).get("kind", {}).get("const")
    for key, inner in schema.get("properties", {}).items():
        yield from _numbers(inner, definitions, (*keys, (key, kind)), unit)
    free = (schema.get("additionalProperties"), *schema.get("patternProperties", {}).values())
    for inner in free:
        if isinstance(inner, dict):
            yield from _numbers(inner, definitions, (*keys, ("some", None)), unit)
    items = [schema["items"]] if "items" in schema else []
    for index, inner in enumerate(schema.get("prefixItems", items)):
        yield from _numbers(inner, definitions, (*keys, index), unit)
    if schema.get("type") in ("number", "integer"):
        yield keys, schema, unit


def _document(keys: tuple[Any, ...], value: float) -> Any:
    document: Any = value
    for key in reversed(keys):
        if isinstance(key, int):
            document = [document] * (key + 1)
        else:
            document = {key[0]: document} | ({"kind": key[1]} if key[1] else {})
    return document


def _outside(schema: dict[str, Any]) -> Iterator[tuple[float, float]]:
    """Yield each bound of a number and a value just outside it."""
    whole = schema["type"] == "integer"
    for bound, sign in (("minimum", -1), ("maximum", 1)):
        if bound in schema:
            limit = schema[bound]
            yield limit, limit + sign * (1 if whole else max(abs(limit), 1e-9) * 1e-6)
        elif (limit := schema.get(f"exclusive{bound.title()}")) is not None:
            yield limit, limit


def _places() -> list[Place]:
    schema = campaign_schema()
    places = _numbers(schema, schema["$defs"], (), None)
    # One place for each field of a model is enough.
    return list({(str(place[0][-2:]), str(place[1])): place for place in places}.values())


def test_every_number_has_a_unit_or_says_that_it_has_none() -> None:
    places = _places()
    assert len(places) > 80
    assert [keys for keys, _, unit in places if unit is None] == []


def test_a_value_just_outside_its_bounds_is_explained_with_unit_and_bound(tmp_path: Path) -> None:
    unexplained = []
    for keys, schema, unit in _places():
        for bound, value in _outside(schema):
            message = _message(tmp_path, yaml.safe_dump(_document(keys, value)))
            names = [str(key[0] if isinstance(key, tuple) else key) for key in keys]
            place = f": {'.'.join(names)}: must be"
            lines = [line for line in message.splitlines() if place in line]
            shown = str(bound) if isinstance(bound, int) else f"{bound:.12g}"
            words = "(no unit)" if unit == "1" else f" {unit}"
            explained = any(shown in line and words in line for line in lines)
            if not explained and not any(written(bound, unit or "") in line for line in lines):
                unexplained.append((names, bound, value, lines))
    assert unexplained == []


def _as_an_editor_reads(path: Path) -> Any:
    """Return a file as JSON: editors read times as texts."""
    read = yaml.safe_load(path.read_text())
    return json.loads(json.dumps(read, default=lambda moment: moment.isoformat()))


def test_the_campaigns_fit_the_schema_and_mistakes_do_not(repository: Path) -> None:
    result = CliRunner().invoke(app, ["schema"])
    assert result.exit_code == 0
    schema = json.loads(result.stdout)
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    files = sorted((repository / "catalogs").glob("*.yaml"))
    assert files
    for path in files:
        campaign = _as_an_editor_reads(path)
        assert [error.message for error in validator.iter_errors(campaign)] == [], path
        assert not validator.is_valid({**campaign, "archve": "raw"})
        assert not validator.is_valid({**campaign, "scenes": {"window": []}})


def test_the_schema_has_units_bounds_and_defaults_of_every_kind() -> None:
    definitions = campaign_schema()["$defs"]
    ratio = definitions["ElasticSettings"]["properties"]["lidar_ratio"]
    assert ratio | {"unit": "sr", "minimum": 1, "maximum": 200, "default": 50.0} == ratio
    assert set(definitions["Products"]["properties"]) >= {"signal", "elastic", "multiangle"}
    assert "visibility" in definitions["Network"]["properties"]


def test_a_campaign_goes_to_a_fresh_process(tmp_path: Path, repository: Path) -> None:
    """Models with a field for each kind are made at import, so that they pickle by name."""
    campaign = load_campaign(repository / "catalogs/network.yaml", output=tmp_path)
    path = tmp_path / "campaign.pickle"
    path.write_bytes(pickle.dumps(campaign))
    code = (
        "import pickle, sys; campaign = pickle.load(open(sys.argv[1], 'rb'));"
        "print(campaign.model_dump_json())"
    )
    output = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
    ).stdout
    assert output.strip() == campaign.model_dump_json()
