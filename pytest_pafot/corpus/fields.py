"""Values of a corpus file with their places: every access checks, and a fault names line, field and way out."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from pytest_pafot.corpus.schema import VERSION, Keys
from pytest_pafot.corpus.yaml_document import Lines, Place
from pytest_pafot.errors import RESTORE, CorpusError
from pytest_pafot.findings.finding import MAX_NUMBER
from pytest_pafot.text import day_of


@dataclass(frozen=True, slots=True)
class Field:
    """A value of a document with its place; every accessor checks the type or raises the error of that place."""

    path: Path
    lines: Lines
    place: Place
    value: Any

    @property
    def name(self) -> str:
        """As in an error: ``scenario.npcs[0][3].cell``."""
        return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in self.place).lstrip(".")

    def error(self, expected: str, fix: str = RESTORE, received: str | None = None) -> CorpusError:
        """What is wrong with the value, at the nearest line that is known."""
        places = (self.place[:end] for end in range(len(self.place), -1, -1))
        line = next(self.lines[place] for place in places if place in self.lines)
        return CorpusError(self.path, expected, received or f"{self.value!r:.80}", fix, field=self.name, line=line)

    def at(self, part: str | int) -> Field:
        """The value under a key, or at an index, of this one."""
        return Field(self.path, self.lines, (*self.place, part), self.value[part])

    def mapping(self, keys: Keys) -> dict[str, Field]:
        """The values of a mapping that has all required keys and no unknown ones."""
        fields = self.any_mapping()
        known = [*keys.required, *keys.optional]
        for key in fields:
            if key not in known:
                raise fields[key].error(f"{_one_of(known)} (format {VERSION})", _guess(key, known), repr(key))
        for key in keys.required:
            if key not in fields:
                received = f"only {', '.join(fields)}" if fields else "nothing"
                raise self.error(f"the key '{key}'", "add it, or restore the file from version control", received)
        return fields

    def any_mapping(self) -> dict[str, Field]:
        """The values of a mapping with any keys."""
        if not isinstance(self.value, dict):
            raise self.error("a mapping (key: value)")
        return {key: self.at(key) for key in self.value}

    def items(self) -> list[Field]:
        """The values of a list."""
        if not isinstance(self.value, list):
            raise self.error("a list")
        return [self.at(index) for index in range(len(self.value))]

    def text(self) -> str:
        """Any text."""
        if not isinstance(self.value, str):
            raise self.error("text", "put it in quotes")
        return self.value

    def some_text(self, fix: str) -> str:
        """A text that is not blank."""
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.error("some text", fix)
        return self.value

    def choice(self, options: Collection[str]) -> Any:
        """One of these texts."""
        if not isinstance(self.value, str) or self.value not in options:
            raise self.error(_one_of(options), _guess(str(self.value), options))
        return self.value

    def whole(self, low: int = 0, high: int | None = None) -> int:
        """A whole number."""
        is_whole = isinstance(self.value, int) and not isinstance(self.value, bool)
        if not is_whole or self.value < low or (high is not None and self.value > high):
            top = "" if high is None else f" to {high}"
            raise self.error(f"a whole number from {low}{top}", "correct it")
        return int(self.value)

    def day(self) -> date:
        """A day of the calendar, as 2027-01-31."""
        day = day_of(self.value) if isinstance(self.value, str) else None
        if day is None:
            raise self.error("a day of the calendar, as year-month-day", "write it as 2027-01-31")
        return day

    def truth(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            raise self.error("true or false", "correct it")
        return self.value

    def number(self, low: float = 0.0) -> float:
        """A finite number, at least so large."""
        is_number = isinstance(self.value, (int, float)) and not isinstance(self.value, bool)
        if not is_number or not low <= self.value <= MAX_NUMBER:
            raise self.error(f"a finite number, at least {low:g}", "correct it")
        return float(self.value)


def _one_of(options: Collection[str]) -> str:
    """What is expected where there is a choice."""
    return f"one of {', '.join(options)}"


def _guess(word: str, options: Collection[str]) -> str:
    """The way out of a word that is unknown."""
    close = difflib.get_close_matches(word, list(options), n=1)
    return f"did you mean {close[0]!r}?" if close else "correct or remove it"
