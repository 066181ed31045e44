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
def test_slow(run): pass
"""


@pytest.mark.parametrize("options", [(), ("--pafot-isolate",)])
def test_limit_ends_a_run_of_slow_decisions_between_two(project, options):
    project.write(SLOW)  # a run takes up to a minute
    begun = time.monotonic()
    result = project.run("--pafot-max-time=1", *options, runs=12)
    assert time.monotonic() - begun < 20
    result.assert_outcomes(failed=1)
    assert "--pafot-max-time" in result.stdout.str()
    assert not project.files
