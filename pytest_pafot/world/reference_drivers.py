"""Reference drivers, which show whether a careful driver in the ego's place gets through the same scenario.

They are planners in SI units that decide at every physics tick and keep their lane. They know only what they see, and
neither the NPCs' plans nor the future. Their sources:

- ``careful-human``: the competent and careful human driver of UN Regulation No. 157, annex 4, appendix 3 (01 series:
  annex 3): risk perception 0.4 s, delay 0.75 s, 0.774 g reached within 0.6 s.
- ``fuzzy-safety``: the Fuzzy Safety Model of the same regulation; Mattas et al., "Fuzzy Surrogate Safety Metrics for
  real-time assessment of rear-end collision risk", Accident Analysis and Prevention 148, 2020.
- ``idm-aeb``: Treiber, Hennecke, Helbing, "Congested traffic states in empirical observations and microscopic
  simulations", Physical Review E 62, 2000, with emergency braking at a low time to collision.

The regulation's models define reactions to danger. Without danger, the regulation only requires a distance to the
vehicle ahead (5.2.3.3). The two drivers keep it by a headway of two seconds, and brake gently as long as gentle braking
suffices.

At junctions, which none of the models covers, all three drivers give way by the same rules. They approach at a speed at
which they can stop. They wait before the zone for each vehicle that would arrive after them by less than the critical
headway of the Highway Capacity Manual (two-way stop, two-lane major road). For a vehicle that is in the way without
priority, they brake as in the regulation.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

from pytest_pafot.attribution.manoeuvres import DRIFTING, KEEPING
from pytest_pafot.attribution.responses import EMERGENCY, FOLLOWING
from pytest_pafot.attribution.sentences import BRAKES
from pytest_pafot.attribution.takeovers import STEADY_BRAKING
from pytest_pafot.model.crossings import CrossingVehicle, Kind
from pytest_pafot.world.kernel.observation import Observation, VehicleState

GRAVITY = 9.81
"""The gravitational acceleration [m/s^2]."""
DELAY = 0.75
"""The time from the perception of a risk until the brakes act (UN R157), and the fuzzy model's reaction time [s]."""
HARD_BRAKING = 0.774 * GRAVITY
"""The deceleration of hard braking (UN R157) [m/s^2]."""
BUILD_UP = 0.6
"""The time in which hard braking builds up (UN R157) [s]."""

HEADWAY = 2.0
"""The headway that a driver keeps to the vehicle ahead [s]."""
STANDSTILL_GAP = 3.0
"""The gap that a driver keeps to a standing vehicle ahead [m]."""
GENTLE_BRAKING = 4.0
"""The hardest braking that drivers call comfortable (Mattas et al. 2020) [m/s^2]."""
GENTLE_ACCELERATION = 1.5
"""The highest acceleration of a calm driver [m/s^2]."""
GAP_GAIN = 0.25
"""The braking for each metre by which the gap to the vehicle ahead is too small [1/s^2]."""
CLOSING_GAIN = 0.8
"""The braking for each m/s by which the ego is faster than the vehicle ahead [1/s]."""
SPEED_GAIN = 0.5
"""The acceleration for each m/s by which the ego is slower than desired [1/s]."""

CRITICAL: Mapping[Kind, float] = MappingProxyType({"oncoming": 4.1, "merging": 6.2, "crossing": 7.1})
"""The critical headways of a left turn from the major road, and of a right and a left turn from the minor road (Highway
Capacity Manual) [s]. The driver waits for a vehicle that would arrive within this time after the driver's own entry.
"""
LINE = 1.0
"""The distance between a waiting driver and the zone [m]."""
STOPPING = 2.0
"""The required braking at which a driver begins to stop before a zone: the comfortable braking of Treiber et al. (2000)
[m/s^2]."""
CREEPING = 2.0
"""The least speed that predictions of arrivals at a zone assume, because a slow or standing vehicle may set off [m/s].
"""
STANDING, PATIENCE = 0.3, 2.0
"""A speed [m/s] and a time [s]: a vehicle that has been slower than this speed for this time is assumed to let others
go first."""
CLEAR = 0.5
"""The least time from a vehicle's exit out of a zone to the driver's entry [s]."""

EPSILON = 1e-6
"""The tolerance of comparisons of times, so that rounding delays nothing by a tick [s]."""

LANE_GAIN, HEADING_GAIN = 0.01, 0.3
"""The steering for each metre of offset from the lane's centre [rad/m], and for each radian of angle to the lane [1].
"""


class Leader(NamedTuple):
    """A vehicle ahead of the ego. Some are made in each tick, and a named tuple is made faster than a dataclass.

    Attributes:
        gap: the distance between the two boxes along the road [m]; negative if they overlap.
        speed: the vehicle's speed along the road [m/s].
        closing: the ego's speed minus the vehicle's speed [m/s].
        braking: the vehicle's deceleration [m/s^2].
    """

    gap: float
    speed: float
    closing: float
    braking: float

    @property
    def time_to_collision(self) -> float:
        """The time to collision at constant speeds [s]; infinite if the gap does not shrink."""
        return max(self.gap, 0.0) / self.closing if self.closing > 0 else math.inf

    @property
    def is_critical(self) -> bool:
        """True if a careful driver behind this vehicle has to brake hard."""
        near = STANDSTILL_GAP + HEADWAY * (self.speed + self.closing)
        is_braking = self.braking > EMERGENCY.leader_braking and self.gap < near
        return is_braking or self.time_to_collision < EMERGENCY.time_to_contact


@dataclass(slots=True)
class ReferenceDriver(ABC):
    """The base class of all reference drivers, which keep their lane and react to the vehicles ahead.

    Attributes:
        now, step: the time of the observation, and the time since the previous observation [s].
        since: for each condition that holds now, the time at which it began to hold [s].
        lane: the lane that the driver keeps.
        wanted: the speed that the driver desires [m/s].
        acceleration: the acceleration of the last decision, from which braking builds up [m/s^2].
        own_speed, own_half: the ego's speed along the road [m/s], and half of its length along the road [m].
        speeds, brakings: the speeds along the road [m/s] and decelerations [m/s^2] of the other vehicles.
        places, drifts: the other vehicles' y [m], and their speeds to the right [m/s].
    """

    HARDEST = HARD_BRAKING
    """The hardest braking [m/s^2]."""
    JERK = HARD_BRAKING / BUILD_UP
    """The jerk with which braking builds up [m/s^3]."""

    now: float = 0.0
    step: float = 0.0
    since: dict[str, float] = field(default_factory=dict)
    lane: int = 0
    wanted: float | None = None
    acceleration: float = 0.0
    own_speed: float = 0.0
    own_half: float = 0.0
    speeds: tuple[float, ...] = ()
    brakings: tuple[float, ...] = ()
    places: tuple[float, ...] = ()
    drifts: tuple[float, ...] = ()

    def __call__(self, observation: Observation) -> tuple[float, float]:
        """Return the driver's acceleration [m/s^2] and steering [rad]."""
        ego, others = observation.ego, observation.others
        speeds, places = tuple([_along(other) for other in others]), tuple([other.y for other in others])
        self.own_speed, self.own_half = _along(ego), _half_length(ego)
        if self.wanted is None:
            self.lane, self.wanted, self.now = ego.lane, min(ego.speed, observation.speed_limit), observation.time
        self.step, self.now = observation.time - self.now, observation.time
        step = self.step
        if step > 0 and len(self.speeds) == len(speeds):
            self.brakings = tuple([(before - now) / step for before, now in zip(self.speeds, speeds, strict=True)])
            self.drifts = tuple([(now - before) / step for before, now in zip(self.places, places, strict=True)])
        else:
            self.brakings = (0.0,) * len(speeds)
            self.drifts = tuple([other.speed * math.sin(other.heading) for other in others])
        self.speeds, self.places = speeds, places
        lowest = self.acceleration - self.JERK * self.step
        wish = min(self.wish(observation), self.at_junction(observation))
        self.acceleration = max(wish, min(lowest, 0.0), -self.HARDEST)  # brakes are released at once
        steering = -LANE_GAIN * (ego.y - self.lane * observation.lane_width) - HEADING_GAIN * ego.heading
        return self.acceleration, steering

    def watch(self, observation: Observation) -> None:
        """Observe while a different driver drives the ego; adopt the ego's lane and its highest speed so far."""
        self(observation)
        self.lane = observation.ego.lane
        self.wanted = max(self.wanted or 0.0, min(observation.ego.speed, observation.speed_limit))

    def at_junction(self, observation: Observation) -> float:
        """Return the highest acceleration that vehicles on other ways allow [m/s^2]; infinite if there are none."""
        if not observation.crossing:
            return math.inf
        meeting = [other for other in observation.crossing if other.to_leave > 0 and other.ego_to_leave > 0]
        passes = [self.lets_pass(observation, other) for other in meeting]
        stops = [other.ego_distance for other, first in zip(meeting, passes, strict=True) if first]
        wishes = []
        for other, first in zip(meeting, passes, strict=True):
            is_stop_in_it = any(other.ego_distance < stop < other.ego_to_leave + LINE for stop in stops)
            wishes.append(self.before_zone(observation, other, first or is_stop_in_it))
        return min(wishes, default=math.inf)

    def before_zone(self, observation: Observation, other: CrossingVehicle, waits: bool) -> float:
        """Return the highest acceleration before the zone of one vehicle, for which the driver may wait [m/s^2]."""
        ego = observation.ego
        lets_pass = self.held(f"lets pass {other.id}", waits)
        if other.zone.kind == "merging" and other.is_inside and other.to_leave < other.ego_to_leave:
            gap = other.ego_to_leave - other.to_leave - (ego.length + other.length) / 2
            leader = Leader(gap=gap, speed=other.speed, closing=ego.speed - other.speed, braking=0.0)
            return -self.HARDEST if leader.is_critical else self.follow(ego.speed, leader)
        if lets_pass < EMERGENCY.perception + DELAY - EPSILON:
            return math.inf
        if other.ego_distance > 0 and ego.speed**2 <= 2 * self.HARDEST * other.ego_distance:
            room = other.ego_distance - LINE
            needed = ego.speed**2 / (2 * max(room, LINE / 2))  # near the line: no hard braking for a few cm
            return -max(needed, STOPPING) if needed >= STOPPING or room < LINE else math.inf
        in_the_way = other.is_inside and other.ahead > 0
        return -self.HARDEST if in_the_way else math.inf  # it can no longer stop; leaving the zone is fastest

    def lets_pass(self, observation: Observation, other: CrossingVehicle) -> bool:
        """Return whether the driver waits before a zone, for a vehicle to pass or for room beyond the zone."""
        ego = observation.ego
        enters = max(other.ego_distance, 0.0) / max(ego.speed, CREEPING)
        leaves = other.to_leave / other.speed if other.speed > STANDING else math.inf
        arrives = max(other.distance, 0.0) / max(other.speed, CREEPING)
        if self.held(f"stands {other.id}", other.speed <= STANDING) >= PATIENCE:
            arrives = math.inf
        if other.is_inside:
            return leaves + CLEAR > enters
        if other.zone.priority == "ego":
            can_stop = other.speed**2 <= 2 * GENTLE_BRAKING * other.distance
            return not can_stop and leaves + CLEAR > enters
        if self.is_queue_behind(observation, other):
            return True
        return leaves + CLEAR > enters and arrives < enters + CRITICAL[other.zone.kind]

    def is_queue_behind(self, observation: Observation, other: CrossingVehicle) -> bool:
        """Return whether a slow vehicle beyond a zone leaves too little room for the ego to clear the zone."""
        ego = observation.ego
        room = other.ego_to_leave + ego.length / 2 + STANDSTILL_GAP
        leaders = (self.ahead(observation, index) for index in range(len(observation.others)))
        return any(leader is not None and leader.speed < CREEPING and leader.gap < room for leader in leaders)

    @abstractmethod
    def wish(self, observation: Observation) -> float:
        """Return the acceleration that the driver wants now [m/s^2]."""

    def held(self, condition: str, holds: bool) -> float:
        """Return the time for which a condition has held without a break [s]; minus infinity if it does not hold."""
        if not holds:
            self.since.pop(condition, None)
            return -math.inf
        return self.now - self.since.setdefault(condition, self.now)

    def ahead(self, observation: Observation, index: int) -> Leader | None:
        """Return an observed vehicle as a leader, in whatever lane; None if its centre is not ahead of the ego's."""
        ego, other, speed = observation.ego, observation.others[index], self.speeds[index]
        if other.x <= ego.x:
            return None
        gap = other.x - ego.x - (self.own_half + _half_length(other))
        return Leader(gap, speed, self.own_speed - speed, self.brakings[index])

    def cruise(self, speed: float) -> float:
        """Return the acceleration towards the desired speed [m/s^2]."""
        missing = (self.wanted or 0.0) - speed
        return max(min(SPEED_GAIN * missing, GENTLE_ACCELERATION), -GENTLE_BRAKING)

    def follow(self, speed: float, leader: Leader) -> float:
        """Return the gentle acceleration that brings the ego to its headway behind a vehicle [m/s^2]."""
        missing = STANDSTILL_GAP + HEADWAY * speed - leader.gap
        return max(min(-GAP_GAIN * missing - CLOSING_GAIN * leader.closing, GENTLE_ACCELERATION), -GENTLE_BRAKING)


@dataclass(slots=True)
class CarefulHuman(ReferenceDriver):
    """The competent and careful human driver of UN R157, who keeps a headway of two seconds to a leader.

    Another vehicle matters once it is in the ego's way, or moves towards it with at least 0.3 m/s and has left the
    centre of its lane by more than 0.375 m. Danger is a time to collision below 2 s, or a leader that brakes harder
    than 5 m/s^2 and is nearer than a headway of two seconds and 3 m. The driver needs 0.4 s to perceive it and 0.75 s
    to brake. It then brakes with up to 0.774 g until no danger is left. Without danger, the driver needs the same times
    before it increases the gap to a new vehicle ahead; afterwards it reacts to that vehicle at once.

    The 0.75 s are also the time in which the foot moves back from the brake to the accelerator. Until then, the driver
    does not speed up. What begins to matter or to be a danger in that time is answered as soon as it is perceived, and
    so is a vehicle that becomes a danger while the driver moves the foot, or brakes gently, for it. The regulation, in
    which one vehicle comes in and the driver brakes once, says nothing about this.
    """

    brakes_from: float = math.inf
    braked: float = -math.inf

    def wish(self, observation: Observation) -> float:
        """Return the acceleration that the driver wants now [m/s^2]."""
        ego = observation.ego
        if self.acceleration <= -BRAKES:
            self.braked = self.now
        foot = self.held("foot at the brake", self.now - self.braked < DELAY - EPSILON)
        calm, is_over = self.cruise(ego.speed), True
        if foot >= 0:
            calm = min(calm, 0.0)
        for index, other in enumerate(observation.others):
            leader = self.ahead(observation, index)
            is_known = f"noticed {index}" in self.since
            if leader is not None and not matters_to(ego, other, self.drifts[index], observation.lane_width, is_known):
                leader = None
            noticed = self.held(f"noticed {index}", leader is not None)
            critical = leader is not None and leader.is_critical
            danger = self.held(f"danger {index}", critical)
            follow = 0.0 if leader is None else self.follow(ego.speed, leader)
            slowing = self.held(f"slowing {index}", follow <= -BRAKES)
            if leader is None:
                continue
            is_over &= leader.closing <= 0 and not critical
            # The rules count the step to the first tick of a danger, too, in which the leader braked already.
            if danger + self.step >= EMERGENCY.perception - EPSILON:
                # A foot that was moved for this vehicle before it became a danger is not moved again.
                is_at_brake = foot >= danger or slowing >= EMERGENCY.perception + DELAY - EPSILON
                perceived = max(self.now, self.now - danger + EMERGENCY.perception)
                self.brakes_from = min(self.brakes_from, perceived + (0.0 if is_at_brake else DELAY))
            if noticed >= EMERGENCY.perception + (DELAY if foot < noticed else 0.0) - EPSILON or noticed == self.now:
                calm = min(calm, follow)
            elif noticed >= EMERGENCY.perception - EPSILON and follow < 0:
                calm = min(calm, 0.0)  # the foot has left the accelerator, but is not yet on the brake
        if is_over and self.brakes_from <= self.now:
            self.brakes_from = math.inf
        if self.brakes_from < math.inf:
            calm = min(calm, 0.0)
        return -HARD_BRAKING if self.brakes_from <= self.now + EPSILON else calm


@dataclass(slots=True)
class FuzzySafety(ReferenceDriver):
    """The Fuzzy Safety Model, which brakes early and comfortably if danger may arise, and harder in danger.

    Two fuzzy measures from 0 to 1, proactive (PFS) and critical (CFS), determine the braking: PFS up to the comfortable
    4 m/s^2, CFS from there to 6 m/s^2. The driver reacts to leaders, and to vehicles that will move into its way before
    it has passed them. CFS assumes that a leader keeps its speed. Behind a leader that goes on braking hard, the driver
    therefore brakes with only 4 m/s^2 until little time is left, and the published model hits some of these leaders.
    """

    COMFORTABLE = 4.0
    HARDEST = 6.0
    OTHERS = 7.0
    """The hardest braking that the driver expects of other vehicles [m/s^2]."""
    MARGIN = 2.0
    """The safety margin of PFS [m]."""
    ROUNDING = 0.5
    """The safety margin of CFS [m]. The published model has no such margin and stops exactly at the other vehicle's
    bumper. In discrete time that is a contact at 0.1 m/s."""

    def wish(self, observation: Observation) -> float:
        """Return the acceleration that the driver wants now [m/s^2]."""
        ego = observation.ego
        calm, hardest = self.cruise(ego.speed), 0.0
        for index, other in enumerate(observation.others):
            leader = self.ahead(observation, index)
            if leader is not None and not self.will_be_in_the_way(ego, other, self.drifts[index], leader):
                leader = None
            needed = 0.0 if leader is None else self.braking(ego.speed, leader)
            alert = self.held(f"alert {index}", needed > 0)
            if leader is None:
                continue
            if alert >= DELAY - EPSILON:
                hardest = max(hardest, needed)
            calm = min(calm, max(self.follow(ego.speed, leader), 0.0))
        return -hardest if hardest > 0 else calm

    @staticmethod
    def will_be_in_the_way(ego: VehicleState, other: VehicleState, drift: float, leader: Leader) -> bool:
        """Return whether a vehicle is in the ego's way, or will move into it before the ego has passed."""
        apart = _apart(ego, other)
        if apart <= 0:
            return True
        sideways = drift if ego.y > other.y else -drift
        if sideways <= 0:
            return False
        passing = (leader.gap + ego.length + other.length) / leader.closing if leader.closing > 0 else math.inf
        return apart / sideways <= passing + 0.1

    def braking(self, speed: float, leader: Leader) -> float:
        """Return the deceleration that PFS and CFS require [m/s^2]."""
        critical = self.critical(speed, leader)
        if critical > 0:
            return self.COMFORTABLE + critical * (self.HARDEST - self.COMFORTABLE)
        return self.proactive(speed, leader) * self.COMFORTABLE

    def proactive(self, speed: float, leader: Leader) -> float:
        """Return PFS: 0 if gentle braking suffices behind a leader that brakes hard, 1 if even hard braking hits it."""
        others = leader.speed**2 / (2 * self.OTHERS)
        safe = speed * DELAY + speed**2 / (2 * self.COMFORTABLE) - others + self.MARGIN
        unsafe = speed * DELAY + speed**2 / (2 * self.HARDEST) - others
        return _fuzzy(leader.gap - self.MARGIN, safe, unsafe)

    def critical(self, speed: float, leader: Leader) -> float:
        """Return CFS: 0 if gentle braking avoids a leader that keeps its speed, 1 if even hard braking hits it."""
        if leader.closing <= 0:
            return 0.0
        gap = leader.gap - self.ROUNDING
        acceleration = max(self.acceleration, -self.COMFORTABLE)
        later = speed + acceleration * DELAY
        if later <= leader.speed:
            return float(gap < leader.closing**2 / (2 * abs(acceleration)))
        until = ((speed + later) / 2 - leader.speed) * DELAY
        safe = until + (later - leader.speed) ** 2 / (2 * self.COMFORTABLE)
        unsafe = until + (later - leader.speed) ** 2 / (2 * self.HARDEST)
        return _fuzzy(gap, safe, unsafe)


@dataclass(slots=True)
class IdmAeb(ReferenceDriver):
    """The Intelligent Driver Model behind vehicles in the way, with full braking at a low time to collision."""

    HEADWAY = 1.5
    """The desired headway [s]."""
    STANDSTILL_GAP = 2.0
    """The desired gap to a standing leader [m]."""
    BRAKING = 2.0
    """The comfortable braking [m/s^2]."""
    HARDEST = 0.85 * GRAVITY
    """The deceleration of emergency braking (UN R157, annex 4, appendix 3) [m/s^2]."""
    JERK = HARDEST / BUILD_UP
    TRIGGER = 1.5
    """The time to collision below which the driver brakes fully [s]."""

    braking: bool = False

    def wish(self, observation: Observation) -> float:
        """Return the acceleration that the driver wants now [m/s^2]."""
        ego = observation.ego
        leaders = [
            leader
            for index, other in enumerate(observation.others)
            if (leader := self.ahead(observation, index)) is not None
            and (_apart(ego, other) <= 0 or other.lane == self.lane)
        ]
        is_danger = any(leader.time_to_collision < self.TRIGGER for leader in leaders)
        self.braking = is_danger or (self.braking and any(leader.closing > 0 for leader in leaders))
        return -self.HARDEST if self.braking else self.idm(ego.speed, leaders)

    def idm(self, speed: float, leaders: list[Leader]) -> float:
        """Return the model's acceleration behind the leader that allows the lowest acceleration [m/s^2]."""
        free = 1 - (speed / max(self.wanted or 0.0, 0.1)) ** 4
        comfort = 2 * math.sqrt(GENTLE_ACCELERATION * self.BRAKING)
        pressing = 0.0
        for leader in leaders:
            desired = self.STANDSTILL_GAP + max(speed * self.HEADWAY + speed * leader.closing / comfort, 0.0)
            pressing = max(pressing, (desired / max(leader.gap, 0.1)) ** 2)
        return GENTLE_ACCELERATION * (free - pressing)


@dataclass(slots=True)
class SteadyBraking(ReferenceDriver):
    """A driver that brakes with 6 m/s^2 to a standstill in the ego's lane, whatever happens."""

    HARDEST = FOLLOWING.deceleration
    JERK = 1000.0
    """The jerk of braking [m/s^3], so high that the brakes act at once."""

    acceleration: float = -FOLLOWING.deceleration

    def wish(self, observation: Observation) -> float:
        """Return the acceleration that the driver wants now [m/s^2]."""
        return -min(self.HARDEST, observation.ego.speed / self.step) if self.step > 0 else -self.HARDEST

    def at_junction(self, observation: Observation) -> float:
        """Return infinity, because this driver ignores all vehicles."""
        return math.inf


REFERENCES: Mapping[str, Callable[[], ReferenceDriver]] = MappingProxyType(
    {"careful-human": CarefulHuman, "fuzzy-safety": FuzzySafety, "idm-aeb": IdmAeb}
)
"""The factories of the reference drivers by name; each can be the ADS of a search."""

TAKING_OVER: Mapping[str, Callable[[], ReferenceDriver]] = MappingProxyType(
    {**REFERENCES, STEADY_BRAKING: SteadyBraking}
)
"""The factories of the drivers that can take over during a run, by name."""


def matters_to(ego: VehicleState, other: VehicleState, drift: float, lane_width: float, is_known: bool) -> bool:
    """Return whether a vehicle is in the ego's way, or visibly leaves its lane towards the ego.

    ``drift`` is the vehicle's speed to the right [m/s]. A vehicle that has mattered before (``is_known``) still matters
    while it pauses over the lane's line.
    """
    if _apart(ego, other) <= 0:
        return True
    side = 1.0 if ego.y > other.y else -1.0
    offset = side * (other.y - other.lane * lane_width)
    if other.lane == ego.lane:  # Its centre is over the line, and its box, if it is narrow, not yet in the ego's way.
        offset += lane_width
    next_lane = abs(ego.y - other.y) < 1.5 * lane_width
    stays = is_known and offset + _half_width(other) > lane_width / 2
    return next_lane and offset > KEEPING and (stays or side * drift >= DRIFTING)


def _along(vehicle: VehicleState) -> float:
    return vehicle.speed * math.cos(vehicle.heading)


def _half_length(vehicle: VehicleState) -> float:
    return (vehicle.length * math.cos(vehicle.heading) + vehicle.width * abs(math.sin(vehicle.heading))) / 2


def _half_width(vehicle: VehicleState) -> float:
    return (vehicle.width * math.cos(vehicle.heading) + vehicle.length * abs(math.sin(vehicle.heading))) / 2


def _apart(ego: VehicleState, other: VehicleState) -> float:
    """Return the distance between the boxes across the road [m]; negative if they overlap."""
    return abs(ego.y - other.y) - _half_width(ego) - _half_width(other)


def _fuzzy(distance: float, safe: float, unsafe: float) -> float:
    """Return 1 below the unsafe distance, 0 above the safe distance, and a linear interpolation between them."""
    if distance >= safe:
        return 0.0
    return 1.0 if distance <= unsafe else (safe - distance) / (safe - unsafe)
