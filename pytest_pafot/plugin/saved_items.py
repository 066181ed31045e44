"""Where the saved scenarios of a test lie, and how their names relate to node ids."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pytest

from pytest_pafot.plugin.marks import SAVED_MARK
from pytest_pafot.plugin.session import SAVED_PART, SEARCH_PART

if TYPE_CHECKING:
    from pytest_pafot.findings.finding import Finding

SUFFIX = ".pafot.yaml"

CRASH = "ProcessCrash"
"""Failure of a finding whose scenario was in flight when a process died."""


class Saved(NamedTuple):
    """A corpus file as collected.

    Attributes:
        path: of the file.
        finding: its content; None when it cannot be read.
        error: why it cannot be read.
    """

    path: Path
    finding: Finding | None = None
    error: str = ""

    @property
    def id(self) -> str:
        """The name of the file, which is the finding's id."""
        return self.path.name.removesuffix(SUFFIX)

    @property
    def xfail(self) -> str | None:
        """The reason why the failure is accepted, or None."""
        return None if self.finding is None else self.finding.xfail

    @property
    def is_crash(self) -> bool:
        """Whether a process died in this scenario."""
        return self.finding is not None and self.finding.expect.failure == CRASH

    @property
    def is_deadly(self) -> bool:
        """Whether running it may end the process, or never end."""
        return self.is_crash or (self.finding is not None and self.finding.expect.outcome == "hang")

    def __repr__(self) -> str:
        return f"<saved {self.id}>"


class Candidates(NamedTuple):
    """Files of the same id that may belong to an item of a test function, by their folder, one of which will.

    Attributes:
        id: of all of them.
        files: by the folder that belongs to one parametrisation.
    """

    id: str
    files: Mapping[Path, Saved]


def by_id(saved: Iterable[Saved]) -> list[Candidates]:
    """One for each id, in the order in which they come."""
    found: dict[str, dict[Path, Saved]] = {}
    for each in saved:
        found.setdefault(each.id, {})[each.path.parent] = each
    return [Candidates(id=id_, files=files) for id_, files in found.items()]


def read_saved_file(path: Path) -> Saved:
    """A file as it is; one that cannot be read says why when its item runs."""
    from pytest_pafot.corpus import files as corpus  # noqa: PLC0415

    try:
        return Saved(path=path, finding=corpus.read(path))
    except (corpus.CorpusError, OSError) as error:
        return Saved(path=path, error=str(error))


def files_in(folder: Path) -> list[Path]:
    """The corpus files in a folder, sorted by name; none in one that is missing or cannot be listed."""
    try:
        return sorted(path for path in folder.iterdir() if path.name.endswith(SUFFIX))
    except OSError:
        return []  # It has no items; whoever writes a finding into it is told what is wrong with it.


def modules_in(root: Path) -> list[Path]:
    """The folders of a corpus, each of a module, by name; none where there is no corpus."""
    return sorted(path for path in root.iterdir() if path.is_dir()) if root.is_dir() else []


def saved_in(folder: Path) -> list[Saved]:
    """All files of one item, by id."""
    return [read_saved_file(path) for path in files_in(folder)]


def read_saved(module_folder: Path, definition: pytest.Item) -> list[Saved]:
    """All files that may belong to an item of a test function, whatever its parameters."""
    if not module_folder.is_dir():
        return []
    from pytest_pafot.corpus.layout import safe_name  # noqa: PLC0415

    name = safe_name(qualified_name(definition))

    def may_belong(folder: Path) -> bool:
        return folder.name.startswith((name, f"{name}@")) or "~" in folder.name

    folders = sorted(folder for folder in module_folder.iterdir() if folder.is_dir() and may_belong(folder))
    return [saved for folder in folders for saved in saved_in(folder)]


def corpus_root(test_file: Path, corpus: str, rootpath: Path) -> Path:
    """The corpus that serves a test file: beside it, or for an absolute path in one place for all."""
    folder = Path(corpus)
    if not folder.is_absolute():
        return test_file.parent / folder
    try:
        return folder / test_file.parent.relative_to(rootpath)
    except ValueError:
        return folder


def is_corpus(path: Path, corpus: Path) -> bool:
    """Whether a folder is one that a corpus option names."""
    if corpus.is_absolute():
        return path == corpus
    return path.name == corpus.name and path.parts[-len(corpus.parts) :] == corpus.parts


def folder_of_module(test_file: Path, corpus: str, rootpath: Path) -> Path:
    """Where the folders of all tests of a module lie."""
    root = corpus_root(test_file, corpus, rootpath)
    if not root.is_dir():
        return root / test_file.stem
    from pytest_pafot.corpus.layout import safe_name  # noqa: PLC0415

    return root / safe_name(test_file.stem)


def folder_of_item(item: pytest.Item, corpus: str, rootpath: Path) -> Path:
    """Where the files of one item lie, parametrisation included."""
    from pytest_pafot.corpus.layout import safe_name  # noqa: PLC0415

    root = corpus_root(item.path, corpus, rootpath)
    return root / safe_name(item.path.stem) / safe_name(qualified_name(item))


def module_of_file(file: Path, corpus: str, rootpath: Path) -> Path | None:
    """The test file that a corpus file belongs to, whatever its content; None outside of a corpus."""
    if len(file.parents) < 3:
        return None
    root, module = file.parents[2], file.parents[1].name
    folder = Path(corpus)
    if folder.is_absolute():
        directory = rootpath / root.relative_to(folder) if root.is_relative_to(folder) else None
    else:
        directory = root.parents[len(folder.parts) - 1] if root.parts[-len(folder.parts) :] == folder.parts else None
    return None if directory is None else module_named(directory, module)


def module_named(directory: Path, folder: str) -> Path:
    """The test file of a directory whose corpus folder has this name; it may not exist."""
    from pytest_pafot.corpus.layout import safe_name  # noqa: PLC0415

    return next((file for file in directory.glob("*.py") if safe_name(file.stem) == folder), directory / f"{folder}.py")


def saved_part(id_: str) -> str:
    """What the name of an item says of its file. What no id may hold is quoted, since pytest would rewrite it."""
    if id_.isascii() and id_.isprintable() and "\\" not in id_:
        return f"{SAVED_PART}{id_}"
    from urllib.parse import quote  # noqa: PLC0415

    return f"{SAVED_PART}{quote(id_, errors='surrogateescape')}"


def base_name(item: pytest.Item) -> str:
    """The name without the plugin's own part: ``test_x[1-search]`` is ``test_x[1]``."""
    mark = item.get_closest_marker(SAVED_MARK)
    part = SEARCH_PART if mark is None else saved_part(mark.args[0].id)
    split = _split(item.name, part)
    if split is None:
        return item.name
    head, tail = split
    if tail.startswith("-"):
        return head + tail[1:]
    return head[:-1] if head.endswith("[") else head[:-1] + tail


def base_id(item: pytest.Item) -> str:
    """The node id without the plugin's own part; equal for a search and its saved scenarios."""
    return _with_name(item, base_name(item))


def saved_node_id(item: pytest.Item, id_: str) -> str:
    """The node id that a finding of a search will have as an item."""
    return _with_name(item, _renamed(item.name, id_))


def saved_name(item: pytest.Item, id_: str) -> str:
    """The same for the third part of a report's location."""
    return _renamed(item.location[2], id_)


def qualified_name(item: pytest.Item) -> str:
    """The test with its classes and parameters: ``TestBraking::test_x[1]``."""
    classes = [node.name for node in item.listchain() if isinstance(node, pytest.Class)]
    return "::".join([*classes, base_name(item)])


def relative(path: Path, rootpath: Path) -> str:
    """A path as people read it."""
    return path.relative_to(rootpath).as_posix() if path.is_relative_to(rootpath) else str(path)


def _with_name(item: pytest.Item, name: str) -> str:
    parent = item.parent
    return name if parent is None else f"{parent.nodeid}::{name}"


def _renamed(text: str, id_: str) -> str:
    split = _split(text, SEARCH_PART)
    return text if split is None else f"{split[0]}{saved_part(id_)}{split[1]}"


def _split(text: str, part: str) -> tuple[str, str] | None:
    """What stands before and after the last occurrence of a part of a parametrised name."""
    found = list(re.finditer(rf"(?<=[\[-]){re.escape(part)}(?=[\]-])", text))
    return (text[: found[-1].start()], text[found[-1].end() :]) if found else None
