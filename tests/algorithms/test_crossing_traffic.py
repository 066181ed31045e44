"""Traffic at zones: how a search samples, mutates and repairs it, and that nothing changes without zones."""

import hashlib
import json
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.algorithms import RandomSearch, SearchSpace, resolve_algorithm
from pytest_pafot.algorithms.catalogue import CLASSES
from pytest_pafot.algorithms.crossing_traffic import ACTS, CrossingTraffic, sample_slot
from pytest_pafot.algorithms.evaluation import Evaluated, EvaluationCache
from pytest_pafot.algorithms.operators import breed, crossover, mutate
from pytest_pafot.algorithms.space import sample
from pytest_pafot.model.instructions import Cell, CrossingInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Collision, Outcome
from pytest_pafot.model.vehicle_type import STYLES
from tests.helpers.crossings import clashes, junction, way_of
from tests.helpers.searches import run_plan
from tests.helpers.tables import table

JUNCTION = junction()
TRAFFIC = CrossingTraffic(JUNCTION, 0.0, 10.0, 2)
SPACE = SearchSpace(
    crossings=JUNCTION, most_npcs=(4,), genes=3, gene_seconds=4.0, speed_limit=10.0, ego_speed=10.0
)
seeds = st.integers(0, 2**32)
spaces = st.builds(
    SearchSpace,
    npcs=st.integers(1, 8),
    most_npcs=st.sampled_from([(), (4,)]),
    genes=st.integers(1, 4),
    speed_limit=st.sampled_from([2.0, 8.0, 20.0]),
    traffic=st.sampled_from(["paper", "hostile", "everyday"]),
    crossings=st.just(JUNCTION),
    most_on_grid=st.integers(0, 2),
)


def crosses(**changes):
    return CrossingInstruction(**({"zone": "o1>o3", "slot": 0.5, "speed": 8.0} | changes))


def told(scenario):
    return [each for each in scenario.crossings if each is not None]


def check(scenario, space):
    """Check everything that a search with a space promises about a scenario."""
    # this checks all scenario rules
    assert scenario == Scenario.from_canonical(json.loads(scenario.canonical()))
    assert not clashes(JUNCTION, scenario)
    assert len(scenario.npcs) - len(told(scenario)) <= space.most_on_grid
    assert len(scenario.npcs) <= (max(space.most_npcs) if space.most_npcs else space.npcs)
    for each in told(scenario):
        assert JUNCTION.fits(each)
        assert each.act in ACTS
        assert each.speed <= min(space.speed_limit, 12.0)
        assert each.speed >= min(3.0, space.speed_limit)
        assert each.speed >= min(STYLES[space.traffic].least_speed(space.speed_limit), 12.0) - 0.05


@given(spaces, seeds, st.integers(0, 8))
def test_drawn_and_varied_scenarios_fit_without_any_clash(space, seed, variations):
    rng = np.random.default_rng(seed)
    a, b = sample(space, rng), sample(space, rng)
    check(a, space)
    check(b, space)
    for _ in range(variations):
        a, b = breed((a, b), space, 0.7, 0.7, rng)
        a = mutate(crossover(a, b, rng)[0], space, rng)
        check(a, space)
        check(b, space)


def test_all_zones_acts_and_slots_are_drawn():
    rng = np.random.default_rng(0)
    scenarios = [sample(SPACE, rng) for _ in range(400)]
    instructions = [each for scenario in scenarios for each in told(scenario)]
    assert len(instructions) / sum(len(each.npcs) for each in scenarios) == pytest.approx(
        0.75, abs=0.06
    )
    assert {each.zone for each in instructions} == set(JUNCTION.ways)
    assert Counter(each.act for each in instructions).keys() == {"pass", "hold", "stop"}
    # together, and less than a second or more before and after the ego
    assert len({(np.sign(each.slot), abs(each.slot) >= 1) for each in instructions}) == 5
    assert any(len(told(each)) in range(1, len(each.npcs)) for each in scenarios)


def test_slots_are_rather_near_the_ego():
    rng = np.random.default_rng(0)
    slots = np.array([sample_slot(rng) for _ in range(4000)])
    assert np.abs(slots).max() <= 5
    shares = [
        np.mean(np.abs(slots) <= 1),
        np.mean((np.abs(slots) > 1) & (np.abs(slots) <= 3)),
        np.mean(slots > 0),
    ]
    assert shares == pytest.approx([0.72, 0.2, 0.5], abs=0.03)


def test_where_nobody_clashes_nothing_is_drawn():
    rng = np.random.default_rng(0)
    npcs = ((crosses(),), (PositionInstruction(2, 8.0),), (crosses(slot=3.0),))
    before = rng.bit_generator.state
    assert tuple(TRAFFIC.without_conflicts(npcs, rng).values()) == npcs
    assert rng.bit_generator.state == before


@given(seeds)
def test_later_of_two_clashing_npcs_is_redrawn(seed):
    npcs = ((crosses(),), (crosses(slot=0.8, act="hold"),))
    first, second = tuple(TRAFFIC.without_conflicts(npcs, np.random.default_rng(seed)).values())
    assert first == npcs[0]
    assert second != npcs[1]
    assert not JUNCTION.clash(first[0], second[0])


def test_unresolvable_npc_comes_last_or_is_left_out(monkeypatch):
    monkeypatch.setattr(CrossingTraffic, "sample", lambda self, rng: crosses(speed=6.0))
    monkeypatch.setattr("pytest_pafot.algorithms.crossing_traffic.sample_slot", lambda rng: 0.5)
    first, last, behind = (
        crosses(speed=6.0),
        crosses(slot=5.0, speed=6.0),
        PositionInstruction(2, 8.0),
    )
    npcs = ((first,), (crosses(speed=6.0, act="stop"),), (behind,), (crosses(speed=6.5),))
    assert tuple(TRAFFIC.without_conflicts(npcs, np.random.default_rng(0)).values()) == (
        (first,),
        (last,),
        (behind,),
    )


def test_npc_without_a_start_cell_crosses_instead():
    crowd = tuple((PositionInstruction(cell, 8.0),) for cell in (1, 2, 3))
    kept = tuple(TRAFFIC.without_conflicts(crowd, np.random.default_rng(0)).values())
    assert kept[:2] == crowd[:2]
    assert isinstance(kept[2][0], CrossingInstruction)


AT_ONCE = way_of("o1>o3", "crossing", "left", (88.0, 95.0), (0.0, 8.0))
NO_START = SearchSpace(crossings=junction(ways={"o1>o3": AT_ONCE}, meetings={}), most_on_grid=0)


def test_ways_without_possible_start_are_refused():
    with pytest.raises(ValueError, match=r"^crossings: "):
        sample(NO_START, np.random.default_rng(0))


def test_npcs_in_one_zone_swap_their_parts():
    a, b = crosses(slot=-2.0, speed=5.0, act="hold"), crosses(slot=3.0)
    children = {a.mixed(b, np.random.default_rng(seed)) for seed in range(100)}
    assert len(children) == 8
    for first, second in children:
        assert {first.slot, second.slot} == {-2.0, 3.0}
        assert {first.speed, second.speed} == {5.0, 8.0}
        assert {first.act, second.act} == {"hold", "pass"}
    one, other = Scenario(npcs=((a,),)), Scenario(npcs=((PositionInstruction(2, 8.0),) * 2,))
    assert [each.npcs for each in crossover(one, other, np.random.default_rng(0))] == [
        other.npcs,
        one.npcs,
    ]


def test_every_part_of_an_instruction_varies():
    instruction, rng = crosses(), np.random.default_rng(0)
    new = [TRAFFIC.vary(instruction, rng) for _ in range(300)]
    moved = [
        each.slot for each in new if (each.zone, each.speed, each.act) == ("o1>o3", 8.0, "pass")
    ]
    assert 0.4 < len(moved) / len(new) < 0.6
    assert np.abs(np.array(moved) - 0.5).mean() < 1.0
    assert new.count(instruction) < 10  # by chance, some other ones are equal
    assert {each.act for each in new} == {"pass", "hold", "stop"}
    assert len({each.zone for each in new}) == 4


class Judged:
    """Evaluate scenarios by digests of their texts: no search can learn them, and they are the same everywhere."""

    def __init__(self, make_evaluation):
        self.make_evaluation = make_evaluation

    def __call__(self, scenario):
        draw = hashlib.sha256(scenario.canonical().encode()).digest()
        hit = Collision(
            tick=15, time=1.0, npc=0, side="front", cell=Cell(draw[1] % 8 + 1), ego_speed=20.0,
            npc_speed=20 - draw[2] / 10, closing_speed=draw[2] / 10,
        )  # fmt: skip
        return self.make_evaluation(
            scenario,
            fitness=draw[3] / 10,
            failing=draw[0] < 40,
            outcome=Outcome.COLLISION
            if draw[0] < 80
            else Outcome.INVALID
            if draw[0] < 90
            else Outcome.COMPLETED,
            collision=hit if draw[0] < 80 else None,
            margins=(("a", draw[4] / 100 - 0.5), ("b", draw[5] / 50)),
        )


WITHOUT = {
    "papers": SearchSpace(),
    "wide": SearchSpace(
        npcs=4, ego_lanes=(0, 1, 2, 3), ego_speeds=(12.0, 26.8), patterns=True, traffic="hostile",
        most_npcs=(4, 6, 6, 4), gene_durations=(4.0, 7.0, 10.0),
    ),
    "bend": SearchSpace(npcs=2, genes=3, gene_seconds=4.3, traffic="everyday", ego_lane=1, ego_speed=8.0),
}  # fmt: skip
AS_BEFORE = {
    ("pafot", "papers"): "fc535b075c81",
    ("pafot", "wide"): "a6156b0451be",
    ("pafot", "bend"): "c7ee8c480c56",
    ("random", "papers"): "95ea8d78ab11",
    ("random", "wide"): "2d01e701a538",
    ("random", "bend"): "4b3bd7979350",
    ("random-manoeuvre", "papers"): "25c4d6900da9",
    ("random-manoeuvre", "wide"): "5669f3be3436",
    ("random-manoeuvre", "bend"): "b582d4195c24",
}
"""Digests of the samples of each algorithm, in a space and with the seed 0, which zones do not change."""


@table(("name", "space"), AS_BEFORE)
def test_searches_without_zones_draw_as_they_did_before(name, space, make_evaluation):
    assert drawn_digest(name, WITHOUT[space], make_evaluation) == AS_BEFORE[name, space]


def drawn_digest(name, space, make_evaluation):
    algorithm, digest = resolve_algorithm(name).make(space), hashlib.sha256()
    if isinstance(algorithm, RandomSearch):
        scenarios = [algorithm.drawn(0, number) for number in range(32)]
    else:
        events = run_plan(algorithm, Judged(make_evaluation), generations=8, seed=0)
        scenarios = [event.evaluation.scenario for event in events if isinstance(event, Evaluated)]
    for each in scenarios:
        digest.update(each.canonical().encode())
    return digest.hexdigest()[:12]


def test_random_search_handles_junctions():
    scenarios = [RandomSearch(SPACE).drawn(1, number) for number in range(48)]
    for each in scenarios:
        check(each, SPACE)
    assert len({each.id for each in scenarios}) == len(scenarios)
    assert any(told(each) for each in scenarios)


@table("name", [name for name in CLASSES if resolve_algorithm(name).is_papers])
def test_the_papers_searches_keep_to_the_grid(name, make_evaluation):
    search = resolve_algorithm(name).make(SearchSpace())
    events = run_plan(search, Judged(make_evaluation), generations=3, seed=1)
    assert not any(
        event.evaluation.scenario.crossings for event in events if isinstance(event, Evaluated)
    )


def test_cached_run_matches_only_the_whole_crossing_instruction(make_evaluation):
    runs = [
        Scenario(npcs=((each,),)) for each in (crosses(), crosses(slot=1.0), crosses(act="hold"))
    ]
    cache = EvaluationCache(map(make_evaluation, runs))
    assert [cache.recall(Scenario(npcs=run.npcs, seed=5)).scenario.npcs for run in runs] == [
        run.npcs for run in runs
    ]
    assert cache.recall(Scenario(npcs=((crosses(speed=8.1),),))) is None
    assert cache.recall(Scenario(npcs=((crosses(zone="o1>o2"),),))) is None
