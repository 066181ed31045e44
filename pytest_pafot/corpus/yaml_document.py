"""YAML as untrusted input: plain data with line numbers, and no other feature of YAML; each access checks the type.

Aliases, anchors, tags, merge keys, repeated keys and second documents are refused, and dates are allowed in only one
place. Size and depth are limited. Errors quote only files that begin like a saved scenario: any other file with such a
name may be a secret.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import yaml

from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.findings.finding import MAX_DEPTH, MAX_NUMBER
from pytest_pafot.support.errors import RESTORE, CorpusError, plain_number, plain_whole
from pytest_pafot.support.files import LFS_POINTER
from pytest_pafot.support.text import day_of

VERSION = 2
"""The version of the format that is written. No other version can be read."""

MAX_BYTES = 256 * 1024
DEPTH = MAX_DEPTH + 4
MOST_VALUES = 40_000
"""The largest number of values in a document. Reading a value takes about 10 microseconds.

A file of this plugin with more values would be larger than the limit of size.
"""

Place = tuple[str | int, ...]
"""The place of a value: the keys and indices that lead from the top of the document to the value."""

XFAIL, REASON = "xfail", "reason"
"""The keys that decide where a date needs no quotes: in ``xfail``, under any key except ``reason``.

Any key is allowed, so that the error about a misspelt ``until`` names the key, and not the missing quotes.
"""

_PREFIX = "tag:yaml.org,2002:"
_PLAIN_TAGS = frozenset(_PREFIX + name for name in ("null", "bool", "int", "float", "str"))
_NUMBER_LIKE = re.compile(r"[-+]?(?:\.?[0-9][0-9_]*(?:[.:][0-9_]*)?(?:[eE][-+]?[0-9]+)?|0[xob][0-9a-fA-F_]+)")
_NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+(?:e[-+][0-9]+)?)?|-?\.inf|\.nan")
_WORD = re.compile(r"true|false|null|")
_IS_SAVED = re.compile(
    rb"(?:\xef\xbb\xbf)?(?:[ \t]*(?:#[^\n]*)?\r?\n)*pafot:[ \t]+[0-9]+[ \t]*(?:#[^\n]*)?\r?(?:\n|\Z)"
)
"""The pattern of a saved scenario's beginning, after comments. It distinguishes a faulty scenario from other files."""
NOT_SHOWN = "a file that does not begin like a saved scenario, so its content is not printed"
_FORBIDDEN = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

Lines = dict[Place, int]
"""The line of every value of a document, by the value's place. Lines are counted from 1."""


@dataclass(frozen=True, slots=True)
class Keys:
    """The required and the optional keys of a mapping in a corpus file."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()

    @property
    def all(self) -> tuple[str, ...]:
        """All keys, the required ones first."""
        return (*self.required, *self.optional)


@dataclass(frozen=True, slots=True)
class Field:
    """A value in a document, with its place. Each method checks the value, and raises an error that names the place."""

    path: Path
    lines: Lines
    place: Place
    value: Any

    @property
    def name(self) -> str:
        """The name of the value in an error, such as ``scenario.npcs[0][3].cell``."""
        return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in self.place).lstrip(".")

    def error(self, expected: str, fix: str = RESTORE, received: str | None = None) -> CorpusError:
        """Return an error about the value, with its line or the nearest line that is known."""
        places = (self.place[:end] for end in range(len(self.place), -1, -1))
        line = next(self.lines[place] for place in places if place in self.lines)
        return CorpusError(self.path, expected, received or f"{self.value!r:.80}", fix, field=self.name, line=line)

    def at(self, part: str | int) -> Field:
        """Return the value under a key, or at an index, of this mapping or list."""
        return Field(self.path, self.lines, (*self.place, part), self.value[part])

    def mapping(self, keys: Keys, hint: str = "") -> dict[str, Field]:
        """Return the values of this mapping; it must have all required keys and no unknown keys.

        The ``hint`` is added to the advice on an unknown key.
        """
        fields = self.any_mapping()
        known = keys.all
        for key in fields:
            if key not in known:
                fix = "; ".join(filter(None, (_guess(key, known), hint)))
                raise fields[key].error(f"{one_of(known)} (format {VERSION})", fix, repr(key))
        for key in keys.required:
            if key not in fields:
                received = f"only {', '.join(fields)}" if fields else "nothing"
                raise self.error(f"the key '{key}'", "add it, or restore the file from version control", received)
        return fields

    def any_mapping(self) -> dict[str, Field]:
        """Return the values of this mapping, which may have any keys."""
        if not isinstance(self.value, dict):
            raise self.error("a mapping (key: value)")
        return {key: self.at(key) for key in self.value}

    def items(self) -> list[Field]:
        """Return the values of this list."""
        if not isinstance(self.value, list):
            raise self.error("a list")
        return [self.at(index) for index in range(len(self.value))]

    def text(self) -> str:
        """Return the value; it must be a text."""
        if not isinstance(self.value, str):
            raise self.error("text", "put it in quotes")
        return self.value

    def some_text(self, fix: str) -> str:
        """Return the value; it must be a text that is not blank. ``fix`` is the advice in the error."""
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.error("some text", fix)
        return self.value

    def choice(self, options: Collection[str]) -> Any:
        """Return the value; it must be a text among the options."""
        if not isinstance(self.value, str) or self.value not in options:
            raise self.error(one_of(options), _guess(str(self.value), options))
        return self.value

    def whole(self, low: int = 0, high: int | None = None) -> int:
        """Return the value; it must be a whole number within limits."""
        number = plain_whole(self.value)
        if number is None or number < low or (high is not None and number > high):
            top = "" if high is None else f" to {high}"
            raise self.error(f"a whole number from {low}{top}", "correct it")
        return number

    def day(self) -> date:
        """Return the value as a day; it must be a text such as 2027-01-31."""
        day = day_of(self.value) if isinstance(self.value, str) else None
        if day is None:
            raise self.error("a day of the calendar, as year-month-day", "write it as 2027-01-31")
        return day

    def truth(self) -> bool:
        """Return the value; it must be true or false."""
        if not isinstance(self.value, bool):
            raise self.error("true or false", "correct it")
        return self.value

    def number(self, low: float = 0.0) -> float:
        """Return the value; it must be a finite number that is not below ``low``."""
        number = plain_number(self.value)
        if number is None or not low <= number <= MAX_NUMBER:
            raise self.error(f"a finite number, at least {low:g}", "correct it")
        return float(number)


def one_of(options: Collection[str]) -> str:
    """Return the words for a choice in an error, such as "one of a, b"."""
    return f"one of {', '.join(options)}"


def _guess(word: str, options: Collection[str]) -> str:
    """Return the advice for an unknown word: similar words, if there are any."""
    close = difflib.get_close_matches(word, list(options), n=1)
    return f"did you mean {close[0]!r}?" if close else "correct or remove it"


def parse(path: Path, content: bytes, base: type[Any] | None = None) -> Field:
    """Return the top mapping of the YAML document in a file: None, bool, int, float, str, lists and dicts of these.

    Args:
        path: the path of the file, for errors.
        content: the content in UTF-8, with or without a byte order mark.
        base: one of PyYAML's safe loaders; by default the compiled one, if it is installed.

    Raises:
        CorpusError: for an error in the text or the syntax, for anything that is not plain data, and for a document
            of another version.
    """
    __tracebackhide__ = True  # pytest's --showlocals would print the content
    if not path.name.endswith(SUFFIX) and not _IS_SAVED.match(content):
        fix = f"give a file that ends in {SUFFIX}; this one is for other tools, such as those that `export` writes for"
        raise CorpusError(path, "a saved scenario", "a file of another kind", fix)
    if len(content) > MAX_BYTES:
        raise CorpusError(path, f"at most {MAX_BYTES // 1024} KiB", "a larger file", "delete or shorten it")
    if not content.removeprefix(b"\xef\xbb\xbf").strip():
        raise CorpusError(path, "a saved scenario", "an empty file", "restore it from version control, or delete it")
    if content.startswith(LFS_POINTER):
        raise CorpusError(path, "a saved scenario", "a pointer of Git LFS", "fetch the file with git lfs pull")
    try:
        value, lines = _parsed(path, content, base)
    except CorpusError as error:
        if _IS_SAVED.match(content):
            raise
        raise CorpusError(path, error.expected, NOT_SHOWN, error.fix, line=error.line) from None
    top = Field(path, lines, (), value)
    if not isinstance(value, dict):
        raise top.error("a mapping (key: value)", received=NOT_SHOWN)
    if "pafot" not in value:  # checked first: nothing else can be checked in a file of a newer version
        raise top.error(f"the key 'pafot' with the version {VERSION}", received="a document without this key")
    version = top.at("pafot")
    is_whole = isinstance(version.value, int) and not isinstance(version.value, bool)
    if not is_whole or version.value != VERSION:
        fix = f"install the pytest-pafot that wrote it; this one reads version {VERSION}"
        # Without a version, this may be some other file with a secret under that key, so its value is not printed.
        raise version.error(f"the format version {VERSION}", fix, None if is_whole else "no whole number")
    return top


def _parsed(path: Path, content: bytes, base: type[Any] | None) -> tuple[Any, Lines]:
    __tracebackhide__ = True
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line, received = content.count(b"\n", 0, error.start) + 1, f"the byte 0x{content[error.start]:02x}"
        raise CorpusError(path, "text in UTF-8", received, "save it as UTF-8", line=line) from None
    bad = _FORBIDDEN.search(text)
    if bad is not None:
        line, received = text.count("\n", 0, bad.start()) + 1, f"the character U+{ord(bad[0]):04X}"
        raise CorpusError(path, "printable text", received, "remove it", line=line)
    # The compiled loader accepts tabs and "?" where the Python loader does not, but both must read a file alike.
    is_odd = "\t" in text or "?" in text
    kind: Any = base or (yaml.SafeLoader if is_odd else getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    loader = kind(text)
    try:
        return _Builder(path, loader).document()
    except yaml.YAMLError as error:
        where, problem = None, str(error).splitlines()[0]
        if isinstance(error, yaml.MarkedYAMLError):
            mark, problem = error.problem_mark or error.context_mark, error.problem or "unknown"
            where = None if mark is None else mark.line + 1
        received, fix = f"text with this error: {problem}", "correct it, or restore the file"
        raise CorpusError(path, "valid YAML", received, fix, line=where) from None
    finally:
        loader.dispose()


class _Builder:
    """A builder of plain data from the events of a YAML loader. Refused features such as aliases are never expanded."""

    def __init__(self, path: Path, loader: Any) -> None:
        self.path = path
        self.loader = loader
        self.lines: Lines = {}
        self.values = 0

    def document(self) -> tuple[Any, Lines]:
        self._next(yaml.StreamStartEvent)
        self._next(yaml.DocumentStartEvent)
        value = self._value((), self.loader.get_event())
        self._next(yaml.DocumentEndEvent)
        self._next(yaml.StreamEndEvent)
        return value, self.lines

    def _error(self, event: Any, expected: str, received: str, fix: str) -> CorpusError:
        return CorpusError(self.path, expected, received, fix, line=_line(event))

    def _next(self, kind: type[yaml.Event]) -> None:
        event = self.loader.get_event()
        if not isinstance(event, kind):
            raise self._error(event, "exactly one document", "none or several", "leave one document in each file")

    def _value(self, place: Place, event: Any) -> Any:
        self.lines[place] = _line(event)
        self.values += 1
        if self.values > MOST_VALUES:
            raise self._error(event, f"at most {MOST_VALUES} values", "more", "delete or shorten the file")
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            name = f"the alias or anchor {event.anchor!r:.40}"
            raise self._error(event, "plain values", name, "write the value out")
        if event.tag is not None:
            raise self._error(event, "values without tags", f"the tag {event.tag!r:.60}", "remove the tag")
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event, is_day=place[:-1] == (XFAIL,) and place[-1] != REASON)
        if len(place) >= DEPTH:
            raise self._error(event, f"at most {DEPTH} levels of nesting", "more", "flatten it")
        if isinstance(event, yaml.MappingStartEvent):
            return self._mapping(place)
        return [self._value((*place, index), each) for index, each in enumerate(self._until(yaml.SequenceEndEvent))]

    def _scalar(self, event: Any, *, is_day: bool) -> Any:
        tag = self.loader.resolve(yaml.ScalarNode, event.value, event.implicit)
        if is_day and tag == f"{_PREFIX}timestamp":
            return str(event.value)
        if tag not in _PLAIN_TAGS:
            received = f"{event.value!r:.60}, which YAML reads as a {tag.removeprefix(_PREFIX)}"
            raise self._error(event, "a number, text, true, false or null", received, "put it in quotes")
        if event.implicit[0]:
            # Versions of YAML, or people, read these as different values: 010, 1_0, 0x1F, 1:30, 1e3, yes, ~.
            text, kind = event.value, tag.removeprefix(_PREFIX)
            is_number = kind in ("int", "float")
            if (is_number and not _NUMBER.fullmatch(text)) or (kind == "str" and _NUMBER_LIKE.fullmatch(text)):
                fix = "write it as 10, 0.5 or 1.0e-5, or put text in quotes"
                raise self._error(event, "a number in decimal digits", f"{text!r:.60}", fix)
            if kind in ("bool", "null") and not _WORD.fullmatch(text):
                raise self._error(event, "true, false or null", f"{text!r:.60}", "put text in quotes")
        try:
            return self.loader.construct_object(yaml.ScalarNode(tag, event.value, event.start_mark, event.end_mark))
        except (ValueError, OverflowError):
            fix = "write a smaller one, or put text in quotes"
            raise self._error(event, "a number", f"{event.value!r:.40}", fix) from None

    def _mapping(self, place: Place) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for event in self._until(yaml.MappingEndEvent):
            key = self._value((*place, "?"), event)
            if not isinstance(key, str):
                raise self._error(event, "keys of text", f"the key {key!r:.60}", "put it in quotes")
            if key in mapping:
                raise self._error(event, "each key once", f"{key!r:.60} again", "remove one of them")
            mapping[key] = self._value((*place, key), self.loader.get_event())
            self.lines[(*place, key)] = _line(event)
        self.lines.pop((*place, "?"), None)
        return mapping

    def _until(self, end: type[yaml.Event]) -> Iterator[Any]:
        while not isinstance(event := self.loader.get_event(), end):
            yield event


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1
