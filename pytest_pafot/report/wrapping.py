"""Lines broken between words to the width of the terminal."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable

from pytest_pafot.text import visible

MARKER = "E   "
"""Before each line of a failure's message, as pytest writes it."""

_GLUED = re.compile(r"(?<=\d) (?=(?:%|h|m|s|m/s|m/s\^[23])(?![\w/^]))|(?<=\bNPC) (?=\d)")
_GLUE = "\N{NO-BREAK SPACE}"


def fitted_lines(lines: Iterable[str], width: int) -> list[str]:
    """Lines of a width at most. Where ``run.explain()`` breaks its longest sentence, it is put together first."""
    whole: list[str] = []
    is_open = False
    for line in lines:
        margin = len(whole[-1]) - len(_unmarked(whole[-1])) + 2 if is_open else 0
        if is_open and len(line) - len(_unmarked(line)) == margin:
            whole[-1] += f" {_unmarked(line)}"
        else:
            whole.append(line)
            is_open = _unmarked(line).startswith("responsible: ")
    return [part for line in whole for part in wrapped_to(line, width, MARKER if line.startswith(MARKER) else "")]


def _unmarked(line: str) -> str:
    return line.removeprefix(MARKER).lstrip(" ")


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
