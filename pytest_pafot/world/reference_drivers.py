"""The reference driver, which shows whether a careful driver could have avoided a failure.

The driver decides at every physics tick, keeps its lane and knows only the observation. It is called ``careful-human``,
and models the competent and careful human driver of UN Regulation No. 157, annex 4, appendix 3 (01 series: annex 3).

The regulation's model only reacts to danger. In ordinary traffic, the regulation requires a following distance
(5.2.3.3), so the driver brakes gently to keep a headway of two seconds. At junctions, which the model does not cover,
the driver waits for each vehicle that would arrive after it by less than the critical headway of the Highway Capacity
Manual (two-way stop, two-lane major road).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

from pytest_pafot.attribution.responsibility import DRIFTING
from pytest_pafot.attribution.sentences import BRAKES
from pytest_pafot.attribution.takeovers import CAREFUL
from pytest_pafot.model.crossings import CrossingVehicle, Kind
from pytest_pafot.model.trace import Trace
from pytest_pafot.world.kernel.lanes import Body
from pytest_pafot.world.kernel.observation import Observation, VehicleState

# Standard gravity [m/s^2].
GRAVITY = 9.81
# The time from the perception of a risk until the brakes act (UN R157) [s].
DELAY = 0.75
# A risk must last this long to be perceived (UN R157) [s].
PERCEPTION = 0.4
# A vehicle that cuts in is a risk below this time to collision [s]. A leader is a risk above this braking [m/s^2]
# (UN R157).
TIME_TO_COLLISION = 2.0
LEADER_BRAKING = 5.0
# The largest offset from its lane's centre at which a vehicle keeps its lane. A larger offset distinguishes a cut-in
# from wandering (UN R157) [m].
KEEPING = 0.375
# The deceleration of hard braking (UN R157) [m/s^2].
HARD_BRAKING = 0.774 * GRAVITY
# The jerk with which hard braking builds up, in 0.6 s (UN R157) [m/s^3].
JERK = HARD_BRAKING / 0.6

# The time gap to the vehicle ahead [s].
HEADWAY = 2.0
# The distance to a stationary vehicle ahead [m].
STANDSTILL_GAP = 3.0
# The hardest braking that drivers call comfortable (Mattas et al., Accident Analysis and Prevention 148, 2020) [m/s^2].
GENTLE_BRAKING = 4.0
# The highest acceleration of a calm driver [m/s^2].
GENTLE_ACCELERATION = 1.5
# Braking for each metre by which the gap to the vehicle ahead is too small [1/s^2].
GAP_GAIN = 0.25
# Braking for each m/s by which the ego is faster than the vehicle ahead [1/s].
CLOSING_GAIN = 0.8
# Acceleration for each m/s by which the ego is slower than desired [1/s].
SPEED_GAIN = 0.5

# The critical headways of a left turn from the major road, and of a right and a left turn from the minor road (Highway
# Capacity Manual) [s]. The driver waits for a vehicle that would arrive within this time after the driver's own entry.
CRITICAL: Mapping[Kind, float] = MappingProxyType(
    {"oncoming": 4.1, "merging": 6.2, "crossing": 7.1}
)
# The distance between a waiting driver and the zone [m].
LINE = 1.0
# The driver starts to brake for a zone when stopping requires this braking, the comfortable braking of Treiber et al.
# (2000) [m/s^2].
STOPPING = 2.0
# Predictions of arrivals at a zone assume at least this speed, because a slow or stationary vehicle may set off [m/s].
CREEPING = 2.0
# A vehicle that has been slower than this speed [m/s] for this time [s] is assumed to let other vehicles go first.
STANDING = 0.3
PATIENCE = 2.0
# The shortest time between a vehicle's exit from a zone and the driver's entry [s].
CLEAR = 0.5

# The tolerance in comparisons of times [s]. Without it, rounding could delay a reaction by a tick.
EPSILON = 1e-6

# Steering for each metre of offset from the lane's centre [rad/m], and for each radian of angle to the lane [1].
LANE_GAIN = 0.01
HEADING_GAIN = 0.3
# Before a takeover, the driver watches for this time [s], which is long enough to notice every vehicle.
WATCHED = 6.0


class Leader(NamedTuple):
    """A vehicle ahead of the ego, to which a driver reacts."""

    # A named tuple, because several are created in each tick, and a dataclass would be slower.
    gap: float  # between the two boxes along the road [m], negative if they overlap
    speed: float  # along the road [m/s]
    closing: float  # the ego's speed minus the vehicle's speed [m/s]
    braking: float  # deceleration [m/s^2]

    @property
    def time_to_collision(self) -> float:
        """The time [s] to collision at constant speeds, or infinity if the gap does not shrink."""
        if self.closing <= 0:
            return math.inf
        return max(self.gap, 0.0) / self.closing

    @property
    def is_critical(self) -> bool:
        """True if a careful driver behind this vehicle has to brake hard."""
        near = STANDSTILL_GAP + HEADWAY * (self.speed + self.closing)
        is_braking = self.braking > LEADER_BRAKING and self.gap < near
        return is_braking or self.time_to_collision < TIME_TO_COLLISION


@dataclass(slots=True)
class CarefulHuman:
    """The competent and careful human driver of UN R157, who keeps a headway of two seconds to a leader.

    The driver needs 0.4 s to perceive a danger and another 0.75 s to start braking, and then brakes at up to 0.774 g
    until the danger is over. Without danger, the driver needs the same time to react to a new vehicle ahead.
    """

    # The time of the observation, and the time since the previous observation [s].
    now: float = 0.0
    step: float = 0.0
    # For each condition that is true now, the time at which it became true [s].
    since: dict[str, float] = field(default_factory=dict)
    # The lane that the driver keeps, and the desired speed [m/s].
    lane: int = 0
    wanted: float | None = None
    # The acceleration of the last decision, from which braking builds up [m/s^2].
    acceleration: float = 0.0
    # The ego's speed [m/s] and half its length [m] along the road.
    own_speed: float = 0.0
    own_half: float = 0.0
    # The other vehicles' speeds along the road [m/s], decelerations [m/s^2], y [m] and speeds to the right [m/s].
    speeds: tuple[float, ...] = ()
    brakings: tuple[float, ...] = ()
    places: tuple[float, ...] = ()
    drifts: tuple[float, ...] = ()
    # The time at which hard braking starts, and the last time at which the driver braked [s].
    brakes_from: float = math.inf
    braked: float = -math.inf

    def __call__(self, observation: Observation) -> tuple[float, float]:
        """Return an acceleration [m/s^2] and a steering angle [rad]."""
        ego = observation.ego
        others = observation.others
        speeds = tuple([_along(other) for other in others])
        places = tuple([other.y for other in others])
        self.own_speed = _along(ego)
        self.own_half = _half_length(ego)
        if self.wanted is None:
            self.lane = ego.lane
            self.wanted = min(ego.speed, observation.speed_limit)
            self.now = observation.time
        self.step = step = observation.time - self.now
        self.now = observation.time
        if step > 0 and len(self.speeds) == len(speeds):
            # Both come from the changes since the last observation, because vehicles do not show them.
            self.brakings = tuple(
                [(before - now) / step for before, now in zip(self.speeds, speeds, strict=True)]
            )
            self.drifts = tuple(
                [(now - before) / step for before, now in zip(self.places, places, strict=True)]
            )
        else:
            self.brakings = (0.0,) * len(speeds)
            self.drifts = tuple([other.speed * math.sin(other.heading) for other in others])
        self.speeds = speeds
        self.places = places
        lowest = self.acceleration - JERK * step
        wish = min(self.wish(observation), self.at_junction(observation))
        # brakes are released immediately
        self.acceleration = max(wish, min(lowest, 0.0), -HARD_BRAKING)
        offset = ego.y - self.lane * observation.lane_width
        return self.acceleration, -LANE_GAIN * offset - HEADING_GAIN * ego.heading

    def watch(self, observation: Observation) -> None:
        """Adopt the lane, and the highest speed so far, of the driver that currently controls the ego."""
        self(observation)
        self.lane = observation.ego.lane
        self.wanted = max(self.wanted or 0.0, min(observation.ego.speed, observation.speed_limit))

    def wish(self, observation: Observation) -> float:
        """Return the acceleration [m/s^2] that the vehicles ahead allow."""
        # The 0.75 s of the regulation are also the time in which the foot moves back from the brake to the accelerator.
        # Until then, the driver does not speed up, and reacts to a new danger as soon as it perceives it. The
        # regulation, in which one vehicle cuts in and the driver brakes once, does not cover this case.
        ego = observation.ego
        if self.acceleration <= -BRAKES:
            self.braked = self.now
        foot = self.held("foot at the brake", self.now - self.braked < DELAY - EPSILON)
        # `calm` is the acceleration without danger: the lowest one that any leader allows.
        calm = self.cruise(ego.speed)
        is_over = True
        if foot >= 0:
            calm = min(calm, 0.0)
        for index, other in enumerate(observation.others):
            leader = self.ahead(observation, index)
            is_known = f"noticed {index}" in self.since
            if leader is not None and not matters_to(
                ego, other, self.drifts[index], observation.lane_width, is_known
            ):
                leader = None
            # How long the vehicle has mattered, has been a danger, and has required gentle braking.
            critical = leader is not None and leader.is_critical
            follow = 0.0
            if leader is not None:
                follow = self.follow(ego.speed, leader)
            noticed = self.held(f"noticed {index}", leader is not None)
            danger = self.held(f"danger {index}", critical)
            slowing = self.held(f"slowing {index}", follow <= -BRAKES)
            if leader is None:
                continue
            is_over &= leader.closing <= 0 and not critical
            # The rules also count the step to the first tick of a danger, because the leader already braked in it.
            if danger + self.step >= PERCEPTION - EPSILON:
                starts = max(self.now, self.now - danger + PERCEPTION)
                # A foot that was moved for this vehicle before it became a danger is not moved again.
                if foot < danger and slowing < PERCEPTION + DELAY - EPSILON:
                    starts += DELAY
                self.brakes_from = min(self.brakes_from, starts)
            reaction = PERCEPTION
            if foot < noticed:
                reaction += DELAY
            if noticed >= reaction - EPSILON or noticed == self.now:
                calm = min(calm, follow)
            elif noticed >= PERCEPTION - EPSILON and follow < 0:
                # the foot has left the accelerator, but is not yet on the brake
                calm = min(calm, 0.0)
        # Hard braking ends when no vehicle is critical and the ego is not faster than any of its leaders.
        if is_over and self.brakes_from <= self.now:
            self.brakes_from = math.inf
        if self.brakes_from <= self.now + EPSILON:
            return -HARD_BRAKING
        if self.brakes_from < math.inf:
            calm = min(calm, 0.0)
        return calm

    def at_junction(self, observation: Observation) -> float:
        """Return the highest acceleration [m/s^2] that vehicles on other paths allow, or infinity if there are none."""
        if not observation.crossing:
            return math.inf
        # Only vehicles that the ego still has to meet.
        meeting = [
            other for other in observation.crossing if other.to_leave > 0 and other.ego_to_leave > 0
        ]
        passes = [self.lets_pass(observation, other) for other in meeting]
        stops = [other.ego_distance for other, first in zip(meeting, passes, strict=True) if first]
        wishes = []
        for other, first in zip(meeting, passes, strict=True):
            # A driver who stops for one vehicle must not stand in the zone of another.
            is_stop_in_it = any(
                other.ego_distance < stop < other.ego_to_leave + LINE for stop in stops
            )
            wishes.append(self.before_zone(observation, other, first or is_stop_in_it))
        return min(wishes, default=math.inf)

    def before_zone(self, observation: Observation, other: CrossingVehicle, waits: bool) -> float:
        """Return the highest acceleration [m/s^2] that one vehicle on another path allows."""
        ego = observation.ego
        lets_pass = self.held(f"lets pass {other.id}", waits)
        if other.zone.kind == "merging" and other.is_inside and other.to_leave < other.ego_to_leave:
            gap = other.ego_to_leave - other.to_leave - (ego.length + other.length) / 2
            leader = Leader(gap, other.speed, closing=ego.speed - other.speed, braking=0.0)
            if leader.is_critical:
                return -HARD_BRAKING
            return self.follow(ego.speed, leader)
        if lets_pass < PERCEPTION + DELAY - EPSILON:
            return math.inf
        if other.ego_distance > 0 and ego.speed**2 <= 2 * HARD_BRAKING * other.ego_distance:
            room = other.ego_distance - LINE
            # near the line: no hard braking for a few cm
            needed = ego.speed**2 / (2 * max(room, LINE / 2))
            if needed >= STOPPING or room < LINE:
                return -max(needed, STOPPING)
            return math.inf
        if other.is_inside and other.ahead > 0:  # in the way
            return -HARD_BRAKING
        # it is too late to stop, so the ego leaves the zone
        return math.inf

    def lets_pass(self, observation: Observation, other: CrossingVehicle) -> bool:
        """Return whether the driver waits before a zone until a vehicle has passed, or has left room behind it."""
        enters = max(other.ego_distance, 0.0) / max(observation.ego.speed, CREEPING)
        leaves = math.inf
        if other.speed > STANDING:
            leaves = other.to_leave / other.speed
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
        """Return whether a slow vehicle behind a zone leaves too little room for the ego to clear the zone."""
        room = other.ego_to_leave + observation.ego.length / 2 + STANDSTILL_GAP
        for index in range(len(observation.others)):
            leader = self.ahead(observation, index)
            if leader is not None and leader.speed < CREEPING and leader.gap < room:
                return True
        return False

    def held(self, condition: str, holds: bool) -> float:
        """Return how long [s] a condition has been true without interruption, or minus infinity if it is false."""
        if not holds:
            self.since.pop(condition, None)
            return -math.inf
        return self.now - self.since.setdefault(condition, self.now)

    def ahead(self, observation: Observation, index: int) -> Leader | None:
        """Return a vehicle in any lane as a leader, or None if its centre is not ahead of the ego's centre."""
        ego = observation.ego
        other = observation.others[index]
        if other.x <= ego.x:
            return None
        speed = self.speeds[index]
        gap = other.x - ego.x - (self.own_half + _half_length(other))
        return Leader(gap, speed, self.own_speed - speed, self.brakings[index])

    def cruise(self, speed: float) -> float:
        missing = (self.wanted or 0.0) - speed
        return max(min(SPEED_GAIN * missing, GENTLE_ACCELERATION), -GENTLE_BRAKING)

    def follow(self, speed: float, leader: Leader) -> float:
        missing = STANDSTILL_GAP + HEADWAY * speed - leader.gap
        wish = -GAP_GAIN * missing - CLOSING_GAIN * leader.closing
        return max(min(wish, GENTLE_ACCELERATION), -GENTLE_BRAKING)


class RecordedBody(Body):
    """The ego in a repeated run, which takes the recorded states up to a tick and then obeys its controls.

    Recorded states repeat a run of any kind of policy to the last bit. Recorded decisions would do so only for
    planners.
    """

    def __init__(self, trace: Trace, tick: int) -> None:
        super().__init__(*trace.sizes[0])
        self._rows = iter(trace.ego[1 : tick + 1].tolist())

    def step(self, dt: float) -> None:
        row = next(self._rows, None)
        if row is None:
            super().step(dt)
            return
        self.place(*row[:4])
        self.acceleration, self.steering = row[4:6]


@dataclass(slots=True)
class Relief:
    """A reference driver that takes over at ``time`` [s], and only observes for a short time before that."""

    driver: CarefulHuman
    time: float

    def __call__(self, observation: Observation) -> tuple[float, float]:
        if observation.time >= self.time:
            return self.driver(observation)
        if observation.time >= self.time - WATCHED:
            self.driver.watch(observation)
        return 0.0, 0.0


# The factories of drivers that can be the policy of a search or take over during a run, by name.
REFERENCES: Mapping[str, Callable[[], CarefulHuman]] = MappingProxyType({CAREFUL: CarefulHuman})


def matters_to(
    ego: VehicleState, other: VehicleState, drift: float, lane_width: float, is_known: bool
) -> bool:
    """Return whether a vehicle is in the ego's way, or visibly moves out of its lane towards the ego.

    ``drift`` is the vehicle's speed [m/s] to the right.
    """
    apart = abs(ego.y - other.y)
    half_width = _half_width(other)
    if apart - _half_width(ego) - half_width <= 0:  # the boxes overlap across the road
        return True
    # Otherwise, the vehicle must have left the centre of its lane and move towards the ego. If it has mattered before,
    # it still does while it pauses over the line.
    side = -1.0
    if ego.y > other.y:
        side = 1.0
    offset = side * (other.y - other.lane * lane_width)
    # Its centre is over the line, but its box, if narrow, is not yet in the ego's way.
    if other.lane == ego.lane:
        offset += lane_width
    stays = is_known and offset + half_width > lane_width / 2
    moves_in = stays or side * drift >= DRIFTING
    return apart < 1.5 * lane_width and offset > KEEPING and moves_in


def _along(vehicle: VehicleState) -> float:
    return vehicle.speed * math.cos(vehicle.heading)


def _half_length(vehicle: VehicleState) -> float:
    cos = math.cos(vehicle.heading)
    sin = abs(math.sin(vehicle.heading))
    return (vehicle.length * cos + vehicle.width * sin) / 2


def _half_width(vehicle: VehicleState) -> float:
    cos = math.cos(vehicle.heading)
    sin = abs(math.sin(vehicle.heading))
    return (vehicle.width * cos + vehicle.length * sin) / 2
