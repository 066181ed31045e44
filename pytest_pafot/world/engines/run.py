"""One run of a scenario: its vehicles at their starts, its loop, and the trace that it leaves."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from pytest_pafot.criticality.measures import RelativePositions
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import (
    HEADING,
    SPEED,
    STEERING,
    AdsError,
    Collision,
    FloatArray,
    Outcome,
    Trace,
)
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.policy import ads_and_sight, give_route, idm_model
from pytest_pafot.world.guard.hang_guard import UNFIT, HangGuard, error_of
from pytest_pafot.world.kernel.bodies import COLUMNS, Body, Box, depth, overlap, side_hit
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.loop import EgoDriver, Loop, ModelDriver, PlannerDriver
from pytest_pafot.world.plausible import Implausible, Plausibility
from pytest_pafot.world.roads.road import StraightRoad
from pytest_pafot.world.run_config import Rules, starts_of


class VehiclesOfRun:
    """The vehicles of one run at their starts, and the record of their states.

    Args:
        rules: the rules that all runs share; the scenario fits them.
        scenario: the scenario.
        ego: the ego, at its start in world coordinates.
        stock_road: returns the road as a road of highway-env, which not every run needs.

    Attributes:
        director: the director of the NPCs.
        vehicles: all vehicles in world coordinates, the ego first.
        places: where they are on the road.
        rows: seven numbers for each vehicle at each tick; see :data:`pytest_pafot.world.kernel.observation.COLUMNS`.
        loop: the loop, at tick 0.
        sizes: length and width of each vehicle [m].
        ended: what of the environment's own has ended the run, see :class:`pytest_pafot.model.trace.Trace`.
        has_failed: true if that raised an error, or moved a vehicle as none moves.
        plausibility: the check of what a user's code moves; None if it moves nothing.
    """

    ended = ""
    has_failed = False
    plausibility: Plausibility | None = None

    def __init__(self, rules: Rules, scenario: Scenario, ego: Body, stock_road: Callable[[], Any]) -> None:
        self.rules = rules
        self.scenario = scenario
        self.director = director = rules.director(scenario, ego.length)
        alongs, starts = starts_of(rules, scenario, director, ego.length)
        road, ticks = rules.road, rules.ticks(scenario)
        is_apart = not road.starts_at_origin
        npcs: list[Body] = [Body(npc.length, npc.width) if is_apart else npc for npc in director.npcs]
        for npc, start in zip(npcs, starts, strict=True):
            npc.place(*start)
        self.vehicles = [ego, *npcs]
        bodies = [Body(ego.length, ego.width), *director.npcs] if is_apart else self.vehicles
        self.places = road.places(self.vehicles, bodies, scenario, starts=alongs, ticks=ticks, stock_road=stock_road)
        self.places.obstacles = [Box(*each) for each in rules.obstacles]
        for each, box in zip(rules.obstacles, self.places.obstacles, strict=True):
            if overlap(ego, box):  # an ego that is longer than the rules know
                rules.refuse_start(scenario, each)
        self.sizes = [(each.length, each.width) for each in self.vehicles]
        # Not zeroed, which would take a fortieth of a run: the loop writes each row before anything reads it.
        self.rows: Any = np.empty((ticks + 1) * len(self.sizes) * COLUMNS).data
        self.loop = Loop(director, self.places, self.rows, 1 / rules.physics_hz)

    def close(self) -> None:
        """End the simulation, after the run, if there is one."""
        if self.loop.simulation is not None:
            self.loop.simulation.close()

    def trace(self, driver: EgoDriver, error: AdsError | None = None) -> Trace:
        """Return the trace up to the current tick, given the ego's driver and the ADS's error that ended the run."""
        loop, places, count = self.loop, self.places, len(self.sizes)
        has_touched = loop.ego_touched or loop.npcs_touched
        if self.plausibility is not None and self.plausibility.doubt and not has_touched:
            self.ended, self.has_failed, error = self.plausibility.doubt, True, None
        shape = (loop.tick + 1, count, COLUMNS)
        rows = np.frombuffer(self.rows, count=shape[0] * count * COLUMNS)
        # Read-only, and without a copy if the run has filled the whole buffer.
        states = (rows if rows.size == len(self.rows) else rows.copy()).reshape(shape)
        states.flags.writeable = False
        track = on_way = None
        ticks = len(self.rows) // (count * COLUMNS)
        if len(places.track):
            track = np.array(places.track).reshape(ticks, count, -1)[: shape[0]]
        if len(places.on_way):
            on_way = np.array(places.on_way).reshape(ticks, -1)[: shape[0]]
        off_road = states[:, 0, -1] < 0
        off_road_tick = int(off_road.argmax()) if off_road.any() else None
        outcome = Outcome.SAFE if off_road_tick is None else Outcome.OFF_ROAD
        if error is not None:
            outcome = Outcome.HANG if error.interrupted else Outcome.ADS_ERROR
        elif self.has_failed:
            outcome = Outcome.INVALID
        elif loop.is_over:
            touched = Outcome.COLLISION if loop.ego_touched else Outcome.INVALID
            outcome = touched if has_touched else places.left or outcome
        elif loop.tick == self.rules.step_limit:
            self.ended = f"max_episode_steps={loop.tick // self.rules.step_ticks}"
        return Trace(
            scenario=self.scenario,
            executed=self.director.executed,
            outcome=outcome,
            collision=self._collision(states, track) if outcome is Outcome.COLLISION else None,
            error=error,
            states=states,
            sizes=np.array(self.sizes),
            lanes=self.rules.road.lanes,
            physics_hz=self.rules.physics_hz,
            ads_hz=self.rules.ads_hz,
            actions=tuple(driver.actions),
            arrivals=self.director.arrivals,
            off_road_tick=off_road_tick,
            max_decision_seconds=driver.slowest,
            track=track,
            zones=self.rules.road.zones(self.scenario),
            on_way=on_way,
            driven=self.director.driven,
            obstacles=self.rules.obstacles,
            ego_vehicle=self.rules.ego,
            ended=self.ended,
        )

    def _collision(self, states: FloatArray, track: FloatArray | None) -> Collision:
        now = self._boxes(states[-1])
        touching = [index for index, npc in enumerate(now[1:]) if overlap(now[0], npc)]
        tick = self.loop.tick
        before, ego = self._boxes(states[max(tick - 1, 0)]), states[-1, 0]
        if not touching:
            speed, objects = float(ego[SPEED]), [each for each in self.places.obstacles if overlap(now[0], each)]
            return Collision(
                tick=tick,
                time=tick / self.rules.physics_hz,
                npc=None,
                side=side_hit(before[0], max(objects, key=lambda each: depth(now[0], each))),
                cell=None,
                ego_speed=speed,
                npc_speed=0.0,
                closing_speed=abs(speed),
            )
        npc = min(touching, key=lambda index: depth(now[0], now[index + 1]))
        other = states[-1, npc + 1]
        positions = RelativePositions(states, np.array(self.sizes), self.rules.road.lanes, track)
        both = states[-1, [0, npc + 1]]
        course = both[:, HEADING] + np.arctan(0.5 * np.tan(both[:, STEERING]))  # a vehicle with turned wheels slips
        velocity = both[:, SPEED] * np.array([np.cos(course), np.sin(course)])
        return Collision(
            tick=tick,
            time=tick / self.rules.physics_hz,
            npc=npc,
            side=side_hit(before[0], before[npc + 1]),
            cell=self._cell(npc, positions),
            ego_speed=float(ego[SPEED]),
            npc_speed=float(other[SPEED]),
            closing_speed=float(np.hypot(*(velocity[:, 0] - velocity[:, 1]))),
        )

    def _cell(self, npc: int, positions: RelativePositions) -> Cell | None:
        """Return the cell of an NPC that the ego has touched; None if the NPC was not on the ego's way."""
        if not positions.is_on_way[npc, -1]:
            return None
        cell = positions.last_cell(npc, self.loop.tick)
        crossings = self.scenario.crossings[: npc + 1]
        if cell is not None or (crossings and crossings[-1] is not None):
            return cell
        return self.director.first_cells()[npc - sum(each is not None for each in crossings)]

    def _boxes(self, row: FloatArray) -> list[Box]:
        poses = row[:, :3].tolist()
        return [Box(x, y, heading, *size) for (x, y, heading), size in zip(poses, self.sizes, strict=True)]

    def drive(self, driver: EgoDriver, guard: HangGuard, ends: OwnEnds | None = None) -> Trace:
        """Drive to the end of the run under the guard of the ADS's decisions, and return the trace.

        ``ends`` is what of the environment's own may end the run; None if nothing does.
        """
        ticks = self.rules.ticks(self.scenario)
        try:
            with guard:
                error = None
                try:
                    error = self.loop.run(driver, ticks) if ends is None else self._run_to_ends(driver, ticks, ends)
                except Implausible as fault:
                    self.ended, self.has_failed = str(fault), True
                return self.trace(driver, error)
        finally:
            self.close()

    def _run_to_ends(self, driver: EgoDriver, ticks: int, ends: OwnEnds) -> AdsError | None:
        """Run the loop, and ask the environment between its steps whether it ends the run.

        So the loop itself knows nothing of such ends, which most runs do not have.
        """
        loop = self.loop
        while loop.tick < ticks and not ends.ended:
            error = ends.step(lambda: loop.run(driver, min(loop.tick + ends.every, ticks)), loop)
            if error is not None or loop.is_over:
                return error
            if loop.tick < ticks:  # else it has lasted for its whole time
                self.ended, self.has_failed = ends.ended, ends.has_failed
        return None


class OwnEnds:
    """The methods by which an environment ends its episodes, asked after each of its steps in a run.

    They are asked at the ticks at which ``env.step`` asks them. The ``config["duration"]`` that they read is at least
    as long as the run, because the world decides its duration.

    Args:
        env: the environment of this run alone, with its road and vehicles.
        names: the names of the methods that may end the run.
        rules: the rules of the run.
        guard: the guard of the user's code.
        show: lets the vehicles of the environment be where those of the run are.

    Attributes:
        every: the number of ticks of a step of the environment.
        ended: the method that has ended the run, with its error if it failed; empty if none has.
        has_failed: true if the method raised an error.
        asked: the tick at which the methods were asked most recently; 0 before.
    """

    def __init__(
        self, env: Any, names: Sequence[str], rules: Rules, guard: HangGuard, show: Callable[[], None] | None = None
    ) -> None:
        self.every = rules.step_ticks
        self.ended, self.has_failed, self.asked = "", False, 0
        self._env, self._guard, self._show = env, guard, show
        self._methods = {name: getattr(env, name) for name in names}
        self._longest = max(rules.duration, rules.lasts or 0.0)
        self._hz = round(rules.physics_hz / self.every)
        self._time = 0.0

    def step(self, move: Callable[[], AdsError | None], loop: Loop) -> AdsError | None:
        """Drive the run by ``move`` for a step of the environment, and ask all methods; return an error of the ADS."""
        error = move()
        if error is None and not loop.is_over:
            self.ask(loop.tick)
        return error

    def ask(self, tick: int) -> None:
        """Ask all methods at a tick that ends a step."""
        self.asked = tick
        self._time += 1 / self._hz  # as highway-env does, with the same rounding
        if self._show is not None:
            self._show()
        self._env.steps, self._env.time = tick, self._time
        with _options(self._env.config, policy_frequency=self._hz):
            for name in self._methods:
                self.says(name)

    def says(self, name: str) -> bool:
        """Return whether a method says that the episode is over. An error that it raises ends the run, too."""
        method = _written(self._env, name, self._methods[name])
        config = self._env.config
        longest = {"duration": max(config["duration"], self._longest)} if "duration" in config else {}
        try:
            with self._guard.decision(), _options(config, **longest):
                is_over = bool(self._methods[name]())
        except UNFIT as error:
            self.ended, self.has_failed = f"{method} failed: {error_of(error, self.asked, self._guard).text}", True
            return True
        if is_over:
            self.ended = self.ended or method
        return is_over


def _written(env: Any, name: str, method: Any) -> str:
    """Return the name of a method as its author wrote it; with its module, if it is highway-env's own."""
    module = str(getattr(method, "__module__", ""))
    if module.startswith("highway_env."):
        return f"{module}.{method.__qualname__}"
    cls = next((each for each in type(env).__mro__ if name in vars(each)), type(env))
    return f"{type(env).__name__ if name in vars(env) else cls.__name__}.{name}"


@contextmanager
def _options(config: dict[str, Any], **given: Any) -> Iterator[None]:
    """Let options of a configuration have other values in this context, in place, because a method may count in it."""
    before = {name: config[name] for name in given}
    config.update(given)
    try:
        yield
    finally:
        config.update(before)


def planner_run(
    rules: Rules,
    scenario: Scenario,
    stock_road: Callable[[], Any],
    ads: Callable[[Any], Any],
    guard: HangGuard,
    *,
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> tuple[VehiclesOfRun, PlannerDriver]:
    """Begin a run of a planner in SI units, on any road.

    Args:
        rules, scenario: the world's rules, and a scenario that fits them.
        stock_road: returns the road as a road of highway-env, which not every run needs.
        ads: the planner.
        guard: the guard of its decisions.
        decisions: the first decisions of the run, which replace calls of the planner.
        body: the ego, in place of its usual body.
    """
    decides, sight = ads_and_sight(ads)
    ego = body or Body(rules.ego.length, rules.ego.width)
    ego.place(*rules.ego_position(scenario), rules.ego_speed(scenario))
    vehicles = VehiclesOfRun(rules, scenario, ego, stock_road)
    return vehicles, planner_driver(vehicles, decides, guard, sight, decisions)


def planner_driver(
    vehicles: VehiclesOfRun,
    ads: Callable[[Any], Any],
    guard: HangGuard,
    sight: Sight | None,
    decisions: Sequence[Any] = (),
    *,
    rules: Rules | None = None,
) -> PlannerDriver:
    """Return the driver of an ego for a planner in SI units; the arguments are those of :func:`planner_run`.

    ``sight`` is None for perfect sight. ``rules`` may have another rate of decisions than those of the run.
    """
    rules, scenario, road = rules or vehicles.rules, vehicles.scenario, vehicles.rules.road
    rates = rules.physics_hz, rules.every
    sensor = road.sensor(vehicles.places, vehicles.rows, scenario, rates, sight, rules.ego)
    common: dict[str, Any] = {"lanes": road.lane_count, "lane_width": road.lane_width}
    common |= {"every": rules.every, "dt": 1 / rules.physics_hz, "kind": rules.ego if rules.ego.has_limits else None}
    ego, place = vehicles.vehicles[0], vehicles.places.bodies[0]
    return PlannerDriver(ads, guard, decisions, ego, place, sensor, **common)


def vehicle_run(
    rules: Rules, scenario: Scenario, road: StraightRoad, network: Callable[[], Any], vehicle_class: Any
) -> Trace:
    """Drive a highway-env vehicle class, which drives itself, on a straight road that starts at the origin."""
    vehicle_class = built_as(rules.ego, vehicle_class)
    guard, start, model = HangGuard(rules.hang_limit), rules.ego_position(scenario), idm_model(vehicle_class)

    def stock_road() -> Any:
        from pytest_pafot.world.stock import Road  # noqa: PLC0415  (a second of imports)

        return Road(network(), np_random=rng_of(scenario.seed))

    if model is not None:
        ego = GoalVehicle(model.constants, road.grid, road.speed_limit)
        ego.start(*start, rules.ego_speed(scenario), model.changes_lanes)
        vehicles = VehiclesOfRun(rules, scenario, ego, stock_road)
        return vehicles.drive(ModelDriver(ego, vehicles.vehicles[1:]), guard)
    from pytest_pafot.world.driving.environment import ObjectDriver  # noqa: PLC0415  (a second of imports)

    on = stock_road()
    driver = ObjectDriver(vehicle_of(vehicle_class, on, start, rules.ego_speed(scenario), None), on, guard)
    vehicles = VehiclesOfRun(rules, scenario, driver.ego, lambda: on)
    driver.show(vehicles.places, road)
    return vehicles.drive(driver, guard)


def built_as(kind: VehicleType, vehicle_class: Any) -> Any:
    """Return a vehicle class of highway-env, or a ``functools.partial`` of one, as an ego that is a given vehicle.

    An ego that is a car, which is what a world has unless the user says otherwise, has the size of its class.

    Raises:
        WorldError: if the class has another size of its own.
    """
    if kind == CAR:
        return vehicle_class
    if isinstance(vehicle_class, functools.partial):
        made = built_as(kind, vehicle_class.func)
        return functools.partial(made, *vehicle_class.args, **vehicle_class.keywords)
    size, own = (kind.length, kind.width), (vehicle_class.LENGTH, vehicle_class.WIDTH)
    if own not in (size, (CAR.length, CAR.width)):
        name = vehicle_class.__name__
        expected = f"the size that {name} has itself, {own[0]:g} x {own[1]:g} m"
        fix = f"leave out ego= of the world, or LENGTH and WIDTH of {name}"
        raise WorldError(field="ego", expected=expected, received=kind.described, fix=fix)

    def clip_actions(self: Any) -> None:
        vehicle_class.clip_actions(self)
        wanted = self.action["acceleration"], self.action["steering"]
        self.action["acceleration"], self.action["steering"] = kind.limited(*wanted, self.speed)

    namespace: dict[str, Any] = {"LENGTH": size[0], "WIDTH": size[1], "__module__": vehicle_class.__module__}
    if kind.has_limits:  # else the kernel drives a class that only sets constants
        namespace["clip_actions"] = clip_actions
    return type(vehicle_class)(vehicle_class.__name__, (vehicle_class,), namespace)


def vehicle_of(
    vehicle_class: Any, road: Any, start: tuple[float, float, float], speed: float, route: Sequence[Any] | None
) -> Any:
    """Return a new ego on a road of highway-env at x [m], y [m], heading [rad] and speed [m/s].

    highway-env's own check of collisions is turned off, because this package tests for contact itself.
    """
    x, y, heading = start
    vehicle = vehicle_class(road, [x, y], heading, speed)
    vehicle.check_collisions = False
    give_route(vehicle, route)
    return vehicle
