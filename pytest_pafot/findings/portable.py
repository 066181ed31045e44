"""Texts of errors without what differs from process to process, so that the same seed writes the same files."""

from __future__ import annotations

import os
import re

_ADDRESS = re.compile(r"(?<=\bat )0x[0-9a-fA-F]+|\b0x[0-9a-fA-F]{9,}\b")
_PROCESS_ID = re.compile(r"(?i)(\b(?:pid|tid|process id|thread id|started(?: daemon)?)[ =:]+)\d+")
_FOLDERS = r"(?:[^\s\"'<>|*?:\\/]+[\\/])*"
_TO_PACKAGES = re.compile(
    # A path is tried from its first character alone, or a long one would take time by its length squared.
    rf"(?<![\w.])(?:[A-Za-z]:)?[\\/]{_FOLDERS}(?=(?:site|dist)-packages[\\/]|python3\.\d+[\\/](?!site|dist))"
)
_TEMPORARY = re.compile(
    r"(?<![\w.])(?:(?:/private)?/(?:var/)?tmp|(?:/private)?/var/folders/\w+/\w+/T"
    rf"|[A-Za-z]:\\Users\\\w+\\AppData\\Local\\Temp)[\\/]{_FOLDERS}(?P<name>[^\s\"'<>|*?:\\/]*)"
)
_RANDOM = re.compile(r"(?<=[\\/])(?:tmp[a-z0-9_]{8}(?!\w)|pytest-of-[^\\/]+[\\/]pytest-\d+)")


def portable(text: str, root: str = "") -> str:
    """A text without what differs from process to process, and from checkout to checkout.

    ``ADDRESS`` stands for memory addresses, ``N`` for ids of processes and threads, ``TMP`` for temporary folders.
    Paths begin at the project's folder, or where packages are installed.
    """
    if root:
        text = text.replace(root.rstrip("\\/") + os.sep, "")
    text = _TO_PACKAGES.sub("", text)
    text = _TEMPORARY.sub(r"TMP/\g<name>", _RANDOM.sub("tmp", text))
    return _PROCESS_ID.sub(r"\g<1>N", _ADDRESS.sub("ADDRESS", text))
