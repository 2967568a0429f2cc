"""Keys and passwords in URLs stay out of what a run writes and says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from support.archives.small_archive import Archive
from typer.testing import CliRunner

from lidarops.catalog.database import WITHOUT_PASSWORD, holds_password
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.errors import CatalogError

SECRET = "swordfish"
URL = f"memory://user:{SECRET}@bucket/raw"


@pytest.mark.parametrize("command", ["catalog", "plan", "reprocess", "verify"])
@pytest.mark.parametrize("place", ["file", "option", "environment"])
def test_an_archive_with_a_key_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, place: str
) -> None:
    archive = Archive(tmp_path, days=1)
    if place == "file":
        archive.tree["archive"] = URL
    if place == "environment":
        monkeypatch.setenv("LIDAROPS_ARCHIVE", URL)
    archive.file.write_text(yaml.safe_dump(archive.tree))
    options = ["--archive", URL] if place == "option" else []
    result = CliRunner().invoke(app, [command, str(archive.file), *options])
    assert result.exit_code == 2
    assert "memory://bucket/raw" in result.output
    assert "AWS_ACCESS_KEY_ID" in result.output
    assert SECRET not in result.output
    assert not (tmp_path / "out").exists()


def test_a_store_with_a_key_is_refused_by_publish(tmp_path: Path) -> None:
    archive = Archive(tmp_path, days=1)
    archive.write()
    CliRunner().invoke(app, ["catalog", str(archive.file)])
    result = CliRunner().invoke(app, ["publish", str(archive.file), f"s3://key:{SECRET}@bucket"])
    assert result.exit_code == 2
    assert SECRET not in result.output


@pytest.mark.parametrize(
    ("rest", "holds"),
    [
        ("user@host:5432/name", False),
        ("user:@host/name", False),
        ("host:5432/na:me?application_name=password", False),
        ("/name?service=file://name:port@host", False),
        (f"user:{SECRET}@host/name", True),
        (f":{SECRET}@host/name", True),
        (f"user:{SECRET}/?@host/name", True),
        (f"host/name?sslmode=require&sslpassword={SECRET}", True),
    ],
)
def test_schemas_and_settings_agree_which_urls_hold_a_password(rest: str, holds: bool) -> None:
    url = f"postgresql+psycopg://{rest}"
    assert holds_password(url) is holds
    assert (re.search(WITHOUT_PASSWORD, url) is None) is holds


@pytest.mark.parametrize(
    "url",
    [
        f"postgresql+psycopg//user:{SECRET}@host/name",
        f"luck://user:{SECRET}@host/name",
        f"postgresql+psycopg://user:{SECRET}@127.0.0.1:1/name",
        f"postgresql+psycopg://user@127.0.0.1:1/name?password={SECRET}",
        f"postgresql+psycopg//user@host/name?password={SECRET}",
    ],
)
def test_errors_of_a_database_do_not_show_its_password(url: str) -> None:
    with pytest.raises(CatalogError) as caught, Store(url, "campaign") as store:
        store.granules()
    assert SECRET not in str(caught.value)
