"""Saved scenarios whose test is gone: found without blaming a selection, removed only when asked for."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from pytest_pafot.corpus import layout
from pytest_pafot.corpus.saved import read_saved_file
from pytest_pafot.plugin.session import Seen

_TEST_LINE = re.compile(rb"^test:\s*(.+?)\s*$", re.MULTILINE)


def find(seen: Seen, roots: Mapping[Path, Path], collected: set[Path], rootpath: Path) -> dict[Path, list[Path]]:
    """Folders that hold saved scenarios of no test, each with the files that may be removed.

    A folder is an orphan when its module is gone, or when the place where its test would be, module or class, was
    collected and made no such item. Selections by ``-k``, ``-m`` or node ids do not matter: pytest collects all
    members of a module or class before it selects. A module that failed or was skipped at import blames nobody.

    Args:
        seen: what was collected.
        roots: corpora, with the folder of the test files that each serves.
        collected: test files with at least one item.
        rootpath: of the session.
    """
    return {
        folder: _own_files(folder, directory, rootpath)
        for root, directory in sorted(roots.items())
        for folder in _folders(root)
        if _is_orphan(folder, directory, collected, seen, rootpath)
    }


def prune(files: Iterable[Path]) -> tuple[list[Path], list[str]]:
    """Remove files, and the folders around them that are empty then; returns those removed, and what failed."""
    removed: list[Path] = []
    failures: list[str] = []
    for file in files:
        try:
            file.unlink(missing_ok=True)  # Another session may have been faster.
            removed.append(file)
        except OSError as error:
            failures.append(f"{file}: {error.strerror or error}")
    for folder in dict.fromkeys(file.parent for file in removed):
        with suppress(OSError):  # It holds something else, which stays.
            folder.rmdir()
            folder.parent.rmdir()
    return removed, failures


def _own_files(folder: Path, directory: Path, rootpath: Path) -> list[Path]:
    """Files of a folder that name a test of this rootdir whose folder it is, and that no link leads to.

    A corpus outside of the rootdir may serve other projects, too: there a test is of this rootdir if its module is.
    """
    inside = folder.is_relative_to(rootpath)
    top = rootpath if inside else folder.parents[2 + len(_relative_parts(directory, rootpath)) - 1]
    if any(each.is_symlink() for each in (folder, *folder.parents) if each != top and each.is_relative_to(top)):
        return []

    def is_own(file: Path) -> bool:
        module, _, test = _test_of(file).partition("::")
        path = rootpath / module
        is_there = (layout.safe_name(path.stem), layout.safe_name(test)) == (folder.parent.name, folder.name)
        return is_there and path.parent == directory and (inside or path.exists())

    return [file for file in layout.files_in(folder) if file.is_file() and not file.is_symlink() and is_own(file)]


def _relative_parts(directory: Path, rootpath: Path) -> tuple[str, ...]:
    return directory.relative_to(rootpath).parts if directory.is_relative_to(rootpath) else ()


def _test_of(file: Path) -> str:
    """The node id that a file names, also where the file is broken."""
    finding = read_saved_file(file).finding
    return named_test(file) if finding is None else finding.test


def count(folder: Path) -> int:
    """Saved scenarios in a folder."""
    return len(layout.files_in(folder))


def named_test(file: Path) -> str:
    """The node id of the test that a saved scenario names; empty where it names none."""
    try:
        line = _TEST_LINE.search(file.read_bytes()[:65536])
    except OSError:
        return ""
    return line.group(1).decode("utf-8", "replace").strip("'\"") if line else ""


def _folders(root: Path) -> Iterator[Path]:
    for module in layout.modules_in(root):
        yield from sorted(folder for folder in module.iterdir() if count(folder) and _is_of_one_test(folder))


def _is_of_one_test(folder: Path) -> bool:
    """Whether it holds no folders: where one corpus serves all folders of tests, they lie side by side with modules."""
    return not any(path.is_dir() for path in folder.iterdir())


def _is_orphan(folder: Path, directory: Path, collected: set[Path], seen: Seen, rootpath: Path) -> bool:
    if folder in seen.folders:
        return False
    module = layout.module_named(directory, folder.parent.name)
    if not module.exists():
        return True
    if module not in collected:
        return False
    prefix = layout.relative(module, rootpath)
    for name in _classes(folder):
        prefix = f"{prefix}::{name}"
        if prefix not in seen.classes:
            return True
        if prefix not in seen.opened:
            return False  # Its members were not collected, since another node id was asked for.
    return True


def _classes(folder: Path) -> list[str]:
    """The classes around the test that a folder belongs to, from the first file that names it."""
    name = next(filter(None, map(named_test, layout.files_in(folder))), "")
    return name.partition("[")[0].split("::")[1:-1]
