"""Values whose ``repr`` is the expression that makes them."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any


class Pasteable:
    """A dataclass whose ``repr`` is the expression that makes it, without the arguments that have their defaults.

    A failing example of hypothesis can so be pasted into a test below ``from pytest_pafot import *``. Declare such a
    dataclass with ``repr=False``.
    """

    __slots__ = ()

    def __repr__(self) -> str:
        given = []
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if each.default is MISSING and not each.kw_only:
                given.append(repr(value))
            elif each.default is MISSING or value != each.default:
                given.append(f"{each.name}={value!r}")
        return f"{type(self).__name__}({', '.join(given)})"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """Print the ``repr``; hypothesis would print every field, or how its strategies made the value."""
        printer.text(repr(self))
