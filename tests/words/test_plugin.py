"""What a session of pytest says about marked tests, searches and replays."""

import re
import shutil
import sys
from functools import partial

import pytest

import pytest_pafot as pafot
from pytest_pafot.findings.shrink import OutOfBudget
from pytest_pafot.oracle.run import Rejected
from pytest_pafot.searches.refine import steps
from pytest_pafot.searches.refine.simplest import Turn
from pytest_pafot.support.errors import OutOfTime, RequestError
from tests.plugin.conftest import CONFTEST, FAILING
from tests.plugin.test_acceptance import TEST as ACCEPTS
from tests.plugin.test_against import AGAINST, ELSEWHERE, KEEPS, SPEEDS, policies
from tests.plugin.test_against import TEST as COMPARED
from tests.plugin.test_algorithms import OWN
from tests.plugin.test_driving_on import POLICIES, filed, replay
from tests.plugin.test_driving_on import TEST as GAP
from tests.plugin.test_elsewhere import fixed, searched
from tests.plugin.test_failure_reports import PRINTS
from tests.plugin.test_guard import LEFT_OUT
from tests.plugin.test_health import STOPS
from tests.plugin.test_marked_functions import CHECK
from tests.plugin.test_options import settings
from tests.plugin.test_own_worlds import wrapped
from tests.plugin.test_replay_item import SIMULATOR
from tests.plugin.test_retrying import OWNER, write
from tests.plugin.test_session_end import ALWAYS, EXITS, LEAVES, SWALLOWS
from tests.plugin.test_session_records import IS_CUT
from tests.plugin.test_stuck_ads import STUCK
from tests.plugin.test_stuck_ads import TESTS as TESTS_OF_THE_STUCK


@pytest.fixture
def project(project, monkeypatch):
    """Return a project whose sessions break no line, as they would in a longer path, and are too quick for progress."""
    monkeypatch.setenv("COLUMNS", "9999")
    monkeypatch.setattr("pytest_pafot.plugin.session.LOG_SECONDS", 1e9)
    return project


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
    def test_method(self): pass

@pafot.search
def test_nothing(): pass

@pafot.search
def test_misspelt(rnu): pass

@pytest.mark.parametrize("run", [1, 2])
@pafot.search
def test_double(run): pass

@pytest.mark.pafot_search
def test_raw(run): pass

@pytest.mark.pafot
def test_bare(run): pass

@pytest.mark.pafot(ads=1)
def test_given(run): pass

@given(number=st.integers())
@pafot.search
def test_given_first(run, number): pass

@pafot.search
@given(number=st.integers())
def test_search_first(run, number): pass

@pafot.search(ads="named:Planer:a:b")
def test_wrong_name(run): pass

@pafot.search(ads="adss")
def test_wrong_fixture(run): pass

@pytest.mark.pafot
def test_other(): pass
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
    checking = "import pytest_check\n\n" + marked(
        ("SHORT", "pytest_check.is_true(run.duration > 99)")
    )
    checked = result_of(project, checking)
    checked.assert_outcomes(failed=1)
    assert project.files == []
    assert [result.stdout.str(), checked.stdout.str()] == snapshot


WRONG = [
    "colour='red'", "5", "today='a'", "blame='npc'", "ads=3", "world=pafot.Highway", "lanes=3", "generations=0",
    "shrink_runs=-1", "algorithm='named:Nobody'", "algorithm='magic'",
]  # fmt: skip
"""Arguments that are an error of their item before any fixture."""
REFUSED = [
    "npcs=9", "gene_seconds=0", "SHORT, instructions='cell'", "ego_lane=7",
    "world=pafot.World('highway-v0', config={'colour': 1})", "fitness='best'", "fitness=lambda trace: 'high'",
]  # fmt: skip
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
    def __init__(self, config): pass

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

class Derived(pafot.Highway): pass

def keep(observation):
    return 0.0, 0.0

async def later(observation):
    return 0.0, 0.0

"""
MISTAKES = [
    "Planner", "Planner()", "model.predict", "ads=Planner()", "ads=lambda observation: (0.0, 0.0)", "ads=keep",
    "ads=lambda: (0.0, 0.0)", "ads=lambda: print()", "ads=lambda: model", "ads=model", "ads='trained'",
    "ads='model.zip'", "ads=Vehicle(None, [0, 0])", "ads=lambda: Vehicle()", "ads=Configured",
    "world=five, ads=lambda: model.predict", "world=ten, ads=lambda: lambda seen: model.predict(seen)[0]",
    "ads=lambda: lambda seen: model.predict(seen)[0]", "ads=lambda: lambda seen: 1", "world=five, ads=Planner",
    "world=five, ads=lambda: lambda seen: seen.ego", "world=five, ads=lambda: lambda seen: np.zeros(5)",
    "world=five, ads=lambda: lambda seen: 1.0", "world=five, ads=lambda: lambda seen: None",
    "world=five, ads=lambda: lambda seen: [[1], [2, 3]]", "world=steering, ads=lambda: lambda seen: np.zeros((1, 2))",
    "ads=lambda: lambda seen: dict(acceleration=0.0, steering=0.0)", "ads=lambda: later", "world='highway-v9'",
    "world='builtins:print'", "world='operator:neg'", "world=pafot.Highway", "world=Road()", "world=Road",
    "world=Derived()", "world=gymnasium.make('highway-v0', config={'lanes_count': 3})",
    "world=gymnasium.make('CartPole-v1')", "worlds=five", "ads=lambda: lambda seen: {}['lane']",
    "ads=lambda: lambda seen: pytest.skip('no GPU')", "ads=lambda: lambda seen: None", "SHORT, against='old_ads'",
]  # fmt: skip
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


# --- saved scenarios


def copies(project, edits, name="copy"):
    """Replace the only saved file by copies in which a regular expression is replaced, and return their number."""
    file, text = project.only_file, project.only_file.read_text()
    for number, (old, new) in enumerate(edits):
        edited = re.sub(old, new, text, count=1, flags=re.MULTILINE)
        assert edited != text, old
        file.with_name(f"{name}-{number:02}.pafot.yaml").write_text(edited)
    file.unlink()
    return len(edits)


DAMAGED = [
    (r"^pafot: 3", "pafot: 99"), (r"^scenario:", "colour: red\nscenario:"),
    (r"cell: [a-z-]+, speed", "cell: 9, speed"), (r"^pafot: 3", "pafot: [1"), (r"(?s).*", ""),
    (r"(?s)\Z", "#" * 300_000), ("lanes: 4", "lanes: 40"), ("overspeed: 1.1", "overspeed: 2.0"),
    ("lane: 1, speed", "lane: 9, speed"), (r"cell: front, speed: [\d.]+", "cell: front, speed: 99.0"),
    ("gene_seconds: 5.0", "gene_seconds: 5.01"),
    (r"world: (.|\n)*?\n#", "world: {kind: own, class: Ring, data: {lanes: 3}}\n#"),
]  # fmt: skip
ENVIRONMENT = [
    ("lanes_count: 3", "lanes_count: many"), ("lanes_count: 3", "lanes_cound: 3"),
    ("highway-fast-v0", "highway-slow-v0"),
]  # fmt: skip
IN_AN_ENVIRONMENT = """
@pafot.search(ads=lambda: lambda observation: 1, world=pafot.World("highway-fast-v0", duration=5.0))  # stop_after=1
def test_fails(run):
    assert run.duration < 1
"""
NAMES = ["with space", "\xfcber", "a%b", "copy (1)", "[x]"]


def test_files_that_cannot_be_read_read_so(saved, snapshot):
    file, text = saved.only_file, saved.only_file.read_text()
    count = copies(saved, DAMAGED)
    for name in NAMES:
        file.with_name(f"{name}.pafot.yaml").write_text(text)
    file.with_name("link.pafot.yaml").symlink_to("/dev/zero")
    result = saved.run("-rN", runs=0)
    result.assert_outcomes(failed=count + len(NAMES) + 1, skipped=1)
    saved.forget()
    saved.write(IN_AN_ENVIRONMENT)
    saved.run_once()
    copies(saved, ENVIRONMENT)
    of_environments = saved.run("-rN", runs=0)
    of_environments.assert_outcomes(failed=len(ENVIRONMENT), skipped=1)
    assert [result.stdout.str(), of_environments.stdout.str()] == snapshot


NO_HIT = "assert not run.collision"
LATER = "assert not run.collision or run.collision.time > 6"
LATE_ERROR = "missing = {}['lane'] if run.duration > 10.0 else None\n    assert not run.collision"
XFAIL = [("# xfail: .*", 'xfail: {reason: "planner issue 12", until: 9999-12-31}')]
OVER = [("# xfail: .*", 'xfail: {reason: "planner issue 12", until: 2027-01-31}')]
FLAKY = [
    ("# xfail: .*", 'flaky: "another run"\nxfail: {reason: "planner issue 12", until: 9999-12-31}')
]
VERSIONS = [(r"highway-env: [\d.]+", "highway-env: 0.9.0")]
FIVE = "world=pafot.Highway(lanes=5)"


def row(policy, body=NO_HIT, more="", edits=()):
    """Return the policy, the body of the test, more arguments of its search, and the changes of its file."""
    return policy, body, more, edits


REPLAYS = {
    "fails": row("fast"),
    "passes": row("braking"),
    "fails_earlier": row("fast", edits=[(r"collision, time: [\d.]+", "collision, time: 4.6")]),
    "fails_after_the_end": row("slow"),
    "hits_after_the_end": row("slow", LATER),
    "raises_after_the_end": row("raising"),
    "error_after_the_end": row("braking", LATE_ERROR),
    "fails_by_chance_after_the_end": row("dicing"),
    "passes_with_other_versions": row("braking", edits=VERSIONS),
    "passes_without_its_situation": row("braking", edits=[("ego_speed: ", "ego_speed: 9")]),
    "ends_in_a_shorter_world": row("fast", more="world=pafot.Highway(lanes=3, duration=0.4)"),
    "fails_and_names_another_world": row("fast", more=FIVE),
    "passes_and_names_another_world": row("braking", more=FIVE),
    "fails_and_names_other_traffic": row("fast", more="traffic='everyday'"),
    "rejects": row("fast", "pafot.reject()"),
    "raises_in_all_runs": row("broken"),
    "misspelt": row("fast", "assert not run.collided"),
    "accepted": row("fast", edits=XFAIL),
    "accepted_and_passes": row("braking", edits=XFAIL),
    "accepted_and_flaky": row("braking", edits=FLAKY),
    "accepted_until_yesterday": row("fast", edits=OVER),
    "accepted_until_yesterday_and_passes": row("braking", edits=OVER),
    "accepted_and_raises": row("failing", edits=XFAIL),
    "accepted_another_speed": row("fast", edits=[*XFAIL, (r" closing_speed: [\d.]+", " closing_speed: 0.5")]),
    "accepted_another_npc": row("fast", edits=[*XFAIL, (r"npc: 0,(\s+)cell", r"npc: 1,\1cell")]),
    "accepted_another_assertion": row("fast", edits=[*XFAIL, ("not run.collision", "not run.off_road")]),
    "accepted_another_end": row("fast", edits=[*XFAIL, ("outcome: collision", "outcome: off_road")]),
}  # fmt: skip
MORE_POLICIES = """
def broken():
    return lambda seen, more: (0.0, 0.0)

def failing():
    return lambda seen: (None if seen.time > 2.0 else 0.0, 0.0)
"""


@pytest.fixture
def replays(project):
    """Return a project with a saved collision for each test in the table."""
    filed(project)
    project.pytester.makepyfile(policies=POLICIES + MORE_POLICIES)
    source = ["import policies", ""]
    text = project.only_file.read_text()
    file = project.only_file
    for name, (policy, body, more, edits) in REPLAYS.items():
        world = "" if "world=" in more else "world=pafot.Highway(lanes=3), "
        source.append(
            f"@pafot.search({world}blame='ego', npcs=1, ads=policies.{policy}, {more})\n"
            f"def test_{name}(run):\n    {body}\n"
        )
        changed = text.replace("::test_gap", f"::test_{name}")
        for old, new in edits:
            assert re.search(old, changed), (name, old)
            changed = re.sub(old, new, changed, count=1)
        folder = file.parent.with_name(f"test_{name}")
        folder.mkdir()
        (folder / "a.pafot.yaml").write_text(changed)
    shutil.rmtree(file.parent)
    project.write("\n".join(source))
    return project


def test_replays_read_so(replays, snapshot):
    sessions = {
        "failed": ["-rN", "-k", "not accepted"],
        "accepted": ["-rx", "--pafot-today=2027-02-01", "-k", "accepted"],
        "compared": ["-rN", "--pafot-against=policies:slower", "-k", "test_fails or passes_and"],
    }
    assert {
        name: replays.run(*args, runs=0).stdout.str() for name, args in sessions.items()
    } == snapshot


# --- searches


KINDS = {
    "collision": (
        "policies.cruise",
        "blame='ego', shrink_runs=40",
        "assert not run.collision, run.explain()",
    ),
    "check": (
        "policies.cruise",
        "",
        "pafot.check(-run.ego.acceleration, name='braking', at_most=5.0, unit='m/s^2')",
    ),
    "measure": ("policies.cruise", "", "assert run.min_ttc > 1.0"),
    "error": ("policies.raises", "", "pass"),
    "hang": ("policies.hangs", "world=pafot.Highway(hang_limit=0.2), shrink_runs=0", "pass"),
    "flaky": ("policies.flaky", "SHORT, shrink_runs=0", "assert run.hardest_brake < 1"),
    "perceived": ("policies.blind", "SHORT", "assert round(float(run.ego.speed.max())) < 23"),
    "differs": (
        "policies.late",
        "npcs=1, genes=1, gene_seconds=20, ego_speed=22, instructions='cells', "
        "against=policies.early",
        "assert not run.collision",
    ),
    "skips": (
        "policies.cruise",
        "",
        "run.collision or pytest.skip('no')\n    assert not run.collision",
    ),
}
"""The policy, the arguments of a search and the body of its test, for several kinds of failures."""
POLICIES_OF_KINDS = """
import pytest_pafot as pafot

calls = []

def cruise():
    def drive(seen):
        ahead = [other for other in seen.others if other.lane == seen.ego.lane and other.x > seen.ego.x]
        late = any(other.x - seen.ego.x < 1.5 * (seen.ego.speed - other.speed) for other in ahead)
        return (-6.0 if late else min(28.0 - seen.ego.speed, 2.0)), 0.0
    return drive

def near(seen):
    return any(abs(other.x - seen.ego.x) < 10 for other in seen.others)

def raises():
    return lambda seen: (1 / (not near(seen)), 0.0)

def hangs():
    def drive(seen):
        is_near = near(seen)
        while is_near: pass  # in one line, which is interrupted
        return 0.0, 0.0
    return drive

def flaky():
    calls.append(1)
    brake = -3.0 if len(calls) % 2 else 0.0
    return lambda seen: (brake, 0.0)

class Blind:
    def __call__(self, seen):
        return (-9.0 if seen.others else 1.0), 0.0

blind = pafot.Perception(Blind, latency=0.1, range=0.0)

def late():
    return lambda seen: (0.0, 0.0)

def early():
    def drive(seen):
        ahead = [o.x - seen.ego.x for o in seen.others if o.lane == seen.ego.lane and o.x > seen.ego.x]
        return (-6.0 if min(ahead, default=99.0) < 45.0 else 0.0), 0.0
    return drive
"""


@pytest.fixture
def kinds(project, examined, shrinking):
    """Return a project with a search for each kind of failure, in sessions with all steps."""
    project.pytester.makepyfile(policies=POLICIES_OF_KINDS)
    tests = [
        f"@pafot.search(ads={policy}, {arguments})  # stop_after=1\ndef test_{name}(run):\n    {body}\n"
        for name, (policy, arguments, body) in KINDS.items()
    ]
    project.write("import policies\n\n" + "\n".join(tests))
    return project


def test_new_failures_read_so(kinds, monkeypatch, snapshot):
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(kinds.path / "summary.md"))
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    result = kinds.run("--pafot-report=page.html", runs=40, seed=2)
    texts = {"terminal": result.stdout.str(), "job": (kinds.path / "summary.md").read_text()}
    assert texts == snapshot


PASSES = marked("SHORT")
BLAMES_THE_EGO = """
@pafot.search(npcs=4, genes=4, gene_seconds=5, blame="ego", ads=lambda: slows)
def test_fault(run):
    assert run.responsibility != "npc"

def slows(seen):
    return (-2.0 if seen.ego.speed > 12 else 0.3), 0.0
"""
SKIPPED = """
@pytest.fixture
def ads():
    pytest.skip("no weights")

""" + marked("SHORT")


def test_searches_without_new_findings_read_so(project, monkeypatch, snapshot):
    def session(source, *args, **options):
        project.write(source)
        return project.run(*args, **options).stdout.str()

    texts = {
        "short": session(PASSES, runs=None),
        "without time": session(PASSES, "--pafot-max-time=0"),
        "an NPC is responsible": session(BLAMES_THE_EGO, runs=100),
        "generations": session(PASSES, "--pafot-generations=1", runs=None),
    }
    session(STOPS, runs=12)
    texts["only known"] = session(STOPS, runs=12, seed=2)
    project.pytester.makeini("[pytest]\npafot_generations = 0\n")
    texts["no generations"] = session(PASSES, runs=None)
    project.pytester.makeini("[pytest]\npafot_algorithm = magic\n")
    texts["wrong key"] = session(PASSES, "test_it.py")
    project.pytester.makeini("[pytest]\n")
    monkeypatch.setenv("CI", "true")
    texts["skipped on CI"] = session(SKIPPED)
    assert texts == snapshot


# --- the end of a session


def fail(error):
    def failing(*arguments, **named):
        raise error

    return failing


def test_problems_at_the_end_of_a_session_read_so(failing, monkeypatch, snapshot):
    (failing.path / "taken").mkdir()
    (failing.path / "elsewhere").mkdir()
    (failing.path / "out").symlink_to("elsewhere")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(failing.path / "none" / "summary.md"))
    outputs = ("--pafot-json=taken", "--pafot-report=out/page.html")
    texts = {"unwritable": failing.run(*outputs).stdout.str()}
    monkeypatch.delenv("GITHUB_STEP_SUMMARY")
    faults = {
        "records": ("plugin.reporter.unclaimed", ValueError("a fault")),
        "page": ("report.page.render_page", KeyboardInterrupt("a fault")),
        "summary": ("report.terminal.session_lines", ValueError("a fault")),
    }
    for name, (function, error) in faults.items():
        with monkeypatch.context() as patch:
            patch.setattr(f"pytest_pafot.{function}", fail(error))
            texts[name] = failing.run("--pafot-report=x.html", runs=0).stdout.str()
    failing.write("def test_other():\n    pass\n")
    failing.pytester.makeconftest("")
    texts["nothing to report"] = failing.run(
        "--pafot-report=y.html", "--pafot-allow-orphans"
    ).stdout.str()
    assert texts == snapshot


def test_sessions_that_end_early_read_so(project, monkeypatch, shrinking, snapshot):
    texts, out = {}, {"no_reraise_ctrlc": True}
    interrupted = IS_CUT.replace("SHORT", "SHORT, shrink_runs=20")
    for save in ("new", "none"):
        result = result_of(project, interrupted, f"--pafot-save={save}", **out)
        texts[f"interrupted, {save}"] = result.stdout.str()
        project.forget()
    with monkeypatch.context() as patch:
        patch.setattr("pytest_pafot.plugin.reporter.report_on", lambda report, when, **_: 1 / 0)
        texts["unreportable"] = project.run("-rN", **out).stdout.str()
    project.forget()
    monkeypatch.setenv("CI", "true")
    texts["exit in a fixture"] = result_of(project, EXITS).stdout.str()
    project.pytester.makeconftest(LEAVES)
    texts["exit in a hook"] = result_of(project, ALWAYS).stdout.str()
    project.pytester.makeconftest(SWALLOWS)
    texts["hidden failure"] = project.run("-rN", runs=0).stdout.str()
    assert texts == snapshot


def test_findings_that_are_not_saved_or_not_finished_read_so(
    failing, shrinking, examined, monkeypatch, snapshot
):
    corpus = failing.path / "pafot_corpus"
    texts = {"not wanted": failing.run("-rN", "--pafot-save=none").stdout.str()}
    corpus.write_text("a file where the folder should be")
    texts["a file instead of the folder"] = failing.run("-rN").stdout.str()
    corpus.unlink()
    (failing.path / "other").mkdir()
    corpus.symlink_to("other")
    texts["a link instead of the folder"] = failing.run("-rN").stdout.str()
    corpus.unlink()

    def end(turn, now, bench):
        turn.is_over = True
        raise OutOfBudget

    with monkeypatch.context() as patch:
        patch.setattr(Turn, "check", end)
        texts["not simplified"] = failing.run("-rN").stdout.str()
    for error in (OutOfTime(), IndexError("not here")):
        failing.forget()
        monkeypatch.setattr(steps, "EXAMINATIONS", {"decisions": partial(fails_later, error)})
        texts[f"not examined: {error!r}"] = failing.run("-rN", "--pafot-shrink-runs=0").stdout.str()
    assert texts == snapshot


def fails_later(error, *_):
    raise error
    yield


def test_failures_that_another_session_saved_meanwhile_read_so(saved, snapshot):
    file, elsewhere = saved.only_file, saved.path / "late"
    file.rename(elsewhere)
    late = f"def pytest_collection_finish():\n    import os\n    os.rename({str(elsewhere)!r}, {str(file)!r})\n"
    saved.pytester.makeconftest(CONFTEST + late)
    assert saved.run("-rN").stdout.str() == snapshot


# --- saved scenarios and tests that a session leaves out


def test_what_a_session_leaves_out_reads_so(saved, monkeypatch, snapshot):
    file = saved.only_file
    for number in range(6):
        shutil.copy(file, file.with_name(f"a-{number}.pafot.yaml"))
    saved.write(FAILING.replace("test_fails", "test_fails_fast"))
    texts = {"here": saved.run(runs=0).stdout.str()}
    monkeypatch.setenv("CI", "true")
    texts["on CI"] = saved.run("--pafot-json=pafot.json", runs=0).stdout.str()
    texts["orphans"] = saved.record["orphans"]
    monkeypatch.setattr("pytest_pafot.plugin.guard.MAX_FOLDERS", 1)
    texts["too many folders"] = saved.run(runs=0).stdout.str()
    saved.forget()
    saved.write(LEFT_OUT)
    not_collected = saved.run("-Wignore::pytest.PytestCollectionWarning", "-k", "other", runs=0)
    texts["not collected"] = not_collected.stdout.str()
    assert texts == snapshot


# --- comparison with a reference


def test_comparisons_read_so(project, snapshot):
    texts = {}

    def compared(name, now, before, *args, **options):
        policies(project, now, before)
        texts[name] = project.run(
            "-rN", AGAINST, "-pno:cacheprovider", *args, **options
        ).stdout.str()

    project.write(COMPARED.replace("MORE", ""))
    one, other = (ELSEWHERE.replace("PART", part) for part in "01")
    compared("no worse", one, f"{other}# before", "--pafot-report=page.html")
    compared("with itself", KEEPS, KEEPS)
    compared("worse", SPEEDS, KEEPS)
    compared("both fail", SPEEDS, f"{SPEEDS}# before", runs=0)
    compared("fixed", KEEPS, SPEEDS, runs=0)
    compared("broken reference", KEEPS, KEEPS.replace("observation:", "observation, more:"), runs=0)
    project.forget()
    compared(
        "search with a broken reference", SPEEDS, KEEPS.replace("(0.0, 0.0)", "observation.lanes")
    )
    assert texts == snapshot


def test_replays_and_the_search_of_their_test_read_so(project, snapshot):
    texts = {}
    for policy in ("careful", "braking"):
        fixed(project, policy)
        texts[policy] = searched(project, "-rN", runs=12)[0].stdout.str()
        project.forget()
    fixed(project, "careful")
    texts["few runs"] = project.run("-rN", "--pafot-max-time=0").stdout.str()
    assert texts == snapshot


# --- other worlds, algorithms and fixtures


OWN_ALGORITHM = marked("SHORT, algorithm=Own", "SHORT, algorithm='av-fuzzer', instructions='cells'",
                       "SHORT, algorithm='pafot', instructions='lanes'")  # fmt: skip


def test_worlds_and_algorithms_of_the_user_read_so(project, monkeypatch, snapshot):
    wrapped(project)
    project.run(runs=20)
    wrapped(project, "", "(5, 5)", "outcome")
    texts = {"other wrappers": project.run("-rN", "--pafot-strict-drift", runs=0).stdout.str()}
    wrapped(project)
    path = project.path / "test_it.py"
    path.write_text(path.read_text().replace("highway-v0", "highway-fast-v0"))
    texts["another environment"] = project.run("-rN", runs=0).stdout.str()
    project.forget()
    project.write("import itertools\nfrom gymnasium.wrappers import TransformAction\n" + DRAWING)
    texts["a wrapper draws"] = project.run("-rN").stdout.str()
    project.forget()
    project.pytester.makepyfile(own=OWN, test_it=SIMULATOR)
    monkeypatch.setenv("JUMPS_AT", "10000")
    project.run("--pafot-stop-after=1", runs=20)
    monkeypatch.setenv("JUMPS_AT", "20")
    texts["a vehicle jumps"] = project.run("-rN", runs=0).stdout.str()
    project.forget()
    texts["algorithms"] = result_of(
        project, "from own import Own\n" + OWN_ALGORITHM, "-v", runs=16
    ).stdout.str()
    assert texts == snapshot


DRAWING = """
calls = itertools.count()

def drawing(env):
    action = 3 if next(calls) % 2 else 1
    return TransformAction(env, lambda _: action, env.action_space)

WORLD = pafot.World("highway-v0", duration=2.0, wrappers=[drawing])

@pafot.search(SHORT, ads=lambda: lambda seen: 1, world=WORLD, shrink_runs=0)  # stop_after=1
def test_drives(run):
    assert run.ego.speed.mean() < 1
"""
SIMULATES = """
SCENARIO = pafot.Scenario(npcs=((pafot.PositionInstruction(2, 5.0),),), gene_seconds=5)

class Standing(pafot.Simulator):
    def start(self, vehicles, seed):
        self.cars, self.ticks = [[each.x, each.y, each.heading, each.speed] for each in vehicles], 0

    def step(self, controls):
        self.ticks += 1
        if self.ticks < 5:
            self.cars = [[each.x, each.y, each.heading, each.speed] for each in controls]

    def states(self):
        return self.cars

    def close(self):
        raise OSError("no")

def broken(observation):
    return observation.ego.sped, 0.0

def test_fails(pafot_simulate):
    assert not pafot_simulate(SCENARIO, lambda: broken).collision

def test_is_invalid(pafot_simulate):
    pafot_simulate(SCENARIO, lambda: lambda observation: (0.0, 0.0), pafot.SimulatorWorld(Standing, duration=5.0))
"""


def test_simulated_scenarios_read_so(project, snapshot):
    assert result_of(project, SIMULATES, "-W", "default").stdout.str() == snapshot


def test_what_cannot_be_decorated_or_rejected_reads_so(snapshot):
    errors = {}
    calls = {
        "object": lambda: pafot.search(ads="ads")(partial(print, 1)),
        "lambda": lambda: pafot.search(ads="ads")(lambda run: None),
        "reject": pafot.reject,
    }
    for name, call in calls.items():
        with pytest.raises((TypeError, Rejected)) as raised:
            call()
        errors[name] = raised.value
    assert errors == snapshot


def test_xfail_in_a_marked_function_reads_so(saved, snapshot):
    saved.write(
        "@pafot.search(SHORT)\ndef test_fails(run):\n    run.ads_error or pytest.xfail('issue 12')\n"
    )
    assert saved.run("-rN").stdout.str() == snapshot


# --- options


WRONG_VALUES = [
    {"marker": {"generations": -1}}, {"marker": {"seed": 2**80}}, {"marker": {"isolate": "perhaps"}},
    {"ini": "pafot_workers = 5000"}, {"ini": "pafot_max_time = nan"}, {"ini": "pafot_max_time = soon"},
    {"ini": "pafot_save = some"}, {"ini": "pafot_generations = as many"}, {"ini": "pafot_generations ="},
    {"ini": "pafot_isolate = perhaps"},
]  # fmt: skip
WRONG_OPTIONS = (
    "stop-after=one",
    "today=31.1.2027",
    "json=new/",
    "report=report.pdf",
    "report=report/",
    "report=page",
)


def test_wrong_values_of_options_read_so(project, monkeypatch, snapshot):
    monkeypatch.delenv("PYTEST_ADDOPTS")
    reference = result_of(project, PASSES, "--pafot-against=old_ads")
    errors = {"unrequested reference": reference.stdout.str()}
    for source in WRONG_VALUES:
        with pytest.raises(RequestError) as raised:
            settings(project, **source)
        errors[str(source)] = raised.value
    for option in WRONG_OPTIONS:
        result = project.run(f"--pafot-{option}", runs=None)
        assert result.ret == pytest.ExitCode.USAGE_ERROR
        errors[option] = next(line for line in result.errlines if "error:" in line).partition(
            "error:"
        )[2]
    assert errors == snapshot


def test_help_reads_so(project, monkeypatch, snapshot):
    monkeypatch.setenv("COLUMNS", "80")
    text = project.run("--help", runs=None, seed=None).stdout.str()
    assert re.search(r"(?ms)^search for traffic .*?\n\n", text)[0] == snapshot


# --- processes that died


forks = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")


@forks
def test_processes_that_died_in_an_earlier_session_read_so(project, snapshot):
    texts = {}
    cases = {
        "completes": ("None", None),
        "dies again": ("os._exit(9)", None),
        "is killed again": ("os.kill(os.getpid(), signal.SIGKILL)", None),
        "raises": ("1 / 0", None),
        "the world is gone": ("None", {"kind": "mine"}),
    }
    for name, (act, world) in cases.items():
        write(project, act)
        project.leave_behind(OWNER, world=world)
        texts[name] = project.run("-rN", runs=0).stdout.str()
        project.forget()
    project.write(RAISES_LATER)
    project.leave_behind(OWNER)
    texts["raises later"] = project.run("-rN", runs=0).stdout.str()
    project.write(FAILING)
    project.leave_crash("test_it.py::test_fails")
    texts["crash"] = project.run("-rN", runs=0).stdout.str()
    project.mend()
    texts["crash that became a failure"] = project.run("-rN", runs=0).stdout.str()
    assert texts == snapshot


RAISES_LATER = """
def drive(observation):
    if observation.time > 1:
        raise KeyError("lane")
    return 0.0, 0.0

@pafot.search(SHORT, ads=lambda: drive)
def test_it(run): pass
"""
ENDS = """
import os
from pytest_pafot.execution import runner

SESSION = os.getpid()

def ends(seen):
    if seen.time > WHEN and os.getpid() != SESSION:
        HOW
    return 0.0, 0.0

@pafot.search(SHORT, ads=lambda: ends, shrink_runs=0, world=pafot.Highway(hang_limit=0.1))  # stop_after=1
def test_ends(run):
    assert not run.collision
"""


@forks
@pytest.mark.processes
def test_processes_that_die_read_so(project, monkeypatch, snapshot):
    texts = {}

    def session(name, *args, how="os._exit(9)", when=1, **options):
        project.write(ENDS.replace("HOW", how).replace("WHEN", str(when)))
        result = project.run("-rN", *args, **{"apart": True, "runs": 4} | options)
        texts[name] = result.stdout.str()
        return result

    session("isolated", "--pafot-isolate")
    session("isolated replay", runs=0)
    session("no process of the session", "-pno:cacheprovider", runs=1)
    project.forget()
    raises = session("raises there", "--pafot-isolate", how="runner.run_recorded = None")
    lines = [line for line in raises.outlines if line.startswith("E ")]
    texts["raises there"] = "\n".join(lines)
    project.forget()
    monkeypatch.setattr("pytest_pafot.execution.runner.GRACE", 0.4)
    hangs = "sum(range(10**12))"
    session("hangs", "--pafot-isolate", how=hangs, apart=False)
    assert texts == snapshot


@forks
@pytest.mark.processes
def test_policies_that_end_or_stop_the_session_read_so(project, snapshot):
    texts = {}
    project.pytester.makeconftest(STUCK.replace("HANG", "swallow"))
    project.write(TESTS_OF_THE_STUCK)
    stuck = project.run("-rN", runs=36, seed=6, apart=True).stdout.str()
    # how deep the stack is depends on how long the session waits
    in_pause = r"(?m)^ +File .* in pause\n .*\n|^ +\[Previous line .*\n"
    texts["ignores an interrupt"] = re.sub(in_pause, "", stuck)
    texts["next session"] = project.run("-rN", runs=0, apart=True).stdout.str()
    project.forget()
    source = ENDS.replace(" and os.getpid() != SESSION", "").replace("HOW", "os._exit(0)")
    project.write(source.replace("WHEN", "1"))
    ended = project.run("-rN", "-pcacheprovider", fresh=True)
    texts["ends the session"] = ended.stdout.str() + ended.stderr.str()
    texts["session after that"] = project.run("-rN", "-pcacheprovider", apart=True).stdout.str()
    assert texts == snapshot


@forks
@pytest.mark.processes
def test_workers_read_so(project, snapshot):
    pytest.importorskip("xdist")
    project.write(SLOW + marked("SHORT, ads=slow"))
    texts = {
        "workers": project.run("--pafot-workers=2", "-pno:cacheprovider", runs=8).stdout.str(),
        "xdist": project.run("-n1", "--pafot-workers=2", runs=2).stdout.str(),
    }
    assert texts == snapshot


SLOW = """
import time

def slow():
    time.sleep(0.015)
    return lambda seen: (0.0, 0.0)
"""


@forks
@pytest.mark.processes
def test_replays_whose_process_died_after_the_end_read_so(project, monkeypatch, snapshot):
    texts = {}
    project.write(COMPARED.replace("MORE", ""))
    policies(
        project, SPEEDS, "import os\n\ndef make():\n    return lambda observation: os._exit(9)\n"
    )
    assert project.run(AGAINST, "-pcacheprovider", apart=True).ret == 9
    texts["reference"] = project.run(AGAINST, "-pcacheprovider", "-rN", apart=True).stdout.str()
    project.write(GAP.replace("WORLD", "pafot.Highway(lanes=3)"))
    filed(project)
    texts["isolated"] = replay(project, "dying", "--pafot-isolate", "-rN").stdout.str()
    assert replay(project, "dying", apart=True).ret == 9
    monkeypatch.setattr("pytest_pafot.execution.runner.METHOD", "spawn")
    before = "import pytest_pafot.execution.runner as pool\npool.METHOD = 'spawn'\n"
    texts["without fork"] = replay(project, "dying", "-rN", before=before).stdout.str()
    texts["debug"] = replay(project, "braking", "--pafot-debug", "-rN").stdout.str()
    assert texts == snapshot


def test_worse_failures_and_long_outputs_read_so(project, snapshot):
    project.write(ACCEPTS)
    project.pytester.makepyfile(planner=KEEPS)
    project.run("--pafot-stop-after=1", runs=16)
    project.accept()
    file = project.only_file
    file.write_text(re.sub(r", worst_closing_speed: [\d.]+", "", file.read_text()))
    texts = {"worse": project.run("-rN", "--pafot-stop-after=1", runs=16).stdout.str()}
    project.forget()
    printed = result_of(project, PRINTS, "-v", runs=40, seed=2)
    texts["long"] = [
        re.sub(r"^.\d+", "N", line) for line in printed.outlines if "pytest -s" in line
    ]
    assert texts == snapshot
