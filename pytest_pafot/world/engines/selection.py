"""The choice between two engines for runs in SI units, the kernel and highway-env's objects, with the same results."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import Any, Protocol, cast

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import AdsError, Outcome, Trace
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.driving.idm_model import IdmModel, idm_model
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.seeing import planner_sight
from pytest_pafot.world.engines.lock_step import SteppedRun
from pytest_pafot.world.engines.record import Record
from pytest_pafot.world.guard.failure import UNFIT, error_of
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.bodies import NPC_LENGTH, NPC_WIDTH, Body
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.kernel.idm import IdmEgo
from pytest_pafot.world.kernel.loop import GivenPilot, Loop, PlannerPilot, SelfPilot
from pytest_pafot.world.kernel.observation import COLUMNS, Observation, Observer
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.run_config import Rules, start_positions


def run_planner(
    rules: Rules,
    scenario: Scenario,
    ads: Callable[[Any], Any],
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> Trace:
    """Simulate a scenario that fits the rules in the kernel, with a callable from an observation to an action.

    The road must be straight and start at the origin. ``decisions`` are the first decisions of the run and replace
    calls of the ADS. ``body`` replaces the ego's usual body.
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
    """A run in the kernel to which the caller passes decisions, as a ``SteppedRun`` of ``engines.lock_step``."""

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
        """Return the ADS's current observation."""
        now = self._observer.observation(self._loop.tick)
        return now if self._sight is None else self._sight.recorded(now, self._observer)

    def take(self, action: Any, seconds: float) -> None:
        """Apply a decision that took ``seconds``, and drive until the next decision or the end of the run."""
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
    """Simulate a scenario that fits the rules in the kernel, with highway-env's IDM and MOBIL as the ego."""
    road = rules.straight
    ego = IdmEgo(model.constants, road.grid, road.speed_limit)
    ego.start(*rules.ego_position(scenario), scenario.ego_speed, model.changes_lanes)
    record, loop = _prepared(rules, scenario, ego)
    loop.run(SelfPilot(ego, list(record.director.npcs)), rules.ticks(scenario))
    return _finished(record, loop, None)


def _prepared(rules: Rules, scenario: Scenario, ego: Body) -> tuple[Record, Loop]:
    """Put all vehicles at their starts, and return the record and the loop."""
    director = cast("Director", rules.director(scenario, ego.length))  # the road is straight
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


class SiWorld(Protocol):
    """A world on whose road egos can drive in SI units."""

    @property
    def engine(self) -> str:
        """The requested engine: ``"kernel"``, ``"highway-env"`` or ``"auto"``."""

    @property
    def rules(self) -> Rules:
        """The settings that all runs have in common."""

    @property
    def network(self) -> Any:
        """The road as a road network of highway-env."""


def rollout_vehicle(world: SiWorld, scenario: Scenario, ads: Any, decisions: Sequence[Any] = ()) -> Trace:
    """Simulate a scenario that fits the world, on a straight road, with an ego of a self-driving vehicle class."""
    if decisions:
        raise WorldError(
            f"decisions: expected none for {ads!r}, a vehicle class, which drives itself and returns no actions, "
            f"received {len(decisions)}; leave them out"
        )
    model = kernel_model(world, ads)
    if model is not None:
        return run_model(world.rules, scenario, model)
    if world.engine == "kernel":
        raise WorldError(
            f"engine: expected an ADS that the kernel can drive, a callable or IDMVehicle with other constants, "
            f'received {ads!r}, a vehicle class with its own code or options; use engine="auto" or '
            f'engine="highway-env"'
        )
    return _by_objects(world, world.rules, scenario, ads)


def kernel_model(world: SiWorld, ads: Any) -> IdmModel | None:
    """Return the model by which the kernel drives a vehicle class; None if the kernel cannot, or is not to be used."""
    return None if world.engine == "highway-env" else idm_model(ads)


def rollout_planner(
    world: SiWorld,
    rules: Rules,
    scenario: Scenario,
    ads: Callable[[Observation], Any],
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> Trace:
    """Simulate a scenario on a world's road by the given rules, with a callable from an observation to an action.

    The kernel runs it if the road is straight and starts at the origin. ``body`` replaces the ego's usual body.
    """
    road = rules.road
    if world.engine == "highway-env" or isinstance(road, NetworkRoad) or not road.starts_at_origin:
        return _by_objects(world, rules, scenario, ads, decisions, body)
    return run_planner(rules, scenario, ads, decisions, body)


def begin(world: SiWorld, scenario: Scenario, guard: HangGuard, sight: Sight | None) -> SteppedRun:
    """Begin a run to which the caller passes decisions in SI units, for an ADS with the given sight."""
    if world.engine != "highway-env":
        return KernelRun(world.rules, scenario, guard, sight)
    from pytest_pafot.world.engines.object_engine import begin_planner  # noqa: PLC0415  (a second of imports)

    return begin_planner(world.network, world.rules, scenario, guard, sight)


def _by_objects(
    world: SiWorld,
    rules: Rules,
    scenario: Scenario,
    ads: Any,
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> Trace:
    from pytest_pafot.world.engines.object_engine import run_on  # noqa: PLC0415  (a second of imports)

    return run_on(world.network, rules, scenario, ads, decisions, body)
