"""What is where at a moment of a finding: the geometry of the picture, without drawing it.

The page's script does the same in the browser; a test compares the two.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pytest_pafot.grid import Cell
from pytest_pafot.report.views import FindingView, InstructionView, Numbers

TRAIL_SECONDS = 4.0
TRAIL_STEP = 0.125

Phase = Literal["approach", "arrived", "ended"]
Point = tuple[float, float]
"""(along, across) [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A vehicle at a moment: centre [m], heading [rad], size [m], speed [m/s]."""

    along: float
    across: float
    heading: float
    length: float
    width: float
    speed: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CellPlace:
    """A cell of the grid around the ego: its number, and its centre [m]; ``exists`` when there is a lane for it."""

    cell: int
    along: float
    across: float
    exists: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A finding at a moment.

    Attributes:
        time: [s].
        boxes: of the vehicles, the ego first; None for one whose position is unknown.
        cells: the eight around the ego.
        targets: per NPC, the cell that it is on its way to, or None.
        trails: per vehicle, where it was in the last seconds. The ego's is its path on the road; an NPC's is its
            path as the ego saw it, moved along with the ego.
        impact: where the vehicles touch, once they do.
    """

    time: float
    boxes: tuple[Box | None, ...]
    cells: tuple[CellPlace, ...]
    targets: tuple[CellPlace | None, ...]
    trails: tuple[tuple[Point, ...], ...]
    impact: Point | None


def scene_at(finding: FindingView, time: float) -> Scene:
    """The scene at a time, positions between frames interpolated.

    Raises:
        ValueError: for a finding without frames, or a moment at which nobody knows where the ego was.
    """
    if not finding.times:
        raise ValueError(f"finding: expected frames to draw, received none for {finding.id}; nobody saw a run of it")
    boxes = tuple(box_at(finding, vehicle, time) for vehicle in range(len(finding.vehicles)))
    ego = boxes[0]
    if ego is None:
        raise ValueError(f"time: expected a moment with a position of the ego, received {time} s of {finding.id}")
    cells = tuple(cell_place(finding, ego, cell) for cell in Cell)
    rows = [instruction_at(finding, npc, time) for npc in range(len(finding.vehicles) - 1)]
    return Scene(
        time=time,
        boxes=boxes,
        cells=cells,
        targets=tuple(
            cells[row[0].cell - 1] if row is not None and row[0].cell and row[1] == "approach" else None for row in rows
        ),
        trails=tuple(_trail(finding, vehicle, time, ego) for vehicle in range(len(boxes))),
        impact=_impact(finding, boxes, time),
    )


def box_at(finding: FindingView, vehicle: int, time: float) -> Box | None:
    """A vehicle at a time."""
    view = finding.vehicles[vehicle]
    after = min(max(bisect_right(finding.times, time), 1), len(finding.times) - 1)
    before = max(after - 1, 0)
    span = finding.times[after] - finding.times[before]
    share = min(max((time - finding.times[before]) / span, 0.0), 1.0) if span > 0 else 0.0
    values = [_between(track, before, after, share) for track in (view.along, view.across, view.heading, view.speed)]
    along, across, heading, speed = values
    if along is None or across is None:
        return None
    return Box(
        along=along,
        across=across,
        heading=heading or 0.0,
        length=view.length,
        width=view.width,
        speed=speed or 0.0,
    )


def instruction_at(finding: FindingView, npc: int, time: float) -> tuple[InstructionView, Phase] | None:
    """What an NPC is told at a time: on its way to the cell, or there, or at the end of its chain."""
    rows = [row for row in finding.instructions if row.npc == npc]
    row = next((each for each in rows if time < each.end - 1e-9), rows[-1] if rows else None)
    if row is None:
        return None
    if time >= row.end - 1e-9 and finding.duration > row.end:
        return row, "ended"
    return row, "arrived" if row.arrived is not None and time >= row.arrived - 1e-9 else "approach"


def nearest_lane(lanes: Sequence[float], across: float) -> int:
    """Index of the lane whose centre is nearest; the left one of two at equal distance."""
    return min(range(len(lanes)), key=lambda lane: (round(abs(lanes[lane] - across), 9), lane))


def cell_place(finding: FindingView, ego: Box, cell: Cell) -> CellPlace:
    """Where a cell is."""
    road = finding.road
    other = finding.vehicles[min(1, len(finding.vehicles) - 1)].length
    lane = nearest_lane(road.lanes, ego.across)
    goal = lane + cell.column
    exists = 0 <= goal < len(road.lanes)
    return CellPlace(
        cell=int(cell),
        along=ego.along + cell.row * ((ego.length + other) / 2 + road.clearance),
        across=road.lanes[goal] if exists else road.lanes[lane] + cell.column * road.lane_width,
        exists=exists,
    )


def _between(track: Numbers, before: int, after: int, share: float) -> float | None:
    a, b = track[before], track[after]
    return None if a is None or b is None else a + (b - a) * share


def _trail(finding: FindingView, vehicle: int, time: float, ego: Box) -> tuple[Point, ...]:
    count = int(min(TRAIL_SECONDS, time) / TRAIL_STEP)
    points = []
    for moment in [*(time - step * TRAIL_STEP for step in range(count, 0, -1)), time]:
        box, origin = box_at(finding, vehicle, moment), box_at(finding, 0, moment)
        if box is not None and origin is not None:
            along = box.along - origin.along + ego.along if vehicle else box.along
            points.append((along, box.across))
    return tuple(points)


def _impact(finding: FindingView, boxes: Sequence[Box | None], time: float) -> Point | None:
    event = finding.event
    if event.kind != "collision" or event.npc is None or time < event.time - 1e-6:
        return None
    ego, other = boxes[0], boxes[event.npc + 1]
    if ego is None or other is None:
        return None
    return (
        ego.along + min(max(other.along - ego.along, -ego.length / 2), ego.length / 2),
        ego.across + min(max(other.across - ego.across, -ego.width / 2), ego.width / 2),
    )
