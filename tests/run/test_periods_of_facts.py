"""Files whose time the facts do not hold, or declare invalid."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.archives.small_archive import Archive, made
from typer.testing import CliRunner, Result

from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.run.archive import reprocess

pytestmark = pytest.mark.usefixtures("quickly")

SECOND, LATER, THIRD = "2026-03-02T00:00:00Z", "2026-03-02T10:01:30Z", "2026-03-03T00:00:00Z"
OF_SECOND = ["rich/h10", "rich/h11", "rich/h12"]
WHY = "the laser was not aligned"


def refused(archive: Archive) -> dict[str, str]:
    """Return the refused files of the archive, with their reasons."""
    campaign = archive.write()
    with Store(campaign.catalog_url, campaign.name) as store:
        return {granule.path: granule.reason for granule in store.refused()}


def products_of_second(archive: Archive) -> list[Path]:
    """Return the products of the second day of the instrument with facts."""
    return sorted(archive.folder.glob("out/products/coast/rich/**/*20260302*.nc"))


def declare(archive: Archive, begin: str, end: str = THIRD) -> None:
    """Declare a period of the second day invalid."""
    facts = archive.tree["instruments"]["rich"]["facts"]
    before = {**facts[0], "valid_to": begin}
    facts[:1] = [before, {"valid_from": begin, "valid_to": end, "invalid": WHY}]


def command(archive: Archive, *words: str) -> Result:
    """Return the result of a command on the campaign."""
    archive.write()
    name, *options = words
    return CliRunner().invoke(app, [name, str(archive.file), *options])


def test_files_of_no_period_of_facts_are_refused(archive: Archive) -> None:
    archive.tree["instruments"]["rich"]["facts"][0]["valid_to"] = SECOND
    before = products_of_second(archive)
    result = command(archive, "reprocess", "--json")
    assert result.exit_code == 1
    assert sorted(json.loads(result.stdout)["refused_files"]) == OF_SECOND
    reasons = refused(archive)
    words = "starts 2026-03-02 10:00, a time that no period of the facts holds: one ends"
    assert f"{words} 2026-03-02 00:00, one begins 2026-03-03 00:00 (" in reasons["rich/h10"]
    # The facts may be mistaken.
    assert products_of_second(archive) == before


def test_products_of_an_invalid_period_go(archive: Archive) -> None:
    assert products_of_second(archive)
    declare(archive, SECOND)
    campaign = archive.write()
    result = reprocess(campaign)
    assert sorted(refused(archive)) == OF_SECOND
    done = command(archive, "reprocess", "--remove-orphans", "--json")
    assert done.exit_code == 0, done.output
    assert products_of_second(archive) == []
    assert result is None or "rich 2 signal photon" not in made(result)


def test_an_invalid_part_of_a_scene_is_left_out_and_named_in_the_product(archive: Archive) -> None:
    declare(archive, LATER)
    done = command(archive, "reprocess", "--json")
    assert done.exit_code == 0, done.output
    assert list(refused(archive)) == ["rich/h12"]
    assert refused(archive)["rich/h12"].endswith(WHY)
    products = json.loads(done.stdout)["products"]
    assert [path for path in products if "/rich/" in path and "20260302" in path]


@pytest.mark.parametrize("name", ["plan", "catalog"])
def test_commands_name_invalid_files_and_succeed(archive: Archive, name: str) -> None:
    declare(archive, SECOND)
    result = command(archive, name, "--json")
    assert result.exit_code == 0, result.output
    assert WHY in result.stdout


def test_dark_files_are_used_whatever_period_they_are_of(archive: Archive) -> None:
    """The only one is of the first day, at 11:40; it is subtracted on that day and the next."""
    facts = archive.tree["instruments"]["rich"]["facts"]
    noon = {"valid_from": "2026-03-01T11:00:00Z", "valid_to": "2026-03-01T12:00:00Z"}
    later = {**facts[0], "valid_from": noon["valid_to"]}
    facts[:1] = [{**facts[0], "valid_to": noon["valid_from"]}, {**noon, "invalid": WHY}, later]
    planned = command(archive, "plan", "--all", "--instrument", "rich")
    assert planned.exit_code == 0, planned.output
    assert refused(archive) == {}
    assert planned.output.count("1 dark") >= 2
