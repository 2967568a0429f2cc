"""Patterns of the paths of files, as campaigns name them."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Callable, Iterable


def path_matcher(patterns: Iterable[str]) -> Callable[[str], bool]:
    """Return a function that tells whether a path matches one of some patterns."""
    expressions = [path_pattern(pattern) for pattern in patterns]
    return lambda path: any(expression.match(path) for expression in expressions)


def path_pattern(pattern: str) -> re.Pattern[str]:
    """Return the expression of a pattern of paths: that of a shell, whose ** stands for folders."""
    expressions = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    tokens = re.split(r"(\*\*/|\*\*|\*|\?|\[[!^]?\]?[^]/]*\])", pattern)
    expression = "".join(
        expressions.get(token) or (_choice(token) if number % 2 else re.escape(token))
        for number, token in enumerate(tokens)
    )
    return re.compile(expression + r"\Z")


def _choice(brackets: str) -> str:
    """Return the expression of characters in brackets, such as [67], [a-f], [!0]."""
    translated = fnmatch.translate(re.sub(r"^\[\^", "[!", brackets))
    return "(?!/)" + translated.removeprefix("(?s:")[: -len(r")\Z")]


def literal_pattern(path: str) -> str:
    """Return the pattern that matches one path only, whatever characters it holds."""
    return re.sub(r"[*?\[{]", r"[\g<0>]", path)
