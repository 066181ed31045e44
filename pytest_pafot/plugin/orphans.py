"""Saved scenarios that no test runs: orphans, whose test is gone, and strays, which lie beside the folders of tests.

They are found without blaming a selection. Orphans are removed, and only when asked for.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import pytest

from pytest_pafot.corpus.layout import entries_of, files_in, is_folder, module_named, modules_in, relative, safe_name
from pytest_pafot.corpus.saved import read_saved_file

# A node id and nothing else: the name of a test is shown of broken files, too, and a file may be anything.
_TEST_LINE = re.compile(rb"^test:[ \t]*([^\n:]*\.py::[^\n]+?)\s*$", re.MULTILINE)


class Unrun(NamedTuple):
    """What a session found."""

    # folders of saved scenarios whose test is gone, each with the files that may be removed
    orphans: dict[Path, list[Path]]
    strays: dict[str, str]  # saved scenarios that lie in no folder of a test, each with where it should be, in words
    unmerged: dict[str, str]  # folders of other corpora whose files no test takes, each with why


UNRUN = pytest.StashKey[Unrun]()


@dataclass(slots=True, kw_only=True)
class Collected:
    """What a session collected, before any selection."""

    rootpath: Path  # of the session
    folders: set[Path] = field(default_factory=set)  # corpus folders of the items
    roots: dict[Path, Path] = field(default_factory=dict)  # corpora, with the folder of the test files that each serves
    # node ids of the classes that exist in collected modules and classes
    classes: set[str] = field(default_factory=set)
    opened: set[str] = field(default_factory=set)  # node ids of the classes whose members were collected
    files: set[Path] = field(default_factory=set)  # test files with at least one item


def find_orphans(collected: Collected) -> dict[Path, list[Path]]:
    """Folders that hold saved scenarios of no test, each with the files that may be removed.

    A folder is an orphan when its module is gone, or when the module or class where its test would be was collected
    and made no such item. Selections by ``-k``, ``-m`` or node ids do not matter: pytest collects all members of a
    module or class before it selects. A module that failed or was skipped at import blames nobody.
    """
    return {
        folder: _own_files(folder, directory, collected.rootpath)
        for root, directory in sorted(collected.roots.items())
        for module in modules_in(root)
        for folder in entries_of(module)
        # A folder of one test has no folders: those of one corpus for all lie side by side with modules.
        if files_in(folder) and not any(map(is_folder, entries_of(folder)))
        if _is_orphan(folder, directory, collected)
    }


def find_strays(collected: Collected, orphans: Iterable[Path]) -> dict[str, str]:
    """Files between the rootdir and the folders of tests, each with where it should be, in words.

    No folder is searched for them but those on the way.
    """
    top = collected.rootpath
    on_the_way = {
        folder
        for root, directory in collected.roots.items()
        for folder in (*_up(root, top), *_up(directory, top), *modules_in(root))
    }
    files = (file for folder in sorted(on_the_way.difference(collected.folders, orphans)) for file in files_in(folder))
    return {relative(file, top): _home(file, collected) for file in files}


def prune(files: Iterable[Path]) -> tuple[list[Path], list[str]]:
    """Remove files, and the folders around them that are empty then; returns those removed, and what failed."""
    removed: list[Path] = []
    failures: list[str] = []
    for file in files:
        try:
            file.unlink(missing_ok=True)  # Another session may have been faster.
            removed.append(file)
        except OSError as error:
            from pytest_pafot.support.files import way_out  # noqa: PLC0415  a session that prunes nothing does not load it

            fix = way_out(error, "then prune again")
            failures.append(f"--pafot-prune: {file}: not removed: {error.strerror or error}; {fix}")
    for folder in dict.fromkeys(file.parent for file in removed):
        with suppress(OSError):  # It holds something else, which stays.
            folder.rmdir()
            folder.parent.rmdir()
    return removed, failures


def _is_orphan(folder: Path, directory: Path, collected: Collected) -> bool:
    if folder in collected.folders:
        return False
    module = module_named(directory, folder.parent.name)
    if not os.path.lexists(module):  # which takes no error for a name that is too long
        return True
    if module not in collected.files:
        return False
    named = next(filter(None, map(_named_test, files_in(folder))), "")
    prefix = relative(module, collected.rootpath)
    for name in named.partition("[")[0].split("::")[1:-1]:  # the classes around the test
        prefix = f"{prefix}::{name}"
        if prefix not in collected.classes:
            return True
        if prefix not in collected.opened:
            return False  # Its members were not collected, since another node id was asked for.
    return True


def _named_test(file: Path) -> str:
    """The node id of the test that a saved scenario names, also where it is broken; empty where it names none."""
    from pytest_pafot.corpus.reader import content_of  # noqa: PLC0415  (yaml, which few sessions need)
    from pytest_pafot.support.errors import CorpusError  # noqa: PLC0415

    try:
        line = _TEST_LINE.search(content_of(file))
    except CorpusError:
        return ""
    return line.group(1).decode("utf-8", "replace").strip("'\"") if line else ""


def _own_files(folder: Path, directory: Path, rootpath: Path) -> list[Path]:
    """Files of a folder that name a test of this rootdir whose folder it is, and that no link leads to.

    A corpus outside of the rootdir may serve other projects, too: there a test is of this rootdir if its module is.
    """
    inside = folder.is_relative_to(rootpath)
    depth = len(directory.relative_to(rootpath).parts) if directory.is_relative_to(rootpath) else 0
    # Outside, the corpus itself: below it lie the folders from the rootdir to the test file, its module and its test.
    top = rootpath if inside else folder.parents[1 + depth]
    if any(each.is_symlink() for each in _up(folder, top) if each != top):
        return []

    def is_own(file: Path) -> bool:
        finding = read_saved_file(file).finding
        module, _, test = (_named_test(file) if finding is None else finding.test).partition("::")
        path = rootpath / module
        is_there = (safe_name(path.stem), safe_name(test)) == (folder.parent.name, folder.name)
        return is_there and path.parent == directory and (inside or os.path.lexists(path))

    return [file for file in files_in(folder) if not file.is_symlink() and file.is_file() and is_own(file)]


def _home(file: Path, collected: Collected) -> str:
    """Where a file should lie, by the test that it names, in words."""
    name = _named_test(file)
    module, _, test = name.partition("::")
    test_file = collected.rootpath / module
    if test_file not in collected.files:
        return f"the folder of {name or 'its test'}"
    tail = (safe_name(test_file.stem), safe_name(test))
    of_test = [folder for folder in collected.folders if folder.parts[-2:] == tail]
    known = [folder for folder in of_test if collected.roots[folder.parents[1]] == test_file.parent]
    return relative(known[0], collected.rootpath) if known else f"the folder of {name}"


def _up(folder: Path, top: Path) -> Iterator[Path]:
    """A folder and those above it up to a top one; nothing above it where it lies elsewhere."""
    yield folder
    if folder.is_relative_to(top):
        yield from (each for each in folder.parents if each.is_relative_to(top))
