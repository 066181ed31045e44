"""A check that a user's own world meets the requirements of a search, for use in the user's tests."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from functools import partial, wraps
from itertools import count, cycle
from typing import Any, Unpack

import numpy as np

from pytest_pafot.campaign.request import SpaceArguments
from pytest_pafot.model.instructions import Cell, LaneInstruction, PositionInstruction, ScenarioError
from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.model.trace import SPEED, Outcome, Trace, X, Y
from pytest_pafot.model.vehicle_type import CAR, MOTORCYCLE, TRUCK, VAN
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching.space import sample
from pytest_pafot.support.errors import plain_number
from pytest_pafot.testing import traces as rules
from pytest_pafot.testing.simulators import experiments
from pytest_pafot.testing.traces import ACROSS, ALONG, DEEP, ROUNDING, Promises
from pytest_pafot.world import SimulatorWorld, WorldLike
from pytest_pafot.world.codec import WorldData
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.guard.own_worlds import base_world, rollout_of

Ads = Callable[[], Callable[..., Any]]

EGOS: tuple[tuple[float, float], ...] = ((0.0, 0.0), (2.0, 0.0), (-3.0, 0.0))
"""The actions of further egos if the ADS of the check acts in SI units [m/s^2, rad]: steady, faster and slower."""
OBSERVED = ("ego", "others", "lanes", "lane_width", "speed_limit")
"""The fields by which an ADS's input counts as a :class:`pytest_pafot.Observation`, whatever its class."""
TOP_SPEED = 70.0
"""The highest speed limit that is plausible in m/s."""
SETTLED = 5.0
"""The time in which an NPC that obeys reaches its first cell, and in which it shows another instruction [s]."""
LEAST_SPEED = 5.0
"""The speed above which an NPC can change lanes soon [m/s]."""
GOOD_DECISIONS = 2
"""The number of decisions that a failing ADS of the check makes before it fails."""
FEW = 2
"""The number of runs of a simulator that are made again in each of the checks that repeat runs."""
MORE = 4
"""The number of further runs, as a multiple of ``runs``, after which no collision is looked for any more."""


@dataclass(slots=True)
class _Noted:
    """The actions of an ADS, and x [m], y [m] and speed [m/s] of the ego if its input has them."""

    actions: list[Any] = field(default_factory=list)
    poses: list[tuple[float, float, float]] = field(default_factory=list)


class _Calls:
    """The ADSs of one factory, which stays the same object in all runs, as in a search.

    Attributes:
        ads: the factory that was given.
        factory: a factory of ADSs that do the same, and whose calls are noted.
        is_known: False if the calls cannot be observed.
        noted: the calls of each ADS that was made.
    """

    def __init__(self, ads: Ads) -> None:
        self.ads = self.factory = ads
        self.is_known = Policy(ads).only_observes and not hasattr(ads, "sight")
        self.noted: list[_Noted] = []
        if self.is_known:
            self.factory = wraps(ads, updated=())(partial(self._make))

    def _make(self) -> Any:
        one, noted = self.ads(), _Noted()
        if not Policy(one).only_observes or hasattr(one, "sight"):
            self.is_known = False
            return one
        self.noted.append(noted)

        def decide(*seen: Any) -> Any:
            if seen and all(hasattr(seen[0], name) for name in OBSERVED):
                noted.poses.append((seen[0].ego.x, seen[0].ego.y, seen[0].ego.speed))
            answer = one(*seen)
            noted.actions.append(answer)
            return answer

        return decide


@dataclass(frozen=True, slots=True)
class _Done:
    """A run of the check, and the calls of its ADS."""

    scenario: Scenario
    trace: Trace
    calls: _Calls
    noted: _Noted


def check_world(
    world: WorldLike,
    *,
    seed: int = 0,
    runs: int = 8,
    ads: Ads = lambda: lambda observation: (0.0, 0.0),
    **space: Unpack[SpaceArguments],
) -> None:
    """Check with random scenarios that a world meets the requirements of a search.

    - It has all attributes that a search needs, and plain data that a file can store.
    - Traces have the form that test functions and reports expect, also for crossing NPCs if the world has ways for
      them.
    - The states agree with each other: positions with lanes, headings and speeds with the motion, accelerations with
      the speeds, and all of them with the start of the scenario. Each tick has a row. On a road that bends, the points
      of the lanes agree with them, too.
    - NPCs take on the speeds of their instructions and go to the sides of their cells, and the ego follows its ADS.
    - A contact of the ego's box with an NPC's is a collision, and the collision agrees with the states. If two NPCs
      touch, the outcome is ``invalid``.
    - The same scenario gives the same trace to the last bit, whatever ran before.
    - The scenario as executed, ``trace.executed``, gives the same trace.
    - If the world has ``has_lane_instructions``, NPCs with Lane-Instructions are among those of all scenarios, and on a
      straight road they change lanes to the side that their instructions name.
    - NPCs stay within the world's ``limits``, if these are a :class:`pytest_pafot.NpcLimits`.
    - An ADS that raises, returns no action or hangs ends its own run and does not affect other runs. An ADS that hangs
      is tried only if the world's ``hang_limit`` is at most one second.
    - ``from_dict`` gives the same world again, if the world's class has that method or if a file can describe the
      world.

    An NPC stops ahead of the ego in one more scenario, unless NPCs cross, and on straight roads ahead of another NPC in
    a second one, if there are two NPCs or more. Further runs are made until a collision came up, at most four times as
    many. If the ADS acts in SI units, their egos keep their speed, accelerate and brake.

    Args:
        world: the world to check.
        seed: the seed of the scenarios.
        runs: the number of scenarios.
        ads: the factory of an ADS that drives in this world without errors and does not depend on earlier runs. The
            default returns an acceleration and a steering of 0 in SI units.
        space: properties of all scenarios, such as ``npcs``, ``genes`` and ``ego_lane``, as in
            :func:`pytest_pafot.search`.

    Raises:
        AssertionError: if a requirement is not met; the message names it.

    Warns:
        RuntimeWarning: if no run had a collision, so that nothing about collisions was checked.
    """
    lacking = base_world(world).missing
    _promise(not lacking, "a world has all that a search needs", f"no {', '.join(lacking)}")
    _check_members(world)
    able: dict[str, Any] = {} if (found := base_world(world).crossings) is None else {"crossings": found}
    if base_world(world).has_lane_instructions:
        able["instructions"] = "both"
    road = base_world(world).straight_road
    if road is not None and road.lane_count == 1:
        able["ego_lane"] = 0
    able["vehicles"] = tuple(filter(base_world(world).can_drive, (CAR, VAN, TRUCK, MOTORCYCLE)))
    random, within = rng_of(seed), base_world(world).space({**able, **space})
    calls, scenarios = _Calls(ads), [sample(within, random) for _ in range(runs)]
    if isinstance(simulated := base_world(world), SimulatorWorld):
        with _no_error("a simulator can be driven step by step, with one vehicle or several"):
            kept = (True, "", "")
            broken = next((each for each in experiments(simulated, scenarios[0], seed) if not each[0]), kept)
        _promise(*broken)
    done = [_run(world, scenario, calls) for scenario in scenarios]
    # What may go wrong with a simulator has shown in the experiments, and the rest is done by this package.
    few = done[:FEW] if isinstance(simulated, SimulatorWorld) else done
    for each in done:
        _check_form(world, each.scenario, each.trace)
    egos, staged, more = _further(world, done, (sample(within, random) for _ in range(MORE * runs)))
    every = [*done, *egos, *staged, *more]
    for each in every[runs:]:
        _check_form(world, each.scenario, each.trace)
    _keep(rules.of_runs(world, [each.trace for each in every]))
    for each in every:
        _keep(_decided(world, each))
    longest = max(done, key=lambda each: each.trace.ticks)
    _check_repetition(world, few)
    _check_obedience(world, done, egos, len(few))
    _check_speed(world, staged[:1])
    _check_sides(world, done[0])
    _check_faults(world, longest, ads)
    _check_round_trip(world, done[0], ads)
    if not any(each.trace.collision for each in every):
        warnings.warn(
            f"check_world: no collision in {len(every)} runs, so nothing about collisions was checked; give an ads= "
            "that collides, or more runs=, npcs= or genes=",
            RuntimeWarning,
            stacklevel=2,
        )


FRESH = "rollout calls ads_factory once, for a fresh ADS"


def _promise(is_kept: Any, promise: str, received: str) -> None:
    if not is_kept:
        raise AssertionError(f"expected that {promise}, received {received}")


def _keep(promises: Promises) -> None:
    for is_kept, promise, received in promises:
        _promise(is_kept, promise, received)


@contextmanager
def _no_error(promise: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise AssertionError(f"expected that {promise}, received {error!r}") from error


def _rollout(rollout: Callable[..., Any], scenario: Scenario, ads: Ads, **given: Any) -> Trace:
    with _no_error("a run ends in a trace, whatever the ADS does"):
        trace = rollout(scenario, ads, **given)
    _promise(isinstance(trace, Trace), "rollout returns a pafot.Trace", f"{trace!r:.200}")
    return trace  # type: ignore[no-any-return]


def _run(world: Any, scenario: Scenario, calls: _Calls) -> _Done:
    before = len(calls.noted)
    trace = _rollout(rollout_of(world), scenario, calls.factory)
    made = len(calls.noted) - before
    _promise(made == 1 or not calls.is_known, FRESH, f"{made} calls")
    return _Done(scenario, trace, calls, calls.noted[-1] if calls.is_known else _Noted())


def _check_form(world: Any, scenario: Scenario, trace: Trace) -> None:
    _keep(rules.form(world, scenario, trace))
    with _no_error("Run(trace).explain() describes the run"):
        Run(trace).explain()


def _further(world: Any, done: Sequence[_Done], scenarios: Iterator[Scenario]) -> tuple[list[_Done], ...]:
    """Run further egos in the first scenario, staged scenarios, and further scenarios until a collision came up.

    The egos have constant actions. If these are not in SI units, there are none, and the ADS of the check drives.
    """
    is_si = all(each.calls.is_known and base_world(world).looks_si(each.noted.actions) for each in done)
    egos = [_run(world, done[0].scenario, _Calls(_constant(action))) for action in EGOS] if is_si else []
    if any(each.trace.error for each in egos):
        egos = []
    drivers = [each.calls for each in egos or done[:1]]
    staged = [_run(world, scenario, drivers[0]) for scenario in _stages(world, done[0])]
    more: list[_Done] = []
    for scenario, calls in zip(scenarios, cycle(drivers), strict=False):
        if any(each.trace.collision for each in (*done, *egos, *more)):
            break
        more.append(_run(world, scenario, calls))
    return egos, staged, more


def _stages(world: Any, done: _Done) -> Iterator[Scenario]:
    """Yield a scenario in which the vehicle ahead of the ego stops, and one in which an NPC meets one that stopped.

    They have as many NPCs as other scenarios. If roads bend, only the first one is certain to have its cells.
    """
    scenario, npcs, speed_limit = done.scenario, len(done.scenario.npcs), _in_steps(world.speed_limit)
    beside = (Cell.FRONT_LEFT, Cell.LEFT) if scenario.ego_lane else (Cell.FRONT_RIGHT, Cell.RIGHT)
    for first in ((Cell.FRONT,), beside) if rules.is_straight(done.trace) else ((Cell.FRONT,),):
        cells = [*first, *(cell for cell in Cell if cell not in first)]
        if npcs >= len(first) and not scenario.crossings:
            speeds = [0.0] + [min(_in_steps(scenario.ego_speed), speed_limit)] * (npcs - 1)
            genes = map(PositionInstruction, cells, speeds)
            staged = replace(scenario, npcs=tuple((gene,) * scenario.genes for gene in genes))
            with suppress(ScenarioError):
                base_world(world).check_fits(staged)
                yield staged


def _in_steps(speed: float) -> float:
    """Return the highest speed that an instruction can have, in steps of 0.1 m/s, up to a speed [m/s]."""
    return int(10.0 * speed + 1e-6) / 10.0


def _check_members(world: Any) -> None:
    """Check the attributes of a world, apart from its runs."""
    for name in ("speed_limit", "longest_run", *(["hang_limit"] if hasattr(world, "hang_limit") else [])):
        value = plain_number(getattr(world, name))
        _promise(value is not None and value > 0, f"{name} is a number above 0", f"{getattr(world, name)!r:.100}")
    is_slow = world.speed_limit <= TOP_SPEED
    _promise(is_slow, f"speed_limit is in m/s, at most {TOP_SPEED:g}", f"{world.speed_limit:g}")
    names = getattr(world, "takes_over", ())
    are_several = isinstance(names, Collection) and not isinstance(names, str)
    are_names = are_several and all(isinstance(each, str) for each in names)
    _promise(are_names, "takes_over is a tuple of names", f"{names!r:.100}")


def _check_same(first: Trace, second: Trace, promise: str) -> None:
    """Check that two traces are the same to the last bit, apart from the requested scenario and the time it took."""
    names = {each.name for each in fields(Trace) if each.init} - {"scenario", "max_decision_seconds"}
    differ = [name for name in sorted(names) if not _is_same(getattr(first, name), getattr(second, name))]
    _promise(not differ, promise, f"a different {', '.join(differ)} for {first.scenario}")


def _is_same(first: Any, second: Any) -> bool:
    """Return whether two values are the same to the last bit."""
    if isinstance(first, np.ndarray):
        return isinstance(second, np.ndarray) and (first.shape, first.tobytes()) == (second.shape, second.tobytes())
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(_is_same, first, second))
    return bool(first == second)


def _repeats(first: Trace, second: Trace, rows: int | None, vehicles: int | None = None) -> bool:
    """Return whether two runs have the same states, apart from rounding, in the first rows or as long as both last."""
    until = min(len(first.states), len(second.states)) if rows is None else rows
    states = first.states[:until, :vehicles], second.states[:until, :vehicles]
    return states[0].shape == states[1].shape and np.allclose(*states, rtol=0.0, atol=ROUNDING)


def _constant(action: tuple[float, float]) -> Ads:
    return lambda: lambda *seen: action


def _decided(world: Any, done: _Done) -> Promises:
    """Yield that an ADS decides when the trace says, and that a run records each of its decisions."""
    trace, made, poses = done.trace, len(done.noted.actions), done.noted.poses
    if not done.calls.is_known:
        return
    ticks = list(trace.decision_ticks)
    received = f"{made} decisions in {trace.ticks} ticks, with physics_hz {trace.physics_hz} and ads_hz {trace.ads_hz}"
    if trace.decided:
        received += f", and decided {trace.decided!r:.100}"
        promise = "decided has the ticks of all decisions, in order and from the start on"
        yield made == len(ticks) and ticks == sorted({0, *ticks}) and ticks[-1] <= trace.ticks, promise, received
    else:
        promise = "the ADS decides ads_hz times a second, for the first time at the start"
        yield len(ticks) <= made <= len(ticks) + 1, promise, received
    if poses:
        rows = trace.ego[ticks][:made, [X, Y, SPEED]]
        away = np.median(np.abs(rows - (seen := np.array(poses)[: len(rows)])), axis=0)
        if not trace.road.is_straight:  # an ADS may see a road that bends as if it were straight
            along = np.column_stack([trace.track_of(0)[ticks][:made, [ALONG, ACROSS]], rows[:, 2]])
            places = np.median(np.abs(along - along[0] - seen + seen[0]), axis=0)
            away = min(away, places, key=np.max)
        promise = "an ADS that receives a pafot.Observation, or an object with its fields, sees the ego as in states"
        received = "a difference of {:.2f} m in x, {:.2f} m in y, {:.2f} m/s at half of the decisions".format(*away)
        yield (away <= 2 * DEEP).all(), promise, received
    if not trace.actions and not base_world(world).is_resumable:
        return  # Only worlds with decisions= are asked to repeat actions.
    yield len(trace.actions) == made, "actions has one action for each decision", f"{len(trace.actions)} for {made}"


def _check_repetition(world: Any, done: Sequence[_Done]) -> None:
    for each in done[::-1]:  # in a different order than before
        for which in ("same scenario", "scenario as executed"):
            made, scenario = len(each.calls.noted), each.scenario if which == "same scenario" else each.trace.executed
            # Without the guard of a search, which gives a world another factory in each run.
            trace = _rollout(world.rollout, scenario, each.calls.factory)
            is_fresh = not each.calls.is_known or len(each.calls.noted) == made + 1
            _promise(is_fresh, FRESH, "an ADS of an earlier run")
            _check_same(each.trace, trace, f"the {which} gives the same trace")


def _check_obedience(world: Any, done: Sequence[_Done], egos: Sequence[_Done], least: int) -> None:
    """Check that NPCs follow the scenario and the ego its ADS, because other instructions give other runs.

    At least a number of runs is made again, and further ones until one differs: in some, no NPC can follow.
    """
    is_told, is_ignored = False, True
    for number, each in enumerate(done):
        if number >= least and not is_ignored:
            break
        scenario, trace = each.scenario, each.trace
        if scenario.crossings:
            continue
        other = _rollout(world.rollout, _otherwise(scenario, _in_steps(world.speed_limit)), each.calls.factory)
        # A run may end before the other instructions could show.
        is_told |= trace.duration >= SETTLED + (scenario.gene_seconds if scenario.genes > 1 else SETTLED)
        is_ignored &= _is_same(trace.npcs, other.npcs)
        is_same = scenario.genes == 1 or _repeats(trace, other, int(scenario.gene_seconds * trace.physics_hz))
        promise = (
            f"states depend only on the first instructions until scenario.gene_seconds, {scenario.gene_seconds:g} s"
        )
        _promise(is_same, promise, "other states with other instructions for later")
    received = "the same states[:, 1:] for other instructions"
    _promise(not (is_told and is_ignored), "NPCs follow their instructions", received)
    if not egos:
        return
    tick = min(each.trace.ticks for each in egos)
    steady, faster, slower = (float(each.trace.ego[tick, SPEED]) for each in egos)
    is_obeyed = tick < egos[0].trace.physics_hz or slower < steady - ROUNDING or steady < faster - ROUNDING
    received = f"{slower:.1f}, {steady:.1f} and {faster:.1f} m/s for an ADS that brakes, does nothing and accelerates"
    _promise(is_obeyed, "the ego follows its ADS, states[:, 0, SPEED]", received)


def _otherwise(scenario: Scenario, speed_limit: float) -> Scenario:
    """Return a scenario in which NPCs stay in their first cells, at other speeds, after their first instruction.

    An NPC may keep to its speed only in its cell, so both are different. An only instruction gets another speed.
    """

    def other(first: Any, gene: Any) -> Any:
        return (first if first.on_grid else gene).with_speed(_in_steps(speed_limit - gene.speed))

    since = 1 if scenario.genes > 1 else 0
    npcs = [(*one[:since], *(other(one[0], gene) for gene in one[since:])) for one in scenario.npcs]
    return replace(scenario, npcs=tuple(npcs))


def _check_speed(world: Any, staged: Sequence[_Done]) -> None:
    """Check that an NPC in the cell of its instruction takes on its speed: 0 in a staged run, and another one."""
    for each in staged:
        other = tuple(gene.with_speed(_in_steps(world.speed_limit)) for gene in each.scenario.npcs[0])
        fast = _run(world, replace(each.scenario, npcs=(other, *each.scenario.npcs[1:])), each.calls).trace
        rows = min(len(each.trace.states), len(fast.states))
        slower, faster = (trace.npcs[:rows, 0, SPEED] for trace in (each.trace, fast))
        apart, seconds = float((faster - slower).max()), (rows - 1) * fast.dt
        promise = "an NPC in the cell of its instruction takes on its speed, states[:, 1, SPEED]"
        received = f"at most {apart:.1f} m/s more in {seconds:g} s with {world.speed_limit:g} m/s instead of 0"
        _promise(apart > 1.0 or seconds < SETTLED, promise, received)


def _check_sides(world: Any, done: _Done) -> None:
    """Check that NPCs go to the side that their instructions name, in runs that last long enough.

    NPC 0 has cells beside the one in which it starts, or all have Lane-Instructions. On a road that bends a lane may
    end, so that they may go to one side only.
    """
    scenario = done.scenario
    speed = _in_steps(min(scenario.ego_speed, world.speed_limit))
    if scenario.crossings or len(done.trace.lanes) < 2 or speed <= LEAST_SPEED:
        return
    cells = [Cell.FRONT, Cell.REAR, Cell.REAR_LEFT, Cell.REAR_RIGHT, Cell.LEFT, Cell.RIGHT]
    chains = [(PositionInstruction(cell, speed),) * scenario.genes for cell in cells]
    tried: dict[str, tuple[float, list[Any]]] = {}
    if scenario.genes > 1 and len(scenario.npcs) <= len(cells):
        sides = [(chains[0][0], *[PositionInstruction(cell, speed)] * (scenario.genes - 1))
                 for cell in (Cell.FRONT_LEFT, Cell.FRONT_RIGHT)]  # fmt: skip
        told: list[Any] = [(side, *chains[1 : len(scenario.npcs)]) for side in sides]
        tried["NPCs go to the cells of their instructions"] = scenario.gene_seconds + SETTLED, told
    if base_world(world).has_lane_instructions:
        genes = [LaneInstruction(lane, speed) for lane in ("left", "right")]
        told = [((gene,) * scenario.genes,) * len(scenario.npcs) for gene in genes]
        tried["NPCs change lanes by Lane-Instructions, as has_lane_instructions declares"] = SETTLED, told
    for promise, (seconds, told) in tried.items():
        across: list[Any] = []
        for npcs in told:
            asked = replace(scenario, npcs=npcs)
            with suppress(ScenarioError):
                base_world(world).check_fits(asked)
                trace = _run(world, asked, done.calls).trace
                _check_form(world, asked, trace)
                across += [trace.road.track[:, 1:, ACROSS]] if trace.duration >= seconds else []
        if len(across) < len(told):
            continue
        until = min(map(len, across))
        apart = (across[1][:until] - across[0][:until])[:, : None if "Lane" in promise else 1].mean(axis=1)
        if rules.is_straight(done.trace):
            received = f"at most {apart.max():.1f} m between NPCs that go left and those that go right"
            _promise(apart.max() > DEEP, promise, received)
        received = f"NPCs {-apart.min():.1f} m farther left if they should go right"
        _promise(apart.min() > -DEEP or apart.max() > DEEP, promise, received)


def _check_faults(world: Any, done: _Done, ads: Ads) -> None:
    """Check that an ADS that fails after its first decisions ends its own run at that decision."""
    limit, trace = base_world(world).hang_limit, done.trace
    faults: list[tuple[str, Callable[[], Any], Outcome]] = [
        ("raises", lambda: 1 / 0, Outcome.ADS_ERROR),
        ("returns None", lambda: None, Outcome.ADS_ERROR),
        ("hangs", lambda: time.sleep(6 * limit), Outcome.HANG),
    ]
    good = min(GOOD_DECISIONS, len(trace.decision_ticks) - 1)  # a run may be shorter
    tick = trace.decision_ticks[good]
    for name, fault, outcome in faults if limit <= 1.0 else faults[:-1]:

        def failing(fault: Callable[[], Any] = fault) -> Callable[..., Any]:
            healthy, made = ads(), count(1)
            return lambda *seen: healthy(*seen) if next(made) <= good else fault()

        failed = _rollout(rollout_of(world), done.scenario, failing)
        received = f"{failed.outcome}, {failed.error}"
        is_told = failed.outcome is outcome and failed.error is not None
        _promise(is_told, f"an ADS that {name} ends its run as {outcome}", received)
        is_tick = failed.error is not None and failed.error.tick == failed.ticks == tick
        promise = f"error.tick is the tick of the decision of an ADS that {name}, at which its run ends"
        received += f", in a run of {failed.ticks} ticks for decision {good}, at tick {tick}"
        _promise(is_tick, promise, received)
        is_named = name != "raises" or (failed.error is not None and "ZeroDivisionError" in failed.error.text)
        _promise(is_named, "error.kind and error.message are those of the exception of an ADS", f"{failed.error}")
        is_same = _repeats(trace, failed, tick + 1)
        promise = f"states has the run up to the decision of an ADS that {name}"
        _promise(is_same, promise, "other states than those of the run without the error")
        again = _rollout(rollout_of(world), done.scenario, ads)
        _check_same(trace, again, f"an ADS that {name} does not affect the next run")


def _check_round_trip(world: Any, done: _Done, ads: Ads) -> None:
    data = WorldData.of(world)
    _promise(data.is_plain, "to_dict returns plain data that a file can store", f"{world.to_dict()!r:.200}")
    if not data.can_be_made:
        return
    with _no_error("from_dict accepts the data of to_dict"):
        again = data.made()
    other = WorldData.of(again)
    _promise(other == data, "from_dict(to_dict()) has the same data", f"{other.data} for {data.data}")
    trace = _rollout(rollout_of(again), done.scenario, ads)
    _check_same(done.trace, trace, "from_dict(to_dict()) gives the same traces")
