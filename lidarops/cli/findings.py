"""Findings about archive and campaign, on the terminal and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from lidarops.cli.app import show_rows
from lidarops.records import Findings


def findings_document(findings: Findings) -> dict[str, Any]:
    """Return the findings as plain JSON types."""
    return {
        "not_in_files": [
            {**asdict(request), "nowhere": request.nowhere} for request in findings.unmet
        ],
        "patterns_without_file": [asdict(idle) for idle in findings.idle_patterns],
        "file_notes": [asdict(note) for note in findings.file_notes],
        "unusable_files": [asdict(unusable) for unusable in findings.unusable_files],
        "incomplete_facts": [asdict(facts) for facts in findings.incomplete_facts],
        "unused_facts": [asdict(idle) for idle in findings.idle_facts],
        "lost_files": [asdict(lost) for lost in findings.lost_files],
        "never_made": [asdict(unmade) for unmade in findings.unmade],
    }


def show_findings(findings: Findings) -> None:
    """Print the findings as tables."""
    from lidarops.reports.findings import finding_rows, lacking

    columns: tuple[str, ...] = ("instrument", "channel", "requested by", "reason", "missing in")
    unmet = (
        (unmet.instrument, unmet.channel, unmet.requested_by, unmet.reason, lacking(unmet))
        for unmet in findings.unmet
    )
    show_rows("Requested, but not in the files", columns, unmet)
    columns = ("instrument", "what", "finding")
    for title, fails in (
        ("The archive is not what the campaign states", True),
        ("Notes on files and products", False),
    ):
        rows = [row for row in finding_rows(findings) if row.fails is fails]
        show_rows(title, columns, ((row.instrument, row.subject, row.problem) for row in rows))


def never_made(findings: Findings) -> str:
    """Return the requested products that no scene gives, for the end of a line."""
    from lidarops.reports.findings import unmade_words

    names = ", ".join(unmade_words(findings))
    return f"; requested, but made in no scene: {names}" if names else ""
