"""Which saved scenarios belong to a test, and how their names relate to node ids."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import pytest

from pytest_pafot.corpus.layout import folder_of_test, safe_name
from pytest_pafot.corpus.saved import Saved, saved_in
from pytest_pafot.plugin.marks import SAVED_MARK
from pytest_pafot.plugin.session import SAVED_PART, SEARCH_PART


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


def read_saved(module_folder: Path, definition: pytest.Item) -> list[Saved]:
    """All files that may belong to an item of a test function, whatever its parameters."""
    if not module_folder.is_dir():
        return []
    name = safe_name(qualified_name(definition))

    def may_belong(folder: Path) -> bool:
        return folder.name.startswith((name, f"{name}@")) or "~" in folder.name

    folders = sorted(folder for folder in module_folder.iterdir() if folder.is_dir() and may_belong(folder))
    return [saved for folder in folders for saved in saved_in(folder)]


def folder_of_item(item: pytest.Item, corpus: str, rootpath: Path) -> Path:
    """Where the files of one item lie, parametrisation included."""
    return folder_of_test(item.path, qualified_name(item), corpus, rootpath)


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
