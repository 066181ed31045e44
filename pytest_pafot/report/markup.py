"""Pieces of HTML that the whole page is made of."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from pytest_pafot.text import visible_lines


def text(value: object) -> str:
    """Any text as HTML, in which nothing is markup, and what does not print is shown as an escape."""
    return escape(visible_lines(str(value)), quote=True)


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """Names and values as a list."""
    rows = "".join(f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="facts">{rows}</dl>' if rows else ""


def copyable(label: str, value: str) -> str:
    """A line of text with a button that copies it."""
    return (
        f'<p class="copyline"><span class="label">{text(label)}</span><code>{text(value)}</code>'
        f'<button type="button" class="copy" data-copy="code" aria-label="Copy: {text(label)}">Copy</button></p>'
    )


def details(summary: str, body: str) -> str:
    """HTML that is folded away under a summary."""
    return f"<details><summary>{summary}</summary>{body}</details>"


def table(head: str, rows: Iterable[str]) -> str:
    """A table of a head, see :func:`columns`, and rows, see :func:`row`."""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def columns(*names: str) -> str:
    """The head of a table."""
    return "".join(f'<th scope="col">{name}</th>' for name in names)


def row(name: str, *cells: object, attributes: str = "") -> str:
    """A row of a table, of HTML: its name and its cells."""
    return f'<tr{attributes}><th scope="row">{name}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'
