"""A campaign that is cut and continues equals one that was not cut, event by event."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching import (
    Checkpoint,
    DistinctSearch,
    PafotSearch,
    RandomManoeuvreSearch,
    RandomSearch,
    ResumableSearch,
    from_plain,
    plain,
)
from pytest_pafot.searching.algorithms.catalogue import CLASSES
from pytest_pafot.searching.evaluation import Evaluation, EvaluationCache, Remembered
from pytest_pafot.searching.events import CampaignFinished, CampaignStarted, GenerationFinished
from pytest_pafot.searching.operators import mutate
from pytest_pafot.searching.plan import CheckpointError, plan_of
from pytest_pafot.searching.space import SearchSpace, sample
from tests.helpers.campaigns import run_campaign

ALGORITHMS = [DistinctSearch(SearchSpace(genes=3), population=5, random_runs=10), RandomSearch(population=3)]


class Telling:
    """A fast world whose runs have kinds of failures, mistakes and margins."""

    def __init__(self, world):
        self.world = world

    def __call__(self, scenario):
        run = self.world(scenario)
        speed = run.executed.npcs[0][0].speed
        margins = (("near", 20.0 - speed), ("slow", speed))
        if not run.failing:
            return replace(run, margins=margins)
        mistake = "moved-into-side" if speed > 15 else "moved-in-front"
        kind = Signature(
            failure="AssertionError",
            assertion=f"speed {int(speed)}",
            outcome=Outcome.COLLISION,
            responsibility="ego",
            mistake=mistake,
            fault="entered-lane",
        )
        return replace(run, kind=kind, mistake=mistake, margins=margins)


def through_json(algorithm, checkpoint):
    """Return a checkpoint after JSON, as from a file."""
    parts = [
        algorithm.stored(checkpoint.state),
        *map(plain, (checkpoint.sums, checkpoint.remembered, checkpoint.begun)),
    ]
    state, sums, remembered, begun = json.loads(json.dumps(parts, allow_nan=False))
    return Checkpoint(
        state=algorithm.restored(state),
        sums=from_plain(CampaignFinished, sums),
        remembered=from_plain(tuple[Remembered, ...], remembered),
        begun=from_plain(tuple[tuple[Evaluation, bool], ...], begun),
    )


def campaign(algorithm, world, checkpoints=None, generations=None, **options):
    """Return the events, and the checkpoints at each border and at the end, by the number of events before."""
    events, kept = [], {} if checkpoints is None else checkpoints
    told = run_campaign(
        algorithm,
        Telling(world),
        generations=generations,
        seed=5,
        border=lambda plan: kept.update({len(events): through_json(algorithm, plan.checkpoint())}),
        **options,
    )
    for event in told:
        events.append(event)  # noqa: PERF402  (a checkpoint at a border follows the earlier events)
    return events


def body(events):
    """Return the events without a session's frame; of a generation that was finished twice, only the later report."""
    last = {each.generation: index for index, each in enumerate(events) if isinstance(each, GenerationFinished)}
    return [
        each
        for index, each in enumerate(events)
        if not isinstance(each, (CampaignStarted, CampaignFinished))
        and (not isinstance(each, GenerationFinished) or last[each.generation] == index)
    ]


@pytest.mark.parametrize("algorithm", ALGORITHMS, ids=lambda algorithm: algorithm.name)
def test_from_every_border_on_it_tells_the_rest(cheap_world, algorithm):
    checkpoints = {}
    whole = campaign(algorithm, cheap_world(), checkpoints, generations=6)
    assert len(checkpoints) == 7
    for told, checkpoint in checkpoints.items():
        left = 6 - checkpoint.generation
        if left:
            world = cheap_world()
            rest = campaign(algorithm, world, resumed=checkpoint, generations=left)
            assert rest[1:] == whole[max(told, 1) :]
            assert len(world.simulated) == whole[-1].simulated - checkpoint.sums.simulated


@pytest.mark.parametrize(("algorithm", "runs"), [(ALGORITHMS[0], 1), (ALGORITHMS[1], 7)], ids=str)
def test_resumed_parts_equal_one_uninterrupted_campaign(cheap_world, algorithm, runs):
    whole = campaign(algorithm, cheap_world(), runs=21)
    parts, checkpoint, world = [], None, cheap_world()
    for _ in range(21 // runs):
        checkpoints = {}
        parts += campaign(algorithm, world, checkpoints, resumed=checkpoint, runs=runs)
        checkpoint = checkpoints[max(checkpoints)]
    assert body(parts) == body(whole)
    assert parts[-1] == whole[-1]
    assert len(world.simulated) == 21  # none of them twice


def test_it_goes_on_with_other_limits(cheap_world):
    algorithm, checkpoints = ALGORITHMS[0], {}
    first = campaign(algorithm, cheap_world(), checkpoints, runs=13)
    rest = campaign(algorithm, cheap_world(), resumed=checkpoints[max(checkpoints)], generations=4)
    whole = campaign(algorithm, cheap_world(), generations=rest[-1].generations)
    assert body(first + rest) == body(whole)


def test_a_checkpoint_of_another_campaign_is_refused(cheap_world):
    checkpoints, algorithm = {}, PafotSearch(population=4)
    kept = lambda plan: checkpoints.update({len(checkpoints): plan.checkpoint()})  # noqa: E731
    list(run_campaign(algorithm, cheap_world(), generations=None, runs=5, seed=5, border=kept))
    checkpoint = checkpoints[max(checkpoints)]
    assert len(checkpoint.begun) == 1
    with pytest.raises(CheckpointError, match="begun: expected the evaluation of"):
        list(run_campaign(algorithm, cheap_world(), resumed=checkpoint, generations=None, runs=4, seed=6))
    wrong = replace(checkpoint, remembered=((checkpoint.begun[0][0], (7,)),))
    with pytest.raises(CheckpointError, match="remembered: expected numbers of 2 keys"):
        plan_of(algorithm, resumed=wrong, generations=None, runs=4, seed=5)


def test_which_algorithms_can_go_on():
    able = {name for name, made_by in CLASSES.items() if issubclass(made_by, ResumableSearch)}
    assert able == {"distinct", "random", "random-manoeuvre"}
    assert not isinstance(PafotSearch(), ResumableSearch)
    assert isinstance(RandomManoeuvreSearch(), ResumableSearch)


@settings(max_examples=settings.default.max_examples // 2)
@given(st.integers(0, 2**32), st.integers(1, 12), st.integers(0, 30))
def test_restored_cache_recalls_and_forgets_like_the_original(cheap_world, seed, room, cut):
    rng, world, space = (
        np.random.default_rng(seed),
        cheap_world(crash_speed=15.0, genes=2),
        SearchSpace(npcs=2, genes=2),
    )
    whole = resumed = EvaluationCache()
    scenario = sample(space, rng)
    for number in range(40):
        if number == cut:
            remembered = from_plain(tuple[Remembered, ...], json.loads(json.dumps(plain(whole.remembered()))))
            resumed = EvaluationCache()
            resumed.restore(remembered)
        for cache in {id(each): each for each in (whole, resumed)}.values():
            cache.add(world(scenario))
            cache.forget(room)
        other = mutate(scenario, space, rng)
        assert resumed.recall(other) == whole.recall(other)
        assert resumed.recall(scenario) == whole.recall(scenario)
        scenario = other if rng.random() < 0.6 else Scenario.repaired(scenario.npcs, seed=int(rng.integers(3)))
    assert resumed.remembered() == whole.remembered()
