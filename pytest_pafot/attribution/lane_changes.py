"""When a vehicle came into another's lane, and since when it keeps it.

Across the road vehicles are where their centre is; which lane they are in says their centre, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality import RoadFrame
from pytest_pafot.trace import ACROSS, LANE, OFFSET, FloatArray, Trace, X, Y

DRIFTING = 0.3
"""Sideways speed towards the other, below which a vehicle keeps its place in the lane [m/s]."""
PAUSE = 0.5
"""A sideways motion that goes on after less than that is one [s]."""
KEEPING = 0.375
"""A vehicle keeps its lane within this offset to its centre; beyond, a cut-in can be told from wandering (UN R157,
annex 4, appendix 3) [m]."""
KEPT_SECONDS = 1.0
"""For so long, and the lane is the vehicle's [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneChange:
    """One continuous sideways motion of a vehicle (0: the ego) into another's track.

    Attributes:
        vehicle: which.
        began: first tick of the motion.
        tick: the moment: the first at which its box was over the last lane line that it crossed on its way.
        drift: sideways speed at the moment [m/s].
    """

    vehicle: int
    began: int
    tick: int
    drift: float


class LanePlaces:
    """Where the vehicles of a run are on the lanes, by vehicle; arrays of shape [ticks + 1]."""

    def __init__(self, trace: Trace, frame: RoadFrame) -> None:
        self.trace, self.frame = trace, frame

    def offset(self, vehicle: int) -> FloatArray:
        """From the centre of the lane that the vehicle's centre is in, or of the nearest one, to the right [m]."""
        if self.trace.track is not None:
            return self.trace.track_of(vehicle)[:, OFFSET]
        across = self._across(vehicle)
        centres = np.array([lane.y * self._cos - lane.x * self._sin for lane in self.trace.lanes])
        lane = self.trace.states[:, vehicle, LANE].astype(np.intp)
        off = np.flatnonzero(lane < 0)
        lane[off] = np.abs(across[off, None] - centres).argmin(axis=1)
        return np.asarray(across - centres[lane])

    def over_line(self, vehicle: int, side: float, tick: int) -> bool:
        """Whether a box reaches over the line of the lane that its centre is in, on one side (1: to the right)."""
        edge = side * self.offset(vehicle)[tick] + self.frame.half_across[vehicle, tick]
        return bool(edge > self._half_widths(vehicle)[tick])

    def kept_since(self, vehicle: int, tick: int, end: int) -> int | None:
        """The first tick by which the vehicle has kept its lane for a second since a tick; None if it never has."""
        keeps = np.abs(self.offset(vehicle)[tick : end + 1]) <= KEEPING
        lasting = first_lasting(keeps, round(KEPT_SECONDS * self.trace.physics_hz) + 1)
        return None if lasting is None else tick + lasting + round(KEPT_SECONDS * self.trace.physics_hz)

    def change(self, vehicle: int, other: int, side: float, onset: int) -> LaneChange | None:
        """How a vehicle came into the other's track, to one side (1: to the right), at a tick; None if it did not."""
        began = self._motion(vehicle, side, onset)
        if began is None:
            return None
        edge = (side * self._across(vehicle) + self.frame.half_across[vehicle])[: onset + 1]
        line = self._line_crossed(vehicle, side, max(began - 1, 0), onset)
        if line is None:
            if self.trace.track is None:
                return None
            # On a road that bends or joins another, a lane itself may lead into the other's.
            line = float((side * self._centre(other) - self._half_widths(other))[onset])
        beyond = np.flatnonzero(edge[began:] > line)
        moment = began + int(beyond[0]) if beyond.size else onset
        drift = side * float(self.frame.drift[vehicle, moment])
        return LaneChange(vehicle=vehicle, began=began, tick=moment, drift=drift)

    def _motion(self, vehicle: int, side: float, onset: int) -> int | None:
        """First tick of the sideways motion that lasts until a tick, or ended just before it."""
        moving = np.flatnonzero(side * self.frame.drift[vehicle, : onset + 1] >= DRIFTING)
        pause = PAUSE * self.trace.physics_hz
        if not moving.size or onset - moving[-1] >= pause:
            return None
        breaks = np.flatnonzero(np.diff(moving) - 1 >= pause)
        return int(moving[breaks[-1] + 1] if breaks.size else moving[0])

    def _line_crossed(self, vehicle: int, side: float, before: int, onset: int) -> float | None:
        """The last lane line that the box is over, in metres to the side; None where it is still in its lane."""
        centre, half = side * self._centre(vehicle), self._half_widths(vehicle)
        is_over = self.over_line(vehicle, side, onset)
        line = float(centre[onset] + (half[onset] if is_over else -half[onset]))
        return None if line < centre[before] + half[before] / 2 else line

    def _across(self, vehicle: int) -> FloatArray:
        if self.trace.track is not None:
            return self.trace.track_of(vehicle)[:, ACROSS]
        states = self.trace.states[:, vehicle]
        return np.asarray(states[:, Y] * self._cos - states[:, X] * self._sin)

    def _centre(self, vehicle: int) -> FloatArray:
        """Of the lane that the vehicle is in, across the road [m]."""
        return self._across(vehicle) - self.offset(vehicle)

    def _half_widths(self, vehicle: int) -> FloatArray:
        """Of the lane that the vehicle is in, or of the first one off the road [m]."""
        widths = np.array([lane.width for lane in self.trace.lanes])
        return widths[np.maximum(self.trace.states[:, vehicle, LANE].astype(np.intp), 0)] / 2

    @property
    def _cos(self) -> float:
        return float(np.cos(self.trace.lanes[0].heading))

    @property
    def _sin(self) -> float:
        return float(np.sin(self.trace.lanes[0].heading))


def first_lasting(holds: npt.NDArray[np.bool_], ticks: int) -> int | None:
    """Where a condition first begins to hold for so many ticks; None if it never does."""
    count = np.concatenate(([0], np.cumsum(holds)))
    lasting = np.flatnonzero(count[ticks:] - count[:-ticks] == ticks)
    return int(lasting[0]) if lasting.size else None
