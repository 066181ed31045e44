"""A saved scenario outside of pytest: what its file says, and one run of it with an ADS."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_pafot.corpus import reader
from pytest_pafot.findings.finding import Expect, Finding
from pytest_pafot.findings.replay import is_same_event
from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import CorpusError
from pytest_pafot.support.shown import Shown
from pytest_pafot.support.text import visible
from pytest_pafot.world import WorldError, WorldLike, codec, protocol
from pytest_pafot.world.driving.ads import AdsFactory


def load(path: str | os.PathLike[str]) -> SavedScenario:
    """A saved scenario; nothing in its file is run as code.

    Raises:
        CorpusError: on any fault of the file, with its line, its field and the way out.
    """
    return SavedScenario(path=Path(path), finding=reader.load(path))


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedScenario(Shown):
    """What a corpus file holds.

    Attributes:
        path: of the file.
        finding: all that it says, such as ``finding.test``.
    """

    path: Path
    finding: Finding

    @property
    def id(self) -> str:
        """The name of the file."""
        return self.finding.id

    @property
    def scenario(self) -> Scenario:
        """That fails."""
        return self.finding.scenario

    @property
    def expect(self) -> Expect:
        """What running it shows while the failure is not fixed."""
        return self.finding.expect

    @property
    def world(self) -> WorldLike:
        """The world that the file describes.

        Raises:
            CorpusError: where that world is code, which no file holds, or cannot be made here.
        """
        if codec.is_code(self.finding.world):
            code = WorldError(
                field="world",
                expected="a world that is data",
                received=f"{dict(self.finding.world)!r:.100}",
                fix="a file holds no code: give the world itself, as in replay(ads, world=...)",
            )
            raise reader.located(self.path, "world", code)
        try:
            return codec.of_file(self.finding.world, self.scenario)
        except (WorldError, TypeError, ValueError) as error:
            raise reader.located(self.path, "world", error) from None

    def replay(self, ads: AdsFactory, *, world: Any = None) -> Run:
        """One run of the scenario; what it means, the test function says, and :meth:`matches`.

        Args:
            ads: the factory, or a highway-env vehicle class.
            world: in the place of the file's; needed where that is code.

        Raises:
            CorpusError: where the file's world cannot be made, or its scenario does not fit the world; and where a
                process died in it, as this one would.
            AdsFactoryError: for an ``ads`` that makes none.
        """
        if self.expect.is_crash:
            expected, received = "a scenario that leaves its process alive", "one in which a process died"
            fix = f"run `python -m pytest {self.path}`, which makes a process for it"
            raise CorpusError(self.path, expected, received, fix, field="expect.failure")
        if world is None:
            world = self.world
        try:
            protocol.check_fits(world, self.scenario)
            trace = world.rollout(self.scenario, ads)  # what a world of one's own finds wrong shows here
        except (ScenarioError, WorldError) as error:
            raise reader.located(self.path, "scenario", error) from None
        return Run(trace, world=protocol.reference_world(world), take_over=protocol.taking_over(world))

    def matches(self, run: Run) -> bool:
        """Whether a run shows what the file expects: the same contact, or the same other end, at its time to 0.2 s.

        Raises:
            ValueError: where a check failed, which only the test function can measure.
        """
        if self.expect.check is not None:
            raise ValueError(
                f"matches: expected a scenario whose run tells by itself, received one of the check "
                f"{self.expect.assertion!r}; call the test function with the run, which asserts it"
            )
        return is_same_event(self.expect, run)

    def __repr__(self) -> str:
        event = f"{self.expect.failure}, {self.expect.outcome} at {self.expect.time:.1f} s"
        return visible(f"<SavedScenario {self.id}: {event}>")
