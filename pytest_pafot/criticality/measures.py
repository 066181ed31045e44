"""The paper's measures, the time to collision of boxes, and derived measures.

Source, unless another is named: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 3.3 (Fitness
Function), equations 1 to 5. Vehicle 1 of the equations is the ego, vehicle 2 an NPC.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality import sweep
from pytest_pafot.criticality.boxes import Boxes, Pairs, box_gap, contact_time, depth, relate
from pytest_pafot.criticality.relative import RelativePositions
from pytest_pafot.model.trace import ACCELERATION, HEADING, SPEED, FloatArray, Trace

MANOEUVRE_SECONDS = 3.0
"""The time to manoeuvre t of equation 5 [s] (section 3.3: between 2 and 6 s by the literature, 3 s adopted)."""

_SWEEPS = sweep.is_in_use()
"""True if one compiled pass over a run computes the extremes. Without it, numpy's arrays compute the same values,
because the interpreted pass would be slower."""

_PARALLEL = 1e-9
"""The sine of the difference of two headings below which they count as parallel [1]: such lines cross beyond any road,
or only because of rounding."""


class Encounters(RelativePositions):
    """The geometry of one run that its measures share: relative positions, speeds and boxes."""

    def __init__(self, trace: Trace) -> None:
        super().__init__(trace.states, trace.sizes, trace.lanes, trace.track)

    @cached_property
    def speed(self) -> FloatArray:
        """The speeds of all vehicles [m/s], shape [vehicles, ticks + 1]."""
        return self.column(SPEED)

    @cached_property
    def boxes(self) -> Boxes:
        """The boxes of all vehicles, shape [vehicles, ticks + 1]."""
        return Boxes.driving(self.x, self.y, self.column(HEADING), self.speed, self._sizes[:, :1], self._sizes[:, 1:])

    @cached_property
    def pairs(self) -> Pairs:
        """The pairs (ego, NPC)."""
        every = slice(None)
        return relate(self.boxes.part(slice(0, 1), every), self.boxes.part(slice(1, None), every))

    def depths(self, rows: slice = slice(None), heading: float | None = None) -> FloatArray:
        """Return how deep the boxes of each two vehicles overlap [m], shape [pairs, rows]; negative if they are apart.

        With a heading [rad] the boxes do not turn: all of them have it.
        """
        boxes, every = self.boxes, range(len(self.x) - 1)
        if heading is not None:
            boxes = replace(boxes, cos=0 * boxes.cos + math.cos(heading), sin=0 * boxes.sin + math.sin(heading))
        parts = [(boxes.part(slice(n, n + 1), rows), boxes.part(slice(n + 1, None), rows)) for n in every]
        return np.vstack([depth(relate(*pair)) for pair in parts])

    def depth_in(self, obstacles: Sequence[Sequence[float]], vehicle: int) -> float:
        """Return how deep a vehicle overlaps fixed boxes at the end [m]; negative if it is apart from all of them.

        Each has x [m], y [m], heading [rad], length and width [m], as in :attr:`pytest_pafot.Trace.obstacles`.
        """
        if not obstacles:
            return -math.inf
        x, y, heading, length, width = np.array(obstacles, dtype=float).T
        fixed = Boxes.driving(x, y, heading, 0 * x, length, width)
        return float(depth(relate(self.boxes.part(slice(vehicle, vehicle + 1), slice(-1, None)), fixed)).max())

    @cached_property
    def ego_follows(self) -> npt.NDArray[np.bool_]:
        """True if the NPC's centre is level with the ego's or ahead of it, in any lane; False off the ego's way.

        The road's direction is the direction of the ego's lane (of the last lane if the ego is off the road). On roads
        that are not straight, *ahead* means later on the ego's way (:attr:`pytest_pafot.Trace.track`).
        """
        return self.ahead >= 0

    def follower_minus_leader(self, values: FloatArray) -> FloatArray:
        """Return the follower's value minus the leader's, for values of all vehicles; NaN off the ego's way."""
        ego_minus_npc = values[:1] - values[1:]
        gain: FloatArray = np.where(self.ego_follows, ego_minus_npc, -ego_minus_npc)
        return np.where(self.is_on_way, gain, np.nan)


@lru_cache(maxsize=1)
def encounters_of(trace: Trace) -> Encounters:
    """Return the geometry of a run. The last one is cached, because several measures of a run need it."""
    return Encounters(trace)


def ettc(trace: Trace) -> FloatArray:
    """Return the paper's estimated time to collision (equations 1 to 3) [s].

    It is the ego's distance to the point where the two lines of travel cross, divided by its speed. With p the
    positions, d the unit vectors of travel and x the cross product, that distance is (p2 - p1) x d2 / d1 x d2. This
    equals the paper's expression whenever the tangents and cotangents in that exist, and it is also defined for
    headings along the axes.

    The time is infinite if no single crossing point is ahead of both vehicles: if the lines are parallel or the same
    (use :func:`ttc` for following), if the point is behind either vehicle, and if the ego stands. A vehicle that drives
    backwards travels against its heading. As in the paper, it does not matter when the NPC reaches the point.
    """
    pairs, speed = encounters_of(trace).pairs, encounters_of(trace).speed
    way = np.where(speed < 0, -1.0, 1.0)
    # In the ego's frame (p2 - p1) x d2 is minus the offset across the NPC's heading, and d1 x d2 the sine of
    # the headings' difference; likewise with the roles swapped. Parallel lines divide by 1 and are ignored.
    parallel = np.abs(pairs.sin) < _PARALLEL
    sine = np.where(parallel, 1.0, pairs.sin)
    ego_way = -way[:1] * pairs.offsets[3] / sine
    npc_way = -way[1:] * pairs.offsets[1] / sine
    standing = speed[:1] == 0
    none = parallel | (ego_way < 0) | (npc_way < 0) | standing
    with np.errstate(over="ignore"):  # at the smallest speeds the time is infinite
        return np.where(none, np.inf, ego_way / np.where(standing, 1.0, np.abs(speed[:1]))).T


def mettc(trace: Trace) -> float:
    """Return the paper's METTC, the smallest :func:`ettc` of the run [s]; inf if none is finite."""
    return _lowest(ettc(trace))


def ttc(trace: Trace) -> FloatArray:
    """Return the time until the boxes touch if both keep velocity and heading [s], or inf.

    Source: time to collision of Hayward, "Near-miss determination through use of a scale of danger", 1972, for
    oriented boxes; exact for straight motion (see :func:`pytest_pafot.criticality.boxes.contact_time`).
    """
    return contact_time(encounters_of(trace).pairs).T


def min_ttc(trace: Trace) -> float:
    """Return the smallest :func:`ttc` of the run [s]; inf if none is finite."""
    swept = _swept(trace)
    return _lowest(ttc(trace)) if swept is None else swept[0]


def centre_distance(trace: Trace) -> FloatArray:
    """Return the distance of the centres of ego and NPC (equation 4) [m]."""
    # The offsets along and across the ego's heading give the same distance and are already computed.
    along, across = encounters_of(trace).pairs.offsets[:2]
    return np.sqrt(along * along + across * across).T


def min_centre_distance(trace: Trace) -> float:
    """Return the paper's MD, the smallest :func:`centre_distance` of the run [m]."""
    return _lowest(centre_distance(trace))


def gap(trace: Trace) -> FloatArray:
    """Return the distance of the boxes of ego and NPC [m]."""
    return box_gap(encounters_of(trace).pairs).T


def min_gap(trace: Trace) -> float:
    """Return the smallest :func:`gap` of the run [m]."""
    swept = _swept(trace)
    return _lowest(gap(trace)) if swept is None else swept[1]


def safety_distance(trace: Trace) -> FloatArray:
    """Return the paper's SD (equation 5), the distance that the follower gains on the leader in 3 s [m].

    (v1 - v2) t + (a1 - a2) t^2 / 2 with vehicle 1 the follower (:attr:`Encounters.ego_follows`) and 2 the leader. The
    follower must leave at least this distance. It is negative if the leader pulls away, and NaN if the NPC is not on
    the ego's way.
    """
    encounters, t = encounters_of(trace), MANOEUVRE_SECONDS
    gain = encounters.follower_minus_leader(encounters.speed)
    return (gain * t + encounters.follower_minus_leader(encounters.column(ACCELERATION)) * (t * t / 2)).T


def min_safety_distance(trace: Trace) -> float:
    """Return the smallest :func:`safety_distance` of the run [m], which the paper's fitness minimises.

    A minimum of this distance rewards leaders that pull away; :func:`max_safety_shortfall` does not. Only NPCs on the
    ego's way are included; the result is infinite if there never is one.
    """
    return _lowest(np.where(encounters_of(trace).is_on_way.T, safety_distance(trace), np.inf))


def safety_shortfall(trace: Trace) -> FloatArray:
    """Return the missing share of the safety distance, see :func:`max_safety_shortfall`; higher is worse."""
    keep = safety_distance(trace)
    demanded = encounters_of(trace).same_lane.T & ~(keep <= 0)
    with np.errstate(over="ignore"):  # at the smallest distances nothing is missing
        ratio = np.divide(gap(trace), keep, out=np.ones_like(keep), where=demanded)
    return np.maximum(1.0 - ratio, 0.0)


def max_safety_shortfall(trace: Trace) -> float:
    """Return the largest missing share of the safety distance in the run, 0 to 1.

    The share is clip((SD - gap) / SD, 0, 1), which is 1 at contact. It is 0 if SD <= 0, or if the centres of ego and
    NPC are not in the same lane, for example while an NPC crosses.
    """
    swept = _swept(trace)
    return float(safety_shortfall(trace).max(initial=0.0)) if swept is None else swept[2]


@lru_cache(maxsize=1)
def _swept(trace: Trace) -> tuple[float, float, float] | None:
    """Return :func:`min_ttc`, :func:`min_gap` and :func:`max_safety_shortfall` by one compiled pass over a run.

    None without such a pass, on roads of several directions, and if the results of the pass are not valid. The last
    result is cached, because the default fitness needs all three.
    """
    heading = trace.road.heading
    if not _SWEEPS or heading is None:
        return None
    return sweep.extremes(trace.states, trace.sizes, (math.cos(heading), math.sin(heading)), MANOEUVRE_SECONDS)


def hardest_brake(trace: Trace) -> float:
    """Return the ego's largest deceleration in the run [m/s^2], 0 if it never slowed down."""
    return max(0.0, -_lowest(trace.ego[:, ACCELERATION]))


def execution_time(trace: Trace) -> float:
    """Return the paper's ET, the simulated time of the run [s].

    Lower is worse if the run ended in a failure.
    """
    return trace.duration


def planned_duration(trace: Trace) -> float:
    """Return the duration of the scenario's genes [s]; that of the run if one of them has no duration."""
    return trace.duration if trace.scenario.seconds == np.inf else trace.scenario.seconds


def _lowest(values: FloatArray) -> float:
    return float(values.min(initial=np.inf))
