"""The verdict of the user's function on a run, by who is responsible for its collision."""

import pytest

from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.harness import judge
from tests.helpers.reference_runs import closing, rammed, running_into


def never_collides(run):
    assert not run.collision


def judged(trace, test, blame):
    return judge(Run(trace), test, blame=blame, test_file="").kind


@pytest.mark.parametrize("blame", ["any", "ego"])
def test_blame_leaves_out_only_what_an_npc_alone_answers_for(blame):
    assert judged(running_into(), never_collides, blame) == "failed"
    assert judged(rammed(), never_collides, blame) == ("failed" if blame == "any" else "npc")
    assert judged(closing(), never_collides, blame) == "passed"


def test_errors_count_whoever_is_responsible():
    def misspelt(run):
        return run.colision

    broken = closing(
        outcome=Outcome.ADS_ERROR,
        error=AdsError(kind="KeyError", message="x", traceback="", tick=3),
    )
    assert judged(running_into(), misspelt, "ego") == "failed"
    assert judged(broken, never_collides, "ego") == "failed"
