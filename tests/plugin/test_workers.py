"""The option `workers`: several processes, the same search."""

import json
import re
import sys

import pytest

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone"),
]

IN_USE = "*note: --pafot-workers=2: in use after 1 run of this process*"

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
@pafot.search(genes=2, gene_seconds=4, shrink_rollouts=0, npcs=2, ego_lane=1, ego_speed=22, vehicles="car")
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
    return [rule.sub("", re.sub(r"\d+\.\d+ ?s\b|0x[0-9a-f]+|pid \d+", "...", line)) for line in lines]


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
        result = project.run(f"--pafot-workers={workers}", "-p", "no:cacheprovider", "--pafot-json=out.json", runs=36)
        (search,) = json.loads((project.path / "out.json").read_text())["searches"]
        new = {path: path.read_text() for path in project.path.rglob("*.pafot.yaml") if path != accepted}
        told.append((search["known"], search["finds"], search["failures"], new))
        result.stdout.fnmatch_lines(["  note: * is worse than saved-*: no run hit faster than * m/s when it*"])
        for path in new:
            path.unlink()
    assert told[0] == told[1]
    assert len(told[0][1]) == 1
