"""Ready properties: common requirements for a driving policy, each of which is one call in a test function.

For example::

    @pafot.search(blame="ego")
    def test_drives_well(run):
        pafot.properties.comfort(run)

Each property except :func:`no_fault` is a check with a name and a margin, and the margin steers the search. If a
property does not apply to a run, it makes no check. Each docstring names the source and how reliable that is: *read*
means that the source itself was read; *second hand* means that it is quoted from others. All other numbers are choices.
The bounds of most properties are arguments.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.manoeuvres import (
    DRIFTING,
    HARD_BRAKING,
    HARD_SECONDS,
    NEAR_SECONDS,
    REASON_SECONDS,
    LanePlaces,
    braking,
    hard_braking,
    reasons,
)
from pytest_pafot.attribution.responses import DISTANCES
from pytest_pafot.criticality import (
    Encounters,
    RoadFrame,
    RssRules,
    longitudinal_gap,
    still_to_pass,
    time_advantage,
)
from pytest_pafot.criticality.signals import Signal
from pytest_pafot.model.trace import LANE, FloatArray
from pytest_pafot.oracle.checks import check, require
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import checked_number

__all__ = [
    "answers_cut_ins", "brakes_for_a_reason", "comfort", "gives_way", "keeps_up", "lane_change_gaps", "no_fault",
    "rss_distance", "stays_on_road",
]  # fmt: skip

__tracebackhide__ = True  # pytest hides these frames, so a traceback ends in the test function

NEAR = 10.0
"""The scale of gaps to other vehicles: a margin is the gap's distance from its bound divided by this scale [m]."""
INTRUSION = 0.3
"""The distance over the line of the ego's lane at which an NPC has cut in [m]; UN R157, 5.2.5.2, defines it for the
NPC's tyre."""
VISIBLE = 0.72
"""The time for which an NPC's sideways motion must have been visible before the NPC has cut in [s]; UN R157,
5.2.5.2."""
CONTACT = 0.1
"""The gap below which two boxes count as touching [m]."""


def no_fault(run: Run) -> None:
    """Assert, without a margin, that the ego is not responsible for a collision, neither alone nor with the NPC.

    The rules of docs/explanation/verdicts.md decide.
    """
    is_free = run.responsibility not in ("ego", "both")
    require(is_free, "run.responsibility not in ('ego', 'both')", run.explain)


def rss_distance(run: Run, *, rules: RssRules = DISTANCES) -> None:
    """Check that the ego keeps the safe distance of Responsibility-Sensitive Safety to NPCs ahead and side by side.

    The value is the gap minus the safe distance [m] of the worst NPC, at least 0: across the road side by side, along
    it for an NPC ahead that is not safe across. Crossing NPCs count once they are on the ego's way.

    Source: Shalev-Shwartz and others, arXiv:1708.06374 (second hand). By default two seconds are enough behind a leader
    of equal speed, up to 48 m/s (a choice). ``pytest_pafot.criticality.RssRules()`` has Intel's parameters.
    """
    if not isinstance(rules, RssRules):
        raise TypeError(f"rss_distance: expected rules= as criticality.RssRules(...), received {rules!r:.80}")
    frame = RoadFrame(run.trace)
    along, across = frame.gap_along - frame.safe_along(rules), frame.gap_across - frame.safe_across(rules)
    beyond = np.where(frame.gap_along <= 0, across, np.where(across < 0, along, np.maximum(along, across))).T
    is_judged = (~(frame.ahead < 0) | (frame.gap_along.T <= 0)) & frame.is_on_way
    _check_worst(run, np.where(is_judged, beyond, np.inf), name="gap minus safe distance", at_least=0.0)


def comfort(
    run: Run,
    *,
    jerk: float | None = 2.5,
    braking: float | None = 3.5,
    lateral_acceleration: float | None = 3.0,
    lateral_jerk: float | None = 5.0,
) -> None:
    """Check that the ride is comfortable, also in bends and in braking for others.

    Four means are limited: the jerk over 1 s [m/s^3], the deceleration over 2 s [m/s^2], and over 0.5 s the lateral
    acceleration [m/s^2] and its change per second [m/s^3]. None disables a limit.

    Source: along, ISO 15622:2018 above 20 m/s (second hand: its jerk is only for braking); across, UN R79, 5.6.2.1.3
    (second hand: only its jerk is a mean).
    """
    asked = {
        "jerk": jerk,
        "braking": braking,
        "lateral_acceleration": lateral_acceleration,
        "lateral_jerk": lateral_jerk,
    }
    _refuse_odd("comfort", **{name: 0.0 if most is None else most for name, most in asked.items()})
    ego = run.ego
    if jerk is not None:
        check(abs(_change(ego.acceleration, 1.0)), name="jerk", at_most=jerk, unit="m/s^3")
    if braking is not None:
        check(-_change(ego.speed, 2.0), name="braking", at_most=braking, unit="m/s^2")
    if lateral_acceleration is not None:
        hz = run.trace.physics_hz
        mean = _change(Signal(np.cumsum(ego.lateral_acceleration) / hz, hz=hz), 0.5)
        check(abs(mean), name="lateral acceleration", at_most=lateral_acceleration, unit="m/s^2")
    if lateral_jerk is not None:
        mean = _change(ego.lateral_acceleration, 0.5)
        check(abs(mean), name="lateral jerk", at_most=lateral_jerk, unit="m/s^3")


def gives_way(run: Run, *, seconds: float = 1.0) -> None:
    """Check that the ego drives into a zone ahead of an NPC with priority only if it leaves a gap of ``seconds`` [s].

    The value is the NPC's ``time_advantage`` when the ego enters the zone, from the ego's exit to the NPC's arrival. An
    NPC that stands then, or entered before the ego, is no failure.

    Source: Laureshyn and others 2010 (second hand); 1 s is a choice.
    """
    _refuse_odd("gives_way", seconds=seconds)
    for passage in run.passages:
        if passage.zone.priority == "npc" and passage.ego_enters <= min(passage.npc_enters, run.duration):
            at, npc = passage.ego_enters, passage.npc
            left = run.npcs[npc].time_advantage[round(at * run.trace.physics_hz)]
            check(left, name="time ahead of crossing traffic", at_least=seconds, unit="s", at=at, npc=npc, scale=1.0)


def stays_on_road(run: Run) -> None:
    """Check that the ego's centre stays on the road: its distance to the nearer edge [m] is at least 0.

    On bent roads half the lane's width stands for the distance. No source.
    """
    trace = run.trace
    check(Signal(trace.road.to_edge(), hz=trace.physics_hz, unit="m"), name="road edge", at_least=0.0)


def keeps_up(
    run: Run,
    *,
    share: float = 0.7,
    speed: npt.ArrayLike | None = None,
    headway: float = 3.0,
    seconds: float = 10.0,
) -> None:
    """Check that the ego, with no vehicle ahead for ``seconds`` [s], drives at ``share`` times a speed or faster.

    The value is the ego's highest speed in the last ``seconds`` divided by ``speed`` [m/s], one number or one per tick,
    by default the limit of its lane. A vehicle is ahead if the gap to the leader is less than the required speed times
    ``headway`` [s], or if the ego and a crossing NPC both still have to pass their zone.

    Raises:
        ValueError: for an argument that is not a finite number of at least 0, or speeds that are not one per tick.

    Source: Vienna Convention on Road Traffic, Art. 13 (4) (without numbers).
    """
    limits = np.array([lane.speed_limit for lane in run.trace.lanes])[np.maximum(run.ego.lane.astype(np.intp), 0)]
    full = np.asarray(limits if speed is None else speed)
    is_number = full.dtype.kind in "iuf" and full.shape in ((), limits.shape)
    if not is_number or not ((full >= 0) & (full < math.inf)).all():
        expected = "a finite speed of at least 0, as a number or one number per tick"
        raise ValueError(f"keeps_up: expected {expected}, received speed={speed!r:.80}")
    _refuse_odd("keeps_up", share=share, headway=headway, seconds=seconds)
    if run.duration < seconds:
        return
    full = np.broadcast_to(full, limits.shape)
    ahead, ticks = run.leader, np.arange(len(full))
    # A leader of -1, which is none, selects the last column.
    gaps = np.column_stack((longitudinal_gap(run.trace), np.full(len(full), np.inf)))[ticks, ahead]
    is_free = (full > 0) & (gaps >= headway * share * full) & ~still_to_pass(run.trace).any(axis=1)
    paces = np.where(is_free, np.asarray(run.ego.speed) / np.where(full > 0, full, 1.0), np.inf)
    window = round(seconds * run.trace.physics_hz)
    held = np.lib.stride_tricks.sliding_window_view(np.concatenate((np.full(window, np.inf), paces)), window + 1)
    if not np.isposinf(held.max(axis=1)).all():
        check(Signal(held.max(axis=1), hz=run.trace.physics_hz), name="pace", at_least=share)


def lane_change_gaps(run: Run, *, ahead: float = 1.0, behind: float = 1.0) -> None:
    """Check that the ego changes lanes only into gaps of at least ``ahead`` and ``behind`` [s].

    The value is the gap when the ego's centre enters the lane, divided by the rear vehicle's speed; 0 side by side.

    Source: for ``behind``, UN R79, 5.6.4.7 (formula read); 1 s for ``ahead`` is a choice.
    """
    _refuse_odd("lane_change_gaps", ahead=ahead, behind=behind)
    gaps, is_on_way = longitudinal_gap(run.trace), Encounters(run.trace).is_on_way
    for change in run.lane_changes:
        for index, npc in enumerate(run.npcs):
            if npc.lane[change.tick] != change.to_lane or not is_on_way[index, change.tick]:
                continue
            follows = not npc.ahead[change.tick] < 0
            speed, gap = (run.ego if follows else npc).speed[change.tick], gaps[change.tick, index]
            seconds = 0.0 if gap <= 0 else math.inf if speed <= 0 else gap / speed
            where, least = ("ahead", ahead) if follows else ("behind", behind)
            check(
                seconds, name=f"lane change gap {where}", at_least=least, unit="s", at=change.time, npc=index, scale=1.0
            )


def brakes_for_a_reason(run: Run) -> None:
    """Check that the ego never brakes hard, more than 5 m/s^2 for 0.4 s, without a reason.

    The value is the deceleration that lasts for 0.4 s [m/s^2]; 0 if there is a reason from 1.6 s before the braking to
    0.4 s after it began: one of rule 7 of docs/explanation/verdicts.md, or an NPC that would cross within 4 s of the
    ego.

    Source: Vienna Convention on Road Traffic, Art. 17 (1); 5 m/s^2 is UN R157, 5.3.1.1 (second hand).
    """
    trace = run.trace
    lasts, back = math.ceil(HARD_SECONDS * trace.physics_hz), round(REASON_SECONDS * trace.physics_hz)
    later = np.concatenate((braking(trace)[1:], np.zeros(lasts)))
    lasting = np.lib.stride_tricks.sliding_window_view(later, lasts).min(axis=1)
    # Reasons depend on the ego's lane, so find them separately for each stretch of ticks in one lane.
    bounds = [0, *(np.flatnonzero(np.diff(trace.ego[:, LANE])) + 1).tolist(), trace.ticks + 1]
    parts, frame = (slice(first, end) for first, end in pairwise(bounds)), RoadFrame(trace)
    by_lane = [reasons(trace, frame, DISTANCES, 0, part) for part in parts]
    meets = (still_to_pass(trace) & (time_advantage(trace) < NEAR_SECONDS)).any(axis=1)
    reason = np.pad(np.concatenate(by_lane) | meets, (back, lasts))
    excused = np.asarray(np.lib.stride_tricks.sliding_window_view(reason, back + lasts + 1).any(axis=1))
    stop = hard_braking(trace, 0, 0, trace.ticks)
    while stop is not None:
        excused[stop.begin : stop.end + 1] = excused[stop.begin]
        stop = hard_braking(trace, 0, 0, stop.begin)
    needless = np.where(excused, 0.0, lasting)
    name = "braking for nothing"
    check(Signal(needless, hz=trace.physics_hz, unit="m/s^2"), name=name, at_most=HARD_BRAKING)


def answers_cut_ins(run: Run) -> None:
    """Check that the ego does not collide after a cut-in if UN R157 requires that such a collision is avoided.

    It requires this for a slower NPC if, when the NPC is 0.3 m over the line of the ego's lane, its sideways motion was
    visible for 0.72 s, and the time to collision is more than v / (2 * 6 m/s^2) + 0.35 s, with v the difference of
    speeds. The value is the gap between the boxes from then on [m], at least 0.1, until the ego is no longer faster,
    one of the two leaves the lane, or the NPC's new speed no longer meets the condition. To merge from its own way is
    no cut-in.

    Source: UN R157, 5.2.5.2 (formula read). That last end, the NPC's box instead of its tyre, visibility from a lateral
    speed of 0.3 m/s on, and 0.1 m are choices.
    """
    trace, frame = run.trace, RoadFrame(run.trace)
    lane = trace.ego[:, LANE].astype(np.intp)
    beside = frame.right + LanePlaces(trace, frame).offset(0)  # offsets of the NPCs from the centre of the ego's lane
    half = np.array([each.width for each in trace.lanes])[np.maximum(lane, 0)] / 2
    is_in = half + trace.sizes[1:, 1:] / 2 - np.abs(beside) >= INTRUSION
    keeps = (lane[1:] == lane[:-1]) & (lane[1:] >= 0)
    closing = frame.speed[:1] - frame.speed[1:]
    gaps = frame.ahead - frame.half_along[:1] - frame.half_along[1:]
    checked = np.full((len(run.npcs), trace.ticks + 1), np.inf)
    for each, before in zip(*np.nonzero(is_in[:, 1:] & ~is_in[:, :-1] & keeps), strict=True):
        npc, tick = int(each), int(before) + 1
        towards = -np.sign(beside[npc, tick]) * frame.drift[npc + 1, : tick + 1]
        # ~(>=) instead of <, because the drift is NaN before the NPC is on the way.
        began = int(np.flatnonzero(np.append(True, ~(towards[1:] >= DRIFTING)))[-1])
        slower = np.maximum(frame.speed[0, tick] - frame.speed[npc + 1, tick:], 0.0)
        is_asked = gaps[npc, tick] > slower * (slower / (2 * 6.0) + 0.35)
        if tick - began >= VISIBLE * trace.physics_hz and slower[0] > 0 and is_asked[0]:
            over = (closing[npc, tick:] <= 0) | ~is_in[npc, tick:] | ~is_asked
            end = tick + int(over.argmax()) if over.any() else trace.ticks + 1
            checked[npc, tick:end] = run.npcs[npc].gap[tick:end]
    _check_worst(run, checked, name="UN R157 cut-in gap", at_least=CONTACT)


def _refuse_odd(name: str, **given: object) -> None:
    """Raise for an argument of a property that is not a finite number of at least 0."""
    for each, value in given.items():
        checked_number(value, name, f"{each}= as a finite number of at least 0", least=0.0)


def _check_worst(run: Run, values: FloatArray, *, name: str, at_least: float) -> None:
    """Check the smallest of all NPCs' values at each tick [m]; ``values`` has the shape [NPCs, ticks + 1].

    Infinite values are not checked.
    """
    if values.size and not np.isposinf(values).all():
        npc = int(np.where(np.isnan(values), -np.inf, values).min(axis=1).argmin())
        least = Signal(values.min(axis=0), hz=run.trace.physics_hz, unit="m")
        check(least, name=name, at_least=at_least, npc=npc, scale=NEAR)


def _change(signal: Signal, seconds: float) -> Signal:
    """Return the mean change of a signal per second, in the ``seconds`` before each tick.

    Before its first tick, the signal is assumed to be constant.
    """
    hz = signal.hz or 1
    ticks = round(seconds * hz)
    before = np.concatenate((np.full(ticks, signal[0]), signal))[: len(signal)]
    # ticks / hz and not seconds, since half a second is not a whole number of ticks at 15 Hz
    change: Signal = (signal - before) / (ticks / hz)
    return change
