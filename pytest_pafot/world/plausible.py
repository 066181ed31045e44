"""Checks for impossible motion, which indicates an error in a user's simulator or environment."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pytest_pafot.model.trace import vehicle_name

# The largest change in speed [m/s^2], three times the hardest braking of a car.
CHANGE = 30.0
# The distance [m] that a vehicle may move in a tick beyond what its speeds allow.
SLACK = 0.5
# An additional change in speed in a tick [m/s]. In the longest possible tick, 0.2 s, it amounts to half a metre.
SPEED_SLACK = 2.5
# A vehicle that reports more than 2 m/s for 0.5 s must move by more than 0.1 m; at 2 m/s it would move 1 m.
STILL, MOVING, SHIFT = 0.5, 2.0, 0.1


class Implausible(Exception):  # noqa: N818  (it ends a run, and is no error of the package)
    """An impossible motion of a vehicle in a user's simulator or environment.

    The run ends at the previous tick and is invalid.
    """


class Plausibility:
    """A check that a user's code moves a run's vehicles only as real vehicles can move."""

    def __init__(self, states: Sequence[Sequence[float]], dt: float) -> None:
        self._dt, self._change = dt, CHANGE * dt + SPEED_SLACK
        self._slack = SLACK + CHANGE * dt * dt / 2
        self._before = self._states = states
        self._tick = 0
        # when and where each vehicle last moved or was slow
        self._seen = [(x, y, 0) for x, y, *_ in self._states]
        # An impossible change in speed in the last tick. A user's code may stop vehicles suddenly in a collision, which
        # ends the run in that tick. So the change is an error only if there is a next tick.
        self.doubt = ""

    def check(
        self, states: Sequence[Sequence[float]], method: str, accelerations: Sequence[float] = ()
    ) -> None:
        """Check the states that the user's ``method`` has set for the next tick.

        Raises:
            Implausible: if a vehicle has moved in an impossible way.
        """
        self._tick = tick = self._tick + 1
        if self.doubt:
            raise Implausible(self.doubt)
        # Distances are measured between positions, so the bend of a lane does not matter.
        dt, seen, slack, change = self._dt, self._seen, self._slack, self._change
        for number, ((x, y, _, speed), (old_x, old_y, _, old)) in enumerate(
            zip(states, self._states, strict=True)
        ):
            moved = math.hypot(x - old_x, y - old_y)
            if not moved <= abs(old) * dt + slack:
                # It can move as far as its new speed allows, if that is no jump. It can also slide as far as in the
                # previous tick, if its speed is only the component along its heading.
                most = max(abs(old), min(abs(speed), abs(old) + change)) * dt
                x_before, y_before, *_ = self._before[number]
                if not moved <= max(most, math.hypot(old_x - x_before, old_y - y_before)) + slack:
                    what = f"moved {moved:.1f} m in a tick, but its stated speed allows only {most:.1f} m"
                    raise Implausible(f"{method}, tick {tick}: {vehicle_name(number)} {what}")
            # A user's controller may request more than a vehicle can do. Then `accelerations` [m/s^2] explain the
            # change.
            is_jump = not -change <= speed - old <= change and not self.doubt
            if is_jump and (
                not accelerations or abs(old + accelerations[number] * dt - speed) > 1e-6
            ):
                what = f"changed its stated speed from {old:.1f} to {speed:.1f} m/s in a tick"
                self.doubt = f"{method}, tick {tick}: {vehicle_name(number)} {what}"
            # A vehicle must not stay in one position while it reports a speed.
            at_x, at_y, since = seen[number]
            if moved > SHIFT or abs(speed) <= MOVING or math.hypot(x - at_x, y - at_y) > SHIFT:
                seen[number] = x, y, tick
            elif (tick - since) * dt >= STILL - 1e-9:
                what = f"did not move for {(tick - since) * dt:.1f} s at a stated speed of {speed:.1f} m/s"
                raise Implausible(f"{method}, tick {tick}: {vehicle_name(number)} {what}")
        self._before, self._states = self._states, states
