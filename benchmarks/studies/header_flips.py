"""Digits flipped in headers: ``python -m benchmarks.studies.header_flips FOLDER``.

A digit of a header is replaced by another one, and the file goes the way of every file: its
header and counts as a run reads them, the catalog, the comparison with the files around it, the
cut into scenes. Prints the share of each outcome by field of the header.
"""

from __future__ import annotations

import argparse
import random
import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Final

import pandas as pd

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.catalog.headers import HEADER_BYTES, Headers, UnreadFile, read_header
from lidarops.catalog.sources import RawFile, Source, path_pattern
from lidarops.errors import RawFormatError
from lidarops.raw.formats import parse_raw_header
from lidarops.raw.header import RawChannel, RawHeader
from lidarops.records import Granule, Role, Status, day_of
from lidarops.run.outlying_headers import without_outlying
from lidarops.run.scenes import cut_scenes
from lidarops.simulate.campaign import simulate_campaign

ROOT: Final = Path(__file__).resolve().parents[2]
REAL: Final = ("pilar", "saopaulo", "manaus", "rhis")
SIMULATED: Final = ("demo", "scan", "network")
OUTCOMES: Final = ("refused", "set aside", "noted", "used", "without effect")
"""The last but one is an error that nobody is told of; the last changes nothing that is read."""
LINE_2: Final = (
    "site", "start day", "start time", "stop day", "stop time", "altitude", "longitude",
    "latitude", "zenith angle", "azimuth or dummy", "temperature", "pressure",
)  # fmt: skip
LINE_3: Final = ("laser shots", "repetition rate", "laser shots", "repetition rate", "datasets")
DATASET: Final = (
    "active", "type", "laser", "bins", "laser polarisation", "high voltage", "bin width",
    "wavelength", "not used", "not used", "bin shift", "bin shift", "ADC bits", "shots",
    "input range or discriminator", "device",
)  # fmt: skip


class Memory(Source):
    """The files of an archive, one of them with other content."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.changed: dict[str, bytes] = {}

    def head(self, path: str, size: int) -> bytes:
        """Return the first bytes of a file."""
        return self.changed[path][:size] if path in self.changed else super().head(path, size)


class Flips:
    """The files of a campaign, and what becomes of one in which a digit is flipped."""

    def __init__(self, campaign: Campaign) -> None:
        self.campaign = campaign
        self.root = Path(campaign.archive)
        self.source = Memory(self.root)
        self.headers = Headers(self.source, campaign, campaign.name)
        self.files = [file for file in _files(campaign) if self._is_good(file)]
        self.granules = {due.file.path: read_header(self.headers, due) for due in self.files}

    def _is_good(self, due: UnreadFile) -> bool:
        return read_header(self.headers, due).status is Status.GOOD

    def outcome(self, due: UnreadFile, content: bytes) -> str:
        """Return what becomes of a file with this content."""
        path = due.file.path
        before = self.granules[path]
        self.source.changed = {path: content}
        granule = read_header(self.headers, due)
        try:
            header = parse_raw_header(content, file=path, size=len(content))
        except RawFormatError:
            return "refused"
        if granule.status is not Status.GOOD:
            return "refused"
        kept, refused = without_outlying(
            [*(g for g in self.granules.values() if g is not before), granule],
            {day_of(g.start) for g in (before, granule) if g.start},
            self._header,
        )
        if any(other.path == path for other in refused):
            return "refused"
        if any(other.path == path for other in cut_scenes(self.campaign, kept).set_aside):
            return "set aside"
        (own,) = (other for other in kept if other.path == path)
        if {*own.notes, *own.contradictions} - {*before.notes, *before.contradictions}:
            return "noted"
        original = (self.root / path).read_bytes()
        whole = parse_raw_header(original, file=path, size=len(original))
        same = _used(whole, due.role) == _used(header, due.role)
        return "without effect" if same else "used"

    def _header(self, granule: Granule) -> RawHeader | None:
        try:
            head = self.source.head(granule.path, HEADER_BYTES)
            return parse_raw_header(head, file=granule.path, size=granule.size)
        except RawFormatError:
            return None


def _used(header: RawHeader, role: Role) -> list[object]:
    """Return what products and scenes follow from."""
    # Dark signal is the same wherever the beam points; the position is that of the station.
    pointing = () if role is Role.DARK else ("zenith_angle", "azimuth")
    names = ("format", "size", "start", "stop", "doubt", "written_angle", *pointing)
    return [getattr(header, name) for name in names] + [
        getattr(channel, item.name) for channel in header.channels for item in fields(RawChannel)
    ]


def _files(campaign: Campaign) -> Iterator[UnreadFile]:
    source = Source.of(campaign.archive)
    for file in source.files():
        for key, instrument in campaign.instruments.items():
            roles = ((Role.SIGNAL, instrument.files), (Role.DARK, instrument.dark_files))
            for role, patterns in roles:
                if any(path_pattern(pattern).fullmatch(file.path) for pattern in patterns):
                    yield UnreadFile(RawFile(*file), key, role, (), "")


def fields_of(content: bytes) -> Iterator[tuple[int, str]]:
    """Yield the place of each digit of a header, and the field that it belongs to."""
    start, number, scans = 0, 0, 0
    while content[start : start + 2] != b"\r\n":
        end = content.index(b"\r\n", start)
        line = content[start:end].decode("latin-1")
        names: tuple[str, ...]
        if number == 0:
            names = ("name",)
        elif number == 1:
            names = LINE_2[1:]
        elif number == 2 and len(re.findall(r"\d[.,]\d", line)) == 7:
            names, scans = ("grid of the scan",) * 7, 1
        else:
            names = LINE_3 if number == 2 + scans else DATASET
        offset = re.search(r"\d+/\d+/\d{4}", line) if number == 1 else None
        begin = offset.start() if offset else 0
        for name, token in zip(names, re.finditer(r"\S+", line[begin:]), strict=False):
            place = start + begin + token.start()
            for digit in re.finditer(r"\d", token[0]):
                yield place + digit.start(), name
        start, number = end + 2, number + 1


def measured(flips: Flips, number: int, seed: int) -> Iterator[tuple[str, str]]:
    """Yield field and outcome of some random flips."""
    chance = random.Random(seed)
    for _ in range(number):
        due = chance.choice(flips.files)
        content = bytearray((flips.root / due.file.path).read_bytes())
        place, field = chance.choice(list(fields_of(bytes(content))))
        content[place] = chance.choice([d for d in b"0123456789" if d != content[place]])
        yield field, flips.outcome(due, bytes(content))


def _archives(data: Path, folder: Path) -> Iterator[tuple[str, Campaign]]:
    for name in REAL:
        text = (ROOT / f"tests/end_to_end/campaigns/{name}.yaml").read_text(encoding="utf-8")
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
        campaign = load_campaign(folder / f"{name}.yaml")
        archive = data / {"manaus": ".", "rhis": "savant"}.get(name, name)
        yield name, campaign.model_copy(update={"archive": str(archive)})
    for name in SIMULATED:
        text = (ROOT / f"catalogs/{name}.yaml").read_text(encoding="utf-8")
        if "damage:" not in text:
            text = re.sub(r"\n  duration: .*", "\n  duration: 3600", text)
        text = re.sub(r"\narchive: .*", f"\narchive: {folder}/{name}", text)
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
        campaign = load_campaign(folder / f"{name}.yaml")
        simulate_campaign(campaign)
        yield name, campaign


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("data", type=Path, help="folder of real raw files")
    arguments.add_argument("--flips", type=int, default=600, help="for each archive")
    options = arguments.parse_args()
    rows: list[tuple[str, str]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, campaign in _archives(options.data, Path(folder)):
            for field, outcome in measured(Flips(campaign), options.flips, seed=31):
                rows += [(place, outcome) for place in (field, f"all of {name}", "all")]
    found = pd.DataFrame(rows, columns=["field", "outcome"])
    table = pd.crosstab(found["field"], found["outcome"]).reindex(columns=OUTCOMES, fill_value=0)
    order = sorted(
        table.index, key=lambda name: (name.startswith("all"), -table["used"][name], name)
    )
    sys.stdout.write(table.loc[order].to_string() + "\n")


if __name__ == "__main__":
    main()
