"""A trace in the frame of the formats: x ahead, y to the left, headings anticlockwise."""

from __future__ import annotations

import numpy as np

from pytest_pafot.trace import HEADING, STEERING, FloatArray, Lane, Trace, Y


def states_of(trace: Trace) -> FloatArray:
    """The states of a trace, with its columns, in that frame; shape [ticks + 1, vehicles, 7]."""
    states = trace.states.copy()
    states[..., [Y, HEADING, STEERING]] *= -1
    return states


def centre_line(lane: Lane) -> FloatArray:
    """Points of the centre line of a lane, in that frame [m], shape [points, 2]: two of a straight lane.

    A lane of a closed track, which a run may follow for several laps, is one lap, since tools take a line that passes
    the same place twice for a loop to cut off.
    """
    end = lane.x + lane.length * np.cos(lane.heading), lane.y + lane.length * np.sin(lane.heading)
    line = np.array(lane.points or [(lane.x, lane.y), end]) * (1, -1)
    pieces, to_start = np.diff(line, axis=0), line[0] - line[:-1]
    share = (to_start * pieces).sum(axis=1) / (pieces**2).sum(axis=1)
    beside = np.hypot(*(to_start - share[:, None] * pieces).T)
    passes = (share > 0) & (share <= 1) & (beside < lane.width / 2) & (pieces @ pieces[0] > 0)
    return line[: passes.argmax() + 1] if passes.any() else line


def tangents(line: FloatArray) -> FloatArray:
    """Unit vectors along a line at its points, shape [points, 2], by differences of the second order."""
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    slopes: FloatArray = np.gradient(line, along, axis=0, edge_order=2 if len(line) > 2 else 1)
    unit: FloatArray = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    return unit


def edges(lane: Lane) -> tuple[FloatArray, FloatArray]:
    """Points of the left and of the right edge of a lane, in that frame [m], shape [points, 2] each."""
    line = centre_line(lane)
    left = tangents(line) @ np.array([[0, 1], [-1, 0]]) * lane.width / 2
    return line + left, line - left


def name_of(vehicle: int) -> str:
    """Of a vehicle of a trace, in files: ``ego``, or ``npc0`` for the NPC 0 of the scenario."""
    return f"npc{vehicle - 1}" if vehicle else "ego"
