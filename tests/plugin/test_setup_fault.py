"""The same exception in every run of the first generation is an error of the setup, not a finding."""

from collections import Counter
from types import SimpleNamespace

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.findings.verdict import Failure, Verdict
from pytest_pafot.searches.harness import SetupFaultError, cause_of
from pytest_pafot.searches.results import Counts, State
from pytest_pafot.searches.search import check_set_up
from tests.plugin.conftest import labels

BROKEN = """
def drive(observation):
    BROKEN

@pafot.search(SHORT, ads=lambda: drive)
def test_drive(run): pass
"""


def misspelt(arguments=""):
    return f"@pafot.search(SHORT, {arguments})\ndef test_drive(run):\n    assert not run.collided\n"


class TestAFaultOfTheSetUpIsOneErrorAndNoFile:
    def test_misspelt_run_attribute_or_failing_first_decision_is_one_error(self, project):
        each = ["", "blame='ego'", "algorithm='pafot'"]
        broken = ["return {}['lane'], 0.0", "pytest.skip('no GPU')", "return None"]
        sources = [*map(misspelt, each), *(BROKEN.replace("BROKEN", line) for line in broken)]
        for n, source in enumerate(sources):
            project.write(source, name=f"test_it{n}")
        result = project.run(runs=12)
        result.assert_outcomes(failed=len(sources))
        assert "(known)" not in result.stdout.str()
        assert not (project.path / "pafot_corpus").exists()

    @pytest.mark.parametrize(
        "option", ["-x", "--pafot-save=none", pytest.param("-n1", marks=pytest.mark.processes)]
    )
    def test_whatever_the_session_does_with_failures(self, project, option):
        project.write(misspelt() + "\ndef test_other():\n    pass\n")
        assert project.run(option).parseoutcomes()["failed"] == 1
        assert project.files == []

    def test_setup_error_leaves_earlier_scenarios_unchanged(self, project):
        project.write(misspelt().replace("not run.collided", "run.duration < 1"))
        project.run("--pafot-shrink-runs=0", "--pafot-stop-after=1")
        contents = project.contents
        project.write(misspelt())
        project.run().assert_outcomes(failed=2)
        assert project.contents == contents
        assert len(contents) == 1


class TestNothingThatWasFoundIsLost:
    SOME = """
    seen = {}

    @pafot.search(SHORT, shrink_runs=0)
    def test_drive(run):
        if seen.setdefault(run.scenario.id, len(seen)) < 2:
            raise ValueError("lane")
        LATER
    """

    def write(self, project, later):
        source = "\n".join(line.removeprefix("    ") for line in self.SOME.splitlines())
        project.write(source.replace("LATER", later))

    @pytest.mark.parametrize("later", ["return None", "raise ValueError('another line')"])
    def test_different_ending_in_first_generation_saves_a_finding(self, project, later):
        self.write(project, later)
        project.run()
        assert {load(project.path / name).expect.failure for name in project.files} == {
            "ValueError"
        }

    @pytest.mark.parametrize(("later", "options"), [
        ("raise KeyboardInterrupt", {"no_reraise_ctrlc": True}),
        ("pytest.exit('enough')", {"no_reraise_ctrlc": True}),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", {"apart": True}),
    ])  # fmt: skip
    def test_where_the_session_or_its_process_ends_meanwhile(self, project, later, options):
        self.write(project, later)
        project.run(**options)
        assert project.files

    def test_time_limit_before_generation_end_saves_a_finding(self, project):
        self.write(project, "return None")
        project.run("--pafot-max-time=0").assert_outcomes(failed=2)
        assert len(project.files) == 1

    def test_where_it_was_asserted_or_came_after_the_first_decision(self, project):
        raised = ["assert run.duration < 0", "raise AssertionError('late')", "pytest.fail('late')"]
        test = "@pafot.search(SHORT, shrink_runs=0)\ndef test_drive(run):\n    {}\n"
        later = BROKEN.replace("BROKEN", "return (0.0, 0.0) if observation.time < 1 else None")
        sources = [*map(test.format, raised), later]
        for n, source in enumerate(sources):
            project.write(source, f"test_it{n}")
        project.run()
        assert {name.split("/")[1] for name in project.files} == {f"test_it{n}" for n in range(4)}


def test_first_generation_error_counts_only_judged_runs():
    failure = Failure(kind="KeyError", assertion="run['x']")
    broken = Verdict(kind="failed", exception=KeyError("x"), failure=failure)
    run = object()  # of a run in which the function failed, nothing is read
    bench = SimpleNamespace(run=lambda scenario: run, finish=lambda run: broken)
    cause, state = cause_of(run, broken), State(first=object())
    state.counts += Counts(kinds=Counter(npc=1, failed=2, invalid=1), causes=Counter({cause: 2}))
    with pytest.raises(SetupFaultError, match=r"\b2\b"):
        check_set_up(state, bench, " of the first generation")


def steers(actions):
    """Return a test of an ADS that always acts in the same way, for each action."""
    return "\n".join(
        f"@pafot.search(SHORT, ads=lambda: lambda seen: {action})\ndef test_drive_{n}(run):\n    pass\n"
        for n, action in enumerate(actions)
    )


def test_plausible_actions_give_no_note(project):
    project.write(steers(["(6.0, 0.7)", "(-100.0, -0.7)", "(0, 1)"]))
    result = project.run()
    assert sum(result.parseoutcomes().values()) == 3
    result.stdout.no_fnmatch_line("*note:*")


DRIVES = """
def ads():
    CALL
        return 0.0, 0.0
    return drive

@pafot.search(SHORT, ads=ads)  # stop_after=1
def test_fails(run):
    assert CONDITION
"""


def drives(call="def drive(observation):", condition="not run"):
    return DRIVES.replace("CALL", call).replace("CONDITION", condition)


SIGNATURES = ("def drive(observation, more):", "def drive():", "def drive(o):\n        undefined.x")


ALONE = "def drive(observation):\n        if len(observation.others) == 1:\n            raise ValueError('alone')"


class TestAReplayWithAFaultOfTheSetUp:
    """A policy that no longer drives says nothing about saved scenarios: no file drifted."""

    @pytest.fixture
    def two(self, project):
        """Return a project with two saved scenarios of one test."""
        project.write(drives())
        project.run()
        path = project.only_file
        other = path.with_name(path.name.replace(load(path).id, "other-111111"))
        other.write_text(path.read_text().replace(load(path).id, "other-111111"))
        return project

    @pytest.mark.parametrize("call", SIGNATURES)
    def test_changed_signature_is_explained_once_per_test(self, two, call):
        two.write(drives(call))
        result = two.run("--pafot-json=pafot.json", runs=0)
        result.assert_outcomes(failed=2, skipped=1)
        assert sum(line.startswith("the ADS failed: ") for line in result.outlines) == 1
        assert {each.status for each in two.record.findings} == {"error"}
        assert labels(result) == ""
        two.write(drives())
        assert labels(two.run(runs=0)) == "2 still failing"

    def test_error_in_the_test_function_is_no_drift_either(self, two):
        two.write(drives(condition="not run.collided"))
        result = two.run(runs=0)
        result.assert_outcomes(failed=2, skipped=1)
        assert labels(result) == ""

    def test_ads_that_raises_in_some_scenarios_is_a_failure(self, project):
        project.write(drives().replace("SHORT", "npcs=1"))
        project.run("--pafot-runs=1", runs=None)
        project.write(drives(ALONE).replace("SHORT", "genes=2"))
        result = project.run(runs=0)
        result.assert_outcomes(failed=1, skipped=1)
        assert labels(result) == "1 drifted"

    def test_an_accepted_failure_does_not_excuse_it(self, two):
        two.accept()
        two.run(runs=0).assert_outcomes(xfailed=2, skipped=1)
        two.write(drives(SIGNATURES[0]))
        two.run(runs=0).assert_outcomes(failed=2, skipped=1)
        two.write(drives().replace("def ads():", "def ads(argument):"))
        two.run(runs=0).assert_outcomes(failed=2, skipped=1)

    def test_a_finding_of_the_first_decision_still_fails(self, project):
        call = ALONE.replace("== 1", "== 3")  # as in some of the random scenarios
        project.write(drives(call, condition="True").replace("SHORT", "genes=2"))
        project.run("--pafot-runs=40", runs=None)
        assert labels(project.run(runs=0)) == "1 still failing"
