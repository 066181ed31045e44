"""A check that a user's own world meets the requirements of a search, for use in the user's tests."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial, wraps
from itertools import chain, combinations, cycle, islice, pairwise, repeat
from typing import Any

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.last_chance import STEADY_BRAKING, brakes_untouched
from pytest_pafot.criticality.boxes import Boxes, depth, relate
from pytest_pafot.criticality.relative import RelativePositions
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import CrossingInstruction, Gene, PositionInstruction, Scenario
from pytest_pafot.model.trace import (
    ACCELERATION,
    ANGLE,
    HEADING,
    LANE,
    SPEED,
    STEERING,
    Collision,
    FloatArray,
    Lane,
    Outcome,
    Trace,
    X,
    Y,
)
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching.space import sample, space_on
from pytest_pafot.support.errors import plain_number, plain_whole
from pytest_pafot.world.codec import OWN, described, from_dict, is_code
from pytest_pafot.world.driving.ads import is_vehicle_class, wants_env
from pytest_pafot.world.driving.seeing import SeeingAds
from pytest_pafot.world.guard.own_worlds import rollout_of, simulate_batch
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.protocol import (
    crossings,
    hang_limit,
    lasting,
    lock_stepping,
    looks_si,
    missing,
    reference_world,
    resumable,
    road_start,
)

Ads = Callable[[], Callable[[Any], Any]]

ROUNDING = 1e-6

# Tolerances of what other simulators do a little differently, such as finding contacts by other shapes, moving with
# the speed before or after a step, and changing lanes in one step. Each is far below the smallest mistake that it has
# to show: a wrong unit or axis, or a wrong point of a vehicle.

AT_START = 0.1
"""The largest difference from the start speed of the scenario, for the ego [m/s]; for NPCs ten times as much."""
DEEP = 0.5
"""The deepest overlap of two boxes that may go unreported, since the shapes of vehicles are no boxes [m]."""
APART = 0.3
"""The largest gap between the boxes of two vehicles in contact, besides what they drive in a tick [m]."""
OUTLIERS = 0.1
"""The share of ticks that may be exceptions, such as a lane change in one tick."""
DISTANCE = 0.1, 4.0
"""The largest difference between the way driven and the speeds: a share, and a lane width of jumps aside [m]."""
DIRECTION = 0.4
"""The largest median angle between the heading and the motion of a vehicle; turned wheels make it slip [rad]."""
MOVING = 2.0
"""The speed above which the direction of motion is known [m/s]."""
LEAST = 10
"""The fewest ticks from which a share is taken."""

EGOS: tuple[tuple[float, float], ...] = ((0.0, 0.0), (2.0, 0.0), (-3.0, 0.0))
"""The actions of further egos if the ADS of the check acts in SI units [m/s^2, rad]: steady, faster and slower."""
OBSERVED = ("ego", "others", "lanes", "lane_width", "speed_limit")
"""The fields by which an ADS's input counts as a :class:`pytest_pafot.Observation`, whatever its class."""
SMOOTH = 0.5
"""The time over which accelerations are compared with speeds [s]."""
TOP_SPEED = 70.0
"""The highest speed limit that is plausible in m/s."""
LONG = 10.0
"""The duration of a run in which an NPC that obeys its only instruction shows it [s]."""
GOOD_DECISIONS = 2
"""The number of decisions that a failing ADS of the check makes before it fails."""
LONGER = 4
"""The largest number of runs that are also made longer, if the world has ``lasting``."""
MORE = 4
"""The number of further runs, as a multiple of ``runs``, after which no collision is looked for any more."""


@dataclass(slots=True)
class _Noted:
    """The calls of an ADS factory and of its ADSs in one run.

    Attributes:
        is_known: False if the calls cannot be observed.
        made: the number of ADSs.
        returned: the actions that they returned.
        poses: x [m], y [m] and speed [m/s] of the ego as they saw it, if they see something like an Observation.
    """

    is_known: bool = True
    made: int = 0
    returned: list[Any] = field(default_factory=list)
    poses: list[tuple[float, float, float]] = field(default_factory=list)

    def noting(self, ads: Ads) -> Ads:
        """Return a factory whose ADSs do the same, and whose calls are noted."""
        if is_vehicle_class(ads) or wants_env(ads) or hasattr(ads, "sight"):
            self.is_known = False
            return ads

        @wraps(ads, updated=())
        def make() -> Any:
            self.made += 1
            one = ads()
            if is_vehicle_class(one) or isinstance(one, SeeingAds):
                self.is_known = False
                return one

            def decide(*seen: Any) -> Any:
                if seen and all(hasattr(seen[0], name) for name in OBSERVED):
                    ego = seen[0].ego
                    self.poses.append((ego.x, ego.y, ego.speed))
                action = one(*seen)
                self.returned.append(action)
                return action

            return decide

        return make


@dataclass(frozen=True, slots=True)
class _Done:
    """A run of the check."""

    scenario: Scenario
    ads: Ads
    trace: Trace
    noted: _Noted


def check_world(
    world: Any, *, seed: int = 0, runs: int = 8, ads: Ads = lambda: lambda observation: (0.0, 0.0), **space: Any
) -> None:
    """Check with random scenarios that a world meets the requirements of a search.

    - It has all attributes that a search needs, and plain data that a file can store.
    - Traces have the form that test functions and reports expect, also for crossing NPCs if the world has ways for
      them.
    - The states agree with each other: positions with lanes, headings and speeds with the motion, accelerations with
      the speeds, and all of them with the start of the scenario. NPCs follow their instructions, and the ego its ADS.
    - A contact of the ego's box with an NPC's is a collision, and the collision agrees with the states.
    - The same scenario gives the same trace to the last bit, whatever ran before.
    - The scenario as executed, ``trace.executed``, gives the same trace.
    - NPCs stay within the world's ``limits``, if these are a :class:`pytest_pafot.NpcLimits`.
    - An ADS that raises, returns no action or hangs ends its own run and does not affect other runs. An ADS that hangs
      is tried only if the world's ``hang_limit`` is at most one second.
    - If the world's class has ``lasting``, its runs are as long as asked, and begin as usual, to the last bit.
    - ``decisions=`` replaces the first decisions, ``take_over`` repeats a run up to a tick, and all declared drivers
      drive, as far as the world has these.
    - ``from_dict`` gives the same world again, if the world's class has that method or if a file can describe the
      world.

    Further runs are made until a collision came up, at most four times as many. If the ADS acts in SI units, their egos
    keep their speed, accelerate and brake.

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
        RuntimeWarning: if no run had a collision, so that nothing about collisions was checked; or if all had an event,
            so that nothing about ``lasting`` was checked.
    """
    _promise(not (lacking := missing(world)), "a world has all that a search needs", f"no {', '.join(lacking)}")
    _check_members(world)
    ways = {} if (found := crossings(world)) is None else {"crossings": found}
    random, within = np.random.default_rng(seed), space_on(world, {**ways, **space}, road_start(world))
    done = [_run(world, scenario, ads) for scenario in (sample(within, random) for _ in range(runs))]
    for each in done:
        _check_form(world, each.scenario, each.trace)
    egos, more = _further(world, done, islice(iter(lambda: sample(within, random), None), MORE * runs))
    every = [*done, *egos, *more]
    for each in every[runs:]:
        _check_form(world, each.scenario, each.trace)
    traces = [each.trace for each in every]
    for trace in traces:
        _check_limits(world, trace)
        _check_road(world, trace)
    _check_motion(traces)
    for each in every:
        _check_start(each.trace)
        _check_contacts(each.trace)
        _check_end(world, each.trace)
        _check_actions(world, each)
    for each in done[::-1]:  # in a different order than before
        scenario, trace = each.scenario, each.trace
        _check_same(trace, _rollout(world, scenario, ads), "the same scenario gives the same trace")
        _check_same(trace, _rollout(world, trace.executed, ads), "the scenario as executed gives the same trace")
    _check_obedience(world, done, [each.trace for each in egos], ads)
    _check_decisions(world, done)
    _check_drivers(world, every)
    _check_batch(world, done, ads)
    _check_lasting(world, done, ads)
    longest = max(done, key=lambda each: each.trace.ticks)
    _check_faults(world, longest.scenario, longest.trace, ads)
    _check_round_trip(world, done[0].scenario, done[0].trace, ads)
    if not any(trace.collision for trace in traces):
        warnings.warn(
            f"check_world: no collision in {len(traces)} runs, so nothing about collisions was checked; give an ads= "
            "that collides, or more runs=, npcs= or genes=",
            RuntimeWarning,
            stacklevel=2,
        )


def _promise(is_kept: bool, promise: str, received: str) -> None:
    if not is_kept:
        raise AssertionError(f"expected that {promise}, received {received}")


@contextmanager
def _no_error(promise: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise AssertionError(f"expected that {promise}, received {error!r}") from error


def _rollout(world: Any, scenario: Scenario, ads: Callable[[], Any], **given: Any) -> Trace:
    with _no_error("a run ends in a trace, whatever the ADS does"):
        trace = rollout_of(world)(scenario, ads, **given)
    _promise(isinstance(trace, Trace), "rollout returns a pafot.Trace", f"{trace!r:.200}")
    return trace


def _run(world: Any, scenario: Scenario, ads: Ads) -> _Done:
    noted = _Noted()
    trace = _rollout(world, scenario, noted.noting(ads))
    is_fresh = noted.made == 1 or not noted.is_known
    _promise(is_fresh, "rollout calls ads_factory once, for a fresh ADS", f"{noted.made} calls")
    return _Done(scenario, ads, trace, noted)


def _constant(action: tuple[float, float]) -> Ads:
    return lambda: lambda *seen: action


def _acts_in_si(done: Sequence[_Done]) -> bool:
    return all(each.noted.is_known and looks_si(each.noted.returned) for each in done)


def _further(world: Any, done: Sequence[_Done], scenarios: Iterator[Scenario]) -> tuple[list[_Done], list[_Done]]:
    """Run further egos in the first scenario, and then in further scenarios until a collision came up.

    The egos have constant actions. If these are not in SI units, there are none, and the ADS of the check drives.
    """
    egos: list[Ads] = [_constant(action) for action in EGOS] if _acts_in_si(done) else []
    first = [_run(world, done[0].scenario, ads) for ads in egos]
    if any(each.trace.error is not None for each in first):
        egos, first = [], []
    more: list[_Done] = []
    for scenario, ads in zip(scenarios, cycle(egos or [done[0].ads]), strict=False):
        if any(each.trace.collision for each in (*done, *first, *more)):
            break
        more.append(_run(world, scenario, ads))
    return first, more


def _check_members(world: Any) -> None:
    """Check the attributes of a world, apart from its runs."""
    for name in ("speed_limit", "longest_run"):
        value = plain_number(getattr(world, name))
        _promise(value is not None and value > 0, f"{name} is a number above 0", f"{getattr(world, name)!r:.100}")
    is_slow = world.speed_limit <= TOP_SPEED
    _promise(is_slow, f"speed_limit is in m/s, at most {TOP_SPEED:g}", f"{world.speed_limit:g}")
    if hasattr(world, "hang_limit"):
        limit = plain_number(world.hang_limit)
        _promise(limit is not None and limit > 0, "hang_limit is a number above 0", f"{world.hang_limit!r:.100}")
    for name in ("reference_drivers", "takes_over"):
        names = getattr(world, name, ())
        are_names = not isinstance(names, str) and all(isinstance(each, str) for each in names)
        _promise(are_names, f"{name} is a tuple of names", f"{names!r:.100}")
    needs = "a world with reference_drivers has rollout_reference"
    _promise(reference_world(world) is not None or not hasattr(world, "reference_drivers"), needs, "none")


def _check_same(first: Trace, second: Trace, promise: str) -> None:
    names = {field.name for field in fields(Trace) if field.init} - {
        "scenario",
        "max_decision_seconds",
    }  # these two may differ
    differ = [name for name in sorted(names) if not _is_same(getattr(first, name), getattr(second, name))]
    _promise(not differ, promise, f"a different {', '.join(differ)} for {first.scenario!r}")


def _is_same(first: Any, second: Any) -> bool:
    """Return whether two values are the same to the last bit."""
    if isinstance(first, np.ndarray):
        return isinstance(second, np.ndarray) and (first.shape, first.tobytes()) == (second.shape, second.tobytes())
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(_is_same, first, second))
    return bool(first == second)


def _check_form(world: Any, scenario: Scenario, trace: Trace) -> None:
    """Check the parts of a trace that test functions, measures and report pages read."""
    _promise(trace.error is None, "the ADS of the check drives in this world", f"{trace.error}; give a different ads=")
    states, start = trace.states, trace.states[0]
    _promise(states.shape[1] == len(scenario.npcs) + 1, "states contain the ego and each NPC", f"shape {states.shape}")
    ways = [None if told is None else told.zone for told in scenario.crossings]
    crossing = np.array([isinstance(chain[0], CrossingInstruction) for chain in scenario.npcs])
    on_way = np.full((len(states), len(scenario.npcs)), np.nan) if trace.on_way is None else trace.on_way
    track = np.zeros((1, len(crossing), 1)) if trace.track is None else trace.track[:, 1:]
    rates = [plain_whole(rate) for rate in (trace.physics_hz, trace.ads_hz)]
    _promise(
        all(rate is not None and rate > 0 for rate in rates), "physics_hz and ads_hz are whole numbers", f"{rates}"
    )
    _promise(
        abs(start[0, SPEED] - scenario.ego_speed) <= AT_START,
        "the ego starts as fast as the scenario says, states[0, 0, SPEED] at scenario.ego_speed",
        f"{start[0, SPEED]:.2f} m/s for {scenario.ego_speed:g} m/s",
    )
    _promise(len(trace.lanes) > 0, "lanes has the lanes of the road", "none")
    promises = {
        "trace.scenario is the requested scenario": trace.scenario == scenario,
        "trace.executed has a chain for each NPC": len(trace.executed.npcs) == len(scenario.npcs),
        "states are finite": np.isfinite(states).all(),
        "vehicles have a length and a width": (trace.sizes > 0).all(),
        "sizes has the length before the width": (trace.sizes[:, 0] >= trace.sizes[:, 1]).all(),
        "the column lane is an index of lanes, or -1": np.isin(states[..., LANE], range(-1, len(trace.lanes))).all(),
        "ads_hz divides physics_hz": trace.physics_hz % trace.ads_hz == 0,
        "no run is longer than longest_run": trace.duration <= world.longest_run + trace.dt,
        "there is a collision if the outcome says so": (trace.outcome is Outcome.COLLISION) == bool(trace.collision),
        "acceleration and steering of the first row are 0": not start[:, [ACCELERATION, STEERING]].any(),
        "zones are those of the instructions": [None if zone is None else zone.way for zone in trace.zones] == ways,
        "on_way has the places of crossing NPCs, and NaN for others": (np.isfinite(on_way) == crossing).all(),
        "track is recorded if an NPC crosses": trace.track is not None or not crossing.any(),
        "track has NaN only for crossing NPCs": not np.isnan(track[:, ~crossing]).any(),
    }
    for promise, is_kept in promises.items():
        _promise(bool(is_kept), promise, f"something else in {trace!r}")
    pairs = combinations(range(len(trace.sizes)), 2)
    touching = [pair for pair in pairs if _depths(trace, *pair, slice(1))[0][0] > 0]
    _promise(not touching, "no vehicles touch at the start", " and ".join(map(_name, next(iter(touching), ()))))
    with _no_error("Run(trace).explain() describes the run"):
        Run(trace).explain()


def _check_road(world: Any, trace: Trace) -> None:
    """Check that the lanes are lanes, and that each vehicle is in the lane that its state names."""
    for number, lane in enumerate(trace.lanes):
        sizes = (lane.length, lane.width, lane.speed_limit)
        _promise(
            all(math.isfinite(each) and each > 0 for each in sizes),
            f"lanes[{number}] has a length, a width and a speed_limit",
            f"{lane}",
        )
    limits = [lane.speed_limit for lane in trace.lanes]
    _promise(
        world.speed_limit / 3 <= max(limits) <= 3 * world.speed_limit,
        "lanes have a speed_limit in m/s that fits the world's speed_limit",
        f"{max(limits):g} and {world.speed_limit:g}",
    )
    is_straight = trace.track is None and not any(lane.points for lane in trace.lanes)
    if is_straight:
        _check_straight_lanes(trace.lanes)
    for number, lane in enumerate(trace.lanes):
        for vehicle in range(trace.states.shape[1]):
            is_there = trace.states[:, vehicle, LANE] == number
            away = _from_centre_line(lane, trace.states[is_there, vehicle][:, [X, Y]])
            if not len(away):
                continue
            is_far = bool((away > lane.width).any())
            is_often_out = len(away) >= LEAST and bool((away > lane.width / 2 + DEEP).mean() > OUTLIERS)
            _promise(
                not is_far and not is_often_out,
                f"states[..., X] and states[..., Y] of {_name(vehicle)} are within the lane of states[..., LANE], with "
                "y to the right of the driving direction",
                f"{away.max():.1f} m from the centre line of lanes[{number}], which is {lane.width:g} m wide",
            )
    if is_straight:
        _check_off_road(trace)


def _name(vehicle: int) -> str:
    return f"NPC {vehicle - 1}" if vehicle else "the ego"


def _check_straight_lanes(lanes: Sequence[Lane]) -> None:
    shares: list[float] = []  # of the distances of neighbours in the widths of lanes
    for number, (left, right) in enumerate(pairwise(lanes)):
        across = (right.y - left.y) * math.cos(left.heading) - (right.x - left.x) * math.sin(left.heading)
        is_alike = math.cos(right.heading - left.heading) > math.cos(0.1)
        _promise(
            not is_alike or across > 0,
            "lanes are listed from the left, with y to the right of the driving direction",
            f"lanes[{number + 1}] {-across:g} m to the left of lanes[{number}]",
        )
        shares.append(across / ((left.width + right.width) / 2) if is_alike else 1.0)
    # Between two lanes there may be room, but not between all of them.
    is_width = not shares or (min(shares) >= 0.6 and (len(shares) == 1 or min(shares) <= 1.5))
    _promise(is_width, "lanes[...].width is the width of a lane", f"lanes {max(shares, default=1):.2g} widths apart")


def _from_centre_line(lane: Lane, places: FloatArray) -> FloatArray:
    """Return the distances of places [m] from the centre line of a lane, shape [places]."""
    end = lane.x + lane.length * math.cos(lane.heading), lane.y + lane.length * math.sin(lane.heading)
    line = np.array(lane.points if len(lane.points) > 1 else [(lane.x, lane.y), end])
    nearest = np.full(len(places), np.inf)
    for start, stop in pairwise(line):
        way = stop - start
        share = np.clip((places - start) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
        nearest = np.minimum(nearest, np.hypot(*(places - start - share[:, None] * way).T))
    return nearest


def _check_off_road(trace: Trace) -> None:
    """Check that a vehicle in a lane of a straight road has no lane of -1, and that leaving the road is an outcome."""
    for vehicle in range(trace.states.shape[1]):
        off = trace.states[trace.states[:, vehicle, LANE] < 0, vehicle][:, [X, Y]]
        inside = [_from_centre_line(lane, off) < lane.width / 2 - DEEP for lane in trace.lanes]
        wrong = int(np.any(inside, axis=0).sum())
        _promise(
            wrong <= OUTLIERS * len(trace.states),
            f"states[..., LANE] of {_name(vehicle)} is -1 only off the road",
            f"-1 within a lane at {wrong} of {len(trace.states)} ticks",
        )


def _check_start(trace: Trace) -> None:
    """Check the start of a run on a straight road against the scenario."""
    scenario, start = trace.scenario, trace.states[0]
    if trace.track is not None or any(lane.points for lane in trace.lanes):
        return
    lane = int(start[0, LANE])
    _promise(
        lane == scenario.ego_lane, "the ego starts in scenario.ego_lane, states[0, 0, LANE]", f"{lane} in {scenario!r}"
    )
    positions = RelativePositions(trace.states[:1], trace.sizes, trace.lanes)
    for npc, (chain_, row) in enumerate(zip(trace.executed.npcs, start[1:], strict=True)):
        _promise(
            abs(row[SPEED] - scenario.ego_speed) <= 10 * AT_START,
            f"NPC {npc} starts as fast as the ego, at scenario.ego_speed",
            f"states[0, {npc + 1}, SPEED] {row[SPEED]:.2f} m/s for {scenario.ego_speed:g} m/s",
        )
        if not isinstance(chain_[0], PositionInstruction):
            continue
        cell, ahead = chain_[0].cell, float(positions.ahead[npc, 0])
        wanted = scenario.ego_lane + cell.column
        reach = float(trace.sizes[[0, npc + 1], 0].sum())
        is_in_row = ahead * cell.row > 0 if cell.row else abs(ahead) <= 1.5 * reach
        is_in_column = row[LANE] == wanted or not 0 <= wanted < len(trace.lanes)
        _promise(
            is_in_row and is_in_column,
            f"NPC {npc} starts in the cell of its first instruction in trace.executed, cell {int(cell)}",
            f"{ahead:.1f} m ahead of the ego in lane {int(row[LANE])}, the ego in lane {lane}",
        )


def _check_end(world: Any, trace: Trace) -> None:
    """Check that a run lasts as long as its outcome says."""
    scenario, off = trace.scenario, np.flatnonzero(trace.ego[:, LANE] < 0)
    if not scenario.crossings:
        longest = min(float(world.longest_run), scenario.seconds)
        _promise(
            trace.duration <= longest + 1.5 * trace.dt, f"a run of {longest:g} s is no longer", f"{trace.duration:g} s"
        )
        is_whole = trace.outcome is not Outcome.SAFE or trace.duration >= longest - 2.5 * trace.dt
        _promise(
            is_whole or trace.track is not None,
            f"states of a run with the outcome safe last {longest:g} s, with physics_hz rows a second",
            f"{trace.ticks} ticks at {trace.physics_hz} Hz, {trace.duration:g} s",
        )
    first = int(off[0]) if len(off) else None
    told = f"off_road_tick {trace.off_road_tick}, outcome {trace.outcome}, and the first such row of states {first}"
    _promise(
        trace.off_road_tick in (None, first), "off_road_tick is the first tick with the ego in lane -1, or None", told
    )
    _promise(
        not (trace.outcome is Outcome.OFF_ROAD and first is None) and not (trace.outcome is Outcome.SAFE and len(off)),
        "the outcome is off_road if the ego was in lane -1 and nothing else ended the run",
        told,
    )
    if trace.arrivals:
        _check_arrivals(trace)


def _check_arrivals(trace: Trace) -> None:
    scenario, most = trace.scenario, trace.scenario.genes
    count, genes = len(trace.arrivals), max((len(each) for each in trace.arrivals), default=0)
    _promise(count == len(scenario.npcs), "arrivals has one entry for each NPC", f"{count}")
    _promise(genes <= most, "arrivals has at most one tick for each gene", f"{genes} for {most} genes")
    if scenario.crossings:
        return
    length = scenario.gene_seconds * trace.physics_hz
    for npc, ticks in enumerate(trace.arrivals):
        for gene, tick in enumerate(ticks):
            if tick is None:
                continue
            is_tick = plain_whole(tick) is not None and 0 <= tick <= trace.ticks
            _promise(
                is_tick and gene * length - 1 <= tick <= (gene + 1) * length + 1,
                f"arrivals[{npc}][{gene}] is a tick of this gene, or None",
                f"{tick!r} for ticks {gene * length:g} to {(gene + 1) * length:g}",
            )


def _check_motion(traces: Sequence[Trace]) -> None:
    """Check that headings, speeds, accelerations and steering describe the motion of the vehicles."""
    sideways: list[FloatArray] = []
    errors: list[FloatArray] = []
    turns: list[FloatArray] = []
    for trace in traces:
        last = trace.ticks + 1 - (trace.collision is not None)  # An impact changes speeds at once.
        states, dt = trace.states[:last], trace.dt
        if len(states) < 2:
            continue
        speed = states[..., SPEED]
        _promise(
            bool((np.abs(states[..., STEERING]) <= math.pi / 2).all()),
            "states[..., STEERING] is in rad",
            f"{np.abs(states[..., STEERING]).max():.2f}",
        )
        steps = np.diff(states[..., [X, Y]], axis=0)
        forwards, pace = np.where(speed[1:] < 0, -1.0, 1.0), np.abs(speed)  # A world may let a vehicle reverse.
        driven, by_speed = np.hypot(steps[..., 0], steps[..., 1]), (pace[1:] + pace[:-1]) / 2 * dt
        share, jump = DISTANCE
        least, most = np.minimum(pace[1:], pace[:-1]) * dt, np.maximum(pace[1:], pace[:-1]) * dt
        is_odd = (driven < least / 2 - 0.1) | (driven > 1.5 * most + 0.1)
        for vehicle, (metres, by, odd) in enumerate(zip(driven.sum(0), by_speed.sum(0), is_odd.T, strict=True)):
            is_alike = abs(metres - by) <= share * max(metres, by) + jump
            _promise(
                is_alike and not (len(odd) >= LEAST and odd.mean() > OUTLIERS),
                f"states[..., SPEED] of {_name(vehicle)} is its speed along its way, in m/s at {trace.physics_hz} Hz",
                f"{metres:.1f} m driven and {by:.1f} m by the speeds, and {int(odd.sum())} of {len(odd)} ticks apart",
            )
        # Over half a second, since speeds may be rounded, and an acceleration may be that of the tick before.
        window = max(round(SMOOTH * trace.physics_hz), 1)
        gained = np.vstack([np.zeros_like(speed[:1]), np.cumsum(states[1:, :, ACCELERATION] * dt, axis=0)])
        both = [(each[window:] - each[:-window]) / (window * dt) for each in (speed, gained)]
        errors.append(np.stack(both, axis=-1).reshape(-1, 2))
        is_moving = (driven > MOVING * dt) & (pace[1:] > MOVING)
        course = np.arctan2(forwards * steps[..., 1], forwards * steps[..., 0])
        slip = np.abs(_wrapped(course - states[1:, :, HEADING]))
        for vehicle, (away, moving) in enumerate(zip(slip.T, is_moving.T, strict=True)):
            if moving.sum() < LEAST:
                continue
            _promise(
                float(np.median(away[moving])) <= DIRECTION,
                f"states[..., HEADING] of {_name(vehicle)} is the direction of its motion in rad, 0 along x and "
                "growing clockwise, towards y",
                f"{np.median(away[moving]):.2f} rad between heading and motion at half of the ticks",
            )
        turn = _wrapped(np.diff(states[..., HEADING], axis=0))
        turns.append(np.stack([turn, states[1:, :, STEERING]], axis=-1)[is_moving])
        if trace.track is not None or any(lane.points for lane in trace.lanes):
            continue
        along = trace.lanes[0].heading
        _promise(
            is_moving.sum() < LEAST or float(np.median(np.cos(course[is_moving] - along))) > 0.7,
            "lanes[...].heading is the driving direction in rad",
            f"{along:g}, and vehicles that move at {float(np.median(course[is_moving])):.2f} rad",
        )
        angles = np.stack([_wrapped(course - along), states[1:, :, HEADING] - along], axis=-1)[is_moving]
        sideways.append(angles[(np.abs(angles[:, 0]) > 0.02) & (np.abs(angles[:, 0]) < 0.5)])
    _check_pooled(sideways, errors, turns)


def _check_pooled(sideways: Sequence[FloatArray], errors: Sequence[FloatArray], turns: Sequence[FloatArray]) -> None:
    """Check what shows only in the motion of many runs: lateral motion, accelerations and steering."""
    pairs = np.concatenate([np.zeros((0, 2)), *sideways])
    course, heading = pairs.T
    # A world without headings, in which all of them are along the road, is no mistake that matters.
    agree = (np.abs(heading) < 0.01) | ((course * heading > 0) & (np.abs(heading) <= 3 * np.abs(course) + 0.1))
    _promise(
        len(pairs) < LEAST or float(agree.mean()) >= 0.5,
        "states[..., HEADING] is the direction of motion in rad, and grows clockwise, towards y",
        f"headings against lateral motion at {int((~agree).sum())} of {len(pairs)} ticks, such as "
        f"{_first(heading, ~agree):.3f} for a motion at {_first(course, ~agree):.3f} rad",
    )
    found, told = np.concatenate([np.zeros((0, 2)), *errors]).T
    error, size = (float(np.sqrt(np.mean(np.square(each)))) if len(each) else 0.0 for each in (told - found, found))
    _promise(
        error <= DEEP + 0.3 * size,
        "states[..., ACCELERATION] is the acceleration that led to a row, in m/s^2, the difference of its speeds",
        f"a root mean square difference of {error:.2f} m/s^2, where the speeds have {size:.2f} m/s^2",
    )
    turned, steered = np.concatenate([np.zeros((0, 2)), *turns]).T
    is_known = (np.abs(turned) > 1e-4) & (np.abs(steered) > 1e-3)
    norm = float(np.linalg.norm(turned[is_known]) * np.linalg.norm(steered[is_known]))
    _promise(
        is_known.sum() < LEAST or float(turned[is_known] @ steered[is_known]) >= -0.5 * norm,
        "states[..., STEERING] is positive where the vehicle turns clockwise, to the right",
        "the opposite",
    )


def _first(values: FloatArray, which: npt.NDArray[np.bool_]) -> float:
    return float(values[which][0]) if which.any() else 0.0


def _wrapped(angles: FloatArray) -> FloatArray:
    """Return angles as the same angles from -pi to pi [rad]."""
    wrapped: FloatArray = (angles + np.pi) % (2 * np.pi) - np.pi
    return wrapped


def _depths(trace: Trace, first: int, second: int, rows: slice = slice(None)) -> tuple[FloatArray, FloatArray]:
    """Return how deep the boxes of two vehicles overlap in some rows [m]: at least, and at most.

    Some worlds find contacts with boxes that do not turn. So on straight roads the boxes are also taken along the road.
    """
    found, states = [], trace.states[rows]
    headings = states[..., HEADING]
    is_straight = trace.track is None and not any(lane.points for lane in trace.lanes)
    for heading in (headings, np.full_like(headings, trace.lanes[0].heading)) if is_straight else (headings,):
        boxes = [
            Boxes.driving(
                states[:, each, X],
                states[:, each, Y],
                heading[:, each],
                states[:, each, SPEED],
                *(np.full(len(states), size) for size in trace.sizes[each]),
            )
            for each in (first, second)
        ]
        found.append(depth(relate(*boxes)))
    return np.min(found, axis=0), np.max(found, axis=0)


def _check_contacts(trace: Trace) -> None:
    """Check that the ego's box touches an NPC's at a collision, at no other tick, and as the collision says."""
    hit, states = trace.collision, trace.states
    if trace.outcome is Outcome.INVALID:
        pairs = list(combinations(range(1, states.shape[1]), 2))
        gap = min((_gap(trace, *pair) for pair in pairs), default=np.inf)
        _promise(gap <= DEEP, "boxes of two NPCs touch at the end of a run with the outcome invalid", f"{gap:.1f} m")
    for npc in range(len(trace.scenario.npcs)):
        least, _ = _depths(trace, 0, npc + 1)
        end = trace.ticks + 1 if hit is None or hit.npc != npc else trace.ticks
        step = np.hypot(*(_velocities(trace, npc)[-1])) * trace.dt if hit is not None else 0.0
        deep = least[:end] > DEEP + np.where(np.arange(end) >= trace.ticks - 1, step, 0.0)
        _promise(
            not deep.any(),
            "the ego's box touches no NPC's before the end of a run, and then the outcome is collision: "
            "states[..., X], states[..., Y] and states[..., HEADING] are of the centres of boxes with sizes",
            f"an overlap of {_first(least[:end], deep):.1f} m with NPC {npc} at tick {int(deep.argmax())} of "
            f"{trace.ticks}, outcome {trace.outcome}",
        )
    if hit is not None:
        _check_collision(trace, hit)


def _velocities(trace: Trace, npc: int) -> FloatArray:
    """Return the velocities of an NPC relative to the ego in the last two rows [m/s], shape [2, 2]."""
    rows = trace.states[-2:][:, [0, npc + 1]]
    velocity = rows[..., SPEED, None] * np.stack([np.cos(rows[..., HEADING]), np.sin(rows[..., HEADING])], axis=-1)
    difference: FloatArray = velocity[:, 1] - velocity[:, 0]
    return difference


def _gap(trace: Trace, first: int, second: int) -> float:
    """Return the gap of two boxes at the end [m], less what both vehicles drive in a tick towards each other."""
    _, most = _depths(trace, first, second)
    speeds = trace.states[-2:, [first, second], SPEED]
    return float(-most[-1] - np.abs(speeds[:, 0] - speeds[:, 1]).max() * trace.dt)


def _check_collision(trace: Trace, hit: Collision) -> None:
    """Check each field of a collision against the states."""
    npcs, hz = len(trace.scenario.npcs), trace.physics_hz
    _promise(hit.tick == trace.ticks, "collision.tick is the last tick of the run", f"{hit.tick} of {trace.ticks}")
    _promise(
        abs(hit.time - hit.tick / hz) <= 0.5 / hz,
        "collision.time is the time of collision.tick, tick / physics_hz",
        f"{hit.time:g} s for tick {hit.tick} at {hz} Hz, which is {hit.tick / hz:g} s",
    )
    is_npc = plain_whole(hit.npc) is not None and 0 <= hit.npc < npcs
    _promise(is_npc, "collision.npc is the index of an NPC in the scenario", f"{hit.npc!r} of {npcs}")
    gaps = [_gap(trace, 0, npc + 1) for npc in range(npcs)]
    told = f"a gap of {gaps[hit.npc]:.1f} m to NPC {hit.npc} at tick {hit.tick}"
    if gaps[hit.npc] > APART and min(gaps) <= 0:
        _promise(False, "collision.npc is the NPC that the ego touches", f"{told}, NPC {int(np.argmin(gaps))} touches")
    _promise(
        gaps[hit.npc] <= APART,
        "the boxes of the ego and of collision.npc touch at a collision: states[..., X], states[..., Y] and "
        "states[..., HEADING] are of the centres of boxes with sizes",
        told,
    )
    rows = trace.states[-2:]
    for name, vehicle, given in (("ego_speed", 0, hit.ego_speed), ("npc_speed", hit.npc + 1, hit.npc_speed)):
        speeds = rows[:, vehicle, SPEED]
        _promise(
            speeds.min() - DEEP <= given <= speeds.max() + DEEP,
            f"collision.{name} is the speed of {_name(vehicle)} at the impact in m/s",
            f"{given:g}, states[..., SPEED] {speeds[-1]:.1f}",
        )
    closing = [*np.hypot(*_velocities(trace, hit.npc).T), *np.abs(rows[:, 0, SPEED] - rows[:, hit.npc + 1, SPEED])]
    _promise(
        min(closing) - 1.0 <= hit.closing_speed <= 1.1 * max(closing) + 1.0 and hit.closing_speed >= 0,
        "collision.closing_speed is the difference of the two velocities at the impact in m/s",
        f"{hit.closing_speed:g}, the states have {closing[-3]:.1f}",
    )
    _check_side(trace, hit)


def _check_side(trace: Trace, hit: Collision) -> None:
    """Check that the side and the cell of a collision do not contradict the states at the tick before."""
    ego, npc = trace.states[max(hit.tick - 1, 0), [0, hit.npc + 1]]
    x, y, cos, sin = npc[X] - ego[X], npc[Y] - ego[Y], math.cos(ego[HEADING]), math.sin(ego[HEADING])
    ahead, right = x * cos + y * sin, y * cos - x * sin
    is_there = {"front": ahead > -APART, "rear": ahead < APART, "right": right > -APART, "left": right < APART}
    told = (
        f"{hit.side!r}, with the NPC {ahead:.1f} m ahead and {right:.1f} m to the right of the ego at the tick before"
    )
    _promise(is_there.get(hit.side, False), "collision.side is the side of the ego that was hit", told)
    # At a corner, either of two sides is right. In line, only one of them is.
    length, width = (trace.sizes[0] + trace.sizes[hit.npc + 1]) / 2
    is_in_line = abs(right) < width - DEEP and abs(ahead) > length - DEEP
    is_beside = abs(ahead) < length - 2 * DEEP and abs(right) > width - DEEP
    sides = ("front", "rear") if is_in_line else ("left", "right") if is_beside else tuple(is_there)
    _promise(hit.side in sides, "collision.side is the side of the ego that was hit", told)
    is_bent = any(lane.points for lane in trace.lanes)
    if hit.cell is None:
        _promise(trace.track is not None or is_bent, "collision.cell is a cell", "None")
        return
    _promise(isinstance(hit.cell, Cell), "collision.cell is a pafot.Cell", f"{hit.cell!r}")
    if trace.track is None and is_bent:
        return
    positions = RelativePositions(trace.states, trace.sizes, trace.lanes, trace.track)
    now = (positions.last_cell(hit.npc, hit.tick), positions.last_cell(hit.npc, max(hit.tick - 1, 0)))
    near = {each for cell in now if cell is not None for each in (cell, *cell.neighbours)}
    _promise(
        not near or hit.cell in near,
        "collision.cell is the cell of the NPC at the impact, or before it came into the ego's own cell",
        f"{hit.cell!r}, the states have {now[0]!r}",
    )


def _check_actions(world: Any, done: _Done) -> None:
    """Check that an ADS decides as often as ads_hz says, and that a run records each of its decisions."""
    trace, noted = done.trace, done.noted
    every = trace.physics_hz // trace.ads_hz
    if not noted.is_known:
        return
    wanted, made = -(-trace.ticks // every), len(noted.returned)
    _promise(
        wanted <= made <= wanted + 1,
        "the ADS decides ads_hz times a second, for the first time at the start",
        f"{made} decisions in {trace.ticks} ticks, with physics_hz {trace.physics_hz} and ads_hz {trace.ads_hz}",
    )
    if trace.track is None and len(noted.poses) == len(noted.returned):
        rows = trace.ego[: len(noted.poses) * every : every][:, [X, Y, SPEED]]
        apart = np.abs(rows - np.array(noted.poses).reshape(-1, 3)[: len(rows)])
        for name, off in zip(("states[..., X]", "states[..., Y]", "states[..., SPEED]"), apart.T, strict=True):
            _promise(
                float(np.median(off)) <= 2 * DEEP,
                f"an ADS that receives a pafot.Observation, or an object with its fields, sees the ego as in {name}",
                f"a difference of {np.median(off):.2f} at half of the decisions",
            )
    if not trace.actions and resumable(world) is None:
        return  # Only worlds with decisions= are asked to repeat actions.
    _promise(len(trace.actions) == made, "actions has one action for each decision", f"{len(trace.actions)} for {made}")
    odd = next((n for n, pair in enumerate(zip(trace.actions, noted.returned, strict=True)) if not _alike(*pair)), None)
    _promise(
        odd is None,
        "actions are those that the ADS returned",
        "" if odd is None else f"{trace.actions[odd]!r:.100} for {noted.returned[odd]!r:.100} as actions[{odd}]",
    )


def _alike(first: Any, second: Any) -> bool:
    """Return whether two actions have the same numbers; True for actions that are no numbers."""
    try:
        numbers = [np.asarray(each, dtype=float) for each in (first, second)]
    except (TypeError, ValueError):
        return True
    return numbers[0].size == numbers[1].size and bool(np.allclose(numbers[0].ravel(), numbers[1].ravel()))


def _check_obedience(world: Any, done: Sequence[_Done], egos: Sequence[Trace], ads: Ads) -> None:
    """Check that NPCs follow the scenario and the ego its ADS, because other instructions give other runs."""
    tried = [each for each in done if not each.scenario.crossings]
    is_told = any(each.scenario.genes > 1 or each.trace.duration >= LONG for each in tried)
    is_ignored = True
    for each in tried:
        trace, gene_seconds = each.trace, each.scenario.gene_seconds
        other = _rollout(world, _otherwise(each.scenario, float(world.speed_limit)), ads)
        is_ignored &= _is_same(trace.npcs, other.npcs)
        rows = math.floor(gene_seconds * trace.physics_hz) if each.scenario.genes > 1 else 0
        first, second = trace.states[:rows], other.states[:rows]
        _promise(
            first.shape == second.shape and np.allclose(first, second, rtol=0.0, atol=ROUNDING),
            f"states depend only on the first instructions until scenario.gene_seconds, here {gene_seconds:g} s",
            "other states with other instructions for later",
        )
    _promise(
        not (is_told and is_ignored), "NPCs follow their instructions", "the same states[:, 1:] for other instructions"
    )
    if not egos:
        return
    steady, faster, slower = egos
    ticks = min(trace.ticks for trace in (steady, faster, slower))
    speeds = [float(trace.ego[ticks, SPEED]) for trace in (slower, steady, faster)]
    is_obeyed = speeds[0] < speeds[1] - ROUNDING or speeds[1] < speeds[2] - ROUNDING
    _promise(
        ticks < steady.physics_hz or is_obeyed,
        "the ego follows its ADS, states[:, 0, SPEED]",
        "{:.1f}, {:.1f} and {:.1f} m/s for an ADS that brakes, does nothing and accelerates".format(*speeds),
    )


def _otherwise(scenario: Scenario, speed_limit: float) -> Scenario:
    """Return a scenario in which NPCs stay in their first cells, at other speeds, after their first instruction.

    An NPC may keep to its speed only in its cell, so both are different. An only instruction gets another speed.
    """

    def other(first: Gene, gene: Gene) -> Gene:
        speed = speed_limit - gene.speed
        if isinstance(first, PositionInstruction):
            return PositionInstruction(first.cell, speed)
        return replace(gene, speed=speed)

    since = 1 if scenario.genes > 1 else 0
    npcs = [(*one[:since], *(other(one[0], gene) for gene in one[since:])) for one in scenario.npcs]
    return replace(scenario, npcs=tuple(npcs))


def _check_decisions(world: Any, done: Sequence[_Done]) -> None:
    """Check that ``decisions=`` replaces the first decisions of an ADS, which then goes on from there."""
    if resumable(world) is None:
        return
    for each in done:
        trace, actions = each.trace, each.trace.actions
        if not each.noted.is_known or len(actions) < 2:
            continue
        is_si = looks_si(actions)
        half, every = len(actions) // 2, trace.physics_hz // trace.ads_hz
        for count in (half, len(actions)):
            noted = _Noted()
            other = _constant((-6.0, 0.0)) if is_si else each.ads
            again = _rollout(world, each.scenario, noted.noting(other), decisions=actions[:count])
            rows = count * every + 1
            recorded, repeated = trace.states[:rows], again.states[:rows]
            is_repeated = recorded.shape == repeated.shape and np.allclose(recorded, repeated, rtol=0.0, atol=ROUNDING)
            _promise(
                is_repeated,
                "decisions= replaces the first decisions, so a run with trace.actions repeats states",
                f"other states in the first {min(rows, len(recorded))} rows with {count} decisions",
            )
            asked = len(again.actions) - count
            _promise(
                len(noted.returned) == asked and all(map(_alike, again.actions[:count], actions[:count])),
                "decisions= replaces calls of the ADS, and actions has both",
                f"{len(noted.returned)} calls and {len(again.actions)} actions after {count} decisions",
            )


def _check_drivers(world: Any, done: Sequence[_Done]) -> None:
    """Check that all drivers that a world declares can drive, and take over."""
    known, first = reference_world(world), done[0]
    if known is not None:
        for name in known.reference_drivers:
            with _no_error(f"rollout_reference runs the declared driver {name!r}"):
                trace, again = (known.rollout_reference(first.scenario, name) for _ in range(2))
            _promise(isinstance(trace, Trace), "rollout_reference returns a pafot.Trace", f"{trace!r:.200}")
            _check_form(world, first.scenario, trace)
            _check_same(trace, again, f"rollout_reference gives the same trace again for {name!r}")
    if not hasattr(world, "take_over"):
        return
    # The runs that differ most from those of any driver are those of the egos that accelerate and brake.
    tried = sorted(done, key=lambda each: (each.trace.collision is None, -abs(float(np.ptp(each.trace.ego[:, SPEED])))))
    for name in (*getattr(world, "reference_drivers", ()), *getattr(world, "takes_over", ())):
        is_other = False
        for each in tried[:4]:
            trace = each.trace
            every = trace.physics_hz // trace.ads_hz
            tick = trace.ticks // 2 // every * every
            with _no_error(f"take_over runs the declared driver {name!r}"):
                taken = world.take_over(trace, tick, name)
            _promise(isinstance(taken, Trace), "take_over returns a pafot.Trace", f"{taken!r:.200}")
            recorded, repeated = trace.states[: tick + 1], taken.states[: tick + 1]
            is_same = recorded.shape == repeated.shape and np.allclose(recorded, repeated, rtol=0.0, atol=ROUNDING)
            _promise(is_same, f"take_over repeats the run up to its tick with {name!r}", "other states before it")
            _check_form(world, taken.scenario, taken)
            _promise(
                taken.ticks > tick or trace.ticks == tick, "take_over drives on after its tick", f"{taken.ticks} ticks"
            )
            rows = min(len(trace.states), len(taken.states))
            is_other |= not np.allclose(taken.ego[:rows], trace.ego[:rows], rtol=0.0, atol=ROUNDING)
            if name == STEADY_BRAKING:
                is_braking = taken.collision is not None or brakes_untouched(taken, tick)
                _promise(is_braking, "steady-braking brakes with 6 m/s^2 in its lane until it stands", f"{taken!r}")
        # Without a collision or another ego, a driver may have nothing else to do than the ADS.
        is_seen = is_other or not any(each.trace.collision for each in tried[:4])
        _promise(is_seen, f"take_over lets {name!r} drive after its tick", "the states of the run without it")


def _check_batch(world: Any, done: Sequence[_Done], ads: Ads) -> None:
    """Check that runs in lock step give the traces of single runs, if the ADS of the check decides for many."""
    together = lock_stepping(world)
    if together is None or is_vehicle_class(ads) or wants_env(ads) or not hasattr(ads(), "batch"):
        return
    with _no_error("rollout_batch runs scenarios"):
        traces = simulate_batch(together, [each.scenario for each in done], ads)
    _promise(len(traces) == len(done), "rollout_batch returns one trace for each scenario", f"{len(traces)}")
    for each, trace in zip(done, traces, strict=True):
        _check_same(each.trace, trace, "rollout_batch gives the traces of rollout")


def _check_limits(world: Any, trace: Trace) -> None:
    limits, npcs, dt = getattr(world, "limits", None), trace.npcs, trace.dt
    if not isinstance(limits, NpcLimits):
        return
    speed = npcs[..., SPEED]
    acceleration = np.concatenate([np.zeros_like(speed[:1]), np.diff(speed, axis=0) / dt])
    is_standing = (speed[1:] <= ROUNDING) | (speed[:-1] <= ROUNDING)
    jerk = np.where(is_standing, 0.0, np.diff(acceleration, axis=0) / dt)
    turns = (np.diff(npcs[..., HEADING], axis=0) + np.pi) % (2 * np.pi) - np.pi
    angle = npcs[..., HEADING] - trace.lanes[0].heading if trace.track is None else trace.track[:, 1:, ANGLE]
    angle = angle[..., [zone is None for zone in trace.zones] if trace.zones else slice(None)]
    for name, values, low, high in (
        ("speed", speed, 0.0, limits.overspeed * world.speed_limit),
        ("acceleration", acceleration, -limits.braking, limits.acceleration),
        ("jerk", jerk, -limits.jerk, limits.jerk),
        ("heading", angle, -limits.heading, limits.heading),
        ("lateral acceleration", speed[:-1] * turns / dt, -limits.lateral_acceleration, limits.lateral_acceleration),
    ):
        least, most = float(np.min(values, initial=0.0)), float(np.max(values, initial=0.0))
        is_kept = low - ROUNDING <= least and most <= high + ROUNDING
        _promise(is_kept, f"the {name} of NPCs is from {low:g} to {high:g}", f"{least:g} to {most:g}")


def _check_lasting(world: Any, done: Sequence[_Done], ads: Ads) -> None:
    """Check that a run that lasts longer is as long as asked for, and begins as usual."""
    make = lasting(world)
    if make is None:
        return
    whole = [each for each in done if each.trace.outcome is Outcome.SAFE][:LONGER]
    if not whole:
        warnings.warn(
            f"check_world: no run without an event among {len(done)} runs, so nothing about lasting was checked; give "
            "an ads= that avoids collisions, or more runs=",
            RuntimeWarning,
            stacklevel=3,
        )
    for number, each in enumerate(whole):
        trace, seconds = each.trace, each.trace.duration + 2.0 + number / 5  # other times for runs of one length
        with _no_error("lasting returns a world"):
            other = make(seconds)
        _promise(not missing(other), "lasting returns a world", f"{other!r:.100}")
        longer = _rollout(other, each.scenario, ads)
        begins = _is_same(trace.states, longer.states[: len(trace.states)]) and len(trace.lanes) == len(longer.lanes)
        _promise(
            begins, "a run in the world of lasting begins as usual", f"other states or lanes for {each.scenario!r}"
        )
        # An event may end it earlier.
        least = seconds if longer.outcome is Outcome.SAFE else trace.duration
        _promise(
            least - trace.dt - ROUNDING <= longer.duration <= seconds + trace.dt + ROUNDING,
            "a run in the world of lasting lasts as long as asked",
            f"{longer.duration:g} s for {seconds:g} s, for {each.scenario!r}",
        )


def _check_faults(world: Any, scenario: Scenario, healthy: Trace, ads: Ads) -> None:
    limit = hang_limit(world)
    faults: list[tuple[str, Callable[[], Any], Outcome]] = [
        ("raises", lambda: 1 / 0, Outcome.ADS_ERROR),
        ("returns None", lambda: None, Outcome.ADS_ERROR),
        ("hangs", lambda: time.sleep(6 * limit), Outcome.HANG),
    ]
    for name, fault, outcome in faults if limit <= 1.0 else faults[:-1]:
        trace = _rollout(world, scenario, partial(_failing_ads, ads, fault))
        is_kept = trace.outcome is outcome and trace.error is not None
        _promise(is_kept, f"an ADS that {name} ends its run as {outcome}", f"{trace.outcome}, {trace.error}")
        every = healthy.physics_hz // healthy.ads_hz
        tick = None if trace.error is None else trace.error.tick
        wanted = GOOD_DECISIONS * every
        _promise(
            tick == wanted and trace.ticks == tick,
            f"error.tick is the tick of the decision of an ADS that {name}, at which its run ends",
            f"{tick} in a run of {trace.ticks} ticks for decision {GOOD_DECISIONS}, at tick {wanted}",
        )
        rows = trace.states, healthy.states[: wanted + 1]
        is_same = rows[0].shape == rows[1].shape and np.array_equal(*rows)
        _promise(is_same, f"states up to a decision of an ADS that {name} are those of other runs", "other states")
        _check_same(healthy, _rollout(world, scenario, ads), f"an ADS that {name} does not affect the next run")


def _failing_ads(factory: Ads, fault: Callable[[], Any]) -> Callable[[Any], Any]:
    """Return an ADS that makes its first decisions with the ADS of a factory, and fails from the next one on."""
    healthy = [factory()] * GOOD_DECISIONS
    decisions: Iterator[Callable[[Any], Any]] = chain(healthy, repeat(lambda observation: fault()))

    def decide(observation: Any) -> Any:
        return next(decisions)(observation)

    return decide


def _check_round_trip(world: Any, scenario: Scenario, trace: Trace, ads: Ads) -> None:
    data, cls = described(world), type(world)
    if data["kind"] == OWN:
        _promise("data" in data, "to_dict returns plain data that a file can store", f"{world.to_dict()!r:.200}")
    if is_code(data) and not (data["kind"] == OWN and hasattr(cls, "from_dict")):
        return
    with _no_error("from_dict accepts the data of to_dict"):
        again = cls.from_dict(world.to_dict()) if data["kind"] == OWN else from_dict(data)
    _promise(described(again) == data, "from_dict(to_dict()) has the same data", f"{described(again)} for {data}")
    _check_same(trace, _rollout(again, scenario, ads), "from_dict(to_dict()) gives the same traces")
