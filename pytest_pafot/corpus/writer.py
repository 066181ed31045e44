"""Write corpus files: a new file never replaces a different one, and a rewritten file keeps its name."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from pytest_pafot.corpus.file_format import text_of
from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.yaml_document import MAX_BYTES
from pytest_pafot.findings.finding import Finding
from pytest_pafot.support.errors import CorpusError
from pytest_pafot.support.files import way_out, write_if_free, write_whole

T = TypeVar("T")


class CorpusWriteError(RuntimeError):
    """A finding that could not be written to a path; no unfinished file is left."""

    def __init__(self, path: Path, reason: str, fix: str) -> None:
        super().__init__(f"{path}: expected to write a finding, received: {reason}; {fix}")
        self.path = path


def write(path: Path, finding: Finding) -> bool:
    """Write a new file, all at once; return False if the file exists already, e.g. written by a different process.

    Raises:
        CorpusWriteError: if it cannot be written.
    """
    return _written(path, finding, write_if_free)


def rewrite(path: Path, finding: Finding) -> Finding:
    """Replace a file's content, all at once; return the finding as written, with the ``xfail`` that the file had.

    A missing file is written again; a file that cannot be read is not overwritten.

    Raises:
        CorpusWriteError: if it cannot be written.
    """
    kept = finding
    if finding.xfail is None and os.path.lexists(path):
        try:
            there = load(path)
            kept = replace(finding, xfail=there.xfail, xfail_until=there.xfail_until)
        except CorpusError as error:
            raise CorpusWriteError(path, f"a file that cannot be read ({error})", "correct or delete it") from error
    _written(path, kept, write_whole)
    return kept


def overwrite(path: Path, finding: Finding) -> None:
    """Write a file, all at once, even over an existing one.

    Raises:
        CorpusWriteError: if it cannot be written.
    """
    _written(path, finding, write_whole)


def free_path(folder: Path, finding: Finding, passed: Collection[Path] = ()) -> tuple[Path, Finding]:
    """Return the path for a new finding, and the finding with the id of that path.

    The id gets ``-2``, ``-3`` ... appended if a file of that name holds a different scenario or failure. That happens
    if a file was rewritten, as it keeps its name, and its first failure is found again. If a file holds this very
    finding, shrunk or not, its path is returned, and :func:`write` leaves it unchanged. The exception is a file that
    was shrunk from this scenario and is in ``passed``: it no longer shows the failure, but stays as a guard.
    """
    number = 1
    while True:
        name = finding.id if number == 1 else f"{finding.id}-{number}"
        path = folder / f"{name}{SUFFIX}"
        if not os.path.lexists(path) or _holds(path, finding, shrunk=path not in passed):
            return path, replace(finding, id=name)
        number += 1


def _holds(path: Path, finding: Finding, *, shrunk: bool) -> bool:
    """Return whether a file holds a finding, or with ``shrunk`` also one that was shrunk from it."""
    try:
        saved = load(path)
    except CorpusError:
        return False
    is_same = finding.scenario == saved.scenario or (shrunk and finding.scenario == saved.original)
    return is_same and saved.signature == finding.signature


def _written(path: Path, finding: Finding, write: Callable[[Path, bytes], T]) -> T:
    content = text_of(finding).encode()
    if len(content) > MAX_BYTES:
        reason = f"{len(content) // 1024} KiB, more than the {MAX_BYTES // 1024} KiB that are read back"
        raise CorpusWriteError(path, reason, "use fewer or shorter chains")
    try:
        return write(path, content)
    except OSError as error:
        fix = way_out(error, "or choose a different folder with --pafot-corpus")
        raise CorpusWriteError(path, error.strerror or str(error), fix) from error
