"""A listing is complete, or it is an error: one that is cut tells of no file."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from fsspec.implementations.local import LocalFileSystem
from support.servers.stand_ins import SCHEMES, StandIn, served

from lidarops.catalog.raw_files import Source
from lidarops.errors import CatalogError

FILES = [f"coast/{day}/h{k}" for day in "ab" for k in range(4)]


@pytest.fixture
def stand_in(tmp_path: Path) -> Iterator[StandIn]:
    """A server of some files in two folders, in pages of three."""
    for name in FILES:
        file = tmp_path / "raw" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"1")
    with served(tmp_path / "raw") as server:
        server.page = 3
        yield server


def _listed(stand_in: StandIn, scheme: str) -> list[str]:
    return [file.path for file in Source.of(stand_in.url(scheme)).files()]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_whole_listing_names_all_files(stand_in: StandIn, scheme: str) -> None:
    assert _listed(stand_in, scheme) == FILES


@pytest.mark.parametrize("states_length", [False, True])
@pytest.mark.parametrize("share", [0.4, 0.8, 0.97])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_page_that_is_cut_is_an_error(
    stand_in: StandIn, scheme: str, share: float, *, states_length: bool
) -> None:
    stand_in.damaged = lambda page: page[: int(share * len(page))]
    stand_in.states_length = states_length
    with pytest.raises(CatalogError, match="cannot be listed"):
        _listed(stand_in, scheme)


def test_a_listing_of_s3_that_promises_more_and_does_not_say_where_is_an_error(
    stand_in: StandIn,
) -> None:
    stand_in.promises_more = True
    with pytest.raises(CatalogError, match="more follow"):
        _listed(stand_in, "s3")


@pytest.mark.parametrize("status", [404, 403, 500, 503])
def test_a_folder_that_is_listed_and_cannot_be_is_an_error(stand_in: StandIn, status: int) -> None:
    stand_in.statuses = {"coast/b": status, "coast/b/": status}
    with pytest.raises(CatalogError, match="cannot be listed"):
        _listed(stand_in, "http")


def test_a_folder_that_vanishes_while_its_archive_is_listed_is_an_error(tmp_path: Path) -> None:
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"1")
    listing = Source.of(str(tmp_path)).files()
    assert next(listing).path == FILES[0]
    shutil.rmtree(tmp_path / "coast/b")
    with pytest.raises(CatalogError, match="cannot be listed"):
        list(listing)


def test_a_folder_of_a_store_that_cannot_be_listed_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "coast/b").mkdir(parents=True)
    ls = LocalFileSystem.ls

    def failing(fs: LocalFileSystem, path: str, **options: object) -> object:
        if path.endswith("coast/b"):
            raise OSError(errno.EIO, "Input/output error")
        return ls(fs, path, **options)

    monkeypatch.setattr(LocalFileSystem, "ls", failing)
    with pytest.raises(CatalogError, match="Input/output error"):
        list(Source.of(f"file://{tmp_path}").files())
