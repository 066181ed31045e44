"""Redo every figure that the documents publish: reports, tables, samples and pictures.

    python docs/tools/figures.py [--only NAME ...] [--workers 16] [--quick] [--build DIR]

It prints the commit, the versions, and the CPU hours of each step. The results of a step are stored in DIR, in a folder
named after the commit that last changed the code, and are not measured again there. So a step that was interrupted, or
that ran on a different machine, continues if its folder is there. Then the results are written into the documents,
between a line ``<!-- measured: NAME -->`` and a line ``<!-- end of measured -->``. Results without such lines are for
sentences that quote them. The tools that write documents themselves run last; they need Chromium, and the packages that
their heads name.

With ``--quick``, a few short runs are measured to try the command, and written into a copy of the documents in DIR.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import resource
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from pytest_pafot.support.versions import installed_versions  # noqa: E402

COMPARE = "-m pytest_pafot compare --workers WORKERS --out OUT"
EVERY = "--blame ego --algorithms distinct,distinct@paper,pafot,av-fuzzer@15,random,nsga2,map-elites,cma-es"
DEFECT = "--ads example_ads.defects:make:"
REPORTS = {
    "paper": "--algorithms pafot,av-fuzzer@15,av-fuzzer,random-manoeuvre,random@paper --ads idm_mobil "
    "--runs {10|2} --seconds {14400|600}",
    "idm": f"{EVERY},random-manoeuvre --runs {{30|2}} --seconds {{43200|600}} --ads idm_mobil",
    "two-defects": f"{EVERY} --runs {{20|2}} --seconds {{3600|600}} {DEFECT}two-defects",
    "sees-cut-ins-late": f"{EVERY} --runs {{20|2}} --seconds {{3600|600}} {DEFECT}sees-cut-ins-late",
    "ppo": f"{EVERY} --runs {{20|1}} --seconds {{3600|300}} --ads ppo --env highway-v0",
    "fiss": f"{EVERY} --runs {{4|1}} --seconds {{3600|60}} --ads fiss",
}
"""Arguments of the comparisons, by the folder of the report. Of two values in braces, ``--quick`` uses the second."""

DEFAULT_SEARCH = "docs/explanation/default-search.md"

BENCHMARKS: Mapping[str, tuple[str, str | None]] = {
    "paper-collisions": (
        "paper_differences --tables collisions --scenarios {1000|20} --careless {200|2}",
        "docs/comparisons/README.md",
    ),
    "paper-readings": ("paper_differences --tables readings --scenarios {1000|20}", "docs/explanation/paper.md"),
    "planted-defects": (
        "planted_defects --half set-aside --seeds {10|1} --runs {2000|20} --workers WORKERS --save OUT.jsonl "
        "--picture OUT.png",
        "docs/comparisons/planted-defects.md",
    ),
    "planted-junctions": (
        "planted_junctions --first-seed 10 --seeds {10|1} --runs {400|20} --workers WORKERS --save OUT.jsonl",
        "docs/comparisons/planted-defects.md",
    ),
    "junction-control": ("junction_control --runs {2000|20} --workers WORKERS", None),
    "margins": ("margins --seeds {40|1} --runs {240|12} --workers WORKERS", DEFAULT_SEARCH),
    "margins-of-others": (
        "margins --policies OneSpeedNear OneResumes OneCentred --seeds {40|1} --runs {240|12} --workers WORKERS",
        DEFAULT_SEARCH,
    ),
    "collisions": (
        "ablation --tables collisions --runs {20|1} --hours {3|0.1} --workers WORKERS",
        DEFAULT_SEARCH,
    ),
    "failures": (
        "ablation --tables failures --runs {24|1} --hours {6|0.1} --workers WORKERS",
        DEFAULT_SEARCH,
    ),
    "progress": (
        "progress --seeds {20|1} --scenarios {200|20} --redraws {200|5} --workers WORKERS",
        None,
    ),
    "shrinking": ("shrinking --runs {400|30} --workers WORKERS", None),
    "endings": ("endings --runs {2000|100} --workers WORKERS", None),
    "every-road": ("every_road --seeds {5|1} --generations {10|1} --workers WORKERS", None),
    "distinctness": ("distinctness --of second --seeds {10|1} --runs {400|30} --workers WORKERS", None),
    "speed": ("speed --rounds {9|1} --parts {engines ads npcs search batch pure start memory|npcs}", None),
    "training": ("training --seconds {8|1}", "docs/guide/training.md"),
    "positive-controls": (
        "positive_controls --first-seed 200 --seeds {3|1} --runs {400|30} --workers WORKERS",
        None,
    ),
    "negative-control": ("negative_control --seeds {10|1} --runs {400|8} --workers WORKERS", None),
}
"""Arguments of the programs in tests/benchmarks, and the document with their tables."""

WRITERS = {
    "reference": "docs/tools/generate.py",
    "gallery": "docs/tools/gallery.py",
    "samples": "-m pytest -q -p no:cacheprovider tests/test_docs.py -m stories",
    "terminal": "docs/tools/picture.py",
    "pages": "docs/tools/report_picture.py",
    "roads": "docs/tools/road_pictures.py",
}
"""Commands that write documents themselves."""

SUMMARY = {
    "unique scenarios that collide": ("How many collisions", "share of unique"),
    "simulated time per scenario": ("How fast", "simulated per scenario"),
    "simulated time per collision": ("How fast", "simulated per collision"),
    "time to a collision, where there is one": ("How fast", "time to collision (max / min)"),
    "wall clock per scenario": ("How fast", "wall clock per scenario"),
    "collisions that an NPC alone is responsible for": ("Who caused them", "share of NPCs"),
    "inverted distance to all impacts": ("Distinct failures for which the ego answers", "inverted distance"),
}
"""Rows of the paper's comparison in the overview: heading of its table in the report, and the column's first words."""

CELLS = re.compile(r"(?<=\|) ([^|]*) (?=\|)")


def columns(report: str, heading: str) -> dict[str, dict[str, str]]:
    """Return the cells of each row in a table of a report, by column; ``paper`` gets the name of the column before."""
    lines = re.findall(r"^\|.*$", report.partition(f"\n## {heading}\n")[2].partition("\n## ")[0], re.MULTILINE)
    head, _, *rows = [CELLS.findall(line) for line in lines]
    names = [f"{before}, paper" if name == "paper" else name for before, name in zip(["", *head], head, strict=False)]
    return {row[0]: dict(zip(names, row, strict=True)) for row in rows}


def overview_of_the_paper(reports: Mapping[str, str]) -> Iterator[list[str]]:
    """Yield the rows of the paper's measures by algorithm, each with the paper's own values below it."""
    algorithms = list(columns(reports["paper"], "How fast"))
    yield ["", *algorithms]
    for measure, (heading, beginning) in SUMMARY.items():
        table = columns(reports["paper"], heading)
        name = next(each for each in table[algorithms[0]] if each.startswith(beginning))
        yield [measure, *(table[each][name] for each in algorithms)]
        if f"{name}, paper" in table[algorithms[0]]:
            yield ["the paper's", *(table[each][f"{name}, paper"] for each in algorithms)]


def overview_of_failures(reports: Mapping[str, str]) -> Iterator[list[str]]:
    """Yield rows of distinct failures per simulated hour by algorithm and report, with the runs that had any."""
    tables = {
        name: columns(text, "Distinct failures for which the ego answers")
        for name, text in reports.items()
        if name != "paper"
    }
    yield ["search", *(f"[{name}]({name}/report.md)" for name in tables)]
    for algorithm in dict.fromkeys(each for table in tables.values() for each in table):
        cells = []
        for table in tables.values():
            found = list(table.get(algorithm, {}).items())
            at = [value for name, value in found if name.startswith(("per hour, ", "runs with any"))]
            cells.append("{} ({})".format(*at) if at else "")
        yield [algorithm, *cells]


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
        command = command.replace("WORKERS", str(arguments.workers)).replace("OUT", os.path.relpath(out, ROOT))
        before = spent()
        printed = run(command)
        stored.write_text(f"{printed}\n{name}: {spent() - before:.3f} CPU hours\n", encoding="utf-8")
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
        raise SystemExit(f"expected the command to end well, received exit status {done.returncode}:\n{done.stdout}")
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
    changed, count = marked.subn(lambda found: f"{found[1]}{text}{found[2]}", document.read_text(encoding="utf-8"))
    if count != 1:
        raise SystemExit(f"{document}: expected one line <!-- measured: {name} -->, found {count}")
    document.write_text(changed, encoding="utf-8", newline="\n")


def commit_of_the_code() -> str:
    """Return the commit that last changed the code, by git; ``unknown`` without git."""
    command = ["git", "log", "-1", "--format=%h", "--", "pytest_pafot", "example_ads", "tests/benchmarks"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S603
    return done.stdout.strip() or "unknown"


def redo(arguments: argparse.Namespace, root: Path, folder: Path) -> None:
    """Measure the requested steps, and write the results into the documents below a root."""
    requested = arguments.only
    for name in (each for each in REPORTS if each in requested):
        measured(name, f"{COMPARE} {REPORTS[name]}", arguments, folder)
        report = root / "docs" / "comparisons" / name
        text = (folder / name / "report.md").read_text(encoding="utf-8")
        text = text.replace(os.path.relpath(folder / name, ROOT), f"comparisons/{name}")
        (report / "report.md").write_text(text, encoding="utf-8", newline="\n")
        for picture in (folder / name / "figures").glob("*.png"):
            shutil.copy(picture, report / "figures")
    for name in (each for each in BENCHMARKS if each in requested):
        command, document = BENCHMARKS[name]
        printed = measured(name, f"-m tests.benchmarks.{command}", arguments, folder)
        if document is not None:
            tables = re.findall(r"(?:^\|.*\n)+", f"{printed}\n", re.MULTILINE)
            write_between(root / document, name, "\n".join(tables))
            for picture in folder.glob(f"{name}*.png"):
                shutil.copy(picture, (root / document).parent)
    if set(requested) & set(REPORTS):
        reports = {name: (root / f"docs/comparisons/{name}/report.md").read_text(encoding="utf-8") for name in REPORTS}
        overview = root / "docs" / "comparisons" / "README.md"
        write_between(overview, "overview-of-the-paper", markdown(overview_of_the_paper(reports)))
        write_between(overview, "overview-of-failures", markdown(overview_of_failures(reports)))


def main() -> None:
    """Redo all steps, or the named ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    every = [*REPORTS, *BENCHMARKS, *WRITERS]
    parser.add_argument("--only", nargs="+", choices=every, default=every, metavar="NAME", help=", ".join(every))
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--build", type=Path, default=ROOT / "build" / "figures", metavar="DIR")
    arguments = parser.parse_args()
    versions = {"python": platform.python_version(), **installed_versions()}
    commit = commit_of_the_code()
    print(f"commit {commit}, {', '.join(f'{name} {version}' for name, version in versions.items())}", flush=True)
    folder, root = arguments.build.resolve() / f"{commit}{'-quick' if arguments.quick else ''}", ROOT
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
