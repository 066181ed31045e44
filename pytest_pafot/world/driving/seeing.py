"""What an ADS with an imperfect sight is shown in one run: a planner its observation, a policy its environment's."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.observation import Observation, Observer
from pytest_pafot.world.roads.straight import StraightRoad
from pytest_pafot.world.run_config import Rules

OF_THE_ROAD = ("KinematicObservation", "OccupancyGridObservation", "TimeToCollisionObservation", "LidarObservation")
"""highway-env's observations that are made of the vehicles of a road, and of nothing that they are copied to."""


@dataclass(frozen=True, eq=False)
class SeeingAds:
    """An ADS with the sight that an engine lends it, which shows ``ads`` what it sees."""

    ads: Any
    sight: Sight

    def __call__(self, *_: Any) -> Any:
        """Not for worlds that know nothing of sights."""
        raise WorldError(
            field="world",
            expected="pafot.Highway or pafot.World around an ADS in a pafot.Perception",
            received="a world that asks it itself",
            fix="have that world show what the ADS sees",
        )

    @property
    def pure(self) -> bool:
        """Whether it still decides by what is there alone."""
        return self.sight.is_memoryless and getattr(self.ads, "pure", False) is True

    @property
    def batch(self) -> Any:
        """The ADS's own, which is given what is seen in each run."""
        return self.ads.batch

    @property
    def close(self) -> Any:
        """The ADS's own."""
        return self.ads.close


@dataclass(frozen=True, slots=True)
class PlannerSight:
    """What a planner sees in one run.

    Attributes:
        seed: of the scenario.
        physics_hz: ticks per second.
        lanes: of the road; None where it is not straight, whose planner puts everybody on it.
    """

    sight: Sight
    seed: int
    physics_hz: int
    lanes: Lanes | None

    @property
    def delay(self) -> int:
        """The latency in ticks."""
        return self.sight.delay(self.physics_hz)

    def tick(self, now: Observation) -> int:
        """Of an observation."""
        return round(now.time * self.physics_hz)

    def asking(self, ads: Callable[[Observation], Any], observer: Observer) -> Callable[[Observation], Any]:
        """An ADS that is shown what is seen in a run whose record an observer has."""
        return lambda now: ads(self.recorded(now, observer))

    def recorded(self, now: Observation, observer: Observer) -> Observation:
        """What is seen now in a run whose record an observer has."""
        return self.seen(now, observer.observation(max(0, self.tick(now) - self.delay)))

    def seen(self, now: Observation, then: Observation) -> Observation:
        """What is seen now, by what was there when it was measured."""
        others, ids, lateral = [], [], [now.lateral_velocities[0]]
        for glimpse in self.sight.glimpses(then.array, self.seed, self.tick(now)):
            was = then.others[glimpse.other]
            x, y = was.x + glimpse.x, was.y + glimpse.y
            lane = was.lane if self.lanes is None else self.lanes.closest(x, y, was.heading)
            others.append(was._replace(x=x, y=y, speed=was.speed + glimpse.speed, lane=lane))
            ids.append(then.ids[glimpse.other])
            lateral.append(then.lateral_velocities[glimpse.other + 1] + glimpse.speed * math.sin(was.heading))
        return Observation(
            now.time,
            now.ego,
            tuple(others),
            now.lanes,
            now.lane_width,
            now.speed_limit,
            decision_period=now.decision_period,
            acceleration=now.acceleration,
            steering=now.steering,
            lateral_velocities=tuple(lateral),
            ids=tuple(ids),
            road_length=now.road_length,
        )


def planner_sight(sight: Sight | None, rules: Rules, scenario: Scenario) -> PlannerSight | None:
    """What a planner sees in a run; None where it sees all as it is."""
    if sight is None:
        return None
    lanes = rules.road.grid if isinstance(rules.road, StraightRoad) else None
    return PlannerSight(sight, scenario.seed, rules.physics_hz, lanes)


class PolicySight:
    """What a policy sees in one run: its environment observes a road on which the others stand where they are seen.

    Args:
        env: of the run, whose road has its vehicles.
        sight: of the policy.
        seed: of the scenario.

    Raises:
        WorldError: for an observation that is not made of the vehicles on the road alone.
    """

    def __init__(self, env: Any, sight: Sight, seed: int) -> None:
        kinds = [each.__name__ for each in type(env.observation_type).__mro__]
        if not set(OF_THE_ROAD).intersection(kinds):
            expected = "an observation of the vehicles on the road for a pafot.Perception, "
            expected += ", ".join(f'"{name}"' for name in OF_THE_ROAD[:-1]) + f' or "{OF_THE_ROAD[-1]}"'
            raise WorldError(field="config.observation", expected=expected, received=kinds[0])
        self._env = env
        self._sight = sight
        self._seed = seed
        # Everybody in the last ticks, the oldest as far back as the latency, or at the start.
        self._past: deque[list[Any]] = deque(maxlen=sight.delay(env.config["simulation_frequency"]))

    def note(self) -> None:
        """Remember where everybody is; called at each tick before they move."""
        if self._past.maxlen:
            self._past.append([_copied(each) for each in self._vehicles])

    @contextmanager
    def shown(self) -> Iterator[None]:
        """The road of the environment as the policy sees it."""
        env, road = self._env, self._env.road
        vehicles = road.vehicles
        road.vehicles = [env.vehicle, *self._others(self._past[0] if self._past else self._vehicles)]
        try:
            yield
        finally:
            road.vehicles = vehicles

    def observe_through(self) -> None:
        """Have the environment observe what is seen, also once a reset has made its observation anew."""
        env = self._env
        define_spaces, plain = env.define_spaces, env.observation_type.observe

        def observe() -> Any:
            with self.shown():
                return plain()

        def define_again() -> None:
            env.define_spaces = define_spaces
            define_spaces()
            self.observe_through()

        env.define_spaces, env.observation_type.observe = define_again, observe

    def close(self) -> None:
        """From its next reset on, the environment observes as ever."""
        self._env.__dict__.pop("define_spaces", None)

    @property
    def _vehicles(self) -> list[Any]:
        """Everybody, the ego first."""
        ego = self._env.vehicle
        return [ego, *(each for each in self._env.road.vehicles if each is not ego)]

    def _others(self, then: list[Any]) -> Iterator[Any]:
        network = self._env.road.network
        # Columns as in pytest_pafot.VehicleState; nobody looks at the lane.
        states = np.array([(*each.position, each.heading, each.speed, 0.0, each.LENGTH, each.WIDTH) for each in then])
        for glimpse in self._sight.glimpses(states, self._seed, self._env.steps):
            vehicle = _copied(then[glimpse.other + 1])
            vehicle.position = np.add(vehicle.position, (glimpse.x, glimpse.y))
            vehicle.speed += glimpse.speed
            vehicle.lane_index = network.get_closest_lane_index(vehicle.position, vehicle.heading)
            vehicle.lane = network.get_lane(vehicle.lane_index)
            yield vehicle


def policy_sight(env: Any, sight: Sight | None, scenario: Scenario) -> PolicySight | None:
    """What a policy sees in a run in an environment; None where it sees all as it is."""
    return None if sight is None else PolicySight(env, sight, scenario.seed)


def _copied(vehicle: Any) -> Any:
    copied = copy.copy(vehicle)
    copied.position = np.array(vehicle.position)  # highway-env moves vehicles in place
    return copied
