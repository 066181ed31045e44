"""The observations of a planner with an imperfect sight in one run, and the vehicle that an ADS does not see."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pytest_pafot.model.crossings import CrossingVehicle
from pytest_pafot.model.sight import Sight, SightWithout
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.observation import Observation, Sensor, VehicleState

OF_THE_ROAD = ("KinematicObservation", "OccupancyGridObservation", "TimeToCollisionObservation", "LidarObservation")
"""The observation classes of highway-env that are computed only from a road's vehicles,."""


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


def lane_nearest(centres: Sequence[float], y: float) -> int:
    """Return the lane whose centre is nearest to y [m]."""
    return min(range(len(centres)), key=lambda lane: abs(centres[lane] - y))


def with_others(
    seen: Observation,
    others: Sequence[VehicleState],
    ids: Sequence[int],
    lateral: Sequence[float],
    *,
    crossing: Sequence[CrossingVehicle] | None = None,
) -> Observation:
    """Return an observation with other vehicles; ``lateral`` are the lateral velocities, the ego's first [m/s].

    The vehicles that cross stay the same if they are not given.
    """
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
        crossing=seen.crossing if crossing is None else tuple(crossing),
    )


class HiddenVehicle:
    """A vehicle that a policy in a run does not see: the environment observes its road without it.

    Args:
        env: the run's environment, whose road has its vehicles.
        npc: index of the vehicle among all vehicles except the ego.

    Raises:
        WorldError: for an observation that is not computed only from the vehicles on the road.
    """

    def __init__(self, env: Any, npc: int) -> None:
        kinds = [each.__name__ for each in type(env.observation_type).__mro__]
        if not set(OF_THE_ROAD).intersection(kinds):
            expected = f"an observation of the vehicles on the road, one of {', '.join(OF_THE_ROAD)}"
            raise WorldError(field="config.observation", expected=expected, received=kinds[0])
        self._env, self._npc = env, npc

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Take the vehicle from the environment's road, for the duration of a ``with`` block."""
        road, ego = self._env.road, self._env.vehicle
        vehicles = road.vehicles
        others = [each for each in vehicles if each is not ego]
        del others[self._npc]
        road.vehicles = [ego, *others]
        try:
            yield
        finally:
            road.vehicles = vehicles

    def observe_through(self) -> None:
        """Hide it from the environment's observations, also after a reset has replaced its observation type."""
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


def hidden_from_policy(env: Any, sight: Sight | None) -> HiddenVehicle | None:
    """Return what hides an NPC from a policy of an environment; None if it sees all.

    Raises:
        AdsFactoryError: for an imperfect sight, which only planners in SI units can have.
    """
    if sight is not None and sight.imperfections:
        raise AdsFactoryError(
            "ads: expected a planner in SI units in a pafot.Perception, received a policy for the observations of an "
            "environment; give it a wrapper of your own that changes these observations"
        )
    return HiddenVehicle(env, sight.npc) if isinstance(sight, SightWithout) else None
