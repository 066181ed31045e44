"""The pytest plugin.

A session without a marked test imports only small modules. Everything else is imported when it is needed.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Generator, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import pytest

from pytest_pafot.plugin.collection import (
    ANY_MARK,
    SAVED_MARK,
    SEARCH_MARK,
    Collection,
    arguments_of,
    is_driven,
)
from pytest_pafot.plugin.session import (
    INVENTORY,
    SESSION,
    SHARED,
    Header,
    Messages,
    Shared,
    add_options,
    cause_of,
    end_in_order,
    guard_exits,
    is_worker,
    option_value,
    resolve,
    stale_day,
)
from pytest_pafot.report.session import Session
from pytest_pafot.searches.options import BY_NAME, OF_COMMAND, OPTIONS, is_ci
from pytest_pafot.support import isolating
from pytest_pafot.support.errors import RequestError, flag

if TYPE_CHECKING:
    from pytest_pafot.model.scenario import Scenario
    from pytest_pafot.oracle.run import Run
    from pytest_pafot.world.base_world import BaseWorld
    from pytest_pafot.world.driving.policy import AdsFactory


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the command-line options and ini keys."""
    add_options(parser)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config) -> Generator[None, None, None]:
    """Fail the session if a conftest.py ends the process."""
    guard_exits(early_config)
    try:
        return (yield)
    except SystemExit as error:
        # pytest would end with the status of this exception, which may be 0.
        raise pytest.UsageError(
            f"a conftest.py raised {error!r}. Remove the call that ends the process"
        ) from error


def pytest_configure(config: pytest.Config) -> None:
    """Register the marks, and one plugin for each enabled feature."""
    for line in (
        f"{ANY_MARK}: select all tests of pytest-pafot with `pytest -m {ANY_MARK}` (set by @pafot.search)",
        f"{SEARCH_MARK}(**arguments): search for scenarios in which the test fails (set by @pafot.search)",
        f"{SAVED_MARK}(saved): replay a saved scenario (set by the plugin)",
    ):
        config.addinivalue_line("markers", line)
    record = config.stash[SESSION] = Session()
    corpus = config.getoption(BY_NAME["corpus"].key)
    if corpus is not None:
        record.options.append(flag("corpus", corpus))
    features: dict[str, object] = {"collection": Collection(config)}
    if is_worker(config):
        from pytest_pafot.plugin.distributed import KEY, Worker  # noqa: PLC0415

        config.stash[SHARED] = Shared(**config.workerinput[KEY])  # type: ignore[attr-defined]
        features["worker"] = Worker()
    else:
        shared = config.stash[SHARED] = Shared()
        asked = config.getoption(BY_NAME["today"].key)
        if asked and is_ci(os.environ):  # a CI script may keep an old day for years
            record.warnings += stale_day(asked, shared.day)
        shared.today = asked or shared.today
        if OF_COMMAND in os.environ:
            _check_that_it_searches(config)
        if cause_of(config):  # even if no marked test is left to register it
            from pytest_pafot.plugin.guard import Guard  # noqa: PLC0415

            features["guard"] = Guard(config)
    is_parallel = config.getoption("dist", "no") != "no"
    if config.get_verbosity() > 0:
        features["header"] = Header()
    _register(config, features)
    # A controller of pytest-xdist collects no items, so it cannot wait for a marked one.
    values = [config.getoption(option.key) for option in OPTIONS]
    if is_parallel or any(value is not None for value in values):
        _report(config)
    # last, so that it merges the data of ended workers before the reports are written
    if is_parallel:
        from pytest_pafot.plugin.distributed import Controller  # noqa: PLC0415

        _register(config, {"controller": Controller()})


def _check_that_it_searches(config: pytest.Config) -> None:
    try:
        # A search without runs would pass.
        settings = resolve(config, {})
    except RequestError:  # its test reports it
        return
    if not settings.is_search:
        raise pytest.UsageError(
            f"search: expected at least 1 run, received 0. Remove --runs or {flag('generations')}"
        )


@pytest.hookimpl(trylast=True)  # after hooks that add marks
def pytest_collection_finish(session: pytest.Session) -> None:
    """Register the plugins that run marked items and report on them."""
    config = session.config
    marked = [item for item in session.items if item.get_closest_marker(ANY_MARK) is not None]
    inventory = config.stash[INVENTORY]
    inventory.driven.update(item.nodeid for item in session.items if is_driven(item))
    is_marked = bool(marked or inventory.driven)
    if is_marked or any(inventory):
        _report(config)
    if not is_marked or config.getoption("collectonly"):
        # these plugins import the simulation, which would slow down an editor that only lists tests
        return
    from pytest_pafot.plugin.item import Failures  # noqa: PLC0415
    from pytest_pafot.plugin.search_item import Checks, Execution  # noqa: PLC0415

    _register(config, {"checks": Checks(), "execution": Execution(), "failing": Failures()})
    end_in_order(config)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Register the reports if a session without marked items has something to report."""
    said = session.config.stash[SESSION]
    if said.problems or said.written or said.left:
        _report(session.config)


def _report(config: pytest.Config) -> None:
    if config.pluginmanager.has_plugin("pafot-messages"):
        return
    features: dict[str, object] = {"messages": Messages()}
    if not is_worker(config):
        from pytest_pafot.plugin.guard import Guard  # noqa: PLC0415
        from pytest_pafot.plugin.reporter import Files, Reporter  # noqa: PLC0415

        # A worker of pytest-xdist only sends messages. The controller reports on them.
        files = Files(config)
        features |= {"files": files, "reporting": Reporter(config, files), "guard": Guard(config)}
    _register(config, features)


def _register(config: pytest.Config, features: Mapping[str, object]) -> None:
    for name, feature in features.items():
        if not config.pluginmanager.has_plugin(f"pafot-{name}"):
            config.pluginmanager.register(feature, f"pafot-{name}")


# Fixtures for searches and for ordinary tests that run simulations, and the types of their values.


class Simulate(Protocol):
    """The type of the function that the fixture ``pafot_simulate`` returns."""

    def __call__(
        self, scenario: Scenario, ads_factory: AdsFactory, world: BaseWorld | None = None
    ) -> Run:
        """Run a scenario in a world, by default in the world of the fixture ``pafot_world``."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Isolate the policies of tests that call ``pafot_simulate``, if an option requests it."""
    with isolating(lambda: option_value(item.config, BY_NAME["isolate"], arguments_of(item) or {})):
        return (yield)


@pytest.fixture(scope="session")
def pafot_world() -> BaseWorld:
    """Return the default world of searches, a straight motorway. Override it in a conftest.py."""
    from pytest_pafot.world import Highway  # noqa: PLC0415

    return Highway()


@pytest.fixture(scope="session")
def pafot_simulate(pafot_world: BaseWorld) -> Simulate:
    """Return a function ``(scenario, ads_factory, world=None) -> Run`` that simulates a scenario.

    The function fails the test if the policy raises, hangs or returns no action. It warns if the run is invalid.
    """
    from pytest_pafot.execution.pool import ProcessLostError  # noqa: PLC0415
    from pytest_pafot.execution.runner import drive_once  # noqa: PLC0415
    from pytest_pafot.findings.finding import ads_failure  # noqa: PLC0415
    from pytest_pafot.model.instructions import Cell, PositionInstruction  # noqa: PLC0415
    from pytest_pafot.model.scenario import Scenario  # noqa: PLC0415
    from pytest_pafot.model.trace import Outcome  # noqa: PLC0415
    from pytest_pafot.searches.harness import ads_text  # noqa: PLC0415
    from pytest_pafot.world import Highway  # noqa: PLC0415

    def simulate(
        scenario: Scenario, ads_factory: AdsFactory, world: BaseWorld | None = None
    ) -> Run:
        end = ""
        try:
            asked = pafot_world if world is None else world
            run = drive_once(asked, scenario, ads_factory)
        except ProcessLostError as lost:
            end = lost.advice
        if end:  # outside of the handler, so that the failure has no context
            pytest.fail(end, pytrace=False)
        failure = ads_failure(run)
        # Such a run is short, and would pass most assertions that something did not happen.
        if failure is not None:
            pytest.fail(ads_text(failure), pytrace=False)
        hypothesis = sys.modules.get("hypothesis")
        # one of many scenarios
        is_generated = hypothesis is not None and hypothesis.currently_in_test_context()
        if run.outcome is Outcome.INVALID and not is_generated:
            why = run.trace.users_error_text or "two NPCs collided, or an NPC hit a fixed object"
            what = "environment" if run.trace.ended else "scenario"
            warnings.warn(
                f"pafot_simulate: the run is invalid, because {why}. It ended early, so it cannot show whether the ego "
                f"drives well. Correct the {what}",
                pytest.PytestWarning,
                stacklevel=2,
            )
        return run

    # The first run imports highway-env, which takes about a second. Hypothesis would report the test as too slow.
    still = Scenario(npcs=((PositionInstruction(Cell.FRONT, 22.0),),))
    with isolating(lambda: False):
        simulate(still, lambda: lambda observation: (0.0, 0.0), Highway(duration=0.2))
    return simulate
