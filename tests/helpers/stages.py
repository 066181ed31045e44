"""Which parameters of a test are tried in every session, and which with ``-m oracle`` only."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def oracle(*values: Any, **options: Any) -> Any:
    """Parameters of one item that is left to the stage ``oracle``."""
    return pytest.param(*values, marks=pytest.mark.oracle, **options)


def mostly_oracle(values: Iterable[Any], *always: Any) -> list[Any]:
    """All values, of which those named second are tried in every session and the others with ``-m oracle``.

    A tuple is several parameters of one item.
    """
    values = list(values)
    unknown = [value for value in always if value not in values]
    assert not unknown, f"expected some of {values}, received {unknown}"
    return [
        value if value in always else oracle(*(value if isinstance(value, tuple) else (value,))) for value in values
    ]
