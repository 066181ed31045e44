"""Runs in lock step equal the runs of the same ADS one by one."""

import time

import numpy as np
import pytest

from pytest_pafot import Highway, Outcome, World
from pytest_pafot.model.instructions import PositionInstruction, ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching import SearchSpace, sample
from pytest_pafot.world import AdsFactoryError
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.engines.lock_step import batching_ads
from tests.helpers.road_cases import space_of
from tests.helpers.stages import oracle
from tests.helpers.stopped_clock import StoppedClock
from tests.helpers.tables import table

HIGHWAY = Highway(duration=12.0)
ENVIRONMENT = World("highway-v0", duration=12.0)
ALONE = Scenario(npcs=[[PositionInstruction(2, 15.0)]])


def scenarios(count=6):
    """Return scenarios with different numbers of NPCs, most of which end in a collision."""
    rng = np.random.default_rng(3)
    return [sample(SearchSpace(npcs=1 + index % 4, genes=2, gene_seconds=6.0), rng) for index in range(count)]


class Planner:
    """An ADS that pushes on and weaves; it decides for each row separately."""

    def __init__(self, asked=None):
        self.asked = [] if asked is None else asked

    def __call__(self, observation):
        return self.decided(observation)

    def batch(self, observations):
        self.asked.append(len(observations))
        return [self.decided(observation) for observation in observations]

    def decided(self, observation):
        return 0.4 - 0.01 * len(observation.others), 0.01 * np.sin(observation.time)


class MetaPolicy(Planner):
    """The same ADS for highway-env's own observation and meta-actions."""

    def decided(self, observation):
        return int(abs(observation).sum() * 1000) % 5


def differences(traces, others):
    """Return what differs between two lists of traces, to the last bit."""
    names = (
        "scenario",
        "executed",
        "outcome",
        "collision",
        "error",
        "actions",
        "arrivals",
        "begun",
        "off_road_tick",
        "lanes",
    )
    return [
        (index, name)
        for index, (a, b) in enumerate(zip(traces, others, strict=True))
        for name in (*names, "states", "sizes")
        if not (np.array_equal(getattr(a, name), getattr(b, name)) if name in ("states", "sizes")
                else getattr(a, name) == getattr(b, name))
    ]  # fmt: skip


def test_planner_in_lock_step_drives_as_alone():
    alone = [HIGHWAY.rollout(scenario, Planner) for scenario in scenarios()]
    assert differences(HIGHWAY.rollout_batch(scenarios(), Planner), alone) == []
    assert len({trace.ticks for trace in alone}) > 1, "they should end at different times"


def test_policy_in_lock_step_drives_as_alone():
    alone = [ENVIRONMENT.rollout(scenario, MetaPolicy) for scenario in scenarios()]
    assert differences(ENVIRONMENT.rollout_batch(scenarios(), MetaPolicy), alone) == []
    assert len({trace.ticks for trace in alone}) > 1, "they should end at different times"


@pytest.mark.parametrize(
    ("world", "ads"),
    [
        (World("intersection-v0", duration=9.0, planner_hz=5), Planner),
        (World("roundabout-v0", duration=9.0), MetaPolicy),
        oracle(World("merge-v1", duration=9.0), MetaPolicy),
        oracle(World("racetrack-v0", duration=9.0, planner_hz=5), Planner),
    ],
)
def test_runs_on_bent_roads_do_not_disturb_each_other(world, ads):
    """They share what is known of the road, and proceed in turn."""
    rng, space, asked = np.random.default_rng(5), space_of(world), []
    several = [sample(space, rng) for _ in range(5)]
    alone = [world.rollout(scenario, ads) for scenario in several]
    assert differences(world.rollout_batch(several, lambda: ads(asked)), alone) == []
    assert asked[0] == 5


def test_batch_is_asked_once_per_decision_tick():
    asked = []
    traces = Highway(duration=12.0).rollout_batch(scenarios(), lambda: Planner(asked))
    decisions = [len(trace.actions) for trace in traces]
    assert asked == [sum(count > tick for count in decisions) for tick in range(max(decisions))]


def test_one_fresh_ads_drives_a_whole_batch():
    made = []
    Highway(duration=2.0).rollout_batch(scenarios(3), lambda: made.append(Planner()) or made[-1])
    assert len(made) == 1


def test_actions_may_be_rows_of_an_array():
    class Stacked(Planner):
        def batch(self, observations):
            return np.array([self.decided(observation) for observation in observations])

    world = Highway(duration=4.0)
    assert differences(world.rollout_batch(scenarios(), Stacked), world.rollout_batch(scenarios(), Planner)) == []


def test_batch_array_has_nan_rows_for_missing_vehicles():
    class Looking(Planner):
        def batch(self, observations):
            values = observations.array
            assert values.shape == (len(observations), max(len(each.others) for each in observations) + 1, 7)
            for rows, each in zip(values, observations, strict=True):
                vehicles = [each.ego, *each.others]
                assert rows[: len(vehicles)].tolist() == each.array.tolist() == [list(map(float, v)) for v in vehicles]
                assert np.isnan(rows[len(vehicles) :]).all()
            return super().batch(observations)

    traces = HIGHWAY.rollout_batch(scenarios(), Looking)
    assert [trace.error for trace in traces] == [None] * 6


def test_environment_array_is_stack_of_its_observations():
    class Looking(MetaPolicy):
        def batch(self, observations):
            assert np.array_equal(observations.array, np.stack(observations))
            return super().batch(observations)

    traces = World("highway-v0", duration=3.0).rollout_batch(scenarios(2), Looking)
    assert [trace.error for trace in traces] == [None, None]


def test_an_ads_without_batch_drives_one_by_one():
    world, made = Highway(duration=4.0), []
    traces = world.rollout_batch(scenarios(3), lambda: made.append(None) or Planner().decided)
    assert differences(traces, [world.rollout(scenario, Planner) for scenario in scenarios(3)]) == []
    assert batching_ads(Policy(lambda: Planner().decided), 1.0) is None
    assert len(made) >= 3


def test_vehicle_classes_and_inside_planners_have_no_batch():
    from highway_env.vehicle.behavior import IDMVehicle

    factories = (IDMVehicle, lambda: IDMVehicle, lambda env: Planner())
    assert [batching_ads(Policy(factory), 1.0) for factory in factories] == [None, None, None]
    assert len(Highway(duration=2.0).rollout_batch(scenarios(2), IDMVehicle)) == 2


def test_one_scenario_is_no_batch():
    asked = []
    (trace,) = Highway(duration=2.0).rollout_batch([ALONE], lambda: Planner(asked))
    assert (asked, trace.outcome) == ([], Outcome.SAFE)


class Failing(Planner):
    """An ADS that raises, hangs, or answers nonsense if there is one NPC."""

    def __init__(self, how):
        super().__init__()
        self.how = how

    def decided(self, observation):
        return self.how() if len(observation.others) == 1 and observation.time > 1 else super().decided(observation)


def raises():
    raise LookupError("one NPC")


def panics():
    raise Panic("one NPC")


class Panic(BaseException):
    """An error like the one that a native library's bindings raise."""


@pytest.mark.parametrize(
    ("how", "outcome", "kind"),
    [
        (raises, Outcome.ADS_ERROR, "LookupError"),
        (panics, Outcome.ADS_ERROR, "Panic"),
        (None, Outcome.HANG, "Hang"),
        (lambda: (np.nan, 0.0), Outcome.ADS_ERROR, "BadAction"),
        (lambda: "left", Outcome.ADS_ERROR, "BadAction"),
    ],
    ids=["raises", "panics", "hangs", "not finite", "no action"],
)
def test_failing_decision_ends_only_its_own_run(how, outcome, kind, monkeypatch):
    world, clock = Highway(duration=4.0), StoppedClock(monkeypatch)
    traces = world.rollout_batch(scenarios(4), lambda: Failing(how or (lambda: clock.sleep(1000.0))))
    healthy = [world.rollout(scenario, Planner) for scenario in scenarios(4)]
    assert [(trace.outcome, trace.error.kind) for trace in traces[:1]] == [(outcome, kind)]
    assert traces[0].error.tick == 18
    assert differences(traces[1:], healthy[1:]) == []


@table("seconds, asked", [(3.9, [4, 4]), (4.1, [4])])
def test_a_batch_has_the_time_of_its_runs(seconds, asked, monkeypatch):
    clock, planner = StoppedClock(monkeypatch), Planner()
    planner.batch = lambda observations: (Planner.batch(planner, observations), clock.sleep(seconds))[0]
    Highway(duration=2.0, ads_hz=1, hang_limit=1.0).rollout_batch(scenarios(4), lambda: planner)
    assert planner.asked == asked, "after a hang the runs are repeated one by one"


def test_interrupt_in_a_batch_decision_reaches_the_user():
    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Highway(duration=4.0).rollout_batch(scenarios(4), lambda: Failing(interrupt))


def test_batch_actions_may_be_generated_and_may_raise():
    class Lazy(Failing):
        def batch(self, observations):
            return (self.decided(observation) for observation in observations)

    traces = Highway(duration=4.0).rollout_batch(scenarios(4), lambda: Lazy(raises))
    assert [trace.outcome for trace in traces] == [Outcome.ADS_ERROR, *[Outcome.SAFE] * 3]


@table("answer", [lambda observations: [(0.0, 0.0)], lambda observations: None, lambda observations: []])
def test_a_wrong_number_of_actions_is_refused(answer):
    planner = Planner()
    planner.batch = answer
    with pytest.raises(AdsFactoryError, match=r"ads\.batch: expected 3 actions, one for each of 3 observations"):
        Highway(duration=2.0).rollout_batch(scenarios(3), lambda: planner)


def test_unfitting_scenario_is_refused_before_anything_runs():
    too_fast = Scenario(npcs=[[PositionInstruction(2, 60.0)]])
    for world in (Highway(), ENVIRONMENT):
        with pytest.raises(ScenarioError, match="speed"):
            world.rollout_batch([ALONE, too_fast], lambda: pytest.fail("the factory should not be called"))


def test_batch_decision_time_is_shared_among_its_runs():
    class Slow(Planner):
        def batch(self, observations):
            time.sleep(0.04)
            return super().batch(observations)

    started = time.perf_counter()
    traces = Highway(duration=1.0, ads_hz=1).rollout_batch(scenarios(4), Slow)
    elapsed = time.perf_counter() - started
    assert all(0.01 <= trace.max_decision_seconds <= elapsed / 4 for trace in traces)
