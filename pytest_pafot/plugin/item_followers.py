"""Findings for plugins that learn of tests from the hooks of items, not from reports.

A finding is no item of the session that finds it. So these plugins, and nobody else, see hooks of an item that has the
name of the finding's replay: allure-pytest makes its results in them, and the plugin of VS Code learns the file of a
test, without which it shows the finding under the folder.
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

EDITOR = "vscode_pytest"
"""The name under which VS Code gives its plugin to pytest."""

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


class _Found(pytest.Function):
    """An item with the node id of a finding's replay, which pytest would make of parameters that it keeps to itself."""

    found_id = ""

    @property
    def nodeid(self) -> str:
        return self.found_id


def show_followers(item: pytest.Function, id_: str, call: pytest.CallInfo[None]) -> None:
    """Show an item with the failing call of a finding to the plugins that follow items; do nothing without them."""
    manager = item.config.pluginmanager
    listener, editor = manager.get_plugin(LISTENER), manager.get_plugin(EDITOR)
    if listener is None and editor is None:
        return
    name = node_ids.renamed(item.name, id_)
    found = _Found.from_parent(item.parent, name=name, callobj=item.obj, originalname=item.originalname)
    found.found_id = node_ids.saved_node_id(item, id_)
    found.stash, found.own_markers = item.stash, item.own_markers  # whether it is an xfail, and what allure shows
    given = arguments_of(item) or {}
    params = {**item.callspec.params, given.get("arg", DEFAULT_ARG): node_ids.saved_part(id_)}
    found.callspec = replace(item.callspec, params=params)  # allure knows the next replay by them

    def hook(name: str, *seeing: object, **arguments: Any) -> None:
        others = [each for each in manager.get_plugins() if each not in seeing]
        manager.subset_hook_caller(name, others)(**arguments)

    if editor is not None:
        hook("pytest_runtest_protocol", editor, item=found, nextitem=None)
    if listener is None:
        return
    makers = [manager.get_plugin(each) for each in REPORTERS]
    for phase, shown in (("setup", None), ("call", call), ("teardown", None)):
        made = shown or pytest.CallInfo.from_call(lambda: None, when=phase)  # type: ignore[arg-type]
        if phase != "call":
            arguments = {"item": found} if phase == "setup" else {"item": found, "nextitem": None}
            hook(f"pytest_runtest_{phase}", listener, **arguments)
        hook("pytest_runtest_makereport", listener, *makers, item=found, call=made)
    hook("pytest_runtest_logfinish", listener, nodeid=found.nodeid, location=found.location)
