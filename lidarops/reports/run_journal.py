"""The scenes of a run as they end, for the record of a run that cannot save one at its end."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from lidarops.errors import CatalogError
from lidarops.records import RunRecord, SceneOutcome
from lidarops.reports.json_records import MismatchError, from_plain, plain

FILE_NAME: Final = "scenes.jsonl"
"""Name of the journal inside a run's report folder; gone once its ``run.json`` is saved."""

_LOG = logging.getLogger(__name__)


class Journal:
    """Writes the journal of a run; where the disk refuses it, the run goes on without one.

    Parameters
    ----------
    folder : Path
        Report folder of the run.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._refused = False

    def write(self, entry: RunRecord | SceneOutcome) -> None:
        """Write the record of a run that has no scenes yet, or a scene that has ended."""
        if self._refused:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with (self._folder / FILE_NAME).open("a", encoding="ascii") as stream:
                stream.write(json.dumps(plain(entry)) + "\n")
        except OSError as error:
            self._refused = True
            _LOG.warning("no report could be made of this run if it died now: %s", error)


def load_journal(file: Path) -> RunRecord:
    """Return the record of a run that ended without one, as far as its journal reaches.

    Raises
    ------
    CatalogError
        If the file cannot be read or is no journal.
    """
    try:
        head, *lines = file.read_text(encoding="ascii").splitlines()
        record = from_plain(RunRecord, json.loads(head), "record")
        written = datetime.fromtimestamp(file.stat().st_mtime, UTC)
    except (OSError, ValueError, RecursionError, MismatchError) as error:
        raise CatalogError(f"cannot be read: {error}", file=file) from error
    scenes: dict[str, SceneOutcome] = {}
    for number, line in enumerate(lines):
        try:
            scene = from_plain(SceneOutcome, json.loads(line), f"scenes[{number}]")
        except (ValueError, RecursionError, MismatchError):
            # The kill, or the full disk, cut this line.
            break
        scenes[scene.scene] = scene
    ended = tuple(scenes[name] for name in sorted(scenes))
    return replace(record, scenes=ended, finished=max(written, record.started), cut_short=True)
