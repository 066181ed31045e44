"""The writing of corpus files: a new file never replaces another file, and a rewritten file keeps its name."""

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
from pytest_pafot.support.ways_out import flag

T = TypeVar("T")


class CorpusWriteError(RuntimeError):
    """An error for a finding that could not be written. No unfinished file is left behind."""

    def __init__(self, path: Path, reason: str, fix: str) -> None:
        super().__init__(f"{path}: expected to write a finding, received: {reason}; {fix}")
        self.path = path


def write(path: Path, finding: Finding) -> bool:
    """Write the new file of a finding, as a whole or not at all.

    Return False if the file exists already, for example because another process has written it.

    Raises:
        CorpusWriteError: if the file cannot be written.
    """
    return _written(path, finding, write_if_free)


def rewrite(path: Path, finding: Finding) -> Finding:
    """Replace the content of a finding's file, as a whole or not at all; the file's ``xfail`` stays.

    A missing file is written again. A file that cannot be read is not overwritten. Return the finding as written.

    Raises:
        CorpusWriteError: if the file cannot be written.
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
    """Write the file of a finding, as a whole or not at all, even over an existing file.

    Raises:
        CorpusWriteError: if the file cannot be written.
    """
    _written(path, finding, write_whole)


def free_path(folder: Path, finding: Finding, passed: Collection[Path] = ()) -> tuple[Path, Finding]:
    """Return the path for a new finding, and the finding with the id of that path.

    If a file already holds this finding, shrunk or not, its path is returned, and :func:`write` leaves the file
    unchanged. If a file with the finding's id as its name holds a different scenario or failure, ``-2``, ``-3`` ...
    is appended to the id. This is necessary if the failure in a file was replaced by a different failure under the same
    file name, and the first failure is found again. ``passed`` are files whose replays do not show a failure. If such a
    file was shrunk from the new finding's scenario, it stays as a guard, and the finding is written into a new file.
    """
    number = 1
    while True:
        name = finding.id if number == 1 else f"{finding.id}-{number}"
        path = folder / f"{name}{SUFFIX}"
        if not os.path.lexists(path) or _holds(path, finding, shrunk=path not in passed):
            return path, replace(finding, id=name)
        number += 1


def _holds(path: Path, finding: Finding, *, shrunk: bool) -> bool:
    """Return whether a file holds a finding, or, with ``shrunk``, a scenario that was shrunk from the finding."""
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
        fix = way_out(error, f"or choose another folder with {flag('corpus')}")
        raise CorpusWriteError(path, error.strerror or str(error), fix) from error
