"""Positions of the NPCs relative to the ego: how far ahead, how far to the right, and in which cell of the grid.

No other module defines these positions, neither for straight roads nor for roads that bend. The measures, the safe
distances of RSS, the record of a collision, the explanation of a run and the report page share them. *Ahead* is the
distance driven along the road, *right* is the distance across it, both from the ego's centre to the NPC's [m]. Neither
depends on the ego's heading. Both together determine the cell, see :func:`pytest_pafot.model.grid.cell_at`: rows are as
long as the ego, columns as wide as its lane.

An NPC that crosses is on the ego's way only for a while, or never. While it is not on that way, its distances are NaN,
it is in no cell, and it shares a lane with no vehicle.

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
    """The positions of the NPCs of a run relative to the ego at every tick; each array is computed at its first use.

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
        """The x coordinates of all vehicles [m], shape [vehicles, ticks + 1]."""
        return self.column(X)

    @cached_property
    def y(self) -> FloatArray:
        """The y coordinates of all vehicles [m], shape [vehicles, ticks + 1]."""
        return self.column(Y)

    @cached_property
    def road(self) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of the heading of the ego's lane, each of shape [1, ticks + 1].

        If all lanes have the same heading, as on a straight road, the shape is [1, 1]. While the ego is off the road,
        the heading of the last lane in the list is used.
        """
        headings = [lane.heading for lane in self._lanes]
        if headings.count(headings[0]) == len(headings):
            heading = np.array([headings[:1]])
        else:
            heading = np.array(headings)[self.column(LANE)[:1].astype(np.intp)]
        return np.cos(heading), np.sin(heading)

    @cached_property
    def is_on_way(self) -> npt.NDArray[np.bool_]:
        """True while an NPC is on the ego's way. An NPC that crosses is on that way only after it has merged."""
        is_there = np.ones((self._states.shape[1] - 1, len(self._states)), dtype=np.bool_)
        # A user's world may record NaN for a vehicle, too. Its distances must then stay NaN, so it counts as on the
        # way.
        return is_there if self._track is None else ~np.isnan(self._track[:, 1:, ALONG].T) | np.isnan(self.x[1:])

    @property
    def ahead(self) -> FloatArray:
        """The distance of each NPC's centre ahead of the ego's [m], negative behind it; NaN off the ego's way.

        On a straight road it is the distance along the road. On a road that bends, it is the difference of the two
        places on the ego's way, times the mean of the metres that ego and NPC drive per metre of that way. In a circle
        this is the length of the arc halfway between the arcs of the two vehicles.
        """
        return self._offset[0]

    @property
    def right(self) -> FloatArray:
        """The distance of each NPC's centre to the right of the ego's, across the road [m], negative to the left.

        NaN off the ego's way. On a road that bends, it is the difference of the two vehicles' distances to the ego's
        way, each measured at the place of the vehicle.
        """
        return self._offset[1]

    @cached_property
    def same_lane(self) -> npt.NDArray[np.bool_]:
        """True if the centres of ego and NPC are in one lane of the road and the NPC is on the ego's way."""
        lane = self.column(LANE)
        same: npt.NDArray[np.bool_] = (lane[1:] == lane[:1]) & (lane[:1] >= 0)
        return same if self._track is None else same & self.is_on_way

    def cell(self, npc: int, tick: int) -> Cell | None:
        """Return the cell that an NPC's centre is in at a tick; None in the ego's own cell and off the ego's way.

        A column is as wide as the ego's lane at that tick, or as the first lane if the ego is off the road.
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
        """Return the last cell, except the ego's own, that an NPC's centre was in up to a tick; None if there is none.

        None, too, if the NPC is off the ego's way at that tick, or has been in the ego's own cell since it entered that
        way.
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
    """Return the NPC's distances ahead and to the right of the ego [m] from states on a straight road."""
    x, y = npc[X] - ego[X], npc[Y] - ego[Y]
    return x * cos + y * sin, y * cos - x * sin


def _on_way(ego: Any, npc: Any) -> tuple[Any, Any]:
    """Return the NPC's distances ahead and to the right of the ego [m] from rows of :attr:`Trace.track`."""
    ahead = driven_between(ego[ALONG], npc[ALONG], ego[STRETCH], npc[STRETCH])
    return ahead, npc[ACROSS] - ego[ACROSS]


def driven_between(first: Number, second: Number, first_stretch: Number, second_stretch: Number) -> Number:
    """Return the metres driven between two places on the ego's way.

    Each stretch factor is the number of metres that a vehicle drives per metre of the way at that place.
    """
    return (second - first) * (first_stretch + second_stretch) / 2
