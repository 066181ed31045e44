"""A plan that an ADS returns with its action: it changes nothing in the run, and is recorded in world coordinates."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from pytest_pafot import Drive, Highway, LaneInstruction, Perception, Planned, PositionInstruction, Run, Scenario, World
from pytest_pafot.campaign.harness import is_same_run
from pytest_pafot.execution.runner import DecisionCache
from pytest_pafot.model.trace import AdsError, Trace, X, Y
from pytest_pafot.report.page import data_json
from pytest_pafot.report.page_data import Report
from pytest_pafot.report.views import run_view
from pytest_pafot.searching.fitness import before_impact
from pytest_pafot.support.errors import BadAction
from pytest_pafot.world.driving.shadow import Aside, beside
from pytest_pafot.world.engines.ordinary_traffic import drive
from tests.helpers.tables import table

SCENARIO = Scenario(npcs=[[PositionInstruction(2, 20.0)], [PositionInstruction(4, 22.0)]])
STRAIGHT = World("highway-v0", planner_hz=5)
LONG = tuple((0.1 * number, 0.0, 0.0) for number in range(201))


def ahead(seen):
    """Return a plan from the ego straight on at its speed, over two seconds."""
    ego = seen.ego
    return [(0.5 * step, ego.x + 0.5 * step * ego.speed, ego.y) for step in range(5)]


@dataclass
class Planner:
    """Keeps the speed and swerves a little; it plans unless ``plans`` is false, and only in each second decision."""

    plans: bool = True
    drives: bool = False
    asked: int = 0

    def __call__(self, seen):
        action = 0.2, 0.01 * math.sin(seen.time)
        if self.drives:
            action = Drive(lane=int(seen.time / 3) % seen.lanes, speed=seen.ego.speed)
        self.asked += 1
        return Planned(action, ahead(seen)) if self.plans and self.asked % 2 else action


@dataclass
class Policy:
    """An environment's policy, with a plan in the world's coordinates."""

    plans: bool = True

    def __call__(self, seen):
        return Planned(np.int64(1), np.array([(1.0, 100.0, 4.0), (2.0, 130.0, 4.0)])) if self.plans else np.int64(1)


def scenario_of(world):
    if isinstance(world, Highway):
        return SCENARIO
    return Scenario(npcs=[[PositionInstruction(6, 5.0)]], ego_lane=0, ego_speed=8.0)


def fields_without_plans():
    arrays = ("states", "sizes", "track", "on_way")
    return [each.name for each in fields(Trace) if each.compare and each.init and each.name not in ("plans", *arrays)]


@table(
    ("world", "ads", "mode"),
    [
        (world, ads, mode)
        for world, ads in (
            (Highway(duration=8.0), Planner),
            (Highway(duration=8.0), lambda plans: Planner(plans, drives=True)),
            (World("racetrack-v0", planner_hz=5, duration=8.0), Planner),
            (World("highway-v0", duration=8.0), Policy),
            (World("intersection-v0", duration=8.0), Policy),
        )
        for mode in ("rollout", "rollout_in_gym", "seen through noise")
    ],
)
def test_ego_drives_the_same_with_and_without_plan(world, ads, mode):
    scenario = replace(scenario_of(world), seed=3)

    def driven(plans):
        factory = lambda: ads(plans)  # noqa: E731
        if mode == "seen through noise":
            return world.rollout(scenario, Perception(factory, noise={"position": 0.2}))
        return getattr(world, mode)(scenario, factory)

    planned, plain = driven(True), driven(False)
    assert planned.error is None
    for name in fields_without_plans():
        assert getattr(planned, name) == getattr(plain, name), name
    assert planned.states.tobytes() == plain.states.tobytes()
    assert (len(planned.plans), plain.plans) == (len(planned.actions), ())
    assert any(planned.plans)


@table(
    ("plan", "received"),
    [
        ([], r"\[\]"),
        (None, "None"),
        ([(0.0, 1.0)], r"\[\(0.0, 1.0\)\]"),
        ([(0.0, 1.0, 2.0), (1.0, 2.0)], r"\[\(0.0, 1.0, 2.0\), "),
        ([(0.0, 1.0, 2e6)], r"\[\(0.0, 1.0, 2000000.0\)\]"),
        ([(0.0, 10**400, 2.0)], r"\[\(0.0, 1000"),
        ([(0.0, math.nan, 2.0)], r"\[\(0.0, nan, 2.0\)\]"),
        ([(0.0, "1", 2.0)], r"\[\(0.0, '1', 2.0\)\]"),
        ([(0.0, True, 2.0), (None, 1, 1)], r"\[\(0.0, True"),
        ({0.0: (1.0, 2.0)}, r"\{0.0"),
        (LONG, r"\(\(0.0, 0.0, 0.0\)"),
    ],
)
def test_something_that_is_no_plan_is_refused(plan, received):
    message = (
        r"^expected a plan of 1 to 200 places \(t \[s\], x \[m\], y \[m\]\), numbers of at most a million, received "
    )
    with pytest.raises(BadAction, match=message + received + r".*; without a plan, return the action alone$"):
        Planned((0.0, 0.0), plan)


@table("times", [(-0.1, 1.0), (0.0, 0.0), (1.0, 0.5), (0.5, 1.0, 1.0)])
def test_times_of_a_plan_rise_from_the_decision_on(times):
    with pytest.raises(BadAction, match=r"places \(t \[s\], x \[m\], y \[m\]\) whose times rise, from 0 on"):
        Planned((0.0, 0.0), [(time, 0.0, 0.0) for time in times])
    with pytest.raises(BadAction, match="whose times rise"):
        Planned((0.0, 0.0), np.array([(2, 0, 0), (1, 0, 0)], dtype=np.uint8))


@table("env_id", ["highway-v0", "roundabout-v1", "racetrack-v0", "intersection-v0"])
def test_places_far_from_the_road_are_recorded_and_drawn(env_id):
    far = [(1.0, 1e6, 0.0), (2.0, -1e6, 1e6), (3.0, 5.0, -1e6), (1e6, 0.0, 0.0)]
    world, lane = World(env_id, planner_hz=5, duration=2.0), int(env_id.startswith("roundabout"))
    scenario = Scenario(npcs=[[PositionInstruction(6, 5.0)]], ego_lane=lane, ego_speed=8.0)
    trace = world.rollout(scenario, lambda: lambda seen: Planned((0.0, 0.0), far))
    assert trace.error is None
    assert np.isfinite(trace.plans).all()
    view = run_view(trace)
    assert data_json(Report.of(view))


def test_a_plan_is_stored_as_plain_numbers_and_cannot_change():
    given = np.array([(0, 1, 2), (1, 5, 2)], dtype=np.float32)
    planned = Planned(1, given)
    given[:] = 7
    assert planned.plan == ((0.0, 1.0, 2.0), (1.0, 5.0, 2.0))
    assert {type(each) for place in planned.plan for each in place} == {float}
    assert pickle.loads(pickle.dumps(planned)) == planned
    assert len(Planned(1, LONG[:200]).plan) == 200
    with pytest.raises(AttributeError):
        planned.plan = ()


@table(("world", "good"), [(Highway(duration=2.0), (0.0, 0.0)), (World("highway-v0", duration=2.0), 1)])
def test_action_inside_is_checked_like_an_action_alone(world, good):
    def driven(bad):
        answers = iter([good, bad])
        return world.rollout(SCENARIO, lambda: lambda seen: next(answers))

    alone, inside = driven("left"), driven(Planned("left", [(1.0, 0.0, 0.0)]))
    assert alone.error == inside.error
    assert inside.error.kind == "BadAction"
    assert (len(inside.actions), inside.plans) == (1, ())


def test_bad_plan_is_an_error_of_the_ads():
    trace = Highway(duration=2.0).rollout(
        SCENARIO, lambda: lambda seen: Planned((0.0, 0.0), [(seen.time, 0, math.inf)])
    )
    assert isinstance(trace.error, AdsError)
    assert trace.error.kind == "BadAction"
    assert "expected a plan of 1 to 200 places" in trace.error.message


@table(
    ("env_id", "npcs"),
    [
        ("highway-v0", [[PositionInstruction(2, 20.0)], [PositionInstruction(4, 22.0)]]),
        ("racetrack-v0", [[LaneInstruction("keep", 7.0)], [PositionInstruction(6, 5.0)]]),
        ("roundabout-v1", [[PositionInstruction(6, 5.0)]]),
        ("merge-v1", [[PositionInstruction(2, 20.0)], [PositionInstruction(4, 22.0)]]),
    ],
)
def test_planned_places_are_recorded_where_the_observation_shows_them(env_id, npcs):
    """The plan is the ego's and the NPCs' observed places, also across lanes and around bends."""
    world = World(env_id, planner_hz=5, duration=10.0)

    def drive(seen):
        places = [(each.x, each.y) for each in (seen.ego, *(dict(zip(seen.ids, seen.others, strict=True)).values()))]
        return Planned(Drive(lane=seen.ego.lane, speed=seen.ego.speed), [(t, *at) for t, at in enumerate(places)])

    lane = 1 if env_id.startswith("roundabout") else 0
    speed = 8.0 if env_id.startswith("r") else 22.0
    trace = world.rollout(Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed), lambda: drive)
    assert trace.error is None
    away = [
        math.dist(place[1:], state)
        for tick, plan in zip(trace.decision_ticks, trace.plans, strict=False)
        for place, state in zip(plan, trace.states[tick][:, [X, Y]], strict=True)
    ]
    assert len(away) > 20
    assert max(away) < 2.0, "where a bend begins, observed distances jump"
    assert np.mean(np.array(away) < 1e-6) > 0.97


def test_plan_belongs_to_the_decision_that_returned_it():
    trace = Highway(duration=4.0).rollout(SCENARIO, Planner)
    assert [plan is not None for plan in trace.plans] == [number % 2 == 0 for number in range(len(trace.actions))]
    ticks = [tick for tick, plan in zip(trace.decision_ticks, trace.plans, strict=True) if plan is not None]
    assert list(Run(trace).plans) == ticks
    assert all(Run(trace).plans[tick][0].tolist() == [0.0, *trace.ego[tick, [X, Y]]] for tick in ticks)


def test_decisions_that_are_given_have_no_plan():
    world = Highway(duration=4.0)
    whole = world.rollout(SCENARIO, Planner)
    again = world.rollout(SCENARIO, Planner, decisions=whole.actions[:6])
    assert again.states.tobytes() == whole.states.tobytes()
    assert again.plans[:6] == (None,) * 6
    assert again.plans[6:] == whole.plans[6:]
    assert world.rollout(SCENARIO, Planner, decisions=whole.actions).plans == ()


@table(
    ("world", "ads"),
    [(Highway(duration=4.0), Planner), (STRAIGHT, Planner), (World("highway-v0", duration=4.0), Policy)],
)
def test_plans_in_lock_step_are_those_of_single_runs(world, ads):
    class Many:
        def __init__(self):
            self.each = {}

        def __call__(self, seen):
            return self.each.setdefault(0, ads())(seen)

        def batch(self, observations):
            return [
                self.each.setdefault(run, ads())(seen)
                for run, seen in zip(observations.runs, observations, strict=True)
            ]

    several = [SCENARIO, replace(SCENARIO, npcs=SCENARIO.npcs[:1]), SCENARIO]
    together = world.rollout_batch(several, Many)
    assert [each.plans for each in together] == [world.rollout(each, ads).plans for each in several]
    assert all(map(any, (each.plans for each in together)))


def test_a_trace_that_crosses_processes_keeps_its_plans():
    trace = Highway(duration=4.0).rollout(SCENARIO, Planner)
    assert pickle.loads(pickle.dumps(trace)).plans == trace.plans != ()


def test_runs_with_different_plans_are_not_the_same_run():
    trace = Highway(duration=4.0).rollout(SCENARIO, Planner)
    assert is_same_run(Run(trace), Run(replace(trace)))
    assert not is_same_run(Run(trace), Run(replace(trace, plans=())))


def test_decisions_with_plans_are_not_cached():
    """A run that begins with cached decisions would lack their plans."""
    cache, world = DecisionCache(), Highway(duration=4.0)
    cache.remember(world.rollout(SCENARIO, Planner))
    assert cache.recall(SCENARIO)[0] == ()
    cache.remember(world.rollout(SCENARIO, lambda: Planner(False)))
    assert cache.recall(SCENARIO)[0] != ()


def test_fitness_sees_the_plans_of_the_part_that_counts():
    trace = Highway().rollout(SCENARIO, lambda: lambda seen: Planned((3.0, 0.0), ahead(seen)))
    assert trace.collision is not None
    cut = before_impact(trace)
    assert len(cut.plans) == len(cut.actions) < len(trace.plans)


def test_planner_beside_a_run_is_compared_by_its_actions():
    world, aside = Highway(duration=2.0), Aside()
    whole = world.rollout(SCENARIO, Planner)
    world.rollout(SCENARIO, beside(Planner, whole.actions, lambda action: action, aside))
    assert tuple(aside.answers) == whole.actions


def test_plan_of_an_ads_that_is_wrong_about_its_place_is_wrong_by_as_much():
    world = Highway(duration=4.0)
    plan = lambda: lambda seen: Planned((0.0, 0.0), ahead(seen))  # noqa: E731
    exact = Run(world.rollout(SCENARIO, plan)).off_plan(after=1.0)
    trace = world.rollout(SCENARIO, Perception(plan, own_bias={"position": 0.5}))
    t, x, y = trace.plans[0][0]
    believed = math.dist((x, y), trace.ego[0, [X, Y]])
    assert exact == pytest.approx(0.0, abs=1e-9)
    assert t == 0.0
    assert 0.0 < believed == pytest.approx(Run(trace).off_plan(after=1.0))


@table("env_id", ["highway-fast-v0", "racetrack-v0"])
def test_episodes_drive_by_the_action_alone(env_id):
    world = World(env_id)
    action = np.zeros(world.action_space.shape) if env_id.startswith("race") else 1

    def driven(answer):
        return drive(world.environment, lambda: lambda seen: answer, 3, hang_limit=60.0)

    plain, planned = driven(action), driven(Planned(action, LONG[:3]))
    assert planned.error is None
    assert planned == plain
