import os
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from pytest_pafot.findings.finding import (
    ENOUGH,
    RUNS,
    Expect,
    Finding,
    Found,
    ads_failure,
    portable,
    raised_failure,
    signature_of_failure,
    with_other_seed,
)
from pytest_pafot.findings.situation import Situation
from pytest_pafot.findings.verdict import Failure, normalised
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import MAX_SEED
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.oracle.run import Run
from tests.findings.builders import plain_finding
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle

FOUND = Found(seed=1, generation=0, algorithm="pafot", versions={"numpy": "2.4.6"})
COLLIDES = Failure(
    kind="AssertionError",
    message="long\nstory",
    assertion="assert not run.collision, run.explain()",
)


def run_of(ticks=30, **fields):
    ego, npc = (
        vehicle(0.0, 4.0, speed=20.0, ticks=ticks),
        vehicle(26.0, 4.0, speed=10.0, ticks=ticks),
    )
    return Run(trace_of(ego, npc, **fields))


def broken_ads(traceback="Traceback ...\n"):
    error = AdsError(kind="ValueError", message="no path\nfor 3 cars", traceback=traceback, tick=6)
    return run_of(outcome=Outcome.ADS_ERROR, error=error)


def test_new_finding_is_named_by_signature_and_scenario():
    run = run_of(outcome=Outcome.COLLISION)
    finding = Finding.from_run(
        run, COLLIDES, test="t.py::test_it", world={"kind": "highway"}, found=FOUND
    )
    assert finding.id == f"leader-unanswered-{run.scenario.id}"
    assert finding.scenario == run.scenario
    assert finding.signature == signature_of_failure(run, COLLIDES)
    assert finding.xfail is None


def test_it_expects_what_the_run_showed():
    run = run_of(outcome=Outcome.COLLISION)
    expect = Expect.from_run(run, COLLIDES, takeover=0.75)
    assert expect == Expect(
        failure="AssertionError",
        assertion="not run.collision",
        outcome=Outcome.COLLISION,
        time=2.0,
        npc=0,
        cell=Cell.FRONT,
        side="front",
        closing_speed=10.0,
        situation=Situation(
            npc=0,
            time=0.0,
            gap=21.0,
            place="ahead",
            lanes_to_right=0,
            ego_speed=20.0,
            npc_speed=10.0,
        ),
        responsibility="ego",
        fault="leader-unanswered",
        npc_manoeuvre="lane-keeping",
        ego_manoeuvre="lane-keeping",
        takeover=0.75,
    )
    *told, responsible = run.sentences
    careful = "A careful driver who took control 0.75 s before the impact would have avoided it."
    assert expect.sentences_on(run) == (*told, f"{responsible} {careful}")
    for changed in ({"time": 1.9}, {"takeover": None}):  # of another collision, or unknown
        assert replace(expect, **changed).sentences_on(run) == run.sentences


def test_message_is_saved_if_no_assertion_says_it():
    expect = Expect.from_run(run_of(), Failure(kind="Failed", message="\n  too close: 0.3 m\nmore"))
    assert (expect.message, expect.assertion) == ("too close: 0.3 m", "too close: N m")


@table(("text", "kept"), [
    ("<Car object at 0x7f12ab34cd56>", "<Car object at ADDRESS>"),
    ("error 0x80004005, mask 0x1F", "error 0x80004005, mask 0x1F"),
    ("process id 77 (pid 1234, PID=12)", "process id N (pid N, PID=N)"),
    ("<Thread(Worker-3, started daemon 140211)>", "<Thread(Worker-3, started daemon N)>"),
    ("restarted 3 times by planner 7", "restarted 3 times by planner 7"),
    ("no file '/tmp/tmpab12cd34/model.bin'", "no file 'TMP/model.bin'"),
    ("/tmp/pytest-of-me/pytest-12/test_x0/a.csv: gone", "TMP/a.csv: gone"),
    ("/scratch/me/tmpab12cd34/a.csv", "/scratch/me/tmp/a.csv"),
    (r"C:\Users\me\AppData\Local\Temp\tmpab12cd34\a.csv", "TMP/a.csv"),
    ("https://example.org/tmp/abc, a/tmp/b, 3/4", "https://example.org/tmp/abc, a/tmp/b, 3/4"),
    ('File "/home/me/planner/ads/plan.py", line 3', 'File "ads/plan.py", line 3'),
    ('File "/opt/venv/lib/python3.11/site-packages/numpy/x.py"', 'File "site-packages/numpy/x.py"'),
])  # fmt: skip
@pytest.mark.skipif(
    os.name == "nt", reason="the folder of the project is written as on other systems"
)
def test_texts_contain_nothing_that_changes_between_runs(text, kept):
    assert portable(text, "/home/me/planner") == kept
    run = broken_ads(f"Traceback\n  {text}\n")
    failure = replace(ads_failure(run), message=text)
    expect = Expect.from_run(run, failure, root="/home/me/planner")
    assert (expect.message, expect.traceback) == (kept, f"Traceback\n  {kept}\n")


def test_a_huge_text_takes_no_time():
    failure = Failure(kind="ValueError", message="/a" * 500_000, traceback="/a" * 500_000)
    assert len(Expect.from_run(broken_ads(), failure).message) == 300


def test_ads_traceback_is_saved_without_a_long_beginning():
    run = broken_ads("".join(f"line {number}\n" for number in range(5000)))
    expect = Expect.from_run(run, ads_failure(run))
    assert (expect.failure, expect.message, expect.time) == ("ValueError", "no path", 0.4)
    assert expect.traceback.startswith("...\nline ")
    assert expect.traceback.endswith("line 4999\n")
    assert len(expect.traceback) < 8100


@table("name", ["", "a/b", "a b", "..", "a.", "-a", "a\n", "é", "a" * 121, "a[1]"])
def test_id_must_fit_into_file_names(name):
    with pytest.raises(ValueError, match="id: expected"):
        plain_finding(id=name)


def test_failure_is_accepted_until_its_last_day():
    day, next_day = date(2027, 1, 31), date(2027, 2, 1)
    finding = plain_finding(xfail="issue 12", xfail_until=day)
    assert (finding.is_accepted(day), finding.is_accepted(next_day)) == (True, False)
    assert not plain_finding().is_accepted(day)


@table(("value", "place"), [
    (float("nan"), "world.a"),
    (np.int64(3), "world.a"),
    ((1, 2), "world.a"),
    ([1, {"b": object()}], r"world.a\[1\].b"),
    ({1: 2}, "world.a"),
    ({"k" * 65: 2}, "world.a"),
])  # fmt: skip
def test_a_world_must_be_plain_data(value, place):
    with pytest.raises(ValueError, match=f"^{place}: expected"):
        plain_finding(world={"a": value})


def test_a_world_that_holds_itself_is_refused():
    world = {}
    world["self"] = world
    with pytest.raises(ValueError, match="levels of nesting"):
        plain_finding(world=world)


def check(run):
    assert run.min_ttc > 1.0, "too close"


def caught(function, run=None):
    with pytest.raises(Exception) as info:  # noqa: PT011
        function(run)
    return raised_failure(info.value, __file__)


class Stub:
    min_ttc = 0.3


def test_a_failing_assertion_is_known_by_its_source():
    failure = caught(check, Stub)
    assert failure.kind == "AssertionError"
    assert "too close" in failure.message
    assert normalised(failure.assertion) == "run.min_ttc > N"


def over_several_lines(run):
    assert (
        run.min_ttc  # seconds
        > 1.0
    )


def of_a_library(_run):
    np.testing.assert_allclose([1.0], [2.0])


def of_python(_run):
    int("x")


# fmt: off
def behind_other_code(run):
    if run.min_ttc: assert run.min_ttc > 1.0  # noqa: E701
# fmt: on


@table(("function", "source"), [
    (over_several_lines, "run.min_ttc > N"),
    (behind_other_code, "run.min_ttc > N"),
    (of_a_library, "np.testing.assert_allclose([N], [N])"),
    (of_python, "int('x')"),
])  # fmt: skip
def test_failure_is_identified_by_the_source_of_its_line(function, source):
    assert normalised(caught(function, Stub).assertion) == source


def test_assertion_in_helper_is_identified_by_its_source():
    namespace = {}
    exec(
        compile("def helper(run):\n    assert run.ok\n", "helper_without_source.py", "exec"),
        namespace,
    )
    through_helper = caught(lambda run: [namespace["helper"](run)], type("R", (), {"ok": False}))
    assert "helper" in through_helper.assertion
    assert normalised(caught(lambda run: [check(run)], Stub).assertion) == "run.min_ttc > N"


def test_an_exception_without_a_traceback_has_its_message():
    assert raised_failure(ValueError("no path"), __file__) == Failure(
        kind="ValueError", message="no path"
    )


def test_finding_repr_contains_no_ci_commands():
    shown = repr(
        plain_finding(test="test_a.py::test_it", flaky="x\n::error::\x1b[31m ##vso[task.complete]")
    )
    assert shown.isprintable()
    assert "##vso[" not in shown


def test_runs_without_a_failure_are_hardly_luck_if_enough_failed_before():
    assert (1 - ENOUGH / RUNS) ** RUNS < 0.05


def test_other_seeds_change_only_the_seed():
    scenario = plain_finding().scenario
    assert with_other_seed(scenario, 0) == scenario
    for number, seed in ((1, scenario.seed + 1), (MAX_SEED, scenario.seed - 1)):
        assert with_other_seed(scenario, number) == replace(scenario, seed=seed)
