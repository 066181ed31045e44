"""What a planner sees in :class:`pytest_pafot.Highway`: the world in SI units, read-only and cheap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pytest_pafot.trace import FloatArray


class VehicleState(NamedTuple):
    """A vehicle as any observer could measure it.

    Attributes:
        x, y: centre [m]; x along the road, y to the right, 0 on the centre of the leftmost lane.
        heading: 0 along the road, positive to the right [rad].
        speed: [m/s].
        lane: index of the nearest lane, 0 at the left.
        length, width: [m].
    """

    x: float
    y: float
    heading: float
    speed: float
    lane: int
    length: float
    width: float


class Observation(NamedTuple):
    """One observation.

    Attributes:
        time: since the start [s].
        ego: the vehicle that the ADS drives.
        others: all other vehicles, the NPCs.
        lanes: number of lanes.
        lane_width: [m].
        speed_limit: [m/s].
    """

    time: float
    ego: VehicleState
    others: tuple[VehicleState, ...]
    lanes: int
    lane_width: float
    speed_limit: float

    @property
    def array(self) -> FloatArray:
        """All vehicles as float64, shape [vehicles, 7], the ego first; columns as in :class:`VehicleState`."""
        return np.array([self.ego, *self.others], dtype=np.float64)
