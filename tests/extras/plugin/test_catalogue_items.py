"""The items of `@pafot.catalogue`: one for each named scenario, and what becomes of them."""

import json
import re

import pytest

from pytest_pafot.extras.sweeps.entries import NAMES
from tests.helpers.sessions import section

POLICIES = """
def keeps_speed():
    return lambda observation: (0.0, 0.0)

def stays_behind():
    def drive(observation):
        ego = observation.ego
        gaps = [each.x - ego.x - each.length for each in observation.others if abs(each.y - ego.y) < 2.5]
        return (-6.0 if any(0 < gap < 30 for gap in gaps) else 0.0), 0.0
    return drive

class Named:
    def __init__(self, text):
        self.action = (float(text), 0.0)

    def __call__(self, observation):
        return self.action
"""


@pytest.fixture
def project(project):
    project.pytester.makepyfile(policies=POLICIES)
    return project


def run(project, source, *args, **options):
    """Run a session with a test file."""
    project.write(f"import policies\n\n{source}")
    return project.run("-v", "-rs", *args, **options)


def collected(project, source, *args):
    """Return the names of the items of a test file without the file."""
    project.write(source)
    lines = project.run("--collect-only", "-q", *args).outlines
    return [line.removeprefix("test_it.py::") for line in lines if line.startswith("test_it.py::")]


def items_of(result):
    """Return the results of the items of a session, by their names without the file."""
    item, outcome = r"test_it\.py::(\S+)", "(PASSED|FAILED|SKIPPED|ERROR)"
    text = "\n".join(result.outlines)
    found = dict(re.findall(rf"^{item} {outcome}", text, re.MULTILINE))
    workers = re.findall(rf"^\[gw\d\] \[ *\d+%\] {outcome} {item}", text, re.MULTILINE)
    return found | {name: result for result, name in workers}


COLLIDES = "def test_drives(run):\n    assert not run.collision\n"


def test_each_entry_of_a_group_is_an_item(project):
    names = [*(name for name in NAMES if name.startswith("classic/")), "r157/cut-in"]
    of_group = collected(project, f'@pafot.catalogue("classic", "r157/cut-in")\n{COLLIDES}')
    assert of_group == [f"test_drives[{name}]" for name in names]
    assert collected(project, f"@pafot.catalogue\n{COLLIDES}") == [f"test_drives[{name}]" for name in NAMES]


def test_item_fails_passes_or_is_skipped_by_what_became_of_the_run(project):
    result = run(
        project,
        f"""
@pafot.catalogue("r157/cut-in", "r157/following", "junction/merge", ego_speed=16.0)
{COLLIDES}

@pafot.catalogue("r157/cut-in", gap=0.0)
def test_unavoidable(run):
    assert not run.collision

@pafot.catalogue("r157/cut-in", ads="policies:Named:3.0")
def test_not_as_asked(run):
    assert run.ego.speed.max() < 90

@pafot.catalogue("r157/cut-in")
def test_declines(run):
    pytest.skip("not for me")
""",
    )
    assert items_of(result) == {
        "test_drives[r157/cut-in]": "FAILED",
        "test_drives[r157/following]": "PASSED",
        "test_drives[junction/merge]": "SKIPPED",
        "test_unavoidable[r157/cut-in]": "SKIPPED",
        "test_not_as_asked[r157/cut-in]": "SKIPPED",
        "test_declines[r157/cut-in]": "SKIPPED",
    }
    result.stdout.fnmatch_lines_random(
        [
            "SKIPPED *test_it.py:*: r157/cut-in: unavoidable*",
            "SKIPPED *this world cannot drive it: world: expected a road on which another way is merging *",
            "SKIPPED *unavoidable: collision after 2.* s, closing at *no reference driver avoids it",
            "SKIPPED *not as asked: ego speed asked 16.7 m/s, was *",
            "SKIPPED *not as asked: skipped: the run says nothing about the policy",
        ]
    )


def test_failed_item_tells_the_scenario_its_source_and_who_avoids_it(project):
    told = section(run(project, f'@pafot.catalogue("r157/cut-in")\n{COLLIDES}'), "test_drives")
    pytest.LineMatcher(told.splitlines()).fnmatch_lines(
        [
            ">   *assert not run.collision",
            "test_it.py:*: AssertionError",
            "*Captured pafot call*",
            "r157/cut-in: A slower vehicle changes into the ego's lane, ahead of it.",
            "source     UN R157, after ASAM OSC-ALKS 4.4",
            "result     collision after 6.3 s, *; careful-human avoids it",
            "  The ego is responsible.",
        ]
    )
    assert "catalogue_item.py" not in told


def test_policy_is_a_fixture_a_factory_or_its_name(project):
    result = run(
        project,
        """
@pytest.fixture
def careful():
    return policies.stays_behind

@pafot.catalogue("r157/cut-in", ads="careful")
def test_fixture(run):
    assert not run.collision

@pafot.catalogue("r157/cut-in", ads=policies.stays_behind)
def test_factory(run):
    assert not run.collision

@pafot.catalogue("r157/cut-in", ads="policies:stays_behind")
def test_name(run):
    assert not run.collision

@pafot.catalogue("r157/side-vehicle", ads="policies:Named:-1.0")
def test_name_with_argument(run):
    assert run.ego.speed.min() < 1

@pafot.catalogue("r157/cut-in")
def test_default(run):
    assert run.collision
""",
    )
    result.assert_outcomes(passed=5)


def test_world_is_that_of_the_mark_or_else_of_the_fixture(project):
    result = run(
        project,
        """
@pytest.fixture
def pafot_world():
    return pafot.Highway(lanes=5, duration=9.0)

@pafot.catalogue("r157/side-vehicle")
def test_fixture(run):
    assert (len(run.trace.lanes), run.duration) == (5, 9.0)

@pafot.catalogue("r157/side-vehicle", world=pafot.Highway(lanes=3))
def test_argument(run):
    assert (len(run.trace.lanes), run.duration) == (3, 20.0)

@pafot.catalogue("r157/side-vehicle", world="pytest_pafot:Highway")
def test_name_of_argument(run):
    assert (len(run.trace.lanes), run.duration) == (4, 20.0)

@pafot.catalogue("junction/crossing", world=pafot.World("intersection-v0", planner_hz=5))
def test_junction(run):
    assert run.ego.speed[0] == 10.0
""",
    )
    result.assert_outcomes(passed=4)


def test_wrong_mark_fails_its_own_items_only(project):
    result = run(
        project,
        """
@pafot.catalogue("r157/cut-inn")
def test_name(run): pass

@pafot.catalogue("r157/cut-in", ego_sped=3.0)
def test_number(run): pass

@pafot.catalogue("r157/cut-in", ego_speed="fast")
def test_value(run): pass

@pafot.catalogue("r157/cut-in", ads=3)
def test_ads(run): pass

@pafot.catalogue("r157/cut-in")
def test_without_run(): pass

@pafot.catalogue("r157/cut-in")
def test_returns(run):
    return run.duration

@pafot.catalogue("r157/following")
def test_right(run): pass

def test_other(): pass
""",
    )
    result.assert_outcomes(failed=6, passed=2)
    result.stdout.fnmatch_lines_random(
        [
            "catalogue: expected one of r157/cut-in, *, received 'r157/cut-inn'; did you mean 'r157/cut-in'?",
            "@pafot.catalogue: expected ads, world or one of ego_speed, *'ego_sped'; did you mean 'ego_speed'?",
            "r157/cut-in: ego_speed: expected a number, received 'fast'",
            "ads: expected a factory, *, received 3*",
            "expected a parameter 'run' that is free for the simulated run; write `def test_without_run(run)`*",
            "expected the test function to assert and to return None, received the return value *",
        ]
    )


def test_missing_fixture_of_the_policy_is_an_error_of_its_item(project):
    project.pytester.makeconftest("")
    result = run(project, f'@pafot.catalogue("r157/cut-in")\n{COLLIDES}\n\ndef test_other(): pass\n')
    result.assert_outcomes(errors=1, passed=1)
    result.stdout.fnmatch_lines(["*fixture 'ads' not found"])


def test_number_of_some_entries_changes_only_those(project):
    result = run(
        project,
        """
@pafot.catalogue("r157/cut-in", "r157/side-vehicle", gap=40.0)
def test_gap(run):
    gaps = [each.asked for each in run.asked if each.what == "gap"]
    assert gaps == ([40.0] if len(run.asked) > 2 else [])
""",
    )
    result.assert_outcomes(passed=2)


def test_items_are_selected_by_name_and_mark(project):
    source = f"@pafot.catalogue\n{COLLIDES}\n\ndef test_other(): pass\n"
    result = run(project, source, "-k", "following or swerving", generations=None, seed=None)
    assert items_of(result) == {
        "test_drives[r157/following]": "PASSED",
        "test_drives[r157/swerving-leader]": "PASSED",
    }
    of_mark = collected(project, source, "-m", "pafot and pafot_catalogue")
    assert (len(of_mark), "test_other" in of_mark) == (len(NAMES), False)


def test_class_parameters_and_fixtures_are_those_of_any_test(project):
    result = run(
        project,
        """
@pytest.fixture
def limit(request):
    return 90.0

@pafot.catalogue("r157/following", "r157/side-vehicle")
class TestGroup:
    def test_method(self, run, limit):
        assert run.ego.speed.max() < limit

    @pytest.mark.parametrize("least", [0, 1])
    def test_parameters(self, run, least):
        assert run.duration > least
""",
    )
    result.assert_outcomes(passed=6)
    assert "TestGroup::test_parameters[r157/following-0]" in items_of(result)


@pytest.mark.processes
def test_workers_of_xdist_give_the_same_results(project):
    pytest.importorskip("xdist")
    source = f'@pafot.catalogue("r157", "junction")\n{COLLIDES}'
    alone = items_of(run(project, source))
    assert items_of(run(project, source, "-n2")) == alone
    assert {*alone.values()} == {"FAILED", "PASSED", "SKIPPED"}


def test_session_without_the_mark_imports_no_catalogue(project):
    project.pytester.makeconftest("")
    project.write(
        "import json, sys\n\ndef test_modules():\n"
        "    with open('modules.json', 'w') as file:\n        json.dump(sorted(sys.modules), file)\n"
    )
    project.run(fresh=True).assert_outcomes(passed=1)
    names = json.loads((project.path / "modules.json").read_text())
    assert not [name for name in names if name.startswith(("pytest_pafot.extras", "pytest_pafot.world", "numpy"))]


def test_mark_that_a_hook_adds_after_the_collection_drives(project):
    conftest = project.path / "conftest.py"
    hook = (
        "\n\ndef pytest_collection_modifyitems(items):\n    for item in items:\n"
        "        item.add_marker(pytest.mark.pafot_catalogue('r157/cut-in'))\n"
    )
    conftest.write_text(conftest.read_text() + hook)
    project.write(
        "@pytest.mark.parametrize('run', ['r157/cut-in'])\n"
        "def test_it(run, ads, pafot_world):\n    assert run.duration > 0\n"
    )
    project.run().assert_outcomes(passed=1)  # a text has no duration
