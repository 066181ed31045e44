"""A run that takes its first decisions from an earlier one equals the run that makes all decisions."""

import random
from collections import deque
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pytest_pafot import Highway, LaneInstruction, Outcome, PositionInstruction, Scenario
from pytest_pafot.execution.runner import DecisionCache, runner_for
from pytest_pafot.execution.scenario_pool import Job
from pytest_pafot.searching.operators import mutate
from pytest_pafot.searching.space import SearchSpace, sample
from pytest_pafot.support.errors import BadAction
from pytest_pafot.world import WorldError
from pytest_pafot.world.driving.policy import Policy
from tests.helpers.tables import table

PI = PositionInstruction
WORLD = Highway(duration=30.0)
PARENT = Scenario(
    npcs=((PI(2, 22.0), PI(1, 24.0), PI(2, 20.0)), (PI(6, 22.0), PI(7, 22.0), PI(6, 25.0))), gene_seconds=3.0
)
EVERY_GENE = 15
"""The number of decisions in a gene of 3 s."""


def test_decisions_among_other_vehicles_are_not_reused():
    cache = DecisionCache()
    cache.remember(driven(PARENT)[0])
    assert cache.recall(PARENT)[0]
    assert cache.recall(replace(PARENT, vehicles=("truck",))) == ((), None)


class Counting:
    """A pure policy that follows vehicles ahead, weaves with vehicles alongside, and counts its decisions."""

    def __init__(self):
        self.asked = 0

    def __call__(self, observation):
        self.asked += 1
        ego = observation.ego
        gap = min((o.x - ego.x for o in observation.others if o.lane == ego.lane and o.x > ego.x), default=80.0)
        beside = sum(o.y - ego.y for o in observation.others if abs(o.x - ego.x) < 15.0)
        if gap < 4.0:
            raise RuntimeError("too near")
        return 0.1 * min(gap - 12.0, 24.0 - ego.speed), 0.0005 * beside - 0.2 * ego.heading


def driven(scenario, decisions=()):
    """Return a run, and the number of decisions that the policy made."""
    ads = Counting()
    return WORLD.rollout(scenario, lambda: ads, decisions=decisions), ads.asked


def differences(trace, other):
    """Return the fields that are not equal to the last bit."""
    plain = ("scenario", "executed", "outcome", "collision", "actions", "arrivals", "off_road_tick", "driven")
    found = [name for name in plain if getattr(trace, name) != getattr(other, name)]
    found += [name for name in ("states", "sizes") if getattr(trace, name).tobytes() != getattr(other, name).tobytes()]
    errors = [None if each.error is None else (each.error.kind, each.error.tick) for each in (trace, other)]
    return found if errors[0] == errors[1] else [*found, "error"]


def remembering(*scenarios):
    prefixes = DecisionCache()
    for scenario in scenarios:
        prefixes.remember(driven(scenario)[0])
    return prefixes


def shared_decisions(child, parent=PARENT):
    """Return how many decisions of a child are known, after checking that it drives the same with and without them."""
    decisions = remembering(parent).recall(child)[0]
    whole, all_of_them = driven(child)
    resumed, asked = driven(child, decisions)
    assert differences(resumed, whole) == []
    assert asked == max(all_of_them - len(decisions), 0)
    return all_of_them - asked


@settings(max_examples=8)
@given(
    seed=st.integers(0, 2**32),
    npcs=st.integers(1, 4),
    lanes=st.booleans(),
    gene_seconds=st.sampled_from([10 / 15, 2.6]),
    ego_lane=st.sampled_from([0, 1, 3]),
)
@example(seed=0, npcs=4, lanes=True, gene_seconds=2.6, ego_lane=3)
def test_related_runs_with_recalled_decisions_drive_the_same(seed, npcs, lanes, gene_seconds, ego_lane):
    prefixes, rng = DecisionCache(decisions=200), np.random.default_rng(seed)
    space = SearchSpace(npcs=npcs, genes=4, gene_seconds=gene_seconds, ego_lane=ego_lane)
    scenario = laned(sample(space, rng), rng) if lanes else sample(space, rng)
    for _ in range(12):
        decisions = prefixes.recall(scenario)[0]
        whole, all_of_them = driven(scenario)
        resumed, asked = driven(scenario, decisions)
        assert differences(resumed, whole) == []
        assert all_of_them - asked == min(len(decisions), all_of_them)
        prefixes.remember(resumed)
        scenario = varied(resumed.executed if rng.random() < 0.6 else scenario, space, rng, lanes)


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32), npcs=st.integers(1, 3), gene_seconds=st.sampled_from([10 / 15, 2.6]))
def test_copies_of_a_policy_with_a_state_go_on_as_the_policy(seed, npcs, gene_seconds):
    rng = np.random.default_rng(seed)
    blend, sway, late = rng.uniform(0.1, 0.9), rng.uniform(0.0, 0.5), int(rng.integers(1, 9))

    class Remembering(Counting):
        copyable = True

        def __init__(self):
            super().__init__()
            self.random, self.past, self.speed = random.Random(seed), deque(maxlen=late), {"mean": 20.0}

        def __call__(self, observation):
            self.speed["mean"] += blend * (observation.ego.speed - self.speed["mean"])
            self.past.append(super().__call__(observation))
            acceleration, steering = self.past[0]
            return acceleration + sway * self.random.uniform(-1, 1) + 0.1 * (22.0 - self.speed["mean"]), steering

    space = SearchSpace(npcs=npcs, genes=4, gene_seconds=gene_seconds)
    scenario = sample(space, rng)
    with ExitStack() as stack:
        records = Path(stack.enter_context(TemporaryDirectory()))
        job = Job(world=WORLD, policy=Policy(Remembering), records=records, owner="test")
        runner = stack.enter_context(runner_for(job, stack.enter_context(job.crash_record())))
        for _ in range(12):
            trace = runner.run(scenario)
            assert differences(trace, WORLD.rollout(scenario, Remembering)) == []
            scenario = varied(trace.executed if rng.random() < 0.6 else scenario, space, rng, lanes=False)
        before = runner.reused
        runner.run(trace.scenario)
        assert runner.reused - before >= len(trace.actions) - (trace.error is not None)


def laned(scenario, rng):
    """Return the same scenario with Lane-Instructions."""
    chains = [[LaneInstruction(str(rng.choice(["keep", "left", "right"])), g.speed) for g in c] for c in scenario.npcs]
    return replace(scenario, npcs=tuple(map(tuple, chains)))


def varied(scenario, space, rng, lanes):
    """Return a child: shortened, with a different seed or start, or with other genes."""
    what = rng.integers(6)
    if what == 0:
        return scenario.truncated(int(rng.integers(1, scenario.genes + 1)))
    if what == 1:
        return replace(scenario, seed=int(rng.integers(1000)))
    if what == 2:
        return replace(scenario, ego_speed=float(rng.integers(18, 24)))
    if not lanes:
        return mutate(scenario, space, rng)
    npc, gene = rng.integers(len(scenario.npcs)), rng.integers(scenario.genes)
    chains = [list(chain) for chain in scenario.npcs]
    chains[npc][gene : gene + 1] = [LaneInstruction("left", float(rng.integers(18, 26)))]
    return replace(scenario, npcs=tuple(map(tuple, chains)))


def changed(npc, gene, *instead):
    """Return the parent with other genes from a place on."""
    chains = list(PARENT.npcs)
    chains[npc] = (*chains[npc][:gene], *instead, *chains[npc][gene + len(instead) :])
    return replace(PARENT, npcs=tuple(chains))


@table(("gene", "other"), [(1, PI(1, 24.1)), (2, PI(2, 20.1)), (2, PI(1, 20.0))])
@table("npc", [0, 1])
def test_decisions_are_shared_until_the_first_different_gene(npc, gene, other):
    instead = other if npc == 0 else PI({1: 7, 2: 6}[int(other.cell)], other.speed)
    assert shared_decisions(changed(npc, gene, instead)) == EVERY_GENE * gene + 1


def test_other_starts_and_gene_lengths_share_no_decisions():
    others = [
        changed(0, 0, PI(2, 22.1)),
        replace(PARENT, ego_speed=21.0),
        replace(PARENT, ego_lane=2),
        replace(PARENT, gene_seconds=3.2),
        replace(PARENT, npcs=PARENT.npcs[:1]),
    ]
    assert [shared_decisions(other) for other in others] == [0] * 5


def test_shorter_and_longer_chains_share_what_both_have():
    two, longer = PARENT.truncated(2), replace(PARENT, npcs=tuple((*chain, chain[-1]) for chain in PARENT.npcs))
    assert shared_decisions(two) == 2 * EVERY_GENE
    assert shared_decisions(longer) == 3 * EVERY_GENE, "the parent ends before it decides at the boundary"
    ends_sooner = replace(PARENT, npcs=(PARENT.npcs[0][:2], PARENT.npcs[1]))
    assert shared_decisions(ends_sooner) == 2 * EVERY_GENE + 1


def test_seed_matters_only_if_genes_were_repaired():
    to_the_left = Scenario(npcs=((PI(8, 22.0), PI(8, 22.0)),), ego_lane=0, gene_seconds=3.0)
    trace, _ = driven(to_the_left)
    assert trace.executed.npcs != to_the_left.npcs, "there is no lane to the left"
    prefixes = DecisionCache()
    prefixes.remember(trace)
    assert prefixes.recall(to_the_left)[0] == trace.actions
    assert prefixes.recall(replace(to_the_left, seed=5))[0] == ()
    assert prefixes.recall(replace(trace.executed, seed=5))[0] == trace.actions


def test_seed_never_matters_for_lane_instructions():
    chains = (tuple(LaneInstruction("keep", 22.0) for _ in range(2)),) * 3
    scenarios = [Scenario(npcs=chains, ego_lane=3, gene_seconds=3.0, seed=seed) for seed in range(8)]
    assert len({driven(each)[0].states.tobytes() for each in scenarios}) == 1
    prefixes = remembering(scenarios[0])
    assert [len(prefixes.recall(each)[0]) for each in scenarios] == [30] * 8


def test_decisions_before_a_collision_are_shared_completely():
    crash = Scenario(npcs=((PI(2, 5.0), PI(2, 0.0), PI(2, 0.0), PI(2, 9.0)),), gene_seconds=3.0)
    careless = [(1.0, 0.0)] * 60
    trace = WORLD.rollout(crash, Counting, decisions=careless)
    assert trace.outcome is Outcome.COLLISION
    prefixes = DecisionCache()
    prefixes.remember(trace)
    begun = -(-trace.ticks // 45)
    assert 1 <= begun < 4
    later = replace(crash, npcs=((*crash.npcs[0][:begun], PI(3, 20.0)),))
    assert prefixes.recall(later)[0] == trace.actions
    again, asked = driven(later, prefixes.recall(later)[0])
    assert (asked, again.outcome) == (0, Outcome.COLLISION)
    assert again.states.tobytes() == trace.states.tobytes()


def test_raising_ads_is_asked_again_and_raises_again():
    class Failing(Counting):
        def __call__(self, observation):
            if observation.time > 1.0:
                raise LookupError
            return super().__call__(observation)

    trace = WORLD.rollout(PARENT, Failing)
    prefixes = DecisionCache()
    prefixes.remember(trace)
    assert len(prefixes.recall(PARENT)[0]) == 6
    assert differences(WORLD.rollout(PARENT, Failing, decisions=prefixes.recall(PARENT)[0]), trace) == []


def test_oldest_runs_are_forgotten_before_recently_used_ones():
    scenarios = [replace(PARENT, ego_speed=float(speed)) for speed in (18, 19, 20)]
    runs = [driven(scenario)[0] for scenario in scenarios]
    counts = [len(run.actions) for run in runs]
    prefixes = DecisionCache(decisions=sum(counts) - 1)
    for run in runs:
        prefixes.remember(run)
    assert [len(prefixes.recall(each)[0]) for each in scenarios] == [0, *counts[1:]]
    prefixes.remember(driven(scenarios[1])[0])
    prefixes.remember(runs[0])
    assert [len(prefixes.recall(each)[0]) for each in scenarios] == [*counts[:2], 0]


def test_run_larger_than_the_cache_is_not_stored():
    prefixes = DecisionCache(decisions=10)
    prefixes.remember(driven(PARENT)[0])
    assert prefixes.recall(PARENT)[0] == ()


def test_only_asked_decisions_are_timed():
    trace, _ = driven(PARENT)
    assert trace.max_decision_seconds > 0
    assert driven(PARENT, trace.actions)[0].max_decision_seconds == 0


def test_a_decision_that_is_none_is_refused():
    with pytest.raises(BadAction, match="expected"):
        driven(PARENT, [(0.0, 0.0), "left"])


def test_a_vehicle_class_takes_no_decisions():
    with pytest.raises(WorldError, match=r"IDMVehicle.*a vehicle class.*received 1"):
        WORLD.rollout(PARENT, IDMVehicle, decisions=[(0.0, 0.0)])
