"""The typer application; the options that commands share, what they mean, and their output."""

from __future__ import annotations

import errno
import json
import logging
import os
import sys
import textwrap
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial, wraps
from itertools import chain, product
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, Final, ParamSpec, TypeVar

import typer

from lidarops.errors import REFUSED, UNAVAILABLE, LidarOpsError, UnavailableError
from lidarops.figures.wording import counted, duration, listed, visible
from lidarops.kinds import kinds

if TYPE_CHECKING:
    from lidarops.campaign.model import Campaign
    from lidarops.records import Findings
    from lidarops.run.options import Selection


app = typer.Typer(
    help="Reprocess archives of atmospheric lidar data into CF-compliant products.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

CAMPAIGN_FILE: Final = "campaign.yaml"
NO_SCENE: Final = "nothing to do: the selection contains no scene of the archive"

Table = tuple[str, Iterable[str], Iterable[Iterable[Any]]]
"""Title, names of columns, and rows."""
_P = ParamSpec("_P")
_T = TypeVar("_T")

PROGRESS_INTERVAL: float = 30.0
"""s between lines of progress where there is no terminal."""

_TABLE_LINES = 3
"""Characters between the columns of a table."""

_FILE_WIDTH = 10_000
"""Width of tables that are not printed on a terminal: no cell folds."""

_LEVELS: Final = ("debug", "info", "warning", "error")
_EXTRA_FIELDS: Final = frozenset(
    {"run", "scene", "granule", "granules", "product", "products", "seconds", "reason"}
)


def show_error(error: LidarOpsError) -> None:
    """Show an error on standard error."""
    typer.secho(visible(f"error: {error}"), fg="red", err=True)


def say(text: object) -> None:
    """Print a text; control characters, which a file name may hold, are shown as escapes."""
    typer.echo(visible(str(text)))


def command(
    name: str | None = None, *, program: typer.Typer = app, **options: Any
) -> Callable[[Callable[_P, None]], Callable[_P, None]]:
    """Register a function as a command that shows a lidarops error as a line, not a traceback."""

    def registered(function: Callable[_P, None]) -> Callable[_P, None]:
        help_ = _paragraphs(function.__doc__ or "")
        return program.command(name, help=help_, **options)(_ending_with_a_line(function))

    return registered


def _ending_with_a_line(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Return a function that shows a lidarops error as a line, and ends with its exit code."""

    @wraps(function)
    def wrapped(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        try:
            return function(*args, **kwargs)
        except LidarOpsError as error:
            show_error(error)
            raise typer.Exit(error.exit_code) from error
        except OSError as error:
            # Typer ends quietly where the reader of a pipe has gone.
            if error.errno == errno.EPIPE:
                raise
            name = error.filename
            problem = LidarOpsError(
                error.strerror or repr(error),
                file=None if name is None else os.fsdecode(name),
                remedy="check permissions, space and connection, then run the command again",
            )
            show_error(problem)
            raise typer.Exit(UNAVAILABLE) from error

    return wrapped


def _paragraphs(text: str) -> str:
    """Return a text with each paragraph in one line, for a terminal of any width."""
    lines = (" ".join(paragraph.split()) for paragraph in text.split("\n\n"))
    return "\n\n".join(filter(None, lines))


def from_here(place: Path | str) -> str:
    """Return a path within the working folder relative to it, any other place as it is."""
    path, here = Path(place), Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else place)


def _print_version(requested: bool) -> None:  # noqa: FBT001 - typer calls it so
    if requested:
        from lidarops import __version__

        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    pass


def no_url(folder: str | None) -> str | None:
    """Refuse a URL where a folder is needed: as a path it would name a folder."""
    if folder is not None and "://" in folder:
        raise typer.BadParameter(f"{folder!r} is a URL; give a folder")
    return folder


def utc(moment: datetime | None) -> datetime | None:
    """Return a time with its zone; without a zone it is UTC."""
    return None if moment is None else moment.replace(tzinfo=moment.tzinfo or UTC)


def exit_with_status(*, failed: bool) -> None:
    """Exit with code 1 if something failed."""
    if failed:
        raise typer.Exit(REFUSED)


class Bar:
    """Progress in words: what is done, how long it took and will take, and what was compiled."""

    def __init__(self, name: str, unit: str) -> None:
        self._name, self._unit = name, unit
        self._total = self._done = 0
        self._started = monotonic()
        self._known = compiled_functions()

    def grow(self, number: int) -> None:
        """Add to the number of things to do."""
        self._total += number

    def advance(self, number: int) -> None:
        """Add to the number of things done."""
        self._done += number

    def __str__(self) -> str:
        """Return one line."""
        elapsed = monotonic() - self._started
        done, share, remaining = counted(self._done, self._unit), "", "unknown"
        if self._total:
            done = f"{self._done:,} of {counted(self._total, self._unit)}"
            share = f", {self._done / self._total:.0%}"
            if self._done:
                left = max(self._total - self._done, 0)
                remaining = duration(elapsed * left / self._done)
        words = f"{self._name}: {done}{share}, elapsed {duration(elapsed)}, remaining {remaining}"
        return "; ".join(filter(None, (words, self.compiled())))

    def compiled(self) -> str:
        """Return how many functions were compiled meanwhile, in words; empty for none."""
        known = compiled_functions()
        # The numerics may have been loaded since.
        self._known = known if self._known is None else self._known
        new = (known or 0) - (self._known or 0)
        return f"{counted(new, 'function')} compiled, once for this installation" if new else ""


def compiled_functions() -> int | None:
    """Return the number of compiled functions that are kept; None before numerics are loaded."""
    if "lidarops.retrieve.common.compiled_code" not in sys.modules:
        return None
    from numba import config

    folder = vars(config)["CACHE_DIR"]
    return sum(1 for _ in Path(folder).rglob("*.nbi")) if folder else None


@contextmanager
def progress_bar(name: str, unit: str = "file") -> Iterator[Bar]:
    """Show progress on standard error; a line every 30 s where that is no terminal."""
    bar = Bar(name, unit)
    with ExitStack() as stack:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            console = Console(stderr=True)
            # Rarely, because each drawing counts the files of compiled functions.
            shown = partial(Live, console=console, transient=True, refresh_per_second=0.5)
            stack.enter_context(shown(get_renderable=lambda: str(bar)))
        else:
            ended = threading.Event()
            teller = threading.Thread(target=_tell, args=(bar, ended), daemon=True)
            teller.start()
            stack.callback(teller.join)
            stack.callback(ended.set)
        yield bar
    if bar.compiled():
        typer.echo(f"{name}: {bar.compiled()}", err=True)


def _tell(bar: Bar, ended: threading.Event) -> None:
    while not ended.wait(PROGRESS_INTERVAL):
        typer.echo(bar, err=True)


def show_rows(title: str, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Print a table as `show_tables` does."""
    show_tables([(title, columns, rows)])


def show_tables(
    tables: Iterable[Table], most: int | None = None, lines: int = 0, main: int = 0
) -> int:
    """Print tables of plain text, but those without rows, and return the number of lines.

    With `most`, so many rows of each, or fewer where all tables together would fill more than so
    many lines; the first `main` tables are cut after the others. On a terminal, cells fold between
    words only, so that names can be read and copied. Where the words are too long for columns, each
    row is a paragraph, as are those of one column.
    """
    whole = [(title, list(columns), list(rows)) for title, columns, rows in tables]
    shown = [_table(*table, most) for table in whole]
    parts = range(main, len(whole)), range(main)
    for numbers, rows in product(parts, range(most or 0, -1, -1)):
        if most is None or sum(map(len, shown)) <= lines:
            break
        for number in numbers:
            shown[number] = _table(*whole[number], rows)
    for line in chain.from_iterable(shown):
        typer.echo(line)
    return sum(map(len, shown))


def _table(title: str, names: list[str], rows: list[Iterable[Any]], most: int | None) -> list[str]:
    """Return the lines of a table of at most so many rows; none of one without rows."""
    # A file name may hold what moves the cursor of a terminal.
    kept = [[visible(str(cell)) for cell in row] for row in rows[:most]]
    if len(kept) < len(rows):
        title += f", the first {len(kept)} of {len(rows)} (--all)"
    # As the title of the table it would fold at the width of the table.
    head = wrapped(title, "") if rows else []
    if not kept:
        return head
    widths = _column_widths(names, kept, terminal_width()) if len(names) > 1 else None
    if widths is None:
        end = [""] if len(names) > 1 else []
        paragraphs = [
            wrapped(f"{name}: {cell}" if name else cell, "  ") or [""]
            for row in kept
            for name, cell in zip((*names, *end), (*row, *end), strict=True)
        ]
        return [*head, *(line for paragraph in paragraphs for line in paragraph)]
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    table = RichTable()
    for name, width in zip(names, widths, strict=True):
        table.add_column(name, width=width, overflow="fold")
    for row in kept:
        # Text, because rich would read brackets in a path or reason as markup.
        table.add_row(*(Text(cell) for cell in row))
    console = Console(width=terminal_width())
    with console.capture() as drawn:
        console.print(table)
    return [*head, *drawn.get().splitlines()]


def terminal_width() -> int:
    """Return the number of characters in a line; many if the output is no terminal."""
    from rich.console import Console

    console = Console()
    return console.width if console.is_terminal else _FILE_WIDTH


def wrapped(text: str, indent: str) -> list[str]:
    """Return lines of a text that fold between words only, the later ones indented further."""
    if text.isprintable() and 0 < len(text) <= terminal_width() - len(indent):
        return [indent + text]
    later = f"{indent}  "
    return textwrap.wrap(
        " ".join(text.split()),
        max(terminal_width(), len(later) + 1),
        initial_indent=indent,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )


def say_wrapped(text: str, indent: str) -> int:
    """Print a text whose lines fold between words only, and return their number."""
    lines = wrapped(text, indent)
    for line in lines:
        say(line)
    return len(lines)


def _column_widths(names: list[str], cells: list[list[str]], width: int) -> list[int] | None:
    """Return widths of columns that break no word; None if these do not fit in a line."""
    columns = [list(column) for column in zip(names, *cells, strict=True)]
    words = ([word for cell in column for word in cell.split()] for column in columns)
    least = [max(map(len, column), default=0) for column in words]
    whole = [max(map(len, column)) for column in columns]
    spare = width - sum(least) - _TABLE_LINES * len(columns) - 1
    if spare < 0:
        return None
    wanted = sum(whole) - sum(least)
    share = min(1.0, spare / wanted) if wanted else 0.0
    return [low + int(share * (high - low)) for low, high in zip(least, whole, strict=True)]


@_ending_with_a_line
def stated(place: Path) -> Path:
    """Return the campaign file in a folder; without one the folder, and a file as it is."""
    file = place / CAMPAIGN_FILE
    return file if file.is_file() else place


@_ending_with_a_line
def campaign_file(place: Path) -> Path:
    """Return the campaign file in a folder, or that of an output folder; a file as it is."""
    if not (place := stated(place)).is_dir():
        return place
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.store import Store

    ledger, found = place / "catalog.sqlite", []
    if ledger.exists():
        try:
            with Store(f"sqlite:///{ledger}", "", create=False) as store:
                folders = store.campaign_folders()
        except LidarOpsError as error:
            error.wrong_use, error.remedy = not error.unavailable, "give a campaign file"
            raise
        for path in chain.from_iterable(sorted(Path(name).glob("*.y*ml")) for name in folders):
            with suppress(LidarOpsError):
                if Path(load_campaign(path).output) == place.resolve():
                    found.append(path)
    if len(found) != 1:
        several = f", but {', '.join(map(str, found))} write to it" if found else ""
        raise typer.BadParameter(f"{place} holds no {CAMPAIGN_FILE}{several}: give a campaign file")
    return found[0]


def loaded_campaign(
    campaign: Path,
    archive: str | None,
    out: str | None,
    catalog: str | None,
    *,
    all_steps: bool = False,
) -> Campaign:
    """Return the campaign of a file, with the places that options override."""
    from lidarops.campaign.model import load_campaign
    from lidarops.catalog.database import check_archive_and_catalog

    settings = load_campaign(campaign, archive=archive, output=out, catalog=catalog)
    check_archive_and_catalog(settings, archive=archive)
    return settings.model_copy(update={"all_steps": all_steps or settings.all_steps})


def selection_of(
    instruments: list[str] | None,
    stations: list[str] | None,
    products: list[str] | None,
    since: datetime | None,
    until: datetime | None,
) -> Selection:
    """Return the selection that options describe; refuse an unknown kind of product."""
    from lidarops.run.options import selected

    for name in products or ():
        if name not in kinds():
            raise typer.BadParameter(
                f"{name!r} is not a kind of product; the kinds are {', '.join(kinds())}"
            )
    return selected(instruments, stations, products, utc(since), utc(until))


class JsonLines(logging.Formatter):
    """Formats a log record as one line of JSON, including the fields passed as `extra`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **{key: value for key, value in vars(record).items() if key in _EXTRA_FIELDS},
        }
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
        return json.dumps(fields, default=str)


class TextLines(logging.Formatter):
    """Formats a log record as text, with control characters, as of file names, as escapes."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text."""
        return visible(super().format(record))


def set_up_log(level: str, *, as_json: bool, file: Path | None) -> None:
    """Send the log of the package to a file or to standard error.

    Raises
    ------
    CatalogError
        If the file cannot be opened.
    typer.BadParameter
        If the level is unknown.
    """
    if level.lower() not in _LEVELS:
        raise typer.BadParameter(f"{level!r} is not one of {', '.join(_LEVELS)}")
    logger = logging.getLogger("lidarops")
    try:
        handler: logging.Handler = (
            logging.StreamHandler() if file is None else logging.FileHandler(file, delay=False)
        )
    except OSError as error:
        raise UnavailableError(
            f"cannot be written: {error.strerror}", file=file, remedy="choose another --log-file"
        ) from error
    text = TextLines("%(asctime)s %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
    handler.setFormatter(JsonLines() if as_json else text)
    for previous in list(logger.handlers):
        logger.removeHandler(previous)
        previous.close()
    logger.addHandler(handler)
    logger.setLevel(level.upper())
    logger.propagate = False


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


def finding_tables(findings: Findings) -> Iterator[Table]:
    """Yield the findings as tables."""
    from lidarops.reports.findings import finding_rows, unmet_rows

    columns: tuple[str, ...] = ("instrument", "channel", "requested by", "reason", "missing in")
    yield "Requested, but not in the files", columns, unmet_rows(findings)
    columns = ("instrument", "what", "finding")
    rows = finding_rows(findings)
    for title, fails in (
        ("The archive is not what the campaign states", True),
        ("Notes on files and products", False),
    ):
        found = [(row.instrument, row.subject, row.problem) for row in rows if row.fails is fails]
        yield title, columns, found


def never_made(findings: Findings) -> str:
    """Return the requested products that no scene gives, for the end of a line."""
    from lidarops.reports.findings import unmade_words

    names = listed(unmade_words(findings))
    return f"; requested, but made in no scene: {names}" if names else ""
