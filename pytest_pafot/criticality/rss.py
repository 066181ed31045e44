"""Safe distances of Responsibility-Sensitive Safety (RSS), and the gaps to compare with them.

Source: Shalev-Shwartz, Shammah, Shashua, "On a Formal Model of Safe and Scalable Self-driving Cars",
arXiv:1708.06374, 2017: safe longitudinal distance for the same direction, safe lateral distance. A pair is in
danger if both gaps are below their safe distances. On a straight road, gaps and speeds are measured along and across
the direction of the ego's lane. On other roads, they are measured along and across the ego's way, in metres that the
vehicles drive there. While an NPC that crosses is not on the ego's way, its gaps and safe distances are NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from pytest_pafot.criticality.measures import Encounters
from pytest_pafot.model.trace import FloatArray, Trace


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
