"""One run: highway-env's objects stepped directly, every tick recorded, contact tested after each."""

from __future__ import annotations

import time
import traceback
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle

from pytest_pafot.grid import Cell, cell_at
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import HEADING, LANE, SPEED, AdsError, Collision, FloatArray, Outcome, Trace, X, Y
from pytest_pafot.world import checks
from pytest_pafot.world import guard as guard_module
from pytest_pafot.world.ads import BadAction, EgoDriver, one_line
from pytest_pafot.world.contact import Box, overlap, separation, side_hit
from pytest_pafot.world.director import Director, Pose
from pytest_pafot.world.guard import AdsHang, HangGuard
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.road import StraightRoad
from pytest_pafot.world.vehicles import Car


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """What all runs of a world have in common.

    Attributes:
        road: on which all drive.
        physics_hz, ads_hz: ticks and decisions per second.
        duration: of a run, at most [s].
        clearance: gap between the ego and the cells ahead and behind [m].
        headway: of NPCs that start ahead or behind [s].
        limits: of the NPCs.
        hang_limit: longest decision of the ADS in wall-clock time [s].
    """

    road: StraightRoad
    physics_hz: int
    ads_hz: int
    duration: float
    clearance: float
    headway: float
    limits: NpcLimits
    hang_limit: float

    @property
    def ego_start(self) -> float:
        """Where along the road the ego starts [m]."""
        return checks.ego_start(self.headway, self.clearance)

    def director(self, scenario: Scenario, ego_length: float, npc_class: type[Vehicle]) -> Director:
        """Who drives the NPCs of one run, vehicles of a class, around an ego of a length [m]."""
        return Director(
            scenario,
            self.road,
            self.limits,
            clearance=self.clearance,
            ego_length=ego_length,
            length=npc_class.LENGTH,
            width=npc_class.WIDTH,
            physics_hz=self.physics_hz,
        )

    def ticks(self, scenario: Scenario) -> int:
        """Physics steps of a run that nothing ends early."""
        return int(min(self.duration, scenario.genes * scenario.gene_seconds) * self.physics_hz + 1e-9)


def start_positions(
    rules: Rules, scenario: Scenario, cells: tuple[Cell, ...], ego_length: float = Car.LENGTH
) -> list[tuple[float, float, float]]:
    """World x [m], y [m], heading [rad] of the ego and of each NPC at tick 0.

    NPCs of cells 4 and 8 start beside the ego, all others in their cell's lane at the headway ahead or behind,
    so that danger is created by driving and never present at the start.
    """
    lane, speed = scenario.ego_lane, scenario.ego_speed
    far = (ego_length + Car.LENGTH) / 2 + max(rules.headway * speed, rules.clearance)
    beside = [rules.road.position(rules.ego_start + cell.row * far, lane + cell.column) for cell in cells]
    return [rules.road.position(rules.ego_start, lane), *beside]


def run(
    rules: Rules,
    scenario: Scenario,
    road: Road,
    make_ego: Callable[[tuple[float, float, float]], EgoDriver],
    clock: Callable[[], float] = time.perf_counter,
) -> Trace:
    """Simulate one scenario.

    Args:
        rules: of the world.
        scenario: checked against the world.
        road: fresh, without vehicles; they are added with the ego first.
        make_ego: from the ego's start to its driver; called before the NPCs exist.
        clock: seconds; only for the duration of decisions.
    """
    driver = make_ego(rules.road.position(rules.ego_start, scenario.ego_lane))
    ego_length = float(driver.vehicle.LENGTH)
    director = rules.director(scenario, ego_length, Car)
    _, *npc_starts = start_positions(rules, scenario, director.first_cells(), ego_length)
    npcs = [Car(road, (x, y), heading, scenario.ego_speed) for x, y, heading in npc_starts]
    road.vehicles = [driver.vehicle, *npcs]
    recorder = Recorder(rules, scenario, driver, npcs, director)
    with HangGuard(rules.hang_limit) as guard:
        return _drive(rules, scenario, recorder, guard, clock)


def _drive(rules: Rules, scenario: Scenario, recorder: Recorder, guard: HangGuard, clock: Callable[[], float]) -> Trace:
    driver, npcs, director = recorder.driver, recorder.npcs, recorder.director
    project, dt = rules.road.project, 1 / rules.physics_hz
    vehicles = [driver.vehicle, *npcs]
    for tick in range(rules.ticks(scenario)):
        if tick % driver.every == 0:
            error = decide(driver, tick, recorder, guard, clock)
            if error is not None:
                return recorder.trace(error=error)
        driver.actuate()
        x, y, heading, speed = recorder.ego_state()
        ego = Pose(*project(x, y, heading), speed)
        poses = [Pose(*project(npc.x, npc.y, npc.heading), npc.speed) for npc in npcs]
        for npc, (acceleration, steering) in zip(npcs, director.command(ego, poses), strict=True):
            npc.control(acceleration, steering)
        for vehicle in vehicles:
            vehicle.step(dt)
        recorder.record()
        ended = recorder.contact()
        if ended is not None:
            return ended
    return recorder.trace()


def decide(
    driver: EgoDriver, tick: int, recorder: Recorder, guard: HangGuard, clock: Callable[[], float]
) -> AdsError | None:
    """Have the ADS decide, under guard; what it did instead of that, or None."""
    started = clock()
    try:
        try:
            guard.decision_starts()
            action = driver.decide(tick)
        finally:
            guard.decision_ends()  # before anything is made of an exception: nothing may interrupt that
    except BadAction as error:
        return AdsError(kind="BadAction", message=str(error), traceback="", tick=tick)
    except AdsHang as hang:
        guard.decision_ends()
        message = "one decision took longer than the hang limit of the world and was interrupted"
        return AdsError(kind="Hang", message=message, traceback=_where(hang), tick=tick, interrupted=True)
    except (Exception, SystemExit) as error:  # noqa: BLE001  (whatever the user's code raises is a finding)
        report = traceback.TracebackException(type(error), error, _users_part(error))
        return AdsError(
            kind=type(error).__name__,
            message=one_line(str(report)),
            traceback="".join(report.format()),
            tick=tick,
        )
    recorder.decided(action, clock() - started)
    return None


def _where(hang: AdsHang) -> str:
    """The stack at which a decision was interrupted, without the frames of the interruption."""
    frames = traceback.extract_tb(_users_part(hang))
    kept = [frame for frame in frames if frame.filename != guard_module.__file__]
    return "".join(["Traceback (most recent call last):\n", *traceback.StackSummary.from_list(kept).format()])


def _users_part(error: BaseException) -> Any:
    """The traceback without this package's own frames at its top."""
    frames = error.__traceback__
    while frames is not None and frames.tb_next is not None and _is_own(frames.tb_frame.f_globals):
        frames = frames.tb_next
    return frames


def _is_own(module: dict[str, Any]) -> bool:
    return module.get("__package__") == __package__


class Recorder:
    """Writes the trace of a run and watches for contact."""

    def __init__(
        self, rules: Rules, scenario: Scenario, driver: EgoDriver, npcs: list[Car], director: Director
    ) -> None:
        self.driver = driver
        self.npcs = npcs
        self.director = director
        self._rules = rules
        self._scenario = scenario
        self._rows = array("d")
        self._actions: list[Any] = []
        self._slowest = 0.0
        self._tick = 0
        ego = driver.vehicle
        self._sizes = [(float(v.LENGTH), float(v.WIDTH)) for v in (ego, *npcs)]
        self._pairs = list(combinations(npcs, 2))
        self._by_floats = isinstance(ego, Car)
        self._rows.extend((*self.ego_state(), 0.0, 0.0, 0.0))
        for npc in npcs:
            self._rows.extend((npc.x, npc.y, npc.heading, npc.speed, 0.0, 0.0, 0.0))

    def ego_state(self) -> tuple[float, float, float, float]:
        """The ego's x [m], y [m], heading [rad], speed [m/s]."""
        ego = self.driver.vehicle
        if self._by_floats:
            return ego.x, ego.y, ego.heading, ego.speed
        position = ego.position
        return float(position[0]), float(position[1]), float(ego.heading), float(ego.speed)

    def decided(self, action: Any, seconds: float) -> None:
        """Log a decision."""
        if action is not None:
            self._actions.append(action)
        self._slowest = max(self._slowest, seconds)

    def record(self) -> None:
        """Write the state after a step."""
        self._tick += 1
        ego = self.driver.vehicle
        if self._by_floats:
            self._rows.extend((ego.x, ego.y, ego.heading, ego.speed, ego.acceleration, ego.steering, 0.0))
        else:
            action = ego.action
            self._rows.extend((*self.ego_state(), float(action["acceleration"]), float(action["steering"]), 0.0))
        for npc in self.npcs:
            self._rows.extend((npc.x, npc.y, npc.heading, npc.speed, npc.acceleration, npc.steering, 0.0))

    def contact(self) -> Trace | None:
        """The finished trace, when somebody touches somebody now; the ego's contact goes first."""
        x, y, heading, _ = self.ego_state()
        ego = Box(x, y, heading, *self._sizes[0])
        hit = [index for index, npc in enumerate(self.npcs) if overlap(ego, _box(npc))]
        if hit:
            return self.trace(hit=min(hit, key=self._depth))
        for a, b in self._pairs:
            if overlap(_box(a), _box(b)):
                return self.trace(invalid=True)
        return None

    def _depth(self, npc: int) -> float:
        x, y, heading, _ = self.ego_state()
        ego, other = Box(x, y, heading, *self._sizes[0]), _box(self.npcs[npc])
        return max(*separation(ego, other), *separation(other, ego))

    def trace(self, *, hit: int | None = None, invalid: bool = False, error: AdsError | None = None) -> Trace:
        """Everything recorded so far, and how it ended: by contact with an NPC, or by what else is given."""
        states = np.array(self._rows).reshape(self._tick + 1, len(self._sizes), 7)
        states[:, :, LANE] = self._rules.road.lanes_at(states[:, :, X], states[:, :, Y])
        off_road = np.flatnonzero(states[:, 0, LANE] < 0)
        off_road_tick = int(off_road[0]) if off_road.size else None
        collision = None if hit is None else self._collision(hit, states)
        return Trace(
            scenario=self._scenario,
            executed=self.director.executed,
            outcome=_outcome(collision, invalid, error, off_road_tick),
            collision=collision,
            error=error,
            states=states,
            sizes=np.array(self._sizes),
            lanes=self._rules.road.lanes,
            physics_hz=self._rules.physics_hz,
            ads_hz=self._rules.ads_hz,
            actions=tuple(self._actions),
            arrivals=self.director.arrivals,
            off_road_tick=off_road_tick,
            max_decision_seconds=self._slowest,
        )

    def _collision(self, npc: int, states: FloatArray) -> Collision:
        ego, other = states[-1, 0], states[-1, npc + 1]
        rows = states[max(self._tick - 1, 0), :, :3].tolist()
        before = [Box(x, y, heading, *size) for (x, y, heading), size in zip(rows, self._sizes, strict=True)]
        velocity = [row[SPEED] * np.array([np.cos(row[HEADING]), np.sin(row[HEADING])]) for row in (ego, other)]
        return Collision(
            tick=self._tick,
            time=self._tick / self._rules.physics_hz,
            npc=npc,
            side=side_hit(before[0], before[npc + 1]),
            cell=self._cell(npc, states),
            ego_speed=float(ego[SPEED]),
            npc_speed=float(other[SPEED]),
            closing_speed=float(np.hypot(*(velocity[0] - velocity[1]))),
        )

    def _cell(self, npc: int, states: FloatArray) -> Cell:
        """The last cell that contained the NPC's centre; it starts in one, so there always is one."""
        for ego, other in zip(states[::-1, 0].tolist(), states[::-1, npc + 1].tolist(), strict=True):
            s_ego, d_ego, _ = self._rules.road.project(*ego[:3])
            s, d, _ = self._rules.road.project(*other[:3])
            cell = cell_at(s - s_ego, d - d_ego, self._sizes[0][0], self._rules.road.lane_width)
            if cell is not None:
                return cell
        return self.director.first_cells()[npc]


def _box(car: Car) -> Box:
    return Box(car.x, car.y, car.heading, car.LENGTH, car.WIDTH)


def _outcome(collision: Collision | None, invalid: bool, error: AdsError | None, off_road_tick: int | None) -> Outcome:
    if collision is not None:
        return Outcome.COLLISION
    if invalid:
        return Outcome.INVALID
    if error is not None:
        return Outcome.HANG if error.interrupted else Outcome.ADS_ERROR
    return Outcome.SAFE if off_road_tick is None else Outcome.OFF_ROAD
