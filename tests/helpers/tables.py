"""Run the rows of a table as one item: with thousands of items, pytest takes longer for these than for the tests."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import pytest


def table(
    names: str | tuple[str, ...], rows: Iterable[Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test with each row in one item, unlike ``pytest.mark.parametrize``, and name all rows that fail."""
    names = tuple(name.strip() for name in names.split(",")) if isinstance(names, str) else names
    values = [row if len(names) > 1 else (row,) for row in rows]
    assert values, "expected some rows, received none"

    def over(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def every(*arguments: Any, **fixtures: Any) -> None:
            failures = []
            for row in values:
                given = dict(zip(names, row, strict=True))
                try:
                    test(*arguments, **fixtures, **given)
                except (Exception, pytest.fail.Exception) as error:  # noqa: BLE001  (reported below, with all others)
                    error.add_note(
                        "with "
                        + ", ".join(f"{name}={value!r}" for name, value in given.items())[:400]
                    )
                    failures.append(error)
            if failures:
                raise BaseExceptionGroup(f"{len(failures)} of {len(values)} rows fail", failures)

        signature = inspect.signature(test)
        left = [parameter for name, parameter in signature.parameters.items() if name not in names]
        every.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
        return every

    return over
