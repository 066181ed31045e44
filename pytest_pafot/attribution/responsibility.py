"""Who caused a collision, by written rules over the trace.

:func:`rss_rule` is the rule; :func:`position_rule` is a second opinion. docs/explanation.md tells both with their
sources.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.avoidance import Braking, Chase, Emergency
from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.trace import ACCELERATION, LANE, OFFSET, Collision, FloatArray, Trace, X, Y

Responsibility = Literal["ego", "npc", "both", "none"]
"""``none`` where there was no collision."""

Fault = Literal["entered-lane", "cut-in-unanswered", "leader-unanswered", "braked-hard"]
"""What the ego answers for: it moved sideways into somebody's way; it did not respond properly to a cut-in, or to a
vehicle ahead in its lane; it braked harder than anybody may with nothing ahead."""

STANDING_SPEED = 0.1
"""Up to this speed [m/s] the ego counts as standing."""

DISTANCES = RssRules(
    ego_response=1.0,
    npc_response=1.0,
    acceleration=0.0,
    least_braking=6.0,
    hardest_braking=8.0,
    lateral_acceleration=0.2,
    lateral_braking=0.8,
    fluctuation=0.1,
)
"""The safe distances of attribution. The usual two seconds behind a leader of equal speed must never be a fault: with
these values they are safe up to 48 m/s (v + v^2 / 48 <= 2 v). Speeding up during the response time, which RSS counts
with, would ask for more than that; a follower that does so has to answer for it through the distance itself. A leader
brakes with at most 8 m/s^2, the hardest that NPCs can; a follower with at least 6 m/s^2, what UN R157 5.2.5.2 takes for
granted of a system that must avoid. Lateral values are those of :class:`~pytest_pafot.criticality.RssRules`."""

FOLLOWING = Braking(delay=1.0, deceleration=6.0)
"""The proper response of the one behind in a lane: that of RSS, with the numbers of :data:`DISTANCES`."""

CUT_OFF = Braking(delay=1.4, deceleration=3.0, perception=0.4)
"""The proper response of one that was cut off, unless it is an emergency: no harsh braking (UN R157, 5.2.3.3), but
what a lane change may ask of others (UN R79, 5.6.4.7: 3 m/s^2). The delay is the careful and competent driver's
(UN R157, annex 4, appendix 3): 0.4 s to perceive the risk, 0.75 s until the brakes act, and half the time in which
they build up."""

EMERGENCY = Emergency(
    time_to_contact=2.0, leader_braking=5.0, perception=0.4, braking=Braking(delay=1.4, deceleration=6.0)
)
"""When the one that was cut off has to brake hard: the careful and competent driver's criteria."""

GIVING_WAY = Braking(delay=0.4, deceleration=3.0)
"""What a lane change may ask of the one behind in the other lane (UN R79, 5.6.4.7)."""

LEAVING = 0.375
"""A cut-in can be told from wandering in the lane from this offset to the lane's centre on (UN R157) [m]."""

DRIFTING = 0.3
"""Lateral speed towards the other, below which a vehicle keeps its place in the lane [m/s]."""
SPED_UP = 0.3
"""Gain of speed after a cut-in that the explanation names [m/s]."""
SHARE = 0.25
"""Share of the lateral closing speed, below which it is the other's doing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Attribution:
    """Who is responsible, and why.

    Attributes:
        responsibility: for the collision.
        tick, time: from which on the situation was dangerous [s]; None without a collision.
        reason: the end of a sentence that begins with "because".
        fault: of the ego; None where it does not answer for the collision.
    """

    responsibility: Responsibility
    tick: int | None
    time: float | None
    reason: str
    fault: Fault | None = None

    @property
    def blames_ego(self) -> bool:
        """Whether the ego answers for the collision, alone or with the NPC."""
        return self.responsibility in ("ego", "both")


def rss_rule(trace: Trace) -> Attribution:
    """Who is responsible by Responsibility-Sensitive Safety: who made it dangerous and did not respond properly.

    1. Nobody without a collision; the NPC where the ego stood (at most 0.1 m/s).
    2. The danger began at the first tick of the last stretch of time, up to the impact, in which the longitudinal and
       the lateral distance both were shorter than :data:`DISTANCES` asks for.
    3. If they were side by side then, or the lateral distance was the last to break, who moved sideways towards the
       other owes an answer: at least 0.3 m/s and a quarter of the closing speed. Both moved: both are responsible.

       - The ego moved: it is responsible, except where an NPC behind would not have touched it with 3 m/s^2 after
         0.4 s. Such a lane change is allowed, also while the NPC moves into that lane.
       - The NPC moved: it is responsible, except where it was ahead, the ego's front hit it, and calm braking with
         3 m/s^2, in an emergency with 6 m/s^2, would have avoided that, once the cut-in could be seen.
    4. Otherwise the follower owes an answer. The ego as follower is responsible if the proper response, 6 m/s^2 after
       1 s, would have avoided the collision. As the leader it is not, except where it braked harder than 8 m/s^2
       with nothing ahead and the follower had no chance.

    Whether braking would have avoided the collision is computed from the other's motion as recorded. So what was
    unsafe at the start is never the ego's by that alone: it must have had the time to respond.

    Sources: Shalev-Shwartz, Shammah, Shashua, "On a Formal Model of Safe and Scalable Self-driving Cars",
    arXiv:1708.06374 (distances, danger, blame, proper response); UN Regulation No. 157 (numbers of a careful driver).
    """
    if trace.collision is None:
        return Attribution(responsibility="none", tick=None, time=None, reason="there was no collision")
    scene, collision = Scene(trace), trace.collision
    start = _start(scene.is_close[:, collision.npc] & scene.is_beside[:, collision.npc])
    conflict = Conflict(scene, collision.npc, start, trace.ticks, by_ego_front=collision.side == "front")
    verdict = conflict.verdict
    if collision.ego_speed <= STANDING_SPEED:
        verdict = Verdict("npc", f"the ego was standing ({collision.ego_speed:.1f} m/s) at the impact")
    return Attribution(**verdict._asdict(), tick=start, time=start / trace.physics_hz)


def _start(is_dangerous: npt.NDArray[np.bool_]) -> int:
    """First tick of the danger that ends in the impact, at the last tick."""
    safe = np.flatnonzero(~is_dangerous[:-1])
    return int(safe[-1]) + 1 if safe.size else 0


def is_ego_responsible(trace: Trace) -> bool:
    """Whether the ego answers for a collision by :func:`rss_rule`, alone or with the NPC; False without one."""
    return rss_rule(trace).blames_ego


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


def position_reason(trace: Trace) -> str:
    """Why :func:`position_rule` says what it says: the end of a sentence that begins with "because"."""
    collision = trace.collision
    if collision is None:
        return "there was no collision"
    if collision.ego_speed <= STANDING_SPEED:
        return f"the ego was standing ({collision.ego_speed:.1f} m/s) at the impact"
    return f"NPC {collision.npc} was {_place(collision)} the ego (cell {int(collision.cell)}) at the impact"


def _place(collision: Collision) -> str:
    return {1: "ahead of", 0: "beside", -1: "behind"}[collision.cell.row]


class Verdict(NamedTuple):
    """An attribution without its moment."""

    responsibility: Responsibility
    reason: str
    fault: Fault | None = None


class Scene:
    """A run as the rule sees it, for all of its conflicts.

    Attributes:
        trace: of the run.
        frame: positions and speeds along and across the road.
        along, across: gaps between the boxes [m], shape [ticks + 1, NPCs].
        safe_along: what RSS asks for along the road [m].
        is_close, is_beside: where RSS would have more, along and across the road. Both at once are a danger.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.frame = RoadFrame(trace)
        self.along, self.across = self.frame.gap_along, self.frame.gap_across
        self.safe_along = self.frame.safe_along(DISTANCES)
        self.is_close = (self.along < self.safe_along) | (self.along <= 0)
        self.is_beside = self.across < self.frame.safe_across(DISTANCES)


class Conflict:
    """A danger between the ego and one NPC, from its first tick to its end: an impact, or what almost was one.

    Arrays are of the two up to the end, shape [end + 1].

    Args:
        scene: of the run.
        npc: the other vehicle.
        start: first tick of the danger.
        end: tick at which they touched, or nearly did.
        by_ego_front: whether it was, or would have been, the ego's front that hit.
    """

    def __init__(self, scene: Scene, npc: int, start: int, end: int, *, by_ego_front: bool) -> None:
        frame, past = scene.frame, slice(end + 1)
        self._scene, self._npc, self._start, self._end = scene, npc, start, end
        self._name, self._hz = f"NPC {npc}", scene.trace.physics_hz
        self._by_ego_front = by_ego_front
        self._ego, self._other = scene.trace.ego[past], scene.trace.npcs[past, npc]
        self._road = frame.ahead[npc, past], frame.right[npc, past]
        self._speeds = frame.speed[0, past], frame.speed[npc + 1, past]
        self._drifts = frame.drift[0, past], frame.drift[npc + 1, past]
        self._half_lengths = (frame.half_along[0] + frame.half_along[npc + 1])[past]
        self._along, self._across = scene.along[past, npc], scene.across[past, npc]
        self._safe_along, self._is_beside = scene.safe_along[past, npc], scene.is_beside[past, npc]
        self._abreast = self._across <= 0
        self._abreast[-1] = True  # They touched there, or are judged as if they had.

    @property
    def _before(self) -> int:
        """The last safe tick, from which on a response counts; the start of the run if there is none."""
        return max(self._start - 1, 0)

    @property
    def verdict(self) -> Verdict:
        """By the rules 3 and 4 of :func:`rss_rule`."""
        ego_moved, npc_moved = self._movers()
        if ego_moved and not self._ego_is_behind and self._leaves_room():
            gap, speed = self._along[self._start], self._towards()[0]
            return Verdict(
                "npc",
                f"at {self._when} the ego moved sideways towards {self._name} ({speed:.1f} m/s), {gap:.1f} m ahead "
                f"of it, which {self._name} could have met with {GIVING_WAY.deceleration:.0f} m/s^2 of braking",
            )
        if ego_moved and npc_moved:
            towards = self._towards()
            return Verdict(
                "both",
                f"at {self._when} the ego and {self._name} moved sideways into each other "
                f"({towards[0]:.1f} and {towards[1]:.1f} m/s)",
                "entered-lane",
            )
        if ego_moved:
            return self._ego_moved()
        if npc_moved:
            return self._npc_moved()
        return self._ego_followed() if self._ego_is_behind else self._npc_followed()

    @property
    def _when(self) -> str:
        return f"{self._start / self._hz:.1f} s"

    @property
    def _ego_is_behind(self) -> bool:
        return bool(self._road[0][self._start] >= 0)

    def _towards(self) -> tuple[float, float]:
        """Lateral speeds of the ego and of the NPC towards the other when the danger began [m/s]."""
        sign = 1.0 if self._road[1][self._start] >= 0 else -1.0
        ego, npc = self._drifts
        return max(float(sign * ego[self._start]), 0.0), max(float(-sign * npc[self._start]), 0.0)

    def _movers(self) -> tuple[bool, bool]:
        """Whether the ego, and whether the NPC, made the danger by moving sideways."""
        lateral_last = bool(self._start > 0 and not self._is_beside[self._start - 1])
        if not lateral_last and self._across[self._start] <= 0:
            return False, False
        towards = self._towards()
        ego, npc = (speed >= max(DRIFTING, SHARE * sum(towards)) for speed in towards)
        return ego, npc

    def _ego_moved(self) -> Verdict:
        speed, gap = self._towards()[0], self._along[self._start]
        moved = f"at {self._when} the ego moved sideways towards {self._name} ({speed:.1f} m/s)"
        if self._ego_is_behind or gap <= 0:
            where = f", {self._along_text()}"
        else:
            where = f", {gap:.1f} m ahead of it, where RSS demands {self._safe_along[self._start]:.1f} m"
        return Verdict("ego", f"{moved}{where}", "entered-lane")

    def _leaves_room(self) -> bool:
        """Whether a lane change of the ego asks little of the NPC behind."""
        return bool(self._along[self._start] > 0) and self._npc_chase.is_avoided(self._start, GIVING_WAY)

    def _npc_moved(self) -> Verdict:
        moved = (
            f"at {self._when} {self._name} moved sideways towards the ego ({self._towards()[1]:.1f} m/s), "
            f"{self._along_text()}"
        )
        if not self._ego_is_behind or not self._by_ego_front:
            return Verdict("npc", moved)
        seen = self._cut_in_seen()
        if not self._ego_chase.is_avoided(seen, CUT_OFF, EMERGENCY):
            return Verdict("npc", f"{moved}, too late to avoid it")
        reason = f"{moved}, but {self._braked_text(seen)} would have avoided it"
        return Verdict("ego", reason, "cut-in-unanswered")

    def _ego_followed(self) -> Verdict:
        safe = self._safe_along[self._start]
        close = f"from {self._when} it was closer than the {safe:.1f} m that RSS demands behind {self._name}"
        if self._ego_chase.is_avoided(self._before, FOLLOWING):
            reason = f"{close} and {self._ego_braking(self._before, FOLLOWING)}"
            return Verdict("ego", reason, "leader-unanswered")
        if self._start == 0:
            reason = f"the run began closer than the {safe:.1f} m that RSS demands, with no time to respond"
        else:
            reason = f"from {self._when} the {safe:.1f} m of RSS were gone, and no response could avoid {self._name}"
        return Verdict("npc", reason)

    def _npc_followed(self) -> Verdict:
        safe = self._safe_along[self._start]
        hardest = float(-self._ego[self._start :, ACCELERATION].min())
        if (
            hardest > DISTANCES.hardest_braking
            and not self._had_reason_to_brake()
            and not self._npc_chase.is_avoided(self._before, FOLLOWING)
        ):
            return Verdict(
                "ego",
                f"it braked with {hardest:.1f} of at most {DISTANCES.hardest_braking:.1f} m/s^2 with nothing ahead, "
                f"and {self._name} behind had no chance",
                "braked-hard",
            )
        reason = f"from {self._when} {self._name} was closer than the {safe:.1f} m that RSS demands behind the ego"
        return Verdict("npc", reason)

    def _had_reason_to_brake(self) -> bool:
        """Whether anybody was ahead in the ego's track and closer than RSS allows, at any tick of the danger."""
        scene, past = self._scene, slice(self._start, self._end + 1)
        is_close = (scene.along < scene.safe_along) & (scene.frame.ahead.T > 0)
        return bool((is_close & scene.is_beside)[past].any())

    def _cut_in_seen(self) -> int:
        """First tick of the danger at which the NPC had left the centre of a lane; the first of all if it never did."""
        offset = np.abs(_lane_offset(self._scene.trace, self._npc, slice(self._start, self._end + 1)))
        left = np.flatnonzero(offset > LEAVING)
        return self._start + (int(left[0]) if left.size else 0)

    @cached_property
    def _ego_chase(self) -> Chase:
        """The ego behind the NPC."""
        ego, npc = self._speeds
        return self._chase(self._road[0], ego, npc, self._other[:, ACCELERATION])

    @cached_property
    def _npc_chase(self) -> Chase:
        """The NPC behind the ego."""
        ego, npc = self._speeds
        return self._chase(-self._road[0], npc, ego, self._ego[:, ACCELERATION])

    def _chase(self, ahead: FloatArray, follower: FloatArray, leader: FloatArray, acceleration: FloatArray) -> Chase:
        return Chase(
            gap=ahead - self._half_lengths,
            abreast=self._abreast,
            follower=follower,
            leader=leader,
            leader_acceleration=acceleration,
            hz=self._hz,
        )

    def _along_text(self) -> str:
        gap = self._along[self._start]
        if gap <= 0:
            return "side by side"
        return f"{gap:.1f} m {'ahead' if self._ego_is_behind else 'behind'}"

    def _ego_braking(self, since: int, response: Braking) -> str:
        return f"braked with {self._mean_braking(since, response):.1f} of {response.deceleration:.1f} m/s^2"

    def _braked_text(self, seen: int) -> str:
        demanded = f"braking with {CUT_OFF.deceleration:.0f} to {EMERGENCY.braking.deceleration:.0f} m/s^2"
        perceived = min(seen + round(CUT_OFF.perception * self._hz), self._end)
        speed = self._speeds[0]
        highest = float(speed[perceived:].max())
        if highest > speed[perceived] + SPED_UP:
            return f"{demanded} instead of speeding up to {highest:.1f} m/s"
        return f"{demanded} instead of {self._mean_braking(seen, CUT_OFF):.1f}"

    def _mean_braking(self, since: int, response: Braking) -> float:
        """The ego's, from when its response was due to the end [m/s^2]."""
        due = min(since + round(response.delay * self._hz), self._end - 1)
        speed = self._speeds[0]
        seconds = (self._end - due) / self._hz
        return max(float(speed[due] - speed[-1]) / seconds, 0.0)


def _lane_offset(trace: Trace, npc: int, ticks: slice) -> npt.NDArray[np.float64]:
    """Distance of an NPC to the centre of the lane that it is in, signed [m], in a part of a run; NaN off the road."""
    rows, lanes = trace.npcs[ticks, npc], trace.lanes
    if trace.track is not None:
        return np.where(rows[:, LANE] < 0, np.nan, trace.track[ticks, npc + 1, OFFSET])
    index = rows[:, LANE].astype(int)
    x, y, heading = (np.array([getattr(lane, name) for lane in lanes])[index] for name in ("x", "y", "heading"))
    offset = (rows[:, Y] - y) * np.cos(heading) - (rows[:, X] - x) * np.sin(heading)
    return np.where(rows[:, LANE] < 0, np.nan, offset)
