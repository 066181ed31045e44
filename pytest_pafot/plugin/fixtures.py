"""Fixtures for searches and for ordinary tests that simulate, and the types of their values."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Generator
from typing import TYPE_CHECKING, Any, Protocol

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.plugin.marks import arguments_of
from pytest_pafot.plugin.option_sources import option_value
from pytest_pafot.support.isolation import isolating

if TYPE_CHECKING:
    from pytest_pafot.model.scenario import Scenario
    from pytest_pafot.oracle.run import Run
    from pytest_pafot.world.base_world import WorldLike
    from pytest_pafot.world.driving.ads import AdsFactory


class Simulate(Protocol):
    """The type of the function that the fixture ``pafot_simulate`` returns."""

    def __call__(self, scenario: Scenario, ads_factory: AdsFactory, world: WorldLike | None = None) -> Run:
        """Run a scenario in a world, by default in the world of the fixture ``pafot_world``."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Let what a test and its fixtures call know whether the policies of this session are isolated."""
    with isolating(lambda: option_value(item.config, BY_NAME["isolate"], arguments_of(item) or {})):
        return (yield)


@pytest.fixture(scope="session")
def pafot_world() -> WorldLike:
    """Return the default world of searches, a straight motorway. Override this fixture in a conftest.py."""
    from pytest_pafot.world import Highway  # noqa: PLC0415

    return Highway()


@pytest.fixture(scope="session")
def pafot_simulate(pafot_world: WorldLike) -> Simulate:
    """Return a function (scenario, ads_factory, world=None) -> Run that simulates a scenario.

    The function fails the test if the ADS raises, hangs or returns no action, and warns of an invalid run. It is warmed
    up: its first call is not slower than the others.
    """
    from pytest_pafot.campaign.verdict import ads_text  # noqa: PLC0415
    from pytest_pafot.execution.pool import ProcessLostError  # noqa: PLC0415
    from pytest_pafot.execution.runner import driving  # noqa: PLC0415
    from pytest_pafot.findings.finding import ads_failure  # noqa: PLC0415
    from pytest_pafot.model.grid import Cell  # noqa: PLC0415
    from pytest_pafot.model.instructions import PositionInstruction  # noqa: PLC0415
    from pytest_pafot.model.scenario import Scenario  # noqa: PLC0415
    from pytest_pafot.model.trace import Outcome  # noqa: PLC0415
    from pytest_pafot.world import Highway  # noqa: PLC0415

    def simulate(scenario: Scenario, ads_factory: AdsFactory, world: WorldLike | None = None) -> Run:
        world = pafot_world if world is None else world
        end = ""
        with driving(world, ads_factory) as drive:
            try:
                run = drive(scenario)
            except ProcessLostError as lost:
                end = lost.advice
        if end:
            pytest.fail(end, pytrace=False)
        failure = ads_failure(run)
        if failure is not None:  # Such a run is short, and would pass most assertions that something did not happen.
            pytest.fail(ads_text(failure), pytrace=False)
        hypothesis = sys.modules.get("hypothesis")
        is_generated = hypothesis is not None and hypothesis.currently_in_test_context()  # one of many, which it tries
        if run.outcome is Outcome.INVALID and not is_generated:
            why = run.trace.users_error_text or "two NPCs or an NPC and a fixed object touched"
            what = "environment" if run.trace.ended else "scenario"
            warnings.warn(
                f"pafot_simulate: the run is invalid, because {why}; it ended there and says nothing about the ego. "
                f"Correct the {what}",
                pytest.PytestWarning,
                stacklevel=2,
            )
        return run

    # The first run imports highway-env, which takes about a second: hypothesis would call the test too slow.
    still = Scenario(npcs=((PositionInstruction(Cell.FRONT, 22.0),),))
    with isolating(lambda: False):
        simulate(still, lambda: lambda observation: (0.0, 0.0), Highway(duration=0.2))
    return simulate
