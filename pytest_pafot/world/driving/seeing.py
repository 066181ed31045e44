"""The observations of an ADS with an imperfect sight in one run, for planners and for policies of environments."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.observation import Observation, Sensor

OF_THE_ROAD = ("KinematicObservation", "OccupancyGridObservation", "TimeToCollisionObservation", "LidarObservation")
"""The observation classes of highway-env that are computed only from a road's vehicles, which copies can replace."""


@dataclass(frozen=True, eq=False)
class SeeingAds:
    """An ADS with an imperfect sight; a run passes to ``ads`` only what this sight lets it see."""

    ads: Any
    sight: Sight

    def __call__(self, *_: Any) -> Any:
        """Refuse a call, which only a world without support for sights makes."""
        raise WorldError(
            field="world",
            expected="pafot.Highway or pafot.World for an ADS in a pafot.Perception",
            received="a world that calls the ADS directly",
            fix="apply the imperfect sight in that world itself",
        )

    @property
    def pure(self) -> bool:
        """True if the ADS is pure and the sight has no memory, so decisions depend only on the current state."""
        return self.sight.is_memoryless and getattr(self.ads, "pure", False) is True

    @property
    def batch(self) -> Any:
        """The ADS's own ``batch``, which receives an imperfect observation for each run."""
        return self.ads.batch

    @property
    def close(self) -> Any:
        """The ADS's own ``close``."""
        return self.ads.close


class ImperfectSensor(Sensor):
    """The maker of imperfect observations on a straight road.

    Args:
        sensor: the maker of the exact observations, also of earlier ticks.
        sight: the imperfections.
        seed: the scenario's seed, from which all errors follow.
        lanes: the road's lanes, in which vehicles with position errors are put.
        physics_hz: ticks per second.
    """

    def __init__(self, sensor: Sensor, sight: Sight, seed: int, lanes: Lanes, physics_hz: int) -> None:
        super().__init__()
        self._sensor = sensor
        self._sight = sight
        self._seed = seed
        self._lanes = lanes
        self._delay = sight.delay(physics_hz)

    def observation(self, tick: int) -> Observation:
        """Make an imperfect observation from the exact observations now and at the time of measurement."""
        now, then = self._sensor.observation(tick), self._sensor.observation(max(0, tick - self._delay))
        others, ids, lateral = [], [], [now.lateral_velocities[0]]
        for glimpse in self._sight.glimpses(then.array, self._seed, tick):
            was = then.others[glimpse.other]
            x, y = was.x + glimpse.x, was.y + glimpse.y
            lane = self._lanes.closest(x, y, was.heading)
            others.append(was._replace(x=x, y=y, speed=was.speed + glimpse.speed, lane=lane))
            ids.append(then.ids[glimpse.other])
            lateral.append(then.lateral_velocities[glimpse.other + 1] + glimpse.speed * math.sin(was.heading))
        return with_others(now, others, ids, lateral)


def with_others(seen: Observation, others: list[Any], ids: list[int], lateral: list[float]) -> Observation:
    """Return an observation with other vehicles; ``lateral`` are the lateral velocities, the ego's first [m/s]."""
    return Observation(
        seen.time,
        seen.ego,
        tuple(others),
        seen.lanes,
        seen.lane_width,
        seen.speed_limit,
        decision_period=seen.decision_period,
        acceleration=seen.acceleration,
        steering=seen.steering,
        lateral_velocities=tuple(lateral),
        ids=tuple(ids),
        road_length=seen.road_length,
        crossing=seen.crossing,
    )


class PolicySight:
    """The sight of a policy in one run: the environment observes a road with the other vehicles as they are seen.

    Args:
        env: the run's environment, whose road has its vehicles.
        sight: the policy's sight.
        seed: the scenario's seed.

    Raises:
        WorldError: for an observation that is not computed only from the vehicles on the road.
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
        # All vehicles in the last ticks. The oldest entry is as old as the latency, or from the start.
        self._past: deque[list[Any]] = deque(maxlen=sight.delay(env.config["simulation_frequency"]))

    def note(self) -> None:
        """Store the states of all vehicles; called at each tick before they move."""
        if self._past.maxlen:
            self._past.append([_copied(each) for each in self._vehicles])

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Put the vehicles as the policy sees them on the environment's road, for the duration of a ``with`` block."""
        env, road = self._env, self._env.road
        vehicles = road.vehicles
        road.vehicles = [env.vehicle, *self._others(self._past[0] if self._past else self._vehicles)]
        try:
            yield
        finally:
            road.vehicles = vehicles

    def observe_through(self) -> None:
        """Make the environment's observations imperfect, also after a reset has replaced its observation type."""
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
        """Make the environment's observations exact again from its next reset on."""
        self._env.__dict__.pop("define_spaces", None)

    @property
    def _vehicles(self) -> list[Any]:
        """All vehicles, the ego first."""
        ego = self._env.vehicle
        return [ego, *(each for each in self._env.road.vehicles if each is not ego)]

    def _others(self, then: list[Any]) -> Iterator[Any]:
        network = self._env.road.network
        # The columns are those of pytest_pafot.VehicleState. The lane is not used.
        states = np.array([(*each.position, each.heading, each.speed, 0.0, each.LENGTH, each.WIDTH) for each in then])
        for glimpse in self._sight.glimpses(states, self._seed, self._env.steps):
            vehicle = _copied(then[glimpse.other + 1])
            vehicle.position = np.add(vehicle.position, (glimpse.x, glimpse.y))
            vehicle.speed += glimpse.speed
            vehicle.lane_index = network.get_closest_lane_index(vehicle.position, vehicle.heading)
            vehicle.lane = network.get_lane(vehicle.lane_index)
            yield vehicle


def policy_sight(env: Any, sight: Sight | None, scenario: Scenario) -> PolicySight | None:
    """Return the sight of a policy in a run in an environment; None for perfect sight."""
    return None if sight is None else PolicySight(env, sight, scenario.seed)


def _copied(vehicle: Any) -> Any:
    copied = copy.copy(vehicle)
    copied.position = np.array(vehicle.position)  # highway-env moves vehicles in place
    return copied
