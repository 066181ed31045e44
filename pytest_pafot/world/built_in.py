"""What :class:`pytest_pafot.Highway` and :class:`pytest_pafot.World` share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Trace
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.ads import AdsFactory, check_drives_in
from pytest_pafot.world.engines.lock_step import SteppedRun, rollouts
from pytest_pafot.world.engines.selection import rollout_planner
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.protocol import FirstDecision, decision_asked
from pytest_pafot.world.reference_drivers import REFERENCES, TAKING_OVER, ReferenceDriver
from pytest_pafot.world.roads.junction import Junction
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.roads.straight import StraightRoad
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.validation import number_within

# What it takes to drive a recorded run again up to a tick, and to have a reference driver take over the ego there.

WATCHED = 6.0
"""For how long a driver has watched when it takes over [s]: long enough to have noticed whatever there is."""


class RecordedBody(Body):
    """The ego of a run, in the states that were recorded up to a tick, whatever its controls are; then it drives.

    What it did is recorded again to the bit, which decisions that are given again allow for planners only.
    """

    def __init__(self, trace: Trace, tick: int) -> None:
        super().__init__(*trace.sizes[0])
        self._rows = iter(trace.ego[1 : tick + 1].tolist())

    def step(self, dt: float) -> None:
        """Where it was at the next tick; from the last recorded one on, as any body."""
        row = next(self._rows, None)
        if row is None:
            super().step(dt)
            return
        self.place(*row[:4])
        self.acceleration, self.steering = row[4:6]


@dataclass(slots=True)
class Relief:
    """A reference driver that takes over at a time [s], having watched; before, what it returns has no effect."""

    driver: ReferenceDriver
    time: float

    def __call__(self, observation: Observation) -> tuple[float, float]:
        """Acceleration [m/s^2] and steering [rad]."""
        if observation.time >= self.time:
            return self.driver(observation)
        if observation.time >= self.time - WATCHED:
            self.driver.watch(observation)
        return 0.0, 0.0


BOUNDS = (("clearance", 0.0, 50.0), ("headway", 0.0, 10.0), ("hang_limit", 0.01, 86400.0))
"""Smallest and largest value of fields that both worlds have."""


class BuiltInWorld(ABC):
    """A world of this package: it has rules, and reference drivers can take the ego's place in it."""

    clearance: float
    headway: float
    limits: NpcLimits
    hang_limit: float
    engine: str = "auto"
    """What steps runs in SI units."""

    @property
    def observation_space(self) -> Any:
        """What a policy sees, as gymnasium describes it; None where that is a :class:`pytest_pafot.Observation`."""
        return None

    @property
    def action_space(self) -> Any:
        """What a policy decides, as gymnasium describes it; None where that is in SI units."""
        return None

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

    @abstractmethod
    def _begin(self, scenario: Scenario, guard: HangGuard, sight: Sight | None) -> SteppedRun:
        """A run that is given its decisions, by an ADS that may have a sight."""

    @property
    def has_lock_step(self) -> bool:
        """Whether runs can take place in lock step."""
        return True

    @property
    def longest_run(self) -> float:
        """How long a run lasts that nothing ends early [s]."""
        return self.rules.duration

    @property
    def crossings(self) -> Crossings | None:
        """The ways of other traffic that meet the ego's; None where there are none."""
        return self.rules.crossings

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

    def rollout_batch(self, scenarios: Sequence[Scenario], ads_factory: AdsFactory) -> list[Trace]:
        """Simulate scenarios in lock step, where this world has that and the ADS has ``batch``; else one by one.

        Args:
            scenarios: to run; checked against this world.
            ads_factory: gives the ADS; see :mod:`pytest_pafot.world.engines.lock_step` on what an ADS with ``batch``
                promises.

        Raises:
            ScenarioError: when a scenario does not fit this world.
            AdsFactoryError: when the factory gives nothing that can drive here, or ``batch`` not one action for
                each observation.
            WorldError: when the environment cannot be used.
            Exception: whatever the factory itself raises. What the ADS raises ends its run as ``ads_error``.
        """
        for scenario in scenarios:
            self.check_fits(scenario)
        check_drives_in(ads_factory, self)
        if not self.has_lock_step:
            return [self.rollout(scenario, ads_factory) for scenario in scenarios]
        return rollouts(scenarios, ads_factory, self._begin, self.rollout, self.hang_limit)

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
        return self._driven_by(_reference_driver(name), scenario)

    def take_over(self, trace: Trace, tick: int, name: str) -> Trace:
        """Simulate a run again in which a reference driver takes the ego over at a tick.

        Up to there the ego is in the states that the trace has, so that all others do what they did. The driver has
        watched for the last 6 s, and drives as in :meth:`rollout_reference`.

        Args:
            trace: of a run in this world.
            tick: of it, at which the driver decides for the first time.
            name: of :attr:`reference_drivers`, or ``steady-braking``.

        Raises:
            WorldError: for another name, a tick that the run does not have, or one with other ticks than this world's.
            ScenarioError: when its scenario does not fit this world.
        """
        if not 0 <= tick <= trace.ticks:
            raise WorldError(field="tick", expected=f"one of the run, 0 to {trace.ticks}", received=repr(tick))
        if trace.physics_hz != self.rules.physics_hz:
            expected = f"a run in this world, with {self.rules.physics_hz} ticks a second"
            raise WorldError(field="trace", expected=expected, received=f"one with {trace.physics_hz}")
        relief = Relief(_reference_driver(name, TAKING_OVER), tick / trace.physics_hz)
        return self._driven_by(relief, trace.executed, RecordedBody(trace, tick))

    def _driven_by(
        self, driver: Callable[[Observation], Any], scenario: Scenario, body: RecordedBody | None = None
    ) -> Trace:
        self.rules.check_fits(scenario)
        every_tick = replace(self.rules, ads_hz=self.rules.physics_hz)
        return rollout_planner(self, every_tick, scenario, driver, body=body)

    def first_decision(self, scenario: Scenario) -> FirstDecision | None:
        """What an ADS is given at its first decision in a scenario; None where the run does not come so far."""
        return decision_asked(self.rollout, scenario)

    def _check_fields(self) -> None:
        for name, low, high in BOUNDS:
            object.__setattr__(self, name, number_within(name, getattr(self, name), low, high))
        if not isinstance(self.limits, NpcLimits):
            raise WorldError(field="limits", expected="pafot.NpcLimits(...)", received=repr(self.limits))

    def _rules_on(
        self,
        road: StraightRoad | NetworkRoad,
        *,
        physics_hz: int,
        ads_hz: int,
        duration: float,
        junction: Junction | None = None,
    ) -> Rules:
        return Rules(
            road=road,
            physics_hz=physics_hz,
            ads_hz=ads_hz,
            duration=duration,
            clearance=self.clearance,
            headway=self.headway,
            limits=self.limits,
            hang_limit=self.hang_limit,
            junction=junction,
        )


def _reference_driver(name: str, known: Mapping[str, Callable[[], ReferenceDriver]] = REFERENCES) -> ReferenceDriver:
    if name not in known:
        raise WorldError(f"reference driver: expected one of {', '.join(known)}, received {name!r}")
    return known[name]()
