"""Words that every room may need: texts that no terminal obeys, nouns that agree with their number, and tables."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from datetime import date

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
