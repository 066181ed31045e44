"""One run by the kernel: a straight road that starts at the origin, and an ego that it can drive or ask."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import Any

from pytest_pafot.scenario import Scenario
from pytest_pafot.sight import Sight
from pytest_pafot.trace import AdsError, Outcome, Trace
from pytest_pafot.world.driving.failure import UNFIT, error_of
from pytest_pafot.world.driving.hang_guard import HangGuard
from pytest_pafot.world.driving.idm_model import IdmModel
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.seeing import planner_sight
from pytest_pafot.world.engines.record import Record
from pytest_pafot.world.kernel.bodies import NPC_LENGTH, NPC_WIDTH, Body
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.kernel.idm import IdmEgo
from pytest_pafot.world.kernel.loop import GivenPilot, Loop, PlannerPilot, SelfPilot
from pytest_pafot.world.kernel.observation import COLUMNS, Observation, Observer
from pytest_pafot.world.run_config import Rules, start_positions


def run_planner(
    rules: Rules,
    scenario: Scenario,
    ads: Callable[[Any], Any],
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> Trace:
    """Simulate a scenario that fits the rules with a callable from an observation to its action.

    The ADS is not asked for ``decisions``, the first ones of the run; it may be given a body of its own.
    """
    ego = body or Body(NPC_LENGTH, NPC_WIDTH)
    ego.place(*rules.ego_position(scenario), scenario.ego_speed)
    record, loop = _prepared(rules, scenario, ego)
    observer = _observer(rules, record)
    every, dt, grid = rules.physics_hz // rules.ads_hz, 1 / rules.physics_hz, rules.straight.grid
    ads, sight = ads_and_sight(ads)
    seen = planner_sight(sight, rules, scenario)
    if seen is not None:
        ads = seen.asking(ads, observer)
    with HangGuard(rules.hang_limit) as guard:
        pilot = PlannerPilot(ads, ego, grid, observer, guard, every=every, dt=dt, decisions=decisions)
        error = loop.run(pilot, rules.ticks(scenario))
    record.actions, record.slowest = pilot.actions, pilot.slowest
    return _finished(record, loop, error)


class KernelRun:
    """One run that is given its decisions, see :class:`pytest_pafot.world.engines.lock_step.SteppedRun`."""

    def __init__(self, rules: Rules, scenario: Scenario, guard: HangGuard, sight: Sight | None = None) -> None:
        ego = Body(NPC_LENGTH, NPC_WIDTH)
        ego.place(*rules.ego_position(scenario), scenario.ego_speed)
        self.trace: Trace | None = None
        self._record, self._loop = _prepared(rules, scenario, ego)
        self._observer = _observer(rules, self._record)
        every, dt = rules.physics_hz // rules.ads_hz, 1 / rules.physics_hz
        self._pilot = GivenPilot(ego, rules.straight.grid, every=every, dt=dt)
        self._ticks = rules.ticks(scenario)
        self._guard = guard
        self._sight = planner_sight(sight, rules, scenario)

    def observe(self) -> Observation:
        """What the ADS sees now."""
        now = self._observer.observation(self._loop.tick)
        return now if self._sight is None else self._sight.recorded(now, self._observer)

    def take(self, action: Any, seconds: float) -> None:
        """Drive with a decision that took so long, up to the next one or the end."""
        loop, record, error = self._loop, self._record, None
        try:
            self._pilot.take(action, seconds)
        except UNFIT as unfit:
            error = error_of(unfit, loop.tick, self._guard)
        else:
            loop.run(self._pilot, min(loop.tick + self._pilot.every, self._ticks))
        if error is None and loop.tick < self._ticks and not (loop.ego_touched or loop.npcs_touched):
            return
        record.actions, record.slowest = self._pilot.actions, self._pilot.slowest
        self.trace = _finished(record, loop, error)


def run_model(rules: Rules, scenario: Scenario, model: IdmModel) -> Trace:
    """Simulate a scenario that fits the rules with highway-env's IDM+MOBIL as the ego."""
    road = rules.straight
    ego = IdmEgo(model.constants, road.grid, road.speed_limit)
    ego.start(*rules.ego_position(scenario), scenario.ego_speed, model.changes_lanes)
    record, loop = _prepared(rules, scenario, ego)
    loop.run(SelfPilot(ego, list(record.director.npcs)), rules.ticks(scenario))
    return _finished(record, loop, None)


def _prepared(rules: Rules, scenario: Scenario, ego: Body) -> tuple[Record, Loop]:
    """Everybody at the start."""
    director: Director = rules.director(scenario, ego.length)
    _, *starts = start_positions(rules, scenario, director.first_cells(), ego.length)
    for npc, (x, y, heading) in zip(director.npcs, starts, strict=True):
        npc.place(x, y, heading, scenario.ego_speed)
    sizes = [(body.length, body.width) for body in (ego, *director.npcs)]
    rows = array("d", bytes(8 * (rules.ticks(scenario) + 1) * len(sizes) * COLUMNS))
    record = Record(rules=rules, scenario=scenario, director=director, sizes=sizes, rows=rows)
    return record, Loop(ego, director, rules.straight.grid, rows, 1 / rules.physics_hz)


def _observer(rules: Rules, record: Record) -> Observer:
    every = rules.physics_hz // rules.ads_hz
    road = rules.straight
    return Observer(record.rows, record.sizes, road.grid, road.speed_limit, rules.physics_hz, every)


def _finished(record: Record, loop: Loop, error: AdsError | None) -> Trace:
    record.tick = loop.tick
    ended = Outcome.COLLISION if loop.ego_touched else Outcome.INVALID if loop.npcs_touched else None
    return record.trace(ended, error)
