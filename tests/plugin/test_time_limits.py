"""The limit of the time of each search."""

import time

import pytest

pytestmark = pytest.mark.processes

SLOW = """
import time

def slow(observation):
    time.sleep(0.2)
    return 0.0, 0.0

@pafot.search(ads=lambda: slow)
def test_slow(run):
    pass
"""


def test_limit_ends_a_run_of_slow_decisions_between_two(project):
    project.write(SLOW)  # a run takes up to a minute
    begun = time.monotonic()
    result = project.run("--pafot-max-time=1", runs=12)
    assert time.monotonic() - begun < 15
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["  0 runs in *", "*ended: --pafot-max-time", "*no scenario was simulated*"])
    assert not project.files


def test_limit_ends_a_run_in_an_isolated_process(project):
    project.write(SLOW)
    begun = time.monotonic()
    result = project.run("--pafot-max-time=1", "--pafot-isolate", runs=12)
    assert time.monotonic() - begun < 20
    result.stdout.fnmatch_lines(["  0 runs in *", "*ended: --pafot-max-time"])
    assert not project.files
