"""Who caused a collision, by written rules over the trace.

:func:`rss_rule` is the rule; :func:`position_rule` is a second opinion. docs/explanation.md tells both with their
sources.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from pytest_pafot.attribution.avoidance import Braking, Chase, Emergency
from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.trace import ACCELERATION, LANE, OFFSET, Trace, X, Y

Responsibility = Literal["ego", "npc", "both", "none"]
"""``none`` where there was no collision."""

Fault = Literal["entered-lane", "cut-in-unanswered", "leader-unanswered", "braked-hard"]
"""What the ego answers for: it moved sideways into somebody's way; it did not respond properly to a cut-in, or to a
vehicle ahead in its lane; it braked harder than anybody may with nothing ahead."""

STANDING_SPEED = 0.1
"""Up to this speed [m/s] the ego counts as standing."""

DISTANCES = RssRules(ego_response=1.0, npc_response=1.0, acceleration=0.0, least_braking=6.0, hardest_braking=8.0)
"""The safe distances of attribution. The usual two seconds behind a leader of equal speed must never be a fault: with
these values they are safe up to 48 m/s (v + v^2 / 48 <= 2 v). Speeding up during the response time, which RSS counts
with, would ask for more than that; a follower that does so has to answer for it through the distance itself. A leader
brakes with at most 8 m/s^2, the hardest that NPCs can; a follower with at least 6 m/s^2, what UN R157 5.2.5.2 takes for
granted of a system that must avoid. Lateral values are the defaults of :class:`~pytest_pafot.criticality.RssRules`."""

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
    dangers, collision = Dangers(trace), trace.collision
    safe = np.flatnonzero(~dangers.is_dangerous[:-1, collision.npc])
    start = int(safe[-1]) + 1 if safe.size else 0
    conflict = Conflict(dangers, collision.npc, start, trace.ticks, by_ego_front=collision.side == "front")
    if collision.ego_speed <= STANDING_SPEED:
        return conflict.attributed("npc", f"the ego was standing ({collision.ego_speed:.1f} m/s) at the impact")
    return conflict.attribution


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
        along, across: gaps between the boxes [m].
        safe_along: what RSS asks for along the road [m].
        is_close, is_beside: where RSS would have more, along and across the road.
        is_dangerous: where both hold.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.frame = RoadFrame(trace)
        self.along, self.across = self.frame.gap_along, self.frame.gap_across
        self.safe_along = self.frame.safe_along(DISTANCES)
        self.is_close = (self.along < self.safe_along) | (self.along <= 0)
        self.is_beside = self.across < self.frame.safe_across(DISTANCES)
        self.is_dangerous = self.is_close & self.is_beside


class Conflict:
    """A danger between the ego and one NPC, from its first tick to its end: an impact, or what almost was one."""

    def __init__(self, dangers: Dangers, npc: int, start: int, end: int, *, by_ego_front: bool) -> None:
        """``by_ego_front`` is whether it was, or would have been, the ego's front that hit."""
        frame, trace, past = dangers.frame, dangers.trace, slice(end + 1)
        self._dangers, self._npc, self._start, self._end = dangers, npc, start, end
        self._by_ego_front = by_ego_front
        self._name, self._hz = f"NPC {npc}", trace.physics_hz
        self._when = f"{start / self._hz:.1f} s"
        self._before = max(start - 1, 0)  # the last safe tick, from which on a response counts
        self._ahead = frame.ahead[npc, past]
        self._ego_is_behind = bool(self._ahead[start] >= 0)
        self._speeds = frame.speed[0, past], frame.speed[npc + 1, past]
        self._accelerations = trace.ego[past, ACCELERATION], trace.npcs[past, npc, ACCELERATION]
        self._half_lengths = (frame.half_along[0] + frame.half_along[npc + 1])[past]
        self._gap, self._safe = dangers.along[start, npc], dangers.safe_along[start, npc]
        self._abreast = dangers.across[past, npc] <= 0
        self._abreast[-1] = True  # they touched there, or are judged as if they had
        side = 1.0 if frame.right[npc, start] >= 0 else -1.0
        ego, other = side * frame.drift[0, start], -side * frame.drift[npc + 1, start]
        self._towards = max(float(ego), 0.0), max(float(other), 0.0)  # lateral speeds when the danger began [m/s]

    def attributed(self, responsibility: Responsibility, reason: str, fault: Fault | None = None) -> Attribution:
        """An attribution since the first tick of this danger."""
        time = self._start / self._hz
        return Attribution(responsibility=responsibility, tick=self._start, time=time, reason=reason, fault=fault)

    @property
    def attribution(self) -> Attribution:
        """By the rules 3 and 4 of :func:`rss_rule`."""
        dangers, start, npc = self._dangers, self._start, self._npc
        to_npc, to_ego = self._towards
        lateral_last = start > 0 and not dangers.is_beside[start - 1, npc]
        by_moving = lateral_last or dangers.across[start, npc] > 0
        ego_moved, npc_moved = (by_moving and s >= max(DRIFTING, SHARE * sum(self._towards)) for s in self._towards)
        is_ahead = not self._ego_is_behind and self._gap > 0
        if ego_moved and is_ahead and self._chase(by_ego=False).is_avoided(self._start, GIVING_WAY):
            return self.attributed(
                "npc",
                f"at {self._when} the ego moved sideways towards {self._name} ({to_npc:.1f} m/s), {self._gap:.1f} m "
                f"ahead of it, which {self._name} could have met with {GIVING_WAY.deceleration:.0f} m/s^2 of braking",
            )
        if ego_moved and npc_moved:
            return self.attributed(
                "both",
                f"at {self._when} the ego and {self._name} moved sideways into each other "
                f"({to_npc:.1f} and {to_ego:.1f} m/s)",
                "entered-lane",
            )
        if ego_moved:
            where = f"{self._gap:.1f} m ahead of it, where RSS demands {self._safe:.1f} m" if is_ahead else self._place
            reason = f"at {self._when} the ego moved sideways towards {self._name} ({to_npc:.1f} m/s), {where}"
            return self.attributed("ego", reason, "entered-lane")
        if npc_moved:
            return self._npc_moved()
        return self._ego_followed() if self._ego_is_behind else self._npc_followed()

    def _npc_moved(self) -> Attribution:
        how = f"sideways towards the ego ({self._towards[1]:.1f} m/s), {self._place}"
        moved = f"at {self._when} {self._name} moved {how}"
        if not self._ego_is_behind or not self._by_ego_front:
            return self.attributed("npc", moved)
        offset = np.abs(_lane_offset(self._dangers.trace, self._npc, slice(self._start, self._end + 1)))
        left = np.flatnonzero(offset > LEAVING)
        seen = self._start + (int(left[0]) if left.size else 0)  # from the start where it never left a lane's centre
        if not self._chase(by_ego=True).is_avoided(seen, CUT_OFF, EMERGENCY):
            return self.attributed("npc", f"{moved}, too late to avoid it")
        demanded = f"braking with {CUT_OFF.deceleration:.0f} to {EMERGENCY.braking.deceleration:.0f} m/s^2"
        speed = self._speeds[0][min(seen + round(CUT_OFF.perception * self._hz), self._end) :]
        highest = float(speed.max())
        sped_up = highest > speed[0] + SPED_UP
        driven = f"speeding up to {highest:.1f} m/s" if sped_up else f"{self._mean_braking(seen, CUT_OFF):.1f}"
        return self.attributed(
            "ego", f"{moved}, but {demanded} instead of {driven} would have avoided it", "cut-in-unanswered"
        )

    def _ego_followed(self) -> Attribution:
        safe = f"the {self._safe:.1f} m"
        if self._chase(by_ego=True).is_avoided(self._before, FOLLOWING):
            braked = f"{self._mean_braking(self._before, FOLLOWING):.1f} of {FOLLOWING.deceleration:.1f} m/s^2"
            reason = f"from {self._when} it was closer than {safe} that RSS demands behind {self._name}"
            return self.attributed("ego", f"{reason} and braked with {braked}", "leader-unanswered")
        if self._start == 0:
            return self.attributed("npc", f"the run began closer than {safe} that RSS demands, with no time to respond")
        return self.attributed(
            "npc", f"from {self._when} {safe} of RSS were gone, and no response could avoid {self._name}"
        )

    def _npc_followed(self) -> Attribution:
        dangers, during = self._dangers, slice(self._start, self._end + 1)
        hardest = float(-self._accelerations[0][self._start :].min())
        # Whether anybody was ahead in the ego's track and closer than RSS allows, at any tick of the danger.
        is_close = (dangers.along < dangers.safe_along) & (dangers.frame.ahead.T > 0)
        had_reason = bool((is_close & dangers.is_beside)[during].any())
        too_hard = hardest > DISTANCES.hardest_braking and not had_reason
        if too_hard and not self._chase(by_ego=False).is_avoided(self._before, FOLLOWING):
            return self.attributed(
                "ego",
                f"it braked with {hardest:.1f} of at most {DISTANCES.hardest_braking:.1f} m/s^2 with nothing ahead, "
                f"and {self._name} behind had no chance",
                "braked-hard",
            )
        reason = f"{self._name} was closer than the {self._safe:.1f} m that RSS demands behind the ego"
        return self.attributed("npc", f"from {self._when} {reason}")

    def _chase(self, *, by_ego: bool) -> Chase:
        """The ego behind the NPC, or the NPC behind the ego."""
        follower, leader = (0, 1) if by_ego else (1, 0)
        return Chase(
            gap=(self._ahead if by_ego else -self._ahead) - self._half_lengths,
            abreast=self._abreast,
            follower=self._speeds[follower],
            leader=self._speeds[leader],
            leader_acceleration=self._accelerations[leader],
            hz=self._hz,
        )

    @property
    def _place(self) -> str:
        """Where the NPC was along the road when the danger began."""
        return "side by side" if self._gap <= 0 else f"{self._gap:.1f} m {'ahead' if self._ego_is_behind else 'behind'}"

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
