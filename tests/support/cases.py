"""Tests of many cases that share their fixtures, as one test that names the case that fails."""

from __future__ import annotations

import functools
import inspect
import itertools
from collections.abc import Callable, Iterable
from typing import Any

Test = Callable[..., None]


def each(names: str | tuple[str, ...], values: Iterable[Any]) -> Callable[[Test], Test]:
    """Return a decorator that runs a test for each of the values, in one test.

    The arguments are those of `pytest.mark.parametrize`; of several decorators, all combinations
    are run. Fixtures are made once: a test that changes one needs `parametrize`.
    """
    split = [name.strip() for name in names.split(",")] if isinstance(names, str) else names
    single = isinstance(names, str) and len(split) == 1
    cases = [dict(zip(split, [row] if single else row, strict=True)) for row in values]
    assert cases, f"no cases of {names}"

    def decorate(test: Test) -> Test:
        function, others = getattr(test, "of_each", (test, [{}]))
        combined = [one | other for one, other in itertools.product(cases, others)]

        @functools.wraps(function)
        def run(*instance: object, **fixtures: object) -> None:
            for case in combined:
                try:
                    function(*instance, **fixtures, **case)
                except Exception as error:
                    error.add_note(f"in the case {repr(case)[:500]}")
                    raise

        signature = inspect.signature(function)
        fixtures = [p for p in signature.parameters.values() if p.name not in combined[0]]
        run.__signature__ = signature.replace(parameters=fixtures)
        run.of_each = function, combined
        return run

    return decorate
