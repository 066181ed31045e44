"""Results of findings for allure-pytest, which makes its results from hooks of items, not from reports.

A finding is no item of the session that finds it. So allure's listener, and nobody else, sees the hooks of an item that
has the name of the finding's replay.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from pytest_pafot.plugin import node_ids
from pytest_pafot.plugin.marks import DEFAULT_ARG, arguments_of

LISTENER = "allure_listener"
"""The name under which allure-pytest registers its listener, if a folder of results is asked for."""

REPORTERS = ("runner", "skipping")
"""The plugins of pytest that make the report of a phase, which the listener reads; the second one knows of xfail."""


@contextmanager
def without_listener(config: pytest.Config) -> Iterator[None]:
    """Hide from allure's listener what happens in this context: it takes each report for the running item's result."""
    manager = config.pluginmanager
    listener = manager.get_plugin(LISTENER)
    if listener is not None:
        manager.unregister(listener)
    try:
        yield
    finally:
        if listener is not None:
            manager.register(listener, LISTENER)


def tell_allure(item: pytest.Function, id_: str, call: pytest.CallInfo[None]) -> None:
    """Give a finding of a search a result of its own, with the failing call; do nothing if nobody asked for results."""
    manager = item.config.pluginmanager
    listener = manager.get_plugin(LISTENER)
    if listener is None:
        return
    name = node_ids.renamed(item.name, id_)
    found = pytest.Function.from_parent(item.parent, name=name, callobj=item.obj, originalname=item.originalname)
    found.stash, found.own_markers = item.stash, item.own_markers  # whether it is an xfail, and what allure shows
    given = arguments_of(item) or {}
    params = {**item.callspec.params, given.get("arg", DEFAULT_ARG): node_ids.saved_part(id_)}
    found.callspec = replace(item.callspec, params=params)  # allure knows the next replay by them
    others = [each for each in manager.get_plugins() if each is not listener]
    makers = [manager.get_plugin(each) for each in REPORTERS]

    def hook(name: str, removed: list[Any], **arguments: Any) -> None:
        manager.subset_hook_caller(name, removed)(**arguments)

    for phase, told in (("setup", None), ("call", call), ("teardown", None)):
        made = told or pytest.CallInfo.from_call(lambda: None, when=phase)  # type: ignore[arg-type]
        if phase != "call":
            arguments = {"item": found} if phase == "setup" else {"item": found, "nextitem": None}
            hook(f"pytest_runtest_{phase}", others, **arguments)
        hook("pytest_runtest_makereport", [each for each in others if each not in makers], item=found, call=made)
    hook("pytest_runtest_logfinish", others, nodeid=found.nodeid, location=found.location)
