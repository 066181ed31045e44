"""A saved scenario outside of pytest."""

from dataclasses import replace

import pytest

import pytest_pafot as pafot
from pytest_pafot.corpus.writer import write
from pytest_pafot.findings.finding import Finding, Found
from pytest_pafot.findings.verdict import PROCESS_CRASH, Failure
from pytest_pafot.model.trace import LANE
from pytest_pafot.oracle.run import Check
from pytest_pafot.support.errors import CorpusError
from pytest_pafot.world import codec
from tests.helpers.puppets import Puppets

WORLD = pafot.Highway(lanes=3, duration=10.0)
SLOW_LEADER = pafot.Scenario(npcs=[[pafot.PositionInstruction(2, 5.0)]])


class Walled(Puppets):
    """A user's simulator, which is code."""

    lanes = 3


WALLED = pafot.SimulatorWorld(Walled, duration=10.0)


def keeps_its_speed():
    return lambda observation: (0.0, 0.0)


def brakes():
    return lambda observation: (-4.0, 0.0)


def finding_in(world, failure=None):
    run = pafot.Run(world.rollout(SLOW_LEADER, keeps_its_speed))
    found = Found(seed=0, generation=0, algorithm="random")
    failure = failure or Failure(kind="AssertionError", assertion="assert not run.collision")
    return Finding.from_run(
        run, failure, test="test_it.py::test_it", world=codec.described(world), found=found
    )


@pytest.fixture
def save(tmp_path):
    def saved(finding):
        path = tmp_path / f"{finding.id}.pafot.yaml"
        write(path, finding)
        return pafot.load(path)

    return saved


def test_saved_scenario_has_scenario_world_and_expectation(save):
    finding = finding_in(WORLD)
    saved = save(finding)
    assert (saved.id, saved.scenario, saved.world, saved.expect) == (
        finding.id, finding.scenario, WORLD, finding.expect,
    )  # fmt: skip
    assert (
        repr(saved)
        == f"<SavedScenario {finding.id}: AssertionError, collision at {finding.expect.time:.1f} s>"
    )


def test_a_saved_scenario_below_the_current_folder_is_loaded_by_its_id(save, monkeypatch):
    saved = save(finding_in(WORLD))
    monkeypatch.chdir(saved.path.parent)
    assert (
        pafot.load(saved.id).scenario
        == pafot.load(f"test_x[saved-{saved.id}]").scenario
        == saved.scenario
    )


def test_replay_matches_until_the_policy_is_fixed(save):
    saved = save(finding_in(WORLD))
    assert saved.matches(saved.replay(keeps_its_speed))
    assert not saved.matches(saved.replay(brakes))


def test_a_replay_knows_its_world(save):
    run = save(finding_in(WORLD)).replay(keeps_its_speed)
    assert run.take_over is not None


def test_world_made_of_code_must_be_given(save):
    saved = save(finding_in(WALLED))
    with pytest.raises(
        CorpusError, match=r"expected a world that a file can describe.*replay\(ads, world="
    ) as error:
        saved.replay(keeps_its_speed)
    assert error.value.line
    assert error.value.field == "world"
    assert saved.matches(saved.replay(keeps_its_speed, world=WALLED))


def test_unfitting_scenario_names_its_line(save):
    finding = finding_in(WORLD)
    saved = save(replace(finding, scenario=replace(finding.scenario, ego_lane=3)))
    with pytest.raises(CorpusError, match=r"yaml:\d+: scenario.ego.lane: expected"):
        saved.replay(keeps_its_speed)
    for world in (WORLD, WALLED):
        with pytest.raises(CorpusError, match=r"yaml:\d+: scenario.ego.lane: expected"):
            saved.replay(keeps_its_speed, world=world)
    assert saved.replay(keeps_its_speed, world=pafot.Highway(lanes=4)).trace.ego[0, LANE] == 3


def test_unknown_kind_of_world_names_its_line(save):
    saved = save(replace(finding_in(WORLD), world={"kind": "moon"}))
    with pytest.raises(
        CorpusError, match=r"yaml:\d+: world.kind: expected one of gym, .*, sumo, received 'moon'"
    ):
        saved.world  # noqa: B018


def test_scenario_with_a_process_crash_needs_pytest(save):
    finding = finding_in(WORLD)
    saved = save(replace(finding, expect=replace(finding.expect, failure=PROCESS_CRASH)))
    with pytest.raises(CorpusError, match=r"Run `python -m pytest .*yaml`"):
        saved.replay(keeps_its_speed)


def test_saved_check_needs_its_test_function(save):
    check = Check(name="jerk", value=30.0, margin=-10.0, at_most=20.0, time=1.0)
    saved = save(finding_in(WORLD, Failure(kind="CheckFailed", assertion="jerk", check=check)))
    with pytest.raises(ValueError, match=r"the check 'jerk'\. Call the test function"):
        saved.matches(saved.replay(keeps_its_speed))


def test_missing_file_is_reported_by_its_name(tmp_path):
    with pytest.raises(
        CorpusError, match=r"none.pafot.yaml: expected a regular file that can be read"
    ):
        pafot.load(tmp_path / "none.pafot.yaml")


def test_replay_in_a_lasting_world_goes_on_after_the_end(save):
    saved = save(finding_in(pafot.Highway(lanes=3, duration=5.0)))
    assert (saved.replay(keeps_its_speed).duration, saved.replay(keeps_its_speed).collision) == (
        5.0,
        None,
    )
    assert saved.replay(keeps_its_speed, world=saved.world.lasting(20.0)).collision
