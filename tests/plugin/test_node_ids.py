"""How names of items, of tests and of saved scenarios go into each other."""

from types import SimpleNamespace

import pytest

from pytest_pafot.plugin.node_ids import base_id, base_name, saved_name, saved_node_id, saved_part


class Item(SimpleNamespace):
    """An item with a name, which replays a saved scenario where it has the id of one."""

    def __init__(self, name, saved=None, parent="test_it.py::TestBraking"):
        super().__init__(name=name, location=("test_it.py", 3, f"TestBraking.{name}"), saved=saved)
        self.parent = None if parent is None else SimpleNamespace(nodeid=parent)

    def get_closest_marker(self, name):
        return None if self.saved is None else SimpleNamespace(args=[SimpleNamespace(id=self.saved)])


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
def test_a_search_and_its_saved_scenarios_have_the_name_of_their_test(base, search, saved):
    assert base_name(Item(search)) == base_name(Item(saved, "cut-in-3fa9c1")) == base
    assert base_id(Item(search)) == f"test_it.py::TestBraking::{base}"


@pytest.mark.parametrize(("base", "search", "saved"), NAMES)
def test_a_find_of_a_search_is_named_as_the_item_that_it_will_be(base, search, saved):
    assert saved_node_id(Item(search), "cut-in-3fa9c1") == f"test_it.py::TestBraking::{saved}"
    assert saved_name(Item(search), "cut-in-3fa9c1") == f"TestBraking.{saved}"


def test_an_item_that_pytest_did_not_parametrise_keeps_its_name():
    assert base_name(Item("test_x[1]")) == "test_x[1]"
    assert base_id(Item("test_x", parent=None)) == "test_x"


@pytest.mark.parametrize(
    ("id_", "part"),
    [
        ("cut-in-3fa9c1", "saved-cut-in-3fa9c1"),
        ("a b", "saved-a b"),
        ("a\\b", "saved-a%5Cb"),
        ("\u00e9", "saved-%C3%A9"),
    ],
)
def test_what_pytest_would_rewrite_in_an_id_is_quoted(id_, part):
    assert saved_part(id_) == part
