"""What is found out about the decisions that led to a finding."""

from contextlib import contextmanager

import pytest

from pytest_pafot.searches.refine import steps
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.driving.conditions import NOBODY

pytestmark = pytest.mark.usefixtures("examined")


def run(project, *args, **options):
    """Return the result, and the record and the file of the finding."""
    project.forget()
    result = project.run("--pafot-json=pafot.json", *args, **{"runs": 40, "seed": 2, **options})
    (record,) = [each for each in project.record.findings if each.status == "new"]
    return result, record, project.contents


@pytest.mark.parametrize("error", [OutOfTime(), IndexError("not here")])
def test_an_examination_without_time_or_with_an_error_loses_no_finding(project, monkeypatch, error):
    def fails(*_):
        raise error
        yield

    monkeypatch.setattr(steps, "EXAMINATIONS", {"decisions": fails})
    project.write(HIDES.replace("ADS", "def make():\n    return lambda seen: 1"))
    result, record, contents = run(project)
    result.assert_outcomes(failed=2)
    assert (record.moment, len(contents)) == (None, 1)
    result.stdout.fnmatch_lines([f"*note: * saved-{record.id} *{error}*"])


HIDES = """
CONFIG = {"observation": {"type": "Kinematics", "vehicles_count": 2, "see_behind": True}}  # the ego, and the nearest
ADS

@pafot.search(npcs=1, genes=2, gene_seconds=5, ads=make, world=pafot.World("highway-v0", CONFIG))  # stop_after=1
def test_collides(run):
    assert not run.collision
"""


def test_what_a_policy_answers_to_is_told_also_if_it_is_isolated(project):
    project.write(HIDES.replace("ADS", "def make():\n    return lambda seen: 1"))
    record = run(project, "--pafot-shrink-runs=0")[1]
    moment = record["moment"]
    values = [moment[key] for key in ("npc", "action", "hidden", "otherwise")]
    assert values == [0, "1", "", None]
    apart = run(project, "--pafot-shrink-runs=0", "--pafot-isolate")[1]
    assert apart["moment"] == moment


@pytest.mark.parametrize("ads", [
    "def make(env):\n    return lambda seen: 1",
    "import random\n\ndef make():\n    return lambda seen: 1 if random.random() < 0.5 else 1",
], ids=["has the environment", "draws"])  # fmt: skip
def test_nothing_is_said_of_a_policy_that_sees_more(project, ads):
    project.write(HIDES.replace("ADS", ads))
    moment = run(project, "--pafot-shrink-runs=0")[1]["moment"]
    assert (moment is None) == ("env" in ads)


def test_with_a_reference_the_first_decision_that_differs_is_told(project):
    project.write("""
class Braking:
    def __call__(self, seen):
        ahead = [o.x - seen.ego.x for o in seen.others if o.lane == seen.ego.lane and o.x > seen.ego.x]
        return (-6.0 if min(ahead, default=99.0) < 45.0 else 0.0), 0.0

@pafot.search(npcs=1, genes=1, gene_seconds=20, ego_speed=22, against=Braking, instructions="cells")  # stop_after=1
def test_collides(run):
    assert not run.collision
""")
    result, record, _ = run(project, "--pafot-runs=60")
    moment = record["moment"]
    answers = ("acceleration 0.0 m/s^2", "acceleration -6.0 m/s^2")
    assert (moment["action"], moment["reference"]) == answers
    result.stdout.fnmatch_lines([f"*{answers[0]}*{answers[1]}."])


READS = """
class Planner:
    def __init__(self):
        self.decisions = 0

    def __call__(self, seen):
        self.decisions += 1
        return self.braking(min(o.x for o in seen.others) - seen.ego.x), 0.0

    def braking(self, gap):
        return 0.0 if gap < 90.0 or self.decisions < 1 else 0.5

@pafot.search(npcs=1, genes=2, gene_seconds=5, ego_speed=22, ads=Planner, instructions="cells",  # stop_after=1
              vehicles="car")
def test_collides(run):
    assert not run.collision
"""


CONDITION = "gap < 90.0 or self.decisions < 1"


def test_the_conditions_of_the_moment_are_told_also_if_the_policy_is_isolated(project):
    project.write(READS)
    source = (project.path / "test_it.py").read_text()
    line = 1 + source.partition(CONDITION)[0].count("\n")
    options = ("--pafot-shrink-runs=0",)
    result, record, _ = run(project, *options, "--pafot-report=out.html", runs=80, seed=4)
    (told,) = record["moment"]["conditions"]
    whom, (row,) = told["about"], told["evaluated"]
    assert whom == f"NPC {record['moment']['npc']}"
    assert row.startswith(f"line {line}: {CONDITION}  (gap = ")
    assert row.endswith(") -> True")
    assert f"  line {line}: {CONDITION}  " in result.stdout.str()
    assert f"line {line}: gap" in (project.path / "out.html").read_text()
    apart = run(project, *options, "--pafot-isolate", runs=80, seed=4)[1]
    assert apart["moment"] == record["moment"]


def test_of_a_change_of_lanes_for_no_vehicle_the_condition_is_told_that_the_decision_before_did_not_fulfil(
    project,
):
    project.write("""
def moves_over(seen):
    lane = 1 if seen.time > 3.0 else 0
    slow = seen.ego.speed < 5.0
    return pafot.LaneCommand(lane=lane, acceleration=0.0 if slow else 0.1)

@pafot.search(npcs=2, genes=3, gene_seconds=3, ads=lambda: moves_over, vehicles="car", ego_lane=0)  # stop_after=1
def test_never_moves_over_at_fault(run):
    assert not (run.collision and run.attribution.fault == "entered-lane")
""")
    moment = run(project, "--pafot-shrink-runs=0", "--pafot-runs=400", runs=200)[1]["moment"]
    assert (moment["time"], moment["action"].split(",")[0]) == (3.2, "lane 1")
    (told,) = moment["conditions"]
    assert told["about"] == NOBODY
    assert told["evaluated"][0].endswith("(seen.time = 3.2) -> True; at 3.0 s False")


def test_no_conditions_are_told_of_a_policy_that_decides_otherwise_when_it_is_asked(
    project, monkeypatch
):
    monkeypatch.setattr("pytest_pafot.searches.refine.moment.Conditions", lambda *_: Otherwise())
    project.write(READS)
    moment = run(project, "--pafot-shrink-runs=0", runs=80, seed=4)[1]["moment"]
    assert moment["action"]
    assert moment["conditions"] == []


class Otherwise:
    """Conditions in whose decision a policy raises an error."""

    @contextmanager
    def recorded(self, ads, rows):
        rows.append("line 1: of another run -> True")
        raise RuntimeError
        yield
