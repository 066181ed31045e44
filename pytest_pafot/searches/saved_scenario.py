"""Functions for scripts that use saved scenarios without pytest."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from pytest_pafot.corpus import reader
from pytest_pafot.corpus.reader import named_file
from pytest_pafot.findings.finding import Expect, Finding, is_same_event
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import CorpusError, command
from pytest_pafot.support.text import safe_repr, visible
from pytest_pafot.world import WorldError, codec
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import AdsFactory
from pytest_pafot.world.guard.chance import GENERATORS


def load(path: str | os.PathLike[str]) -> SavedScenario:
    """Load a saved scenario from its file. Nothing in the file is run as code.

    ``path`` can also be the id of a saved scenario below the current folder, or the name of its item.

    Raises:
        CorpusError: if the file has an error. The message names the line and the field, and how to fix it.
    """
    found = named_file(path) if isinstance(path, str) else Path(path)
    return SavedScenario(path=found, finding=reader.load(found))


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedScenario:
    """A saved scenario, loaded from its file.

    Attributes:
        path: the path of the file.
        finding: the content of the file, with attributes such as ``finding.test``.
    """

    path: Path
    finding: Finding

    @property
    def id(self) -> str:
        """The id of the finding."""
        return self.finding.id

    @property
    def scenario(self) -> Scenario:
        """The scenario in which the test fails."""
        return self.finding.scenario

    @property
    def expect(self) -> Expect:
        """The result that a run is expected to have until the failure is fixed."""
        return self.finding.expect

    @property
    def world(self) -> BaseWorld:
        """The world that the file describes.

        Raises:
            CorpusError: if the world is defined in code, or cannot be built on this machine.
        """
        if codec.is_code(self.finding.world):
            code = WorldError(
                field="world",
                expected="a world that a file can describe",
                received=safe_repr(dict(self.finding.world)),
                fix="because a file cannot contain code, pass the world itself with replay(ads, world=...) or --world",
            )
            raise reader.located(self.path, "world", code)
        try:
            return codec.world_of_file(self.finding.world, self.scenario)
        except (WorldError, TypeError, ValueError) as error:
            raise reader.located(self.path, "world", error) from None

    def check_fits(self, world: BaseWorld) -> None:
        """Raise a CorpusError if the scenario does not fit a world."""
        try:
            world.check_fits(self.scenario)
        except (ScenarioError, WorldError) as error:
            raise reader.located(self.path, "scenario", error) from error

    def replay(self, ads: AdsFactory, *, world: BaseWorld | None = None) -> Run:
        """Run the scenario once, without a verdict.

        Pass the run to the test function or to :meth:`matches`. The run ends with the scenario. For a longer run, pass
        the result of the world's method ``lasting``.

        Args:
            ads: the factory, or a highway-env vehicle class.
            world: a world to use instead of the file's world; required if the file's world is code.

        Raises:
            CorpusError: if the file's world cannot be built, the scenario does not fit the world, or a process died
                in this scenario.
            AdsFactoryError: if ``ads`` does not return an ADS.
            WorldError: if ``world`` is not a world.
        """
        if self.expect.is_crash:
            expected, received = (
                "a scenario that can run in this process",
                "one in which a process died",
            )
            fix = f"run `{command('pytest', self.path)}`, which replays it in a separate process"
            raise CorpusError(self.path, expected, received, fix, field="expect.failure")
        world = self.world if world is None else codec.checked_world(world)
        try:
            world.check_fits(self.scenario)
            # some simulators check the scenario only now
            trace = GENERATORS.run(world.rollout, self.scenario, ads)
        except (ScenarioError, WorldError) as error:
            raise reader.located(self.path, "scenario", error) from None
        return world.run_of(trace)

    def matches(self, run: Run) -> bool:
        """Return whether a run ends as the file expects, within 0.2 s.

        Raises:
            ValueError: if the file describes a failed check, because only the test function can measure it.
        """
        if self.expect.check is not None:
            raise ValueError(
                f"matches: expected a failure that is visible in the run, received a failure of the check "
                f"{self.expect.assertion!r}. Call the test function with the run instead"
            )
        return is_same_event(self.expect, run)

    def __repr__(self) -> str:
        event = f"{self.expect.failure}, {self.expect.outcome} at {self.expect.time:.1f} s"
        return visible(f"<SavedScenario {self.id}: {event}>")
