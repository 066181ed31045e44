"""What a session collected, and the saved scenarios that no item of it runs.

:mod:`pytest_pafot.plugin.orphans` finds them. It is imported only in a project that has saved scenarios.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import pytest

from pytest_pafot.corpus.layout import CORPUS


class Orphan(NamedTuple):
    """A folder of saved scenarios whose test is gone."""

    removable: list[str]  # paths of the files that may be removed
    expected: str  # a sentence on which test was expected and what was found instead
    is_gone: bool  # True if the module or the function no longer exists, although the session collected its folder


class Unrun(NamedTuple):
    """The saved scenarios of a session that no item runs."""

    orphans: dict[Path, Orphan]  # by folder
    # saved scenarios that no test's folder runs, each with the reason, and whether the session fails by it on CI
    strays: dict[str, tuple[str, bool]]
    unnamed: dict[str, str]  # functions and classes with a mark of pafot that pytest does not collect by their name


UNRUN = pytest.StashKey[Unrun]()


@dataclass(slots=True, kw_only=True)
class Collected:
    """The items and corpora that a session collected, before tests are selected."""

    rootpath: Path  # the rootdir of the session
    asked_for: list[Path] = field(default_factory=list)  # the folders given on the command line
    folders: dict[Path, str] = field(default_factory=dict)  # corpus folders of the items, with the ids of their tests
    roots: dict[Path, Path] = field(default_factory=dict)  # corpora, each with the folder of its test files
    shared: set[Path] = field(default_factory=set)  # the corpora of several folders of test files: absolute paths
    # node ids of the classes that exist in collected modules and classes
    classes: set[str] = field(default_factory=set)
    opened: set[str] = field(default_factory=set)  # node ids of the classes whose members were collected
    files: set[Path] = field(default_factory=set)  # test files that were collected, also those without a test
    skipped: set[Path] = field(default_factory=set)  # test files that were skipped at import
    failed: set[Path] = field(default_factory=set)  # test files that could not be imported
    corpus: str = CORPUS  # the option of this name
    others: Collection[Path] = field(default_factory=set)  # corpora of the default name, if the option gives another
    passed_by: Collection[Path] = field(default_factory=set)  # saved scenarios that pytest met outside of corpora
    is_of_testpaths: bool = False  # whether the session was given no folders, so that its setting testpaths gave them
    is_ignored: Callable[[Path], bool] = lambda path: False  # whether an option of the session leaves out a path
