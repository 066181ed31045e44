"""Marked functions: which are allowed, and what happens to what they raise."""

import pytest

from pytest_pafot.corpus.reader import load

CHECK = """
failures = []

def is_true(x):
    x or failures.append(x)

def any_failures():
    return bool(failures)
"""
"""A module that collects failures, as pytest-check does."""


def test_policy_may_be_named_with_its_argument_and_recorder_of_warnings_holds_those_of_one_run(
    project,
):
    named = "class Planner:\n    def __init__(self, text):\n        assert text == 'a:b'\n"
    named += "    def __call__(self, observation):\n        return 0.0, 0.0\n"
    project.pytester.makepyfile(named=named, pytest_check=CHECK)
    project.write("""
import warnings
import pytest_check

@pafot.search(SHORT, ads='named:Planner:a:b')
def test_search(run):
    pytest_check.is_true(run.duration > 0)

@pafot.search(SHORT)
def test_x(run, recwarn):
    warnings.warn(run.scenario.id)
    assert [str(each.message) for each in recwarn] == [run.scenario.id]
""")
    project.run("-opythonpath=.").assert_outcomes(passed=2)


def test_the_decorator_works_bare_called_with_a_name_and_on_classes(project):
    project.write("""
@pafot.search()
def test_called(run):
    assert run.duration > 0

@pafot.search(SHORT)
def test_by_keyword(*, run):
    assert run.duration > 0

@pafot.search(runs=4)
class TestClass:
    def test_method(self, run):
        assert run.duration > 0

    @pafot.search(SHORT)
    def test_own_arguments(self, run):
        assert run.scenario.genes == 2
""")
    project.run().assert_outcomes(passed=4)


def test_a_method_has_its_own_files(project):
    project.write("""
class TestClass:
    @pafot.search(SHORT)  # stop_after=1
    def test_fails(self, run):
        assert not run
""")
    project.run().assert_outcomes(failed=2)
    assert "TestClass.test_fails" in project.files[0]
    name = f"test_it.py::TestClass::test_fails[saved-{project.only_id}] FAILED"
    assert name in project.run("-v", runs=0).stdout.str()


def test_xfail_in_the_test_function_hides_no_failure(saved):
    saved.write(
        "@pafot.search(SHORT)\ndef test_fails(run):\n    run.ads_error or pytest.xfail('issue 12')\n"
    )
    saved.run().assert_outcomes(failed=2)


def test_skip_inside_a_scenario_does_not_hide_finds(project):
    project.write("""
seen = {}

@pafot.search(SHORT)
def test_skips_later(run):
    if seen.setdefault(run.scenario.id, len(seen)) > 1:
        pytest.skip("no more")
    assert run.scenario.id == ""
""")
    result = project.run("-v")
    assert result.parseoutcomes()["failed"] == 1 + len(project.files)
    assert project.files
    assert "(2 skipped)" in result.stdout.str()


@pytest.mark.parametrize(
    "skip", ["pytest.skip('not today')", "raise unittest.SkipTest('not today')"]
)
def test_skipping_every_scenario_skips_the_test(project, skip):
    project.write(f"import unittest\n\n@pafot.search(SHORT)\ndef test_skips(run):\n    {skip}\n")
    project.run().assert_outcomes(skipped=1)
    assert project.files == []


def test_any_other_exception_of_test_function_is_finding(project):
    raised = ["GeneratorExit", "Panic('lost')", "Mute", "MuteAndExits"]
    classes = """
class Panic(BaseException): pass

class Mute(Exception):
    def __str__(self):
        raise RuntimeError("no words")

class MuteAndExits(Exception):
    def __str__(self):
        raise SystemExit(3)
"""
    test = """
@pafot.search(SHORT, shrink_runs=0)
def test_NUMBER(run):
    if run.scenario.npcs[0][0].speed < 15:
        raise RAISED
"""
    tests = (
        test.replace("NUMBER", str(n)).replace("RAISED", each) for n, each in enumerate(raised)
    )
    project.write(classes + "".join(tests))
    assert project.run(runs=12).parseoutcomes()["failed"] == len(raised) + len(project.files)
    failures = {
        (name.split("/")[2], load(project.path / name).expect.failure) for name in project.files
    }
    assert failures == {(f"test_{n}", each.partition("(")[0]) for n, each in enumerate(raised)}


def test_timeout_is_no_finding_and_preserves_earlier_ones(project):
    project.write("""
import signal
seen = []

@pytest.mark.timeout(3600, method="signal")
@pafot.search(SHORT)
def test_hangs(run):
    seen.append(run)
    if len(seen) > 1:
        signal.raise_signal(signal.SIGALRM)  # as if the hour were over
    assert run.scenario.id == ""
""")
    result = project.run(runs=20, plugins=("timeout",))
    result.assert_outcomes(failed=2)
    assert f"FAILED test_it.py::test_hangs[saved-{project.only_id}]" in result.stdout.str()
