"""The paper's measures, time to collision of boxes, and what derives from them.

Source, unless another is named: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 3.3 (Fitness
Function), equations 1 to 5. Vehicle 1 of the equations is the ego, vehicle 2 an NPC.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality import sweep
from pytest_pafot.criticality.boxes import Boxes, Pairs, box_gap, contact_time, overlaps, relate
from pytest_pafot.criticality.relative import RelativePositions
from pytest_pafot.model.trace import ACCELERATION, HEADING, SPEED, FloatArray, Trace

MANOEUVRE_SECONDS = 3.0
"""The time to manoeuvre t of equation 5 [s] (section 3.3: between 2 and 6 s by the literature, 3 s adopted)."""

_SWEEPS = sweep.is_in_use()
"""Whether extremes come from one compiled pass; from the arrays they are the same, and sooner than interpreted."""

_PARALLEL = 1e-9
"""Headings whose sine differs by less are parallel [1]: their lines cross beyond any road, or only by rounding."""


def ettc(trace: Trace) -> FloatArray:
    """Estimated time to collision of the paper (equations 1 to 3) [s]; lower is worse.

    The ego's distance to the point where the two lines of travel cross, divided by its speed. With p the
    positions, d the unit vectors of travel and x the cross product, that distance is
    (p2 - p1) x d2 / d1 x d2, which equals the paper's expression wherever its tangents and cotangents exist and
    is defined for headings along the axes as well.

    Infinite where there is no single crossing point ahead of both: for parallel lines (also the same line: for
    following, use :func:`ttc`), for a point behind either vehicle, and for an ego that stands. A vehicle that
    drives backwards travels against its heading. When the NPC gets to the point plays no part, as in the paper.
    """
    return Encounters(trace).ettc.T


def mettc(trace: Trace) -> float:
    """The paper's METTC: the smallest :func:`ettc` of the run [s]; lower is worse, infinite if none is finite."""
    return Encounters(trace).mettc


def ttc(trace: Trace) -> FloatArray:
    """Time until the boxes touch if both keep velocity and heading [s]; lower is worse, 0 at overlap, inf if never.

    Source: time to collision of Hayward, "Near-miss determination through use of a scale of danger", 1972, for
    oriented boxes; exact for straight motion (see :func:`pytest_pafot.criticality.boxes.contact_time`).
    """
    return Encounters(trace).ttc.T


def min_ttc(trace: Trace) -> float:
    """The smallest :func:`ttc` of the run [s]; lower is worse, infinite if none is finite."""
    return Encounters(trace).min_ttc


def centre_distance(trace: Trace) -> FloatArray:
    """Distance between the centres of ego and NPC (equation 4) [m]; lower is worse."""
    return Encounters(trace).centre_distance.T


def min_centre_distance(trace: Trace) -> float:
    """The paper's MD: the smallest :func:`centre_distance` of the run [m]; lower is worse."""
    return Encounters(trace).min_centre_distance


def gap(trace: Trace) -> FloatArray:
    """Distance between the boxes of ego and NPC [m]; lower is worse, 0 at overlap."""
    return Encounters(trace).gap.T


def min_gap(trace: Trace) -> float:
    """The smallest :func:`gap` of the run [m]; lower is worse, 0 at a collision."""
    return Encounters(trace).min_gap


def ego_follows(trace: Trace) -> npt.NDArray[np.bool_]:
    """Whether the ego is the follower of the pair: the NPC's centre is level with its own or ahead, along the road.

    The road's direction is that of the ego's lane (of the last lane where the ego is off the road). On roads that are
    not straight, ahead is what comes later on the ego's way (:attr:`pytest_pafot.Trace.track`). False for an NPC that
    is not on the ego's way: neither follows the other.
    """
    return Encounters(trace).ego_follows.T


def safety_distance(trace: Trace) -> FloatArray:
    """SD of the paper (equation 5 with t = 3 s) [m]: by how much the follower gains on the leader within t.

    (v1 - v2) t + (a1 - a2) t^2 / 2 with vehicle 1 the follower (:func:`ego_follows`) and 2 the leader. The
    distance that the follower has to keep, so higher asks for more; negative where the leader pulls away. NaN where the
    NPC is not on the ego's way.
    """
    return Encounters(trace).safety_distance.T


def min_safety_distance(trace: Trace) -> float:
    """The smallest :func:`safety_distance` of the run [m], which is what the paper's fitness minimises.

    Taken as it is, it rewards leaders that pull away; :func:`safety_shortfall` is the reading that does not. Only of
    NPCs while they are on the ego's way; infinite where none ever is.
    """
    return Encounters(trace).min_safety_distance


def safety_shortfall(trace: Trace) -> FloatArray:
    """Share of the safety distance that is missing, clip((SD - gap) / SD, 0, 1); higher is worse.

    0 where ego and NPC are not in the same lane (by their centres), as an NPC that crosses, and where SD <= 0; 1 at
    contact.
    """
    return Encounters(trace).safety_shortfall.T


def max_safety_shortfall(trace: Trace) -> float:
    """The largest :func:`safety_shortfall` of the run, 0 to 1; higher is worse."""
    return Encounters(trace).max_safety_shortfall


def required_deceleration(trace: Trace) -> FloatArray:
    """Constant deceleration with which the follower just avoids the leader, who keeps its speed [m/s^2].

    Higher is worse; (v1 - v2)^2 / (2 gap) while closing in the same lane, else 0, also for an NPC that crosses;
    infinite at contact while closing. Source: deceleration rate to avoid a crash, DRAC (Cooper and Ferguson 1976; in
    the review of Westhofen et al. 2022).
    """
    return Encounters(trace).required_deceleration.T


def hardest_brake(trace: Trace) -> float:
    """The ego's largest deceleration in the run [m/s^2], positive; higher is worse, 0 if it never slowed down."""
    return max(0.0, -_lowest(trace.ego[:, ACCELERATION]))


def execution_time(trace: Trace) -> float:
    """ET of the paper, t_f - t_0: simulated time until the run ended [s]; lower is worse where it ended badly."""
    return trace.duration


def planned_duration(trace: Trace) -> float:
    """Time that the scenario's genes take [s]; a run ends earlier for a reason, or at the world's own limit.

    That of the run where an NPC crosses, which has no duration.
    """
    return trace.duration if trace.scenario.crossings else trace.scenario.seconds


class Encounters(RelativePositions):
    """The measures of one run; whoever needs several asks one of these, and the shared geometry is computed once.

    Arrays are as in the functions of the same names but transposed, [NPCs, ticks + 1].
    """

    def __init__(self, trace: Trace, *, sweeps: bool = _SWEEPS) -> None:
        """``sweeps=False`` takes the extremes from the arrays, which gives the same numbers; so do roads that bend."""
        super().__init__(trace.states, trace.sizes, trace.lanes, trace.track)
        self._sweeps = sweeps and trace.track is None

    @cached_property
    def speed(self) -> FloatArray:
        """Of all vehicles [m/s], shape [vehicles, ticks + 1]."""
        return self.column(SPEED)

    @cached_property
    def boxes(self) -> Boxes:
        """Of all vehicles, shape [vehicles, ticks + 1]."""
        return Boxes.driving(self.x, self.y, self.column(HEADING), self.speed, self._sizes[:, :1], self._sizes[:, 1:])

    @cached_property
    def pairs(self) -> Pairs:
        """(ego, NPC)."""
        every = slice(None)
        return relate(self.boxes.part(slice(0, 1), every), self.boxes.part(slice(1, None), every))

    @cached_property
    def ego_follows(self) -> npt.NDArray[np.bool_]:
        """Whether the NPC's centre is level with the ego's or ahead of it, along the road; False off the ego's way."""
        return self.ahead >= 0

    @cached_property
    def gain(self) -> FloatArray:
        """Speed of the follower minus that of the leader [m/s]; NaN off the ego's way."""
        return self._follower_minus_leader(self.speed)

    @cached_property
    def ettc(self) -> FloatArray:
        """Time of the ego to where the two lines of travel cross, as in the paper [s]; lower is worse, inf if none."""
        pairs, speed = self.pairs, self.speed
        way = np.where(speed < 0, -1.0, 1.0)
        # In the ego's frame (p2 - p1) x d2 is minus the offset across the NPC's heading, and d1 x d2 the sine of
        # the headings' difference; likewise with the roles swapped. Parallel lines divide by 1 and are dropped.
        parallel = np.abs(pairs.sin) < _PARALLEL
        sine = np.where(parallel, 1.0, pairs.sin)
        ego_way = -way[:1] * pairs.offsets[3] / sine
        npc_way = -way[1:] * pairs.offsets[1] / sine
        standing = speed[:1] == 0
        none = parallel | (ego_way < 0) | (npc_way < 0) | standing
        with np.errstate(over="ignore"):  # by the smallest of speeds, the time is infinite
            return np.where(none, np.inf, ego_way / np.where(standing, 1.0, np.abs(speed[:1])))

    @cached_property
    def ttc(self) -> FloatArray:
        """Time until the boxes touch at constant velocity [s]; lower is worse, 0 at overlap, inf if never."""
        return contact_time(self.pairs)

    @cached_property
    def centre_distance(self) -> FloatArray:
        """Between the centres of ego and NPC [m]; lower is worse."""
        # Along and across the ego's heading: the same distance, already at hand.
        along, across = self.pairs.offsets[0], self.pairs.offsets[1]
        return np.sqrt(along * along + across * across)

    @cached_property
    def gap(self) -> FloatArray:
        """Between the boxes of ego and NPC [m]; lower is worse, 0 at overlap."""
        return box_gap(self.pairs)

    @cached_property
    def safety_distance(self) -> FloatArray:
        """By how much the follower gains on the leader within 3 s, as in the paper [m]; higher asks for more.

        NaN off the ego's way.
        """
        t = MANOEUVRE_SECONDS
        return self.gain * t + self._follower_minus_leader(self.column(ACCELERATION)) * (t * t / 2)

    @cached_property
    def safety_shortfall(self) -> FloatArray:
        """Share of the safety distance that is missing in one lane, 0 to 1; higher is worse."""
        keep = self.safety_distance
        demanded = self.same_lane & ~(keep <= 0)
        with np.errstate(over="ignore"):  # by the smallest of distances, nothing is missing
            ratio = np.divide(self.gap, keep, out=np.ones_like(keep), where=demanded)
        return np.maximum(1.0 - ratio, 0.0)

    @cached_property
    def required_deceleration(self) -> FloatArray:
        """With which the follower just avoids the leader in one lane [m/s^2]; higher is worse."""
        closing = np.maximum(self.gain, 0.0)
        threatened = self.same_lane & ~(closing <= 0)
        with np.errstate(divide="ignore"):
            needed: FloatArray = np.divide(closing**2, 2 * self.gap, out=np.zeros_like(closing), where=threatened)
        return needed

    @property
    def mettc(self) -> float:
        """Least :attr:`ettc` of the run [s]; lower is worse, inf if none is finite."""
        return _lowest(self.ettc)

    @property
    def min_ttc(self) -> float:
        """Least :attr:`ttc` of the run [s]; lower is worse, inf if none is finite."""
        return _lowest(self.ttc) if self._extremes is None else self._extremes.min_ttc

    @property
    def min_centre_distance(self) -> float:
        """Least :attr:`centre_distance` of the run [m]; lower is worse."""
        return _lowest(self.centre_distance)

    @property
    def min_gap(self) -> float:
        """Least :attr:`gap` of the run [m]; lower is worse, 0 at a collision."""
        return _lowest(self.gap) if self._extremes is None else self._extremes.min_gap

    @property
    def min_safety_distance(self) -> float:
        """Least :attr:`safety_distance` of the run, on the ego's way [m]; inf if nobody ever is."""
        return _lowest(np.where(self.is_on_way, self.safety_distance, np.inf))

    @property
    def max_safety_shortfall(self) -> float:
        """Largest :attr:`safety_shortfall` of the run, 0 to 1; higher is worse."""
        if self._extremes is not None:
            return self._extremes.max_safety_shortfall
        return float(self.safety_shortfall.max(initial=0.0))

    @cached_property
    def _extremes(self) -> sweep.Sweep | None:
        """Of one compiled pass over the run; None where there is none, or where it leaves the run to the arrays."""
        heading = self._lanes[0].heading
        if not self._sweeps or any(lane.heading != heading for lane in self._lanes):
            return None
        road = math.cos(heading), math.sin(heading)
        found = sweep.Sweep(self._states, self._sizes, road, MANOEUVRE_SECONDS)
        return found if found.run() else None

    def _follower_minus_leader(self, values: FloatArray) -> FloatArray:
        ego_minus_npc = values[:1] - values[1:]
        gain: FloatArray = np.where(self.ego_follows, ego_minus_npc, -ego_minus_npc)
        return gain if self._track is None else np.where(self.is_on_way, gain, np.nan)


def _lowest(values: FloatArray) -> float:
    return float(values.min(initial=np.inf))


# Post-encroachment time: how narrowly two vehicles missed each other in time.
#
# Source: Allen, Shin, Cooper, "Analysis of traffic conflicts and collisions", Transportation Research Record 667,
# 1978: the time between one road user leaving a place and another arriving at it.


def post_encroachment_time(trace: Trace, *, horizon: float = 10.0) -> FloatArray:
    """Shortest time between one of ego and NPC leaving a place and the other arriving at it [s], shape [NPCs].

    Lower is worse; 0 at overlap, infinite where nobody arrives within ``horizon`` seconds. The place is any: the
    result is the smallest lag at which the box of one, where it is now, overlaps the box of the other, where it
    was before. For a crossing that is the usual measure at its conflict area, for following the net time gap.
    Lags are whole physics ticks, so that it exceeds the exact time by up to one tick.

    Args:
        trace: the run.
        horizon: longest time looked for [s]; the work grows with it.
    """
    boxes = Encounters(trace).boxes
    lags = range(min(int(horizon * trace.physics_hz), trace.ticks) + 1)
    met = [
        next((lag for lag in lags if _meets(boxes, 0, npc, lag) or _meets(boxes, npc, 0, lag)), np.inf)
        for npc in range(1, len(boxes.x))
    ]
    return np.array(met) / trace.physics_hz


def _meets(boxes: Boxes, first: int, second: int, lag: int) -> bool:
    """Whether ``second`` ever is, ``lag`` ticks later, where ``first`` was."""
    ticks = boxes.x.shape[1]
    before = boxes.part(slice(first, first + 1), slice(0, ticks - lag))
    after = boxes.part(slice(second, second + 1), slice(lag, ticks))
    # Most lags are settled by the circles around the boxes, at a fraction of the cost.
    reach = np.hypot(before.half_length, before.half_width) + np.hypot(after.half_length, after.half_width)
    if not ((after.x - before.x) ** 2 + (after.y - before.y) ** 2 <= reach**2).any():
        return False
    return bool(overlaps(relate(before, after)).any())
