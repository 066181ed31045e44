"""The verdict of the user's function on a run, and on reference drivers in the ego's place."""

from pytest_pafot.campaign.harness import judge, reference_outcomes
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.oracle.run import Rejected, Run
from tests.helpers.reference_runs import Drivers, closing, rammed, running_into
from tests.helpers.tables import table

DRIVERS = {"far": closing(ticks=3), "near": closing(), "unlucky": rammed(), "blind": running_into()}


def keeps_apart(run):
    assert run.min_distance > 15.0


def never_collides(run):
    assert not run.collision


def judged(trace, test, blame, **drivers):
    """Return the kind of a verdict, and the reference drivers that it called."""
    world = Drivers(**drivers)
    return judge(Run(trace, world=world), test, blame=blame, test_file="").kind, world.asked


@table("blame", ["any", "ego", "preventable"])
def test_reference_drivers_are_evaluated_like_the_ego(blame):
    run = Run(closing(), world=Drivers(**DRIVERS, cut=closing(outcome=Outcome.INVALID)))
    told = dict(reference_outcomes(run, keeps_apart, blame=blame, test_file=""))
    assert told == {"far": "avoids", "near": "fails", "unlucky": "hit", "blind": "at-fault"}


def test_driver_without_verdict_of_function_is_left_out():
    def judges_long_runs(run):
        if run.duration < 1:
            raise Rejected
        never_collides(run)

    told = reference_outcomes(Run(closing(), world=Drivers(**DRIVERS)), judges_long_runs, blame="any", test_file="")
    assert dict(told) == {"near": "avoids", "unlucky": "hit", "blind": "at-fault"}


def test_collision_that_the_function_allows_counts_as_avoided():
    def stays_on_the_road(run):
        assert not run.off_road

    run = Run(closing(off_road_tick=9), world=Drivers(**DRIVERS))
    told = dict(reference_outcomes(run, stays_on_the_road, blame="any", test_file=""))
    assert told == dict.fromkeys(DRIVERS, "avoids")
    assert dict(reference_outcomes(run, stays_on_the_road, blame="ego", test_file=""))["unlucky"] == "hit"


def test_failure_is_preventable_if_one_driver_is_faultless():
    assert judged(running_into(), never_collides, "preventable", blind=running_into())[0] == "unpreventable"
    assert judged(running_into(), never_collides, "preventable", unlucky=rammed())[0] == "failed"
    assert judged(running_into(), never_collides, "preventable", calm=closing())[0] == "failed"
    assert judged(running_into(), never_collides, "ego", blind=running_into())[0] == "failed"


def test_driver_prevents_other_failure_only_if_property_holds():
    assert judged(closing(), keeps_apart, "preventable", near=closing(), unlucky=rammed())[0] == "unpreventable"
    assert judged(closing(), keeps_apart, "preventable", far=closing(ticks=3))[0] == "failed"


def test_reference_drivers_run_only_for_possible_findings():
    drivers = {"blind": running_into(), "calm": closing(), "idle": closing()}
    assert judged(closing(), never_collides, "preventable", **drivers) == ("passed", [])
    assert judged(rammed(), never_collides, "preventable", **drivers) == ("npc", [])
    assert judged(running_into(), never_collides, "ego", **drivers) == ("failed", [])
    assert judged(running_into(), never_collides, "preventable", **drivers) == ("failed", ["blind", "calm"])


def test_errors_count_whatever_the_reference_drivers_do():
    def misspelt(run):
        return run.colision

    broken = closing(outcome=Outcome.ADS_ERROR, error=AdsError(kind="KeyError", message="x", traceback="", tick=3))
    assert judged(running_into(), misspelt, "preventable", blind=running_into()) == ("failed", [])
    assert judged(broken, never_collides, "preventable", blind=running_into()) == ("failed", [])
