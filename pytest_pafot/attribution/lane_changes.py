"""When a vehicle came into another's lane, and since when it keeps it.

Across the road vehicles are where their centre is; which lane they are in says their centre, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

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
BETWEEN_SECONDS = 2.0
"""Likewise for one that is not so near to the centre, but between the lane's lines [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneChange:
    """One continuous sideways motion of a vehicle (0: the ego) into another's track.

    Attributes:
        vehicle: which.
        seen: the tick from which on it could be told from wandering in the lane.
        tick: the moment: from it on its box was over the last lane line that it crossed on its way.
        drift: sideways speed at the moment [m/s].
    """

    vehicle: int
    seen: int
    tick: int
    drift: float


class LanePlaces:
    """Where the vehicles of a run are on the lanes, by vehicle; arrays of shape [ticks + 1]."""

    def __init__(self, trace: Trace, frame: RoadFrame) -> None:
        self.trace, self.frame = trace, frame
        self._offsets: dict[int, FloatArray] = {}
        self._edges: dict[int, FloatArray] = {}

    def offset(self, vehicle: int) -> FloatArray:
        """From the centre of the lane that the vehicle's centre is in, or of the nearest one, to the right [m]."""
        if vehicle not in self._offsets:
            self._offsets[vehicle] = self._offset(vehicle)
        return self._offsets[vehicle]

    def _offset(self, vehicle: int) -> FloatArray:
        if self.trace.track is not None:
            return self.trace.track_of(vehicle)[:, OFFSET]
        across = self._across(vehicle)
        centres = np.array([lane.y * self._cos - lane.x * self._sin for lane in self.trace.lanes])
        lane = self.trace.states[:, vehicle, LANE].astype(np.intp)
        offset, off = across - centres[lane], lane < 0
        if off.any():  # as on one more lane, on either side of the road
            width = self.trace.lanes[0].width
            beside = np.concatenate((centres, [centres.min() - width, centres.max() + width]))
            apart = across[off, None] - beside
            offset[off] = apart[np.arange(len(apart)), np.abs(apart).argmin(axis=1)]
        return np.asarray(offset)

    def over_line(self, vehicle: int, side: float, tick: int) -> bool:
        """Whether a box reaches over the line of the lane that its centre is in, on one side (1: to the right)."""
        edge = side * self.offset(vehicle)[tick] + self.frame.half_across[vehicle, tick]
        return bool(edge > self._half_widths(vehicle)[tick])

    def kept_since(self, vehicle: int, tick: int, end: int) -> tuple[int, int] | None:
        """From when, and by when, the vehicle has kept its lane since a tick; None if it has not up to the end.

        Near the lane's centre for a second, or between its lines for two.
        """
        offset = np.abs(self.offset(vehicle))
        between = offset + self.frame.half_across[vehicle] <= self._half_widths(vehicle)
        kept = []
        for holds, seconds in ((offset <= KEEPING, KEPT_SECONDS), (between, BETWEEN_SECONDS)):
            ticks = round(seconds * self.trace.physics_hz)
            begin = first_lasting(holds[tick : end + 1], ticks + 1)
            if begin is not None:
                kept.append((tick + begin, tick + begin + ticks))
        return min(kept, key=lambda each: each[1], default=None)

    def change(self, vehicle: int, other: int, side: float, onset: int) -> LaneChange | None:
        """How a vehicle came into the other's track, to one side (1: to the right), at a tick; None if it did not."""
        began = self._motion(vehicle, side, onset)
        if began is None:
            return None
        offset, half = side * self.offset(vehicle), self.frame.half_across[vehicle]
        over = offset[began : onset + 1] + half[began : onset + 1] > self._half_widths(vehicle)[began : onset + 1]
        if over.any():
            moment = began + _run_start(over, int(np.flatnonzero(over)[-1]))
        elif self.trace.track is not None:  # a lane itself may lead into the other's
            line = (side * (self._across(other) - self.offset(other)) - self._half_widths(other))[onset]
            beyond = (side * self._across(vehicle) + half)[began : onset + 1] > line
            if not beyond.any():
                return None
            moment = began + int(beyond.argmax())
        else:
            return None
        return self._made(vehicle, side, began, moment)

    def moved_over(self, npc: int, first: int, last: int) -> LaneChange | None:
        """How the one of ego and NPC that is ahead came over into the lane that the other was already in.

        The one behind had left the lane that they shared, so that their tracks overlapped all the time. None where
        nothing of the kind happened between the ticks.
        """
        part = slice(first, last + 1)
        if not any((self._edge(each)[part] > 0).any() for each in (0, npc + 1)):
            return None
        leads = self.frame.ahead[npc, part] < 0
        pairs = product(((0, npc + 1, leads), (npc + 1, 0, ~leads)), (1.0, -1.0))
        crossings = (self._crossing_after(*pair, side, first, last) for pair, side in pairs)
        return max((each for each in crossings if each is not None), key=lambda each: each.tick, default=None)

    def _crossing_after(
        self, mover: int, other: int, is_ahead: npt.NDArray[np.bool_], side: float, first: int, last: int
    ) -> LaneChange | None:
        """The last time that the mover, ahead, came over its lane line on a side where the other already was."""
        part = slice(first, last + 1)
        lanes = self.trace.states[part, :, LANE]
        is_over = side * self.offset(mover)[part] + self.frame.half_across[mover, part] > self._half_widths(mover)[part]
        if not is_over.any():
            return None
        centres = ((self._across(each) - self.offset(each))[part] for each in (mover, other))
        beyond = np.round(side * -np.subtract(*centres) / (2 * self._half_widths(mover)[part]))
        was_there = is_ahead & (beyond == 1) & (lanes[:, [mover, other]].min(axis=1) >= 0)
        crosses = is_over[1:] & ~is_over[:-1] & was_there[:-1] & (side * self.frame.drift[mover, part][1:] >= DRIFTING)
        if not crosses.any():
            return None
        return self._made(mover, side, first, first + int(np.flatnonzero(crosses)[-1]) + 1)

    def _made(self, vehicle: int, side: float, began: int, moment: int) -> LaneChange:
        """A lane change at a moment, and since when it could be seen, at the earliest when it began."""
        left = side * self.offset(vehicle)[began : moment + 1] > KEEPING
        seen = began + _run_start(left, moment - began) if left[-1] else moment
        drift = side * float(self.frame.drift[vehicle, moment])
        return LaneChange(vehicle=vehicle, seen=seen, tick=moment, drift=drift)

    def _edge(self, vehicle: int) -> FloatArray:
        """How far the box is over the nearer line of the lane that its centre is in [m]."""
        if vehicle not in self._edges:
            edge = np.abs(self.offset(vehicle)) + self.frame.half_across[vehicle]
            self._edges[vehicle] = edge - self._half_widths(vehicle)
        return self._edges[vehicle]

    def _motion(self, vehicle: int, side: float, onset: int) -> int | None:
        """First tick of the sideways motion that lasts until a tick, or ended just before it."""
        moving = np.flatnonzero(side * self.frame.drift[vehicle, : onset + 1] >= DRIFTING)
        pause = PAUSE * self.trace.physics_hz
        if not moving.size or onset - moving[-1] >= pause:
            return None
        breaks = np.flatnonzero(np.diff(moving) - 1 >= pause)
        return int(moving[breaks[-1] + 1] if breaks.size else moving[0])

    def _across(self, vehicle: int) -> FloatArray:
        if self.trace.track is not None:
            return self.trace.track_of(vehicle)[:, ACROSS]
        states = self.trace.states[:, vehicle]
        return np.asarray(states[:, Y] * self._cos - states[:, X] * self._sin)

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


def _run_start(holds: npt.NDArray[np.bool_], tick: int) -> int:
    """Where the stretch begins in which a condition holds up to a tick."""
    fails = np.flatnonzero(~holds[:tick])
    return int(fails[-1]) + 1 if fails.size else 0


def stretches(holds: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Where each unbroken stretch begins in which a condition holds, and where it has just ended, in their order."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], holds, [False])))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def first_lasting(holds: npt.NDArray[np.bool_], ticks: int) -> int | None:
    """Where a condition first begins to hold for so many ticks; None if it never does."""
    count = np.concatenate(([0], np.cumsum(holds)))
    lasting = np.flatnonzero(count[ticks:] - count[:-ticks] == ticks)
    return int(lasting[0]) if lasting.size else None
