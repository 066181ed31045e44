"""The command ``export``, which writes the run of a finding to files for other tools."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pytest_pafot import Trace, load
from pytest_pafot.commands.policy_reference import add_world_arguments, ads_factory, chosen_world
from pytest_pafot.findings.finding import Finding
from pytest_pafot.model.trace import HEADING, LANE, STEERING, FloatArray, Lane, Outcome, Y
from pytest_pafot.support.errors import FieldError, install
from pytest_pafot.support.files import write_whole, written_into
from pytest_pafot.support.process import postponed
from pytest_pafot.support.text import csv_text
from pytest_pafot.world.codec import file_or_named_world

# A trace in the coordinates of the formats: x ahead, y to the left, headings anticlockwise.


def states_of(trace: Trace) -> FloatArray:
    """Return a trace's states, converted so that y points left and headings are anticlockwise.

    The shape and the columns are those of ``trace.states``.
    """
    states = trace.states.copy()
    states[..., [Y, HEADING, STEERING]] *= -1
    return states


def centre_line(lane: Lane) -> FloatArray:
    """Return the points [m] of a lane's centre line, with y to the left, as an array of shape [points, 2]."""
    points = lane.points
    if not points:  # a straight lane
        end_x = lane.x + lane.length * np.cos(lane.heading)
        end_y = lane.y + lane.length * np.sin(lane.heading)
        points = ((lane.x, lane.y), (end_x, end_y))
    line: FloatArray = np.array(points) * (1, -1)
    # On a closed track, a run may follow the lane for several laps. The line is cut to one lap, because tools would
    # treat a line that passes the same position twice as a loop, and remove it.
    pieces = np.diff(line, axis=0)
    to_start = line[0] - line[:-1]
    share = (to_start * pieces).sum(axis=1) / (pieces**2).sum(axis=1)
    off = to_start - share[:, None] * pieces
    is_close = np.hypot(*off.T) < lane.width / 2
    is_ahead = pieces @ pieces[0] > 0
    passes = (share > 0) & (share <= 1) & is_close & is_ahead
    if passes.any():
        return line[: passes.argmax() + 1]
    return line


def tangents(line: FloatArray) -> FloatArray:
    """Return a line's unit tangents, from second-order differences, as an array of shape [points, 2]."""
    lengths = np.hypot(*np.diff(line, axis=0).T)
    along = np.cumsum([0.0, *lengths])
    order: Any = min(2, len(line) - 1)
    slopes = np.gradient(line, along, axis=0, edge_order=order)
    unit: FloatArray = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
    return unit


def edges(lane: Lane) -> tuple[FloatArray, FloatArray]:
    """Return the points [m] of a lane's left and right edges, with y to the left, as arrays of shape [points, 2]."""
    line = centre_line(lane)
    quarter_turn = np.array([[0, 1], [-1, 0]])
    left = tangents(line) @ quarter_turn * lane.width / 2
    return line + left, line - left


def name_of(vehicle: int) -> str:
    """Return a vehicle's name in exported files: ``ego``, or ``npc0`` for NPC 0 of the scenario."""
    if vehicle == 0:
        return "ego"
    return f"npc{vehicle - 1}"


# For each format, the module of this package and the function that exports.
FORMATS = {
    "commonroad": "commonroad_xml:export",
    "csv": "exporter:csv_table",
    "mcap": "foxglove_mcap:export",
    "xosc": "openscenario:export",
    "xosc-1.0": "openscenario:export_1_0",
}

# For each library that a format needs, the extra of pytest-pafot that installs it.
EXTRAS = {"scenariogeneration": "export", "foxglove": "export", "commonroad": "commonroad"}


class Exporter(Protocol):
    """The type of a function that exports the run of a finding to files."""

    def __call__(self, finding: Finding, trace: Trace) -> Mapping[str, bytes]:
        """Return the content of each file by name, without writing any file. All names start with the finding's id."""


class ExportError(FieldError):
    """An error for a finding that cannot be exported as requested."""


def exporter(name: str) -> Exporter:
    """Return the exporter for a format.

    Raises:
        ExportError: if the format is unknown or a library is missing.
    """
    if name not in FORMATS:
        raise ExportError("--to", f"one of {', '.join(FORMATS)}", repr(name))
    module, _, function = FORMATS[name].partition(":")
    try:
        made: Exporter = getattr(import_module(f"{__package__}.{module}"), function)
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in EXTRAS:
            raise
        raise ExportError(
            f"--to {name}",
            f"the library {library}",
            "a Python environment without it",
            f"run `{install(EXTRAS[library])}`",
        ) from error
    return made


COLUMNS = (
    "time",
    "vehicle",
    "x",
    "y",
    "heading",
    "speed",
    "acceleration",
    "steering",
    "lane",
    "length",
    "width",
)
"""The columns, in units of s, m and rad. Lanes are numbered from 0 at the left; -1 means off the road."""


def csv_table(finding: Finding, trace: Trace) -> Mapping[str, bytes]:
    """Return a CSV file whose numbers have all digits, so that reading the file restores the exact states."""
    rows = []
    sizes = trace.sizes.tolist()
    for time, states in zip(trace.times.tolist(), states_of(trace).tolist(), strict=True):
        for number, state in enumerate(states):
            state[LANE] = int(state[LANE])
            rows.append([time, name_of(number), *state, *sizes[number]])
    return {f"{finding.id}.csv": csv_text(COLUMNS, rows).encode()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the command."""
    parser.add_argument(
        "finding",
        metavar="FILE|FINDING",
        help="export this saved scenario, given by its file or id",
    )
    parser.add_argument(
        "--to",
        required=True,
        metavar="FORMAT",
        help=f"write this format: {', '.join(FORMATS)}",
    )
    parser.add_argument(
        "--ads",
        metavar="ADS",
        help="drive the ego with this policy: a module of example_ads, module:factory, or module:factory:argument",
    )
    add_world_arguments(
        parser, "required if the world of the file is code, such as wrappers", has_config=False
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="write to this folder (default: the current folder)",
    )


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Run the scenario of a finding, and write the run to files. Return the exit code."""
    export = exporter(arguments.to)
    saved = load(arguments.finding)
    if arguments.ads is None:
        raise ExportError(
            "--ads",
            f"the policy that drives the ego in the test {saved.finding.test}, such as --ads module:factory",
            "none. A file contains the instructions of the NPCs, but not the trajectories of the vehicles",
        )
    made = chosen_world(arguments.world, None, [arguments.ads])
    if made is None:
        world = saved.world
        where = "the world of the file"
        fix = "use the policy of the test"
    else:
        world = file_or_named_world(saved.finding.world, made)
        where = arguments.world
        fix = "use the policy of the test, and its world if that is code"
    driven = saved.replay(ads_factory(arguments.ads), world=world)
    error = driven.trace.error
    is_expected = saved.expect.outcome in (Outcome.ADS_ERROR, Outcome.HANG)
    if error is not None and not driven.trace.actions and not is_expected:
        raise ExportError("--ads", f"a policy that drives in {where}", error.text, fix)
    files = export(saved.finding, driven.trace)
    with postponed():  # one of several files is useless alone, such as a scenario without its road
        for name, content in files.items():
            with written_into(arguments.out):
                write_whole(arguments.out / name, content)
            sys.stdout.write(f"{arguments.out / name}\n")
    # A failed check cannot be compared, because the test function is not called.
    if saved.expect.check is None and not saved.matches(driven):
        needed = "the policy" if arguments.world is None else "the policy and the world"
        sys.stderr.write(
            f"export: {saved.id} was saved with {saved.expect.outcome} at {saved.expect.time:.1f} s, but this run "
            f"ended with {driven.outcome} after {driven.duration:.1f} s. Did you pass {needed} of its test?\n"
        )
    return 0
