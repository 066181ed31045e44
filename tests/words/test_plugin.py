"""What a session of pytest says about marked tests, searches and replays."""

import pytest

from tests.helpers.tables import table


def marked(*cases, body="pass"):
    """Return a file with a marked test for each case: the arguments of its search, and the lines of its body."""
    pairs = [case if isinstance(case, tuple) else (case, body) for case in cases]
    return "\n".join(
        f"@pafot.search({arguments})\ndef test_{n}(run):\n    {lines}\n"
        for n, (arguments, lines) in enumerate(pairs)
    )


def result_of(project, source, *args, **options):
    """Return the result of a session without pytest's list of all failures, which repeats their first lines."""
    project.write(source)
    return project.run("-rN", *args, **options)


# --- what cannot be searched

UNSUITABLE = """
import unittest
from hypothesis import given, strategies as st

@pafot.search
async def test_async(run):
    assert False

class TestCase(unittest.TestCase):
    @pafot.search
    def test_method(self):
        pass

@pafot.search
def test_nothing():
    pass

@pafot.search
def test_misspelt(rnu):
    pass

@pytest.mark.parametrize("run", [1, 2])
@pafot.search
def test_double(run):
    pass

@pytest.mark.pafot_search
def test_raw(run):
    pass

@pytest.mark.pafot
def test_bare(run):
    pass

@pytest.mark.pafot(ads=1)
def test_given(run):
    pass

@given(number=st.integers())
@pafot.search
def test_given_first(run, number):
    pass

@pafot.search
@given(number=st.integers())
def test_search_first(run, number):
    pass

@pafot.search(ads="named:Planer:a:b")
def test_wrong_name(run):
    pass

@pafot.search(ads="adss")
def test_wrong_fixture(run):
    pass

@pytest.mark.pafot
def test_other():
    pass
"""
COLLECTING = """
@pytest.fixture
def indirectly(subtests):
    return subtests

def of(package):
    return pytest.fixture(lambda: type("Once", (), {"__module__": f"{package}.fixture"})(), name=f"of_{package}")

one, two, three = of("pytest_benchmark"), of("pytest_codspeed"), of("syrupy")

@pafot.search(SHORT)
def test_returns(run):
    return run.min_ttc > 1

"""
FIXTURES = ("subtests", "indirectly", "of_pytest_benchmark", "of_pytest_codspeed", "of_syrupy")
CHECK = """
failures = []

def is_true(x):
    x or failures.append(x)

def any_failures():
    return bool(failures)
"""


def test_functions_that_cannot_be_marked_read_so(project, snapshot):
    project.pytester.makepyfile(named="class Planner:\n    pass\n")
    result = result_of(project, UNSUITABLE, "-opythonpath=.", plugins=("hypothesispytest",))
    result.assert_outcomes(errors=13, passed=1)
    assert result.stdout.str() == snapshot


def test_functions_that_hide_or_only_collect_failures_read_so(project, snapshot):
    skips = [
        "pytest.skip('no GPU')",
        "pytest.importorskip('no_such_module')",
        "pytest.xfail('')",
        "pytest.exit('')",
    ]
    source = COLLECTING + "".join(
        f"@pafot.search(SHORT)\ndef test_{each}(run, {each}):\n    assert {each} is None\n\n"
        for each in FIXTURES
    )
    source += "".join(
        f"def other_{n}(*args):\n    {call}\n\n"
        f"@pafot.search(SHORT, {name}=other_{n})\ndef test_{name}_{n}(run):\n    pass\n\n"
        for name in ("ads", "fitness")
        for n, call in enumerate(skips)
    )  # fmt: skip
    result = result_of(project, source)
    result.assert_outcomes(failed=1 + len(FIXTURES) + 2 * len(skips))
    project.pytester.makepyfile(pytest_check=CHECK)
    checking = "import pytest_check\n\n" + marked(("SHORT", "pytest_check.is_true(run.duration > 99)"))
    checked = result_of(project, checking)
    checked.assert_outcomes(failed=1)
    assert project.files == []
    assert [result.stdout.str(), checked.stdout.str()] == snapshot


WRONG = [
    "colour='red'",
    "5",
    "today='a'",
    "blame='npc'",
    "ads=3",
    "world=pafot.Highway",
    "lanes=3",
    "generations=0",
    "shrink_runs=-1",
    "algorithm='named:Nobody'",
    "algorithm='magic'",
]
"""Arguments that are an error of their item before any fixture."""
REFUSED = [
    "npcs=9",
    "gene_seconds=0",
    "SHORT, instructions='cell'",
    "ego_lane=7",
    "world=pafot.World('highway-v0', config={'colour': 1})",
    "fitness='best'",
    "fitness=lambda trace: 'high'",
]
"""Arguments that only a world or a run can refuse."""


def test_wrong_arguments_read_so(project, snapshot):
    project.pytester.makepyfile(named="class Planner:\n    pass\n")
    fixture = "@pytest.fixture\ndef ads():\n    raise RuntimeError('set up')\n"
    result = result_of(project, fixture + marked(*WRONG), "-opythonpath=.")
    result.assert_outcomes(errors=len(WRONG))
    refused = result_of(project, marked(*REFUSED))
    refused.assert_outcomes(failed=len(REFUSED))
    assert [result.stdout.str(), refused.stdout.str()] == snapshot


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

class Derived(pafot.Highway):
    pass

def keep(observation):
    return 0.0, 0.0

async def later(observation):
    return 0.0, 0.0

"""
MISTAKES = [
    "Planner",
    "Planner()",
    "model.predict",
    "ads=Planner()",
    "ads=lambda observation: (0.0, 0.0)",
    "ads=keep",
    "ads=lambda: (0.0, 0.0)",
    "ads=lambda: print()",
    "ads=lambda: model",
    "ads=model",
    "ads='trained'",
    "ads='tmp_path'",
    "ads='model.zip'",
    "ads=Vehicle(None, [0, 0])",
    "ads=lambda: Vehicle()",
    "ads=Configured",
    "world=five, ads=lambda: model.predict",
    "world=ten, ads=lambda: lambda seen: model.predict(seen)[0]",
    "ads=lambda: lambda seen: model.predict(seen)[0]",
    "ads=lambda: lambda seen: 1",
    "world=five, ads=Planner",
    "world=five, ads=lambda: lambda seen: seen.ego",
    "world=five, ads=lambda: lambda seen: np.zeros(5)",
    "world=five, ads=lambda: lambda seen: 1.0",
    "world=five, ads=lambda: lambda seen: None",
    "world=five, ads=lambda: lambda seen: [[1], [2, 3]]",
    "world=steering, ads=lambda: lambda seen: np.zeros((1, 2))",
    "ads=lambda: lambda seen: dict(acceleration=0.0, steering=0.0)",
    "ads=lambda: later",
    "world='highway-v9'",
    "world='builtins:print'",
    "world='operator:neg'",
    "world=pafot.Highway",
    "world=Road()",
    "world=Road",
    "world=Derived()",
    "world=gymnasium.make('highway-v0', config={'lanes_count': 3})",
    "world=gymnasium.make('CartPole-v1')",
    "worlds=five",
    "ads=lambda: lambda seen: {}['lane']",
    "ads=lambda: lambda seen: pytest.skip('no GPU')",
    "ads=lambda: lambda seen: None",
    "SHORT, against='old_ads'",
]
"""Mistakes of somebody who writes a first search."""


def test_mistakes_of_a_first_search_read_so(project, snapshot):
    result = result_of(project, NEWCOMERS + marked(*MISTAKES), "-W", "error")
    outcomes = result.parseoutcomes()
    assert outcomes["failed"] + outcomes["errors"] == len(MISTAKES)
    assert "passed" not in outcomes
    assert project.files == []
    assert result.stdout.str() == snapshot


MISSPELT = "assert not run.collided"
BODIES = [
    ("SHORT", MISSPELT),
    ("SHORT, blame='ego'", MISSPELT),
    ("SHORT, algorithm='pafot'", MISSPELT),
    ("SHORT", "int(run.scenario.id, 16) % 4 and pafot.reject()"),
    ("SHORT", "pytest.skip('not today')"),
    ("SHORT, ads=lambda: lambda seen: (0.0, 3.0)", "pass"),
    ("SHORT, ads=lambda: lambda seen: (0.05, -6.0)", "pass"),
    ("SHORT, ads=lambda: lambda seen: (80.0, 0.0)", "pass"),
    ("npcs=1, genes=4, gene_seconds=10, ads=lambda: lambda seen: (-8.0, 0.0)", "pass"),
]
"""Searches that test nothing or little."""


def test_searches_that_test_little_read_so(project, snapshot):
    project.write(
        "@pytest.fixture\ndef pafot_world():\n    return 'highway-v0'\n\n" + marked(""),
        "test_world",
    )
    result = result_of(project, marked(*BODIES), "-rs", "-v", runs=12)
    result.assert_outcomes(failed=5, passed=4, skipped=1)
    assert project.files == []
    strict = project.run("--pafot-strict-health", "test_it.py::test_8[search]", runs=8)
    strict.assert_outcomes(failed=1)
    assert [result.stdout.str(), strict.stdout.str()] == snapshot
