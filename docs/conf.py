"""Settings of the documentation: ``make docs``."""

from __future__ import annotations

import os
import re
import sys
from importlib.metadata import version as version_of
from pathlib import Path
from typing import TYPE_CHECKING

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
# Their output is text: no progress bars or colours, and tables as wide as a page.
os.environ |= {"TTY_COMPATIBLE": "0", "COLUMNS": "110"}
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
# Single pages have no neighbours to list.
html_sidebars = {page: [] for page in ("index", "getting_started", "results/index")}
html_math_renderer = "mathml"
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": False,
    "footer_start": ["copyright"],
    "footer_end": [],
}


def _link_to_page(_: object, __: str, source: list[str]) -> None:
    """Let links to CONTRIBUTING.md, which lies above the pages, lead to the page of its text."""
    source[0] = re.sub(r"\]\((\.\./)+CONTRIBUTING\.md", "](/contributing.md", source[0])


def setup(app: Sphinx) -> None:
    """Connect what no setting says."""
    app.connect("source-read", _link_to_page)
