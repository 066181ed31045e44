"""Errors that the user can mend: what was expected of which value, what was received, and the way out."""

from __future__ import annotations

import math
import operator
from numbers import Integral, Real
from pathlib import Path

from pytest_pafot.support.text import visible

RESTORE = "restore the file from version control, or delete it"


class FieldError(ValueError):
    """A value that breaks a rule, told in one line: values, keys and paths in it may come from a stranger's file.

    Attributes:
        field: path of the value, such as ``npcs[0][2].speed``; empty where it has none.
        expected, received: what should be there, and what is; empty where the text says it in its own way.
        fix: the way out; empty where it is plain.
    """

    def __init__(
        self, text: str = "", *, field: str = "", expected: str = "", received: str = "", fix: str = ""
    ) -> None:
        super().__init__(visible(text or sentence(field, expected, received, fix)))
        self.field, self.expected, self.received, self.fix = field, expected, received, fix


def sentence(field: str, expected: str, received: str, fix: str) -> str:
    """``field: expected this, received that; do so``, without the parts that are empty."""
    place, way_out = f"{field}: " if field else "", f"; {fix}" if fix else ""
    return f"{place}expected {expected}, received {received}{way_out}"


POSITIVE = math.ulp(0.0)
"""As the least that a number may be, it refuses zero."""


def checked_number(
    value: object,
    field: str,
    expected: str,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    error: type[FieldError] = FieldError,
) -> float:
    """A finite number within bounds, as a float; numbers of other libraries, such as numpy's, are numbers too.

    Raises:
        FieldError: or the given kind of it, unless the value is such a number.
    """
    number = plain_number(value)
    if number is None or not least <= number <= most:
        raise error(field=field, expected=expected, received=f"{value!r:.100}")
    return float(number)


def checked_whole(
    value: object,
    field: str,
    expected: str,
    *,
    least: int,
    most: float = math.inf,
    error: type[FieldError] = FieldError,
) -> int:
    """A whole number within bounds, as an int.

    Raises:
        FieldError: or the given kind of it, unless the value is such a number.
    """
    number = plain_whole(value)
    if number is None or not least <= number <= most:
        raise error(field=field, expected=expected, received=f"{value!r:.100}")
    return number


def plain_number(value: object) -> float | None:
    """Python's own int or float of a finite number; None for everything else, and for truth values."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return None
    try:
        number = int(value) if isinstance(value, Integral) else float(value)
        return number if math.isfinite(number) else None
    except OverflowError:  # An int that no float can hold.
        return None


def plain_whole(value: object) -> int | None:
    """Python's own int of a whole number; None for everything else, and for truth values."""
    if isinstance(value, bool) or not hasattr(type(value), "__index__"):
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:  # numpy's arrays and truth values
        return None


class WorldError(FieldError):
    """A world, or a scenario for it, that cannot be run."""


class AdsFactoryError(TypeError):
    """What was given as the ADS factory does not make an ADS for this world."""


class BadAction(Exception):  # noqa: N818  (named in findings as the fault it is)
    """What an ADS returned is no action; the message says what was expected."""


class CorpusError(FieldError):
    """A file of the corpus that cannot be used, with the line, from 1, and the field of the fault where it has them."""

    def __init__(
        self, path: Path, expected: str, received: str, fix: str = RESTORE, *, field: str = "", line: int | None = None
    ) -> None:
        place = f"{path}" if line is None else f"{path}:{line}"
        text = f"{place}: {sentence(field, expected, received, fix)}"
        super().__init__(text, field=field, expected=expected, received=received, fix=fix)
        self.path, self.line = path, line
