"""The Fuzzy Safety Model of UN R157, an oracle for verdicts on the collisions of a driver that brakes too gently.

Source: Mattas et al., "Fuzzy Surrogate Safety Metrics for real-time assessment of rear-end collision risk", Accident
Analysis and Prevention 148, 2020.
"""

import math
from dataclasses import dataclass

from pytest_pafot.world import Observation, VehicleState
from pytest_pafot.world.reference_drivers import DELAY, EPSILON, Leader, ReferenceDriver, _apart


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


def _fuzzy(distance: float, safe: float, unsafe: float) -> float:
    """Return 1 below the unsafe distance, 0 above the safe distance, and a linear interpolation between them."""
    if distance >= safe:
        return 0.0
    return 1.0 if distance <= unsafe else (safe - distance) / (safe - unsafe)
