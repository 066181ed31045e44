"""What :class:`pytest_pafot.Highway` and :class:`pytest_pafot.World` share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Outcome, Trace
from pytest_pafot.world.driving.ads import AdsFactory
from pytest_pafot.world.engines.selection import rollout_planner
from pytest_pafot.world.errors import WorldError
from pytest_pafot.world.first_decision import FirstDecision, first_decision
from pytest_pafot.world.reference_drivers import REFERENCES
from pytest_pafot.world.run_config import Rules


class BuiltInWorld(ABC):
    """A world of this package: it has rules, and reference drivers can take the ego's place in it."""

    engine: str = "auto"
    """What steps runs in SI units."""

    @property
    @abstractmethod
    def rules(self) -> Rules:
        """What all runs have in common."""

    @property
    @abstractmethod
    def network(self) -> Any:
        """The road as highway-env has it."""

    @abstractmethod
    def rollout(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario with a fresh ADS."""

    @property
    def longest_run(self) -> float:
        """How long a run lasts that nothing ends early [s]."""
        return self.rules.duration

    @property
    def reference_drivers(self) -> tuple[str, ...]:
        """Names of the reference drivers (:mod:`pytest_pafot.world.reference_drivers`)."""
        return tuple(REFERENCES)

    def check_fits(self, scenario: Scenario) -> None:
        """Check a scenario against this world.

        Raises:
            ScenarioError: naming the field that does not fit.
            WorldError: when the environment cannot be used.
        """
        self.rules.check_fits(scenario)

    def rollout_reference(self, scenario: Scenario, name: str) -> Trace:
        """Simulate a scenario with a reference driver in the ego's place.

        It drives in SI units on this road, decides at every physics tick, and has no foresight.

        Args:
            scenario: to run; checked against this world.
            name: of :attr:`reference_drivers`.

        Raises:
            WorldError: for another name.
            ScenarioError: when the scenario does not fit this world.
        """
        if name not in REFERENCES:
            raise WorldError(f"reference driver: expected one of {', '.join(REFERENCES)}, received {name!r}")
        self.rules.check_fits(scenario)
        every_tick = replace(self.rules, ads_hz=self.rules.physics_hz)
        return rollout_planner(self, every_tick, scenario, REFERENCES[name]())

    def preventable_by(self, scenario: Scenario) -> tuple[str, ...]:
        """Names of the reference drivers that survive a scenario, whoever is to blame for a collision."""
        return tuple(
            name for name in REFERENCES if self.rollout_reference(scenario, name).outcome is not Outcome.COLLISION
        )

    def first_decision(self, scenario: Scenario) -> FirstDecision | None:
        """What an ADS is given at its first decision in a scenario; None where the run does not come so far."""
        return first_decision(self.rollout, scenario)
