"""The same exception in every run of the first generation is an error of the setup, not a finding."""

import fnmatch
from collections import Counter
from types import SimpleNamespace

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.findings.verdict import Failure, Verdict
from pytest_pafot.searches.harness import SetupFaultError, cause_of
from pytest_pafot.searches.results import Counts, State
from pytest_pafot.searches.search import check_set_up
from tests.helpers.sessions import section
from tests.plugin.conftest import labels, shows

MISSPELT = """
@pafot.search(SHORT, ARGUMENTS)
def test_drive(run):
    assert not run.collided
"""

BROKEN = """
def drive(observation):
    BROKEN

@pafot.search(SHORT, ads=lambda: drive)
def test_drive(run):
    pass
"""


def misspelt(arguments=""):
    return MISSPELT.replace("ARGUMENTS", arguments)


class TestAFaultOfTheSetUpIsOneErrorAndNoFile:
    def test_misspelt_run_attribute_is_one_error_with_suggestion(self, project):
        each = ["", "blame='ego'", "algorithm='pafot'"]
        project.write(
            "".join(
                misspelt(each[n]).replace("test_drive", f"test_drive_{n}") for n in range(len(each))
            )
        )
        result = project.run(runs=12)
        result.assert_outcomes(failed=len(each))
        for n in range(len(each)):
            shows(
                result,
                f"test_drive_{n}",
                "*assert not run.collided",
                "E*AttributeError: a run has no attribute 'collided'. Did you mean `run.collision`?",
                "E*This happened in all * runs*an error in the test function and not a finding*Use assert if *.",
            )
        result.stdout.no_fnmatch_line("*pafot: found*")
        result.stdout.no_fnmatch_line("*During handling*")
        result.stdout.no_fnmatch_line("*responsible*")
        result.stdout.no_fnmatch_line("*(known)*")
        assert project.files == []
        assert not (project.path / "pafot_corpus").exists()

    @pytest.mark.parametrize(
        "option", ["-x", "--pafot-save=none", pytest.param("-n1", marks=pytest.mark.processes)]
    )
    def test_whatever_the_session_does_with_failures(self, project, option):
        project.write(misspelt() + "\ndef test_other():\n    pass\n")
        project.run(option).stdout.fnmatch_lines(
            ["E*AttributeError: *Did you mean `run.collision`?", "*1 failed*"]
        )
        assert project.files == []

    def test_failing_first_decision_is_one_error_without_file(self, project):
        told = {
            "return {}['lane'], 0.0": "the ADS failed: KeyError: 'lane'",
            "pytest.skip('no GPU')": "the ADS failed: Skipped: no GPU",
            "return None": "the ADS failed: BadAction: expected (acceleration *received None*",
        }
        for n, broken in enumerate(told):
            project.write(
                BROKEN.replace("BROKEN", broken).replace("test_drive", f"test_{n}"),
                name=f"test_it{n}",
            )
        result = project.run(runs=12)
        result.assert_outcomes(failed=len(told))
        for n, line in enumerate(told.values()):
            shows(result, f"test_{n}", line, "*in all * runs, at the first decision*")
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
        project.run().stdout.fnmatch_lines(["*pafot: found*", "*[[]search[]]: * failed*"])
        assert {load(project.path / name).expect.failure for name in project.files} == {
            "ValueError"
        }

    @pytest.mark.parametrize(("later", "options", "told"), [
        ("raise KeyboardInterrupt", {"no_reraise_ctrlc": True}, ["*found*", "*ended early*it was interrupted."]),
        ("pytest.exit('enough')", {"no_reraise_ctrlc": True}, ["*found*", "*ended early*it was interrupted."]),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", {"apart": True}, []),
    ])  # fmt: skip
    def test_where_the_session_or_its_process_ends_meanwhile(self, project, later, options, told):
        self.write(project, later)
        project.run(**options).stdout.fnmatch_lines(told)
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


NEWCOMERS = """
import gymnasium
import highway_env
import numpy as np
from highway_env.vehicle.kinematics import Vehicle

class Planner:
    def __call__(self, observation):
        return 0.0, 0.0

class Configured(Planner):
    def __init__(self, config):
        pass

class Model:
    def predict(self, observation, state=None, deterministic=False):
        if getattr(observation, "shape", None) != (5, 5):
            raise ValueError(f"expected a shape of (5, 5), received {getattr(observation, 'shape', None)}")
        return np.int64(1), None

model = Model()

@pytest.fixture
def trained():
    return model

ten = pafot.World("highway-v0", duration=2.0, config={"observation": {"type": "Kinematics", "vehicles_count": 10}})
five = pafot.World("highway-v0", duration=2.0)
steering = pafot.World("highway-v0", duration=2.0, config={"action": {"type": "ContinuousAction"}})

class Road:
    rollout = to_dict = print

def keep(observation):
    return 0.0, 0.0

async def later(observation):
    return 0.0, 0.0
"""

NEWCOMER = """
@pafot.search(ARGUMENTS)
def test_drive_NUMBER(run):
    pass
"""

CONFIG = (
    "A policy needs the config= and the wrappers= with which it was trained. A "
    "planner in SI units needs pafot.Highway"
)
NO_FACTORY = "An ADS itself is not a factory. Wrap it so that each scenario gets a fresh ADS: `lambda: MyPlanner()`"

PREDICT = (
    "It has a method 'predict'. Return a function that calls it with the observation, "
    "`lambda: lambda observation: model.predict(observation, deterministic=True)[0]`"
)

MESSAGES = {
    "Planner": [
        "expected only keyword arguments",
        "Write the argument's name, as in @pafot.search(ads=Planner)",
    ],
    "Planner()": [
        "expected only keyword arguments",
        "Write the argument's name, as in @pafot.search(ads=...)",
    ],
    "model.predict": ["Write the argument's name, as in @pafot.search(ads=predict)"],
    "ads=Planner()": [
        "that can be called without arguments, received one with * (observation)",
        NO_FACTORY,
    ],
    "ads=lambda observation: (0.0, 0.0)": [NO_FACTORY],
    "ads=keep": [
        "with the signature (observation) ",
        "If keep is an ADS, write `lambda: keep`. If it makes one, write `lambda: keep(...)`",
    ],
    "ads=lambda: (0.0, 0.0)": ["received (0.0, 0.0)", "Write `lambda: lambda observation: ...`"],
    "ads=lambda: print()": ["received None. Is a `return` missing?"],
    "ads=lambda: model": [PREDICT],
    "ads=model": [
        "expected the name of a fixture or a factory such as `lambda: MyPlanner()`",
        PREDICT,
    ],
    "ads='trained'": ["expected the fixture 'trained' to return a factory", PREDICT],
    "ads='model.zip'": [
        "received 'model.zip'. Load a model in the factory, as in `ads=lambda: MyPlanner('model.zip')`"
    ],
    "ads=Vehicle(None, [0, 0])": [
        "received Vehicle #*. Pass the class itself, `Vehicle`, without calling it"
    ],
    "ads=lambda: Vehicle()": [
        "TypeError: *'road' and 'position'",
        "pass its class without calling it, as in `ads=MyVehicle`",
    ],
    "ads=Configured": [
        "Wrap the call in a function that passes the arguments, such as `lambda: Configured(...)`"
    ],
    "world=five, ads=lambda: model.predict": [
        "received (np.int64(1), None); (action, state) is what `model.predict` returns: use "
        "`model.predict(observation, deterministic=True)[0]`"
    ],
    "world=ten, ads=lambda: lambda seen: model.predict(seen)[0]": [
        "expected a shape of (5, 5), received (10, 5)",
        "was given an array of shape (10, 5) and type float32",
        CONFIG,
    ],
    "ads=lambda: lambda seen: model.predict(seen)[0]": [
        "was given a pafot.Observation (time, ego, *.array of shape (*, 7))",
        "needs world=pafot.World('highway-v0'",
    ],
    "ads=lambda: lambda seen: 1": [
        "received 1; policies of a highway-env environment need world=pafot.World("
    ],
    "world=five, ads=Planner": [
        "received (0.0, 0.0); planners in SI units drive without world=, or in a pafot.World(*"
    ],
    "world=five, ads=lambda: lambda seen: seen.ego": [
        "no attribute 'ego'",
        "A planner in SI units needs pafot.Highway",
    ],
    "world=five, ads=lambda: lambda seen: np.zeros(5)": [
        "return the number of the largest: `int(np.argmax(...))`"
    ],
    "world=five, ads=lambda: lambda seen: 1.0": ["received 1.0; return `int(...)` of it"],
    "world=five, ads=lambda: lambda seen: None": ["received None; is a `return` missing?"],
    "world=five, ads=lambda: lambda seen: [[1], [2, 3]]": [
        "expected a whole number from 0 to 4, received [[1], *"
    ],
    "world=steering, ads=lambda: lambda seen: np.zeros((1, 2))": ["use its first row, `action[0]`"],
    "ads=lambda: lambda seen: dict(acceleration=0.0, steering=0.0)": [
        "return the two values as a tuple"
    ],
    "ads=lambda: later": ["an ADS is an ordinary function, without `async` and `yield`"],
    "world='highway-v9'": [
        "expected a registered environment, received 'highway-v9'. Did you mean 'highway-v0'? highway-env's straight *"
    ],
    "world='builtins:print'": [
        "the factory 'builtins:print' to return pafot.Highway(*, received None. Return a world, such as pafot.World("
    ],
    "world='operator:neg'": [
        "which raises TypeError: * takes exactly one argument (0 given)*. Add its argument to the string, as in *"
    ],
    "world=pafot.Highway": [". Call it: Highway(...)"],
    "world=Road()": [
        "expected pafot.Highway(...), pafot.World(...) or pafot.SimulatorWorld(...), received *Road object at *",
        ". Derive your own simulator from pafot.Simulator, and pass it to pafot.SimulatorWorld",
    ],
    "world=gymnasium.make('highway-v0', config={'lanes_count': 3})": [
        ". Did you mean pafot.World('highway-v0', config=...)?"
    ],
    "world=gymnasium.make('CartPole-v1')": [
        ". Derive your own simulator from pafot.Simulator, and pass it to pafot.SimulatorWorld"
    ],
    "worlds=five": [
        "(worlds=...): expected one of ads, against, *, received 'worlds'. Did you mean 'world'?"
    ],
}


def test_newcomer_errors_explain_what_to_write(project):
    tests = [
        NEWCOMER.replace("ARGUMENTS", given).replace("NUMBER", str(n))
        for n, given in enumerate(MESSAGES)
    ]
    project.write(NEWCOMERS + "".join(tests))
    result = project.run("-W", "error")
    missing = {}
    for n, given in enumerate(MESSAGES):
        shown = " ".join(section(result, f"test_drive_{n}").split()).replace('"', "'")
        patterns = {text: text.replace("[", "[[]").replace('"', "'") for text in MESSAGES[given]}
        missing[given] = [
            text for text, each in patterns.items() if not fnmatch.fnmatchcase(shown, f"*{each}*")
        ]
    assert {given: texts for given, texts in missing.items() if texts} == {}
    outcomes = result.parseoutcomes()
    assert outcomes["failed"] + outcomes["errors"] == len(MESSAGES)
    assert "passed" not in outcomes
    assert project.files == []


def test_first_generation_error_counts_only_judged_runs():
    broken = Verdict(
        kind="failed",
        exception=KeyError("x"),
        failure=Failure(kind="KeyError", assertion="run['x']"),
    )
    run = object()  # of a run in which the function failed, nothing is read
    bench = SimpleNamespace(run=lambda scenario: run, finish=lambda run: broken)
    cause, state = cause_of(run, broken), State(first=object())
    state.counts += Counts(kinds=Counter(npc=1, failed=2, invalid=1), causes=Counter({cause: 2}))
    with pytest.raises(
        SetupFaultError, match="all 2 evaluated runs of the first generation ended with"
    ):
        check_set_up(state, bench, " of the first generation")


def steers(actions):
    """Return a test of an ADS that always acts in the same way, for each action."""
    return "\n".join(
        f"@pafot.search(SHORT, ads=lambda: lambda seen: {action})\ndef test_drive_{n}(run):\n    pass\n"
        for n, action in enumerate(actions)
    )


def test_note_warns_of_wrong_units_or_action_order(project):
    told = {
        "(0.0, 3.0)": "requested a steering angle of 3 rad, but only 0.79*Convert degrees with math.radians*",
        "(0.05, -6.0)": "An action is (acceleration, steering), in this order*",
        "(80.0, 0.0)": "requested an acceleration of 80 m/s^2, but only 6*not a speed*",
    }
    project.write(steers(told))
    lines = [
        each
        for n, line in enumerate(told.values())
        for each in (f"*test_drive_{n}[[]search[]]: *", f"*{line}")
    ]
    project.run().stdout.fnmatch_lines(lines)


def test_plausible_actions_give_no_note(project):
    project.write(steers(["(6.0, 0.7)", "(-100.0, -0.7)", "(0, 1)"]))
    result = project.run()
    assert sum(result.parseoutcomes().values()) == 3
    result.stdout.no_fnmatch_line("*the ADS requested*")


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


SIGNATURES = {
    "def drive(observation, more):": "TypeError: *missing 1 required positional argument: 'more'",
    "def drive():": "TypeError: *takes 0 positional arguments but 1 was given",
    "def drive(o):\n        undefined.x": "NameError: name 'undefined' is not defined",
}


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
        text = result.stdout.str()
        assert text.count("This happened in this replay and 10 random scenarios") == 1
        assert (
            text.count(
                "The cause is an error in the set-up. See the failure of test_it.py::test_fails[saved-"
            )
            == 1
        )
        result.stdout.fnmatch_lines([f"the ADS failed: {SIGNATURES[call]}*"])
        assert "drifted" not in text
        assert '"status": "error"' in (two.path / "pafot.json").read_text()
        two.write(drives())
        assert "2 still failing" in two.run(runs=0).stdout.str()

    def test_error_in_the_test_function_is_no_drift_either(self, two):
        two.write(drives(condition="not run.collided"))
        result = two.run(runs=0)
        result.assert_outcomes(failed=2, skipped=1)
        result.stdout.fnmatch_lines(
            [
                "*This happened in this replay and 10 random scenarios*error in the test function and not a finding*"
            ]
        )
        assert "drifted" not in result.stdout.str()

    def test_ads_that_raises_in_some_scenarios_is_a_failure(self, project):
        project.write(drives().replace("SHORT", "npcs=1"))
        project.run("--pafot-runs=1", runs=None)
        project.write(drives(ALONE).replace("SHORT", "genes=2"))
        result = project.run(runs=0)
        result.assert_outcomes(failed=1, skipped=1)
        result.stdout.fnmatch_lines(
            ["ValueError: alone.", "*: 1 drifted", "* the ADS failed: ValueError: alone"]
        )

    def test_an_accepted_failure_does_not_excuse_it(self, two):
        two.accept()
        two.run(runs=0).assert_outcomes(xfailed=2, skipped=1)
        two.write(drives(next(iter(SIGNATURES))))
        two.run(runs=0).assert_outcomes(failed=2, skipped=1)
        two.write(drives().replace("def ads():", "def ads(argument):"))
        two.run(runs=0).assert_outcomes(failed=2, skipped=1)

    def test_a_finding_of_the_first_decision_still_fails(self, project):
        call = ALONE.replace("== 1", "== 3")  # as in some of the random scenarios
        project.write(drives(call, condition="True").replace("SHORT", "genes=2"))
        project.run("--pafot-runs=40", runs=None)
        assert labels(project.run(runs=0)) == "1 still failing"
