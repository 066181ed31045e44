"""Texts with which a malicious file could control a terminal, a CI runner or a browser; folders without permission."""

import errno
import os
import re
import unicodedata

from hypothesis import strategies as st

PIECES = (
    "::error file=a.py::spoofed", "::add-mask::e", "##[error]spoofed", "##vso[task.setvariable]", "##teamcity[x]",
    "#", "##", "[", "]", ":", "::", "\n", "\r", "\r\n", "\x0b", "\x0c", "\x1c", "\x85", "\u2028", "\u2029", "\t", " ",
    "\xa0", "\u3000",
    "\x00", "\x08", "\x7f", "\x9b2J", "\x1b[2J", "\x1b]0;title\x07", "\x1b[31m", "\u202e", "\u2066", "\u200b",
    "@somebody", "#12", "gh-12", "$x$", "|", "`", "``", "\\", "*a*", "<img src=x onerror=y>", "</script>", "<!--",
    "&lt;", ":tada:", "https://a.b", "www.a.b", "- ", "1. ", "PASSED", "E   ", "word " * 30, "x" * 200, "\u00e9",
)  # fmt: skip

CHARACTERS = st.characters(exclude_categories=["Cs"])
"""All characters that a file can hold, as in ``st.text()``, which takes seconds because it checks each codec."""

TEXTS = st.lists(
    st.sampled_from(PIECES) | st.text(CHARACTERS, max_size=5), min_size=1, max_size=8
).map("".join)

WORST = "x\n::error file=a.py::S ::b ##[error]C \r\x1b]0;T\x07\x1b[2J\x9b1m\u202e\u2028::c <img src=x> @me $x$ |"
"""A text with every kind of attack."""


def obeyed(text: str) -> list[str]:
    """Return the parts of a text that would take effect: lines that control a CI runner, and unprintable characters."""
    lines = re.split("[\n\r\x0b\x0c\x1c-\x1e\x85\u2028\u2029]", text)
    commands = [
        line for line in lines if line.strip().startswith("::") or re.search(r"##\w*\[", line)
    ]
    other = {
        each
        for each in text
        if unicodedata.category(each)[0] == "C" or unicodedata.category(each) in ("Zl", "Zp")
    }
    return [*commands, *sorted(map(ascii, other - {"\n"}))]


def unlisted(monkeypatch, folder):
    """Let a folder be one that this user may not list; root may list any."""
    for name in ("listdir", "scandir"):
        function = getattr(os, name)

        def refuse(path=".", function=function):
            if os.fspath(path) == os.fspath(folder):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))
            return function(path)

        monkeypatch.setattr(os, name, refuse)
