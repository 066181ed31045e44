"""XML as untrusted data: elements with their lines, limits of size, and no document types, so no entities and links."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from pytest_pafot.extras.recordings.recording import RecordingError

MOST_BYTES, MOST_ELEMENTS, DEEPEST = 256 * 2**20, 5_000_000, 60
"""The largest file [bytes], the largest number of elements in it, and how deep they may lie in each other."""
LONGEST_TEXT = 1_000_000
"""The longest text of an element; joining its pieces would take ever longer."""
LARGEST = 1e9
"""The largest number that a value may have."""


@dataclass(eq=False, slots=True)
class Element:
    """An element with its line, the one around it, and its own text without spaces at its ends."""

    path: Path
    outer: Element | None = field(repr=False)
    line: int
    tag: str
    values: dict[str, str]
    children: list[Element] = field(default_factory=list)
    text: str = ""

    @property
    def place(self) -> str:
        """The names of the elements around it and its own, for messages."""
        name = self.values.get("name", "")
        own = f"{self.tag:.60}[{name:.60}]" if name else f"{self.tag:.60}"
        return own if self.outer is None or not self.outer.tag else f"{self.outer.place}/{own}"

    def error(self, expected: str, received: str, fix: str, value: str = "") -> RecordingError:
        """Return an error about this element or one of its values."""
        where = f"{self.place}@{value}" if value else self.place
        return RecordingError(self.path, expected, received, fix, field=where, line=self.line)

    def all(self, way: str) -> Iterator[Element]:
        """Yield the elements at the end of a way of names, such as ``Shape/Polyline/Vertex``."""
        first, _, rest = way.partition("/")
        for child in self.children:
            if child.tag == first:
                yield from child.all(rest) if rest else (child,)

    def find(self, way: str) -> Element | None:
        """Return the first element at the end of a way, or None."""
        return next(self.all(way), None)

    def get(self, way: str) -> Element:
        """Return the first element at the end of a way.

        Raises:
            RecordingError: if there is none.
        """
        found = self.find(way)
        if found is None:
            within = ", ".join(dict.fromkeys(child.tag for child in self.children)) or "nothing"
            raise self.error(f"{way} in it", f"{within:.100}", "the file may be cut off")
        return found

    def only(self) -> Element:
        """Return the one element in this one.

        Raises:
            RecordingError: if there are none or several.
        """
        if len(self.children) != 1:
            within = ", ".join(child.tag for child in self.children) or "nothing"
            raise self.error("one element in it", f"{within:.100}", "leave one")
        return self.children[0]

    def number(self, name: str, default: float | None = None) -> float:
        """Return a value as a finite number; ``default`` if the value is missing.

        Raises:
            RecordingError: if it is no number, or missing without a default.
        """
        if name not in self.values:
            if default is None:
                raise self.error("a number", "nothing", "add the value", name)
            return default
        return self._number(self.values[name], name)

    def content(self) -> float:
        """Return the text of this element as a finite number.

        Raises:
            RecordingError: if it is none.
        """
        return self._number(self.text, "")

    def _number(self, text: str, name: str) -> float:
        try:
            number = float(text) if "_" not in text else math.nan
        except ValueError:
            number = math.nan
        if not abs(number) <= LARGEST:
            raise self.error("a finite number", f"{text!r:.60}", "correct the value", name)
        return number


def read_xml(path: Path) -> Element:
    """Return the outermost element of a file.

    Raises:
        RecordingError: if it is not XML, too large, or has a document type.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise RecordingError(path, f"at most {MOST_BYTES} bytes", f"{size}", "cut it into several files")
    parser = expat.ParserCreate()
    parser.buffer_text = True
    around = [Element(path, None, 1, "", {})]
    count = 0

    def begin(tag: str, values: dict[str, str]) -> None:
        nonlocal count
        count += 1
        inner = Element(path, around[-1], parser.CurrentLineNumber, tag, values)
        if len(around) > DEEPEST or count > MOST_ELEMENTS:
            expected = f"at most {MOST_ELEMENTS} elements, {DEEPEST} deep"
            raise inner.error(expected, "more", "this is no file of this format")
        around[-1].children.append(inner)
        around.append(inner)

    def end(tag: str) -> None:
        inner = around.pop()
        inner.text = inner.text.rstrip()

    def add(text: str) -> None:
        inner = around[-1]
        inner.text = (inner.text + text).lstrip()  # the spaces between a million children would be joined, too
        if len(inner.text) > LONGEST_TEXT:
            raise inner.error(f"at most {LONGEST_TEXT} characters", "more", "this is no file of this format")

    def refuse(name: str, *rest: object) -> None:
        fix = "remove its declaration; no format that is read here has one"
        raise RecordingError(path, "no document type", f"<!DOCTYPE {name:.40}", fix, line=parser.CurrentLineNumber)

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = begin, end, add
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(path.read_bytes(), True)
    except expat.ExpatError as error:
        fix = "the file may be cut off"
        raise RecordingError(path, "XML", expat.ErrorString(error.code), fix, line=error.lineno) from None
    except RecordingError:
        raise
    except (LookupError, ValueError) as error:  # of Python, which expat asks for encodings that it does not know
        raise RecordingError(path, "XML in UTF-8", f"{error}", "convert its encoding", line=1) from None
    return around[0].children[0]
