"""Who caused a collision, by written rules over the trace.

:func:`rss_rule` is the rule; :func:`position_rule` is a second opinion. docs/explanation/verdicts.md tells the rules
clause by clause, with their sources.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.avoidance import Braking, Emergency, Pursuit
from pytest_pafot.attribution.lane_changes import DRIFTING, LaneChange, LanePlaces, first_lasting
from pytest_pafot.attribution.needless_braking import (
    AFTERMATH_SECONDS,
    HARD_BRAKING,
    HARD_SECONDS,
    REASON_SECONDS,
    STANDING_SPEED,
    Stop,
    braking,
    hard_braking,
    long_stop,
    reasons,
)
from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.model.trace import FloatArray, Trace

Responsibility = Literal["ego", "npc", "both", "none"]
"""``none`` where there was no collision."""

Fault = Literal["entered-lane", "cut-in-unanswered", "leader-unanswered", "braked-for-nothing", "stopped-for-nothing"]
"""What the ego answers for: it changed lanes into somebody's way; it did not respond properly to a cut-in, or to a
vehicle ahead in its lane; it braked hard, or stopped, with nothing in its way."""

DISTANCES = RssRules(ego_response=1.0, npc_response=1.0, acceleration=0.0, least_braking=6.0, hardest_braking=8.0)
"""The safe distances of attribution. The usual two seconds behind a leader of equal speed must never be a fault: with
these values they are safe up to 48 m/s (v + v^2 / 48 <= 2 v). Speeding up during the response time, which RSS counts
with, would ask for more than that; a follower that does so has to answer for it through the distance itself. A leader
brakes with at most 8 m/s^2, the hardest that NPCs can; a follower with at least 6 m/s^2, what UN R157 5.2.5.2 takes for
granted of a system that must avoid. Lateral values are the defaults of :class:`~pytest_pafot.criticality.RssRules`."""

FOLLOWING = Braking(delay=1.0, deceleration=6.0)
"""The proper response of the one behind in a lane: that of RSS, with the numbers of :data:`DISTANCES`."""

CUT_OFF = Braking(delay=1.4, deceleration=3.0, perception=0.4, headway=1.0)
"""The proper response of one that was cut off, unless it is an emergency: no harsh braking (UN R157, 5.2.3.3), but
what a lane change may ask of others (UN R79, 5.6.4.7: 3 m/s^2, and a second behind). The delay is the careful and
competent driver's (UN R157, annex 4, appendix 3): 0.4 s to perceive the risk, 0.75 s until the brakes act, and half the
time in which they build up."""

EMERGENCY = Emergency(
    time_to_contact=2.0, leader_braking=5.0, perception=0.4, braking=Braking(delay=1.4, deceleration=6.0)
)
"""When the one that was cut off has to brake hard: the careful and competent driver's criteria."""

HELD = Braking(delay=0.0, deceleration=6.0)
"""What is left to one that brakes already: to go on."""

GIVING_WAY = Braking(delay=0.4, deceleration=3.0)
"""What a lane change may ask of the one behind in the other lane (UN R79, 5.6.4.7)."""
HEADWAY = 1.0
"""What is to be left between the two when the one behind has slowed down, in seconds of the mover's driving [s]."""
TOGETHER = 1.0
"""Two that crossed into one lane within that time both did [s]."""
SOON = 5.0
"""Braking of an NPC that is hit up to so long after its lane change belongs to it, and would have gone on [s]."""
BLOCKED = 0.3
AT_ONCE = 2.0
"""Nobody can answer an NPC that moves in with less headway than the first, and begins to brake hard within the second
[s]."""
AMPLE = 1.0
"""Who is further behind, in seconds of its driving, has all that it needs to answer a hard braking [s]."""
LET_GO = 0.4
"""Braking that pauses so long is over [s]."""
ROLLED = 0.5
"""An ego that drove so shortly before they touched does not stand for what it owed an answer to [s]."""
LATER = 3.0
"""An NPC that runs into a driving ego so long after its braking has had the time to adapt [s]."""
CRAWLING = 3.0
"""An NPC that is no faster when the danger begins can stop behind whatever stands there [m/s]."""
DROVE_ON = 1.0
"""An NPC that gained more speed towards an ego that had braked for nothing made it dangerous itself [m/s]."""
BRAKES = 0.5
"""What the sentences call braking, at least [m/s^2]."""
SPED_UP = 0.3
"""What they call speeding up, or slowing down in a lane change, at least [m/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Attribution:
    """Who is responsible, and why.

    Attributes:
        responsibility: for the collision.
        tick, time: of what the reason begins with [s]: a lane change, a braking, or when the danger began; None without
            a collision.
        reason: the end of a sentence that begins with "because".
        fault: of the ego; None where it does not answer for the collision.
    """

    responsibility: Responsibility
    tick: int | None
    time: float | None
    reason: str
    fault: Fault | None = None


def rss_rule(trace: Trace) -> Attribution:
    """Who is responsible: who made it dangerous, and did not respond properly.

    The danger began at the first tick of the last stretch of time, up to the impact, in which the longitudinal and the
    lateral distance both were shorter than :data:`DISTANCES` asks for (Responsibility-Sensitive Safety). If it had
    begun when the two came into one track, whoever changed lanes into it answers for that, unless it gave way to the
    one behind, or was the leader long enough for that one to respond; and an ego that a careful driver's braking would
    have saved from a cut-in answers for that. Otherwise the follower does, where 6 m/s^2 after 1 s would have avoided
    it. A leading ego answers for braking hard, or stopping, with nothing in its way; otherwise not, and not while it
    stands. Each clause, its source and its numbers are in docs/explanation/verdicts.md.

    Sources: Shalev-Shwartz, Shammah, Shashua, "On a Formal Model of Safe and Scalable Self-driving Cars",
    arXiv:1708.06374 (distances, danger, blame, proper response); UN Regulations No. 79 (lane changes) and No. 157
    (numbers of a careful driver); Vienna Convention on Road Traffic, Art. 17 (braking for nothing).
    """
    if trace.collision is None:
        return Attribution(responsibility="none", tick=None, time=None, reason="there was no collision")
    return trace.reading("attribution", lambda trace: dangers_of(trace).impact)


def is_ego_responsible(trace: Trace) -> bool:
    """Whether the ego answers for a collision by :func:`rss_rule`, alone or with the NPC; False without one."""
    return rss_rule(trace).responsibility in ("ego", "both")


def position_rule(trace: Trace) -> Responsibility:
    """The rule of the authors' released code: by where the NPC was at the impact. A second opinion.

    An ego at 0.1 m/s or less is never responsible; otherwise it is when the NPC was ahead of it, in cell 1, 2
    or 3; an NPC beside or behind the ego is responsible itself. The paper itself counts collisions without a split.
    """
    if trace.collision is None:
        return "none"
    if trace.collision.ego_speed <= STANDING_SPEED or trace.collision.cell.row <= 0:
        return "npc"
    return "ego"


class Dangers:
    """Where in a run the ego and each NPC were closer than RSS allows; arrays have the shape [ticks + 1, NPCs].

    Attributes:
        across: gap between the boxes across the road [m].
        places: of the vehicles on the lanes.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.frame = RoadFrame(trace)
        self.across = self.frame.gap_across
        self.places = LanePlaces(trace, self.frame)

    @cached_property
    def safe_along(self) -> FloatArray:
        """What RSS asks for along the road [m]."""
        return self.frame.safe_along(DISTANCES)

    @cached_property
    def is_dangerous(self) -> npt.NDArray[np.bool_]:
        """Where RSS would have more, along and across the road."""
        along = self.frame.gap_along
        is_close = (along < self.safe_along) | (along <= 0)
        return np.asarray(is_close & (self.across < self.frame.safe_across(DISTANCES)))

    @cached_property
    def impact(self) -> Attribution:
        """Of the collision in which the run ended."""
        if self.trace.collision is None:
            raise ValueError("trace: expected a run that ended in a collision, received one without")
        npc = self.trace.collision.npc
        safe = np.flatnonzero(~self.is_dangerous[:-1, npc])
        start = int(safe[-1]) + 1 if safe.size else 0
        return Conflict(self, npc, start, self.trace.ticks).attribution


@lru_cache(maxsize=1)
def dangers_of(trace: Trace) -> Dangers:
    """The dangers of a run; those of the last one are kept, which verdict, fitness and near-misses ask for in turn."""
    return Dangers(trace)


class Conflict:
    """A danger between the ego and one NPC, from its first tick to its end: an impact, or what almost was one."""

    def __init__(self, dangers: Dangers, npc: int, start: int, end: int) -> None:
        self._dangers, self._npc, self._start, self._end = dangers, npc, start, end
        self._frame, self._trace, self._hz = dangers.frame, dangers.trace, dangers.trace.physics_hz
        self._name = f"NPC {npc}"
        self._before = max(start - 1, 0)  # the last safe tick, from which on a response counts
        apart = np.flatnonzero(dangers.across[:end, npc] > 0)
        self._onset = int(apart[-1]) + 1 if apart.size else 0  # from which on they were in one track, up to the end
        self._side = 1.0 if self._frame.right[npc, max(self._onset - 1, 0)] >= 0 else -1.0
        self._lanes = dangers.places

    @cached_property
    def attribution(self) -> Attribution:
        """By the rules of docs/explanation/verdicts.md."""
        over = self._over
        if self._is_in_one_track:
            return self._in_one_lane() if over is None else self._changed(over)
        ego, npc = self._change(0), self._change(self._npc + 1)
        latest = max((each for each in (ego, npc) if each is not None), key=lambda each: each.tick, default=None)
        if over is not None and (latest is None or over.tick > latest.tick):
            return self._changed(over)
        if latest is None:
            return self._strayed() if self._gap(self._onset) <= 0 else self._in_one_lane()
        if ego is not None and npc is not None and abs(ego.tick - npc.tick) <= TOGETHER * self._hz:
            return self._both_changed(ego, npc)
        return self._changed(latest)

    def may_be(self, fault: Fault | None) -> bool:
        """Whether the verdict may be a fault of the ego, by what is known sooner than the verdict."""
        if fault == "entered-lane":
            has_moved_over = self._over is not None and self._over.vehicle == 0
            may_have_changed = not self._is_in_one_track and (self._change(0) or self._gap(self._onset) <= 0)
            return bool(has_moved_over or may_have_changed)
        if fault == "braked-for-nothing":
            stop = self._hard_braking(0)
        elif fault == "stopped-for-nothing":
            stop = long_stop(self._trace, self._end)
        else:
            return True
        return stop is not None and self._leads(stop.begin)

    # Lane changes.

    @cached_property
    def _over(self) -> LaneChange | None:
        return self._lanes.moved_over(self._npc, max(self._start, self._onset), self._end)

    @property
    def _is_in_one_track(self) -> bool:
        """Whether the danger came later than that, or was there when the run began."""
        return self._onset == 0 or self._start > self._onset

    def _change(self, vehicle: int) -> LaneChange | None:
        npc = self._npc + 1
        other, side = (npc, self._side) if vehicle == 0 else (0, -self._side)
        return self._lanes.change(vehicle, other, side, self._onset)

    def _changed(self, change: LaneChange) -> Attribution:
        return self._npc_changed(change) if change.vehicle else self._ego_changed(change)

    def _both_changed(self, ego: LaneChange, npc: LaneChange) -> Attribution:
        if self._leads(ego.tick) and self._gives_way(ego):
            return self._gave_way(ego)
        first, by_ego = (ego, False) if self._leads(self._onset) else (npc, True)
        passed = self._duty_passed(first, max(ego.tick, npc.tick), self._pursuit(by_ego=by_ego))
        if passed is not None:
            return passed
        when = f"at {self._at(ego.tick)} the ego and at {self._at(npc.tick)} {self._name} crossed a lane line"
        reason = f"{when} towards each other ({ego.drift:.1f} and {npc.drift:.1f} m/s sideways)"
        return self._attributed("both", ego.tick, reason, "entered-lane")

    def _ego_changed(self, change: LaneChange) -> Attribution:
        crossed, tick = self._crossed(change), change.tick
        if not self._leads(tick):
            return self._attributed("ego", tick, crossed, "entered-lane")
        if self._gives_way(change):
            return self._gave_way(change)
        crossed, pursuit = self._without_room(change), self._pursuit(by_ego=False)
        passed = self._duty_passed(change, tick, pursuit)
        if passed is not None:
            return passed
        entered = max(self._onset, tick)
        if self._gap(tick) >= self._room(tick, float(self._frame.speed[0, tick])) and self._gap(entered) > 0:
            since = pursuit.avoided_from(max(tick, self._before), FOLLOWING)  # there was room at first
            if since is not None:
                reason = f"{crossed}; {self._name}'s {self._would(since)}"
                return self._attributed("both", tick, reason, "entered-lane")
        kept = self._lanes.kept_since(0, tick, self._end)
        late = f", and {self._name} could not avoid it any more when the ego kept the lane" if kept is not None else ""
        chance = self._second_chance(tick, pursuit, by_ego=False)
        if chance is not None:
            return self._attributed("both", tick, f"{crossed}{late}; but {chance}", "entered-lane")
        return self._attributed("ego", tick, f"{crossed}{late}", "entered-lane")

    def _without_room(self, change: LaneChange) -> str:
        """How the ego's lane change left too little room."""
        tick, lowest, crossed = change.tick, self._lowest(change), self._crossed(change)
        room = self._room(tick, lowest)
        if self._gap(tick) >= room:
            entered = max(self._onset, tick)
            gap = f"{max(self._gap(entered), 0.0):.1f} m"
            return f"{crossed}, and came into its track only {gap} ahead at {self._at(entered)}"
        slowed = (
            f", as it slowed down to {round(lowest, 1) + 0.0:.1f} m/s"
            if lowest < self._frame.speed[0, tick] - SPED_UP
            else ""
        )
        return f"{crossed}, where giving way takes {room:.1f} m{slowed}"

    def _duty_passed(self, change: LaneChange, tick: int, pursuit: Pursuit) -> Attribution | None:
        """To the one behind, who could still have avoided it when the one ahead had kept the lane since a tick.

        None where that one did not keep it for long enough, or nothing could have avoided it any more.
        """
        kept = self._lanes.kept_since(change.vehicle, tick, self._end)
        since = None if kept is None else pursuit.avoided_from(max(kept[1], self._before), FOLLOWING)
        if kept is None or since is None:
            return None
        who = self._name if change.vehicle else "the ego"
        reason = f"from {self._at(kept[0])} on {who} kept the lane ahead"
        if change.vehicle == 0:
            return self._npc_followed(kept[1], kept[0], f"{reason}, and {self._name}'s {self._would(since)}")
        would = f"{self._would(since)}; {self._answer(since)}"
        return self._unanswered(kept[0], (reason, would), "leader-unanswered", change)

    def _gave_way(self, change: LaneChange) -> Attribution:
        room = self._room(change.tick, self._lowest(change))
        gave = f"{self._crossed(change)}, more than the {room:.1f} m that giving way takes"
        return self._npc_followed(change.tick, change.tick, gave)

    def _npc_changed(self, change: LaneChange) -> Attribution:
        crossed, tick = self._crossed(change), change.tick
        if self._gap(tick) > 0 and self._leads(tick):
            return self._npc_followed(tick, tick, crossed, moved_in=tick)
        seen, pursuit = change.seen, self._pursuit(by_ego=True, goes_on=self._end - tick <= SOON * self._hz)
        if min(self._gap(tick), self._gap(max(self._onset, tick))) <= 0:
            return self._excused_behind(tick, crossed, pursuit, change)
        if self._is_blocked(tick):
            return self._excused_behind(tick, f"{crossed}, too late to avoid it", pursuit, change)
        since = None if self._is_too_late(seen) else pursuit.avoided_from(seen, CUT_OFF, EMERGENCY)
        if since is not None:
            would = f"{self._demanded(since)}; {self._answer(since)}"
            return self._unanswered(tick, (crossed, would), "cut-in-unanswered", change)
        passed = self._duty_passed(change, tick, pursuit)
        if passed is not None:
            return passed
        return self._excused_behind(tick, f"{crossed}, too late to avoid it", pursuit, change)

    def _pushed_in(self, change: LaneChange | None) -> bool:
        """Whether an NPC changed lanes ahead of a driving ego, not long ago, and did not give way."""
        if change is None or self._stands or self._end - change.tick > SOON * self._hz:
            return False
        speed = float(self._frame.speed[self._npc + 1, change.tick])
        return self._gap(change.tick) < self._room(change.tick, speed, behind=0)

    def _npc_braked_hard(self, first: int, last: int) -> float:
        """How hard the NPC braked between two ticks [m/s^2]; 0 where it did not, or not for long enough."""
        slowed = -np.diff(self._frame.speed[self._npc + 1, first : last + 1]) * self._hz
        is_hard = first_lasting(slowed > HARD_BRAKING, math.ceil(HARD_SECONDS * self._hz)) is not None
        return float(slowed.max()) if is_hard else 0.0

    def _is_blocked(self, tick: int) -> bool:
        """Whether an NPC moved in with next to no headway and began to brake hard at once."""
        last = tick + round(AT_ONCE * self._hz) + math.ceil(HARD_SECONDS * self._hz)
        is_close = self._gap(tick) < BLOCKED * self._frame.speed[0, tick]
        return bool(is_close and self._npc_braked_hard(tick, min(last, self._end)))

    def _strayed(self) -> Attribution:
        """Side by side without a lane change: by slow drift, or in lanes that come together."""
        tick, right = self._onset, self._side
        towards = right * self._frame.drift[0, tick], -right * self._frame.drift[self._npc + 1, tick]
        ego, npc = (drift >= DRIFTING for drift in towards)
        if ego == npc:
            ego, npc = (self._lanes.over_line(each, side, tick) for each, side in ((0, right), (self._npc + 1, -right)))
        if ego == npc:
            ego = towards[0] >= towards[1] + DRIFTING
        if not ego:
            return self._excused(tick, f"at {self._at(tick)} {self._name} came sideways into the ego, side by side")
        reason = f"at {self._at(tick)} the ego came sideways into {self._name}, side by side"
        return self._blamed_unless_standing(tick, reason, "entered-lane")

    def _gives_way(self, change: LaneChange) -> bool:
        """Whether the ego's lane change leaves the NPC room, and still does when they have come into one track."""
        entered = max(self._onset, change.tick)
        asked = (change.tick, self._lowest(change)), (entered, float(self._frame.speed[0, entered]))
        return all(self._gap(tick) >= self._room(tick, speed) for tick, speed in asked)

    def _room(self, tick: int, speed: float, behind: int | None = None) -> float:
        """What a lane change at some speed ahead of another has to leave at a tick [m] (UN R79, 5.6.4.7)."""
        follower = self._frame.speed[self._npc + 1 if behind is None else behind, tick]
        return max(_braking_room(float(follower) - speed) + speed * HEADWAY, 0.0)

    def _lowest(self, change: LaneChange) -> float:
        """Speed of the ego during its lane change [m/s]: who slows down in it asks more of the one behind."""
        over = max(self._onset, change.tick) + round(HEADWAY * self._hz)
        return float(self._frame.speed[0, change.tick : min(over, self._end) + 1].min())

    def _is_too_late(self, seen: int) -> bool:
        """Whether nobody can answer a cut-in that is seen at a tick, for its time to collision."""
        frame = self._frame
        closing = float(frame.speed[0, seen] - frame.speed[self._npc + 1, seen])
        hardest = EMERGENCY.braking.deceleration
        return closing > 0 and self._gap(seen) <= closing * (CUT_OFF.delay + closing / (2 * hardest))

    # One behind the other.

    def _in_one_lane(self) -> Attribution:
        if self._leads(self._start):
            reason = self._close_behind(self._name, "the ego")
            return self._npc_followed(0, self._start, reason)
        close, pursuit = self._close_behind("the ego", self._name), self._pursuit(by_ego=True)
        since = pursuit.avoided_from(self._before, FOLLOWING)
        if since is not None:
            would = f"{self._would(since)}; {self._answer(since)}"
            return self._unanswered(self._start, (close, would), "leader-unanswered")
        began = " as the run began" if self._start == 0 else ""
        return self._excused_behind(self._start, f"{close}{began}, and no response could avoid it", pursuit)

    def _unanswered(
        self, tick: int, reason: tuple[str, str], fault: Fault, change: LaneChange | None = None
    ) -> Attribution:
        """The ego's, behind; shared with an NPC that braked hard after it had pushed in, or with nothing in its way."""
        npc = self._npc + 1
        stop = None if self._stands else self._needless_braking(npc)
        if stop is not None and self._gap(stop.begin) <= AMPLE * self._frame.speed[0, stop.begin]:
            began, peak = self._at(stop.begin), braking(self._trace, npc)[stop.begin : stop.end + 1].max()
            braked = f"from {began} {self._name} braked with up to {peak:.1f} m/s^2 with nothing in its way"
            return self._attributed("both", tick, f"{reason[0]}; {braked}; {reason[1]}", fault)
        peak = self._npc_braked_hard(change.tick, self._end) if change and self._pushed_in(change) else 0.0
        if peak:
            braked = f", and braked with up to {peak:.1f} m/s^2"
            return self._attributed("both", tick, f"{reason[0]}{braked}; {reason[1]}", fault)
        return self._blamed_unless_standing(tick, "; ".join(reason), fault)

    def _excused_behind(
        self, tick: int, reason: str, pursuit: Pursuit, change: LaneChange | None = None
    ) -> Attribution:
        """The NPC's, ahead; but not where the ego had mastered it, and ran into the NPC nevertheless."""
        chance = self._second_chance(tick, pursuit, by_ego=True)
        if chance is None:
            return self._excused(tick, reason)
        reason = f"{reason}; but {chance}"
        if self._pushed_in(change):
            return self._attributed("both", tick, reason, "leader-unanswered")
        return self._blamed_unless_standing(tick, reason, "leader-unanswered")

    def _second_chance(self, tick: int, pursuit: Pursuit, *, by_ego: bool) -> str | None:
        """How the one behind gave away what it had gained since a tick; None where it did not."""
        behind, ahead = (0, self._npc + 1) if by_ego else (self._npc + 1, 0)
        who, speed = self._name if behind else "the ego", self._frame.speed
        closing = speed[behind] - speed[ahead]
        first = max(tick, self._before) + round(FOLLOWING.delay * self._hz)
        ticks = [at for at in range(first, self._end) if self._gap(at) > 0 and self._leads(at) != by_ego]
        over = max((at for at in ticks if closing[at] <= 0), default=None)
        since = None if over is None else pursuit.avoided_from(over, CUT_OFF, EMERGENCY)
        if over is not None and since is not None:
            answer = f"; {self._answer(since)}" if by_ego else ""
            return f"until {self._at(over)} {who} was no faster, and {self._demanded(since)}{answer}"
        pause, slowed = math.ceil(LET_GO * self._hz), braking(self._trace, behind)
        for at in (each for each in ticks if closing[each] > 0 and each + pause <= self._end):
            has_let_go = slowed[at] >= BRAKES and (slowed[at + 1 : at + 1 + pause] < BRAKES).all()
            if has_let_go and pursuit.avoided_from(at, HELD) is not None:
                held = f"braking on with {HELD.deceleration:.0f} m/s^2 would have avoided it"
                return f"{who} let the brakes go at {self._at(at)}, where {held}"
        return None

    def _npc_followed(self, duty: int, tick: int, reason: str, moved_in: int = 0) -> Attribution:
        """The ego led: the NPC owes an answer, not before a tick, unless the ego braked, or stopped, for nothing.

        One that moved in behind an ego that did so is responsible, too.
        """
        stop = self._needless_braking(0, moved_in)
        if stop is not None and stop.end >= duty:
            peak = float(braking(self._trace)[stop.begin : stop.end + 1].max())
            braked = f"from {self._at(stop.begin)} the ego braked with up to {peak:.1f} m/s^2 with nothing in its way"
            since = max(duty, min(self._before, stop.begin))  # hard braking is something to answer, however far away
            return self._needless(stop, since, braked, "braked-for-nothing", moved_in=moved_in > 0)
        stop = long_stop(self._trace, self._end)
        is_slow = self._frame.speed[self._npc + 1, self._start] <= CRAWLING
        if stop is not None and not is_slow and self._is_needless(stop, slice(stop.begin, stop.end + 1), moved_in):
            stood = (self._end - stop.end) / self._hz
            stopped = f"from {self._at(stop.begin)} the ego braked to a standstill with nothing in its way"
            stopped = f"{stopped} and stood for {stood:.1f} s"
            return self._needless(stop, max(duty, self._before), stopped, "stopped-for-nothing", moved_in=moved_in > 0)
        return self._excused(tick, reason)

    def _needless_braking(self, leader: int, moved_in: int = 0) -> Stop | None:
        """The hard braking of the vehicle ahead with nothing in its way, about when the danger began."""
        stop = self._hard_braking(leader)
        if stop is None:
            return None
        ticks = slice(stop.begin, stop.begin + 1 + round(HARD_SECONDS * self._hz))
        return stop if self._is_needless(stop, ticks, moved_in, leader) else None

    def _hard_braking(self, leader: int) -> Stop | None:
        return hard_braking(self._trace, leader, self._start - round(AFTERMATH_SECONDS * self._hz), self._end)

    def _is_needless(self, stop: Stop, ticks: slice, moved_in: int, leader: int = 0) -> bool:
        """Whether the one ahead alone made it dangerous: nothing was a reason to brake, and it never regained speed.

        And the other was behind then, and did not move in, or speed up, once the braking was over.
        """
        ahead, behind = self._frame.speed[leader], self._frame.speed[0 if leader else self._npc + 1]
        if self._leads(stop.begin) == bool(leader) or ahead[self._end] >= ahead[stop.begin]:
            return False
        closing = behind[stop.begin] - ahead[stop.begin]
        if self._end - stop.end > LATER * self._hz and ahead[self._end] > STANDING_SPEED:
            return False  # it could have adapted to the new speed
        if self._gap(stop.begin) < EMERGENCY.time_to_contact * closing:
            return False  # it would have hit the one ahead anyway
        late = moved_in > stop.end + AFTERMATH_SECONDS * self._hz
        since = max(stop.end, self._before)
        if late or behind[self._end] > behind[since : self._end + 1].min() + DROVE_ON:
            return False
        ticks = slice(max(ticks.start - round(REASON_SECONDS * self._hz), 0), ticks.stop)
        return not reasons(self._trace, self._frame, DISTANCES, leader, ticks).any()

    def _needless(self, stop: Stop, since: int, reason: str, fault: Fault, *, moved_in: bool) -> Attribution:
        if moved_in:
            return self._attributed("both", stop.begin, f"{reason}, and {self._name} moved in behind it", fault)
        answer = self._pursuit(by_ego=False).avoided_from(since, FOLLOWING)
        if answer is not None:
            return self._attributed("both", stop.begin, f"{reason}; {self._name}'s {self._would(answer)}", fault)
        return self._attributed("ego", stop.begin, f"{reason}, and {self._name} behind could not avoid it", fault)

    # What the sentences are made of.

    def _attributed(
        self, responsibility: Responsibility, tick: int, reason: str, fault: Fault | None = None
    ) -> Attribution:
        return Attribution(responsibility=responsibility, tick=tick, time=tick / self._hz, reason=reason, fault=fault)

    def _blamed_unless_standing(self, tick: int, reason: str, fault: Fault) -> Attribution:
        """An ego that rolls until it touches does not stand."""
        rolled = self._frame.speed[0, max(self._end - round(ROLLED * self._hz), 0) : self._end]
        if self._stands and not (rolled > STANDING_SPEED).any():
            return self._excused(tick, reason)
        return self._attributed("ego", tick, reason, fault)

    def _excused(self, tick: int, reason: str) -> Attribution:
        if self._stands:
            speed = float(self._frame.speed[0, self._end])
            return self._attributed("npc", tick, f"the ego was standing ({abs(speed):.1f} m/s) at the impact")
        return self._attributed("npc", tick, reason)

    @property
    def _stands(self) -> bool:
        return bool(abs(self._frame.speed[0, self._end]) <= STANDING_SPEED)

    def _crossed(self, change: LaneChange) -> str:
        """That a vehicle changed lanes, and where the other was then."""
        mover, other = ("the ego", self._name) if change.vehicle == 0 else (self._name, "the ego")
        tick, gap = change.tick, self._gap(change.tick)
        place = "side by side"
        if gap > 0:
            is_ahead = self._leads(tick) == (change.vehicle == 0)
            faster = float(self._frame.speed[0, tick] - self._frame.speed[self._npc + 1, tick])
            faster = faster if change.vehicle == 0 else -faster
            pace = f"{abs(faster):.1f} m/s {'faster' if faster >= 0 else 'slower'}"
            pace = "as fast" if abs(faster) < 0.05 else pace
            place = f"{gap:.1f} m {'ahead' if is_ahead else 'behind'}, {pace}"
        crossed = f"at {self._at(tick)} {mover} crossed the lane line towards {other}"
        return f"{crossed} ({change.drift:.1f} m/s sideways), {place}"

    def _close_behind(self, follower: str, leader: str) -> str:
        gap, safe = max(self._gap(self._start), 0.0), self._dangers.safe_along[self._start, self._npc]
        when, place = self._at(self._start), f"{gap:.1f} m behind {leader}"
        return f"from {when} on {follower} was {place}, closer than the {safe:.1f} m that RSS demands"

    def _would(self, since: int) -> str:
        due = self._at(since + round(FOLLOWING.delay * self._hz))
        return f"braking with {FOLLOWING.deceleration:.0f} m/s^2 from {due} on would have avoided it"

    def _demanded(self, since: int) -> str:
        """As :meth:`_would`, of a cut-in."""
        due = self._at(since + round(CUT_OFF.delay * self._hz))
        demanded = f"{CUT_OFF.deceleration:.0f} to {EMERGENCY.braking.deceleration:.0f} m/s^2"
        return f"braking with {demanded} from {due} on would have avoided it"

    def _answer(self, since: int) -> str:
        """What the ego did since a tick, in words."""
        slowed = braking(self._trace)[since + 1 : self._end + 1]
        braked = np.flatnonzero(slowed >= BRAKES)
        if braked.size:
            return (
                f"the ego braked from {self._at(since + int(braked[0]))} on with up to {float(slowed.max()):.1f} m/s^2"
            )
        speed = self._frame.speed[0, since : self._end + 1]
        if float(speed.max()) > float(speed[0]) + SPED_UP:
            return f"the ego sped up to {float(speed.max()):.1f} m/s"
        return "the ego did not brake"

    def _at(self, tick: int) -> str:
        return f"{tick / self._hz:.1f} s"

    def _gap(self, tick: int) -> float:
        """Between the boxes along the road [m], negative side by side."""
        frame, npc = self._frame, self._npc
        half = frame.half_along[0, tick] + frame.half_along[npc + 1, tick]
        return float(abs(frame.ahead[npc, tick]) - half)

    def _leads(self, tick: int) -> bool:
        """Whether the ego is the one ahead."""
        return bool(self._frame.ahead[self._npc, tick] < 0)

    def _pursuit(self, *, by_ego: bool, goes_on: bool = False) -> Pursuit:
        """The ego behind the NPC, or the NPC behind the ego; ``goes_on`` with the braking of its last tick."""
        frame, npc, past, way = self._frame, self._npc, slice(self._end + 1), 1.0 if by_ego else -1.0
        vehicles = (0, npc + 1) if by_ego else (npc + 1, 0)
        first, second = ((frame.cos[vehicle, past], frame.sin[vehicle, past]) for vehicle in vehicles)
        responder, other = (frame.speed[vehicle, past] for vehicle in vehicles)
        own, theirs = ((float(length), float(width)) for length, width in self._trace.sizes[list(vehicles)])
        return Pursuit(
            ahead=way * frame.ahead[npc, past],
            right=way * frame.right[npc, past],
            directions=(first, second),
            speeds=(responder, other),
            sizes=(own, theirs),
            hz=self._hz,
            goes_on=goes_on,
        )


def _braking_room(faster: float) -> float:
    """What the one behind needs to slow down with 3 m/s^2 after 0.4 s [m]; 0 where it is not faster."""
    faster = max(faster, 0.0)
    return faster * GIVING_WAY.delay + faster**2 / (2 * GIVING_WAY.deceleration)
