"""CSV files with a row for each vehicle at each tick."""

from __future__ import annotations

from collections.abc import Mapping

from pytest_pafot import Trace
from pytest_pafot.export.exporter import name_of, states_of
from pytest_pafot.findings.finding import Finding
from pytest_pafot.model.trace import LANE
from pytest_pafot.support.text import csv_text

COLUMNS = ("time", "vehicle", "x", "y", "heading", "speed", "acceleration", "steering", "lane", "length", "width")
"""The columns, in s, m, rad, m/s and m/s^2. Lanes are numbered from 0 at the left; -1 is off the road."""


def export(finding: Finding, trace: Trace) -> Mapping[str, bytes]:
    """Return a CSV file with all digits of the numbers, so that reading it gives exactly the states of the run."""
    rows = (
        [time, name_of(number), *state[:LANE], int(state[LANE]), *size]
        for time, vehicles in zip(trace.times.tolist(), states_of(trace).tolist(), strict=True)
        for number, (state, size) in enumerate(zip(vehicles, trace.sizes.tolist(), strict=True))
    )
    return {f"{finding.id}.csv": csv_text(COLUMNS, rows).encode()}
