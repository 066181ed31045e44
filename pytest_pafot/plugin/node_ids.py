"""The names of items: ``test_x[1-search]`` is a search, ``test_x[1-saved-<id>]`` replays a saved scenario.

Both belong to the test ``test_x[1]``. This module calls that name the base name.
"""

from __future__ import annotations

import pytest

from pytest_pafot.corpus.layout import SEARCH_PART, around, name_without
from pytest_pafot.plugin.marks import SAVED_MARK
from pytest_pafot.support.text import visible

SAVED_PART = "saved-"


def saved_part(id_: str) -> str:
    """Return the part of an item's name that identifies its saved scenario, such as ``saved-<id>``.

    An id is quoted if pytest would rewrite it, or if it contains control characters, which a terminal would obey.
    """
    if id_.isascii() and "\\" not in id_ and visible(id_) == id_:
        return f"{SAVED_PART}{id_}"
    from urllib.parse import quote  # noqa: PLC0415

    return f"{SAVED_PART}{quote(id_, errors='surrogateescape')}"


def base_name(item: pytest.Item) -> str:
    """Return the name of an item's test: ``test_x[1]`` for ``test_x[1-search]``."""
    mark = item.get_closest_marker(SAVED_MARK)
    return name_without(SEARCH_PART if mark is None else saved_part(mark.args[0].id), item.name)


def base_id(item: pytest.Item) -> str:
    """Return the node id of an item's test, which a search and its saved scenarios have in common."""
    return _node_id(item, base_name(item))


def saved_node_id(item: pytest.Item, id_: str) -> str:
    """Return the node id of the item that will replay a finding of a search, given the finding's id."""
    return _node_id(item, renamed(item.name, id_))


def saved_name(item: pytest.Item, id_: str) -> str:
    """Return the name, for the location of a report, of the item that will replay a finding of a search."""
    return renamed(item.location[2], id_)


def qualified_name(item: pytest.Item) -> str:
    """Return the name of an item's test with its classes and parameters: ``TestBraking::test_x[1]``."""
    classes = [node.name for node in item.listchain() if isinstance(node, pytest.Class)]
    return "::".join([*classes, base_name(item)])


def _node_id(item: pytest.Item, name: str) -> str:
    return name if item.parent is None else f"{item.parent.nodeid}::{name}"


def renamed(text: str, id_: str) -> str:
    """Return the name of a search with the part of a saved scenario in place of its own."""
    parts = around(SEARCH_PART, text)
    return text if parts is None else saved_part(id_).join(parts)
