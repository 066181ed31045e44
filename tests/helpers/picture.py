"""A second program for the page's picture at a moment: where everything is, without drawing it.

The page's script computes the same in the browser. Tests compare the results of both.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pytest_pafot.model.grid import Cell
from pytest_pafot.report.page_data import InstructionView, Numbers, RoadView, RunView

TRAIL_SECONDS = 4.0
TRAIL_STEP = 0.125

Phase = Literal["approach", "arrived", "ended"]
Point = tuple[float, float]
"""A point of the picture: (along the road, across it) [m]."""


@dataclass(frozen=True, slots=True)
class DrawnVehicle:
    """A vehicle in the picture: its centre [m], heading [rad], size [m] and speed [m/s]."""

    along: float
    across: float
    heading: float
    length: float
    width: float
    speed: float = 0.0


@dataclass(frozen=True, slots=True)
class DrawnCell:
    """A cell around the ego: its number, its centre [m], and True if there is a lane."""

    cell: int
    along: float
    across: float
    exists: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A finding's picture at a time [s].

    Attributes:
        vehicles: the ego first; None for a vehicle whose position is unknown.
        cells: the eight cells around the ego; none on a bent road.
        targets: the cell that each NPC is driving to, or its place in the lane that it is driving to, or None.
        trails: recent positions of each vehicle. The ego's trail is its path on the road. An NPC's trail is its path
            relative to the ego; on a bent road it is its path on the road, too.
        impact: point of contact of the ego with an NPC, from the collision on; None before it.
    """

    time: float
    ego: DrawnVehicle
    vehicles: tuple[DrawnVehicle | None, ...]
    cells: tuple[DrawnCell, ...]
    targets: tuple[DrawnCell | None, ...]
    trails: tuple[tuple[Point, ...], ...]
    impact: Point | None


def picture_at(finding: RunView, time: float) -> Picture:
    """Return the picture of a finding at a time [s], with positions interpolated between frames.

    Raises:
        ValueError: for a finding without frames, or a moment at which the ego's position is unknown.
    """
    if not finding.times:
        raise ValueError(f"finding: expected frames to draw, received none: {finding.headline}")
    vehicles = tuple(vehicle_at(finding, vehicle, time) for vehicle in range(len(finding.vehicles)))
    ego = vehicles[0]
    if ego is None:
        raise ValueError(f"time: expected a moment with a position of the ego, received {time} s of {finding.headline}")
    cells = () if finding.road.shapes else tuple(drawn_cell(finding, ego, cell) for cell in Cell)
    return Picture(
        time=time,
        ego=ego,
        vehicles=vehicles,
        cells=cells,
        targets=tuple(_target(finding, cells, npc, time) for npc in range(len(vehicles) - 1)),
        trails=tuple(_trail(finding, vehicle, time, ego) for vehicle in range(len(vehicles))),
        impact=_impact(finding, ego, vehicles, time),
    )


def vehicle_at(finding: RunView, vehicle: int, time: float) -> DrawnVehicle | None:
    """Return a vehicle as it is at a time [s]; None if its position is unknown then."""
    view = finding.vehicles[vehicle]
    before, after, share = _frame_at(finding, time)

    def between(track: Numbers) -> float | None:
        a, b = track[before], track[after]
        return None if a is None or b is None else a + (b - a) * share

    along, across = between(view.along), between(view.across)
    if along is None or across is None:
        return None
    heading, speed = between(view.heading) or 0.0, between(view.speed) or 0.0
    return DrawnVehicle(along, across, heading, view.length, view.width, speed)


def instruction_at(finding: RunView, npc: int, time: float) -> tuple[InstructionView, Phase] | None:
    """Return an NPC's instruction at a time [s], and its phase; None if the NPC has no instructions.

    The phase is ``approach`` on the way to the goal, ``arrived`` there, and ``ended`` after the last instruction.
    """
    rows = [row for row in finding.instructions if row.npc == npc]
    row = next((each for each in rows if time < each.end - 1e-9), rows[-1] if rows else None)
    if row is None:
        return None
    if not row.zone and time >= row.end - 1e-9 and finding.times[-1] > row.end:
        return row, "ended"
    return row, "arrived" if row.arrived is not None and time >= row.arrived - 1e-9 else "approach"


def drawn_cell(finding: RunView, ego: DrawnVehicle, cell: Cell) -> DrawnCell:
    """Return the place of a cell on a straight road."""
    road = finding.road
    other = finding.vehicles[min(1, len(finding.vehicles) - 1)].length
    along = ego.along + cell.row * ((ego.length + other) / 2 + _gap_to(road, cell, ego.speed))
    lane = _nearest_lane(road, ego.across)
    goal = lane + cell.column
    exists = 0 <= goal < len(road.lanes)
    return DrawnCell(
        int(cell), along, road.lanes[goal] if exists else road.lanes[lane] + cell.column * road.lane_width, exists
    )


def _gap_to(road: RoadView, cell: Cell, speed: float) -> float:
    """Return the gap between the ego at a speed [m/s] and a cell ahead of or behind it [m]."""
    least, start, seconds = (0.0, 0.0, 0.0) if cell.column else road.ahead if cell.row > 0 else road.behind
    return max(road.clearance, least, start + seconds * speed)


def _nearest_lane(road: RoadView, across: float) -> int:
    """Return the lane that a vehicle is in; the left one of two at equal distance."""
    return min(range(len(road.lanes)), key=lambda lane: (round(abs(road.lanes[lane] - across), 9), lane))


def _target(finding: RunView, cells: Sequence[DrawnCell], npc: int, time: float) -> DrawnCell | None:
    """Return the cell to which an NPC is driving at a time [s]; None if it has no cell, or if there is no lane.

    The target of an NPC that changes lanes is drawn as a cell without a number, beside the NPC in its target lane.
    """
    row, phase = instruction_at(finding, npc, time) or (None, "ended")
    if row is None or phase != "approach" or finding.road.shapes:
        return None
    if row.lane:
        box, start = vehicle_at(finding, npc + 1, time), vehicle_at(finding, npc + 1, row.start)
        if box is None or start is None:
            return None
        lane = _nearest_lane(finding.road, start.across) + {"left": -1, "right": 1}.get(row.lane, 0)
        exists = 0 <= lane < len(finding.road.lanes)
        return DrawnCell(0, box.along, finding.road.lanes[lane], exists) if exists else None
    if row.cell == 0:
        return None
    return cells[row.cell - 1]


def _frame_at(finding: RunView, time: float) -> tuple[int, int, float]:
    """Return the frames before and after a time, and the share of the time between them that has passed."""
    after = min(max(bisect_right(finding.times, time), 1), len(finding.times) - 1)
    before = max(after - 1, 0)
    span = finding.times[after] - finding.times[before]
    return before, after, min(max((time - finding.times[before]) / span, 0.0), 1.0) if span > 0 else 0.0


def _trail(finding: RunView, vehicle: int, time: float, ego: DrawnVehicle) -> tuple[Point, ...]:
    count = int(min(TRAIL_SECONDS, time) / TRAIL_STEP)
    is_relative = vehicle > 0 and not finding.road.shapes
    points = []
    for moment in [*(time - step * TRAIL_STEP for step in range(count, 0, -1)), time]:
        seen, origin = vehicle_at(finding, vehicle, moment), vehicle_at(finding, 0, moment)
        if seen is not None and origin is not None:
            points.append((seen.along - origin.along + ego.along if is_relative else seen.along, seen.across))
    return tuple(points)


def _impact(finding: RunView, ego: DrawnVehicle, vehicles: Sequence[DrawnVehicle | None], time: float) -> Point | None:
    """Return the point of the ego that is nearest to the centre of the NPC that it touches."""
    event = finding.event
    other = None if event.npc is None else vehicles[event.npc + 1]
    if event.kind != "collision" or other is None or time < event.time - 1e-6:
        return None
    cos, sin = (math.cos(ego.heading), math.sin(ego.heading)) if finding.road.shapes else (1.0, 0.0)
    dx, dy = other.along - ego.along, other.across - ego.across
    ahead = min(max(dx * cos + dy * sin, -ego.length / 2), ego.length / 2)
    right = min(max(dy * cos - dx * sin, -ego.width / 2), ego.width / 2)
    return ego.along + ahead * cos - right * sin, ego.across + ahead * sin + right * cos
