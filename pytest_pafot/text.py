"""Words for people that every room may need: plain ASCII for any terminal, and nouns that agree with their number."""

from __future__ import annotations

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
