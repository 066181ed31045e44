"""The conversion between the names of items, tests and saved scenarios."""

from types import SimpleNamespace

import pytest

from pytest_pafot.plugin.collection import base_id, base_name, saved_name, saved_node_id, saved_part


class Item(SimpleNamespace):
    """An item with a name, which replays a saved scenario if its name has an id."""

    def __init__(self, name, saved=None, parent="test_it.py::TestBraking"):
        super().__init__(name=name, location=("test_it.py", 3, f"TestBraking.{name}"), saved=saved)
        self.parent = None if parent is None else SimpleNamespace(nodeid=parent)

    def get_closest_marker(self, name):
        return (
            None if self.saved is None else SimpleNamespace(args=[SimpleNamespace(id=self.saved)])
        )


NAMES = [
    ("test_x", "test_x[search]", "test_x[saved-cut-in-3fa9c1]"),
    ("test_x[1]", "test_x[1-search]", "test_x[1-saved-cut-in-3fa9c1]"),
    ("test_x[1-2]", "test_x[1-search-2]", "test_x[1-saved-cut-in-3fa9c1-2]"),
    ("test_x[2]", "test_x[search-2]", "test_x[saved-cut-in-3fa9c1-2]"),
    ("test_x[search]", "test_x[search-search]", "test_x[search-saved-cut-in-3fa9c1]"),
    ("test_x[saved-a]", "test_x[saved-a-search]", "test_x[saved-a-saved-cut-in-3fa9c1]"),
    ("test_x[research]", "test_x[research-search]", "test_x[research-saved-cut-in-3fa9c1]"),
]


@pytest.mark.parametrize(("base", "search", "saved"), NAMES)
def test_search_and_saved_items_share_their_base_name_and_a_finding_is_named_like_its_item(
    base, search, saved
):
    assert base_name(Item(search)) == base_name(Item(saved, "cut-in-3fa9c1")) == base
    assert base_id(Item(search)) == f"test_it.py::TestBraking::{base}"
    assert saved_node_id(Item(search), "cut-in-3fa9c1") == f"test_it.py::TestBraking::{saved}"
    assert saved_name(Item(search), "cut-in-3fa9c1") == f"TestBraking.{saved}"


def test_item_without_parameters_retains_its_name():
    assert base_name(Item("test_x[1]")) == "test_x[1]"
    assert base_id(Item("test_x", parent=None)) == "test_x"


@pytest.mark.parametrize(("id_", "part"), [
    ("cut-in-3fa9c1", "saved-cut-in-3fa9c1"),
    ("a b", "saved-a b"),
    ("a\\b", "saved-a%5Cb"),
    ("\u00e9", "saved-%C3%A9"),
])  # fmt: skip
def test_characters_rewritten_by_pytest_are_quoted_in_ids(id_, part):
    assert saved_part(id_) == part
