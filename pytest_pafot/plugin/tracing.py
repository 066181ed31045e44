"""Requirements of tests: what marks say of them, and how reports carry it to the controller and to other tools."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from pytest_pafot.plugin.marks import ANY_MARK, TRACING
from pytest_pafot.support.text import visible
from pytest_pafot.support.traced import MOST_TEXT, Traced, checked

TRACED = pytest.StashKey[Traced]()


def traced(item: pytest.Item) -> Traced:
    """Return what the marks of an item say of its requirements; nothing if they are wrong, which fails the item."""
    if TRACED not in item.stash:
        try:
            item.stash[TRACED] = read(item)
        except ValueError:
            item.stash[TRACED] = Traced()
    return item.stash[TRACED]


def read(item: pytest.Item) -> Traced:
    """Read the requirements from the marks of an item, its classes and its module; the closest mark counts.

    A title belongs to the requirement of its mark: with a requirement of its own, a test does not inherit the title
    of its class. Without a title, the first line of the docstring of what is marked is the title.

    Raises:
        ValueError: if an argument is wrong.
    """
    requirements: tuple[str, ...] = ()
    title = owner = documentation = ""
    for node, mark in item.iter_markers_with_node(ANY_MARK):
        if mark.args or not mark.kwargs.keys() <= set(TRACING):
            received = ", ".join([*map(repr, mark.args), *(f"{name}=" for name in mark.kwargs if name not in TRACING)])
            raise ValueError(f"pytest.mark.{ANY_MARK}: expected {', '.join(TRACING)} by name, received {received:.100}")
        named = checked(mark.kwargs)
        owner = owner or named.owner
        if not requirements:
            title = title or named.title
            requirements = named.requirements
            documentation = _first_line(node) if requirements else ""
    title = title or documentation or _first_line(item)
    return Traced(requirements=requirements, title=title if requirements else "", owner=owner)


def _first_line(node: object) -> str:
    # Not inspect.getdoc, which takes the docstring of a base class for one that has none.
    documentation = getattr(getattr(node, "obj", None), "__doc__", None)
    if not isinstance(documentation, str):
        return ""
    return visible(documentation.strip().partition("\n")[0].strip())[:MOST_TEXT].removesuffix(".")


def set_properties_of(items: Iterable[pytest.Item]) -> None:
    """Give items whose marks name a requirement or an owner their properties, which their reports carry."""
    for item in items:
        item.user_properties.extend(traced(item).properties)
