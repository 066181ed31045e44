"""The error of a file that cannot be used, with its line, field and way out."""

from __future__ import annotations

from pathlib import Path

from pytest_pafot.errors import FieldError, sentence

RESTORE = "restore the file from version control, or delete it"


class CorpusError(FieldError):
    """A file of the corpus that cannot be used, with the line, from 1, and the field of the fault where it has them."""

    def __init__(
        self, path: Path, expected: str, received: str, fix: str = RESTORE, *, field: str = "", line: int | None = None
    ) -> None:
        place = f"{path}" if line is None else f"{path}:{line}"
        text = f"{place}: {sentence(field, expected, received, fix)}"
        super().__init__(text, field=field, expected=expected, received=received, fix=fix)
        self.path, self.line = path, line
