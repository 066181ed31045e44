"""Errors that the user can mend: what was expected of which value, what was received, and the way out."""

from __future__ import annotations

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
