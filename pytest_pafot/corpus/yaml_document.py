"""YAML as untrusted input: plain data with line numbers, and nothing else that YAML can do.

No aliases, anchors, tags, merge keys, repeated keys, dates or second documents; limited in size and depth.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml

from pytest_pafot.findings.finding import MAX_DEPTH

MAX_BYTES = 256 * 1024
DEPTH = MAX_DEPTH + 4

Place = tuple[str | int, ...]
"""Keys and indices from the top of the document."""

_PREFIX = "tag:yaml.org,2002:"
_PLAIN_TAGS = frozenset(_PREFIX + name for name in ("null", "bool", "int", "float", "str"))
_NUMBER_LIKE = re.compile(r"[-+]?(?:\.?[0-9][0-9_]*(?:[.:][0-9_]*)?(?:[eE][-+]?[0-9]+)?|0[xob][0-9a-fA-F_]+)")
_NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+(?:e[-+][0-9]+)?)?|-?\.inf|\.nan")
_WORD = re.compile(r"true|false|null|")
_FORBIDDEN = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class DocumentError(ValueError):
    """A document that is not plain data.

    Attributes:
        line: counted from 1, or None.
        expected, received, fix: parts of the message.
    """

    def __init__(self, line: int | None, expected: str, received: str, fix: str) -> None:
        super().__init__(f"expected {expected}, received {received}; {fix}")
        self.line, self.expected, self.received, self.fix = line, expected, received, fix


@dataclass(frozen=True, slots=True)
class Document:
    """A parsed document.

    Attributes:
        value: None, bool, int, float, str, and lists and dicts of these.
        lines: the line of every place in it, counted from 1.
    """

    value: Any
    lines: dict[Place, int] = field(default_factory=dict)


def decoded(content: bytes) -> str:
    """Text of a file: UTF-8, with or without a byte order mark.

    Raises:
        DocumentError: if it is too long, empty, or not UTF-8.
    """
    if len(content) > MAX_BYTES:
        raise DocumentError(None, f"at most {MAX_BYTES // 1024} KiB", "a larger file", "delete or shorten it")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        received = f"the byte 0x{content[error.start]:02x}"
        raise DocumentError(line, "text in UTF-8", received, "save it as UTF-8") from None
    if not text.strip():
        raise DocumentError(None, "a saved scenario", "an empty file", "restore it from version control, or delete it")
    bad = _FORBIDDEN.search(text)
    if bad is not None:
        line = text.count("\n", 0, bad.start()) + 1
        raise DocumentError(line, "printable text", f"the character U+{ord(bad[0]):04X}", "remove it")
    return text


def parse(text: str, base: type[Any] | None = None) -> Document:
    """Read one YAML document.

    Args:
        text: of the document.
        base: PyYAML's safe loader to build on; the compiled one where it is there.

    Raises:
        DocumentError: on a fault in the syntax, or anything that is not plain data.
    """
    # The compiled loader takes these in places where the other one does not; a file is to be read alike everywhere.
    is_odd = "\t" in text or "?" in text
    kind: Any = base or (yaml.SafeLoader if is_odd else getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    loader = kind(text)
    try:
        return _Builder(loader).document()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise _syntax_error(None if mark is None else mark.line + 1, error.problem or "a fault") from None
    except yaml.YAMLError as error:
        raise _syntax_error(None, str(error).splitlines()[0]) from None
    finally:
        loader.dispose()


def _syntax_error(line: int | None, problem: str) -> DocumentError:
    return DocumentError(line, "valid YAML", f"text with this fault: {problem}", "correct it, or restore the file")


class _Builder:
    """Builds plain data from a loader's events, so that what is not wanted is refused before it is expanded."""

    def __init__(self, loader: Any) -> None:
        self.loader = loader
        self.lines: dict[Place, int] = {}

    def document(self) -> Document:
        self._next(yaml.StreamStartEvent)
        self._next(yaml.DocumentStartEvent)
        value = self._value((), self.loader.get_event())
        self._next(yaml.DocumentEndEvent)
        self._next(yaml.StreamEndEvent)
        return Document(value, self.lines)

    def _next(self, kind: type[yaml.Event]) -> None:
        event = self.loader.get_event()
        if not isinstance(event, kind):
            raise DocumentError(_line(event), "exactly one document", "another one or none", "keep one in each file")

    def _value(self, place: Place, event: Any) -> Any:
        self.lines[place] = _line(event)
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            name = f"the alias or anchor {event.anchor!r:.40}"
            raise DocumentError(_line(event), "plain values", name, "write the value out")
        if event.tag is not None:
            raise DocumentError(_line(event), "values without tags", f"the tag {event.tag!r:.60}", "remove the tag")
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event)
        if len(place) >= DEPTH:
            raise DocumentError(_line(event), f"at most {DEPTH} levels of nesting", "more", "flatten it")
        return self._mapping(place) if isinstance(event, yaml.MappingStartEvent) else self._list(place)

    def _scalar(self, event: Any) -> Any:
        tag = self.loader.resolve(yaml.ScalarNode, event.value, event.implicit)
        if tag not in _PLAIN_TAGS:
            kind = tag.removeprefix(_PREFIX)
            received = f"{event.value!r:.60}, which YAML takes for a {kind}"
            raise DocumentError(_line(event), "a number, text, true, false or null", received, "put it in quotes")
        if event.implicit[0]:
            _check_plain_scalar(tag, event)
        try:
            return self.loader.construct_object(yaml.ScalarNode(tag, event.value, event.start_mark, event.end_mark))
        except (ValueError, OverflowError):
            fix = "write a smaller one, or put text in quotes"
            raise DocumentError(_line(event), "a number", f"{event.value!r:.40}", fix) from None

    def _mapping(self, place: Place) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for event in self._until(yaml.MappingEndEvent):
            line = _line(event)
            key = self._value((*place, "?"), event)
            if not isinstance(key, str):
                raise DocumentError(line, "keys of text", f"the key {key!r:.60}", "put it in quotes")
            if key in mapping:
                raise DocumentError(line, "each key once", f"{key!r:.60} again", "remove one of them")
            mapping[key] = self._value((*place, key), self.loader.get_event())
            self.lines[(*place, key)] = line
        self.lines.pop((*place, "?"), None)
        return mapping

    def _list(self, place: Place) -> list[Any]:
        events = self._until(yaml.SequenceEndEvent)
        return [self._value((*place, index), event) for index, event in enumerate(events)]

    def _until(self, end: type[yaml.Event]) -> Iterator[Any]:
        while not isinstance(event := self.loader.get_event(), end):
            yield event


def _check_plain_scalar(tag: str, event: Any) -> None:
    """Refuse what the versions of YAML, or people, read as different values: 010, 1_0, 0x1F, 1:30, 1e3, yes, ~."""
    text, kind = event.value, tag.removeprefix(_PREFIX)
    if kind in ("int", "float") or (kind == "str" and _NUMBER_LIKE.fullmatch(text)):
        is_clear, expected = kind != "str" and _NUMBER.fullmatch(text) is not None, "a number in decimal digits"
    else:
        is_clear, expected = kind == "str" or _WORD.fullmatch(text) is not None, "true, false or null"
    if not is_clear:
        fix = "write it as 10, 0.5 or 1.0e-5, or put text in quotes" if "number" in expected else "put text in quotes"
        raise DocumentError(_line(event), expected, f"{text!r:.60}", fix)


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1
