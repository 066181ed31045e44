"""What a session collected, and the saved scenarios that no item of it runs.

:mod:`pytest_pafot.plugin.orphans` finds them. It is imported only in a project that has saved scenarios.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from pytest_pafot.corpus.layout import CORPUS


class Orphan(NamedTuple):
    """A folder of saved scenarios whose test is gone."""

    expected: str  # a sentence on which test was expected and what was found instead
    is_gone: bool  # True if the module or the function no longer exists, although the session collected its folder


class Unrun(NamedTuple):
    """The saved scenarios of a session that no item runs."""

    orphans: dict[Path, Orphan]  # by folder
    # saved scenarios that no test's folder runs, each with the reason, and whether the session fails by it on CI
    strays: dict[str, tuple[str, bool]]
    unnamed: dict[str, str]  # what has a mark of pafot and pytest does not collect, with the reason


UNRUN = pytest.StashKey[Unrun]()

DRIVEN = pytest.StashKey[set[str]]()
"""The node ids of the items to run that drive policies; in a controller of pytest-xdist, those of its workers."""


class Collected:
    """The items and corpora that a session collected, before tests are selected."""

    def __init__(self, rootpath: Path) -> None:
        self.rootpath = rootpath  # the rootdir of the session
        self.asked_for: list[Path] = []  # the folders given on the command line
        self.folders: dict[Path, str] = {}  # corpus folders of the items, with the ids of their tests
        self.roots: dict[Path, Path] = {}  # corpora, each with the folder of its test files
        self.shared: set[Path] = set()  # the corpora of several folders of test files: absolute paths
        self.classes: set[str] = set()  # node ids of the classes that exist in collected modules and classes
        self.opened: set[str] = set()  # node ids of the classes whose members were collected
        self.files: set[Path] = set()  # test files that were collected, also those without a test
        self.skipped: set[Path] = set()  # test files that were skipped at import
        self.failed: set[Path] = set()  # test files that were not imported: by an error, or by --lf
        self.corpus = CORPUS  # the option of this name
        self.others: set[Path] = set()  # corpora of the default name, if the option gives another
        self.passed_by: set[Path] = set()  # saved scenarios that pytest met outside of corpora
        self.is_of_testpaths = False  # whether the setting testpaths gave the folders of the session, which had none
        # whether an option of the session leaves out a path
        self.is_ignored: Callable[[Path], bool] = lambda path: False
