"""A run of a scenario, with its vehicles, its loop and its trace."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

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
    RoadOfRun,
    Trace,
    road_of_run,
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
    """The vehicles of one run, with the ego first, and the record of their states.

    ``stock_road`` returns the road as a highway-env road. It is called only by runs that need this road.
    """

    # The part of the environment that has ended the run; see `Trace.ended`.
    ended = ""
    # True if that part raised an error, or moved a vehicle in an impossible way.
    has_failed = False
    # Checks the vehicles that a user's code moves; None if there is no such code.
    plausibility: Plausibility | None = None

    def __init__(
        self, rules: Rules, scenario: Scenario, ego: Body, stock_road: Callable[[], Any]
    ) -> None:
        # The director knows where NPCs start. On a road that does not start at the origin, it moves NPCs in coordinates
        # of the road, and a second body of each NPC has world coordinates.
        self.rules = rules
        self.scenario = scenario
        self.director = director = rules.director(scenario, ego.length)
        alongs, starts = starts_of(rules, scenario, director, ego.length)
        road, ticks = rules.road, rules.ticks(scenario)
        is_apart = not road.starts_at_origin
        npcs: list[Body] = [
            Body(npc.length, npc.width) if is_apart else npc for npc in director.npcs
        ]
        for npc, start in zip(npcs, starts, strict=True):
            npc.place(*start)
        self.vehicles = [ego, *npcs]
        # `places` maps vehicles to the road. Its obstacles must not overlap with the ego.
        bodies = [Body(ego.length, ego.width), *director.npcs] if is_apart else self.vehicles
        self.places = road.places(
            self.vehicles, bodies, scenario, starts=alongs, ticks=ticks, stock_road=stock_road
        )
        self.places.obstacles = [Box(*each) for each in rules.obstacles]
        for each, box in zip(rules.obstacles, self.places.obstacles, strict=True):
            if overlap(ego, box):  # the ego is longer than in the rules
                rules.refuse_start(scenario, each)
        self.sizes = [(each.length, each.width) for each in self.vehicles]  # [m]
        # Not zeroed, because that would take a fortieth of a run, and the loop writes each row before it is read.
        self.rows: Any = np.empty((ticks + 1) * len(self.sizes) * COLUMNS).data
        self.loop = Loop(director, self.places, self.rows, 1 / rules.physics_hz)

    def close(self) -> None:
        if self.loop.simulation is not None:
            self.loop.simulation.close()

    def trace(self, driver: EgoDriver, error: AdsError | None = None) -> Trace:
        """Return the trace up to the current tick. ``error`` is the policy's error that ended the run, if any."""
        loop, places, count = self.loop, self.places, len(self.sizes)
        has_touched = loop.ego_touched or loop.npcs_touched
        # A jump in speed in the last tick is an error of the user's code, unless a collision explains it.
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
        # The outcome: errors have priority over events that end the loop, which have priority over leaving the road.
        off_road = states[:, 0, -1] < 0
        off_road_tick = int(off_road.argmax()) if off_road.any() else None
        outcome = Outcome.COMPLETED if off_road_tick is None else Outcome.OFF_ROAD
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
            driven=self.director.driven_cells,
            obstacles=self.rules.obstacles,
            ego_vehicle=self.rules.ego,
            ended=self.ended,
        )

    def _collision(self, states: FloatArray, track: FloatArray | None) -> Collision:
        now = self._boxes(states[-1])
        touching = [index for index, npc in enumerate(now[1:]) if overlap(now[0], npc)]
        tick = self.loop.tick
        # The positions before the impact determine the side.
        before, ego = self._boxes(states[max(tick - 1, 0)]), states[-1, 0]
        if not touching:
            # The ego has hit a fixed object. Take the object with the largest overlap.
            speed, objects = (
                float(ego[SPEED]),
                [each for each in self.places.obstacles if overlap(now[0], each)],
            )
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
        road = road_of_run(states, self.rules.road.lanes, track)
        both = states[-1, [0, npc + 1]]
        # a vehicle with turned wheels slips
        course = both[:, HEADING] + np.arctan(0.5 * np.tan(both[:, STEERING]))
        velocity = both[:, SPEED] * np.array([np.cos(course), np.sin(course)])
        return Collision(
            tick=tick,
            time=tick / self.rules.physics_hz,
            npc=npc,
            side=side_hit(before[0], before[npc + 1]),
            cell=self._cell(npc, road),
            ego_speed=float(ego[SPEED]),
            npc_speed=float(other[SPEED]),
            closing_speed=float(np.hypot(*(velocity[:, 0] - velocity[:, 1]))),
        )

    def _cell(self, npc: int, road: RoadOfRun) -> Cell | None:
        # None for an NPC that was not on the ego's path.
        if not road.is_on_way[npc, -1]:
            return None
        cell = road.last_cell(npc, self.loop.tick, self.sizes[0][0])
        crossings = self.scenario.crossings[: npc + 1]
        if cell is not None or (crossings and crossings[-1] is not None):
            return cell
        return self.director.first_cells()[npc - sum(each is not None for each in crossings)]

    def _boxes(self, row: FloatArray) -> list[Box]:
        poses = row[:, :3].tolist()
        return [
            Box(x, y, heading, *size)
            for (x, y, heading), size in zip(poses, self.sizes, strict=True)
        ]

    def drive(self, driver: EgoDriver, guard: HangGuard, ends: OwnEnds | None = None) -> Trace:
        """Run to the end under the guard, and return the trace. ``ends`` can end the run early."""
        ticks = self.rules.ticks(self.scenario)
        try:
            with guard:
                error = None
                try:
                    error = (
                        self.loop.run(driver, ticks)
                        if ends is None
                        else self._run_to_ends(driver, ticks, ends)
                    )
                except Implausible as fault:
                    self.ended, self.has_failed = str(fault), True
                return self.trace(driver, error)
        finally:
            self.close()

    def _run_to_ends(self, driver: EgoDriver, ticks: int, ends: OwnEnds) -> AdsError | None:
        # The loop itself does not know the environment's ends, because most runs have none.
        loop = self.loop
        while loop.tick < ticks and not ends.ended:
            error = ends.step(lambda: loop.run(driver, min(loop.tick + ends.every, ticks)), loop)
            if error is not None or loop.is_over:
                return error
            if loop.tick < ticks:  # else the run has its full duration
                self.ended, self.has_failed = ends.ended, ends.has_failed
        return None


class OwnEnds:
    """The methods with which an environment ends episodes, called after each step of a run.

    ``show`` updates the vehicles of the environment to the state of the run.
    """

    def __init__(
        self,
        env: Any,
        names: Sequence[str],
        rules: Rules,
        guard: HangGuard,
        show: Callable[[], None] | None = None,
    ) -> None:
        self.every = rules.step_ticks  # the ticks of a step of the environment
        # The method that has ended the run (with its error), whether it raised one, and the tick of the last calls.
        self.ended, self.has_failed, self.asked = "", False, 0
        self._env, self._guard, self._show = env, guard, show
        self._methods = {name: getattr(env, name) for name in names}
        # The world decides the duration, so the methods see a `config["duration"]` that is at least as long.
        self._longest = max(rules.duration, rules.lasts or 0.0)
        self._hz = round(rules.physics_hz / self.every)
        self._time = 0.0

    def step(self, move: Callable[[], AdsError | None], loop: Loop) -> AdsError | None:
        """Run a step of the environment with ``move``, call all methods, and return the policy's error or None."""
        error = move()
        if error is None and not loop.is_over:
            self.ask(loop.tick)
        return error

    def ask(self, tick: int) -> None:
        self.asked = tick
        self._time += 1 / self._hz  # as highway-env does, with the same rounding
        if self._show is not None:
            self._show()
        self._env.steps, self._env.time = tick, self._time
        with _options(self._env.config, policy_frequency=self._hz):
            for name in self._methods:
                self.says(name)

    def says(self, name: str) -> bool:
        # If the method raises an error, this also ends the run.
        method = _method_name(self._env, name, self._methods[name])
        config = self._env.config
        longest = (
            {"duration": max(config["duration"], self._longest)} if "duration" in config else {}
        )
        try:
            with self._guard.decision(), _options(config, **longest):
                is_over = bool(self._methods[name]())
        except UNFIT as error:
            self.ended, self.has_failed = (
                f"{method} failed: {error_of(error, self.asked, self._guard).text}",
                True,
            )
            return True
        if is_over:
            self.ended = self.ended or method
        return is_over


def _method_name(env: Any, name: str, method: Any) -> str:
    """Return the name of a method for messages, with the module name for a method of highway-env."""
    module = str(getattr(method, "__module__", ""))
    if module.startswith("highway_env."):
        return f"{module}.{method.__qualname__}"
    cls = next((each for each in type(env).__mro__ if name in vars(each)), type(env))
    return f"{type(env).__name__ if name in vars(env) else cls.__name__}.{name}"


@contextmanager
def _options(config: dict[str, Any], **given: Any) -> Iterator[None]:
    # Changed in place, because a method may keep a counter in the configuration.
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
    """Set up a run of a planner in SI units.

    ``decisions`` replace the first calls of the planner. ``body`` is the ego's body, or None for a default one.
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
    """Return the driver that lets a planner in SI units control the ego.

    ``sight`` is None for perfect perception. ``rules`` can have a different decision rate than the run's rules.
    """
    rules, scenario, road = rules or vehicles.rules, vehicles.scenario, vehicles.rules.road
    rates = rules.physics_hz, rules.every
    sensor = road.sensor(vehicles.places, vehicles.rows, scenario, rates, sight, rules.ego)
    common: dict[str, Any] = {"lanes": road.lane_count, "lane_width": road.lane_width}
    common |= {
        "every": rules.every,
        "dt": 1 / rules.physics_hz,
        "kind": rules.ego if rules.ego.has_limits else None,
    }
    ego, place = vehicles.vehicles[0], vehicles.places.bodies[0]
    return PlannerDriver(ads, guard, decisions, ego, place, sensor, **common)


def vehicle_run(
    rules: Rules,
    scenario: Scenario,
    road: StraightRoad,
    network: Callable[[], Any],
    vehicle_class: Any,
) -> Trace:
    """Run a highway-env vehicle class on a straight road that starts at the origin."""
    vehicle_class = built_as(rules.ego, vehicle_class)
    guard, start, model = (
        HangGuard(rules.hang_limit),
        rules.ego_position(scenario),
        idm_model(vehicle_class),
    )

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
    driver = ObjectDriver(
        vehicle_of(vehicle_class, on, start, rules.ego_speed(scenario), None), on, guard
    )
    vehicles = VehiclesOfRun(rules, scenario, driver.ego, lambda: on)
    driver.show(vehicles.places, road)
    return vehicles.drive(driver, guard)


def built_as(kind: VehicleType, vehicle_class: Any) -> Any:
    """Return a highway-env vehicle class, or a ``functools.partial`` of one, with a vehicle type's properties.

    The type ``car`` does not change the class.

    Raises:
        WorldError: if the class sets a size that is not the type's.
    """
    if kind == CAR:
        return vehicle_class
    if isinstance(vehicle_class, functools.partial):
        made = built_as(kind, vehicle_class.func)
        return functools.partial(made, *vehicle_class.args, **vehicle_class.keywords)
    size, own = (kind.length, kind.width), (vehicle_class.LENGTH, vehicle_class.WIDTH)
    if own not in (size, (CAR.length, CAR.width)):
        name = vehicle_class.__name__
        expected = f"a vehicle with the size of {name}, {own[0]:g} x {own[1]:g} m"
        fix = f"omit ego= in the world, or remove LENGTH and WIDTH from {name}"
        raise WorldError(field="ego", expected=expected, received=kind.described, fix=fix)

    def clip_actions(self: Any) -> None:
        vehicle_class.clip_actions(self)
        wanted = self.action["acceleration"], self.action["steering"]
        self.action["acceleration"], self.action["steering"] = kind.limited(*wanted, self.speed)

    namespace: dict[str, Any] = {
        "LENGTH": size[0],
        "WIDTH": size[1],
        "__module__": vehicle_class.__module__,
    }
    if kind.has_limits:  # without limits, the class only sets constants, so the kernel can drive it
        namespace["clip_actions"] = clip_actions
    return type(vehicle_class)(vehicle_class.__name__, (vehicle_class,), namespace)


def vehicle_of(
    vehicle_class: Any,
    road: Any,
    start: tuple[float, float, float],
    speed: float,
    route: Sequence[Any] | None,
) -> Any:
    """Create an ego on a highway-env road at x [m], y [m], heading [rad] and speed [m/s]."""
    x, y, heading = start
    vehicle = vehicle_class(road, [x, y], heading, speed)
    vehicle.check_collisions = False
    give_route(vehicle, route)
    return vehicle
