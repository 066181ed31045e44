"""After a search, findings are confirmed, shrunk and limited, and none is lost."""

from types import SimpleNamespace

import pytest
from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
import pytest_pafot.searches.refine.simplest

# pytester forgets modules that a run imports; reading them is slow
import pytest_pafot.world.engines.gym_replay
from example_ads import constant_speed
from pytest_pafot.corpus.reader import load
from pytest_pafot.findings.finding import FailureRate
from pytest_pafot.findings.shrink import OutOfBudget, described, sort_key
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.refine import steps
from pytest_pafot.searches.refine.simplest import (
    ROLLOUTS,
    ROLLOUTS_IN_KERNEL,
    Turn,
    rollouts_for,
    starts_of,
)
from pytest_pafot.support.text import capitalised
from pytest_pafot.world import Highway
from pytest_pafot.world.driving.policy import Policy
from tests.plugin.conftest import labels
from tests.plugin.test_progress import ON_A_TERMINAL

COLLIDES = """
@pafot.search(SHORT)  # stop_after=1
def test_collides(run):
    assert not run.collision
"""


pytestmark = pytest.mark.usefixtures("shrinking")


@pytest.fixture
def collides(project):
    project.write(COLLIDES)
    return project


def test_gene_start_is_ego_state_at_that_tick():
    scenario = Scenario(npcs=((PositionInstruction(4, 20.0),) * 3,), gene_seconds=5.0)
    run = Run(Highway(duration=12.0).rollout(scenario, lambda: lambda observation: (1.0, 0.0)))
    assert starts_of(run, 26.8) == ((1, 22.0), (1, 26.8), (1, 26.8))
    assert starts_of(run, 40.0) == ((1, 22.0), (1, 27.0), (1, 32.0))


def test_run_off_the_road_has_no_later_start():
    scenario = Scenario(npcs=((PositionInstruction(5, 10.0),) * 2,), gene_seconds=5.0)
    run = Run(Highway(duration=10.0).rollout(scenario, lambda: lambda observation: (0.0, -0.05)))
    assert run.off_road
    assert starts_of(run, 26.8) == ()


def run(project, *args, **kwargs):
    """Run a session with a seed whose finding takes few runs to shrink."""
    return project.run_once(*args, **{"runs": 40, "seed": 2, **kwargs})


def test_shrunk_finding_is_announced_once_and_nothing_is_left_to_shrink(collides):
    result = run(collides)
    result.assert_outcomes(failed=2)
    result.stdout.no_fnmatch_line("*note:*")
    (line,) = [line for line in result.outlines if line.startswith("pafot: found ")]
    assert line.endswith(f": test_it.py::test_collides[saved-{collides.only_id}]")


def test_shrunk_file_retains_name_and_size_as_found(collides):
    run(collides, "--pafot-shrink-runs=0")
    as_found, name = load(collides.only_file), collides.only_file
    name.unlink()
    run(collides)
    assert collides.only_file == name
    finding = load(name)
    assert finding.shrunk.before == described(as_found.scenario, as_found.longest_run)
    assert finding.signature == as_found.signature
    assert finding.id.endswith(as_found.scenario.id)
    assert sort_key(finding.scenario) < sort_key(as_found.scenario)
    assert finding.shrunk.is_minimal
    assert 0 < finding.shrunk.rollouts <= 300


def test_existing_shrunk_file_is_no_new_finding(collides):
    """Two processes may search the same item: the second then finds the first's file, which is already shrunk."""
    run(collides)
    first = collides.contents
    collides.only_file.rename(collides.path / "kept")
    run(collides)
    assert collides.contents == first


INTERRUPTED = """
seen = []

@pafot.search(SHORT)  # stop_after=1
def test_interrupted(run):
    seen.append(run)
    if len(seen) == LIMIT:
        STOP
    assert run.scenario.id == ''
"""


@pytest.mark.parametrize("save", ["new", "none"])
@pytest.mark.parametrize("limit", [2, 4])
def test_interrupted_search_loses_nothing_and_says_how_to_shrink_later(project, save, limit):
    source = INTERRUPTED.replace("LIMIT", str(limit)).replace("STOP", "raise KeyboardInterrupt")
    project.write(source.replace("# stop_after=1" if limit == 2 else "", ""))
    result = run(project, f"--pafot-save={save}", no_reraise_ctrlc=True)
    result.stdout.fnmatch_lines(
        ["pafot: found *", "  note: * --pafot-seed=2", "*KeyboardInterrupt*"]
    )
    if save == "new":
        name = f"FAILED test_it.py::test_interrupted[saved-{project.only_id}]"
        assert name in result.stdout.str()
        assert load(project.only_file).shrunk is None


def test_process_death_while_shrinking_preserves_the_finding(project):
    project.write("import os\n" + INTERRUPTED.replace("LIMIT", "4").replace("STOP", "os._exit(9)"))
    run(project, apart=True)
    assert load(project.only_file).shrunk is None
    project.write(
        "@pafot.search(SHORT)\ndef test_interrupted(run):\n    assert run.scenario.id == ''\n"
    )
    assert "(pid " in run(project, "--pafot-stop-after=1").stdout.str()


def test_finding_that_time_cuts_says_so_everywhere(project, monkeypatch):
    def check(turn, now, bench):
        turn.is_over = True
        raise OutOfBudget

    monkeypatch.setattr(Turn, "check", check)
    project.write(
        "@pafot.search(SHORT)  # stop_after=1\ndef test_fails(run):\n    assert run.scenario.id == ''\n"
    )
    result = run(project, "--pafot-json=pafot.json", "--pafot-report=page.html")
    result.assert_outcomes(failed=2)
    told = project.record.findings[0].unshrunk
    assert f"{capitalised(told)}." in result.outlines
    assert f"new ({told})" in (project.path / "page.html").read_text()
    assert load(project.only_file).shrunk is None


def test_work_on_findings_asks_for_as_many_decisions_as_the_search(project, monkeypatch):
    monkeypatch.setattr(steps, "LEAST_DECISIONS", 300)
    project.write(
        "@pafot.search(npcs=4)\ndef test_fails(run):\n    assert len(run.scenario.npcs) < 3\n"
    )

    def session(*options):
        project.forget()
        project.run_once("--pafot-json=pafot.json", *options, runs=2)
        (search,) = project.record.searches
        asked = [search.decisions[what] for what in ("search", "confirm", "shrink", "moment")]
        is_limited = any("--pafot-shrink-runs=N" in note for note in search.notes)
        return asked[0], sum(asked[1:]), project.contents, is_limited

    first, refining, files, is_limited = session()
    # and what confirms the finding, before its simplification
    assert 0 < refining <= max(first, 300) + 300
    assert session("--pafot-workers=2")[1:3] == (refining, files)
    first, refining, other, is_later_limited = session("--pafot-shrink-runs=300")
    assert refining > 2 * first
    assert other != files
    assert (is_limited, is_later_limited) == (True, False)


def test_simplification_unfit_for_the_road_is_skipped(monkeypatch):
    """From the second gene on, the ego would start in the outer lane, which has no room for six NPCs around it."""
    starts = ((1, 22.0), (0, 22.0), (0, 22.0))
    monkeypatch.setattr(
        pytest_pafot.searches.refine.simplest, "starts_of", lambda run, top_speed: starts
    )

    def holds(run):
        assert len(run.scenario.npcs) < 6 or min(map(len, run.scenario.npcs)) < 2

    space = {"npcs": 6, "ego_lane": 1, "genes": 3, "gene_seconds": 2}
    result = pafot.explore(
        constant_speed.make, holds=holds, runs=2, shrink_runs=400, seed=1, **space
    )
    (finding,) = result.findings
    scenario = finding.scenario
    assert (len(scenario.npcs), scenario.ego_lane, scenario.genes) == (6, 1, 2)


def rollouts_without_an_option(ads):
    request = SimpleNamespace(settings=SimpleNamespace(shrink_runs=None))
    return rollouts_for(SimpleNamespace(request=request, world=Highway(), policy=Policy(ads)))


def test_vehicle_class_in_the_kernel_gets_more_rollouts():
    class Near(IDMVehicle):
        TIME_WANTED = 0.5

    class Coasts(IDMVehicle):
        def act(self, action=None):
            self.action = {"steering": 0.0, "acceleration": 0.0}

    in_kernel = {rollouts_without_an_option(ads) for ads in (IDMVehicle, Near)}
    others = (Coasts, lambda: lambda observation: (0.0, 0.0))
    assert in_kernel == {ROLLOUTS_IN_KERNEL}
    assert {rollouts_without_an_option(ads) for ads in others} == {ROLLOUTS}


def test_unrepeatable_finding_is_flaky_and_not_shrunk(project):
    project.write("""
calls = []

def flaky():
    calls.append(1)
    brake = -3.0 if len(calls) % 2 else 0.0
    return lambda observation: (brake, 0.0)

@pafot.search(SHORT, ads=flaky)  # stop_after=1
def test_brakes(run):
    assert run.hardest_brake < 1
""")
    run(project).stdout.fnmatch_lines(["Flaky: * 5 of 10 runs.", "  hardest-brake-*(new, flaky)."])
    finding = load(project.only_file)
    assert "speed of the ego differs by 0.2 m/s" in finding.flaky
    assert finding.rate == FailureRate(failing=5)
    assert finding.shrunk is None


def test_a_flaky_file_that_passes_is_called_flaky(collides):
    run(collides)
    file = collides.only_file
    file.write_text(file.read_text().replace("# xfail", 'flaky: "in highway-env: safe"\n# xfail'))
    collides.write(COLLIDES.replace("assert not run.collision", "pass"))
    result = run(collides, "-v", runs=0)
    assert "PASSED (flaky)" in result.stdout.str()
    assert labels(result) == "1 flaky"


IMPATIENT = """
import pytest
from pytest_pafot.plugin.session import SHARED

@pytest.fixture
def ads(pytestconfig):
    pytestconfig.stash[SHARED].progress_seconds = 0.0
    return lambda: lambda observation: (0.0, 0.0)
"""


def test_log_has_one_line_for_each_finding(project):
    project.pytester.makeconftest(IMPATIENT)
    gap = '    pafot.check(run.min_distance, name="gap", at_least=12.0)\n'
    project.write(COLLIDES.replace("# stop_after=1", "") + gap)
    log = run(project).stdout.str().partition(" FAILURES ")[0].splitlines()
    ids = [name.rpartition("/")[2].removesuffix(".pafot.yaml") for name in project.files]
    assert [sum(f"saved-{id_}" in line for line in log) for id_ in ids] == [1, 1]
    assert not any(f"simplifying {id_}" in line for line in log for id_ in ids)


def test_terminal_rewrites_the_line_with_each_run(collides):
    terminal = ON_A_TERMINAL.partition("@pytest.hookimpl")[2]
    collides.pytester.makeconftest(f"{IMPATIENT}\n@pytest.hookimpl{terminal}")
    output = run(collides).stdout.str()
    assert output.count(f"simplifying {collides.only_id}, run ") > 5
