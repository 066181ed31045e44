"""The operators of the genetic algorithm: crossover, mutation, tournament and elitism.

Source: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024. The algorithms decide how often to apply them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from numpy.random import Generator

from pytest_pafot.algorithms.crossing_traffic import CrossingTraffic
from pytest_pafot.algorithms.evaluation import Evaluation, Population
from pytest_pafot.algorithms.space import (
    SearchSpace,
    followed_by_pattern,
    fresh_seed,
    repaired,
    sample,
)
from pytest_pafot.model.instructions import Instruction, is_adjacent, pick
from pytest_pafot.model.scenario import Chromosome, Scenario, retimed
from pytest_pafot.model.vehicle_type import VehicleType

STARTS = 0.1  # fraction of the mutations that sample a new start, if the space has several
PATTERNS = 0.35  # fraction of the mutations that insert a pattern, if the space has any
# Fraction of the new starts that change the initial speed. The others change the ego's lane.
SPEEDS = 0.7
# fraction of the mutations that change the vehicle of an NPC, if the space has several vehicles
VEHICLES = 0.05
# Fraction of the mutations that change the number of NPCs or the duration of genes, if the space varies them.
SIZES = 0.1


def crossover(a: Scenario, b: Scenario, rng: Generator) -> tuple[Scenario, Scenario]:
    """Swap two complete NPCs, one chosen at random from each scenario (section 3.4.1)."""
    # NPCs may then conflict in a zone. `mutate` and `breed` resolve the conflicts, because they know the paths.
    in_a = int(rng.integers(len(a.npcs)))
    in_b = int(rng.integers(len(b.npcs)))
    # If both NPCs cross in the same zone, each of their slots, speeds and acts is swapped at random instead.
    vehicle_a = a.vehicle_of(in_a)
    vehicle_b = b.vehicle_of(in_b)
    children = a.npcs[in_a][0].mixed(b.npcs[in_b][0], rng)
    if children is not None:
        one, other = children
        first = _with_npc(a, in_a, (one,), vehicle_a, rng)
        return first, _with_npc(b, in_b, (other,), vehicle_b, rng)
    first = _with_npc(a, in_a, _fit_genes(b, in_b, a), vehicle_b, rng)
    return first, _with_npc(b, in_b, _fit_genes(a, in_a, b), vehicle_a, rng)


def _with_npc(
    scenario: Scenario,
    npc: int,
    chain: Chromosome,
    vehicle: VehicleType,
    rng: Generator,
) -> Scenario:
    vehicles = list(scenario.all_vehicles)
    vehicles[npc] = vehicle
    chains = with_chain(scenario.npcs, npc, chain)
    return repaired(chains, fresh_seed(rng), scenario, tuple(vehicles))


def _fit_genes(scenario: Scenario, npc: int, other: Scenario) -> Chromosome:
    chain = scenario.npcs[npc]
    if scenario.gene_seconds == other.gene_seconds:
        return chain
    return retimed(chain, scenario.gene_seconds, other.gene_seconds)[: other.genes]


def mutate(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    """Replace a random instruction with a new one of the same kind (section 3.4.2).

    If the space allows it, some mutations instead change the start, the number of NPCs, the gene duration or a
    vehicle, or insert a pattern.
    """
    return _resolve_conflicts(_mutate(scenario, space, rng), space, rng)


def _resolve_conflicts(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    # If crossing NPCs conflict now, one of them is sampled again.
    crossing = space.crossing_traffic
    if crossing is None:
        return scenario
    kept = crossing.without_conflicts(scenario.npcs, rng)
    npcs = tuple(kept.values())
    if npcs != scenario.npcs:
        vehicles = tuple(map(scenario.vehicle_of, kept))
        scenario = replace(scenario, npcs=npcs, vehicles=vehicles)
    return space.with_fitting_vehicles(scenario)


def _mutate(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    # A mutation that the space does not allow has the probability 0. If it allows none, no random number is used.
    starts = sizes = vehicles = 0.0
    if len(space.ego_lanes) > 1 or space.has_speeds:
        starts = STARTS
    if space.most_npcs or len(space.gene_durations) > 1:
        sizes = SIZES
    if len(space.vehicles) > 1:
        vehicles = VEHICLES
    draw = 1.0
    if starts or sizes or vehicles or space.patterns:
        draw = rng.random()
    if draw < starts:
        return _with_new_start(scenario, space, rng)
    if draw < starts + sizes:
        return _with_new_size(scenario, space, rng)
    if draw < starts + sizes + vehicles:
        npc = int(rng.integers(len(scenario.npcs)))
        others = [vehicle for vehicle in space.vehicles if vehicle != scenario.vehicle_of(npc)]
        return scenario.with_vehicle(npc, pick(others, rng))
    npcs = scenario.npcs
    numbers = [npc for npc, chain in enumerate(npcs) if not chain[0].crosses]
    crossing = space.crossing_traffic
    # All NPCs are mutated equally often, whether they cross or not.
    if crossing is not None and rng.random() * len(npcs) >= len(numbers):
        return _with_new_crossing(scenario, crossing, rng)
    patterns = starts + sizes + vehicles + PATTERNS
    if draw < patterns and space.patterns and scenario.positions:
        return _with_pattern(scenario, space, rng)
    places = [(npc, gene) for npc in numbers for gene in range(len(npcs[npc]))]
    npc, gene = pick(places, rng)
    chain = npcs[npc]
    new = chain[gene]
    # Only the new cell is repaired. Repairing the genes after it would rewrite the rest of the chain, and lose what the
    # parent was selected for.
    while new == chain[gene]:
        new = chain[gene].varied(space.choices, rng)
        if new.on_grid:
            new = _fit_cell(scenario, npc, gene, new, bool(rng.integers(2)))
    changed = (*chain[:gene], new, *chain[gene + 1 :])
    return _child(scenario, npc, changed, rng)


def _with_new_crossing(scenario: Scenario, crossing: CrossingTraffic, rng: Generator) -> Scenario:
    told = [(npc, each) for npc, each in enumerate(scenario.crossings) if each is not None]
    npc, instruction = pick(told, rng)
    others = [each for number, each in told if number != npc]
    new = crossing.first_with_room(others, lambda: crossing.vary(instruction, rng))
    return _child(scenario, npc, (new or crossing.sample(rng),), rng)


def _with_new_start(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    npcs = scenario.npcs
    lanes = [lane for lane in space.ego_lanes if lane != scenario.ego_lane]
    roomy = [lane for lane in lanes if space.most_on(lane) >= len(npcs)]
    if space.has_speeds and (not roomy or rng.random() < SPEEDS):
        return replace(scenario, ego_speed=space.sample_speed(rng))
    lane = pick(roomy or lanes, rng)
    # If no other lane has room for all NPCs and the speed is fixed, the last NPCs are omitted.
    kept = npcs[: space.most_on(lane)]
    vehicles = scenario.vehicles[: len(kept)]
    return replace(scenario, ego_lane=lane, npcs=kept, vehicles=vehicles)


def _with_new_size(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    npcs = scenario.npcs
    most = space.most_on(scenario.ego_lane)
    durations = [seconds for seconds in space.gene_durations if seconds != scenario.gene_seconds]
    if durations and (not space.most_npcs or rng.integers(2)):
        seconds = pick(durations, rng)
        genes = space.genes_of(seconds)
        chains = [retimed(chain, scenario.gene_seconds, seconds)[:genes] for chain in npcs]
        start = replace(scenario, gene_seconds=seconds)
        return repaired(chains, fresh_seed(rng), start)
    if len(npcs) > 1 and (len(npcs) >= most or rng.integers(2)):
        gone = int(rng.integers(len(npcs)))
        return scenario.of_npcs(npc for npc in range(len(npcs)) if npc != gone)
    if len(npcs) >= most:
        return scenario
    alone = space.fixed(
        scenario.ego_lane,
        scenario.ego_speed,
        1,
        scenario.genes,
        scenario.gene_seconds,
    )
    one = sample(alone, rng)
    vehicles = (*scenario.all_vehicles, one.vehicle_of(0))
    return repaired((*npcs, *one.npcs), fresh_seed(rng), scenario, vehicles)


def _with_pattern(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    numbers = [npc for npc, chain in enumerate(scenario.npcs) if chain[0].on_grid]
    npc = pick(numbers, rng)
    chain: Any = scenario.npcs[npc]
    before = chain[: int(rng.integers(len(chain)))]
    new = followed_by_pattern(before, scenario.ego_speed, space.choices, rng)
    changed = (*new, *chain[len(new) :])
    return _child(scenario, npc, changed[: len(chain)], rng)


def _fit_cell(
    scenario: Scenario,
    npc: int,
    gene: int,
    new: Instruction,
    clockwise_first: bool,
) -> Instruction:
    """Return ``new`` with a cell that fits the chain and that no other NPC occupies."""
    chain = scenario.npcs[npc]
    nearby = (gene - 1, gene + 1)
    around = [chain[k].cell for k in nearby if 0 <= k < len(chain)]
    held = set()
    for index, other in enumerate(scenario.npcs):
        if index != npc and gene < len(other) and other[gene].on_grid:
            held.add(other[gene].cell)
    before, *_ = around or [new.cell]
    neighbours = list(before.neighbours)
    if clockwise_first:
        neighbours.reverse()
    # The first cell that fits is used: the new cell, the neighbours of the previous cell in random order (for the first
    # gene, of the next cell), or the replaced cell, which always fits.
    for cell in (new.cell, *neighbours):
        if cell not in held and all(is_adjacent(cell, other) for other in around):
            return new.aimed(cell)
    return new.aimed(chain[gene].cell)


def tournament(population: Sequence[Evaluation], rng: Generator) -> Evaluation:
    """Return the better of two random members, sampled with replacement."""
    # The paper does not specify how parents are selected. A binary tournament is the usual choice.
    indices: list[int] = rng.integers(len(population), size=2).tolist()
    first, second = (population[index] for index in indices)
    if second.rank > first.rank:
        return second
    return first


def parents(population: Sequence[Evaluation], rng: Generator) -> tuple[Evaluation, Evaluation]:
    """Return the winners of two tournaments, which are different members if possible."""
    first = tournament(population, rng)
    others = [member for member in population if member is not first]
    return first, tournament(others or population, rng)


def elites(population: Sequence[Evaluation], share: float) -> Population:
    """Return the eligible members among the best ``share`` of a population, best first (section 3.5)."""
    # 0.1 of 30 is 3. A floating-point error must not turn it into 4.
    count = math.ceil(round(share * len(population), 9))
    ranked = sorted(population, key=lambda evaluation: evaluation.rank, reverse=True)
    return tuple(evaluation for evaluation in ranked[:count] if evaluation.eligible)


def best_of(evaluations: Sequence[Evaluation]) -> Evaluation | None:
    """Return the best evaluation, or None if none is eligible."""
    best = max(evaluations, key=lambda evaluation: evaluation.rank, default=None)
    if best is not None and best.eligible:
        return best
    return None


def improves(candidate: Evaluation | None, best: Evaluation | None) -> bool:
    """Return whether a candidate is eligible and outranks the best run so far, if any."""
    if candidate is None or not candidate.eligible:
        return False
    return best is None or candidate.rank > best.rank


def breed(
    pair: Iterable[Scenario],
    space: SearchSpace,
    crossover_rate: float,
    mutation_rate: float,
    rng: Generator,
) -> tuple[Scenario, Scenario]:
    """Return two children of a pair of scenarios."""
    a, b = pair
    # The pair swaps NPCs with the probability `crossover_rate`. Each child then mutates with `mutation_rate`.
    if rng.random() < crossover_rate:
        a, b = crossover(a, b, rng)
        a = _resolve_conflicts(a, space, rng)
        b = _resolve_conflicts(b, space, rng)
    if rng.random() < mutation_rate:
        a = mutate(a, space, rng)
    if rng.random() < mutation_rate:
        b = mutate(b, space, rng)
    return a, b


def with_chain(chains: Sequence[Chromosome], npc: int, chain: Chromosome) -> tuple[Chromosome, ...]:
    """Return the chains with one NPC's chain replaced."""
    return (*chains[:npc], chain, *chains[npc + 1 :])


def _child(parent: Scenario, npc: int, chain: Chromosome, rng: Generator) -> Scenario:
    # With the parent's seed, the repair would make the same choice for an NPC and a gene in all descendants.
    return repaired(with_chain(parent.npcs, npc, chain), fresh_seed(rng), parent)
