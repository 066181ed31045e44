"""The operators of the genetic algorithm: crossover, mutation, tournament and elitism.

Source: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024. The algorithms decide how often to apply them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from numpy.random import Generator

from pytest_pafot.algorithms.crossing_traffic import CrossingTraffic
from pytest_pafot.algorithms.evaluation import Evaluation
from pytest_pafot.algorithms.space import (
    SearchSpace,
    followed_by_pattern,
    fresh_seed,
    repaired,
    sample,
)
from pytest_pafot.model.instructions import Instruction, is_adjacent
from pytest_pafot.model.scenario import Chromosome, Scenario, retimed
from pytest_pafot.model.vehicle_type import CAR, VehicleType

# Fractions of the mutations that sample a new start, if the space has several, and that insert a pattern, if it has
# any.
STARTS, PATTERNS = 0.1, 0.35
# Fraction of the new starts that change the initial speed. The others change the ego's lane.
SPEEDS = 0.7
# fraction of the mutations that change the vehicle of an NPC, if the space has several vehicles
VEHICLES = 0.05
# Fraction of the mutations that change the number of NPCs or the duration of genes, if the space varies them.
SIZES = 0.1


def crossover(a: Scenario, b: Scenario, rng: Generator) -> tuple[Scenario, Scenario]:
    """Swap two complete NPCs, one chosen at random from each scenario (section 3.4.1)."""
    # NPCs may then conflict in a zone. `mutate` and `breed` resolve the conflicts, because they know the paths.
    first, second = _swap(a, b, rng)
    return _with_npc(a, *first, rng), _with_npc(b, *second, rng)


# the index of an NPC, and the chain and the vehicle that it receives
Swapped = tuple[int, Chromosome, VehicleType]


def _with_npc(
    scenario: Scenario, npc: int, chain: Chromosome, vehicle: VehicleType, rng: Generator
) -> Scenario:
    vehicles = scenario.vehicles
    if vehicle is not CAR or vehicles:
        vehicles = (*scenario.all_vehicles[:npc], vehicle, *scenario.all_vehicles[npc + 1 :])
    return repaired(with_chain(scenario.npcs, npc, chain), fresh_seed(rng), scenario, vehicles)


def _swap(a: Scenario, b: Scenario, rng: Generator) -> tuple[Swapped, Swapped]:
    """Return the index of a random NPC in each scenario, with the NPC's new chain and vehicle."""
    in_a, in_b = int(rng.integers(len(a.npcs))), int(rng.integers(len(b.npcs)))
    one, other = a.npcs[in_a][0], b.npcs[in_b][0]
    kind, its_kind = a.vehicle_of(in_a), b.vehicle_of(in_b)
    # If both NPCs cross in the same zone, each of their slots, speeds and acts is swapped at random instead.
    if (children := one.mixed(other, rng)) is not None:
        first, second = children
        return (in_a, (first,), kind), (in_b, (second,), its_kind)
    return (in_a, _fit_genes(b, in_b, a), its_kind), (in_b, _fit_genes(a, in_a, b), kind)


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
    # If crossing NPCs conflict now, one of them is sampled again.
    child, crossing = _mutate(scenario, space, rng), space.crossing_traffic
    return (
        child
        if crossing is None
        else space.with_fitting_vehicles(_resolve_conflicts(child, crossing, rng))
    )


def _resolve_conflicts(scenario: Scenario, crossing: CrossingTraffic, rng: Generator) -> Scenario:
    kept = crossing.numbered_without_conflicts(scenario.npcs, rng)
    npcs = tuple(chain for _, chain in kept)
    if npcs == scenario.npcs:
        return scenario
    return replace(scenario, npcs=npcs, vehicles=tuple(scenario.vehicle_of(npc) for npc, _ in kept))


def _mutate(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    # A mutation that the space does not allow has the probability 0. If it allows none, no random number is used.
    starts = STARTS if len(space.ego_lanes) > 1 or space.has_speeds else 0.0
    sizes = SIZES if space.most_npcs or len(space.gene_durations) > 1 else 0.0
    vehicles = VEHICLES if len(space.vehicles) > 1 else 0.0
    draw = rng.random() if starts or sizes or vehicles or space.patterns else 1.0
    if draw < starts:
        return _with_new_start(scenario, space, rng)
    if draw < starts + sizes:
        return _with_new_size(scenario, space, rng)
    if draw < starts + sizes + vehicles:
        npc = int(rng.integers(len(scenario.npcs)))
        others = [vehicle for vehicle in space.vehicles if vehicle != scenario.vehicle_of(npc)]
        return scenario.with_vehicle(npc, others[int(rng.integers(len(others)))])
    numbers = [npc for npc, chain in enumerate(scenario.npcs) if not chain[0].crosses]
    crossing = space.crossing_traffic
    # All NPCs are mutated equally often, whether they cross or not.
    if crossing is not None and rng.random() * len(scenario.npcs) >= len(numbers):
        return _with_new_crossing(scenario, crossing, rng)
    if draw < starts + sizes + vehicles + PATTERNS and space.patterns and scenario.positions:
        return _with_pattern(scenario, space, rng)
    places = [(npc, gene) for npc in numbers for gene in range(len(scenario.npcs[npc]))]
    npc, gene = places[int(rng.integers(len(places)))]
    chain, choices = scenario.npcs[npc], space.choices
    new = chain[gene]
    # Only the new cell is repaired. Repairing the genes after it would rewrite the rest of the chain, and lose what the
    # parent was selected for.
    while new == chain[gene]:
        new = chain[gene].varied(choices, rng)
        if new.on_grid:
            on_grid = _on_grid(scenario).index(npc)
            new = _fit_cell(scenario.positions, on_grid, gene, new, bool(rng.integers(2)))
    return _child(
        scenario, with_chain(scenario.npcs, npc, (*chain[:gene], new, *chain[gene + 1 :])), rng
    )


def _with_new_crossing(scenario: Scenario, crossing: CrossingTraffic, rng: Generator) -> Scenario:
    told = [(npc, each) for npc, each in enumerate(scenario.crossings) if each is not None]
    npc, instruction = told[int(rng.integers(len(told)))]
    others = [each for number, each in told if number != npc]
    new = crossing.first_with_room(
        others, lambda: crossing.vary(instruction, rng)
    ) or crossing.sample(rng)
    return _child(scenario, with_chain(scenario.npcs, npc, (new,)), rng)


def _with_new_start(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    npcs = scenario.npcs
    lanes = [lane for lane in space.ego_lanes if lane != scenario.ego_lane]
    roomy = [lane for lane in lanes if space.most_on(lane) >= len(npcs)]
    if space.has_speeds and (not roomy or rng.random() < SPEEDS):
        return replace(scenario, ego_speed=space.sample_speed(rng))
    among = roomy or lanes
    lane = among[int(rng.integers(len(among)))]
    # If no other lane has room for all NPCs and the speed is fixed, the last NPCs are omitted.
    kept = npcs[: space.most_on(lane)]
    return replace(scenario, ego_lane=lane, npcs=kept, vehicles=scenario.vehicles[: len(kept)])


def _with_new_size(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    npcs, most = scenario.npcs, space.most_on(scenario.ego_lane)
    durations = [seconds for seconds in space.gene_durations if seconds != scenario.gene_seconds]
    if durations and (not space.most_npcs or rng.integers(2)):
        seconds = durations[int(rng.integers(len(durations)))]
        genes = space.genes_of(seconds)
        chains = [retimed(chain, scenario.gene_seconds, seconds)[:genes] for chain in npcs]
        return repaired(chains, fresh_seed(rng), replace(scenario, gene_seconds=seconds))
    if len(npcs) > 1 and (len(npcs) >= most or rng.integers(2)):
        gone = int(rng.integers(len(npcs)))
        return scenario.of_npcs(npc for npc in range(len(npcs)) if npc != gone)
    if len(npcs) >= most:
        return scenario
    alone = space.fixed(
        scenario.ego_lane, scenario.ego_speed, 1, scenario.genes, scenario.gene_seconds
    )
    one = sample(alone, rng)
    vehicles = (*scenario.all_vehicles, one.vehicle_of(0))
    return repaired((*npcs, *one.npcs), fresh_seed(rng), scenario, vehicles)


def _with_pattern(scenario: Scenario, space: SearchSpace, rng: Generator) -> Scenario:
    chains = scenario.positions
    own = int(rng.integers(len(chains)))
    chain = chains[own]
    before = chain[: int(rng.integers(len(chain)))]
    new = followed_by_pattern(before, scenario.ego_speed, (space.low_step, space.top_step), rng)
    chain = (*new, *chain[len(new) :])[: len(chain)]
    return _child(scenario, with_chain(scenario.npcs, _on_grid(scenario)[own], chain), rng)


def _on_grid(scenario: Scenario) -> list[int]:
    return [npc for npc, chain in enumerate(scenario.npcs) if chain[0].on_grid]


def _fit_cell(
    chains: Sequence[Chromosome],
    npc: int,
    gene: int,
    new: Instruction,
    clockwise_first: bool,
) -> Instruction:
    """Return ``new`` with a cell that fits the chain and that no other NPC occupies."""
    chain = chains[npc]
    around = [chain[k].cell for k in (gene - 1, gene + 1) if 0 <= k < len(chain)]
    held = {
        other[gene].cell for index, other in enumerate(chains) if index != npc and gene < len(other)
    }
    anticlockwise, clockwise = around[0].neighbours if around else new.cell.neighbours
    neighbours = (clockwise, anticlockwise) if clockwise_first else (anticlockwise, clockwise)
    # The first cell that fits is used: the new cell, the neighbours of the previous cell in random order (for the first
    # gene, of the next cell), or the replaced cell, which always fits.
    candidates = (new.cell, *neighbours, chain[gene].cell)
    cell = next(
        c for c in candidates if c not in held and all(is_adjacent(c, other) for other in around)
    )
    return new.aimed(cell)


def tournament(population: Sequence[Evaluation], rng: Generator) -> Evaluation:
    """Return the better of two random members, sampled with replacement."""
    # The paper does not specify how parents are selected. A binary tournament is the usual choice.
    first, second = (population[int(index)] for index in rng.integers(len(population), size=2))
    return second if second.rank > first.rank else first


def parents(population: Sequence[Evaluation], rng: Generator) -> tuple[Evaluation, Evaluation]:
    """Return the winners of two tournaments, which are different members if possible."""
    first = tournament(population, rng)
    others = [member for member in population if member is not first]
    return first, tournament(others or population, rng)


def elites(population: Sequence[Evaluation], share: float) -> tuple[Evaluation, ...]:
    """Return the eligible members among the best ``share`` of a population, best first (section 3.5)."""
    # 0.1 of 30 is 3. A floating-point error must not turn it into 4.
    count = math.ceil(round(share * len(population), 9))
    ranked = sorted(population, key=lambda evaluation: evaluation.rank, reverse=True)
    return tuple(evaluation for evaluation in ranked[:count] if evaluation.eligible)


def best_of(evaluations: Sequence[Evaluation]) -> Evaluation | None:
    """Return the best evaluation, or None if none is eligible."""
    best = max(evaluations, key=lambda evaluation: evaluation.rank, default=None)
    return best if best is not None and best.eligible else None


def improves(candidate: Evaluation | None, best: Evaluation | None) -> bool:
    """Return whether a candidate is eligible and outranks the best run so far, if any."""
    return (
        candidate is not None
        and candidate.eligible
        and (best is None or candidate.rank > best.rank)
    )


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
        if (crossing := space.crossing_traffic) is not None:
            a, b = (
                space.with_fitting_vehicles(_resolve_conflicts(child, crossing, rng))
                for child in (a, b)
            )
    first, second = (
        mutate(child, space, rng) if rng.random() < mutation_rate else child for child in (a, b)
    )
    return first, second


def with_chain(chains: Sequence[Chromosome], npc: int, chain: Chromosome) -> tuple[Chromosome, ...]:
    """Return the chains with one NPC's chain replaced."""
    return (*chains[:npc], chain, *chains[npc + 1 :])


def _child(parent: Scenario, chains: tuple[Chromosome, ...], rng: Generator) -> Scenario:
    # With the parent's seed, the repair would make the same choice for an NPC and a gene in all descendants.
    return repaired(chains, fresh_seed(rng), parent)
