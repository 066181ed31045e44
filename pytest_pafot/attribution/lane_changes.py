"""Lane changes: when a vehicle came into the lane of another vehicle, and since when it has kept that lane.

The centre of a vehicle determines the lane that it is in.
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
"""The sideways speed from which on a vehicle moves towards a different lane [m/s]; a slower vehicle only wanders."""
PAUSE = 0.5
"""Sideways motions with a shorter pause between them count as one motion [s]."""
KEEPING = 0.375
"""The largest offset from the lane's centre at which a vehicle keeps its lane; a larger offset distinguishes a cut-in
from wandering (UN R157, annex 4, appendix 3) [m]."""
KEPT_SECONDS = 1.0
"""The time near the lane's centre after which a vehicle has kept its lane [s]."""
BETWEEN_SECONDS = 2.0
"""The time between the lane's lines after which a vehicle has kept its lane, even if it is not near the centre [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneChange:
    """One continuous sideways motion of a vehicle into the track of another vehicle.

    Attributes:
        vehicle: index of the vehicle; 0 is the ego.
        seen: tick from which on the motion could be distinguished from wandering in the lane.
        tick: moment of the lane change, the tick from which on the vehicle's box was over the last line that it
            crossed.
        drift: sideways speed at that moment [m/s].
    """

    vehicle: int
    seen: int
    tick: int
    drift: float


class LanePlaces:
    """The places of the vehicles of a run on the lanes. Arrays of all vehicles have the shape [vehicles, ticks + 1]."""

    def __init__(self, trace: Trace, frame: RoadFrame) -> None:
        self.trace, self.frame = trace, frame

    def offset(self, vehicle: int) -> FloatArray:
        """Return the offset to the right from the centre of the vehicle's lane, or of the nearest lane [m]."""
        return np.asarray(self._offsets[vehicle])

    @cached_property
    def _offsets(self) -> FloatArray:
        if self.trace.track is not None:
            return self.trace.track[:, :, OFFSET].T
        centres = np.array([lane.y * self._cos - lane.x * self._sin for lane in self.trace.lanes])
        offset, off = self._across - centres[self._lanes], self._lanes < 0
        if off.any():  # off the road: as if there were one more lane on either side
            width = self.trace.lanes[0].width
            beside = np.concatenate((centres, [centres.min() - width, centres.max() + width]))
            apart = self._across[off, None] - beside
            offset[off] = apart[np.arange(len(apart)), np.abs(apart).argmin(axis=1)]
        return np.asarray(offset)

    def over_line(self, vehicle: int, side: float, tick: int) -> bool:
        """Return whether a vehicle's box reaches over the line of its lane on one side (1: right, -1: left)."""
        return bool(self._over[side][vehicle, tick])

    @cached_property
    def _over(self) -> dict[float, npt.NDArray[np.bool_]]:
        """The values of :meth:`over_line` by side, shape [vehicles, ticks + 1]."""
        return {side: side * self._offsets + self.frame.half_across > self._half_widths for side in (1.0, -1.0)}

    def kept_since(self, vehicle: int, tick: int, end: int) -> tuple[int, int] | None:
        """Return two ticks: a vehicle keeps its lane from the first on, and has kept it for long enough at the second.

        Long enough is a second near the lane's centre, or two seconds between the lane's lines. None if that does not
        happen between the ticks ``tick`` and ``end``.
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
        """Return the lane change that put a vehicle into another's track at the tick ``onset``; None without one.

        ``side`` is 1 for a lane change to the right and -1 for one to the left.
        """
        began = self._motion(vehicle, side, onset)
        if began is None:
            return None
        part = slice(began, onset + 1)
        over = self._over[side][vehicle, part]
        if over.any():
            moment = began + _run_start(over, int(np.flatnonzero(over)[-1]))
        elif self.trace.track is not None:  # in a bend a lane itself may lead into the other's
            line = side * (self._across - self._offsets)[other, onset] - self._half_widths[other, onset]
            beyond = side * self._across[vehicle, part] + self.frame.half_across[vehicle, part] > line
            if not beyond.any():
                return None
            moment = began + int(beyond.argmax())
        else:
            return None
        return self._made(vehicle, side, began, moment)

    def is_back(self, change: LaneChange, side: float, tick: int) -> bool:
        """Return whether a vehicle has given up a lane change, so that its box is again within its former lane."""
        lanes, over = self._lanes[change.vehicle], self._over[side][change.vehicle]
        return bool(over[change.tick] and not over[tick] and lanes[tick] == lanes[change.tick] and lanes[tick] >= 0)

    def moved_in_behind(self, npc: int, side: float, first: int, last: int) -> LaneChange | None:
        """Return an NPC's lane change into the ego's lane, behind the ego, while their tracks overlapped; or None."""
        return self._crossing_after(npc + 1, 0, side, first, last, is_ahead=False)

    def moved_over(self, npc: int, first: int, last: int) -> LaneChange | None:
        """Return the lane change of the vehicle ahead, ego or NPC, into the lane of the vehicle behind; None if none.

        The vehicle behind had left their common lane first, but their tracks overlapped all the time. The lane change
        must be between the ticks ``first`` and ``last``.
        """
        pairs = product(((0, npc + 1), (npc + 1, 0)), (1.0, -1.0))
        crossings = (self._crossing_after(*pair, side, first, last) for pair, side in pairs)
        return max((each for each in crossings if each is not None), key=lambda each: each.tick, default=None)

    def _crossing_after(
        self, mover: int, other: int, side: float, first: int, last: int, *, is_ahead: bool = True
    ) -> LaneChange | None:
        """Return the last lane change in which a vehicle crossed its line towards the other vehicle's lane, or None.

        ``is_ahead`` is whether the vehicle that changes lanes must be ahead of the other vehicle or behind it.
        """
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
        """Return the record of a vehicle's lane change to a side, 1 for right and -1 for left.

        The sideways motion began at the tick ``began``; the lane change counts from the tick ``moment`` on.
        """
        left = side * self._offsets[vehicle, began : moment + 1] > KEEPING
        seen = began + _run_start(left, moment - began) if left[-1] else moment
        drift = side * float(self.frame.drift[vehicle, moment])
        return LaneChange(vehicle=vehicle, seen=seen, tick=moment, drift=drift)

    def _motion(self, vehicle: int, side: float, onset: int) -> int | None:
        """Return the first tick of the sideways motion that lasts until a tick or ended just before; None if none."""
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
        """Half the width of each vehicle's lane, or of the first lane if the vehicle is off the road [m]."""
        widths = np.array([lane.width for lane in self.trace.lanes])
        return np.asarray(widths[np.maximum(self._lanes, 0)] / 2)

    @property
    def _cos(self) -> float:
        return float(np.cos(self.trace.lanes[0].heading))

    @property
    def _sin(self) -> float:
        return float(np.sin(self.trace.lanes[0].heading))


def _run_start(holds: npt.NDArray[np.bool_], tick: int) -> int:
    """Return the first tick of the unbroken stretch, up to a tick, in which a condition holds."""
    fails = np.flatnonzero(~holds[:tick])
    return int(fails[-1]) + 1 if fails.size else 0


def stretches(holds: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first tick and the tick after the last of each unbroken stretch in which a condition holds."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], holds, [False])))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def first_lasting(holds: npt.NDArray[np.bool_], ticks: int) -> int | None:
    """Return the first tick from which on a condition holds for ``ticks`` ticks; None if there is none."""
    count = np.concatenate(([0], np.cumsum(holds)))
    lasting = np.flatnonzero(count[ticks:] - count[:-ticks] == ticks)
    return int(lasting[0]) if lasting.size else None
