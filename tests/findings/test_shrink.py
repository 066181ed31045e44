"""Shrinking with predicates instead of runs: the input, what still fails, and the exact minimal answer."""

import re
from dataclasses import replace
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_pafot.findings.shrink import instructions, size_of, sort_key
from pytest_pafot.model.instructions import SHIFTS, Cell, instruction_of
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.vehicle_type import MOTORCYCLE, PAPERS, TRUCK
from pytest_pafot.strategies import scenarios
from tests.helpers.shrinking import shrink, shrunk_by
from tests.helpers.tables import table


def scenario(*chains, **fields):
    """Return a scenario from texts such as "4@22 3@24.5" or "left@22 keep@5": cell or lane, and speed of each gene."""
    pairs = [[gene.split("@") for gene in text.split()] for text in chains]
    npcs = [
        [instruction_of([int(to) if to.isdigit() else to, float(speed)]) for to, speed in chain]
        for chain in pairs
    ]
    return Scenario(npcs=tuple(map(tuple, npcs)), **fields)


def written(given):
    """Return the texts of a scenario, the inverse of `scenario`."""
    return tuple(
        " ".join(f"{gene.target}@{gene.speed:g}" for gene in chain) for chain in given.npcs
    )


shrunk = partial(shrunk_by, rollouts=5000, top_speed=26.8)


def minimal(given, fails):
    """Return the chains of the result, which must be minimal."""
    simplest, how = shrunk(given, fails)
    assert how.is_minimal
    return written(simplest)


BUSY = scenario(
    "4@22.3 3@24.1 2@7.7 2@7.7 3@19 4@1.2", "8@21 1@3.4 8@26.8 8@26.8 7@5 6@2.5", seed=77
)
"""A scenario with two NPCs with six genes each."""
IN_LANES = scenario("keep@7 left@3 keep@7 left@3", "left@3 keep@7 keep@7 keep@7")
MIXED = scenario("4@20 4@20 3@20 2@5", "left@3 keep@7 keep@7 keep@7")
CIRCLING = scenario("4@5 3@5 2@5 1@5 8@5")


def has(cell, at_least=0.0, at_most=100.0):
    """Return a predicate that is true if an NPC has an instruction for a cell at a speed in a range."""
    return lambda each: any(
        gene.cell == cell and at_least <= gene.speed <= at_most
        for chain in each.npcs
        for gene in chain
    )


def moves(each, pattern):
    """Return whether an NPC's chain matches a pattern."""
    return any(re.search(pattern, chain) for chain in written(each))


AROUND = scenario("1@20", "2@20", "3@20", "4@20", "5@20", "6@20", "7@20", "8@20")
LONG_IN_LANES = scenario(
    "keep@5 left@8 left@8 keep@3 right@2 left@11", "keep@1 keep@2 keep@3 keep@4 keep@5 keep@6"
)


@table(("given", "fails", "answer"), [
    (BUSY, lambda each: True, ("1@0",)),
    # Of many NPCs, those that matter together stay.
    (AROUND, lambda each: {Cell(2), Cell(7)} <= {chain[0].cell for chain in each.npcs}, ("2@0", "7@0")),
    # A run that must be long has one instruction.
    (BUSY, lambda each: each.genes >= 4 and has(Cell.FRONT)(each), ("2@0 2@0 2@0 2@0",)),
    # Only moves that matter remain, and in an order that matters.
    (BUSY, lambda each: moves(each, "3@.* 2@"), ("3@0 2@0",)),
    (BUSY, lambda each: moves(each, "^8@.* 6@[^ ]*$"), ("8@0 7@0 6@0",)),
    # Rounding does not exceed a speed limit.
    (scenario("2@26.4"), has(Cell.FRONT, 25.5), ("2@26",)),
    (scenario("2@26.4"), has(Cell.FRONT, 26.2), ("2@26.2",)),
    # A small scenario is found although nothing leads to it, also one of two NPCs.
    (BUSY, lambda each: each == BUSY or re.match("1@20 2@0[^&]*$", " & ".join(written(each))), ("1@20 2@0",)),
    (BUSY, lambda each: each == BUSY or written(each) == ("4@20", "6@25"), ("4@20", "6@25")),
    # Two steps are combined if neither helps alone.
    (CIRCLING, lambda each: each == CIRCLING or written(each) == ("3@5 2@5 1@5",), ("3@5 2@5 1@5",)),
    # An NPC in lanes cuts in on the grid, and stays in lanes where the grid does not fail.
    (scenario("keep@5 right@5"), lambda each: moves(each, "^(keep@5 right@5|1@.* 2@5)$"), ("1@0 2@5",)),
    (MIXED, lambda each: moves(each, "right@") or each == MIXED, ("right@0",)),
    # A change of lanes lasts for as long as needed.
    (LONG_IN_LANES, lambda each: each.genes >= 4 and "left@" in written(each)[0], ("left@0 keep@0 keep@0 keep@0",)),
])  # fmt: skip
def test_minimal_scenario_has_only_what_matters(given, fails, answer):
    assert minimal(given, fails) == answer


def test_run_begins_later_if_ego_state_suffices():
    given = scenario("4@20 4@20 3@20 2@5", ego_lane=1, ego_speed=22.0, seed=7)
    states = ((1, 22.0), (2, 21.0), (2, 15.5), (3, 15.5))

    def fails(each):
        return (
            has(Cell.FRONT)(each) and (each.ego_lane, each.ego_speed) == (3, 15.5)
        ) or each.npcs == given.npcs

    simplest, _ = shrunk(
        given, fails, starts=lambda each: states if each.npcs == given.npcs else ()
    )
    assert (simplest.ego_lane, simplest.ego_speed) == (3, 15.5)
    assert written(simplest) == ("2@0",)


@pytest.mark.parametrize(("low", "high", "answer"), [
    (0, 100, "0"), (3, 12, "5"), (6, 14, "10"), (6, 9, "6"), (7.3, 7.9, "7.3"), (7.7, 7.7, "7.7"), (7.5, 30, "10"),
])  # fmt: skip
def test_speeds_become_round_and_then_low(low, high, answer):
    assert minimal(BUSY, has(Cell.FRONT, low, high)) == (f"2@{answer}",)


def test_seed_becomes_zero_where_it_is_irrelevant():
    assert shrunk(BUSY, lambda each: True)[0].seed == 0
    assert shrunk(BUSY, lambda each: each.seed == 77)[0].seed == 77


def test_ego_start_and_gene_length_stay_unchanged():
    given = scenario("2@20 2@20", ego_lane=2, ego_speed=17.5, gene_seconds=4.0)
    result = shrunk(given, lambda each: True)[0]
    assert (result.ego_lane, result.ego_speed, result.gene_seconds) == (2, 17.5, 4.0)


def test_default_traffic_becomes_paper_traffic_last():
    given = scenario("2@20 2@20", seed=3, traffic="hostile")
    asked = []
    assert shrunk(given, lambda each: asked.append(each) or True)[0] == scenario("1@0")
    assert next(each for each in asked if each.traffic == PAPERS) == scenario("1@0")
    assert shrunk(given, lambda each: each.traffic == "hostile")[0] == scenario(
        "1@0", traffic="hostile"
    )


def test_paper_traffic_is_tried_despite_spent_budget():
    simplest, how = shrunk(
        replace(BUSY, traffic="hostile"), lambda each: len(each.npcs) == 2, rollouts=20
    )
    assert (simplest.traffic, how.is_minimal) == (PAPERS, False)


@table("traffic", ["everyday", "assertive"])
def test_chosen_style_and_its_least_speed_stay(traffic):
    simplest, _ = shrunk(scenario("2@22.5 3@25", traffic=traffic), lambda each: True)
    assert simplest.traffic == traffic
    least = {"everyday": 25.0, "assertive": 15.0}[traffic]  # 20.1 and 13.4 are less round
    assert [gene.speed for gene in simplest.npcs[0]] == [least]


def test_instructions_below_the_least_speed_get_no_slower():
    given = scenario("2@15 2@15 3@25", traffic="everyday")
    assert (
        min(gene.speed for chain in shrunk(given, lambda each: True)[0].npcs for gene in chain)
        == 15.0
    )


def test_the_scenario_as_driven_is_what_comes_out():
    driven = scenario("1@10")

    def attempt(candidate):
        return driven if candidate.npcs[0][0].cell == Cell.FRONT else None

    assert shrink(scenario("2@10 2@20"), attempt, rollouts=100)[0] == driven


def test_run_that_is_no_simpler_is_not_accepted():
    given = scenario("2@10 2@10 3@10")
    simplest, how = shrink(given, lambda _: given, rollouts=5000)
    assert simplest == given
    assert how.is_minimal


def test_first_attempts_are_short_because_a_run_that_does_not_fail_lasts_to_its_end():
    """With little time, few attempts are made. Most of them have to be of scenarios without what is not needed."""
    long, attempts = scenario("2@0 " * 30, *(f"{cell}@20 " * 30 for cell in (1, 3, 4, 5, 6))), []

    def attempt(candidate):
        attempts.append(candidate)
        return candidate if has(2)(candidate) else None

    shrink(long, attempt, rollouts=100)
    assert all(each.genes == 1 for each in attempts)
    assert sum(len(each.npcs) for each in attempts[:20]) < 2 * 20


def test_vehicles_become_cars_unless_the_failure_needs_them():
    given = replace(BUSY, vehicles=("truck", "motorcycle"))
    simplest, how = shrunk(given, has(2))
    assert (simplest.vehicles, len(simplest.npcs), how.is_minimal) == ((), 1, True)
    for needed in (TRUCK, MOTORCYCLE):  # the other NPC is left out together with its vehicle
        simplest, how = shrunk(given, lambda each, needed=needed: needed in each.vehicles)
        assert (simplest.vehicles, written(simplest), how.is_minimal) == ((needed,), ("1@0",), True)


def test_a_car_is_tried_before_most_other_changes():
    asked = []
    shrink(replace(BUSY, vehicles=("truck",)), asked.append, rollouts=100)
    assert (
        next(
            number for number, each in enumerate(asked) if not each.vehicles and len(each.npcs) == 2
        )
        < 10
    )


def test_without_rollouts_nothing_is_tried():
    simplest, how = shrunk(BUSY, lambda each: True, rollouts=0)
    assert (simplest, how.rollouts, how.is_minimal) == (BUSY, 0, False)


def test_only_likely_small_scenarios_are_run():
    looked, asked = [], []
    shrunk(BUSY, lambda each: each == BUSY, likely=lambda each, best: looked.append((each, best)))
    (wanted, best), small = looked[20], {each for each, _ in looked}
    assert best == BUSY
    assert all(sort_key(each) < sort_key(BUSY)[:2] for each in small)
    likely = lambda each, best: each == wanted  # noqa: E731
    assert (
        shrunk(BUSY, lambda each: asked.append(each) or each in (BUSY, wanted), likely=likely)[0]
        == wanted
    )
    assert len(set(asked) & small) < 5  # and those that a pass leads to


def test_small_scenario_may_begin_as_run_was_found():
    given = scenario("4@20 4@20 3@20 2@5", ego_lane=2, ego_speed=17.0)
    simplest, _ = shrunk(given, lambda each: each == given or written(each) == ("6@25",))
    assert (written(simplest), simplest.ego_lane, simplest.ego_speed) == (("6@25",), 2, 17.0)


@table(("fails", "start"), [
    (lambda each: True, (1, 22.0)),
    (lambda each: each.ego_lane == 3, (3, 22.0)),
    (lambda each: each.ego_speed < 14, (1, 10.0)),
    (lambda each: 11 < each.ego_speed < 14, (1, 13.0)),
])  # fmt: skip
def test_ego_starts_as_plainly_as_failure_allows(fails, start):
    given = scenario("4@20 3@20 2@5", ego_lane=3, ego_speed=13.7)
    simplest, _ = shrunk(given, fails, plain=(1, 22.0))
    assert (simplest.ego_lane, simplest.ego_speed) == start


@table(("least_genes", "seconds"), [(1, 10.0), (3, 5.0)])
def test_genes_last_as_long_as_in_default_search(least_genes, seconds):
    given = scenario("4@20 4@20 3@20", gene_seconds=5.0)
    simplest, _ = shrunk(
        given, lambda each: each.genes >= least_genes and has(4)(each), plain_seconds=10.0
    )
    assert simplest.gene_seconds == seconds


@pytest.mark.parametrize("given", [IN_LANES, MIXED])
@pytest.mark.parametrize(
    "wanted", [("right@20",), ("left@20 keep@20 keep@20 keep@20",), ("6@25",), ("4@20", "6@25")]
)
def test_small_scenarios_of_both_kinds_replace_npcs_in_lanes(given, wanted):
    assert minimal(given, lambda each: each == given or written(each) == wanted) == wanted


def test_small_scenarios_for_npcs_on_grid_are_on_grid():
    asked = []
    shrunk(BUSY, lambda each: asked.append(each) or each == BUSY, rollouts=300)
    assert all(
        gene.target in tuple(Cell) for each in asked for chain in each.npcs for gene in chain
    )


def start_cells(each):
    """Return the start cells of a scenario's NPCs in the middle of a wide road: NPCs in lanes take the free ones."""
    taken = [chain[0].target for chain in each.npcs]
    free = iter([cell for cell in (1, 2, 3, 8, 4, 6, 7, 5) if cell not in taken])
    return [next(free) if isinstance(target, str) else int(target) for target in taken]


@table(("given", "cell", "answer"), [
    (scenario("keep@5", "keep@10", "keep@15", "keep@20"), 8, "8@20"),
    (scenario("keep@5 left@2", "keep@10 right@3", "keep@20 keep@20"), 3, "3@20"),
    (scenario("2@5 1@5", "keep@5 left@5", "keep@20 keep@20"), 3, "3@20"),
])  # fmt: skip
def test_npc_on_grid_needs_no_others_to_start_in_its_place(given, cell, answer):
    """In lanes, the third NPC starts in cell 3 only if two others are there."""

    def fails(each):
        starts = zip(start_cells(each), each.npcs, strict=True)
        return any(
            start == cell and {gene.speed for gene in chain} == {20.0} for start, chain in starts
        )

    assert minimal(given, fails) == (answer,)


def test_long_chains_of_which_little_matters_take_few_runs():
    genes = [f"{SHIFTS[gene * gene % 3]}@{gene * 7 % 26}" for gene in range(30)]
    given = scenario(" ".join(genes), " ".join(reversed(genes)))

    def fails(each):
        return each.genes >= 25 and any(chain.count("left@") >= 1 for chain in written(each))

    simplest, how = shrunk(given, fails, rollouts=300)
    assert (len(simplest.npcs), instructions(simplest), simplest.genes) == (1, 1, 25)
    assert how.rollouts < 300


def test_small_scenario_trials_leave_budget_for_the_passes():
    simplest, _ = shrunk(
        BUSY, lambda each: each == BUSY or (len(each.npcs) == 2 and each.genes == 6), rollouts=200
    )
    assert written(simplest)[0].endswith("@0")


def test_sizes_read_as_words():
    assert size_of(BUSY) == "2 NPCs, 10 instructions, 60 s"
    assert size_of(scenario("2@0", gene_seconds=2.5)) == "1 NPC, 1 instruction, 2.5 s"
    assert size_of(scenario("2@0", gene_seconds=26 / 3)) == "1 NPC, 1 instruction, 8.7 s"
    assert (
        size_of(scenario("2@0 2@0", gene_seconds=40), longest_run=60)
        == "1 NPC, 1 instruction, 60 s"
    )


@table(("simpler", "other"), [
    (scenario("4@22 3@20 2@10"), scenario("2@0", "4@0")),
    (scenario("4@20 4@20 4@20"), scenario("4@20 4@0")),
    (scenario("4@20 4@0"), scenario("4@0 3@0")),
    (scenario("4@20"), scenario("4@20 4@20")),
    (scenario("4@3.7"), scenario("4@0", ego_lane=2)),
    (scenario("4@3.7", ego_lane=2), scenario("4@0", ego_lane=2, ego_speed=20.0)),
    (scenario("4@3.7", ego_speed=15.0), scenario("4@0", ego_speed=12.0)),
    (scenario("4@3.7"), scenario("4@0", gene_seconds=5.0)),
    (scenario("4@20"), scenario("4@19")),
    (scenario("4@19"), scenario("4@18.5")),
    (scenario("4@15"), scenario("4@20")),
    (scenario("4@15"), scenario("4@15", seed=1)),
    (scenario("left@5 keep@5 keep@5"), scenario("left@5 keep@0")),
    (scenario("left@5 keep@5 keep@5"), scenario("left@5 left@5")),
    (scenario("keep@5 keep@5 keep@5"), scenario("left@5")),
    (scenario("2@20 2@20"), scenario("keep@20")),
    (scenario("left@20"), scenario("1@20 2@20")),
])  # fmt: skip
def test_the_order_of_simpler(simpler, other):
    assert sort_key(simpler) < sort_key(other)


@st.composite
def failures(draw):
    """Return a scenario and a failure that it shows: numbers of NPCs and genes, cells or lanes, and speed limits."""
    given = draw(scenarios(max_npcs=2, max_genes=4))
    genes = [gene for chain in given.npcs for gene in chain]
    targets = draw(
        st.sets(st.sampled_from(sorted({gene.target for gene in genes}, key=str)), max_size=3)
    )
    least = draw(st.integers(1, len(given.npcs))), draw(st.integers(1, given.genes))
    limit = draw(st.floats(0, 10)) + max(
        (gene.speed for gene in genes if gene.target in targets), default=0.0
    )

    def fails(each):
        genes = [gene for chain in each.npcs for gene in chain]
        is_large = len(each.npcs) >= least[0] and each.genes >= least[1]
        slow = all(gene.speed <= limit for gene in genes if gene.target in targets)
        return is_large and slow and targets <= {gene.target for gene in genes}

    assert fails(given)
    return given, fails


@given(failures(), st.integers(0, 400))
def test_result_fails_without_growing_or_exceeding_its_budget(failure, rollouts):
    shrunk(*failure, rollouts=rollouts)


@settings(max_examples=settings.default.max_examples // 4)  # each shrinks three times, to the end
@given(failures())
def test_minimal_result_is_repeatable_and_cannot_be_reduced(failure):
    given, fails = failure
    best, how = shrunk(given, fails, rollouts=10_000)
    assert how.is_minimal
    assert shrunk(given, fails, rollouts=10_000) == (best, how)
    assert shrunk(best, fails, rollouts=10_000)[0] == best
    smaller = [best.truncated(genes) for genes in range(1, best.genes)]
    if len(best.npcs) > 1:
        chains = [best.npcs[:npc] + best.npcs[npc + 1 :] for npc in range(len(best.npcs))]
        smaller += [
            Scenario(npcs=each, ego_lane=best.ego_lane, ego_speed=best.ego_speed) for each in chains
        ]
    assert not any(fails(each) for each in smaller)
    assert instructions(best) <= instructions(given)


@given(failure=failures(), ahead=st.integers(2, 20), rollouts=st.sampled_from([0, 1, 20, 150]))
def test_runs_told_in_advance_change_nothing_and_are_those_that_follow(failure, ahead, rollouts):
    given, fails = failure
    plain, how = shrunk(given, fails, rollouts=rollouts)
    asked, told, waiting = [], [], []

    def expect(candidates, more):
        if not more:
            waiting.clear()
        waiting.extend(candidates)
        told.extend(candidates)
        assert len(waiting) <= ahead

    def attempt(candidate):
        asked.append(candidate)
        if candidate in waiting:  # those before it were not asked, or not again
            assert waiting[0] == candidate
            waiting.pop(0)
        return candidate if fails(candidate) else None

    result = shrink(given, attempt, rollouts=rollouts, top_speed=26.8, ahead=ahead, expect=expect)
    assert result == (plain, how)
    passes = [each for each in asked if not fails(each)]
    assert len(passes) < 10 or len(set(passes) & set(told)) > len(passes) / 2
