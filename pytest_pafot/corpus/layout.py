"""Folder names for tests: readable, distinct for distinct tests, and valid on every file system."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

CORPUS = "pafot_corpus"
MAX_NAME = 80
DIGEST = 10

_PLAIN = re.compile(r"[a-z0-9_](?:[a-z0-9_.,=+-]*[a-z0-9_,=+-])?")
_WITH_PARAMETERS = re.compile(r"([^@\[\]]+)\[([^@\[\]]+)\]")
_RESERVED = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d|conin|conout|clock)(?=[.@,=+~-]|$)", re.IGNORECASE)


def folder_of(test_file: Path, module: str, test_name: str) -> Path:
    """Where the findings of one test live.

    Args:
        test_file: the file that holds the test; the corpus lies beside it.
        module: name of the test's module.
        test_name: the test with its class and parameters, as in ``TestBraking::test_it[4-slow]``.
    """
    return Path(test_file).parent / CORPUS / safe_name(module) / safe_name(test_name)


def safe_name(text: str) -> str:
    """A folder name for any text.

    ``test_it`` stays as it is and ``test_it[4-slow]`` becomes ``test_it@4-slow``: pytest and shells give square
    brackets a meaning in paths. What has capitals (some file systems ignore case), other characters, a name that
    Windows reserves, or more than 80 characters, is made readable and ends with ``~`` and ten digits of a digest
    of the whole text, so that distinct texts never share a name.
    """
    bracketed = _WITH_PARAMETERS.fullmatch(text)
    parts = bracketed.groups() if bracketed else (text,)
    name = "@".join(parts)
    if all(map(_PLAIN.fullmatch, parts)) and len(name) <= MAX_NAME and not _RESERVED.match(name):
        return name
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:DIGEST]
    readable = re.sub(r"[^A-Za-z0-9_.,=+@-]+", "-", name.replace("::", "."))
    readable = readable[: MAX_NAME - DIGEST - 2].strip("-.")
    prefix = "_" if not readable or _RESERVED.match(readable) else ""
    return f"{prefix}{readable}~{digest}"
