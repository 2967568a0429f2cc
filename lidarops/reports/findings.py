"""Findings about archive and campaign in words, for the terminal, the log and the report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from lidarops.figures.wording import counted
from lidarops.records import Findings, SceneOutcome, Unmet


@dataclass(frozen=True, slots=True)
class FindingRow:
    """One finding about an instrument or network."""

    instrument: str
    subject: str
    """Key of the campaign or number of files that it is about."""
    problem: str
    fails: bool
    """Whether the run counts as failed for it."""


def finding_rows(findings: Findings) -> list[FindingRow]:
    """Return the findings besides missing channels, those that fail a run first."""
    return sorted(_rows(findings), key=lambda row: not row.fails)


def disagreement_rows(scenes: Iterable[SceneOutcome]) -> Iterator[FindingRow]:
    """Yield a row for each two channels of a scene that disagree."""
    for scene in scenes:
        for pair in scene.disagreements:
            subject = f"{pair.kind}: {', '.join(pair.channels)}"
            problem = f"in {scene.scene}, {pair.words}"
            yield FindingRow(scene.instrument, subject, problem, fails=False)


def scene_note_rows(scenes: Iterable[SceneOutcome]) -> list[FindingRow]:
    """Return a row for each note on the data of an instrument, the most frequent first."""
    notes = Counter((scene.instrument, note) for scene in scenes for note in scene.notes)
    return [
        FindingRow(instrument, counted(count, "scene"), note, fails=False)
        for (instrument, note), count in sorted(notes.items(), key=lambda row: (-row[1], row[0]))
    ]


def unmade_words(findings: Findings) -> list[str]:
    """Return the products that no scene gives, such as ``elastic glued_532o of hill-lidar``."""
    return [
        f"{unmade.kind} {unmade.channel or 'of all channels'} of {unmade.instrument}"
        for unmade in findings.unmade
    ]


def unmet_rows(findings: Findings) -> list[tuple[str, str, str, str, str]]:
    """Return the requested channels that files lack: why, and in how many files."""
    return [
        (unmet.instrument, unmet.channel, unmet.requested_by, unmet.reason, _lacking(unmet))
        for unmet in findings.unmet
    ]


def _lacking(unmet: Unmet) -> str:
    expected = unmet.files_expected
    if unmet.nowhere:
        return "the only file" if expected == 1 else f"all {expected:,} files"
    return f"{unmet.files:,} of {expected:,} files"


def _rows(findings: Findings) -> Iterator[FindingRow]:
    for lost in findings.lost_files:
        fate = "products are made again of the files that are left"
        if lost.kept:
            fate = (
                f"{counted(lost.kept, 'product')} that they belong to stay as they are: bring the"
                " files back, or name them under acknowledged in the campaign file"
            )
        more = lost.files - len(lost.names)
        names = ", ".join(lost.names) + (f" and {more:,} more" if more else "")
        gone = "have vanished, are empty now or cannot be read"
        problem = f"{gone}, though products were made from them; {fate}"
        subject = f"{lost.files:,} of {counted(lost.of, 'raw file')}: {names}"
        yield FindingRow(lost.instrument, subject, problem, fails=bool(lost.kept))
    for idle in findings.idle_patterns:
        subject = f"{idle.key}: {idle.pattern}"
        yield FindingRow(idle.instrument, subject, "matches no file of the archive", fails=True)
    for facts in (*findings.idle_facts, *findings.incomplete_facts):
        yield FindingRow(facts.instrument, facts.subject, facts.reason, fails=False)
    for note in findings.file_notes:
        files = counted(note.files, "file")
        yield FindingRow(note.instrument, files, note.text, fails=note.contradicts)
    for unusable in findings.unusable_files:
        subject = f"{unusable.key}: {unusable.path}"
        yield FindingRow(unusable.instrument, subject, unusable.problem, fails=True)
    for unmade in findings.unmade:
        subject = f"products: {unmade.kind} {unmade.channel or 'of all channels'}"
        yield FindingRow(unmade.instrument, subject, f"not made: {unmade.reason}", fails=False)
