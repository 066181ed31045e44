"""Saved scenarios that lie too high, beside the folders of tests, where no item runs them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pytest_pafot.corpus import layout
from pytest_pafot.plugin.orphans import named_test
from pytest_pafot.plugin.session import Seen


def find(roots: Mapping[Path, Path], folders: set[Path], rootpath: Path) -> list[Path]:
    """Files between the rootdir and the folders of tests; no folder is searched for them but those on the way.

    Args:
        roots: corpora, with the folder of the test files that each serves.
        folders: that hold the saved scenarios of a test, or did so.
        rootpath: of the session.
    """
    on_the_way: set[Path] = set()
    for root, directory in roots.items():
        on_the_way |= {*_up(root, rootpath), *_up(directory, rootpath), *layout.modules_in(root)}
    return [file for folder in sorted(on_the_way - folders) for file in layout.files_in(folder)]


def home(file: Path, seen: Seen, collected: set[Path], rootpath: Path) -> str:
    """Where a file should lie, by the test that it names, in words."""
    name = named_test(file)
    module, _, test = name.partition("::")
    if rootpath / module not in collected:
        return f"the folder of {name or 'its test'}"
    test_file = rootpath / module
    tail = (layout.safe_name(test_file.stem), layout.safe_name(test))
    of_test = [folder for folder in seen.folders if folder.parts[-2:] == tail]
    known = [folder for folder in of_test if seen.roots[folder.parents[1]] == test_file.parent]
    return layout.relative(known[0], rootpath) if known else f"the folder of {name}"


def _up(folder: Path, top: Path) -> list[Path]:
    """A folder and those above it up to a top one; nothing above it where it lies elsewhere."""
    return [folder, *(each for each in folder.parents if folder.is_relative_to(top) and each.is_relative_to(top))]
