"""Functions that make strings safe to print, even in Markdown and HTML."""

from __future__ import annotations

import base64
import csv
import difflib
import hashlib
import io
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from datetime import date
from types import MappingProxyType
from typing import Any

# The start of a command to a CI runner. Patterns are compiled when they are used, because most sessions use none.
_COMMAND = r"(?<!\S)::|##(?=\w*\[)"


def visible(text: str) -> str:
    """Escape unprintable characters and commands to CI runners, on one line."""
    # For example \n, \x1b, and \u202e, which reverses the text after it. A second call changes nothing.
    if not text.isprintable():
        text = "".join(
            each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
        )
    return re.sub(_COMMAND, lambda found: rf"\x{ord(found[0][0]):x}{found[0][1]}", text)


def visible_lines(text: str) -> str:
    """Escape a string as :func:`visible` does, but keep line breaks and tabs."""
    return "\n".join("\t".join(map(visible, line.split("\t"))) for line in text.split("\n"))


def ascii_text(text: str) -> str:
    """Escape a string for any terminal or log, on one line."""
    return visible(text).encode("ascii", "backslashreplace").decode("ascii")


def safe_repr(value: Any) -> str:
    """Return a value's ``repr`` in one line for an error message, even if ``repr`` raises."""
    try:
        return one_line(repr(value))
    except Exception as error:  # noqa: BLE001  (the user's code may raise anything)
        return f"a {type(value).__name__} whose repr raises {type(error).__name__}"


def one_line(text: str) -> str:
    """Shorten a string to one line of at most 120 characters."""
    line = " ".join(text.split())
    return line if len(line) <= 120 else f"{line[:117]}..."


def quiet_json(text: str) -> str:
    """Return equivalent JSON without ``##``, which can start a command in CI runners."""
    return text.replace("##", r"#\u0023")


def day_of(text: str) -> date | None:
    """Return the date in a string such as ``2027-01-31``, or None."""
    try:
        day = date.fromisoformat(text)
    except ValueError:
        return None
    return day if day.isoformat() == text else None  # rejects week dates and dates without hyphens


def capitalised(text: str) -> str:
    """Return a string with the first letter in upper case."""
    return text[:1].upper() + text[1:]


def plural(count: int, noun: str) -> str:
    """Return a number with its noun: ``1 run``, ``2 runs``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def listed(texts: Sequence[str], last: str = "and") -> str:
    """Join strings as in ``a, b and c``."""
    return f" {last} ".join(filter(None, [", ".join(texts[:-1]), *texts[-1:]]))


def first_of(names: Sequence[object], most: int) -> str:
    """Join the first names, and count the others, as in ``a, b and 3 more``."""
    joined = ", ".join(map(str, names[:most]))
    if len(names) > most:
        joined += f" and {len(names) - most} more"
    return joined


def suggest(name: object, known: Iterable[str]) -> str:
    """Return ``. Did you mean 'gap'?`` for a similar name, or an empty string."""
    near = difflib.get_close_matches(str(name), list(known), n=1)
    return f". Did you mean {near[0]!r}?" if near else ""


def csv_text(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Format rows as CSV with a header. None becomes an empty cell, and numbers are exact."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return buffer.getvalue()


def markdown_table(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Format rows as a Markdown table with a header. Cells may contain Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    texts = ([visible(str(cell)).replace("|", r"\|") for cell in cells] for cells in lines)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in texts)


# Wrapping lines between words to the width of the terminal.

# pytest's prefix for the lines of a failure message.
MARKER = "E   "

_GLUED = r"(?<=\d) (?=(?:%|h|m|s|m/s|m/s\^[23])(?![\w/^]))|(?<=\bNPC) (?=\d)"
_GLUE = "\N{NO-BREAK SPACE}"


def fitted_lines(lines: Iterable[str], width: int) -> list[str]:
    """Wrap lines to a width [characters]."""
    return [
        part
        for line in lines
        for part in wrapped_to(line, width, MARKER if line.startswith(MARKER) else "")
    ]


def wrapped_to(line: str, width: int, prefix: str = "") -> list[str]:
    """Wrap a line between words, but not within ``3 m/s`` or ``NPC 1``."""
    line = visible(line.expandtabs())  # before wrapping, which would turn line breaks into spaces
    text = line.removeprefix(prefix)
    indent = prefix + text[: len(text) - len(text.lstrip())]
    wrapper = textwrap.TextWrapper(
        width, indent, f"{indent}  ", break_long_words=False, break_on_hyphens=False
    )
    if len(line) <= width:
        return [line]
    return [part.replace(_GLUE, " ") for part in wrapper.wrap(re.sub(_GLUED, _GLUE, text.strip()))]


# The maximum number of differences that are described.
MAX_TOLD = 3


def differences(place: str, file: Mapping[str, Any], session: Mapping[str, Any]) -> list[str]:
    """Describe the first differences between a file's data and the data in this session."""
    then, now = dict(_leaves(place, file)), dict(_leaves(place, session))
    differ = [
        key for key in {**then, **now} if key not in then or key not in now or then[key] != now[key]
    ]
    told = [
        f"{key} is {_shown(then, key)} in the file, {_shown(now, key)} now"
        for key in differ[:MAX_TOLD]
    ]
    return told + ([f"{len(differ) - MAX_TOLD} more"] if len(differ) > MAX_TOLD else [])


def _leaves(place: str, data: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(data, Mapping) or not data:
        yield place, data
        return
    for key, inner in data.items():
        yield from _leaves(f"{place}.{key}".lstrip("."), inner)


def _shown(leaves: Mapping[str, Any], key: str) -> str:
    return f"{leaves[key]!r:.60}" if key in leaves else "missing"


# The length at which a string of the user is cut [characters].
MAX_TEXT = 300

_MARKUP = re.compile(r"([\\`*_\[\]|~#!]|^[-+=](?=[-+=]*(?: |$)))")
_ORDERED = re.compile(r"^(\d+)(?=[.)](?: |$))")
_LINK = re.compile(r"(?i)(:)(?=//)|(?<=www)(\.)")
_ENTITIES = MappingProxyType({"&": "&amp;", "<": "&lt;", ">": "&gt;", "$": "<span>$</span>"})
# GitHub turns these into mentions, issues or emojis even if they are escaped, unless a zero-width space follows.
_REFERENCE = re.compile(r"(?i)@|#(?=\w)|\bgh-(?=\d)|:(?=[\w+-]+:)")


def plain(text: str) -> str:
    """Escape a string for Markdown, on one line."""
    line = _LINK.sub(r"\\\1\2", _ORDERED.sub(r"\1\\", _MARKUP.sub(r"\\\1", _one_line(text))))
    line = "".join(_ENTITIES.get(character, character) for character in line)
    return _REFERENCE.sub(r"\g<0>&#8203;", line)


def code(text: str) -> str:
    """Format a string as code in Markdown."""
    line = _one_line(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    pad = " " if line.startswith(("`", " ")) or line.endswith(("`", " ")) else ""
    return f"{fence}{pad}{line or ' '}{pad}{fence}"


def _one_line(text: str) -> str:
    line = " ".join(visible(text).split())
    return line if len(line) <= MAX_TEXT else f"{line[:MAX_TEXT]}..."


def json_in_script(plain: str) -> str:
    """Return equivalent JSON that is safe inside a ``<script>`` element."""
    return quiet_json(plain).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def content_hash(content: str) -> str:
    """Return the hash with which a Content Security Policy allows a style or a script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


class Pasteable:
    """A dataclass with a ``repr`` that can be pasted into a test."""

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
        printer.text(repr(self))
