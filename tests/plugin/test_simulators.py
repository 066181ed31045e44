"""Sessions with a simulator of the user's: each one that was made is closed once, in whatever process and way."""

import sys

import pytest

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone"),
]

CONFTEST = """
import contextlib
import os
import signal
import time

import pytest_pafot as pafot

SESSION = os.getpid()


class Placing(pafot.Simulator):
    def __init__(self):
        open(f"made-{os.getpid()}-{id(self)}", "x").close()

    def start(self, vehicles, seed):
        self.cars = vehicles

    def step(self, controls):
        self.cars = controls

    def states(self):
        return [(each.x, each.y, each.heading, each.speed) for each in self.cars]

    def close(self):
        open(f"closed-{os.getpid()}-{id(self)}", "x").close()  # an error if it is there
        CLOSE


def planner():
    def decide(seen):
        time.sleep(0.0005)
        if seen.time > 5.0 and len([each for each in os.listdir() if each.startswith("made")]) >= MADE:
            with contextlib.suppress(FileExistsError):
                open("interrupted", "x").close()  # a second interrupt would end the session at once
                os.kill(SESSION, signal.SIGINT)
        return 0.0, 0.0

    return decide
"""
SEARCH = """
from conftest import Placing, planner

@pafot.search(ads=planner, world=pafot.SimulatorWorld(Placing, duration=10.0), runs=8)
def test_anything(run):
    assert run.duration > 0
"""
WORKERS = "--pafot-workers=2"


def session(project, *options, made=99, close="pass"):
    """Return the result of a session, and which simulators were made and closed in it: of what process."""
    project.pytester.makeconftest(CONFTEST.replace("MADE", str(made)).replace("CLOSE", close))
    project.write(SEARCH)
    result = project.run(*options, runs=None, apart=True)
    made, closed = (
        sorted(each.name.partition("-")[2] for each in project.path.glob(f"{what}-*"))
        for what in ("made", "closed")
    )
    return result, made, closed


ENDS, INTERRUPTED = pytest.ExitCode.OK, pytest.ExitCode.INTERRUPTED


@pytest.mark.parametrize(("options", "processes", "code"), [
    *[((), 1, each) for each in (ENDS, INTERRUPTED)],
    *[((WORKERS,), 3, each) for each in (ENDS, INTERRUPTED)],
    (("--pafot-isolate", WORKERS), 3, ENDS),
    (("--pafot-isolate",), 2, INTERRUPTED),
    (("-n1",), 1, ENDS),
])  # fmt: skip
def test_each_simulator_is_closed_once_at_the_end_or_after_an_interrupt(
    project, options, processes, code
):
    result, made, closed = session(project, *options, made=processes if code == INTERRUPTED else 99)
    assert result.ret == code
    assert (len(made), closed) == (processes, made)


@pytest.mark.parametrize("options", [(), (WORKERS,)])
def test_close_that_raises_stays_a_warning_where_warnings_are_errors(project, options):
    result, made, closed = session(
        project, "-Werror", "--junitxml=results.xml", *options, close="raise OSError('no')"
    )
    assert result.ret == 0
    assert (len(made), closed) == (3 if options else 1, made)
    result.stdout.fnmatch_lines(["*RuntimeWarning: Placing.close: *OSError: no*"])
    result.assert_outcomes(passed=1, warnings=len(made))
    assert 'errors="0"' in (project.path / "results.xml").read_text("utf-8")
