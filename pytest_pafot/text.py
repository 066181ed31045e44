"""Words for people that every room may need: plain ASCII for any terminal, and nouns that agree with their number."""

from __future__ import annotations


def ascii_text(text: str) -> str:
    """Text that any terminal and log can show."""
    return text.encode("ascii", "backslashreplace").decode("ascii")


def plural(count: int, noun: str) -> str:
    """A number with its noun: ``1 run``, ``2 runs``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
