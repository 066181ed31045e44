"""Positions of the NPCs relative to the ego: how far ahead, how far to the right, and in which cell of the grid.

The road of the run (:class:`pytest_pafot.model.trace.RoadOfRun`) defines the distances. The measures, the safe
distances of RSS, the record of a collision, the explanation of a run and the report page share them. *Ahead* is the
distance driven along the road, *right* is the distance across it, both from the ego's centre to the NPC's [m]. Neither
depends on the ego's heading. Both together determine the cell, see :func:`pytest_pafot.model.grid.cell_at`: rows are as
long as the ego, columns as wide as its lane.

An NPC that crosses is on the ego's way only for a while, or never. While it is not on that way, its distances are NaN,
it is in no cell, and it shares a lane with no vehicle.

Source of the grid: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 2.1 (Modelling Target Positions).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import takewhile

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.grid import Cell, cell_at
from pytest_pafot.model.trace import LANE, FloatArray, Lane, road_of_run


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
        self._road = road_of_run(states, lanes, track)

    def column(self, index: int) -> FloatArray:
        """Return one column of the trace's states, shape [vehicles, ticks + 1]."""
        return self._road.column(index)

    @property
    def x(self) -> FloatArray:
        """The x coordinates of all vehicles [m], shape [vehicles, ticks + 1]."""
        return self._road.x

    @property
    def y(self) -> FloatArray:
        """The y coordinates of all vehicles [m], shape [vehicles, ticks + 1]."""
        return self._road.y

    @property
    def road(self) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of the heading of the ego's lane, each of shape [1, ticks + 1], or [1, 1] if all have one."""
        return self._road.direction

    @property
    def is_on_way(self) -> npt.NDArray[np.bool_]:
        """True while an NPC is on the ego's way. An NPC that crosses is on that way only after it has merged."""
        return self._road.is_on_way

    @property
    def ahead(self) -> FloatArray:
        """The distance of each NPC's centre ahead of the ego's [m], negative behind it; NaN off the ego's way.

        On a straight road it is the distance along the road. On a road that bends, it is the difference of the two
        places on the ego's way, times the mean of the metres that ego and NPC drive per metre of that way. In a circle
        this is the length of the arc halfway between the arcs of the two vehicles.
        """
        return self._road.offsets[0]

    @property
    def right(self) -> FloatArray:
        """The distance of each NPC's centre to the right of the ego's, across the road [m], negative to the left.

        NaN off the ego's way. On a road that bends, it is the difference of the two vehicles' distances to the ego's
        way, each measured at the place of the vehicle.
        """
        return self._road.offsets[1]

    @cached_property
    def same_lane(self) -> npt.NDArray[np.bool_]:
        """True if the centres of ego and NPC are in one lane of the road and the NPC is on the ego's way."""
        lane = self.column(LANE)
        same: npt.NDArray[np.bool_] = (lane[1:] == lane[:1]) & (lane[:1] >= 0) & self.is_on_way
        return same

    def cell(self, npc: int, tick: int) -> Cell | None:
        """Return the cell that an NPC's centre is in at a tick; None in the ego's own cell and off the ego's way.

        A column is as wide as the ego's lane at that tick, or as the first lane if the ego is off the road.
        """
        ahead, right = self._road.offset(npc, tick)
        width = self._lanes[max(int(self._states[tick, 0, LANE]), 0)].width
        return cell_at(ahead, right, float(self._sizes[0, 0]), width)

    def last_cell(self, npc: int, tick: int) -> Cell | None:
        """Return the last cell, except the ego's own, that an NPC's centre was in up to a tick; None if there is none.

        None, too, if the NPC is off the ego's way at that tick, or has been in the ego's own cell since it entered that
        way.
        """
        ticks = takewhile(lambda each: self.is_on_way[npc, each], range(tick, -1, -1))
        cells = (self.cell(npc, each) for each in ticks)
        return next((cell for cell in cells if cell is not None), None)
