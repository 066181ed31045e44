"""Tests with a mark of pafot that pytest does not collect: they never run, and nothing but this module says so."""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import pytest

import pytest_pafot
from pytest_pafot.corpus.layout import relative
from pytest_pafot.plugin.marks import SEARCH_MARK, search

_NO_TEST = "pytest collects no test of this class; expected one without __init__ and __new__, and with test methods"


class Left(NamedTuple):
    """A marked function, class or callable object that pytest has left out."""

    name: str  # like the node id that it would have
    why: str
    member: object


def left_out(collector: pytest.Module | pytest.Class, collected: Sequence[object]) -> Iterator[Left]:
    """Yield the marked members of a module or class that pytest has left out of what it collected.

    Not meant are what was imported, what sets ``__test__`` to False, and a function that was collected by another name.
    A class that a later module derives from is no test of its own either; see :func:`is_base`.
    """
    home = collector.obj
    is_class = inspect.isclass(home)
    module = home.__module__ if is_class else home.__name__
    runs = set(map(_member_of, collected))
    if is_class and not collected and _is_marked(home) and getattr(home, "__test__", True):
        yield Left(collector.nodeid, _NO_TEST, home)
    for name, each in vars(home).items():
        if not _is_own(each, module) or id(each) in runs or not getattr(each, "__test__", True):
            continue
        marked = _marked_in(each)
        if marked is None:
            continue
        if isinstance(each, pytest.MarkDecorator):
            why = f"expected a function, received {each.args[-1]!r:.80}; write a function that calls it"
        elif _has_test_name(collector, name, each):
            why = _NO_TEST if is_class and not collected else "expected a test, but a plugin has left it out"
        else:
            other = f"Test{name}" if inspect.isclass(each) else f"test_{name}"
            setting = "python_classes" if inspect.isclass(each) else "python_functions"
            example = f"such as {other}" if _has_test_name(collector, other, each) else f"see {setting} in its settings"
            why = f"expected a name that pytest collects, {example}"
        yield Left("::".join((collector.nodeid, name, *marked)), why, each)


def replaced_in(collector: pytest.Module) -> Iterator[tuple[str, str]]:
    """Yield the marked functions and classes of a test file that a later definition of the same name replaces."""
    scope = vars(collector.obj)
    if not any(each is search or each is pytest_pafot for each in scope.values()):
        return
    import ast  # noqa: PLC0415  (few test files use this plugin)

    def resolved(node: ast.expr) -> object:
        if isinstance(node, ast.Call):
            return resolved(node.func)
        if isinstance(node, ast.Attribute):
            return getattr(resolved(node.value), node.attr, None)
        return scope.get(node.id) if isinstance(node, ast.Name) else None

    bodies = [(collector.nodeid, ast.parse(collector.path.read_bytes()).body)]
    for prefix, body in bodies:  # grows by the classes
        definitions: dict[str, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef] = {}
        for node in body:
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            former = definitions.get(node.name)
            if former is not None and any(resolved(each) is search for each in former.decorator_list):
                yield f"{prefix}::{node.name}", f"line {node.lineno} replaces that of line {former.lineno}"
            definitions[node.name] = node
            if isinstance(node, ast.ClassDef):
                bodies.append((f"{prefix}::{node.name}", node.body))


def beside_test_files(config: pytest.Config, folders: Sequence[Path], items: Iterable[pytest.Item]) -> Iterator[Left]:
    """Yield the marked members of conftest.py and other files that pytest imports and does not collect.

    Only files in the folders that the session was asked for are meant; no installed packages, and nothing that a test
    file has imported as a test of its own.
    """
    root, patterns = str(config.rootpath) + os.sep, config.getini("python_files")
    runs: set[int] | None = None
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if not isinstance(file, str) or not file.startswith(root) or "site-packages" in file:
            continue
        path = Path(file)
        if not any(map(path.is_relative_to, folders)) or any(
            fnmatch(path.name, each) or path.match(each) for each in patterns
        ):
            continue
        for name, each in vars(module).items():
            if not _is_own(each, module.__name__) or not getattr(each, "__test__", True):
                continue
            marked = _marked_in(each)
            if marked is None:
                continue
            if runs is None:
                nodes = {node for item in items for node in item.listchain()}
                runs = set(map(_member_of, nodes))
            if id(each) not in runs:
                node_id = "::".join((relative(path, config.rootpath), name, *marked))
                yield Left(node_id, "pytest collects no tests from this file; move it to a test file", each)


def is_base(member: object) -> bool:
    """Return whether a class has subclasses, which may be collected in its place."""
    return inspect.isclass(member) and bool(type.__subclasses__(member))


def _marked_in(member: object) -> list[str] | None:
    """Return no names if a member is marked, the first marked method of a class that is not; None if there is none."""
    if _is_marked(member):
        return []
    methods: Mapping[str, object] = vars(member) if inspect.isclass(member) else {}
    return next(([name] for name, each in methods.items() if inspect.isfunction(each) and _is_marked(each)), None)


def _is_marked(member: object) -> bool:
    own: Any = []
    if isinstance(member, pytest.MarkDecorator) and any(map(callable, member.args)):
        own = member  # which pytest has made of an object without a name, instead of marking it
    elif isinstance(member, FunctionType | type):
        own = vars(member).get("pytestmark", [])  # a list, unless the user has set it to one mark
    return SEARCH_MARK in {mark.name for mark in (own if isinstance(own, list) else [own])}


def _is_own(member: object, module: str) -> bool:
    """Return whether a member may be a test of a module; a marked object says of no module that it is from there."""
    if inspect.isfunction(member) or inspect.isclass(member):
        return member.__module__ == module
    return isinstance(member, pytest.MarkDecorator)


def _member_of(node: object) -> int:
    """Return the identity of the function or class that a node of pytest runs."""
    return id(getattr(node, "function", None) or getattr(node, "obj", None))


def _has_test_name(collector: pytest.Module | pytest.Class, name: str, member: object) -> bool:
    is_named = collector.classnamefilter if inspect.isclass(member) else collector.funcnamefilter
    return is_named(name) or collector.isnosetest(member)
