"""A run of a scenario, with its rules, its vehicles, its loop and its trace."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from pytest_pafot.model.instructions import Cell, ScenarioError
from pytest_pafot.model.scenario import Scenario
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
    road_of_run,
    vehicle_name,
)
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.policy import give_route
from pytest_pafot.world.guard.hang_guard import UNFIT, HangGuard, error_of
from pytest_pafot.world.kernel.crossing import JunctionDirector
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.kernel.lanes import COLUMNS, Body, Box, depth, overlap, side_hit
from pytest_pafot.world.kernel.loop import EgoDriver, Loop, PlannerDriver
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.road import Pose, Road

# The smallest and largest accepted rates: physics ticks, and decisions per second.
PHYSICS_HZ = (5, 1000)
ADS_HZ = (1, 1000)
# The largest accepted number of ticks in a run. With 8 NPCs, the record takes about 0.5 KB per tick.
MOST_TICKS = 400_000
# The end of error messages for users whose simulator is not highway-env.
OTHER_KIND = 'a pafot.Simulator, and use it in a pafot.SimulatorWorld (see the page "A simulator of your own")'

# The state of a vehicle: x [m], y [m], heading [rad] and speed [m/s].
State = tuple[float, float, float, float]
# A fixed object: x [m], y [m], heading [rad], length [m] and width [m].
FixedObject = tuple[float, float, float, float, float]

# The largest change in speed [m/s^2], three times the hardest braking of a car.
CHANGE = 30.0
# The distance [m] that a vehicle may move in a tick beyond what its speeds allow.
SLACK = 0.5
# An additional change in speed in a tick [m/s]. In the longest possible tick, 0.2 s, it amounts to half a metre.
SPEED_SLACK = 2.5
# A vehicle that reports more than 2 m/s for 0.5 s must move by more than 0.1 m; at 2 m/s it would move 1 m.
STILL = 0.5
MOVING = 2.0
SHIFT = 0.1


def plain_data(name: str, value: Any) -> Any:
    """Copy data, with tuples and numpy arrays replaced by lists, so that a corpus file can contain it."""
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise WorldError(
                    field=name,
                    expected="strings as keys",
                    received=repr(key),
                )
        return {key: plain_data(f"{name}.{key}", item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_data(f"{name}[{index}]", item) for index, item in enumerate(value)]
    if type(value).__module__ == "numpy" and hasattr(value, "tolist"):
        return plain_data(name, value.tolist())
    is_nan = isinstance(value, float) and math.isnan(value)
    if value is None or (isinstance(value, (int, float, str)) and not is_nan):
        return value
    raise WorldError(
        field=name,
        expected="JSON-compatible data",
        received=repr(value),
        fix="use numbers, strings, lists and mappings, which a corpus file can contain",
    )


def check_ticks(duration: float, physics_hz: float) -> None:
    """Reject a duration [s] with more than ``MOST_TICKS`` ticks, because the record would need too much memory."""
    if duration * physics_hz > MOST_TICKS:
        raise WorldError(
            field="duration",
            expected=f"at most {int(MOST_TICKS / physics_hz)} s at {physics_hz:.6g} ticks per second",
            received=f"{duration:g}",
        )


def check_divides(physics_name: str, physics_hz: int, ads_name: str, ads_hz: int) -> None:
    """Reject two rates, each given with its name, if a decision does not last a whole number of ticks."""
    if physics_hz % ads_hz == 0:
        return
    divisors = [str(n) for n in range(1, physics_hz + 1) if physics_hz % n == 0]
    expected = f"a divisor of {physics_name} ({physics_hz}), so that every decision lasts a whole number of ticks"
    fix = f"use one of {', '.join(divisors)}"
    higher = math.ceil(physics_hz / ads_hz) * ads_hz
    if higher <= PHYSICS_HZ[1]:
        fix += f", or set {physics_name} to {higher}"
    raise WorldError(
        field=ads_name,
        expected=expected,
        received=str(ads_hz),
        fix=fix,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """The settings that all runs in a world share, and the start positions of vehicles."""

    road: Road
    # Ticks and decisions per second.
    physics_hz: float
    ads_hz: float
    # The longest duration of a run [s].
    duration: float
    # The gap between the ego and the cells ahead of and behind it [m].
    clearance: float
    # The time gap at which NPCs start ahead of or behind the ego [s].
    headway: float
    limits: NpcLimits
    # The wall-clock time after which a decision is interrupted [s].
    hang_limit: float
    ego: VehicleType
    obstacles: tuple[FixedObject, ...]
    # The duration of each run [s], or None if the scenario and `duration` determine it.
    lasts: float | None = None
    # Decisions of the policy per second, if a reference driver changes `ads_hz`.
    policy_hz: float | None = None
    # Methods of the environment that may end a run (`OwnEnds`); None if only the duration ends it.
    ends: tuple[str, ...] | None = None
    # True if a step of the environment or a wrapper may also end a run (`EpisodeEnds`).
    ends_in_steps: bool = False
    # The number of ticks after which the environment's step limit ends a run.
    step_limit: int | None = None

    @property
    def step_ticks(self) -> int:
        # A step of the environment lasts as long as a decision of the policy, even if a reference driver drives.
        return round(self.physics_hz / (self.policy_hz or self.ads_hz))

    @property
    def every(self) -> int:
        return round(self.physics_hz / self.ads_hz)

    @property
    def ego_start(self) -> float:
        """The ego's position [m] along the road at the start."""
        return self.road.ego_start(self.headway, self.clearance)

    def ego_position(self, scenario: Scenario) -> Pose:
        """Return the ego's world x [m], y [m] and heading [rad] at tick 0."""
        return self.road.position(self.ego_start, scenario.ego_lane, self.ego)

    def ego_speed(self, scenario: Scenario) -> float:
        # NPCs that start as fast as the ego use this speed, too. It is at most the ego's top speed [m/s].
        return min(scenario.ego_speed, self.ego.top_speed)

    def start_distance(self, scenario: Scenario, ego_length: float) -> float:
        # The distance between the centres of the ego and of cars that start ahead of or behind it [m].
        gap = max(self.headway * scenario.ego_speed, self.clearance)
        return float(ego_length + CAR.length) / 2 + gap

    def start_cells(self, scenario: Scenario, ego_length: float) -> frozenset[Cell]:
        return self.road.start_cells(scenario.ego_lane, self.start_distance(scenario, ego_length))

    def director(self, scenario: Scenario, ego_length: float) -> Director | JunctionDirector:
        """Return the director that controls the NPCs of one run, for an ego of the given length [m]."""
        return self.road.director(
            scenario,
            self.limits,
            self.start_cells(scenario, ego_length),
            clearance=self.clearance,
            ego_length=ego_length,
            physics_hz=self.physics_hz,
        )

    def object_at_start(self, lane: int, speed: float) -> tuple[float, ...] | None:
        """Return a fixed object at the ego's start, or within the headway if the ego can start anywhere."""
        gap = 0.0
        if self.road.prescribed is None:
            gap = max(self.headway * speed, self.clearance)
        x, y, heading = self.road.position(self.ego_start, lane)
        # The box reaches from the ego's rear to the end of the gap.
        x += gap / 2 * math.cos(heading)
        y += gap / 2 * math.sin(heading)
        place = Box(x, y, heading, self.ego.length + gap, self.ego.width)
        return next((each for each in self.obstacles if overlap(place, Box(*each))), None)

    def refuse_start(self, scenario: Scenario, near: tuple[float, ...]) -> NoReturn:
        """Raise an error for a scenario in which the ego starts at a fixed object, or too close to it to stop."""
        road = self.road
        own_lane = scenario.ego_lane
        speed = scenario.ego_speed
        x, y, _ = road.position(self.ego_start, own_lane)
        where = f"the ego's start at ({x:.0f}, {y:.0f}) m"
        expected = f"a lane without a fixed object at {where}"
        fix = "move the environment's objects"
        if road.prescribed is None:
            expected = (
                f"a lane without fixed objects for {self.headway:g} s at {speed:g} m/s from {where}"
            )
            for lane in road.start_lanes:
                if lane != own_lane and self.object_at_start(lane, speed) is None:
                    fix = f"write ego_lane={lane}"
                    break
        raise ScenarioError(
            field="ego_lane",
            expected=expected,
            received=f"lane {own_lane}, which has an object at ({near[0]:.1f}, {near[1]:.1f}) m",
            fix=fix,
        )

    def ticks(self, scenario: Scenario) -> int:
        """Return the number of ticks of a run that does not end early."""
        seconds = self.lasts
        if seconds is None:
            seconds = min(self.duration, scenario.seconds)
        ticks = int(seconds * self.physics_hz + 1e-9)  # rounding must not lose a tick
        if self.step_limit is None:
            return ticks
        return min(ticks, self.step_limit)


def starts_of(
    rules: Rules, scenario: Scenario, director: Director | JunctionDirector, ego_length: float
) -> tuple[list[float], list[State]]:
    """Return the positions [m] of all vehicles along their paths at the start, ego first, and the NPCs' states."""
    road = rules.road
    ego_start = rules.ego_start
    apart = rules.start_distance(scenario, ego_length)
    kinds = [
        kind
        for chain, kind in zip(scenario.npcs, scenario.all_vehicles, strict=True)
        if not chain[0].crosses
    ]
    starts = []
    for cell, kind in zip(director.first_cells(), kinds, strict=True):
        lane = scenario.ego_lane + cell.column
        along = ego_start + cell.row * (apart + (kind.length - CAR.length) / 2)
        if kind.length > CAR.length and not road.has_lane(lane, along):
            # Where the lane ends, there is room only for a car.
            along = ego_start + cell.row * apart
        pose = road.position(along, lane, kind)
        wanted = min(rules.ego_speed(scenario), kind.top_speed)
        speed = road.start_speed(wanted, lane, along, kind)
        starts.append((along, (*pose, speed)))
    starts = director.started(starts)
    alongs = [along for along, _ in starts]
    return [ego_start, *alongs], [start for _, start in starts]


class Implausible(Exception):  # noqa: N818  (it ends a run, and is no error of the package)
    """An impossible motion of a vehicle in a user's simulator or environment.

    The run ends at the previous tick and is invalid.
    """


class Plausibility:
    """A check that a user's code moves a run's vehicles only as real vehicles can move."""

    def __init__(self, states: Sequence[Sequence[float]], dt: float) -> None:
        self._dt = dt
        self._change = CHANGE * dt + SPEED_SLACK
        self._slack = SLACK + CHANGE * dt * dt / 2
        self._before = self._states = states
        self._tick = 0
        # when and where each vehicle last moved or was slow
        self._seen = [(x, y, 0) for x, y, *_ in states]
        # An impossible change in speed in the last tick. A user's code may stop vehicles suddenly in a collision, which
        # ends the run in that tick. So the change is an error only if there is a next tick.
        self.doubt = ""

    def check(
        self, states: Sequence[Sequence[float]], method: str, accelerations: Sequence[float] = ()
    ) -> None:
        """Check the states that the user's ``method`` has set for the next tick.

        Raises:
            Implausible: if a vehicle has moved in an impossible way.
        """
        self._tick = tick = self._tick + 1
        if self.doubt:
            raise Implausible(self.doubt)
        # Distances are measured between positions, so the bend of a lane does not matter.
        dt, seen, slack, change = self._dt, self._seen, self._slack, self._change
        for number, ((x, y, _, speed), (old_x, old_y, _, old)) in enumerate(
            zip(states, self._states, strict=True)
        ):
            moved = math.hypot(x - old_x, y - old_y)
            if not moved <= abs(old) * dt + slack:
                # It can move as far as its new speed allows, if that is no jump. It can also slide as far as in the
                # previous tick, if its speed is only the component along its heading.
                most = max(abs(old), min(abs(speed), abs(old) + change)) * dt
                x_before, y_before, *_ = self._before[number]
                if not moved <= max(most, math.hypot(old_x - x_before, old_y - y_before)) + slack:
                    what = f"moved {moved:.1f} m in a tick, but its stated speed allows only {most:.1f} m"
                    raise Implausible(f"{method}, tick {tick}: {vehicle_name(number)} {what}")
            # A user's controller may request more than a vehicle can do. Then `accelerations` [m/s^2] explain the
            # change.
            is_jump = not -change <= speed - old <= change and not self.doubt
            if is_jump and (
                not accelerations or abs(old + accelerations[number] * dt - speed) > 1e-6
            ):
                what = f"changed its stated speed from {old:.1f} to {speed:.1f} m/s in a tick"
                self.doubt = f"{method}, tick {tick}: {vehicle_name(number)} {what}"
            # A vehicle must not stay in one position while it reports a speed.
            at_x, at_y, since = seen[number]
            if moved > SHIFT or abs(speed) <= MOVING or math.hypot(x - at_x, y - at_y) > SHIFT:
                seen[number] = x, y, tick
            elif (tick - since) * dt >= STILL - 1e-9:
                what = f"did not move for {(tick - since) * dt:.1f} s at a stated speed of {speed:.1f} m/s"
                raise Implausible(f"{method}, tick {tick}: {vehicle_name(number)} {what}")
        self._before, self._states = self._states, states


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
        self.rules = rules
        self.scenario = scenario
        self.director = director = rules.director(scenario, ego.length)
        alongs, starts = starts_of(rules, scenario, director, ego.length)
        road = rules.road
        ticks = rules.ticks(scenario)
        # The director knows where NPCs start. On a road that does not start at the origin, it moves NPCs in coordinates
        # of the road, and a second body of each NPC has world coordinates.
        npcs: list[Body] = [*director.npcs]
        if not road.starts_at_origin:
            npcs = [Body(npc.length, npc.width) for npc in director.npcs]
        for npc, start in zip(npcs, starts, strict=True):
            npc.place(*start)
        self.vehicles = [ego, *npcs]
        # `places` maps vehicles to the road. Its obstacles must not overlap with the ego.
        bodies = self.vehicles
        if not road.starts_at_origin:
            bodies = [Body(ego.length, ego.width), *director.npcs]
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
        loop = self.loop
        rules = self.rules
        places = self.places
        director = self.director
        has_touched = loop.ego_touched or loop.npcs_touched
        # A jump in speed in the last tick is an error of the user's code, unless a collision explains it.
        if self.plausibility is not None and self.plausibility.doubt and not has_touched:
            self.ended = self.plausibility.doubt
            self.has_failed = True
            error = None
        states = self._rows_until(loop.tick)
        off_road_tick = None
        off_road = states[:, 0, -1] < 0
        if off_road.any():
            off_road_tick = int(off_road.argmax())
        outcome = self._outcome(error, off_road_tick)
        ticks = len(self.rows) // (len(self.sizes) * COLUMNS)
        track = on_way = collision = None
        if len(places.track):
            track = np.array(places.track).reshape(ticks, len(self.sizes), -1)[: len(states)]
        if len(places.on_way):
            on_way = np.array(places.on_way).reshape(ticks, -1)[: len(states)]
        if outcome is Outcome.COLLISION:
            collision = self._collision(states, track)
        return Trace(
            scenario=self.scenario,
            executed=director.executed,
            outcome=outcome,
            collision=collision,
            error=error,
            states=states,
            sizes=np.array(self.sizes),
            lanes=rules.road.lanes,
            physics_hz=rules.physics_hz,
            ads_hz=rules.ads_hz,
            actions=tuple(driver.actions),
            arrivals=director.arrivals,
            off_road_tick=off_road_tick,
            max_decision_seconds=driver.slowest,
            track=track,
            zones=rules.road.zones(self.scenario),
            on_way=on_way,
            driven=director.driven_cells,
            obstacles=rules.obstacles,
            ego_vehicle=rules.ego,
            ended=self.ended,
        )

    def _rows_until(self, tick: int) -> FloatArray:
        """Return the states up to a tick, read-only, and without a copy if the run has filled the whole buffer."""
        shape = (tick + 1, len(self.sizes), COLUMNS)
        rows = np.frombuffer(self.rows, count=math.prod(shape))
        if rows.size < len(self.rows):
            rows = rows.copy()
        states = rows.reshape(shape)
        states.flags.writeable = False
        return states

    def _outcome(self, error: AdsError | None, off_road_tick: int | None) -> Outcome:
        # Errors have priority over events that end the loop, which have priority over leaving the road.
        loop = self.loop
        if error is not None and error.interrupted:
            return Outcome.HANG
        if error is not None:
            return Outcome.ADS_ERROR
        if self.has_failed:
            return Outcome.INVALID
        if loop.is_over:
            if loop.ego_touched:
                return Outcome.COLLISION
            if loop.npcs_touched:
                return Outcome.INVALID
            if self.places.left:
                return self.places.left
        elif loop.tick == self.rules.step_limit:
            self.ended = f"max_episode_steps={loop.tick // self.rules.step_ticks}"
        if off_road_tick is None:
            return Outcome.COMPLETED
        return Outcome.OFF_ROAD

    def _collision(self, states: FloatArray, track: FloatArray | None) -> Collision:
        tick = self.loop.tick
        now = self._boxes(states[-1])
        # The positions before the impact determine the side.
        before = self._boxes(states[max(tick - 1, 0)])
        ego_speed = float(states[-1, 0, SPEED])
        touching = [index for index, npc in enumerate(now[1:]) if overlap(now[0], npc)]
        npc = cell = None
        npc_speed = 0.0
        if touching:
            npc = min(touching, key=lambda index: depth(now[0], now[index + 1]))
            hit = before[npc + 1]
            cell = self._cell(npc, states, track)
            both = states[-1, [0, npc + 1]]
            npc_speed = float(both[1, SPEED])
            # a vehicle with turned wheels slips
            course = both[:, HEADING] + np.arctan(0.5 * np.tan(both[:, STEERING]))
            velocity = both[:, SPEED] * np.array([np.cos(course), np.sin(course)])
            closing_speed = float(np.hypot(*(velocity[:, 0] - velocity[:, 1])))
        else:
            # The ego has hit a fixed object. Take the object with the largest overlap.
            objects = [each for each in self.places.obstacles if overlap(now[0], each)]
            hit = max(objects, key=lambda each: depth(now[0], each))
            closing_speed = abs(ego_speed)
        return Collision(
            tick=tick,
            time=tick / self.rules.physics_hz,
            npc=npc,
            side=side_hit(before[0], hit),
            cell=cell,
            ego_speed=ego_speed,
            npc_speed=npc_speed,
            closing_speed=closing_speed,
        )

    def _cell(self, npc: int, states: FloatArray, track: FloatArray | None) -> Cell | None:
        """Return the cell of an NPC at the impact, or None for an NPC that was not on the ego's path."""
        road = road_of_run(states, self.rules.road.lanes, track)
        if not road.is_on_way[npc, -1]:
            return None
        cell = road.last_cell(npc, self.loop.tick, self.sizes[0][0])
        crossings = self.scenario.crossings[: npc + 1]
        if cell is not None or (crossings and crossings[-1] is not None):
            return cell
        crossing = [each for each in crossings if each is not None]
        return self.director.first_cells()[npc - len(crossing)]

    def _boxes(self, row: FloatArray) -> list[Box]:
        poses = row[:, :3].tolist()
        return [
            Box(x, y, heading, *size)
            for (x, y, heading), size in zip(poses, self.sizes, strict=True)
        ]

    def drive(self, driver: EgoDriver, guard: HangGuard, ends: OwnEnds | None = None) -> Trace:
        """Run to the end under the guard, and return the trace. ``ends`` can end the run early."""
        error = None
        try:
            with guard:
                try:
                    error = self._run(driver, ends)
                except Implausible as fault:
                    self.ended = str(fault)
                    self.has_failed = True
                return self.trace(driver, error)
        finally:
            self.close()

    def _run(self, driver: EgoDriver, ends: OwnEnds | None) -> AdsError | None:
        loop = self.loop
        ticks = self.rules.ticks(self.scenario)
        if ends is None:
            return loop.run(driver, ticks)
        # The loop itself does not know the environment's ends, because most runs have none.
        while loop.tick < ticks and not ends.ended:
            error = ends.step(lambda: loop.run(driver, min(loop.tick + ends.every, ticks)), loop)
            if error is not None or loop.is_over:
                return error
            if loop.tick < ticks:  # else the run has its full duration
                self.ended = ends.ended
                self.has_failed = ends.has_failed
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
        self.ended = ""
        self.has_failed = False
        self.asked = 0
        self._env = env
        self._guard = guard
        self._show = show
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
        self._env.steps = tick
        self._env.time = self._time
        with _options(self._env.config, policy_frequency=self._hz):
            for name in self._methods:
                self.says(name)

    def says(self, name: str) -> bool:
        # If the method raises an error, this also ends the run.
        method = _method_name(self._env, name, self._methods[name])
        config = self._env.config
        longest = {}
        if "duration" in config:
            longest["duration"] = max(config["duration"], self._longest)
        try:
            with self._guard.decision(), _options(config, **longest):
                is_over = bool(self._methods[name]())
        except UNFIT as error:
            failure = error_of(error, self.asked, self._guard)
            self.ended = f"{method} failed: {failure.text}"
            self.has_failed = True
            return True
        if is_over and not self.ended:
            self.ended = method
        return is_over


def _method_name(env: Any, name: str, method: Any) -> str:
    """Return the name of a method for messages, with the module name for a method of highway-env."""
    module = str(getattr(method, "__module__", ""))
    if module.startswith("highway_env."):
        return f"{module}.{method.__qualname__}"
    owner = type(env)
    if name not in vars(env):
        owner = next((each for each in owner.__mro__ if name in vars(each)), owner)
    return f"{owner.__name__}.{name}"


@contextmanager
def _options(config: dict[str, Any], **given: Any) -> Iterator[None]:
    # Changed in place, because a method may keep a counter in the configuration.
    before = {name: config[name] for name in given}
    config.update(given)
    try:
        yield
    finally:
        config.update(before)


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
    rules = rules or vehicles.rules
    road = rules.road
    rates = rules.physics_hz, rules.every
    sensor = road.sensor(vehicles.places, vehicles.rows, vehicles.scenario, rates, sight, rules.ego)
    kind = None
    if rules.ego.has_limits:
        kind = rules.ego
    return PlannerDriver(
        ads,
        guard,
        decisions,
        vehicles.vehicles[0],
        vehicles.places.bodies[0],
        sensor,
        lanes=road.lane_count,
        lane_width=road.lane_width,
        every=rules.every,
        dt=1 / rules.physics_hz,
        kind=kind,
    )


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
    length, width = vehicle_class.LENGTH, vehicle_class.WIDTH
    if (length, width) not in ((kind.length, kind.width), (CAR.length, CAR.width)):
        name = vehicle_class.__name__
        raise WorldError(
            field="ego",
            expected=f"a vehicle with the size of {name}, {length:g} x {width:g} m",
            received=kind.described,
            fix=f"omit ego= in the world, or remove LENGTH and WIDTH from {name}",
        )

    def clip_actions(self: Any) -> None:
        vehicle_class.clip_actions(self)
        action = self.action
        action["acceleration"], action["steering"] = kind.limited(
            action["acceleration"], action["steering"], self.speed
        )

    namespace: dict[str, Any] = {
        "LENGTH": kind.length,
        "WIDTH": kind.width,
        "__module__": vehicle_class.__module__,
    }
    if kind.has_limits:  # without limits, the class only sets constants, so the kernel can drive it
        namespace["clip_actions"] = clip_actions
    return type(vehicle_class)(vehicle_class.__name__, (vehicle_class,), namespace)


def make_ego(
    rules: Rules,
    scenario: Scenario,
    vehicle_class: Any,
    road: Any,
    route: Sequence[Any] | None = None,
) -> Any:
    """Create the ego of a run on a highway-env road."""
    x, y, heading = rules.ego_position(scenario)
    vehicle = vehicle_class(road, [x, y], heading, rules.ego_speed(scenario))
    vehicle.check_collisions = False
    give_route(vehicle, route)
    return vehicle
