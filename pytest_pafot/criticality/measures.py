"""The geometry of a run, the paper's measures and others that follow from it, and the safe distances of RSS.

The road of the run (:class:`pytest_pafot.model.trace.RoadOfRun`) defines the distances. The record of a collision, the
explanation of a run and the report page share them. *Ahead* is the distance driven along the road, *right* is the
distance across it, both from the ego's centre to the NPC's [m]. Neither depends on the ego's heading. Both together
determine the cell, see :func:`pytest_pafot.model.instructions.cell_at`: rows are as long as the ego, columns as wide as
its lane. While an NPC that crosses is not on the ego's way, its distances, gaps and safe distances are NaN, it is in no
cell, and it shares a lane with no vehicle.

Sources, unless another is named: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 2.1 (Modelling Target
Positions) for the grid, and section 3.3 (Fitness Function), equations 1 to 5, for the measures. Vehicle 1 of the
equations is the ego, vehicle 2 an NPC.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from itertools import product, takewhile

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality import sweep
from pytest_pafot.model.instructions import Cell, cell_at
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, FloatArray, Lane, Trace, road_of_run


class RelativePositions:
    """The positions of the NPCs of a run relative to the ego at every tick; each array is computed at its first use.

    Arrays have the shape [NPCs, ticks + 1]: with the long dimension innermost, numpy is about three times as fast.

    Args:
        states, sizes, lanes, track: data of a run, see :class:`~pytest_pafot.Trace`.
    """

    def __init__(
        self, states: FloatArray, sizes: FloatArray, lanes: Sequence[Lane], track: FloatArray | None = None
    ) -> None:
        self._states = states
        self._sizes = sizes
        self._lanes = lanes
        self._road = road_of_run(states, lanes, track)

    def column(self, index: int) -> FloatArray:
        """Return one column of the trace's states, shape [vehicles, ticks + 1]."""
        return self._road.column(index)

    @property
    def x(self) -> FloatArray:
        """The x coordinates of all vehicles [m], shape [vehicles, ticks + 1]."""
        return self._road.x

    @property
    def y(self) -> FloatArray:
        """The y coordinates of all vehicles [m], shape [vehicles, ticks + 1]."""
        return self._road.y

    @property
    def road(self) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of the heading of the ego's lane, each of shape [1, ticks + 1], or [1, 1] if all have one."""
        return self._road.direction

    @property
    def is_on_way(self) -> npt.NDArray[np.bool_]:
        """True while an NPC is on the ego's way. An NPC that crosses is on that way only after it has merged."""
        return self._road.is_on_way

    @property
    def ahead(self) -> FloatArray:
        """The distance of each NPC's centre ahead of the ego's [m], negative behind it; NaN off the ego's way.

        On a straight road it is the distance along the road. On a road that bends, it is the difference of the two
        places on the ego's way, times the mean of the metres that ego and NPC drive per metre of that way. In a circle
        this is the length of the arc halfway between the arcs of the two vehicles.
        """
        return self._road.offsets[0]

    @property
    def right(self) -> FloatArray:
        """The distance of each NPC's centre to the right of the ego's, across the road [m], negative to the left.

        NaN off the ego's way. On a road that bends, it is the difference of the two vehicles' distances to the ego's
        way, each measured at the place of the vehicle.
        """
        return self._road.offsets[1]

    @cached_property
    def same_lane(self) -> npt.NDArray[np.bool_]:
        """True if the centres of ego and NPC are in one lane of the road and the NPC is on the ego's way."""
        lane = self.column(LANE)
        same: npt.NDArray[np.bool_] = (lane[1:] == lane[:1]) & (lane[:1] >= 0) & self.is_on_way
        return same

    def cell(self, npc: int, tick: int) -> Cell | None:
        """Return the cell that an NPC's centre is in at a tick; None in the ego's own cell and off the ego's way.

        A column is as wide as the ego's lane at that tick, or as the first lane if the ego is off the road.
        """
        ahead, right = self._road.offset(npc, tick)
        width = self._lanes[max(int(self._states[tick, 0, LANE]), 0)].width
        return cell_at(ahead, right, float(self._sizes[0, 0]), width)

    def last_cell(self, npc: int, tick: int) -> Cell | None:
        """Return the last cell, except the ego's own, that an NPC's centre was in up to a tick; None if there is none.

        None, too, if the NPC is off the ego's way at that tick, or has been in the ego's own cell since it entered that
        way.
        """
        ticks = takewhile(lambda each: self.is_on_way[npc, each], range(tick, -1, -1))
        cells = (self.cell(npc, each) for each in ticks)
        return next((cell for cell in cells if cell is not None), None)


_TINY = 1e-290
"""A tiny velocity that is added to relative velocities, so that no division is by zero [m/s]. Any velocity other than
zero stays the same, and a division by it does not overflow."""

FourAxes = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""One array per axis. A single stacked array would be so large that the allocator returns it to the system each time,
and faulting its pages in again takes several times as long as the arithmetic."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Boxes:
    """Rectangles that move without turning.

    Attributes:
        x, y: centres [m].
        cos, sin: cosines and sines of the headings; a heading points along the length.
        vx, vy: velocities [m/s].
        half_length, half_width: half of the lengths and of the widths [m].
    """

    x: FloatArray
    y: FloatArray
    cos: FloatArray
    sin: FloatArray
    vx: FloatArray
    vy: FloatArray
    half_length: FloatArray
    half_width: FloatArray

    @classmethod
    def driving(
        cls, x: FloatArray, y: FloatArray, heading: FloatArray, speed: FloatArray, length: FloatArray, width: FloatArray
    ) -> Boxes:
        """Make boxes that move along their heading [m, rad, m/s]; a negative speed means backwards."""
        cos, sin = np.cos(heading), np.sin(heading)
        return cls(
            x=x, y=y, cos=cos, sin=sin, vx=speed * cos, vy=speed * sin, half_length=length / 2, half_width=width / 2
        )

    def part(self, vehicles: slice, ticks: slice) -> Boxes:
        """Return the boxes of some vehicles at some ticks; these boxes have shape [vehicles, ticks]."""
        moving = {name: getattr(self, name)[vehicles, ticks] for name in ("x", "y", "cos", "sin", "vx", "vy")}
        return Boxes(**moving, half_length=self.half_length[vehicles], half_width=self.half_width[vehicles])


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """Pairs of boxes a and b, projected onto the four axes that can separate them.

    The axes are a's length, a's width, b's length and b's width.

    Attributes:
        a, b: the boxes of each pair.
        offsets: offset of b's centre from a's, along each axis [m].
        reaches: half extent of a plus half extent of b along each axis [m]; the boxes overlap there below this offset.
        cos, sin: cosine and sine of b's heading relative to a's.
    """

    a: Boxes
    b: Boxes
    offsets: FourAxes
    reaches: FourAxes
    cos: FloatArray
    sin: FloatArray


def relate(a: Boxes, b: Boxes) -> Pairs:
    """Project the pairs (a, b) onto their four axes, which all measures of this module need."""
    cos = a.cos * b.cos + a.sin * b.sin
    sin = a.cos * b.sin - a.sin * b.cos
    c, s = np.abs(cos), np.abs(sin)
    reaches = (
        a.half_length + b.half_length * c + b.half_width * s,
        a.half_width + b.half_length * s + b.half_width * c,
        b.half_length + a.half_length * c + a.half_width * s,
        b.half_width + a.half_length * s + a.half_width * c,
    )
    return Pairs(a=a, b=b, offsets=_along_axes(a, b, b.x - a.x, b.y - a.y), reaches=reaches, cos=cos, sin=sin)


def overlaps(pairs: Pairs) -> npt.NDArray[np.bool_]:
    """Return whether the boxes have a point in common, which means that no axis separates them."""
    result: npt.NDArray[np.bool_] = np.ones(pairs.cos.shape, dtype=np.bool_)
    for offset, reach in zip(pairs.offsets, pairs.reaches, strict=True):
        result &= np.abs(offset) <= reach
    return result


def depth(pairs: Pairs) -> FloatArray:
    """Return how deep the boxes overlap along the axis with the least overlap [m]; negative if they are apart."""
    spare = [reach - np.abs(offset) for offset, reach in zip(pairs.offsets, pairs.reaches, strict=True)]
    result: FloatArray = np.min(spare, axis=0)
    return result


def box_gap(pairs: Pairs) -> FloatArray:
    """Return the smallest distance between the boxes [m], 0 at overlap; lower is worse.

    The smallest distance between two separate rectangles is always at a corner of one of them.
    """
    a, b = pairs.a, pairs.b
    along, across, back_along, back_across = pairs.offsets
    from_b = _corners_to_box(along, across, pairs.cos, pairs.sin, a, b)
    # As seen from b, the offset has the opposite sign. That mirrors the set of a's corners in b's centre, which does
    # not change their distances from b's box, so the sign can stay.
    from_a = _corners_to_box(back_along, back_across, pairs.cos, -pairs.sin, b, a)
    return np.where(overlaps(pairs), 0.0, np.sqrt(np.minimum(from_a, from_b)))


def contact_time(pairs: Pairs) -> FloatArray:
    """Return the time until the boxes first touch if both keep their velocity and heading [s]; lower is worse.

    The time is 0 at overlap, and infinite if the boxes never touch. Along each of the four axes, the projections of the
    boxes overlap during one interval of time. Contact begins when the last of these four intervals begins, unless one
    of them has ended by then.
    """
    velocities = _along_axes(pairs.a, pairs.b, pairs.b.vx - pairs.a.vx, pairs.b.vy - pairs.a.vy)
    begins: FloatArray = np.full(pairs.cos.shape, -np.inf)
    ends: FloatArray = np.full(pairs.cos.shape, np.inf)
    for offset, reach, velocity in zip(pairs.offsets, pairs.reaches, velocities, strict=True):
        distance = np.abs(offset)
        parting = np.copysign(1.0, offset) * velocity + _TINY
        near, far = (reach - distance) / parting, -(reach + distance) / parting
        begins = np.maximum(begins, np.minimum(near, far))
        ends = np.minimum(ends, np.maximum(near, far))
    # This order makes NaN fail the comparisons, so the result is NaN.
    return np.where((begins > ends) | (ends < 0), np.inf, np.maximum(begins, 0.0))


def _along_axes(a: Boxes, b: Boxes, x: FloatArray, y: FloatArray) -> FourAxes:
    """Return the components of the vector (x, y) along the four axes of the boxes a and b."""
    return x * a.cos + y * a.sin, y * a.cos - x * a.sin, x * b.cos + y * b.sin, y * b.cos - x * b.sin


def _corners_to_box(
    u: FloatArray, v: FloatArray, cos: FloatArray, sin: FloatArray, box: Boxes, other: Boxes
) -> FloatArray:
    """Return the squared distance from the nearest corner of ``other`` to ``box`` [m^2].

    ``(u, v)`` is the centre of ``other`` in the frame of ``box``. ``cos`` and ``sin`` are the cosine and sine of the
    heading of ``other`` in that frame.
    """
    length_u, length_v = other.half_length * cos, other.half_length * sin
    width_u, width_v = -other.half_width * sin, other.half_width * cos
    nearest: FloatArray = np.full(u.shape, np.inf)
    for move, side in product((np.add, np.subtract), repeat=2):
        outside_u = np.maximum(np.abs(side(move(u, length_u), width_u)) - box.half_length, 0.0)
        outside_v = np.maximum(np.abs(side(move(v, length_v), width_v)) - box.half_width, 0.0)
        nearest = np.minimum(nearest, outside_u * outside_u + outside_v * outside_v)
    return nearest


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
    oriented boxes; exact for straight motion (see :func:`pytest_pafot.criticality.measures.contact_time`).
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


def stretches(holds: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first tick and the tick after the last of each unbroken stretch in which a condition holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], holds, [False])))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def last_stretch(holds: npt.NDArray[np.bool_]) -> int:
    """Return the first tick of the last unbroken stretch, up to the last tick, in which a condition holds."""
    fails = np.flatnonzero(~holds[:-1])
    return int(fails[-1]) + 1 if fails.size else 0


def _lowest(values: FloatArray) -> float:
    return float(values.min(initial=np.inf))


@dataclass(frozen=True, slots=True, kw_only=True)
class RssRules:
    """The parameters of RSS. The paper does not specify their values.

    The defaults are the initial values that Intel published with its open implementation (ad-rss-lib, appendix
    "Parameter Discussion"), with a response time of 1 s for the automated vehicle and 2 s for all others.

    Attributes:
        ego_response, npc_response: rho, the response time, in which a vehicle may still accelerate as hard as possible
            [s].
        acceleration: a_max,accel, the hardest acceleration during the response time [m/s^2].
        least_braking: a_min,brake, the least braking of a follower after its response time [m/s^2].
        hardest_braking: a_max,brake, the hardest braking of a leader [m/s^2].
        lateral_acceleration: a_lat,max,accel, the hardest sideways acceleration towards the other vehicle during the
            response time [m/s^2].
        lateral_braking: a_lat,min,brake, the least sideways braking after the response time [m/s^2].
        fluctuation: mu, the lateral margin [m].
    """

    ego_response: float = 1.0
    npc_response: float = 2.0
    acceleration: float = 3.5
    least_braking: float = 4.0
    hardest_braking: float = 8.0
    lateral_acceleration: float = 0.2
    lateral_braking: float = 0.8
    fluctuation: float = 0.1

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            divides = field.name in ("least_braking", "hardest_braking", "lateral_braking")
            if not math.isfinite(value) or value < 0 or (divides and value == 0):
                bound = "more than 0" if divides else "at least 0"
                raise ValueError(f"{field.name}: expected a finite number, {bound}, received {value!r}")

    def safe_along(self, follower: FloatArray, leader: FloatArray, response: float | FloatArray) -> FloatArray:
        """Return the gap [m] that a follower must leave, for the two speeds [m/s] and the follower's response time [s].

        The leader may brake as hard as possible at once. The follower may speed up for its response time rho and then
        brakes with at least a_min,brake:

            v rho + a rho^2 / 2 + (v + rho a)^2 / (2 a_min,brake) - v_leader^2 / (2 a_max,brake)

        Speeds are along the road. A leader that drives against the direction of the road comes closer while it brakes,
        so the square of its speed has the sign of the speed. The paper's second formula, for oncoming traffic, is not
        used.
        """
        fastest = follower + response * self.acceleration
        travelled = (follower + fastest) / 2 * response + _stopping(fastest, self.least_braking)
        return np.asarray(np.maximum(travelled - _stopping(leader, self.hardest_braking), 0.0))


def longitudinal_gap(trace: Trace) -> FloatArray:
    """Return the gap between the boxes of ego and NPC along the road [m], shape [ticks + 1, NPCs].

    Lower is worse; 0 if the boxes are side by side.
    """
    return RoadFrame(trace).gap_along


class RoadFrame:
    """Positions and velocities of a run's vehicles along and across the road, shape [vehicles or NPCs, ticks + 1].

    Attributes:
        is_on_way: whether each NPC is on the ego's way, see :class:`~pytest_pafot.criticality.RelativePositions`.
        ahead, right: offset of the NPC's centre from the ego's [m].
        cos, sin: cosine and sine of each vehicle's angle to the road at its place.
        speed: speed of each vehicle along the road [m/s].
        drift: speed of each vehicle to the right across the road [m/s], from its movement since the previous tick, so
            slip is included. At the first tick of the run, or of the vehicle on the ego's way, it is computed from the
            vehicle's heading.
        half_along, half_across: half extents of each box [m].

    Gaps and safe distances have the shape [ticks + 1, NPCs]. All values of an NPC are NaN while it is not on the ego's
    way.
    """

    def __init__(self, trace: Trace) -> None:
        encounters = Encounters(trace)
        boxes = encounters.boxes
        self.is_on_way, self.ahead, self.right = encounters.is_on_way, encounters.ahead, encounters.right
        self.cos, self.sin, road_cos, road_sin = trace.road.turned(boxes.cos, boxes.sin)
        speed = encounters.speed
        self.speed, self.drift = speed * self.cos, speed * self.sin
        before = slice(-1) if road_cos.shape[1] > 1 else slice(None)
        right = np.diff(encounters.y) * road_cos[:, before] - np.diff(encounters.x) * road_sin[:, before]
        self.drift[0, 1:] = right[0] * trace.physics_hz
        was_and_is = self.is_on_way[:, :-1] & self.is_on_way[:, 1:]
        np.copyto(self.drift[1:, 1:], right[1:] * trace.physics_hz, where=was_and_is)
        cos, sin = np.abs(self.cos), np.abs(self.sin)
        self.half_along = boxes.half_length * cos + boxes.half_width * sin
        self.half_across = boxes.half_length * sin + boxes.half_width * cos

    def half_lengths(self, npc: int) -> FloatArray:
        """Return half the lengths of ego and NPC along the road together at each tick [m]."""
        return np.asarray(self.half_along[0] + self.half_along[npc + 1])

    @property
    def gap_along(self) -> FloatArray:
        """The gap between the boxes of ego and NPC along the road [m]; lower is worse, 0 if they are side by side."""
        return np.maximum(np.abs(self.ahead) - self.half_along[:1] - self.half_along[1:], 0.0).T

    @property
    def gap_across(self) -> FloatArray:
        """The gap between the boxes of ego and NPC across the road [m]; lower is worse.

        It is 0 in one track, which means that the box behind would touch the box ahead if it drove straight on.
        """
        return np.maximum(np.abs(self.right) - self.half_across[:1] - self.half_across[1:], 0.0).T

    def safe_along(self, rules: RssRules) -> FloatArray:
        """Return the longitudinal distance that RSS requires of the follower [m]; see :meth:`RssRules.safe_along`.

        A smaller :attr:`gap_along` is not safe.
        """
        ego_follows = self.ahead >= 0
        follower = np.where(ego_follows, self.speed[:1], self.speed[1:])
        leader = np.where(ego_follows, self.speed[1:], self.speed[:1])
        response = np.where(ego_follows, rules.ego_response, rules.npc_response)
        return rules.safe_along(follower, leader, response).T

    def safe_across(self, rules: RssRules) -> FloatArray:
        """Return the lateral distance that RSS requires between ego and NPC [m]; a smaller gap is not safe.

        RSS assumes that both vehicles accelerate towards each other for their response times, and then brake with
        ``rules.lateral_braking`` until they no longer move sideways. The distance is ``rules.fluctuation`` plus the
        metres by which the vehicles come closer until then, if they do. A vehicle that still moves away from the other
        vehicle after its response time increases the gap while it brakes, so its stopping distance is subtracted. In
        the published formula, which assumes vehicles that come closer, every stopping distance is added.
        """
        towards_npc = np.where(self.right >= 0, 1.0, -1.0)
        ego_way = _sideways(towards_npc * self.drift[:1], rules.ego_response, rules)
        npc_way = _sideways(-towards_npc * self.drift[1:], rules.npc_response, rules)
        return (rules.fluctuation + np.maximum(ego_way + npc_way, 0.0)).T


def _stopping(speed: FloatArray, deceleration: float) -> FloatArray:
    """Return the distance that a vehicle drives until it stands [m], with the sign of its speed."""
    return speed * np.abs(speed) / (2 * deceleration)


def _sideways(drift: FloatArray, response: float, rules: RssRules) -> FloatArray:
    """Return the largest distance that a vehicle may move towards the other until its sideways motion ends [m].

    ``drift`` is its sideways speed towards the other vehicle [m/s], and ``response`` its response time [s].
    """
    fastest = drift + response * rules.lateral_acceleration
    return (drift + fastest) / 2 * response + _stopping(fastest, rules.lateral_braking)
