# cython: boundscheck=False, initializedcheck=False, wraparound=False, cdivision=True, auto_pickle=False
# No index is beyond the shapes that the constructor checks, and nothing is divided by zero.
"""One pass over the ticks of a run that finds out whether NPCs came near the ego: plain Python that can be compiled.

The results equal those of the numpy code in :mod:`pytest_pafot.searching.evaluation`, because both do the same
operations in the same order.
"""

from __future__ import annotations

import math

from pytest_pafot.model.trace import FloatArray


class InteractionSweep:
    """One pass over the states of a trace, shape [ticks + 1, vehicles, 7], with its sizes, shape [vehicles, 2].

    An NPC in the ego's lane interacts if it is within ``headway`` [s] or ``gap`` [m]. NPCs more than ``far`` [m] behind
    the ego count as left behind.
    """

    interacted: bool  # whether a follower in the same lane was ever nearer than the headway or the gap
    alone: int  # ticks at which all NPCs were farther behind than far

    def __init__(self, states: FloatArray, sizes: FloatArray, headway: float, gap: float, far: float) -> None:
        if states.ndim != 3 or states.shape[2] != 7 or sizes.shape != (states.shape[1], 2):
            raise ValueError(
                f"states, sizes: expected the shapes [ticks + 1, vehicles, 7] and [vehicles, 2], received "
                f"{states.shape} and {sizes.shape}; give those of a trace"
            )
        self.interacted = False
        self.alone = 0
        self._states = states
        self._sizes = sizes
        self._headway = headway
        self._gap = gap
        self._far = far
        self._look(states.shape[0], states.shape[1])

    def _look(self, ticks: int, vehicles: int) -> None:
        for tick in range(ticks):
            cos, sin = math.cos(self._states[tick, 0, 2]), math.sin(self._states[tick, 0, 2])
            behind = 0
            for vehicle in range(1, vehicles):
                offset_x = self._states[tick, vehicle, 0] - self._states[tick, 0, 0]
                offset_y = self._states[tick, vehicle, 1] - self._states[tick, 0, 1]
                ahead = offset_x * cos + offset_y * sin
                behind += ahead < -self._far
                if not self.interacted and self._states[tick, vehicle, 6] == self._states[tick, 0, 6]:
                    self.interacted = self._is_near(tick, vehicle, ahead)
            self.alone += behind == vehicles - 1

    def _is_near(self, tick: int, vehicle: int, ahead: float) -> bool:
        room = self._headway * (self._states[tick, 0, 3] if ahead >= 0.0 else self._states[tick, vehicle, 3])
        room = self._gap if room < self._gap else room
        return bool(abs(ahead) - (self._sizes[0, 0] + self._sizes[vehicle, 0]) / 2.0 < room)
