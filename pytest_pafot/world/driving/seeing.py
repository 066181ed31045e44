"""The observations of an ADS with an imperfect sight in one run, for planners and for policies of environments."""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_pafot.model.crossings import CrossingVehicle
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import GHOST_LENGTH, GHOST_WIDTH, OwnErrors, Sight
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.observation import Observation, Sensor, VehicleState

OF_THE_ROAD = ("KinematicObservation", "OccupancyGridObservation", "TimeToCollisionObservation", "LidarObservation")
"""The observation classes of highway-env that are computed only from a road's vehicles, which copies can replace."""

OWN_STATE = ("position", "heading", "speed", "lane_index", "lane")
"""The attributes of an ego in highway-env that an error of its own state changes."""


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
        self._hz = physics_hz
        self._own = sight.own_errors(seed)

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
        seen, count = with_others(now, others, ids, lateral), len(then.others)
        return misjudged(seen, self._sight, self._own, self._seed, tick, self._hz, count, self.has_lane)


def misjudged(
    seen: Observation,
    sight: Sight,
    own: OwnErrors,
    seed: int,
    tick: int,
    hz: int,
    npcs: int,
    has_lane: Callable[[int], bool],
) -> Observation:
    """Return an observation with what a sight adds to that of the single vehicles: own errors, ghosts, and an order.

    Args:
        seen: the observation with the vehicles that are seen, and their errors.
        sight, seed: the imperfections, and the scenario's seed.
        own: the errors of the ego's own state in this run.
        tick, hz: the tick of the decision, and ticks per second.
        npcs: the number of NPCs, which is the id of the first ghost.
        has_lane: returns whether a lane exists at the ego's place; one that does not is never the ego's.
    """
    if not (sight.shuffled or sight.ghosts or sight.own_bias):
        return seen
    ego, crossing, centres = seen.ego, list(seen.crossing), seen.lane_centres
    others, ids, lateral = list(seen.others), list(seen.ids), list(seen.lateral_velocities)
    if sight.own_bias:
        states = [ego, *others]
        moved = [_moved(each, its, ego, own) for each, its in zip(states, lateral, strict=True)]
        lateral = [its for _, its in moved]
        ego, *others = [each._replace(lane=lane_nearest(centres, each.y)) for each, _ in moved]
        ego = ego._replace(lane=lane_nearest(centres, ego.y, has_lane))
        crossing = [_moved_across(each, seen.ego.heading, own) for each in crossing]
    for number, ahead, right, faster in sight.ghosts_at(seed, tick / hz):
        y, speed = ego.y + right, max(0.0, ego.speed + faster)
        lane = lane_nearest(centres, y)
        others.append(VehicleState(ego.x + ahead, y, 0.0, speed, lane, GHOST_LENGTH, GHOST_WIDTH))
        ids.append(npcs + number)
        lateral.append(0.0)
    order = sight.order(ids, seed, tick)
    return with_others(
        seen,
        [others[place] for place in order],
        [ids[place] for place in order],
        [lateral[0], *(lateral[place + 1] for place in order)],
        ego=ego,
        crossing=[crossing[place] for place in sight.order([each.id for each in crossing], seed, tick)],
    )


def lane_nearest(centres: Sequence[float], y: float, has_lane: Callable[[int], bool] = lambda _: True) -> int:
    """Return the lane whose centre is nearest to y [m], of those that exist; of all, if none exists."""
    lanes = range(len(centres))
    return min(list(filter(has_lane, lanes)) or lanes, key=lambda lane: abs(centres[lane] - y))


def _moved(state: VehicleState, lateral: float, ego: VehicleState, own: OwnErrors) -> tuple[VehicleState, float]:
    """Return where an ego that is wrong about its own state takes a vehicle to be, and its lateral velocity [m/s].

    Its sensors measure others relative to itself. So all of them are moved and turned with it, and gaps stay right.
    """
    cos, sin = math.cos(own.heading), math.sin(own.heading)
    dx, dy = state.x - ego.x, state.y - ego.y
    x, y = ego.x + own.x + dx * cos - dy * sin, ego.y + own.y + dx * sin + dy * cos
    heading, speed = state.heading + own.heading, state.speed + own.speed * math.cos(state.heading - ego.heading)
    lateral += speed * math.sin(heading) - state.speed * math.sin(state.heading)
    return state._replace(x=x, y=y, heading=heading, speed=speed), lateral


def _moved_across(crossing: CrossingVehicle, heading: float, own: OwnErrors) -> CrossingVehicle:
    """Return a crossing vehicle as :func:`_moved` moves it; ``heading`` is the ego's, relative to its way [rad].

    Its place and heading are relative to the ego's, so they stay. Its distance along its own way, which is taken to be
    straight, and the ego's distance are places on the map.
    """
    cos, sin = math.cos(own.heading), math.sin(own.heading)
    ahead = own.x * math.cos(heading) + own.y * math.sin(heading) + crossing.ahead * (cos - 1) - crossing.right * sin
    right = own.y * math.cos(heading) - own.x * math.sin(heading) + crossing.ahead * sin + crossing.right * (cos - 1)
    along = ahead * math.cos(crossing.heading) + right * math.sin(crossing.heading)
    return crossing._replace(
        distance=crossing.distance - along,
        ego_distance=crossing.ego_distance - own.x,
        speed=crossing.speed + own.speed * math.cos(crossing.heading),
    )


def with_others(
    seen: Observation,
    others: Sequence[VehicleState],
    ids: Sequence[int],
    lateral: Sequence[float],
    *,
    ego: VehicleState | None = None,
    crossing: Sequence[CrossingVehicle] | None = None,
) -> Observation:
    """Return an observation with other vehicles; ``lateral`` are the lateral velocities, the ego's first [m/s].

    The ego and the vehicles that cross stay the same if they are not given.
    """
    return Observation(
        seen.time,
        ego or seen.ego,
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
        self._own = sight.own_errors(seed)
        self._hz = env.config["simulation_frequency"]
        # All vehicles in the last ticks. The oldest entry is as old as the latency, or from the start.
        self._past: deque[list[Any]] = deque(maxlen=sight.delay(self._hz))

    def note(self) -> None:
        """Store the states of all vehicles; called at each tick before they move."""
        if self._past.maxlen:
            self._past.append([_copied(each) for each in self._vehicles])

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Put the vehicles as the policy sees them on the environment's road, for the duration of a ``with`` block."""
        road, ego = self._env.road, self._env.vehicle
        then, vehicles = self._past[0] if self._past else self._vehicles, road.vehicles
        is_biased = bool(self._sight.own_bias)
        others, exact = self._others(then), [getattr(ego, name) for name in OWN_STATE] if is_biased else []
        try:
            if is_biased:
                self._put(ego, _moved(_state(ego), 0.0, _state(ego), self._own)[0])
            others |= self._ghosts(len(then) - 1)
            ids = list(others)
            road.vehicles = [ego, *(others[ids[place]] for place in self._order(ids))]
            yield
        finally:
            road.vehicles = vehicles
            for name, value in zip(OWN_STATE, exact, strict=is_biased):
                setattr(ego, name, value)

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

    def _others(self, then: list[Any]) -> dict[int, Any]:
        """Return the other vehicles as they are seen, by index; ``then`` are all vehicles when they were measured."""
        sight, ego, others = self._sight, _state(self._env.vehicle), dict[int, Any]()
        # The columns are those of pytest_pafot.VehicleState. The lane is not used.
        states = np.array([_state(each) for each in then])
        for glimpse in sight.glimpses(states, self._seed, self._env.steps):
            vehicle = others[glimpse.other] = _copied(then[glimpse.other + 1])
            was = _state(vehicle)
            seen = was._replace(x=was.x + glimpse.x, y=was.y + glimpse.y, speed=was.speed + glimpse.speed)
            self._put(vehicle, _moved(seen, 0.0, ego, self._own)[0] if sight.own_bias else seen)
        return others

    def _ghosts(self, npcs: int) -> dict[int, Any]:
        """Return the ghosts by their ids: vehicles along the ego's lane, which is taken to continue at its ends."""
        env, ghosts = self._env, dict[int, Any]()
        for number, ahead, right, faster in self._sight.ghosts_at(self._seed, env.steps / self._hz):
            from pytest_pafot.world.stock import Vehicle  # noqa: PLC0415  (a second of imports)

            ego = env.vehicle
            along, across = ego.lane.local_coordinates(ego.position)
            position, heading = ego.lane.position(along + ahead, across + right), ego.lane.heading_at(along + ahead)
            ghosts[npcs + number] = Vehicle(env.road, position, heading, max(0.0, ego.speed + faster))
        return ghosts

    def _order(self, ids: list[int]) -> list[int]:
        return self._sight.order(ids, self._seed, self._env.steps)

    def _put(self, vehicle: Any, state: VehicleState) -> None:
        """Give a vehicle another place, heading and speed, and the lane that is closest there."""
        network = self._env.road.network
        vehicle.position, vehicle.heading, vehicle.speed = np.array(state[:2]), state.heading, state.speed
        vehicle.lane_index = network.get_closest_lane_index(vehicle.position, vehicle.heading)
        vehicle.lane = network.get_lane(vehicle.lane_index)


def _state(vehicle: Any) -> VehicleState:
    """Return the state of a vehicle of highway-env, in the world's coordinates and without its lane."""
    x, y = vehicle.position
    return VehicleState(x, y, vehicle.heading, vehicle.speed, 0, vehicle.LENGTH, vehicle.WIDTH)


def policy_sight(env: Any, sight: Sight | None, scenario: Scenario) -> PolicySight | None:
    """Return the sight of a policy in a run in an environment; None for perfect sight."""
    return None if sight is None else PolicySight(env, sight, scenario.seed)


def _copied(vehicle: Any) -> Any:
    copied = copy.copy(vehicle)
    copied.position = np.array(vehicle.position)  # highway-env moves vehicles in place
    return copied
