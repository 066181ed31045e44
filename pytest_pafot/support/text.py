"""Words that every room may need: texts that no terminal obeys, nouns that agree with their number, and tables."""

from __future__ import annotations

import csv
import io
import re
import textwrap
from collections.abc import Iterable, Sequence
from datetime import date
from typing import Any

_COMMAND = re.compile(r"(?<!\S)::|##(?=\w*\[)")
"""What CI runners obey: ``::`` where a line may begin, also after it was wrapped, and ``##[``, ``##vso[`` anywhere."""


def visible(text: str) -> str:
    r"""Return a text on one line that is safe to show, whoever wrote it: what acts on its reader is shown as an escape.

    That is every character that does not print, such as ``\n``, ``\x1b`` and ``\u202e``, which reorders what follows,
    and the beginnings of commands to CI runners. Applied again, it changes nothing more.
    """
    if not text.isprintable():
        text = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)
    return _COMMAND.sub(lambda found: rf"\x{ord(found[0][0]):x}{found[0][1]}", text)


def visible_lines(text: str) -> str:
    """Return a text of several lines that is safe to show, with its line breaks and tabs; see :func:`visible`."""
    return "\n".join("\t".join(map(visible, line.split("\t"))) for line in text.split("\n"))


def ascii_text(text: str) -> str:
    """Return a text on one line that any terminal and log can show; see :func:`visible`."""
    return visible(text).encode("ascii", "backslashreplace").decode("ascii")


def shown(value: Any) -> str:
    """A value in an error message, cut to a line; its class where its ``repr`` raises."""
    try:
        return one_line(repr(value))
    except Exception as error:  # noqa: BLE001  (any code of the user's)
        return f"a {type(value).__name__} whose repr raises {type(error).__name__}"


def one_line(text: str) -> str:
    """A text on one line, cut to what one can hold."""
    line = " ".join(text.split())
    return line if len(line) <= 120 else f"{line[:117]}..."


def quiet_json(text: str) -> str:
    """Return the same JSON without ``##``, by which commands to CI runners begin; only strings can have it."""
    return text.replace("##", r"#\u0023")


def day_of(text: str) -> date | None:
    """The day of the calendar that a text like ``2027-01-31`` names; None for any other text."""
    try:
        day = date.fromisoformat(text)
    except ValueError:
        return None
    return day if day.isoformat() == text else None  # no week dates, and nothing without its hyphens


def plural(count: int, noun: str) -> str:
    """A number with its noun: ``1 run``, ``2 runs``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def csv_text(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Rows as CSV with a header; None as nothing, and numbers as Python writes them, which is exact."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return buffer.getvalue()


def markdown_table(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Rows as a table in Markdown, with a header. Cells are Markdown; none can end its cell."""
    lines = [columns, ["---"] * len(columns), *rows]
    texts = ([visible(str(cell)).replace("|", r"\|") for cell in cells] for cells in lines)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in texts)


# Lines broken between words to the width of the terminal.

MARKER = "E   "
"""Before each line of a failure's message, as pytest writes it."""

_GLUED = re.compile(r"(?<=\d) (?=(?:%|h|m|s|m/s|m/s\^[23])(?![\w/^]))|(?<=\bNPC) (?=\d)")
_GLUE = "\N{NO-BREAK SPACE}"


def fitted_lines(lines: Iterable[str], width: int) -> list[str]:
    """Lines of a width at most."""
    return [part for line in lines for part in wrapped_to(line, width, MARKER if line.startswith(MARKER) else "")]


def wrapped_to(line: str, width: int, prefix: str = "") -> list[str]:
    """A line in lines of a width, broken between words, but not between a number and its unit or an NPC and its number.

    Each has the prefix and the indentation of the first, and is safe to show.
    """
    line = visible(line.expandtabs())  # before it is wrapped, which would make spaces of other line breaks
    text = line.removeprefix(prefix)
    indent = prefix + text[: len(text) - len(text.lstrip())]
    wrapper = textwrap.TextWrapper(width, indent, f"{indent}  ", break_long_words=False, break_on_hyphens=False)
    if len(line) <= width:
        return [line]
    return [part.replace(_GLUE, " ") for part in wrapper.wrap(_GLUED.sub(_GLUE, text.strip()))]
