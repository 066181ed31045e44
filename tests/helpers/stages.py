"""Choose which parameters of a test run in every session, and which only with ``-m oracle``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def oracle(*values: Any, **options: Any) -> Any:
    """Mark the parameters of one item for the stage ``oracle``."""
    return pytest.param(*values, marks=pytest.mark.oracle, **options)


def mostly_oracle(values: Iterable[Any], *always: Any) -> list[Any]:
    """Return all values: those in ``always`` run in every session, the others only with ``-m oracle``.

    A tuple is several parameters of one item.
    """
    values = list(values)
    unknown = [value for value in always if value not in values]
    assert not unknown, f"expected some of {values}, received {unknown}"
    return [
        value if value in always else oracle(*(value if isinstance(value, tuple) else (value,)))
        for value in values
    ]
