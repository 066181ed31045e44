"""A policy whose whole runs are made by itself, such as one of another revision, in a process of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import DrivesElsewhere


@dataclass(frozen=True, slots=True)
class StandIn(BaseWorld):
    """A stand-in for a world, whose runs are made in another way; it can do nothing else."""

    world: BaseWorld

    @property
    def hang_limit(self) -> float:
        """The limit of the world [s]."""
        return self.world.hang_limit

    @property
    def speed_limit(self) -> float:
        """The limit of the world [m/s]."""
        return self.world.speed_limit

    @property
    def longest_run(self) -> float:
        """The longest duration of a run in the world [s]."""
        return self.world.longest_run

    def to_dict(self) -> dict[str, Any]:
        """Return the world as plain data."""
        return self.world.to_dict()


@dataclass(frozen=True, slots=True)
class Elsewhere(StandIn):
    """A stand-in for a world, whose runs a policy makes by itself."""

    policy: DrivesElsewhere

    def rollout(self, scenario: Scenario, ads_factory: object) -> Trace:
        """Run a scenario with the policy."""
        return self.policy.driven("rollout", self.world, scenario)
