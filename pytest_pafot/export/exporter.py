"""The interface of exporters, and the lookup of an exporter of this or another package by its format's name."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Protocol

import numpy as np

from pytest_pafot import Trace
from pytest_pafot.findings.finding import Finding
from pytest_pafot.model.trace import HEADING, STEERING, FloatArray, Lane, Y
from pytest_pafot.support.errors import FieldError, install

# A trace in the coordinates of the formats: x ahead, y to the left, headings anticlockwise.


def states_of(trace: Trace) -> FloatArray:
    """Return the states of a trace with x ahead, y to the left and headings anticlockwise.

    The columns are those of the trace; the shape is [ticks + 1, vehicles, 7].
    """
    states = trace.states.copy()
    states[..., [Y, HEADING, STEERING]] *= -1
    return states


def centre_line(lane: Lane) -> FloatArray:
    """Return the points of a lane's centre line [m], with y to the left; shape [points, 2], two for a straight lane.

    On a closed track, a run may follow the lane for several laps. The line is cut to one lap, because tools would treat
    a line that passes the same place twice as a loop, and remove it.
    """
    end = lane.x + lane.length * np.cos(lane.heading), lane.y + lane.length * np.sin(lane.heading)
    line = np.array(lane.points or [(lane.x, lane.y), end]) * (1, -1)
    pieces, to_start = np.diff(line, axis=0), line[0] - line[:-1]
    share = (to_start * pieces).sum(axis=1) / (pieces**2).sum(axis=1)
    beside = np.hypot(*(to_start - share[:, None] * pieces).T)
    passes = (share > 0) & (share <= 1) & (beside < lane.width / 2) & (pieces @ pieces[0] > 0)
    return line[: passes.argmax() + 1] if passes.any() else line


def tangents(line: FloatArray) -> FloatArray:
    """Return the unit tangents of a line at its points, by second-order differences; shape [points, 2]."""
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    slopes: FloatArray = np.gradient(line, along, axis=0, edge_order=2 if len(line) > 2 else 1)
    unit: FloatArray = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    return unit


def edges(lane: Lane) -> tuple[FloatArray, FloatArray]:
    """Return the points of a lane's left edge and of its right edge [m], with y to the left; shape [points, 2] each."""
    line = centre_line(lane)
    left = tangents(line) @ np.array([[0, 1], [-1, 0]]) * lane.width / 2
    return line + left, line - left


def name_of(vehicle: int) -> str:
    """Return a vehicle's name in files: ``ego``, or ``npc0`` for NPC 0 of the scenario."""
    return f"npc{vehicle - 1}" if vehicle else "ego"


FORMATS: Mapping[str, str] = MappingProxyType(
    {
        "commonroad": "commonroad_xml:export",
        "csv": "csv_table:export",
        "mcap": "foxglove_mcap:export",
        "xosc": "openscenario:export",
        "xosc-1.0": "openscenario:export_1_0",
    }
)
"""The module of this package, and the exporter in it, of each format."""

EXTRAS: Mapping[str, str] = MappingProxyType(
    {"scenariogeneration": "export", "foxglove": "export", "commonroad": "commonroad"}
)
"""The extra of pytest-pafot that installs a library, for each library that a format needs."""


class Exporter(Protocol):
    """The type of a function that turns a run of a finding into files."""

    def __call__(self, finding: Finding, trace: Trace) -> Mapping[str, bytes]:
        """Return the content of each file by the file's name, which begins with the finding's id; write nothing."""


class ExportError(FieldError):
    """An error for a finding that cannot be exported as requested."""


def exporter(name: str) -> Exporter:
    """Return the exporter for the name of a format.

    Raises:
        ExportError: if the name is unknown, or if the library that the exporter needs cannot be imported.
    """
    if name not in FORMATS:
        raise ExportError(field="--to", expected=f"one of {', '.join(FORMATS)}", received=repr(name))
    module, _, function = FORMATS[name].partition(":")
    try:
        made: Exporter = getattr(import_module(f"{__package__}.{module}"), function)
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in EXTRAS:
            raise
        raise ExportError(
            field=f"--to {name}",
            expected=f"the library {library}",
            received="a Python environment without it",
            fix=f"run `{install(EXTRAS[library])}`",
        ) from error
    return made
