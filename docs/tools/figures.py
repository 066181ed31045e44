"""Redo every figure that the documents publish: tables, samples and pictures.

    python docs/tools/figures.py [--only NAME ...] [--workers 16] [--quick] [--build DIR]

It prints the commit, the versions, and the CPU hours of each step. The results of a step are stored in DIR, in a folder
named after the commit that last changed the code, and are not measured again there. So a step that was interrupted, or
that ran on a different machine, continues if its folder is there. Then the results are written into the documents,
between a line ``<!-- measured: NAME -->`` and a line ``<!-- end of measured -->``. The reports of comparisons stay in
DIR. All their tables are stored as CSV files in docs/comparisons; pages have the part of them that readers need.
The tools that write documents themselves run last. They need Chromium, and the packages that their heads name.

With ``--quick``, a few short runs are measured to try the command, and written into a copy of the documents in DIR.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import re
import resource
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from pytest_pafot.support.process import installed_versions  # noqa: E402
from pytest_pafot.support.text import csv_text  # noqa: E402

COMPARE = "-m pytest_pafot compare --workers WORKERS --out OUT"
EVERY = "--blame ego --algorithms random,random@paper,pafot,av-fuzzer@15"
DEFECT = "--ads example_ads.defects:make:"
REPORTS = {
    "paper": "--algorithms pafot,av-fuzzer@15,av-fuzzer,random-manoeuvre,random@paper --ads idm_mobil "
    "--runs {10|2} --seconds {14400|600}",
    "idm": f"{EVERY} --runs {{20|2}} --seconds {{3600|600}} --ads idm_mobil",
    "two-defects": f"{EVERY} --runs {{20|2}} --seconds {{3600|600}} {DEFECT}two-defects",
    "sees-cut-ins-late": f"{EVERY} --runs {{20|2}} --seconds {{3600|600}} {DEFECT}sees-cut-ins-late",
    "ppo": f"{EVERY} --runs {{20|1}} --seconds {{3600|300}} --ads ppo --world highway-v0",
    "fiss": f"{EVERY} --runs {{4|1}} --seconds {{3600|60}} --ads fiss",
}
"""Arguments of the comparisons, by name. Of two values in braces, ``--quick`` uses the second."""

BENCHMARKS: Mapping[str, str] = {
    "planted-defects": "planted_defects --arms default cells pafot pafot-drawn --seeds {10|1} --first-seed 1000 "
    "--runs {1000|20} --workers WORKERS --save OUT.jsonl --picture OUT.png",
    "speed": "speed --rounds {9|1} --parts {engines search|search}",
}
"""Arguments of the programs in tests/benchmarks."""

WRITERS = {
    "reference": "docs/tools/generate.py",
    "verdict": "docs/tools/verdict_picture.py",
    "samples": "-m pytest -q -p no:cacheprovider tests/test_docs.py -m stories",
    "crash": "docs/tools/crash_picture.py",
    "pages": "docs/tools/report_picture.py",
    "roads": "docs/tools/road_pictures.py",
}
"""Commands that write documents themselves."""

COMPARISONS = Path("docs/comparisons")
SEARCHES = "searches.csv"
"""Every cell of the reports' tables of searches: report, search, measure, value."""
STATISTICS = "statistics.csv"
"""Every test of the reports."""
STATISTICS_COLUMNS = (
    "report,measure,first,second,median of first,median of second,A12 [95 %],p,Holm's p,test"
)
STORED = {
    "planted-defects": ("planted-defects.csv", "planted-defects-of-each.csv"),
}
"""Files in docs/comparisons for the tables of a benchmark, in their order."""
PICTURES = {
    "paper/figures/collisions-over-time.png": "paper.png",
    "planted-defects.png": "planted-defects.png",
}
"""Pictures in DIR, and their names in docs/comparisons."""

SUMMARY = {
    "unique scenarios that collide": "share of unique",
    "simulated time per collision": "simulated per collision",
    "collisions that an NPC alone is responsible for": "share of NPCs",
    "distinct failures of the ego, mean of a run": "mean of a run",
}
"""Rows of the paper's comparison in the overview, and their measures in its report."""
THE_PAPERS = {
    "share of unique": {"pafot": "80.5 %", "av-fuzzer": "56.3 %", "random-manoeuvre": "24.9 %"},
    "simulated per collision": {
        "pafot": "34.98 s",
        "av-fuzzer": "80.82 s",
        "random-manoeuvre": "218.35 s",
    },
}
"""The paper's values of measures, from the scenarios, collisions and hours of its section 4.2: 4945, 3981 and 38.68 for
PAFOT, 4327, 2438 and 54.73 for AV-Fuzzer, and 4000, 997 and 60.47 for its Random, whose NPCs use no grid either."""

CELLS = re.compile(r"(?<=\|) ([^|]*) (?=\|)")

Cells = Mapping[str, Mapping[str, Mapping[str, str]]]
"""Values by report, search and measure."""


def tables_of(text: str) -> list[list[list[str]]]:
    """Return the cells of all tables in a Markdown text. The first row of each is its head."""
    found = re.findall(r"(?:^\|.*\n)+", f"{text}\n", re.MULTILINE)
    parsed = ([CELLS.findall(line) for line in table.splitlines()] for table in found)
    return [[head, *rows] for head, _, *rows in parsed]


def searches_of(name: str, report: str) -> Iterator[list[str]]:
    """Yield report, search, measure and value from the tables of a report."""
    for (_, *measures), *rows in tables_of(report)[:-1]:
        for search, *values in rows:
            yield from (
                [name, search, *cell] for cell in zip(measures, values, strict=True) if cell[1]
            )


def statistics_of(name: str, report: str) -> Iterator[list[str]]:
    """Yield the tests of a report."""
    _, *rows = tables_of(report)[-1]
    yield from ([name, *row] for row in rows)


def rows_of(path: Path) -> list[list[str]]:
    """Return the rows of a CSV file without its head; none if there is no file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))[1:]


def write_rows(path: Path, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a CSV file."""
    path.write_text(csv_text(head, rows), encoding="utf-8", newline="\n")


def replace_report(path: Path, head: Sequence[str], name: str, rows: Iterable[list[str]]) -> None:
    """Replace the rows of one report in a CSV file of all reports."""
    others = [row for row in rows_of(path) if row[0] != name]
    write_rows(path, head, sorted([*others, *rows], key=lambda row: list(REPORTS).index(row[0])))


def cells_of(folder: Path) -> Cells:
    """Return the stored values of all reports."""
    cells: dict[str, dict[str, dict[str, str]]] = {}
    for report, search, measure, value in rows_of(folder / SEARCHES):
        cells.setdefault(report, {}).setdefault(search, {})[measure] = value
    return cells


def overview_of_the_paper(folder: Path) -> Iterator[list[str]]:
    """Yield the rows of the paper's measures by algorithm, each with the paper's own values below it."""
    searches = cells_of(folder)["paper"]
    yield ["", *searches]
    for shown, measure in SUMMARY.items():
        yield [shown, *(cells[measure] for cells in searches.values())]
        if measure in THE_PAPERS:
            yield ["the paper's", *(THE_PAPERS[measure].get(search, "") for search in searches)]


def overview_of_planted(folder: Path) -> Iterator[list[str]]:
    """Yield rows of how soon each search finds planted defects."""
    yield ["search", "found", "median of runs", "times the default's"]
    for _, search, found, _, unit, median, _, ratio, _ in rows_of(folder / "planted-defects.csv"):
        if unit == "runs":
            yield [search, found, median, ratio]


OVERVIEWS: Mapping[str, tuple[str, Callable[[Path], Iterator[list[str]]]]] = {
    "overview-of-the-paper": ("docs/explanation/paper.md", overview_of_the_paper),
    "planted-defects": ("docs/guide/algorithms.md", overview_of_planted),
}
"""Tables that are made from the CSV files, each with its page."""


def markdown(rows: Iterator[list[str]]) -> str:
    """Return a table of rows in Markdown. The first row is the head."""
    head, *others = rows
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (head, ["---"] * len(head), *others))


def measured(name: str, command: str, arguments: argparse.Namespace, folder: Path) -> str:
    """Return the output of a command, from DIR if it is stored there, and print the CPU hours that it took."""
    stored, out = folder / f"{name}.txt", folder / name
    if not stored.exists():
        for whole, quick in re.findall(r"\{([^|}]*)\|([^}]*)\}", command):
            command = command.replace(f"{{{whole}|{quick}}}", quick if arguments.quick else whole)
        command = command.replace("WORKERS", str(arguments.workers)).replace(
            "OUT", os.path.relpath(out, ROOT)
        )
        before = spent()
        shutil.rmtree(out, ignore_errors=True)  # of a comparison that was interrupted
        printed = run(command)
        stored.write_text(
            f"{printed}\n{name}: {spent() - before:.3f} CPU hours\n", encoding="utf-8"
        )
    text, _, hours = stored.read_text(encoding="utf-8").rstrip().rpartition("\n")
    print(hours, flush=True)
    return text


def run(command: str, **variables: str) -> str:
    """Return the output of a command of this Python. Its errors and its progress go to the terminal.

    Raises:
        SystemExit: if the command fails.
    """
    print(f"$ python {command}", flush=True)
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONHASHSEED": "0", **variables}
    done = subprocess.run(  # noqa: S603
        [sys.executable, *shlex.split(command)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(
            f"expected the command to end well, received exit status {done.returncode}:\n{done.stdout}"
        )
    return done.stdout


def spent() -> float:
    """Return the processor time of all child processes that have ended so far [h]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (usage.ru_utime + usage.ru_stime) / 3600


def write_between(document: Path, name: str, text: str) -> None:
    """Put a text between the markers of a document.

    Raises:
        SystemExit: if the document does not have them exactly once.
    """
    marked = re.compile(rf"(<!-- measured: {name} -->\n).*?(<!-- end of measured -->)", re.DOTALL)
    changed, count = marked.subn(
        lambda found: f"{found[1]}{text}{found[2]}", document.read_text(encoding="utf-8")
    )
    if count != 1:
        raise SystemExit(f"{document}: expected one line <!-- measured: {name} -->, found {count}")
    document.write_text(changed, encoding="utf-8", newline="\n")


def commit_of_the_code() -> str:
    """Return the commit that last changed the code, by git; ``unknown`` without git."""
    command = [
        "git",
        "log",
        "-1",
        "--format=%h",
        "--",
        "pytest_pafot",
        "example_ads",
        "tests/benchmarks",
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S603
    return done.stdout.strip() or "unknown"


def redo(arguments: argparse.Namespace, root: Path, folder: Path) -> None:
    """Measure the requested steps, and write the results into the documents below a root."""
    requested, comparisons = arguments.only, root / COMPARISONS
    for name in (each for each in REPORTS if each in requested):
        measured(name, f"{COMPARE} {REPORTS[name]}", arguments, folder)
        report = (folder / name / "report.md").read_text(encoding="utf-8")
        head = ["report", "search", "measure", "value"]
        replace_report(comparisons / SEARCHES, head, name, searches_of(name, report))
        replace_report(
            comparisons / STATISTICS,
            STATISTICS_COLUMNS.split(","),
            name,
            statistics_of(name, report),
        )
    for name in (each for each in BENCHMARKS if each in requested):
        printed = measured(name, f"-m tests.benchmarks.{BENCHMARKS[name]}", arguments, folder)
        for path, (head, *rows) in zip(STORED.get(name, ()), tables_of(printed), strict=False):
            write_rows(comparisons / path, head, rows)
    for picture, published in PICTURES.items():
        if (folder / picture).exists():
            shutil.copy(folder / picture, comparisons / published)
    for name, (page, overview) in OVERVIEWS.items():
        write_between(root / page, name, markdown(overview(comparisons)))


def main() -> None:
    """Redo all steps, or the named ones."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    every = [*REPORTS, *BENCHMARKS, *WRITERS]
    parser.add_argument(
        "--only", nargs="+", choices=every, default=every, metavar="NAME", help=", ".join(every)
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--build", type=Path, default=ROOT / "build" / "figures", metavar="DIR")
    arguments = parser.parse_args()
    versions = {"python": platform.python_version(), **installed_versions()}
    commit = commit_of_the_code()
    print(
        f"commit {commit}, {', '.join(f'{name} {version}' for name, version in versions.items())}",
        flush=True,
    )
    folder, root = (
        arguments.build.resolve() / f"{commit}{'-quick' if arguments.quick else ''}",
        ROOT,
    )
    folder.mkdir(parents=True, exist_ok=True)
    if arguments.quick:
        root = folder / "copy"
        shutil.copytree(ROOT / "docs", root / "docs", dirs_exist_ok=True)
    redo(arguments, root, folder)
    for name in (each for each in WRITERS if each in arguments.only and not arguments.quick):
        run(WRITERS[name], PAFOT_REFRESH="1")
    print(f"in all {spent():.3f} CPU hours, {os.cpu_count()} cores", flush=True)


if __name__ == "__main__":
    main()
