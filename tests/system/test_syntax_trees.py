"""Digests of sources by their syntax trees, and the modules that sources import."""

from __future__ import annotations

import pytest

from lidarops.system.source_closure import source_facts

SOURCE = '''"""A module."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from package import types


class Place:
    """A place."""

    name: str = "here"
    """Its name."""


def area(width: float, *, height: float = 2.0) -> str:
    """Return an area in words."""
    # In m2.
    return f"{width * height:.1f} m2"
'''


def digest(source: str) -> str:
    """Return the digest of a source."""
    return source_facts(source.encode()).digest


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"""A module."""', '"""Another text."""'),
        ('"""A module."""\n', ""),
        ('    """A place."""\n', ""),
        ('"""Its name."""', '"""What it is called."""'),
        ('    """Return an area in words."""\n', ""),
        ("    # In m2.\n", ""),
        ("width * height", "(width  *  height)"),
        ("\n", "\r\n"),
        ("from package import types", "from package import others"),
        ('f"{width * height:.1f} m2"', "f'{width * height:.1f}' ' m2'"),
    ],
)
def test_words_and_layout_do_not_count(old: str, new: str):
    assert old in SOURCE
    assert digest(SOURCE.replace(old, new)) == digest(SOURCE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("2.0", "2"),
        ("2.0", "-2.0"),
        ('"here"', "here"),
        ('"here"', 'b"here"'),
        ("width * height", "height * width"),
        ("*, height", "height"),
        (": float = 2.0", "= 2.0"),
        (":.1f", ":.2f"),
        ("class Place", "class Site"),
        ("if TYPE_CHECKING", "if not TYPE_CHECKING"),
    ],
)
def test_statements_count(old: str, new: str):
    assert old in SOURCE
    assert digest(SOURCE.replace(old, new)) != digest(SOURCE)


def test_a_class_of_a_docstring_only_is_one_that_passes():
    assert digest('class A:\n    """Text."""\n') == digest("class A:\n    pass\n")


def test_statements_do_not_move_between_blocks_unnoticed():
    assert digest("if a:\n    b()\n    c()\n") != digest("if a:\n    b()\nc()\n")


def test_imports_are_found_wherever_they_stand():
    source = """
import numpy as np, a.b
from . import near
from ..up import thing
if TYPE_CHECKING:
    import unseen
else:
    import seen
def late():
    from deep.down import *
"""
    assert set(source_facts(source.encode()).imports) == {
        "numpy", "a.b", ".", ".near", "..up", "..up.thing", "seen", "deep.down", "deep.down.*",
    }  # fmt: skip
