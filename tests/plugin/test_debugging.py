"""``--pafot-debug``: the debugger in the decision of a replay that could have avoided the failure."""

import subprocess
import sys

import pytest

KEEPS = """
class Keeps:
    def __call__(self, seen):
        acceleration = 0.0
        return acceleration, 0.0

@pafot.search(ads=Keeps, npcs=1, genes=1, gene_seconds=20, ego_speed=22, instructions="cells")  # stop_after=1
def test_collides(run):
    assert not run.collision
"""


@pytest.fixture
def found(project):
    """Return a function that replays a finding with the debugger, and what is typed into it."""
    project.write(KEEPS)
    project.run(runs=40, seed=2)
    (file,) = project.contents

    def replay(typed, *options):
        command = [sys.executable, "-m", "pytest", "-p", "pafot", file, "--pafot-debug", *options]
        ended = subprocess.run(
            command, cwd=project.path, input=typed, capture_output=True, text=True, check=False
        )
        return ended.returncode, ended.stdout

    return replay


@pytest.mark.parametrize("options", [(), ("--pafot-isolate",)])
def test_one_step_leads_into_the_policy(found, options):
    code, output = found("s\nn\nn\np 'time', round(seen.time, 1), acceleration\nc\n", *options)
    header = next(line for line in output.splitlines() if "pafot: decision" in line)
    at = float(header.partition(" at ")[2].partition(" s:")[0])
    assert "NPC 0 is" in header
    assert f"('time', {at}, 0.0)" in output
    assert ": still failing." in output
    assert code == pytest.ExitCode.TESTS_FAILED


def test_a_scenario_that_passes_has_no_debugger(found, project):
    project.write(KEEPS.replace("acceleration = 0.0", "acceleration = -6.0"))
    code, output = found("")
    assert "pafot: decision" not in output
    assert code == pytest.ExitCode.OK


def test_a_worker_has_no_debugger(found):
    code, output = found("", "-n1", "-p", "xdist")
    assert "--pafot-debug: " in output
    assert code == pytest.ExitCode.TESTS_FAILED


def test_leaving_the_debugger_ends_the_session(found):
    code, output = found("q\n")
    assert "Quitting debugger" in output
    assert code == pytest.ExitCode.INTERRUPTED
