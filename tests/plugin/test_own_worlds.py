"""Worlds that are code: the user's own and wrapped environments are searched and replayed as tests name them."""

import pytest

from pytest_pafot.attribution.takeovers import latest
from pytest_pafot.corpus.reader import load
from pytest_pafot.world import Highway

RING = """
class Ring:
    speed_limit, longest_run = 26.8, 10.0

    def __init__(self, lanes):
        self.lanes = lanes

    def rollout(self, scenario, ads_factory):
        return pafot.Highway(lanes=self.lanes, duration=10.0).rollout(scenario, ads_factory)

    def to_dict(self):
        return DATA
"""
OWN = (
    RING
    + """
@pafot.search(genes=2, gene_seconds=5, npcs=1, world=Ring(LANES),  # stop_after=1
              shrink_rollouts=9)
def test_fails(run):
    assert run.VERDICT
"""
)
WRAPPED = """
from gymnasium.wrappers import FlattenObservation, FrameStackObservation

seen = []

def ads():
    return lambda observation: seen.append(observation.shape) or 1

@pafot.search(
    genes=2,
    gene_seconds=1,
    npcs=1,
    ads=ads,
    world=pafot.World("highway-v0", duration=2.0, WRAPPERS),
    shrink_rollouts=2,  # stop_after=1
)
def test_fails(run):
    assert set(seen) == {SHAPE}
    assert run.VERDICT
"""
FAILS, PASSES = "outcome == 'x'", "outcome"


def write(project, source, **words):
    for word, text in words.items():
        source = source.replace(word, text)
    project.write(source)


def own(project, data="{'lanes': self.lanes}", lanes="3", verdict=FAILS, name="Ring"):
    write(project, OWN, DATA=data, LANES=lanes, VERDICT=verdict, Ring=name)


def wrapped(project, wrappers="wrappers=[FlattenObservation]", shape="(25,)", verdict=FAILS):
    write(project, WRAPPED, WRAPPERS=wrappers, SHAPE=shape, VERDICT=verdict)


@pytest.fixture
def saved(project):
    """Return a project with one scenario that was saved in the project's own world."""
    own(project)
    project.run_once(runs=20)
    return project


@pytest.fixture
def saved_wrapped(project):
    """Return a project with one scenario that was saved in a wrapped environment."""
    wrapped(project)
    project.run_once(runs=20)
    return project


def test_finding_in_own_world_replays_in_named_world(saved):
    assert "\nworld: {kind: own, class: Ring, data: {lanes: 3}}\n" in saved.only_file.read_text()
    result = saved.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(["replayed 1 saved scenario: 1 still failing"])
    own(saved, verdict=PASSES)
    saved.run(runs=0).stdout.fnmatch_lines(["replayed 1 saved scenario: 1 passes"])


def test_passing_replay_in_a_changed_world_has_drifted(saved):
    own(saved, lanes="4", verdict=PASSES)
    result = saved.run("--pafot-strict-drift", runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(["*passes, but drifted: *world.data.lanes 3 in the file, 4 now*"])
    own(saved, lanes="4")
    saved.run(runs=0).stdout.fnmatch_lines(["replayed 1 saved scenario: 1 still failing"])


def test_world_of_another_class_is_refused_with_location(saved):
    own(saved, name="Circle")
    result = saved.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(
        [f"*{saved.only_file.name}:*: world: expected *, a world of the class Ring, *received *of the class Circle; *"]
    )
    saved.write("@pafot.search(genes=2, gene_seconds=5, npcs=1)\ndef test_fails(run):\n    assert run.outcome")
    result = saved.run(runs=0)
    result.stdout.fnmatch_lines(
        ["*a world of the class Ring, *, received a pafot.Highway; *(world=...), the fixture pafot_world or --world*"]
    )


@pytest.mark.parametrize("data", ["object()", "{'road': {1: 2}}", "[float('nan')]"])
def test_world_without_plain_data_is_replayed_too(project, data):
    own(project, data=data)
    project.run(runs=20)
    assert load(project.only_file).world == {"kind": "own", "class": "Ring"}
    project.run(runs=0).stdout.fnmatch_lines(["replayed 1 saved scenario: 1 still failing"])


def test_subclass_of_a_builtin_world_is_own_world(project):
    project.write("""
class Short(pafot.Highway):  # which may do anything
    def rollout(self, scenario, ads_factory):
        return pafot.Highway(duration=2.0).rollout(scenario, ads_factory)

@pafot.search(genes=2, gene_seconds=5, npcs=1, world=Short(duration=10.0))  # stop_after=1
def test_fails(run):
    assert run.duration > 5, run.duration
""")
    project.run(runs=20)
    finding = load(project.only_file)
    assert (finding.world["class"], finding.expect.time, finding.flaky) == ("Short", 2.0, None)
    project.run(runs=0).stdout.fnmatch_lines(["replayed 1 saved scenario: 1 still failing"])


# --- environments in wrappers


def test_finding_in_wrapped_environment_replays_in_its_wrappers(in_highway_env, saved_wrapped):
    assert load(saved_wrapped.only_file).world["wrappers"] == ["FlattenObservation"]
    assert load(saved_wrapped.only_file).flaky is None
    saved_wrapped.run(runs=0).stdout.fnmatch_lines(["replayed 1 saved scenario: 1 still failing"])
    wrapped(saved_wrapped, verdict=PASSES)
    saved_wrapped.run(runs=0).stdout.fnmatch_lines(["replayed 1 saved scenario: 1 passes"])


@pytest.mark.parametrize(("wrappers", "shape", "now"), [
    ("wrappers=[FlattenObservation, lambda env: FrameStackObservation(env, 2)]", "(2, 25)", "'FrameStackOb*'"),
    ("", "(5, 5)", "missing"),
])  # fmt: skip
def test_other_wrappers_than_in_the_file_are_drift(saved_wrapped, wrappers, shape, now):
    wrapped(saved_wrapped, wrappers, shape, PASSES)
    result = saved_wrapped.run("--pafot-strict-drift", runs=0)
    result.stdout.fnmatch_lines([f"*drifted: *world.wrappers [[]'FlattenObservation'] in the file, *{now}* now*"])


def test_a_test_that_names_another_environment_is_refused(saved_wrapped):
    wrapped(saved_wrapped)
    path = saved_wrapped.path / "test_it.py"
    path.write_text(path.read_text().replace("highway-v0", "highway-fast-v0"))
    result = saved_wrapped.run(runs=0)
    result.stdout.fnmatch_lines(
        ["*pafot.World('highway-v0') with FlattenObservation, *, received pafot.World('highway-fast-v0') with Flatten*"]
    )


# --- what is said in a world that does less than a Highway

SLEEPS = """
import time

def sleeps():
    return lambda seen: time.sleep(60) if seen.time > 2 else (0.0, 0.0)

class Hung(Ring):
    hang_limit = 0.05

    def rollout(self, scenario, ads_factory):
        STUCK
        return super().rollout(scenario, ads_factory)

@pafot.search(ads=sleeps, genes=2, gene_seconds=5, npcs=1, world=Hung(3), shrink_rollouts=0)  # stop_after=1
def test_moves(run):
    assert run.outcome
"""


def sleeping(project, stuck="pass"):
    write(project, RING + SLEEPS, DATA="{'lanes': 3}", STUCK=stuck)


@pytest.mark.parametrize("options", [(), ("--pafot-isolate",)])
def test_decision_that_hangs_in_own_world_is_a_finding(project, options):
    sleeping(project)
    result = project.run(*options, runs=4)
    result.stdout.fnmatch_lines(["*Hang: one decision took longer than the hang limit of the world and was interr*"])
    finding = load(project.only_file)
    assert (finding.expect.outcome, finding.expect.time) == ("hang", pytest.approx(2.2, abs=0.01))


@pytest.mark.processes
def test_own_world_that_hangs_itself_is_ended_with_isolate(project, monkeypatch):
    monkeypatch.setattr("pytest_pafot.world.guard.hang_guard.LEAST_FOR_WORLD", 0.3)
    sleeping(project, stuck="time.sleep(60)")
    result = project.run("--pafot-isolate", runs=4)
    result.stdout.fnmatch_lines(
        [
            "The process * was ended, because its world neither asked the ADS nor ended the run*",
            "*the world hangs, or needs that long (then give it a longer hang_limit*",
        ]
    )
    assert load(project.only_file).expect.outcome == "hang"


@pytest.mark.parametrize("has_styles", [False, True])
def test_styles_are_only_said_of_worlds_that_have_them(project, has_styles):
    own(project, data="{'lanes': self.lanes}\n\n    has_traffic_styles = " + str(has_styles))
    result = project.run("-v", runs=4)
    told = [line for line in result.outlines if "1 NPC" in line and "ego starts" in line]
    assert ["hostile" in line for line in told] == [has_styles]
    assert ("hostile traffic" in project.only_file.read_text()) is has_styles


@pytest.mark.parametrize(("argument", "ability", "words", "begin"), [
    ("traffic='everyday'", "has_traffic_styles", "whose NPCs have styles", "whose NPCs have styles, received "),
    (
        "instructions='both'",
        "has_lane_instructions",
        "whose NPCs can have Lane-Instructions",
        "whose NPCs can have Lane-Ins",  # the message is cut after this
    ),
])  # fmt: skip
def test_argument_is_refused_for_a_world_without_its_ability(project, argument, ability, words, begin):
    own(project)
    path = project.path / "test_it.py"
    path.write_text(path.read_text().replace("npcs=1", f"npcs=1, {argument}"))
    project.run().stdout.fnmatch_lines([f"*expected a world {begin}*{ability} = True*"])
    path.write_text(path.read_text().replace("class Ring:", f"class Ring:\n    {ability} = True\n"))
    project.run(runs=4).stdout.no_fnmatch_line(f"*{words}*")


@pytest.mark.parametrize("has_lanes", [False, True])
def test_lanes_are_only_drawn_for_worlds_that_have_them(project, has_lanes):
    only_cells = "trace.scenario.positions == run.trace.scenario.npcs"
    own(project, data="{'lanes': self.lanes}\n\n    has_lane_instructions = " + str(has_lanes), verdict=only_cells)
    project.run(runs=8).assert_outcomes(**({"failed": 2} if has_lanes else {"passed": 1, "skipped": 0}))


DRIVERS = """
class Driven(Ring):
    takes_over = ("calm", "careful-human")

    def rollout(self, scenario, ads_factory):
        return HIGHWAY.rollout(scenario, ads_factory)

    def take_over(self, trace, tick, name):
        return HIGHWAY.take_over(trace, tick, name)

HIGHWAY = pafot.Highway(lanes=4, duration=20.0)

@pafot.search(ads=lambda: lambda seen: (0.0, 0.0), genes=2, gene_seconds=10, npcs=2, world=Driven(4),
              blame="ego", shrink_rollouts=9)  # stop_after=1
def test_keeps_off(run):
    assert not run.collision, run.explain()
"""


def driven(project, text=DRIVERS):
    write(project, RING + text, DATA="{'lanes': self.lanes}")
    return project.run("--pafot-runs=60", runs=None), load(project.only_file)


def test_careful_driver_takes_over_in_an_own_world_as_far_as_it_goes(shrinking, project):
    result, finding = driven(project)
    result.stdout.no_fnmatch_line("*note: the world*")
    highway = Highway(lanes=4, duration=20.0)
    run = highway.run_of(highway.rollout(finding.scenario, lambda: lambda seen: (0.0, 0.0)))
    assert finding.expect.takeover == latest(run.trace, run.take_over) > 0


def test_driver_that_own_world_cannot_run_is_one_note(shrinking, project):
    failing = DRIVERS.replace("return HIGHWAY.take_over(trace, tick, name)", "raise KeyError(name)")
    result, finding = driven(project, failing)
    result.stdout.fnmatch_lines(["*note: the world Driven could not run take_over with the driver 'careful-human'*"])
    assert finding.expect.takeover is None
    assert finding.shrunk is not None
