"""Do other tools read an exported run, and its road? Ten findings on six roads, through every format and reader.

    python -m tests.benchmarks.exports [--finds DIR]

Searches for collisions of an ego that keeps its lane and its speed, and lets
``tests/extras/export/test_exports.py`` read all of them. Prints a row for each reader: its version, how many findings
it read as they were driven, and the largest difference in lengths [m] and speeds [m/s]. Ends with 1 if one is read
differently. A reader that is not installed is reported as absent. The following commands install all of them, best in
a separate virtual environment:

    python -m pip install asam-qc-openscenarioxml asam-qc-opendrive eclipse-sumo
    python -m pip install ".[export,commonroad]" commonroad-drivability-checker

The second command installs a newer numpy than ASAM's checkers name. pip complains, but they work with it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

import pytest
from highway_env.vehicle.controller import ControlledVehicle

import pytest_pafot as pafot

ROADS = {"highway-v0": 3, "merge-v0": 2, "exit-v0": 2, "roundabout-v0": 1, "racetrack-v0": 1, "u-turn-v0": 1}
"""The number of findings to take from each road."""
RUNS, SEED = 150, 1
POLICY = f"{__name__ if __name__ != '__main__' else 'tests.benchmarks.exports'}:keeps_its_lane"
TESTS = "tests/extras/export/test_exports.py"
READERS = {
    "test_a_table_read_back_is_what_was_driven": ("csv", "csv", None),
    "test_openscenario_has_every_vehicle_at_every_tick": ("xosc", "xml.etree", None),
    "test_asams_checkers_report_no_issue-.xosc": ("xosc", "asam-qc-openscenarioxml", "asam-qc-openscenarioxml"),
    "test_asams_checkers_report_no_issue-.xodr": ("xosc", "asam-qc-opendrive", "asam-qc-opendrive"),
    "test_sumos_netconvert_reads_the_lanes_where_they_are": ("xosc", "netconvert", "eclipse-sumo"),
    "test_foxglove_file_has_same_numbers_and_times": ("mcap", "mcap", "mcap"),
    "test_commonroad_reads_the_same_vehicles_and_lanes": ("commonroad", "commonroad-io", "commonroad-io"),
    "test_commonroad_checker_finds_collision_at_the_same_tick": (
        "commonroad",
        "drivability checker",
        "commonroad-drivability-checker",
    ),
}
"""The readers by test: the format, the reader's name, and its distribution."""


def keeps_its_lane() -> type[ControlledVehicle]:
    """Return an ego that keeps its lane and its speed, also on roads that bend."""
    return ControlledVehicle


def holds(run: pafot.Run) -> None:
    """Assert that there is no collision."""
    assert not run.collision, run.explain()


def finds(folder: Path) -> list[Path]:
    """Search, and return the files of the findings; of each road, those with the first ids."""
    taken = []
    for road, count in ROADS.items():
        pafot.explore(
            keeps_its_lane(),
            holds=holds,
            world=pafot.World(road, duration=20.0),
            runs=RUNS,
            seed=SEED,
            corpus=folder / road,
        )
        found = sorted((folder / road).rglob("*.pafot.yaml"))
        sys.stderr.write(f"{road}: {len(found)} finds, {min(count, len(found))} taken\n")
        taken += found[:count]
    return taken


@dataclass
class Readings:
    """A plugin of pytest that has the tests read some findings, and stores the outcomes.

    Attributes:
        files: The findings' files.
        ends: Outcomes by test.
        differences: The differences that tests report, by test.
        why: The reports of failed tests.
    """

    files: list[Path]
    ends: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    differences: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    why: list[str] = field(default_factory=list)

    @pytest.hookimpl(tryfirst=True)
    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Replace the files in the fixture of every test that reads, by a mark."""
        if any(test.startswith(metafunc.function.__name__) for test in READERS):
            given = [(str(file), POLICY) for file in self.files]
            metafunc.definition.add_marker(pytest.mark.parametrize("exported", given, indirect=True))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Store the outcome of the call, or of the phase that prevented it."""
        name, _, parameters = report.nodeid.rpartition("::")[2].partition("[")
        suffix = next((f"-{each}" for each in (".xosc", ".xodr") if each in parameters), "")
        if report.when == "call" or report.outcome != "passed":
            self.ends[name + suffix].append(report.outcome)
        if report.when == "call":
            self.differences[name + suffix] += [float(value) for _, value in report.user_properties]
        if report.failed:
            self.why.append(f"{report.nodeid}\n{report.longreprtext}\n")


def version(distribution: str | None) -> str:
    """Return the version of an installed distribution, or Python's own for None."""
    try:
        return metadata.version(distribution) if distribution else f"Python {sys.version.partition(' ')[0]}"
    except metadata.PackageNotFoundError:
        return "absent"


def main() -> int:
    """Find, export, read, and print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--finds", type=Path, metavar="DIR", help="where to store or reuse the findings")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        readings = Readings(finds(given.finds or Path(scratch)))
        chosen = " or ".join({name.partition("-.")[0] for name in READERS})
        pytest.main(["-q", "-p", "no:cacheprovider", "--no-header", "-k", chosen, TESTS], plugins=[readings])
    print("| Format | Read by | Version | Finds as driven | Largest difference |\n| --- | --- | --- | --- | --- |")
    for test, (form, reader, distribution) in READERS.items():
        ends, apart = readings.ends[test], readings.differences[test]
        difference = f"{max(apart):.1e}" if apart else "none" if "passed" in ends else "-"
        count = f"{ends.count('passed')} of {len(ends)}"
        print(f"| {form} | {reader} | {version(distribution)} | {count} | {difference} |")
    print("\n".join(readings.why), file=sys.stderr)
    return 1 if readings.why else 0


if __name__ == "__main__":
    sys.exit(main())
