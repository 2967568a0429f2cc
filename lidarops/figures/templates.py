"""Page templates and the shared style of reports and the site."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from lidarops import __version__
from lidarops.figures.wording import counted, percent, size, verdicts_in_words, visible

_SHARED = "lidarops.figures"


@cache
def style(package: str, name: str) -> bytes:
    """Return a style sheet: the rules that all pages share, and those of a package."""
    parts = ((_SHARED, "page.css"), (package, name))
    return b"".join(files(where).joinpath("templates", part).read_bytes() for where, part in parts)


@cache
def environment(package: str) -> Environment:
    """Return the environment of the templates of a package, and of those that all pages share.

    Every text is escaped, with its control characters shown.
    """
    own = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader(_SHARED)]),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: visible(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    own.globals |= {"version": __version__, "counted": counted, "percent": percent, "size": size}
    own.globals |= {"verdicts": verdicts_in_words}
    return own
