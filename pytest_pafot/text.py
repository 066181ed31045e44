"""Words that every room may need: plain ASCII for any terminal, nouns that agree with their number, and tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from datetime import date


def ascii_text(text: str) -> str:
    """Text that any terminal and log can show."""
    return text.encode("ascii", "backslashreplace").decode("ascii")


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
    """Rows as a table in Markdown, with a header."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)
