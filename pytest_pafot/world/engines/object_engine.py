"""The engine that steps highway-env's objects directly, records every tick, and tests for contact after each."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations
from typing import Any, cast

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import AdsError, Outcome, Trace
from pytest_pafot.world.driving.ads import AskedDriver, EgoDriver, Planner, SelfDriving, is_vehicle_class
from pytest_pafot.world.driving.junction_director import JunctionDirector
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.road_planner import RoadPlanner
from pytest_pafot.world.driving.seeing import planner_sight
from pytest_pafot.world.driving.vehicles import Car, EgosRegulatedRoad
from pytest_pafot.world.engines.record import Record
from pytest_pafot.world.guard.failure import UNFIT, error_of
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.bodies import Body, Box, overlap
from pytest_pafot.world.kernel.crossing import CrossingNpc
from pytest_pafot.world.roads.junction import JunctionFrame
from pytest_pafot.world.roads.network import NetworkFrame, NetworkRoad, State, StraightFrame
from pytest_pafot.world.run_config import Rules, starts_of
from pytest_pafot.world.stock import RegulatedRoad, Road, RoadNetwork


def run(
    rules: Rules,
    scenario: Scenario,
    road: Road,
    make_ego: Callable[[tuple[float, float, float]], EgoDriver],
    decisions: Sequence[Any] = (),
) -> Trace:
    """Simulate one scenario; the arguments are those of :class:`ObjectRun`.

    ``decisions`` are the first decisions of the run and replace calls of the ADS. The driver must then be an
    :class:`AskedDriver`.
    """
    guard = HangGuard(rules.hang_limit)
    under_way = ObjectRun(rules, scenario, road, make_ego, guard)
    record, driver = under_way.traffic.record, under_way.traffic.driver
    for decision in decisions:
        if under_way.trace is None:
            record.actions.append(cast("AskedDriver", driver).apply(decision))
            under_way.go_on()
    with guard:
        while under_way.trace is None:
            under_way.go_on(decide(driver, record.tick, record, guard))
    return under_way.trace


def run_on(
    network: RoadNetwork,
    rules: Rules,
    scenario: Scenario,
    ads: Any,
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> Trace:
    """Simulate a scenario with a vehicle class or an ADS in SI units; ``body`` replaces the body of an ADS's car."""
    road = Road(network, np_random=np.random.default_rng(scenario.seed))
    if is_vehicle_class(ads):
        return run(rules, scenario, road, lambda start: SelfDriving(ads, road, start, scenario.ego_speed), decisions)
    ads, sight = ads_and_sight(ads)
    return run(rules, scenario, road, partial(_planner, rules, scenario, road, ads, sight, body), decisions)


def begin_planner(
    network: RoadNetwork, rules: Rules, scenario: Scenario, guard: HangGuard, sight: Sight | None
) -> ObjectRun:
    """Begin a run to which the caller passes decisions in SI units, for an ADS with the given sight."""
    road = Road(network, np_random=np.random.default_rng(scenario.seed))
    return ObjectRun(rules, scenario, road, partial(_planner, rules, scenario, road, None, sight, None), guard)


def _planner(
    rules: Rules,
    scenario: Scenario,
    road: Road,
    ads: Any,
    sight: Sight | None,
    body: Body | None,
    start: tuple[float, float, float],
) -> Planner:
    return planner_of(rules, scenario, road, ads, sight, Car(road, start[:2], start[2], scenario.ego_speed, body))


def planner_of(rules: Rules, scenario: Scenario, road: Road, ads: Any, sight: Sight | None, ego: Any) -> Planner:
    """Return the driver of an ego for an ADS in SI units, on any road."""
    seen = planner_sight(sight, rules, scenario)
    common = {"vehicle": ego, "physics_hz": rules.physics_hz, "every": rules.physics_hz // rules.ads_hz, "sight": seen}
    if isinstance(rules.road, NetworkRoad):
        far = rules.start_distance(scenario)
        starts = [rules.ego_start + row * far for row in (-1, 0, 1)]
        ways = rules.ways(scenario)
        return RoadPlanner(ads, road, rules.road, starts=starts, junction=rules.junction, ways=ways, **common)
    return Planner(ads, road, rules.road, **common)


class ObjectRun:
    """A run to which the caller passes decisions; see :class:`pytest_pafot.world.engines.lock_step.SteppedRun`.

    The road must be empty: the run adds all vehicles, the ego first. ``make_ego`` makes the ego's driver for its start
    (x [m], y [m], heading [rad]) before the NPCs exist.
    """

    def __init__(
        self,
        rules: Rules,
        scenario: Scenario,
        road: Road,
        make_ego: Callable[[tuple[float, float, float]], EgoDriver],
        guard: HangGuard,
    ) -> None:
        self.trace: Trace | None = None
        driver = make_ego(rules.ego_position(scenario))
        self.traffic = VehiclesOfRun(rules, scenario, driver, lambda *start: Car(road, start[:2], *start[2:]))
        road.vehicles = self.traffic.vehicles
        self._regulated = road if isinstance(road, EgosRegulatedRoad) else None
        self._guard = guard
        self._dt, self._last = 1 / rules.physics_hz, rules.ticks(scenario)

    def observe(self) -> Any:
        """Return the ADS's current observation."""
        return cast("AskedDriver", self.traffic.driver).observe(self.traffic.record.tick)

    def take(self, action: Any, seconds: float) -> None:
        """Apply a decision that took ``seconds``, and drive until the next decision or the end of the run."""
        record, error = self.traffic.record, None
        try:
            record.actions.append(cast("AskedDriver", self.traffic.driver).apply(action))
        except UNFIT as unfit:
            error = error_of(unfit, record.tick, self._guard)
        else:
            record.slowest = max(record.slowest, seconds)
        self.go_on(error)

    def go_on(self, error: AdsError | None = None) -> None:
        """Drive until the next decision; set ``trace`` if the run ends, as it does at once with an error of the ADS."""
        traffic, record, driver = self.traffic, self.traffic.record, self.traffic.driver
        for _ in range(min(driver.every, self._last - record.tick) if error is None else 0):
            driver.actuate()
            traffic.command()
            if self._regulated is not None:
                self._regulated.regulate(self._dt)
            error = step_ego(record.tick, self._guard, lambda: driver.vehicle.step(self._dt))
            if error is not None:
                break
            for npc in traffic.vehicles[1:]:
                npc.step(self._dt)
            self.trace = traffic.note()
            if self.trace is not None:
                return
        if error is not None or record.tick == self._last:
            self.trace = record.trace(error=error)


def decide(driver: EgoDriver, tick: int, record: Record, guard: HangGuard) -> AdsError | None:
    """Let the ADS decide within the guard's time limit, and return its error, or None."""
    started = guard.clock()
    try:
        try:
            guard.decision_starts()
            action = driver.decide(tick)
        finally:
            guard.decision_ends()  # before the exception is handled, which nothing may interrupt
    except UNFIT as error:
        return error_of(error, tick, guard)
    if action is not None:
        record.actions.append(action)
    record.slowest = max(record.slowest, guard.clock() - started)
    return None


def step_ego(tick: int, guard: HangGuard, step: Callable[[], Any]) -> AdsError | None:
    """Move an ego by its vehicle class, which may be the user's code, and return its error, or None."""
    try:
        step()
    except UNFIT as error:
        return error_of(error, tick, guard)
    return None


class VehiclesOfRun:
    """The highway-env vehicles of a run. They receive the director's controls, and the record receives their states.

    The driver's ego must already be at its start. ``make_npc`` makes a vehicle from x [m], y [m], heading [rad] and
    speed [m/s].
    """

    def __init__(
        self, rules: Rules, scenario: Scenario, driver: EgoDriver, make_npc: Callable[[float, float, float, float], Any]
    ) -> None:
        ego = driver.vehicle
        length = float(ego.LENGTH)
        self.driver = driver
        self._director = director = rules.director(scenario, length)
        places, starts = starts_of(rules, scenario, director, length)
        self._npcs = [make_npc(*start) for start in starts]
        if isinstance(rules.road, NetworkRoad) and isinstance(ego.road, RegulatedRoad):
            for vehicle, body in zip(self._npcs, director.npcs, strict=True):
                vehicle.predict_trajectory_constant_speed = _foresight(rules.road, body)
        self.vehicles = [ego, *self._npcs]  # in the order of the record
        self._by_floats = isinstance(ego, Car)
        self._bodies = [Body(length, float(ego.WIDTH)), *director.npcs]
        frame: NetworkFrame | None = None
        if (
            isinstance(director, JunctionDirector)
            and isinstance(rules.road, NetworkRoad)
            and rules.junction is not None
        ):
            ways = [None if each is None else each.zone for each in scenario.crossings]
            frame = JunctionFrame(rules.road, ego.road.network, places, rules.junction, ways)
        elif isinstance(rules.road, NetworkRoad):
            frame = NetworkFrame(rules.road, ego.road.network, places)
        self._frame = frame or StraightFrame(rules.straight)
        sizes, rows = [(body.length, body.width) for body in self._bodies], array("d")
        self._boxes = [Box(0.0, 0.0, 0.0, *size) for size in sizes]
        ego_box, *others = self._boxes
        self._pairs = [(ego_box, box, Outcome.COLLISION) for box in others]
        self._pairs += [(a, b, Outcome.INVALID) for a, b in combinations(others, 2)]
        self.record = Record(rules=rules, scenario=scenario, director=director, sizes=sizes, rows=rows, frame=frame)
        self._write(self._states(), [(0.0, 0.0)] * len(self.vehicles))

    def command(self) -> None:
        """Let the director set the NPCs' controls."""
        self._director.command(self._bodies[0])
        for vehicle, npc in zip(self._npcs, self._director.npcs, strict=True):
            vehicle.control(npc.acceleration, npc.steering)

    def note(self) -> Trace | None:
        """Record the state after a step, and return the trace if a contact or the end of the road ends the run."""
        self.record.tick += 1
        states = self._states()
        left = self._write(states, [self._controls(vehicle) for vehicle in self.vehicles])
        for box, (x, y, heading, _) in zip(self._boxes, states, strict=True):
            box.x, box.y, box.heading = x, y, heading
        for npc, other, ended in self._pairs:
            if overlap(npc, other):
                return self.record.trace(ended)
        return None if left is None else self.record.trace(left)

    def _states(self) -> list[State]:
        ego = self.driver.vehicle
        x, y = (ego.x, ego.y) if self._by_floats else map(float, ego.position)
        npcs = [(npc.x, npc.y, float(npc.heading), float(npc.speed)) for npc in self._npcs]
        return [(x, y, float(ego.heading), float(ego.speed)), *npcs]

    def _controls(self, vehicle: Any) -> tuple[float, float]:
        if vehicle is self.driver.vehicle and not self._by_floats:
            return float(vehicle.action["acceleration"]), float(vehicle.action["steering"])
        return float(vehicle.acceleration), float(vehicle.steering)

    def _write(self, states: Sequence[State], controls: Sequence[tuple[float, float]]) -> Outcome | None:
        """Record all vehicles, update the director's bodies, and return the outcome if the run leaves the road."""
        lanes, left = self._frame.see(states, self._bodies)
        rows: list[float] = []
        for state, own, lane in zip(states, controls, lanes, strict=True):
            rows += (*state, *own, lane)
        self.record.rows.extend(array("d", rows))  # extending by a list takes several times as long
        return left


def _foresight(road: NetworkRoad, body: Body) -> Callable[[Any], tuple[list[Any], list[float]]]:
    """Return a prediction for highway-env's regulated road: an NPC continues along its way or lane at its speed.

    highway-env predicts its own vehicles along their routes. An NPC has no such route, so highway-env would assume that
    it keeps its steering angle.
    """

    def foresight(times: Any) -> tuple[list[Any], list[float]]:
        places = [body.x + body.speed * float(time) for time in times]
        if isinstance(body, CrossingNpc):
            poses = [body.track.pose(along) for along in places]
        else:
            poses = [road.position(along, body.lane) for along in places]
        return [np.array(pose[:2]) for pose in poses], [pose[2] for pose in poses]

    return foresight
