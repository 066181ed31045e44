"""What no vehicle does, which tells a fault of a user's simulator or environment from driving."""

from __future__ import annotations

import math
from collections.abc import Sequence

CHANGE = 30.0
"""The largest change of a speed [m/s^2], three times that of the hardest braking."""
SLACK = 0.5
"""The distance by which a vehicle may move further in a tick than its speeds allow [m]."""
SPEED_SLACK = 2.5
"""How much more a stated speed may change in a tick [m/s]; half a metre in the longest tick that a world has, 0.2 s."""
STILL, MOVING, SHIFT = 0.5, 2.0, 0.1
"""A vehicle that states more than 2 m/s all the time moves more than 0.1 m in 0.5 s; at 2 m/s it would move 1 m."""


class Implausible(Exception):  # noqa: N818  (it ends a run, and is no error of the package)
    """What a vehicle of a user's simulator or environment did in a run, with the method and the tick.

    The run ends with the tick before, is invalid, and says nothing about the ego.
    """


class Plausibility:
    """The vehicles of a run, whose states are checked after each tick that a user's code has moved them.

    Distances are between places, so a lane's bend does not matter. The code may let vehicles stop at once in a
    collision, which ends the run in that tick. So a speed that jumps is only a ``doubt`` until the next tick.

    Args:
        states: x, y, heading and speed of each vehicle at the start, the ego first [m, m, rad, m/s].
        dt: the length of a tick [s].

    Attributes:
        doubt: what no vehicle has done in the last tick, unless it was in a collision; empty if nothing.
    """

    def __init__(self, states: Sequence[Sequence[float]], dt: float) -> None:
        self._dt, self._change = dt, CHANGE * dt + SPEED_SLACK
        self._slack = SLACK + CHANGE * dt * dt / 2
        self._before = self._states = states
        self._tick = 0
        self._seen = [(x, y, 0) for x, y, *_ in self._states]  # where each vehicle was when it last moved or stood
        self.doubt = ""

    def check(self, states: Sequence[Sequence[float]], method: str, accelerations: Sequence[float] = ()) -> None:
        """Check the states after the next tick, for which ``method`` of the user's is responsible.

        ``accelerations`` are those that led there [m/s^2], if they are known: a controller of the user's that asks for
        more than any vehicle can do is no fault of the states.

        Raises:
            Implausible: for the first vehicle that does what no vehicle does.
        """
        self._tick = tick = self._tick + 1
        if self.doubt:
            raise Implausible(self.doubt)
        dt, seen, slack, change = self._dt, self._seen, self._slack, self._change
        for number, ((x, y, _, speed), (old_x, old_y, _, old)) in enumerate(zip(states, self._states, strict=True)):
            moved = math.hypot(x - old_x, y - old_y)
            if not moved <= abs(old) * dt + slack:
                # It may move by the new speed, if that is no jump, or slide on as before, if speeds are along headings.
                most = max(abs(old), min(abs(speed), abs(old) + change)) * dt
                x_before, y_before, *_ = self._before[number]
                if not moved <= max(most, math.hypot(old_x - x_before, old_y - y_before)) + slack:
                    what = f"moved {moved:.1f} m in a tick, in which it drives {most:.1f} m at its stated speed"
                    raise Implausible(f"{method}, tick {tick}: {named(number)} {what}")
            is_jump = not -change <= speed - old <= change and not self.doubt
            if is_jump and (not accelerations or abs(old + accelerations[number] * dt - speed) > 1e-6):
                what = f"had a stated speed of {old:.1f} m/s, and a tick later of {speed:.1f} m/s"
                self.doubt = f"{method}, tick {tick}: {named(number)} {what}"
            at_x, at_y, since = seen[number]
            if moved > SHIFT or abs(speed) <= MOVING or math.hypot(x - at_x, y - at_y) > SHIFT:
                seen[number] = x, y, tick
            elif (tick - since) * dt >= STILL - 1e-9:
                what = f"stood still for {(tick - since) * dt:.1f} s at a stated speed of {speed:.1f} m/s"
                raise Implausible(f"{method}, tick {tick}: {named(number)} {what}")
        self._before, self._states = self._states, states


def named(number: int) -> str:
    """Return the name of a vehicle in messages, whose number counts from the ego."""
    return "the ego" if number == 0 else f"NPC {number - 1}"
