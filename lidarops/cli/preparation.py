"""Commands before a run: first campaign file, its schema, simulated raw files, compiled code."""

from __future__ import annotations

import json
import os
import re
import tempfile
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from lidarops.cli import options
from lidarops.cli.app import (
    command,
    from_here,
    no_url,
    progress_bar,
    say,
)
from lidarops.errors import SceneError

if TYPE_CHECKING:
    from lidarops.run.options import Progress

_SCHEMA: Final = "campaign.schema.json"
_OUTPUT: Final = "out"


@command()
def init(
    folder: Annotated[
        str, typer.Argument(help="Folder of raw files.", metavar="FOLDER", callback=no_url)
    ],
    campaign: Annotated[
        Path, typer.Argument(help="Campaign file to write.", metavar="CAMPAIGN")
    ] = Path("campaign.yaml"),
    force: Annotated[bool, typer.Option("--force", help="Overwrite the campaign file.")] = False,
    headers_only: Annotated[
        bool, typer.Option("--headers-only", help="Do not look at the data of any file.")
    ] = False,
) -> None:
    """Write a commented campaign file for a folder of raw files, from their headers and some data.

    A few files of each fixed lidar are processed for a look: what gives no usable value is not
    proposed, and the range of full overlap is where signals stop rising.

    The JSON schema of its keys is written beside it, so that editors complete them. What headers
    do not state is marked with a question in a comment.

    Example: lidarops init raw harbour.yaml
    """
    from lidarops.campaign.model import editor_schema
    from lidarops.catalog.draft import draft_campaign
    from lidarops.catalog.folder import read_folder
    from lidarops.errors import CampaignError, CatalogError

    if campaign.exists() and not force:
        raise CampaignError(
            "exists", file=campaign, remedy="give another name, or --force", wrong_use=True
        )
    root, base = Path(folder).resolve(), campaign.resolve().parent
    if not root.is_dir():
        raise CatalogError(
            "is not a folder",
            file=folder,
            remedy="give the folder of the raw files",
            wrong_use=True,
        )
    contents = read_folder(str(root), guess_pointing=True)
    if not headers_only:
        from lidarops.run.first_look import without_light

        contents = without_light(contents, root)
    draft = partial(
        draft_campaign,
        contents,
        archive=Path(os.path.relpath(root, base)).as_posix(),
        output=_free_output(campaign),
        schema=_SCHEMA,
    )
    text = draft()
    if not headers_only:
        from lidarops.run.first_look import look_at_data

        with progress_bar("look at data") as bar:
            looks, failed = look_at_data(text, contents, str(root), bar.advance)
        for key, reason in failed.items():
            say(f"{key}: no look at data, drafted from headers alone: {reason}")
        text = draft(looks=looks)
    base.mkdir(parents=True, exist_ok=True)
    (base / _SCHEMA).write_text(json.dumps(editor_schema(), indent=2) + "\n", encoding="utf-8")
    campaign.write_text(text, encoding="utf-8")
    questions = sum(bool(re.search(r"#(.* )?\?( |$)", line)) for line in text.splitlines())
    say(f"{campaign}: {questions} questions to check, marked ?; next: lidarops plan {campaign}")


def _free_output(campaign: Path) -> str:
    """Return a folder of output that no other campaign file beside this one states."""
    others = (
        path for path in campaign.resolve().parent.glob("*.yaml") if path != campaign.resolve()
    )
    stated = re.compile(rf"""^output:\s*["']?{_OUTPUT}["']?\s*(#|$)""", re.MULTILINE)
    texts = (path.read_text(encoding="utf-8", errors="replace") for path in others)
    return f"{_OUTPUT}-{campaign.stem}" if any(map(stated.search, texts)) else _OUTPUT


@command()
def simulate(
    campaign: options.Campaign = Path(),
    archive: options.Archive = None,
    out: options.Out = None,
    workers: options.Workers = 1,
) -> None:
    """Write the raw Licel files of a simulated campaign, and the truth behind them.

    Example: lidarops simulate catalogs/demo.yaml --workers 2
    """
    from lidarops.campaign.model import load_campaign
    from lidarops.netcdf.write import write_plain
    from lidarops.simulate.campaign import simulate_campaign

    settings = load_campaign(campaign, archive=archive, output=out)
    with progress_bar("simulate") as bar:
        simulated = simulate_campaign(
            settings, workers=workers, progress=bar.advance, expect=bar.grow
        )
    write_plain(simulated.truth, settings.truth_path)
    say(f"{len(simulated.paths)} raw files and truth.nc in {from_here(settings.archive)}")


@command()
def schema() -> None:
    """Print the JSON schema of campaign files, for editors.

    Example: lidarops schema > campaign.schema.json
    """
    from lidarops.campaign.model import editor_schema

    typer.echo(json.dumps(editor_schema(), indent=2))


@command("compile")
def compile_code() -> None:
    """Compile the retrievals now, so that the first run need not: once after installation.

    Example: lidarops compile
    """
    say("compiling the retrievals: about two minutes")
    with progress_bar("compile", "scene") as bar:
        folder = _compile_retrievals(lambda _: bar.advance(1))
    say(f"compiled code is kept in {folder}")


def _compile_retrievals(progress: Progress) -> Path:
    """Compile what products of all kinds need, and return the folder that keeps the result.

    Later processes load the compiled code from there. What is kept for another processor is not
    used, but compiled again.

    Raises
    ------
    SceneError
        If a product of the small campaign that is simulated for it is not made, so that its code
        was not compiled.
    """
    from numba import config

    from lidarops.campaign.model import load_campaign
    from lidarops.netcdf.write import write_plain
    from lidarops.run.archive import Options, bring_up_to_date
    from lidarops.simulate.campaign import simulate_campaign

    with (
        tempfile.TemporaryDirectory(prefix="lidarops-compile-") as folder,
        resources.as_file(resources.files("lidarops.run") / "compile.yaml") as path,
    ):
        campaign = load_campaign(path, archive=f"{folder}/raw", output=f"{folder}/out")
        simulated = simulate_campaign(campaign)
        write_plain(simulated.truth, campaign.truth_path)
        result = bring_up_to_date(campaign, options=Options(progress=progress))
    if result.has_failures:
        raise SceneError(
            "not all products of the campaign for compilation were made",
            remedy="report it: the installation is incomplete, or lidarops has a bug",
        )
    return Path(str(vars(config)["CACHE_DIR"]))
