"""Texts from users, files and exceptions in Markdown and HTML: nothing in them becomes markup, a mention or a link."""

from __future__ import annotations

import base64
import hashlib
import re
from types import MappingProxyType

from pytest_pafot.support.text import quiet_json, visible

MAX_TEXT = 300
"""The largest number of characters of a user's text. A longer text is cut."""

_MARKUP = re.compile(r"([\\`*_\[\]|~#!]|^[-+=](?=[-+=]*(?: |$)))")
_ORDERED = re.compile(r"^(\d+)(?=[.)](?: |$))")
_LINK = re.compile(r"(?i)(:)(?=//)|(?<=www)(\.)")
_ENTITIES = MappingProxyType({"&": "&amp;", "<": "&lt;", ">": "&gt;", "$": "<span>$</span>"})
_REFERENCE = re.compile(r"(?i)@|#(?=\w)|\bgh-(?=\d)|:(?=[\w+-]+:)")
"""Text that GitHub turns into a mention, an issue or an emoji, even escaped, unless a zero-width space follows it."""


def plain(text: str) -> str:
    """Escape a text on one line so that nothing in it is markup, a link or HTML."""
    line = _LINK.sub(r"\\\1\2", _ORDERED.sub(r"\1\\", _MARKUP.sub(r"\\\1", _one_line(text))))
    line = "".join(_ENTITIES.get(character, character) for character in line)
    return _REFERENCE.sub(r"\g<0>&#8203;", line)


def code(text: str) -> str:
    """Return a text as Markdown code, between fences of more backticks than the text has in a row."""
    line = _one_line(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    pad = " " if line.startswith(("`", " ")) or line.endswith(("`", " ")) else ""
    return f"{fence}{pad}{line or ' '}{pad}{fence}"


def _one_line(text: str) -> str:
    line = " ".join(visible(text).split())
    return line if len(line) <= MAX_TEXT else f"{line[:MAX_TEXT]}..."


def json_in_script(plain: str) -> str:
    """Return equal JSON that is safe inside a ``<script>`` element: nothing in it ends the element."""
    return quiet_json(plain).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def content_hash(content: str) -> str:
    """Return the hash with which a page's policy allows a style or a script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
