"""The decorator ``@pafot.search``, the marks that it sets on test functions, and the names of their items.

Every test file that uses the plugin imports this module, so it imports little.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar, Unpack, overload
from weakref import WeakKeyDictionary

import pytest

from pytest_pafot.corpus.layout import SEARCH_PART, around, name_without

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import SearchArguments

SEARCH_MARK = "pafot_search"
SAVED_MARK = "pafot_saved"
SAVED_PART = "saved-"
ANY_MARK = "pafot"
WORLD_FIXTURE = "pafot_world"
DEFAULT_ADS = "ads"
DEFAULT_ARG = "run"
MARKED: WeakKeyDictionary[ModuleType, list[Any]] = WeakKeyDictionary()  # what is marked, by the module that exists
REPEAT = "repeat="  # the part of an item's name by which a plugin repeats its test, followed by a number
POSITIONAL = "<positional>"  # stores positional arguments, which a search does not take, for the item's error message

Target = TypeVar("Target", bound=Callable[..., Any] | type)


@overload
def search(target: Target, /) -> Target: ...
@overload
def search(**arguments: Unpack[SearchArguments]) -> Callable[[Target], Target]: ...
def search(*target: Any, **arguments: Any) -> Any:
    """Search for scenarios in which the decorated test function raises.

    The decorator works with and without arguments, on functions and on classes of test functions. Arguments are checked
    right before the test runs, so a wrong argument fails one item and does not prevent the import of the module.
    """
    if len(target) == 1 and not arguments and _may_be_decorated(target[0]):
        return _decorated(target[0], (), {})
    return lambda function: _decorated(function, target, arguments)


def _may_be_decorated(target: object) -> bool:
    """Return whether the only argument of ``@pafot.search`` can be the decorated test, not an ADS or its factory.

    An ADS is a class with ``__call__``, or a vehicle class of highway-env. A factory has no parameter ``run``, and its
    name is not the name of a test.
    """
    if inspect.isclass(target):
        kinematics = sys.modules.get("highway_env.vehicle.kinematics")  # if not imported, there is no vehicle class
        is_vehicle = kinematics is not None and issubclass(target, kinematics.Vehicle)
        return not is_vehicle and not any("__call__" in vars(base) for base in target.__mro__)
    if not inspect.isfunction(target):
        return False
    return target.__name__.startswith("test") or DEFAULT_ARG in inspect.signature(target).parameters


def _check_name(target: object) -> None:
    """Refuse an object without a name, which pytest takes for an argument of its mark: it would collect no test."""
    if getattr(target, "__name__", "<lambda>") == "<lambda>":
        raise TypeError(
            f"expected a test function or a class of tests, received {target!r}, which pytest does not collect; write "
            f"a function `def test_...({DEFAULT_ARG})` that calls it, and decorate that"
        )


def _decorated(target: Any, positional: tuple[object, ...], arguments: Mapping[str, object]) -> Any:
    _check_name(target)
    if (module := sys.modules.get(target.__module__)) is not None:
        MARKED.setdefault(module, []).append(target)
    given = [arguments.get("ads", DEFAULT_ADS), arguments.get("against")]
    names = [each for each in given if isinstance(each, str) and each and ":" not in each]
    fixtures = [WORLD_FIXTURE, *names]
    # usefixtures, not getfixturevalue at run time: a parametrised fixture must be known at collection.
    target = pytest.mark.usefixtures(*fixtures)(target)
    target = getattr(pytest.mark, SEARCH_MARK).with_args(*positional, **arguments)(target)
    return getattr(pytest.mark, ANY_MARK)(target)


def is_driven(item: pytest.Item) -> bool:
    """Return whether the item of a test drives its policy: a search or a replay."""
    return item.get_closest_marker(SEARCH_MARK) is not None


def arguments_of(item: pytest.Item | pytest.Collector) -> dict[str, Any] | None:
    """Return the arguments of all search marks of an item, merged; None if the item has no search mark.

    Of two marks with the same argument, the mark that is closer to the function is used.
    """
    marks = list(item.iter_markers(SEARCH_MARK))
    if not marks:
        return None
    merged: dict[str, Any] = {}
    for mark in reversed(marks):
        merged.update(mark.kwargs)
        if mark.args:
            merged[POSITIONAL] = mark.args
    return merged


# The names of items: ``test_x[1-search]`` is a search, ``test_x[1-saved-<id>]`` replays a saved scenario.
#
# Both belong to the test ``test_x[1]``, whose name is called the base name here.


def saved_part(id_: str) -> str:
    """Return the part of an item's name that identifies its saved scenario, such as ``saved-<id>``.

    An id is quoted if pytest would rewrite it, or if it contains control characters, which a terminal would obey.
    """
    from pytest_pafot.support.text import visible  # noqa: PLC0415  (few sessions have a saved scenario)

    if id_.isascii() and "\\" not in id_ and visible(id_) == id_:
        return f"{SAVED_PART}{id_}"
    from urllib.parse import quote  # noqa: PLC0415

    return f"{SAVED_PART}{quote(id_, errors='surrogateescape')}"


def base_name(item: pytest.Item) -> str:
    """Return the name of an item's test: ``test_x[1]`` for ``test_x[1-search]``, and for each repetition of it."""
    mark = item.get_closest_marker(SAVED_MARK)
    name = name_without(SEARCH_PART if mark is None else saved_part(mark.args[0].id), item.name)
    for part in re.findall(rf"(?<=[\[-]){REPEAT}\d+(?=[\]-])", name):
        name = name_without(part, name)
    return name


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
