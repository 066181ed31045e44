"""When a vehicle came into another's lane, and since when it keeps it.

Across the road vehicles are where their centre is; which lane they are in says their centre, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality import RoadFrame
from pytest_pafot.model.trace import ACROSS, LANE, OFFSET, FloatArray, Trace, X, Y

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
    """Where the vehicles of a run are on the lanes; arrays of all vehicles have the shape [vehicles, ticks + 1]."""

    def __init__(self, trace: Trace, frame: RoadFrame) -> None:
        self.trace, self.frame = trace, frame

    def offset(self, vehicle: int) -> FloatArray:
        """From the centre of the lane that the vehicle's centre is in, or of the nearest one, to the right [m]."""
        return np.asarray(self._offsets[vehicle])

    @cached_property
    def _offsets(self) -> FloatArray:
        if self.trace.track is not None:
            return self.trace.track[:, :, OFFSET].T
        centres = np.array([lane.y * self._cos - lane.x * self._sin for lane in self.trace.lanes])
        offset, off = self._across - centres[self._lanes], self._lanes < 0
        if off.any():  # as on one more lane, on either side of the road
            width = self.trace.lanes[0].width
            beside = np.concatenate((centres, [centres.min() - width, centres.max() + width]))
            apart = self._across[off, None] - beside
            offset[off] = apart[np.arange(len(apart)), np.abs(apart).argmin(axis=1)]
        return np.asarray(offset)

    def over_line(self, vehicle: int, side: float, tick: int) -> bool:
        """Whether a box reaches over the line of the lane that its centre is in, on one side (1: to the right)."""
        return bool(self._over[side][vehicle, tick])

    @cached_property
    def _over(self) -> dict[float, npt.NDArray[np.bool_]]:
        """Of both sides, see :meth:`over_line`."""
        return {side: side * self._offsets + self.frame.half_across > self._half_widths for side in (1.0, -1.0)}

    def kept_since(self, vehicle: int, tick: int, end: int) -> tuple[int, int] | None:
        """From when, and by when, the vehicle has kept its lane since a tick; None if it has not up to the end.

        Near the lane's centre for a second, or between its lines for two.
        """
        part = slice(tick, end + 1)
        offset = np.abs(self._offsets[vehicle, part])
        between = offset + self.frame.half_across[vehicle, part] <= self._half_widths[vehicle, part]
        kept = []
        for holds, seconds in ((offset <= KEEPING, KEPT_SECONDS), (between, BETWEEN_SECONDS)):
            ticks = round(seconds * self.trace.physics_hz)
            begin = first_lasting(holds, ticks + 1)
            if begin is not None:
                kept.append((tick + begin, tick + begin + ticks))
        return min(kept, key=lambda each: each[1], default=None)

    def change(self, vehicle: int, other: int, side: float, onset: int) -> LaneChange | None:
        """How a vehicle came into the other's track, to one side (1: to the right), at a tick; None if it did not."""
        began = self._motion(vehicle, side, onset)
        if began is None:
            return None
        part = slice(began, onset + 1)
        over = self._over[side][vehicle, part]
        if over.any():
            moment = began + _run_start(over, int(np.flatnonzero(over)[-1]))
        elif self.trace.track is not None:  # a lane itself may lead into the other's
            line = side * (self._across - self._offsets)[other, onset] - self._half_widths[other, onset]
            beyond = side * self._across[vehicle, part] + self.frame.half_across[vehicle, part] > line
            if not beyond.any():
                return None
            moment = began + int(beyond.argmax())
        else:
            return None
        return self._made(vehicle, side, began, moment)

    def is_back(self, change: LaneChange, side: float, tick: int) -> bool:
        """Whether the vehicle has given a lane change up: its box is within the lane again from which it came."""
        lanes, over = self._lanes[change.vehicle], self._over[side][change.vehicle]
        return bool(over[change.tick] and not over[tick] and lanes[tick] == lanes[change.tick] and lanes[tick] >= 0)

    def moved_in_behind(self, npc: int, side: float, first: int, last: int) -> LaneChange | None:
        """How an NPC came over, behind the ego, into the ego's lane, while their tracks overlapped already."""
        return self._crossing_after(npc + 1, 0, side, first, last, is_ahead=False)

    def moved_over(self, npc: int, first: int, last: int) -> LaneChange | None:
        """How the one of ego and NPC that is ahead came over into the lane that the other was already in.

        The one behind had left the lane that they shared, so that their tracks overlapped all the time. None where
        nothing of the kind happened between the ticks.
        """
        pairs = product(((0, npc + 1), (npc + 1, 0)), (1.0, -1.0))
        crossings = (self._crossing_after(*pair, side, first, last) for pair, side in pairs)
        return max((each for each in crossings if each is not None), key=lambda each: each.tick, default=None)

    def _crossing_after(
        self, mover: int, other: int, side: float, first: int, last: int, *, is_ahead: bool = True
    ) -> LaneChange | None:
        """The last time that the mover, ahead or behind, came over its lane line on a side where the other was."""
        over = self._over[side][mover, first : last + 1]
        crosses = over[1:] > over[:-1]
        if not crosses.any():
            return None
        crosses &= side * self.frame.drift[mover, first + 1 : last + 1] >= DRIFTING
        for before in (first + np.flatnonzero(crosses)[::-1]).tolist():
            ego_leads = self.frame.ahead[max(mover, other) - 1, before] < 0
            centres = (self._across[each, before] - self._offsets[each, before] for each in (mover, other))
            lanes_apart = np.round(side * -np.subtract(*centres) / (2 * self._half_widths[mover, before]))
            are_in_lanes = self._lanes[[mover, other], before].min() >= 0
            if ego_leads == ((mover == 0) == is_ahead) and lanes_apart == 1 and are_in_lanes:
                return self._made(mover, side, first, before + 1)
        return None

    def _made(self, vehicle: int, side: float, began: int, moment: int) -> LaneChange:
        """A lane change at a moment, and since when it could be seen, at the earliest when it began."""
        left = side * self._offsets[vehicle, began : moment + 1] > KEEPING
        seen = began + _run_start(left, moment - began) if left[-1] else moment
        drift = side * float(self.frame.drift[vehicle, moment])
        return LaneChange(vehicle=vehicle, seen=seen, tick=moment, drift=drift)

    def _motion(self, vehicle: int, side: float, onset: int) -> int | None:
        """First tick of the sideways motion that lasts until a tick, or ended just before it."""
        pause = PAUSE * self.trace.physics_hz
        moving = np.flatnonzero(side * self.frame.drift[vehicle, : onset + 1] >= DRIFTING)
        if not moving.size or onset - moving[-1] >= pause:
            return None
        breaks = np.flatnonzero(np.diff(moving) - 1 >= pause)
        return int(moving[breaks[-1] + 1] if breaks.size else moving[0])

    @cached_property
    def _across(self) -> FloatArray:
        if self.trace.track is not None:
            return self.trace.track[:, :, ACROSS].T
        x, y = (np.ascontiguousarray(self.trace.states[:, :, column].T) for column in (X, Y))
        return np.asarray(y * self._cos - x * self._sin)

    @cached_property
    def _lanes(self) -> npt.NDArray[np.intp]:
        return self.trace.states[:, :, LANE].T.astype(np.intp, order="C")

    @cached_property
    def _half_widths(self) -> FloatArray:
        """Of the lane that the vehicle is in, or of the first one off the road [m]."""
        widths = np.array([lane.width for lane in self.trace.lanes])
        return np.asarray(widths[np.maximum(self._lanes, 0)] / 2)

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
