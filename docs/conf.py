"""Settings of the documentation: ``make docs``."""

from __future__ import annotations

import os
import re
import sys
from importlib.metadata import version as version_of
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jupyter_client.manager import KernelManager

from lidarops.system.code_version import source_version

if TYPE_CHECKING:
    from sphinx.application import Sphinx

HERE = Path(__file__).parent
REPOSITORY = HERE.parent
sys.path[:0] = [str(HERE / "_extensions"), str(REPOSITORY / "tests"), str(REPOSITORY)]

project = "lidarops"
author = "The lidarops developers"
project_copyright = author
release = version = version_of("lidarops")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "generated",
    "mathml",
]
exclude_patterns = ["_build", "_extensions"]
# Docstrings write code in single backticks.
default_role = "code"
# Names in types of docstrings that several classes have as an attribute.
suppress_warnings = ["ref.python"]

myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 4
myst_links_external_new_tab = False

nb_execution_mode = "cache"
nb_execution_in_temp = True
# Notebooks call the commands of this environment.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
# They show what a terminal as wide as the page shows, without progress bars and colours.
os.environ |= {"TTY_COMPATIBLE": "1", "TTY_INTERACTIVE": "0", "NO_COLOR": "1", "COLUMNS": "84"}
# No notebook shows results of other code.
nb_execution_cache_path = str(HERE / "_build" / "notebooks" / source_version())
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_execution_show_tb = True
nb_merge_streams = True
# Sockets of kernels listen on the loopback interface, where others must not read along.
KernelManager.transport_encryption.default_value = "required"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring = False
napoleon_use_rtype = False

html_theme = "pydata_sphinx_theme"
html_title = "lidarops"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_favicon = "_static/logo.svg"
# Single pages have no neighbours to list.
html_sidebars = {page: [] for page in ("index", "getting_started", "faq", "results/index")}
html_math_renderer = "mathml"
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {
        **dict.fromkeys(("image_light", "image_dark"), "_static/logo.svg"),
        "text": "lidarops",
    },
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": False,
    "footer_start": ["copyright"],
    "footer_end": [],
}


SEARCHED = {
    "howto/calibration": {"Change a calibration or another fact": ("dead time", "calibration")},
    "howto/pages": {"Pages of an archive": ("quicklook", "plot", "picture")},
    "howto/aggregate": {"Use many products as one": ("mean", "monthly mean")},
    "tutorials/vertical_lidar": {"A vertical lidar": ("Klett", "Fernald")},
    "tutorials/raman_night": {"A Raman night": ("Raman", "lidar ratio")},
    "tutorials/dead_time": {"A changed dead time": ("dead time",)},
    "faq": {
        "Klett, Fernald": ("Klett", "Fernald"),
        "Depolarisation": ("depolarisation", "depolarization", "polarisation"),
        "Attenuated backscatter": ("attenuated backscatter",),
        "Quicklook": ("quicklook",),
        "Dead time": ("dead time",),
        "Overlap": ("overlap",),
        "Soundings": ("sounding", "radiosonde", "ERA5"),
    },
}
"""Words by which a search finds headings of pages: index entries come first among its hits."""


def _prepare(_: object, page: str, source: list[str]) -> None:
    """Let links to CONTRIBUTING.md, which lies above the pages, lead to the page of its text.

    Headings get their index entries.
    """
    text = re.sub(r"\]\((\.\./)+CONTRIBUTING\.md", "](/contributing.md", source[0])
    for heading, words in SEARCHED.get(page, {}).items():
        before, line, after = text.partition(f"# {heading}\n")
        if not line:
            message = f"{page} has no heading {heading}"
            raise ValueError(message)
        text = f"{before}{line}\n```{{index}} {', '.join(words)}\n```\n{after}"
    source[0] = text


def _tidy(_: object, __: str, ___: str, context: dict[str, Any], ____: object) -> None:
    """Let names in code fold behind underscores, dots and slashes, and options nowhere.

    What hides the cursor of a terminal is no output.
    """

    def fold(code: re.Match[str]) -> str:
        if code[1].startswith("--"):
            return f'<span class="pre option">{code[1]}</span>'
        folding = re.sub("([_./])(?=.)", r"\1<wbr>", code[1])
        return f'<span class="pre">{folding}</span>'

    if "body" in context:
        body = re.sub(r"\x1b?\[?\?25[lh]\n?", "", context["body"])
        context["body"] = re.sub(r'<span class="pre">([^<]*)</span>', fold, body)


def setup(app: Sphinx) -> None:
    """Connect what no setting says."""
    app.connect("source-read", _prepare)
    app.connect("html-page-context", _tidy)
