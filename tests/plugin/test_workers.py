"""The option `workers`: several processes, the same search."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.model.trace import Outcome
from tests.helpers.processes import begun

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone"),
]

IN_USE = "*note: --pafot-workers=2: *"

DEAR = """
import os
import time

import pytest

SESSION = os.getpid()

def in_worker():
    return os.getpid() != SESSION

@pytest.fixture
def ads():
    def make():
        time.sleep(0.015)
        return DRIVE
    return make

def keep(observation):
    return 0.0, 0.0
"""

MANY = """
@pafot.search(genes=2, gene_seconds=4, shrink_runs=0, npcs=2, ego_lane=1, ego_speed=22, vehicles="car")
def test_many(run):
    assert not run.collision
    assert run.min_distance > 1.9
"""


@pytest.fixture
def dear(project):
    """Return a function that writes a project with some source text, whose ADS is slow enough for workers."""

    def write(drive="keep", more="", test=MANY):
        project.pytester.makeconftest(DEAR.replace("DRIVE", drive) + more)
        project.write(test)
        return project

    return write


def summary(result):
    """Return a session's output without times, process ids, progress, and the note about workers."""
    depends = re.compile(r"pafot-workers| \d+/s$").search
    lines = [line for line in result.stdout.lines if not depends(line)]
    rule = re.compile(r"(?<= )=+$|^=+(?= )")  # the rule is shorter if a time has more digits
    return [
        rule.sub("", re.sub(r"\d+\.\d+ ?s\b|0x[0-9a-f]+|pid \d+", "...", line)) for line in lines
    ]


def session(project, workers, *args, **options):
    """Run a session that begins without saved scenarios; return it and what it saved."""
    project.forget()
    result = project.run(f"--pafot-workers={workers}", "-p", "no:cacheprovider", *args, **options)
    return result, project.contents


def test_number_of_workers_does_not_change_the_results(dear):
    project = dear()
    alone, contents = session(project, 1, "--pafot-json=out.json", runs=12)
    record = (project.path / "out.json").read_text()
    assert len(contents) > 1
    for workers in (2, 3):
        several, same = session(project, workers, "--pafot-json=out.json", runs=12)
        assert (project.path / "out.json").read_text() == record
        several.stdout.fnmatch_lines([IN_USE.replace("2", str(workers))])
        assert same == contents
        assert summary(several) == summary(alone)


def test_number_of_workers_does_not_change_what_is_worse_than_accepted(dear):
    ego_only = MANY.replace("gene_seconds=4", "gene_seconds=4, blame='ego'").replace(
        "    assert run.min_distance > 1.9\n", ""
    )
    project = dear(test=ego_only)
    project.run("--pafot-workers=1", "-p", "no:cacheprovider", runs=12)
    project.accept()
    accepted, told = project.only_file, []
    for workers in (1, 2):
        result = project.run(
            f"--pafot-workers={workers}", "-p", "no:cacheprovider", "--pafot-json=out.json", runs=36
        )
        (search,) = json.loads((project.path / "out.json").read_text())["searches"]
        new = {
            path: path.read_text()
            for path in project.path.rglob("*.pafot.yaml")
            if path != accepted
        }
        told.append((search["known"], search["finds"], search["failures"], new))
        result.stdout.fnmatch_lines(["  note: * saved-* m/s"])
        for path in new:
            path.unlink()
    assert told[0] == told[1]
    assert len(told[0][1]) == 1


@pytest.mark.parametrize("capture", ["fd", "sys"])
def test_what_the_ads_prints_is_captured_as_ever(dear, capture):
    project = dear(
        "chatty",
        "def chatty(observation):\n    print('at', observation.time)\n    return 0.0, 0.0\n",
    )
    printed = []
    for workers in (1, 2):
        result, _ = session(project, workers, "-v", f"--capture={capture}", runs=8)
        printed.append([line for line in result.stdout.lines if line.startswith("at ")])
    assert len(printed[0]) > 100
    assert printed[0] == printed[1]


def test_an_ads_that_raises_is_the_same_finding(dear):
    more = (
        "def fails(observation):\n    if observation.time > 3:\n        raise "
        "KeyError('lane')\n    return 0.0, 0.0\n"
    )
    project = dear("fails", more)
    _, contents = session(project, 1, runs=8)
    several, same = session(project, 2, runs=8)
    several.stdout.fnmatch_lines([IN_USE])
    assert same == contents
    assert any("ads-error-" in name for name in contents)


@pytest.mark.parametrize(("drive", "test"), [
    ("keep if not in_worker() else 1 / 0", MANY), ("keep", MANY.replace("npcs=2", "fitness=lambda trace: 'high'")),
], ids=["factory", "fitness"])  # fmt: skip
def test_errors_outside_the_ads_are_as_without_workers(dear, drive, test):
    project = dear(drive, test=test)
    alone, contents = session(project, 1, runs=8)
    several, same = session(project, 2, runs=8)
    assert same == contents
    assert summary(several) == summary(alone)


DIES = """
def dies(observation):
    ego, other = observation.ego, observation.others[0]
    if in_worker() and observation.time == 1 and other.lane == ego.lane:
        os._exit(9)
    return 0.0, 0.0
"""


IMPATIENT = """
@pytest.fixture
def pafot_world():
    from pytest_pafot import Highway

    return Highway(hang_limit=0.1)
"""


def test_worker_death_is_a_finding_and_search_continues(dear):
    project = dear("dies", DIES)
    result, contents = session(project, 2, runs=16)
    (crash,) = [name for name in contents if "crash-" in name]
    finding = load(project.path / crash)
    assert finding.expect.message.endswith(" exit code 9")
    assert finding.found.generation > 0
    assert [name for name in contents if "crash-" not in name]
    result.assert_outcomes(failed=1 + len(contents))
    assert " of 16 " in result.stdout.str()
    assert "During handling" not in result.stdout.str()
    assert not project.records


def test_a_worker_whose_decision_hangs_interrupts_it(dear):
    hangs = DIES.replace("def dies", "def hangs").replace("os._exit(9)", "time.sleep(60)")
    project = dear("hangs", hangs + IMPATIENT)
    result, contents = session(project, 2, runs=16)
    finding = next(load(project.path / name) for name in contents if "hang-" in name)
    assert finding.expect.outcome is Outcome.HANG
    result.stdout.fnmatch_lines(["*: Hang: *"])


def test_keyboard_interrupt_ends_all_processes_without_losing_findings(dear):
    more = """
def noting(observation):
    open(f"pid-{os.getpid()}", "w").close()
    time.sleep(0.002)
    return 0.0, 0.0
"""
    project = dear("noting", more, test=MANY)
    options = ["-p", "pafot", "--pafot-generations=999", "--pafot-seed=1"]
    command = [sys.executable, "-m", "pytest", *options]
    one = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with begun([*command, "--pafot-workers=2"], cwd=project.path, text=True, **one) as process:
        found = next(line for line in process.stdout if line.startswith("pafot: found ")).split()[
            -1
        ]
        while len(list(project.path.glob("pid-*"))) < 3:
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        rest = process.stdout.read()
    assert process.returncode == pytest.ExitCode.INTERRUPTED
    assert "Traceback" not in rest
    id_ = found.partition("saved-")[2].removesuffix("]")
    assert f"pafot_corpus/test_it/test_many/{id_}.pafot.yaml" in project.files
    assert f"FAILED {found}" in rest
    with pytest.raises(ProcessLookupError):  # No process of its group is left.
        os.killpg(process.pid, 0)
    assert not project.records


def test_xdist_allows_one_process_for_each_search(dear):
    pytest.importorskip("xdist")
    project = dear(test=MANY + MANY.replace("test_many", "test_more"))
    _, contents = session(project, 1, runs=8)
    result, same = session(project, 2, "-n1", runs=8)
    assert same == contents
    text = result.stdout.str()
    assert text.count("--pafot-workers is 1 ") == 1
    assert "--pafot-workers=2:" not in text
