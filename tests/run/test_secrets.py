"""Passwords in URLs stay out of what a run writes and says."""

from __future__ import annotations

from pathlib import Path

import fsspec
from support.archives.small_archive import Archive

from lidarops.run.archive import bring_up_to_date, report_run

PASSWORD = "swordfish"


def test_a_password_in_the_url_of_the_archive_is_in_no_file(tmp_path: Path) -> None:
    archive = Archive(tmp_path, days=1)
    del archive.tree["instruments"]["rich"]
    store, prefix = fsspec.core.url_to_fs(f"memory://user:{PASSWORD}@{tmp_path.name}/raw")
    for path in (tmp_path / "raw" / "poor").iterdir():
        store.pipe_file(f"{prefix}/poor/{path.name}", path.read_bytes())
    archive.tree["archive"] = f"memory://user:{PASSWORD}@{tmp_path.name}/raw"
    campaign = archive.write()
    result = bring_up_to_date(campaign)
    assert result.record is not None
    assert not result.failures
    report_run(campaign, result.record)
    written = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert any(path.name == "run.json" for path in written)
    assert not [path for path in written if PASSWORD.encode() in path.read_bytes()]
