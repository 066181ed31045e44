"""Positions of the NPCs relative to the ego: how far ahead, how far to the right, and in which cell of the grid.

This is the only definition, for straight roads and for those that bend. The measures, the safe distances of RSS, the
record of a collision, the explanation of a run and the report page share it. *Ahead* is the distance driven along the
road, *right* is the distance across it, both from the ego's centre to the NPC's [m]. Neither depends on the ego's
heading. The cell follows from the two, see :func:`pytest_pafot.model.grid.cell_at`: rows are as long as the ego,
columns as wide as its lane.

An NPC that crosses is on the ego's way only for a while, or never. While it is not, its distances are NaN, and it is in
no cell and in no vehicle's lane.

Source of the grid: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 2.1 (Modelling Target Positions).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import takewhile
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.grid import Cell, cell_at
from pytest_pafot.model.trace import ACROSS, ALONG, LANE, STRETCH, FloatArray, Lane, X, Y

Number = TypeVar("Number", float, FloatArray)


class RelativePositions:
    """The positions of the NPCs of a run relative to the ego, at every tick. Each array is computed at its first use.

    Arrays have the shape [NPCs, ticks + 1]: with the long dimension innermost, numpy is about three times as fast.

    Args:
        states, sizes, lanes, track: data of a run, see :class:`~pytest_pafot.Trace`.
    """

    def __init__(
        self, states: FloatArray, sizes: FloatArray, lanes: Sequence[Lane], track: FloatArray | None = None
    ) -> None:
        self._states = states
        self._sizes = sizes
        self._lanes = lanes
        self._track = track

    def column(self, index: int) -> FloatArray:
        """Return one column of the trace's states, shape [vehicles, ticks + 1]."""
        return np.ascontiguousarray(self._states[:, :, index].T)

    @cached_property
    def x(self) -> FloatArray:
        """The x of all vehicles in the world [m], shape [vehicles, ticks + 1]."""
        return self.column(X)

    @cached_property
    def y(self) -> FloatArray:
        """The y of all vehicles in the world [m], shape [vehicles, ticks + 1]."""
        return self.column(Y)

    @cached_property
    def road(self) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of the direction of the ego's lane, shape [1, ticks + 1], or [1, 1] if all lanes agree.

        If the ego is off the road, the last lane's direction counts. On a straight road all lanes agree.
        """
        headings = [lane.heading for lane in self._lanes]
        if headings.count(headings[0]) == len(headings):
            heading = np.array([headings[:1]])
        else:
            heading = np.array(headings)[self.column(LANE)[:1].astype(np.intp)]
        return np.cos(heading), np.sin(heading)

    @cached_property
    def is_on_way(self) -> npt.NDArray[np.bool_]:
        """True for each NPC on the ego's way. An NPC that crosses is on it only after it has merged."""
        is_there = np.ones((self._states.shape[1] - 1, len(self._states)), dtype=np.bool_)
        # A user's world may record NaN for a vehicle, too. Its distances must then stay NaN, so it counts as on the
        # way.
        return is_there if self._track is None else ~np.isnan(self._track[:, 1:, ALONG].T) | np.isnan(self.x[1:])

    @property
    def ahead(self) -> FloatArray:
        """The distance of each NPC's centre ahead of the ego's [m], negative behind it; NaN off the ego's way.

        It is measured along a straight road. On one that bends, it is the difference of the places on the ego's way
        times the mean of the metres that the two drive per metre of it. In a circle that is the arc halfway between
        theirs.
        """
        return self._offset[0]

    @property
    def right(self) -> FloatArray:
        """The distance of each NPC's centre to the right of the ego's, across the road [m], negative to the left.

        NaN off the ego's way. On a road that bends, it is the difference of the distances to the ego's way, each
        measured at the vehicle itself.
        """
        return self._offset[1]

    @cached_property
    def same_lane(self) -> npt.NDArray[np.bool_]:
        """True if the centres of ego and NPC are in one lane of the road and the NPC is on the ego's way."""
        lane = self.column(LANE)
        same: npt.NDArray[np.bool_] = (lane[1:] == lane[:1]) & (lane[:1] >= 0)
        return same if self._track is None else same & self.is_on_way

    def cell(self, npc: int, tick: int) -> Cell | None:
        """Return the cell that an NPC's centre is in, None for the ego's own cell and off the ego's way.

        A column is as wide as the ego's lane at that tick, or as the first lane if the ego is on none.
        """
        ego, npc_now = self._states[tick, 0].tolist(), self._states[tick, npc + 1].tolist()
        lane = int(ego[LANE])
        if self._track is None:
            heading = self._lanes[lane].heading
            ahead, right = _on_road(ego, npc_now, math.cos(heading), math.sin(heading))
        else:
            ahead, right = _on_way(self._track[tick, 0].tolist(), self._track[tick, npc + 1].tolist())
        return cell_at(ahead, right, float(self._sizes[0, 0]), self._lanes[max(lane, 0)].width)

    def last_cell(self, npc: int, tick: int) -> Cell | None:
        """Return the last cell up to a tick, other than the ego's own, that an NPC's centre was in; None if none.

        Also None off the ego's way, and if the NPC entered that way in the ego's own cell.
        """
        ticks = takewhile(lambda each: self.is_on_way[npc, each], range(tick, -1, -1))
        cells = (self.cell(npc, each) for each in ticks)
        return next((cell for cell in cells if cell is not None), None)

    @cached_property
    def _offset(self) -> tuple[FloatArray, FloatArray]:
        if self._track is None:
            x, y = self.x, self.y
            return _on_road({X: x[:1], Y: y[:1]}, {X: x[1:], Y: y[1:]}, *self.road)
        columns = self._track.transpose(2, 1, 0)
        return _on_way(columns[:, :1], columns[:, 1:])


def _on_road(ego: Any, npc: Any, cos: Number, sin: Number) -> tuple[Number, Number]:
    """Return ahead and right [m] from states, floats or arrays, on a straight road."""
    x, y = npc[X] - ego[X], npc[Y] - ego[Y]
    return x * cos + y * sin, y * cos - x * sin


def _on_way(ego: Any, npc: Any) -> tuple[Any, Any]:
    """Return ahead and right [m] from rows of a track, floats or arrays."""
    ahead = driven_between(ego[ALONG], npc[ALONG], ego[STRETCH], npc[STRETCH])
    return ahead, npc[ACROSS] - ego[ACROSS]


def driven_between(first: Number, second: Number, first_stretch: Number, second_stretch: Number) -> Number:
    """Return the metres driven between two places on the ego's way, given the metres driven per metre of it at each."""
    return (second - first) * (first_stretch + second_stretch) / 2
