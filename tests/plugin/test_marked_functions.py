"""Marked functions: which are allowed, and what happens to what they raise."""

from functools import partial

import pytest

import pytest_pafot as pafot
from pytest_pafot.corpus.reader import load
from pytest_pafot.oracle.run import Rejected
from tests.plugin.conftest import shows


def test_function_that_returns_a_value_is_refused(project):
    project.write("@pafot.search(SHORT)\ndef test_returns(run):\n    return run.min_ttc > 1\n")
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ["*the test function returned False, but it must assert*Write `assert ...`*"]
    )
    assert project.files == []


def test_mark_takes_the_name_of_a_policy_with_its_argument(project):
    project.pytester.makepyfile(named="class Planner:\n    def __init__(self, text):\n        assert text == 'a:b'\n"
                                "    def __call__(self, observation):\n        return 0.0, 0.0\n")  # fmt: skip
    search = "@pafot.search(SHORT, ads='named:Planner:a:b')\ndef test_search(run):\n    assert run.duration > 1\n"
    project.write(search + search.replace("Planner", "Planer").replace("test_search", "test_wrong"))
    result = project.run("-ppytester", "-opythonpath=.", "--pafot-runs=2")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(
        ["@pafot.search(ads=...): expected a factory in the module named, *'named:Planner'?"]
    )


ONCE = ("pytest_benchmark", "pytest_codspeed", "syrupy")
COLLECTS = "*received one that uses the fixture '*', which only collects failures*Use `assert`*"
FIXTURES = {"subtests": COLLECTS, "indirectly": COLLECTS}
FIXTURES |= {
    f"of_{package}": f"*received one that uses the fixture 'of_{package}' from {package}*"
    for package in ONCE
}
OF_PACKAGE = """
@pytest.fixture
def of_PACKAGE():
    return type("Once", (), {"__module__": "PACKAGE.fixture"})()
"""
INDIRECTLY = """
@pytest.fixture
def indirectly(subtests):
    return subtests

def test_other(indirectly):
    with indirectly.test("part"):
        pass
"""


def test_fixture_that_collects_failures_or_is_for_one_call_is_refused(project):
    tests = (
        f"@pafot.search(SHORT)\ndef test_{each}(run, {each}):\n    assert {each} is None\n"
        for each in FIXTURES
    )
    project.write(
        "\n".join([*(OF_PACKAGE.replace("PACKAGE", each) for each in ONCE), INDIRECTLY, *tests])
    )
    result = project.run()
    result.assert_outcomes(failed=len(FIXTURES), passed=1)
    for name, line in FIXTURES.items():
        shows(result, f"test_{name}", line)
    assert project.files == []


def test_recorder_of_warnings_holds_those_of_one_run(project):
    project.write(
        "import warnings\n\n@pafot.search(SHORT)\ndef test_x(run, recwarn):\n"
        "    warnings.warn(run.scenario.id)\n    assert [str(each.message) for each in recwarn] == [run.scenario.id]\n"
    )
    project.run("--pafot-runs=8").assert_outcomes(passed=1)


def test_failures_collected_by_pytest_check_fail_the_search(project):
    project.pytester.makepyfile(
        pytest_check="failures = []\n\ndef is_true(x):\n    x or failures.append(x)\n\n"
        "def any_failures():\n    return bool(failures)\n"
    )
    test = (
        "import pytest_check\n\n@pafot.search(SHORT)\ndef test_x(run):\n"
        "    pytest_check.is_true(run.duration > LEAST)\n"
    )
    project.write(test.replace("LEAST", "0"))
    project.run().assert_outcomes(passed=1)
    project.write(test.replace("LEAST", "99"))
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ["*received one that uses pytest-check, which only collects failures*"]
    )


def test_unsuitable_function_is_one_error_and_others_run(project):
    project.write("""
import unittest

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

@pytest.mark.pafot
def test_other():
    pass
""")
    result = project.run()
    result.assert_outcomes(errors=9, passed=1)
    told = {
        "test_async": "*expected a synchronous function, received an async function*Write `def`*",
        "TestCase.test_method": "*received a method of TestCase, a unittest.TestCase*",
        "test_nothing": "expected a parameter 'run'*Add it, as in `def test_nothing(run)`",
        "test_misspelt": "*expected a parameter 'run'*received the parameters (rnu). Add it*",
        "test_double": "*expected the parameter 'run' to be free for the simulated run*",
        "test_raw": "*Mark the test with @pafot.search(...)*",
        "test_bare": "*expected the decorator @pafot.search, received the mark @pytest.mark.pafot*",
        "test_given": "*expected the decorator @pafot.search, received the mark @pytest.mark.pafot*",
    }
    for name, line in told.items():
        shows(result, name, line)


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


@pytest.mark.parametrize("target", [partial(print, 1), lambda run: None], ids=["object", "lambda"])
def test_what_pytest_does_not_collect_cannot_be_decorated(target):
    with pytest.raises(
        TypeError, match=r"received (<function|functools.partial).* does not collect"
    ):
        pafot.search(ads="ads")(target)


def test_a_method_has_its_own_files(project):
    project.write("""
class TestClass:
    @pafot.search(SHORT)  # stop_after=1
    def test_fails(self, run):
        assert not run
""")
    project.run().assert_outcomes(failed=2)
    assert "TestClass.test_fails" in project.files[0]
    result = project.run("-v", runs=0)
    result.stdout.fnmatch_lines(
        [f"test_it.py::TestClass::test_fails[[]saved-{project.only_id}[]] FAILED*"]
    )


def test_given_and_search_on_one_function_are_refused(project):
    given, search = "@given(number=st.integers())", "@pafot.search"
    project.write(
        "from hypothesis import given, strategies as st\n\n"
        f"{given}\n{search}\ndef test_given_first(run, number):\n    pass\n\n"
        f"{search}\n{given}\ndef test_search_first(run, number):\n    pass\n"
    )
    result = project.run(plugins=("hypothesispytest",))
    result.assert_outcomes(errors=2)
    told = "*expected @pafot.search or @given, received both*pafot_simulate*"
    for name in ("test_given_first", "test_search_first"):
        shows(result, name, told)


WRONG = [
    ("colour='red'", "*(colour=...): expected one of ads, *"),
    ("5", "*expected only keyword arguments, received (5,)*"),
    (
        "today='a'",
        "*this option applies to the whole session. Use --pafot-today on the command line*",
    ),
    ("blame='npc'", "*(blame=...): expected any or ego, received 'npc'. blame='ego'*"),
    ("ads=3", "*(ads=...): expected the name of a fixture or a factory*received 3*"),
    (
        "world=pafot.Highway",
        "*(world=...): expected pafot.Highway(...), pafot.World(...)*received <class*. Call it: Highway(...)",
    ),
    (
        "lanes=3",
        "*(lanes=...): expected an argument of a search*. Write world=pafot.Highway(lanes=...)*",
    ),
    ("generations=0", "*(generations=0): expected at least 1, because 0 generations test nothing*"),
    ("shrink_runs=-1", "*(shrink_runs=...): expected a whole number, at least 0, received -1*"),
    (
        "algorithm='pytest:Nobody'",
        "*algorithm: expected a name in the module pytest, received 'pytest:Nobody'*",
    ),
    (
        "algorithm='magic'",
        "*(algorithm=...): expected random, pafot, * or random-manoeuvre, received 'magic'*",
    ),
]
"""Arguments that are an error of their item before any fixture, and the error's text."""


def told_of(project, cases, before=""):
    """Return a session's result. The failure of each of these arguments tells its message."""
    tests = [
        f"@pafot.search({arguments})\ndef test_{n}(run):\n    pass\n"
        for n, (arguments, _) in enumerate(cases)
    ]
    project.write("\n".join([before, *tests, "def test_other():\n    pass\n"]))
    result = project.run()
    for n, (_, message) in enumerate(cases):
        shows(result, f"test_{n}", message)
    result.stdout.no_fnmatch_line("*another exception occurred*")
    return result


def test_wrong_argument_is_an_error_before_any_fixture(project):
    result = told_of(
        project, WRONG, "@pytest.fixture\ndef ads():\n    raise RuntimeError('set up')\n"
    )
    result.assert_outcomes(errors=len(WRONG), passed=1)
    result.stdout.no_fnmatch_line("All traceback entries are hidden*")
    assert "set up" not in result.stdout.str()


REFUSED = [
    ("npcs=9", "*npcs: expected 1 to 8 NPCs*received 9*"),
    (
        "gene_seconds=0",
        "*gene_seconds: expected a duration of more than 0 s and at most 86400 s, received 0*",
    ),
    (
        "SHORT, instructions='cell'",
        "*instructions: expected one of cells, lanes, both, but received 'cell'*",
    ),
    ("ego_lane=7", "*ego_lane*"),
    (
        "world=pafot.World('highway-v0', config={'colour': 1})",
        "*(world=...): config: expected *received colour*",
    ),
    ("fitness='best'", "*(fitness=...): *'best'*"),
    ("fitness=lambda trace: 'high'", "*fitness: expected *"),
]
"""Arguments that only a world or a run can refuse."""


def test_argument_refused_by_world_or_run_fails_item(project):
    result = told_of(project, REFUSED)
    result.assert_outcomes(failed=len(REFUSED), passed=1)
    result.stdout.no_fnmatch_line("*did not finish. Its findings so far are reported*")


def test_missing_ads_fixture_suggests_a_similar_name(project, monkeypatch):
    monkeypatch.setenv("COLUMNS", "70")
    project.write("@pafot.search(ads='adss')\ndef test_drive(run):\n    pass\n")
    project.run().stdout.fnmatch_lines(
        [
            "the fixture 'adss', which must return the policy's factory, was not",
            "  found. Did you mean 'ads'[?]",
            "    def adss():",
            'Or name another fixture with @pafot.search(ads="..."), or pass a',
            "  factory: @pafot.search(ads=MyPlanner).",
        ]
    )


def test_summary_line_names_the_test_only_once(project):
    project.write(
        "@pafot.search(ads='tmp_path')\ndef test_drive(run):\n    pass\n\n@pafot.search\ndef test_other():\n    pass\n"
    )
    project.run().stdout.fnmatch_lines(
        [
            "FAILED test_it.py::test_drive[[]search[]] - Failed: expected the fixture 'tmp_path' to return a factory*",
            "ERROR test_it.py::test_other - Failed: expected a parameter 'run'*",
        ]
    )


def test_skip_outside_the_test_function_is_an_error(project):
    calls = ["pytest.skip('no GPU')", "pytest.importorskip('no_such_module')", "pytest.xfail('')"]
    cases = [(where, call) for where in ("factory", "fitness") for call in calls]
    arguments = {"factory": "ads", "fitness": "fitness"}
    project.write(
        "\n".join(
            f"def other_{n}(*args):\n    {call}\n\n"
            f"@pafot.search(SHORT, {arguments[where]}=other_{n})\ndef test_drive_{n}(run):\n    pass\n"
            for n, (where, call) in enumerate(cases)
        )
    )
    result = project.run()
    result.assert_outcomes(failed=len(cases))
    for n, (where, _) in enumerate(cases):
        told = f"*the {where}* raised *but a skip there would hide that *Call pytest.skip() in the fixture or*"
        shows(result, f"test_drive_{n}", told)


def test_xfail_in_the_test_function_hides_no_failure(saved):
    source = "@pafot.search(SHORT)\ndef test_fails(run):\n    if not run.ads_error:\n        pytest.xfail('issue 12')\n"
    saved.write(source)
    result = saved.run()
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["*called pytest.xfail('issue 12'), which would hide a failure. *"])


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
    result.stdout.fnmatch_lines(["  4 runs (2 skipped)* took * s."])


@pytest.mark.parametrize(
    "skip", ["pytest.skip('not today')", "raise unittest.SkipTest('not today')"]
)
def test_skipping_every_scenario_skips_the_test(project, skip):
    project.write(f"import unittest\n\n@pafot.search(SHORT)\ndef test_skips(run):\n    {skip}\n")
    result = project.run("-rs")
    result.assert_outcomes(skipped=1)
    result.stdout.fnmatch_lines(["SKIPPED*not today"])
    assert project.files == []


def test_reject_outside_a_search_explains_its_use():
    with pytest.raises(Rejected, match=r"discards a scenario in a @pafot.search test"):
        pafot.reject()


def test_any_other_exception_of_test_function_is_finding(project):
    raised = ["GeneratorExit", "Panic('lost')", "Mute", "MuteAndExits"]
    classes = """
class Panic(BaseException):
    pass

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
    project.run(runs=12).stdout.fnmatch_lines(["FAILED * new failures in *"] * len(raised))
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
    result.stdout.fnmatch_lines(
        ["*Timeout*", f"FAILED test_it.py::test_hangs[[]saved-{project.only_id}[]]*"]
    )
