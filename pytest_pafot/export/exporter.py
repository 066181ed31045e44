"""The interface of exporters, and their lookup by name: one of this package, or one that a package has registered."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from types import MappingProxyType
from typing import Protocol

import numpy as np

from pytest_pafot.findings.finding import Finding
from pytest_pafot.model.trace import HEADING, STEERING, FloatArray, Lane, Trace, Y
from pytest_pafot.support.errors import FieldError

# A trace in the coordinates of the formats: x ahead, y to the left, headings anticlockwise.


def states_of(trace: Trace) -> FloatArray:
    """Return the states of a trace, with its columns, in these coordinates; shape [ticks + 1, vehicles, 7]."""
    states = trace.states.copy()
    states[..., [Y, HEADING, STEERING]] *= -1
    return states


def centre_line(lane: Lane) -> FloatArray:
    """Return the points of a lane's centre line in these coordinates [m], shape [points, 2]: two for a straight lane.

    The lane of a closed track, which a run may follow for several laps, is cut to one lap: tools would treat a line
    that passes the same place twice as a loop and remove it.
    """
    end = lane.x + lane.length * np.cos(lane.heading), lane.y + lane.length * np.sin(lane.heading)
    line = np.array(lane.points or [(lane.x, lane.y), end]) * (1, -1)
    pieces, to_start = np.diff(line, axis=0), line[0] - line[:-1]
    share = (to_start * pieces).sum(axis=1) / (pieces**2).sum(axis=1)
    beside = np.hypot(*(to_start - share[:, None] * pieces).T)
    passes = (share > 0) & (share <= 1) & (beside < lane.width / 2) & (pieces @ pieces[0] > 0)
    return line[: passes.argmax() + 1] if passes.any() else line


def tangents(line: FloatArray) -> FloatArray:
    """Return the unit tangents of a line at its points, shape [points, 2], by second-order differences."""
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    slopes: FloatArray = np.gradient(line, along, axis=0, edge_order=2 if len(line) > 2 else 1)
    unit: FloatArray = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    return unit


def edges(lane: Lane) -> tuple[FloatArray, FloatArray]:
    """Return the points of a lane's left and right edges in these coordinates [m], shape [points, 2] each."""
    line = centre_line(lane)
    left = tangents(line) @ np.array([[0, 1], [-1, 0]]) * lane.width / 2
    return line + left, line - left


def name_of(vehicle: int) -> str:
    """Return a vehicle's name in files: ``ego``, or ``npc0`` for NPC 0 of the scenario."""
    return f"npc{vehicle - 1}" if vehicle else "ego"


GROUP = "pytest_pafot.exporters"
"""The group of entry points; each is an :class:`Exporter` under the name of its format."""

BUILT_IN = tuple(
    metadata.EntryPoint(name, f"{__package__}.{module}:export", GROUP)
    for name, module in (
        ("commonroad", "commonroad_xml"),
        ("csv", "csv_table"),
        ("mcap", "foxglove_mcap"),
        ("xosc", "openscenario"),
    )
)
"""The exporters of this package; no other package can take their names."""

EXTRAS: Mapping[str, str] = MappingProxyType(
    {"scenariogeneration": "export", "foxglove": "export", "commonroad": "commonroad"}
)
"""The extra that installs each library that a format needs."""


class Exporter(Protocol):
    """A function that turns a run of a finding into files."""

    def __call__(self, finding: Finding, trace: Trace) -> Mapping[str, bytes]:
        """Return the content of each file by its name, which begins with the finding's id. Write nothing."""


class ExportError(FieldError):
    """A finding that cannot be exported as requested."""


def exporter(name: str) -> Exporter:
    """Return the exporter of a format.

    Raises:
        ExportError: for an unknown name, or if the exporter, or the library that it needs, cannot be imported.
    """
    entries = {entry.name: entry for entry in (*metadata.entry_points(group=GROUP), *BUILT_IN)}
    if name not in entries:
        known, fix = ", ".join(sorted(entries)), "a package that registers it may not be installed here"
        raise ExportError(field="--to", expected=f"one of {known}", received=repr(name), fix=fix)
    try:
        made: Exporter = entries[name].load()
    except Exception as error:
        library = (getattr(error, "name", None) or "").partition(".")[0]
        is_missing = isinstance(error, ModuleNotFoundError) and library in EXTRAS
        fix = f"run `pip install 'pytest-pafot[{EXTRAS[library]}]'`" if is_missing else ""
        expected = f"the library {library}" if is_missing else f"that {entries[name].value} can be imported"
        received = "an environment without it" if is_missing else f"{type(error).__name__}: {error}"
        raise ExportError(field=f"--to {name}", expected=expected, received=received, fix=fix) from error
    return made
