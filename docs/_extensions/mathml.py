"""Formulas as MathML, which browsers show without a script from another host."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util import logging

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.writers.html5 import HTML5Translator

_LOG = logging.getLogger(__name__)
_TAG = re.compile(r"\\tag\{([^}]*)\}")
# The converter passes on commands that it does not know.
_UNKNOWN = re.compile(r">\s*(\\[A-Za-z]+)")


def _mathml(node: nodes.math | nodes.math_block, display: str) -> str:
    latex = _TAG.sub(lambda tag: rf"\qquad \text{{({tag[1]})}}", node.astext())
    text = convert(latex, display=display)
    if unknown := _UNKNOWN.search(text):
        _LOG.warning("MathML has no %s; write it another way", unknown[1], location=node)
    return text


def _inline(translator: HTML5Translator, node: nodes.math) -> None:
    translator.body.append(_mathml(node, "inline"))
    raise nodes.SkipNode


def _block(translator: HTML5Translator, node: nodes.math_block) -> None:
    anchors = "".join(f'<span id="{name}"></span>' for name in node["ids"])
    translator.body.append(f'{anchors}<div class="math">{_mathml(node, "block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer."""
    app.add_html_math_renderer(
        "mathml", inline_renderers=(_inline, None), block_renderers=(_block, None)
    )
    return {"parallel_read_safe": True, "parallel_write_safe": True}
