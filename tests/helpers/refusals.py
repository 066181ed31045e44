"""Errors by what they are about; only the tests in tests/words read what they say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from pytest_pafot.support.errors import FieldError
from pytest_pafot.world import WorldError


def refused(field: str, error: type[FieldError] = WorldError) -> Any:
    """Expect an error about a field, and only about this one."""
    return pytest.raises(error, check=lambda raised: raised.field == field)


def error_of(call: Callable[..., object], *given: Any, **named: Any) -> Exception:
    """Return the exception that a call raises."""
    with pytest.raises(Exception) as caught:  # noqa: PT011  (which one it is, is part of a snapshot)
        call(*given, **named)
    return caught.value
