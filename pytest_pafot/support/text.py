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
from typing import Any

# The start of a command to a CI runner. Patterns are compiled when they are used, because most sessions use none.
_COMMAND = r"(?<!\S)::|##(?=\w*\[)"


def visible(text: str) -> str:
    """Escape unprintable characters and commands to CI runners, on one line."""
    # For example \n, \x1b, and \u202e, which reverses the text after it. A second call changes nothing.
    if not text.isprintable():
        text = "".join(map(_escaped, text))
    return re.sub(_COMMAND, lambda found: rf"\x{ord(found[0][0]):x}{found[0][1]}", text)


def _escaped(character: str) -> str:
    if character.isprintable():
        return character
    return character.encode("unicode_escape").decode()


def visible_lines(text: str) -> str:
    """Escape a string as :func:`visible` does, but keep line breaks and tabs."""
    # The separators are kept, too, as the odd parts.
    parts = re.split(r"([\n\t])", text)
    parts[::2] = map(visible, parts[::2])
    return "".join(parts)


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
    if len(line) <= 120:
        return line
    return f"{line[:117]}..."


def quiet_json(text: str) -> str:
    """Return equivalent JSON without ``##``, which can start a command in CI runners."""
    return text.replace("##", r"#\u0023")


def day_of(text: str) -> date | None:
    """Return the date in a string such as ``2027-01-31``, or None."""
    try:
        day = date.fromisoformat(text)
    except ValueError:
        return None
    if day.isoformat() != text:  # a week date, or a date without hyphens
        return None
    return day


def capitalised(text: str) -> str:
    """Return a string with the first letter in upper case."""
    return text[:1].upper() + text[1:]


def plural(count: int, noun: str) -> str:
    """Return a number with its noun: ``1 run``, ``2 runs``."""
    if count != 1:
        noun += "s"
    return f"{count} {noun}"


def listed(texts: Sequence[str], last: str = "and") -> str:
    """Join strings as in ``a, b and c``."""
    head = ", ".join(texts[:-1])
    return f" {last} ".join(filter(None, [head, *texts[-1:]]))


def first_of(names: Sequence[object], most: int) -> str:
    """Join the first names, and count the others, as in ``a, b and 3 more``."""
    joined = ", ".join(map(str, names[:most]))
    if len(names) > most:
        joined += f" and {len(names) - most} more"
    return joined


def suggest(name: object, known: Iterable[str]) -> str:
    """Return ``. Did you mean 'gap'?`` for a similar name, or an empty string."""
    near = difflib.get_close_matches(str(name), list(known), n=1)
    if not near:
        return ""
    return f". Did you mean {near[0]!r}?"


def csv_text(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Format rows as CSV with a header. None becomes an empty cell, and numbers are exact."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return buffer.getvalue()


def markdown_table(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Format rows as a Markdown table with a header. Cells may contain Markdown."""
    lines = []
    for cells in (columns, ["---"] * len(columns), *rows):
        texts = [visible(str(cell)).replace("|", r"\|") for cell in cells]
        lines.append(f"| {' | '.join(texts)} |")
    return "\n".join(lines)


# Wrapping lines between words to the width of the terminal.

# pytest's prefix for the lines of a failure message.
MARKER = "E   "

_GLUED = r"(?<=\d) (?=(?:%|h|m|s|m/s|m/s\^[23])(?![\w/^]))|(?<=\bNPC) (?=\d)"
_GLUE = "\N{NO-BREAK SPACE}"


def fitted_lines(lines: Iterable[str], width: int) -> list[str]:
    """Wrap lines to a width [characters]."""
    fitted: list[str] = []
    for line in lines:
        prefix = MARKER if line.startswith(MARKER) else ""
        fitted += wrapped_to(line, width, prefix)
    return fitted


def wrapped_to(line: str, width: int, prefix: str = "") -> list[str]:
    """Wrap a line between words, but not within ``3 m/s`` or ``NPC 1``."""
    line = visible(line.expandtabs())  # before wrapping, which would turn line breaks into spaces
    if len(line) <= width:
        return [line]
    text = line.removeprefix(prefix)
    indent = prefix + text[: len(text) - len(text.lstrip())]
    wrapper = textwrap.TextWrapper(
        width,
        indent,
        f"{indent}  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    glued = re.sub(_GLUED, _GLUE, text.strip())
    return [part.replace(_GLUE, " ") for part in wrapper.wrap(glued)]


# The maximum number of differences that are described.
MAX_TOLD = 3


def differences(place: str, file: Mapping[str, Any], session: Mapping[str, Any]) -> list[str]:
    """Describe the first differences between a file's data and the data in this session."""
    then = dict(_leaves(place, file))
    now = dict(_leaves(place, session))
    differ = [
        key for key in then | now if key not in then or key not in now or then[key] != now[key]
    ]
    told = [
        f"{key} is {_shown(then, key)} in the file, {_shown(now, key)} now"
        for key in differ[:MAX_TOLD]
    ]
    if len(differ) > MAX_TOLD:
        told.append(f"{len(differ) - MAX_TOLD} more")
    return told


def _leaves(place: str, data: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(data, Mapping) or not data:
        yield place, data
        return
    for key, inner in data.items():
        yield from _leaves(f"{place}.{key}".lstrip("."), inner)


def _shown(leaves: Mapping[str, Any], key: str) -> str:
    if key not in leaves:
        return "missing"
    return f"{leaves[key]!r:.60}"


# The length at which a string of the user is cut [characters].
MAX_TEXT = 300

_MARKUP = re.compile(r"([\\`*_\[\]|~#!]|^[-+=](?=[-+=]*(?: |$)))")
_ORDERED = re.compile(r"^(\d+)(?=[.)](?: |$))")
_LINK = re.compile(r"(?i)(:)(?=//)|(?<=www)(\.)")
_ENTITIES = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "$": "<span>$</span>"})
# GitHub turns these into mentions, issues or emojis even if they are escaped, unless a zero-width space follows.
_REFERENCE = re.compile(r"(?i)@|#(?=\w)|\bgh-(?=\d)|:(?=[\w+-]+:)")


def plain(text: str) -> str:
    """Escape a string for Markdown, on one line."""
    line = _MARKUP.sub(r"\\\1", _one_line(text))
    line = _ORDERED.sub(r"\1\\", line)
    line = _LINK.sub(r"\\\1\2", line)
    return _REFERENCE.sub(r"\g<0>&#8203;", line.translate(_ENTITIES))


def code(text: str) -> str:
    """Format a string as code in Markdown."""
    line = _one_line(text)
    fence = "`"
    while fence in line:
        fence += "`"
    if line.startswith("`") or line.endswith("`"):
        line = f" {line} "
    return f"{fence}{line or ' '}{fence}"


def _one_line(text: str) -> str:
    line = " ".join(visible(text).split())
    if len(line) <= MAX_TEXT:
        return line
    return f"{line[:MAX_TEXT]}..."


def json_in_script(plain: str) -> str:
    """Return equivalent JSON that is safe inside a ``<script>`` element."""
    line = quiet_json(plain)
    for character in "<>&":
        line = line.replace(character, f"\\u{ord(character):04x}")
    return line


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
