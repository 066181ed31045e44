"""YAML as untrusted input: plain data with line numbers, and no other feature of YAML.

Aliases, anchors, tags, merge keys, repeated keys and second documents are refused, and dates are allowed in only one
place. Size and depth are limited. Errors quote only files that begin like a saved scenario: any other file with such a
name may be a secret.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from pytest_pafot.findings.finding import MAX_DEPTH
from pytest_pafot.support.errors import CorpusError

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


def parse(path: Path, content: bytes, base: type[Any] | None = None) -> tuple[Any, Lines]:
    """Return the YAML document in the content of a file: None, bool, int, float, str, and lists and dicts of these.

    Args:
        path: the path of the file, for errors.
        content: the content in UTF-8, with or without a byte order mark.
        base: one of PyYAML's safe loaders; by default the compiled one, if it is installed.

    Raises:
        CorpusError: for an error in the text or the syntax, and for anything that is not plain data.
    """
    __tracebackhide__ = True  # pytest's --showlocals would print the content
    if len(content) > MAX_BYTES:
        raise CorpusError(path, f"at most {MAX_BYTES // 1024} KiB", "a larger file", "delete or shorten it")
    if not content.removeprefix(b"\xef\xbb\xbf").strip():
        raise CorpusError(path, "a saved scenario", "an empty file", "restore it from version control, or delete it")
    try:
        return _parsed(path, content, base)
    except CorpusError as error:
        if _IS_SAVED.match(content):
            raise
        raise CorpusError(path, error.expected, NOT_SHOWN, error.fix, line=error.line) from None


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
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise _syntax_error(path, None if mark is None else mark.line + 1, error.problem or "unknown") from None
    except yaml.YAMLError as error:
        raise _syntax_error(path, None, str(error).splitlines()[0]) from None
    finally:
        loader.dispose()


def _syntax_error(path: Path, line: int | None, problem: str) -> CorpusError:
    received = f"text with this error: {problem}"
    return CorpusError(path, "valid YAML", received, "correct it, or restore the file", line=line)


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
