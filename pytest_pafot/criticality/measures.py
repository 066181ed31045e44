"""The geometry of a run, its criticality measures, and the safe distances of RSS."""

# Sources, unless another is named: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 2.1 for the grid, and
# section 3.3, equations 1 to 5, for the measures. Vehicle 1 of the equations is the ego, vehicle 2 an NPC.

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from itertools import product

import numpy as np

from pytest_pafot.criticality import sweep
from pytest_pafot.model.trace import (
    ACCELERATION,
    HEADING,
    LANE,
    SPEED,
    BoolArray,
    FloatArray,
    Trace,
)

# Added to relative velocities to avoid divisions by zero [m/s]. It is too small to change other velocities, and
# divisions by it do not overflow.
_TINY = 1e-290

# One array per axis. A single stacked array would be so large that the allocator returns it to the system each time,
# and faulting its pages in again takes several times as long as the arithmetic.
FourAxes = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class Boxes:
    """Rectangles that move without turning."""

    x: FloatArray  # centres [m]
    y: FloatArray
    cos: FloatArray  # of the headings, which point along the length
    sin: FloatArray
    vx: FloatArray  # velocities [m/s]
    vy: FloatArray
    half_length: FloatArray  # [m]
    half_width: FloatArray

    @classmethod
    def driving(
        cls,
        x: FloatArray,
        y: FloatArray,
        heading: FloatArray,
        speed: FloatArray,
        length: FloatArray,
        width: FloatArray,
    ) -> Boxes:
        cos = np.cos(heading)
        sin = np.sin(heading)
        return cls(
            x=x,
            y=y,
            cos=cos,
            sin=sin,
            vx=speed * cos,  # a negative speed moves backwards
            vy=speed * sin,
            half_length=length / 2,
            half_width=width / 2,
        )

    def part(self, vehicles: slice, ticks: slice) -> Boxes:
        # These boxes have the shape [vehicles, ticks].
        moving = {
            name: getattr(self, name)[vehicles, ticks]
            for name in ("x", "y", "cos", "sin", "vx", "vy")
        }
        length = self.half_length[vehicles]
        width = self.half_width[vehicles]
        return Boxes(**moving, half_length=length, half_width=width)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pairs:
    """Pairs of boxes, projected onto the four axes that can separate them."""

    a: Boxes
    b: Boxes
    # The axes are a's length, a's width, b's length and b's width. The boxes overlap along an axis if the offset of
    # their centres is at most the reach, which is half of both extents together [m].
    offsets: FourAxes
    reaches: FourAxes
    cos: FloatArray  # of b's heading relative to a's
    sin: FloatArray


def relate(a: Boxes, b: Boxes) -> Pairs:
    """Project each pair (a, b) of boxes onto the four axes of the boxes."""
    cos = a.cos * b.cos + a.sin * b.sin
    sin = a.cos * b.sin - a.sin * b.cos
    c = np.abs(cos)
    s = np.abs(sin)
    reaches = (
        a.half_length + b.half_length * c + b.half_width * s,
        a.half_width + b.half_length * s + b.half_width * c,
        b.half_length + a.half_length * c + a.half_width * s,
        b.half_width + a.half_length * s + a.half_width * c,
    )
    offsets = _along_axes(a, b, b.x - a.x, b.y - a.y)
    return Pairs(a=a, b=b, offsets=offsets, reaches=reaches, cos=cos, sin=sin)


def overlaps(pairs: Pairs) -> BoolArray:
    """Return whether the two boxes of each pair overlap."""
    result = np.ones(pairs.cos.shape, dtype=np.bool_)
    for offset, reach in zip(pairs.offsets, pairs.reaches, strict=True):
        result &= np.abs(offset) <= reach
    return result


def depth(pairs: Pairs) -> FloatArray:
    """Return the smallest overlap [m] on any axis, negative if the boxes are apart."""
    pairs_of_axes = zip(pairs.offsets, pairs.reaches, strict=True)
    spare = [reach - np.abs(offset) for offset, reach in pairs_of_axes]
    result: FloatArray = np.min(spare, axis=0)
    return result


def box_gap(pairs: Pairs) -> FloatArray:
    """Return the distance [m] between the boxes, or 0 if they overlap."""
    a = pairs.a
    b = pairs.b
    # The smallest distance between two separate rectangles is always at a corner of one of them.
    along, across, back_along, back_across = pairs.offsets
    from_b = _corners_to_box(along, across, pairs.cos, pairs.sin, a, b)
    # As seen from b, the offset has the opposite sign. That mirrors the set of a's corners in b's centre, which does
    # not change their distances from b's box, so the sign can stay.
    from_a = _corners_to_box(back_along, back_across, pairs.cos, -pairs.sin, b, a)
    apart = np.sqrt(np.minimum(from_a, from_b))
    return np.where(overlaps(pairs), 0.0, apart)


def contact_time(pairs: Pairs) -> FloatArray:
    """Return the time [s] until the boxes touch at their present velocities, or inf."""
    # Along each axis, the projections overlap during one interval of time. Contact starts when the last of these four
    # intervals starts, unless one of them has ended by then.
    a = pairs.a
    b = pairs.b
    velocities = _along_axes(a, b, b.vx - a.vx, b.vy - a.vy)
    begins: FloatArray = np.full(pairs.cos.shape, -np.inf)
    ends: FloatArray = np.full(pairs.cos.shape, np.inf)
    for offset, reach, velocity in zip(pairs.offsets, pairs.reaches, velocities, strict=True):
        distance = np.abs(offset)
        parting = np.copysign(1.0, offset) * velocity + _TINY
        near = (reach - distance) / parting
        far = -(reach + distance) / parting
        begins = np.maximum(begins, np.minimum(near, far))
        ends = np.minimum(ends, np.maximum(near, far))
    # This order makes NaN fail the comparisons, so the result is NaN.
    never = (begins > ends) | (ends < 0)
    return np.where(never, np.inf, np.maximum(begins, 0.0))


def _along_axes(a: Boxes, b: Boxes, x: FloatArray, y: FloatArray) -> FourAxes:
    # The components of the vector (x, y) along the lengths and widths of a and b.
    return (
        x * a.cos + y * a.sin,
        y * a.cos - x * a.sin,
        x * b.cos + y * b.sin,
        y * b.cos - x * b.sin,
    )


def _corners_to_box(
    u: FloatArray,
    v: FloatArray,
    cos: FloatArray,
    sin: FloatArray,
    box: Boxes,
    other: Boxes,
) -> FloatArray:
    # The result is the squared distance from the nearest corner of `other` to `box` [m^2].
    # (u, v) is the centre of `other`, and cos and sin belong to its heading. Both are in the frame of `box`.
    length_u = other.half_length * cos
    length_v = other.half_length * sin
    width_u = -other.half_width * sin
    width_v = other.half_width * cos
    nearest: FloatArray = np.full(u.shape, np.inf)
    for move, side in product((np.add, np.subtract), repeat=2):
        corner_u = side(move(u, length_u), width_u)
        corner_v = side(move(v, length_v), width_v)
        outside_u = np.maximum(np.abs(corner_u) - box.half_length, 0.0)
        outside_v = np.maximum(np.abs(corner_v) - box.half_width, 0.0)
        nearest = np.minimum(nearest, outside_u * outside_u + outside_v * outside_v)
    return nearest


# The time to manoeuvre t of equation 5 [s] (section 3.3: 2 to 6 s in the literature, 3 s adopted).
MANOEUVRE_SECONDS = 3.0

# True if one compiled pass over a run computes the extremes. Otherwise, numpy's arrays compute the same values.
_SWEEPS = sweep.is_in_use()

# Two headings count as parallel if the sine of the angle between them is below this [1]. Such lines cross far away from
# any road, or only because of rounding.
_PARALLEL = 1e-9


class Encounters:
    """The geometry of one run, which the measures share. Arrays have the shape [NPCs, ticks + 1]."""

    def __init__(self, trace: Trace) -> None:
        # The road defines all distances. Each array is computed at its first use. Ticks are the last axis, which makes
        # numpy about three times as fast.
        self.road = trace.road
        self._sizes = trace.sizes

    @cached_property
    def speed(self) -> FloatArray:
        return self.road.column(SPEED)  # [m/s], shape [vehicles, ticks + 1]

    @cached_property
    def boxes(self) -> Boxes:
        road = self.road
        length = self._sizes[:, :1]
        width = self._sizes[:, 1:]
        return Boxes.driving(road.x, road.y, road.column(HEADING), self.speed, length, width)

    @cached_property
    def pairs(self) -> Pairs:
        every = slice(None)
        ego = self.boxes.part(slice(0, 1), every)
        return relate(ego, self.boxes.part(slice(1, None), every))

    @cached_property
    def same_lane(self) -> BoolArray:
        # True where the centres of the ego and an NPC are in the same lane.
        lane = self.road.column(LANE)
        is_same: BoolArray = lane[1:] == lane[:1]
        return is_same & (lane[:1] >= 0) & self.road.is_on_way

    @cached_property
    def ego_follows(self) -> BoolArray:
        # True where an NPC's centre is level with the ego's centre or ahead of it.
        return self.road.ahead >= 0

    def follower_minus_leader(self, values: FloatArray) -> FloatArray:
        # The result is NaN off the ego's path.
        ego_minus_npc = values[:1] - values[1:]
        gain = np.where(self.ego_follows, ego_minus_npc, -ego_minus_npc)
        return np.where(self.road.is_on_way, gain, np.nan)


@lru_cache(maxsize=1)
def encounters_of(trace: Trace) -> Encounters:
    """Return the geometry of a run, which is cached."""
    return Encounters(trace)


def ettc(trace: Trace) -> FloatArray:
    """Return the paper's estimated time to collision [s] (equations 1 to 3).

    This is the time until the ego reaches the point where its line of travel crosses the NPC's, or inf if that point is
    not ahead.
    """
    # With p the positions, d the unit vectors of travel and x the cross product, the ego's distance to the crossing
    # point is (p2 - p1) x d2 / d1 x d2. This equals the paper's expression where its tangents and cotangents exist, and
    # is also defined for headings along the axes. As in the paper, it does not matter when the NPC reaches the point. A
    # vehicle that drives backwards travels against its heading.
    pairs = encounters_of(trace).pairs
    speed = encounters_of(trace).speed
    way = np.where(speed < 0, -1.0, 1.0)
    # In the ego's frame, (p2 - p1) x d2 is minus the offset across the NPC's heading, and d1 x d2 is the sine of the
    # difference between the headings. The same applies if the roles are swapped. Parallel lines are divided by 1 and
    # ignored.
    parallel = np.abs(pairs.sin) < _PARALLEL
    sine = np.where(parallel, 1.0, pairs.sin)
    ego_way = -way[:1] * pairs.offsets[3] / sine
    npc_way = -way[1:] * pairs.offsets[1] / sine
    standing = speed[:1] == 0
    none = parallel | (ego_way < 0) | (npc_way < 0) | standing
    ego_speed = np.where(standing, 1.0, np.abs(speed[:1]))
    with np.errstate(over="ignore"):  # at the smallest speeds the time is infinite
        return np.where(none, np.inf, ego_way / ego_speed).T


def mettc(trace: Trace) -> float:
    """Return the paper's METTC [s], the smallest :func:`ettc` of the run."""
    return _lowest(ettc(trace))


def ttc(trace: Trace) -> FloatArray:
    """Return the time [s] until the boxes touch at constant velocity and heading, or inf."""
    # Source: Hayward, "Near-miss determination through use of a scale of danger", 1972; here for oriented boxes.
    return contact_time(encounters_of(trace).pairs).T


def min_ttc(trace: Trace) -> float:
    """Return the smallest :func:`ttc` [s] of the run."""
    swept = _swept(trace)
    if swept is None:
        return _lowest(ttc(trace))
    return swept[0]


def centre_distance(trace: Trace) -> FloatArray:
    """Return the distance [m] between the centres of the ego and each NPC (equation 4)."""
    # The offsets along and across the ego's heading give the same distance and are already computed.
    along, across = encounters_of(trace).pairs.offsets[:2]
    return np.sqrt(along * along + across * across).T


def min_centre_distance(trace: Trace) -> float:
    """Return the paper's MD [m], the smallest :func:`centre_distance` of the run."""
    return _lowest(centre_distance(trace))


def gap(trace: Trace) -> FloatArray:
    """Return the distance [m] between the boxes of the ego and each NPC."""
    return box_gap(encounters_of(trace).pairs).T


def min_gap(trace: Trace) -> float:
    """Return the smallest :func:`gap` [m] of the run."""
    swept = _swept(trace)
    if swept is None:
        return _lowest(gap(trace))
    return swept[1]


def safety_distance(trace: Trace) -> FloatArray:
    """Return the paper's SD [m], the distance that the follower gains on the leader in 3 s (equation 5).

    The follower must keep at least this distance.
    """
    # (v1 - v2) t + (a1 - a2) t^2 / 2 with vehicle 1 the follower and 2 the leader.
    encounters = encounters_of(trace)
    t = MANOEUVRE_SECONDS
    gain = encounters.follower_minus_leader(encounters.speed)
    pull = encounters.follower_minus_leader(encounters.road.column(ACCELERATION))
    return (gain * t + pull * (t * t / 2)).T


def min_safety_distance(trace: Trace) -> float:
    """Return the smallest :func:`safety_distance` [m] of the run, which the paper's fitness minimises."""
    # This rewards leaders that pull away. `max_safety_shortfall` does not.
    is_on_way = encounters_of(trace).road.is_on_way.T
    return _lowest(np.where(is_on_way, safety_distance(trace), np.inf))


def safety_shortfall(trace: Trace) -> FloatArray:
    """Return the missing fraction of the safety distance."""
    keep = safety_distance(trace)
    # Nothing is missing if the leader pulls away, or if ego and NPC are not in one lane.
    demanded = encounters_of(trace).same_lane.T & ~(keep <= 0)
    with np.errstate(over="ignore"):  # at the smallest distances nothing is missing
        ratio = np.divide(gap(trace), keep, out=np.ones_like(keep), where=demanded)
    return np.maximum(1.0 - ratio, 0.0)


def max_safety_shortfall(trace: Trace) -> float:
    """Return the largest missing fraction of the safety distance, from 0 to 1 (contact)."""
    swept = _swept(trace)
    if swept is None:
        return float(safety_shortfall(trace).max(initial=0.0))
    return swept[2]


@lru_cache(maxsize=1)
def _swept(trace: Trace) -> tuple[float, float, float] | None:
    # The three extremes are computed together and cached, because the default fitness needs all of them. The compiled
    # pass requires a road with a single direction.
    heading = trace.road.heading
    if not _SWEEPS or heading is None:
        return None
    direction = math.cos(heading), math.sin(heading)
    return sweep.extremes(trace.states, trace.sizes, direction, MANOEUVRE_SECONDS)


def hardest_brake(trace: Trace) -> float:
    """Return the ego's largest deceleration [m/s^2] in the run."""
    return max(0.0, -_lowest(trace.ego[:, ACCELERATION]))


def planned_duration(trace: Trace) -> float:
    """Return the total duration [s] of the scenario's genes, or of the run if a gene has no duration."""
    seconds = trace.scenario.seconds
    if seconds == math.inf:
        return trace.duration
    return seconds


def stretches(holds: BoolArray) -> list[tuple[int, int]]:
    """Return the intervals in which a condition is true, each as its first tick and the tick after its last."""
    padded = np.concatenate(([False], holds, [False]))
    edges = np.flatnonzero(np.diff(padded)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def last_stretch(holds: BoolArray) -> int:
    """Return the first tick of the last interval in which a condition is true."""
    fails = np.flatnonzero(~holds[:-1])
    if fails.size:
        return int(fails[-1]) + 1
    return 0


def _lowest(values: FloatArray) -> float:
    return float(values.min(initial=np.inf))


@dataclass(frozen=True, slots=True, kw_only=True)
class RssRules:
    """The parameters of RSS, with the default values of Intel's ad-rss-lib (appendix "Parameter Discussion")."""

    #: rho of the ego, the response time, in which it may still accelerate [s]
    ego_response: float = 1.0
    npc_response: float = 2.0  #: rho of the NPCs [s]
    acceleration: float = 3.5  #: a_max,accel, the hardest acceleration in the response time [m/s^2]
    #: a_min,brake, the least braking of a follower after its response time [m/s^2]
    least_braking: float = 4.0
    hardest_braking: float = 8.0  #: a_max,brake, the hardest braking of a leader [m/s^2]
    #: a_lat,max,accel, the hardest sideways acceleration towards the other vehicle in the response time [m/s^2]
    lateral_acceleration: float = 0.2
    #: a_lat,min,brake, the least sideways braking after the response time [m/s^2]
    lateral_braking: float = 0.8
    fluctuation: float = 0.1  #: mu, the lateral margin [m]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            divides = field.name in ("least_braking", "hardest_braking", "lateral_braking")
            if not math.isfinite(value) or value < 0 or (divides and value == 0):
                bound = "greater than 0" if divides else "of at least 0"
                raise ValueError(
                    f"{field.name}: expected a finite number {bound}, but received {value!r}"
                )

    def safe_along(
        self,
        follower: FloatArray,
        leader: FloatArray,
        response: float | FloatArray,
    ) -> FloatArray:
        """Return the gap [m] that RSS requires of a follower, given speeds [m/s] along the road."""
        # v rho + a rho^2 / 2 + (v + rho a)^2 / (2 a_min,brake) - v_leader^2 / (2 a_max,brake): the leader may brake as
        # hard as possible immediately. The follower may speed up for its response time rho [s], and then brakes. A
        # leader that drives against the direction of the road comes closer while it brakes, so the square of its speed
        # has the sign of the speed. The formula for oncoming traffic is not used.
        fastest = follower + response * self.acceleration
        travelled = (follower + fastest) / 2 * response + _stopping(fastest, self.least_braking)
        leaders = _stopping(leader, self.hardest_braking)
        return np.asarray(np.maximum(travelled - leaders, 0.0))


def longitudinal_gap(trace: Trace) -> FloatArray:
    """Return the gap [m] along the road between the boxes of the ego and each NPC."""
    return RoadFrame(trace).gap_along


class RoadFrame:
    """Positions, velocities and gaps along and across the road at each tick.

    While an NPC is not on the ego's path, its values are NaN.
    """

    def __init__(self, trace: Trace) -> None:
        encounters = Encounters(trace)
        road = encounters.road
        boxes = encounters.boxes
        # Whether each NPC is on the ego's path, and the offset of its centre from the ego's centre [m].
        self.is_on_way = road.is_on_way
        self.ahead = road.ahead
        self.right = road.right
        # The cosine and sine of each vehicle's angle to the road.
        self.cos, self.sin, road_cos, road_sin = road.turned(boxes.cos, boxes.sin)
        # The speeds of each vehicle along the road and to the right across it [m/s].
        self.speed = encounters.speed * self.cos
        self.drift = encounters.speed * self.sin
        # The drift is the movement since the previous tick, so slip is included. At the first tick of the run, or of
        # the vehicle on the ego's path, the heading determines it.
        if road_cos.shape[1] > 1:
            road_cos = road_cos[:, :-1]
            road_sin = road_sin[:, :-1]
        right = np.diff(road.y) * road_cos - np.diff(road.x) * road_sin
        drift = right * trace.physics_hz
        self.drift[0, 1:] = drift[0]
        was_and_is = self.is_on_way[:, :-1] & self.is_on_way[:, 1:]
        np.copyto(self.drift[1:, 1:], drift[1:], where=was_and_is)
        # Half of the extents of each box [m].
        cos = np.abs(self.cos)
        sin = np.abs(self.sin)
        self.half_along = boxes.half_length * cos + boxes.half_width * sin
        self.half_across = boxes.half_length * sin + boxes.half_width * cos

    def half_lengths(self, npc: int) -> FloatArray:
        # of ego and NPC together [m]
        return np.asarray(self.half_along[0] + self.half_along[npc + 1])

    @property
    def gap_along(self) -> FloatArray:
        """The gap [m] between the boxes along the road."""
        gap = np.abs(self.ahead) - self.half_along[:1] - self.half_along[1:]
        return np.maximum(gap, 0.0).T

    @property
    def gap_across(self) -> FloatArray:
        # At 0, the vehicle behind would hit the vehicle ahead if it drove straight on.
        gap = np.abs(self.right) - self.half_across[:1] - self.half_across[1:]
        return np.maximum(gap, 0.0).T

    def safe_along(self, rules: RssRules) -> FloatArray:
        # The smallest `gap_along` [m] that is safe according to RSS.
        ego_follows = self.ahead >= 0
        ego = self.speed[:1]
        npcs = self.speed[1:]
        follower = np.where(ego_follows, ego, npcs)
        leader = np.where(ego_follows, npcs, ego)
        response = np.where(ego_follows, rules.ego_response, rules.npc_response)
        return rules.safe_along(follower, leader, response).T

    def safe_across(self, rules: RssRules) -> FloatArray:
        # Both vehicles may accelerate towards each other for their response times, and then brake until they no longer
        # move sideways. A vehicle that still moves away after its response time increases the gap while it brakes, so
        # its stopping distance is subtracted. The published formula, which assumes vehicles that come closer, adds it.
        towards_npc = np.where(self.right >= 0, 1.0, -1.0)
        ego_drift = towards_npc * self.drift[:1]
        npc_drift = -towards_npc * self.drift[1:]
        ego_way = _sideways(ego_drift, rules.ego_response, rules)
        npc_way = _sideways(npc_drift, rules.npc_response, rules)
        return (rules.fluctuation + np.maximum(ego_way + npc_way, 0.0)).T


def _stopping(speed: FloatArray, deceleration: float) -> FloatArray:
    # the stopping distance [m], with the sign of the speed
    return speed * np.abs(speed) / (2 * deceleration)


def _sideways(drift: FloatArray, response: float, rules: RssRules) -> FloatArray:
    # The result is the largest distance towards the other vehicle until the sideways motion ends [m].
    fastest = drift + response * rules.lateral_acceleration
    return (drift + fastest) / 2 * response + _stopping(fastest, rules.lateral_braking)
