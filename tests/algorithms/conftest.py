"""Shared parts of the search's tests: evaluations by hand, a fast world, and exact bounds of a rate."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from pytest_pafot.algorithms.evaluation import Evaluation
from pytest_pafot.algorithms.space import SearchSpace, sample
from pytest_pafot.model.instructions import Cell, PositionInstruction, repair_gene, toss
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from tests.helpers.traces import ring_distance


def _evaluation(scenario=None, **fields):
    scenario = scenario or Scenario(npcs=((PositionInstruction(4, 10.0),),))
    known = dict.fromkeys(("scenario", "executed"), scenario)
    known |= dict.fromkeys(("genes_started", "genes_reached"), sum(map(len, scenario.npcs)))
    known |= {
        "fitness": 0.0,
        "failing": False,
        "outcome": Outcome.COMPLETED,
        "duration": 60.0,
        "interaction": True,
    }
    return Evaluation(**(known | fields))


@pytest.fixture(scope="session")
def make_evaluation():
    """Return a safe, valid evaluation of fitness 0, except for the given fields."""
    return _evaluation


@pytest.fixture(scope="session")
def make_population():
    """Return evaluations of random scenarios whose seeds are 0, 1, 2, ...; the last is the fittest."""

    def population(size=4, npcs=2, genes=6):
        rng = np.random.default_rng(0)
        space = SearchSpace(npcs=npcs, genes=genes)
        scenarios = [sample(space, rng) for _ in range(size)]
        return tuple(
            _evaluation(Scenario(npcs=scenario.npcs, seed=seed), fitness=float(seed))
            for seed, scenario in enumerate(scenarios)
        )

    return population


def _binomial_tail(successes, trials, rate):
    """Return the smaller one of P(X <= successes) and P(X >= successes)."""

    def log_mass(k):
        ways = math.lgamma(trials + 1) - math.lgamma(k + 1) - math.lgamma(trials - k + 1)
        return ways + k * math.log(rate) + (trials - k) * math.log1p(-rate)

    below = math.fsum(math.exp(log_mass(k)) for k in range(successes + 1))
    above = math.fsum(math.exp(log_mass(k)) for k in range(successes, trials + 1))
    return min(below, above)


@pytest.fixture(scope="session")
def assert_rate():
    """Refuse a count that has a probability below 1e-4 in the rate's binomial distribution."""

    def check(successes, trials, rate):
        assert _binomial_tail(successes, trials, rate) > 0.5e-4, (
            f"{successes} of {trials} is not a rate of {rate}"
        )

    return check


@dataclass
class CheapWorld:
    """A world whose runs take a few microseconds and obey the contract of a real one.

    The left lane is missing, so repair happens inside the run. The run ends with a collision in the first gene in which
    an NPC drives faster than ``crash_speed`` in cell 2. Everything in the evaluation depends only on the driven genes.
    """

    crash_speed: float = 22.0
    genes: int = 6

    def __post_init__(self):
        self.simulated = []

    def __call__(self, scenario):
        self.simulated.append(scenario)
        driven, crashed = self._drive(scenario)
        depth = len(driven[0])
        executed = Scenario.repaired(
            [own + chain[depth:] for own, chain in zip(driven, scenario.npcs, strict=True)],
            seed=scenario.seed,
        )
        risk = sum(
            1 / (1 + ring_distance(gene.cell, Cell.FRONT)) + gene.speed / 100
            for own in driven
            for gene in own
        )
        return _evaluation(
            scenario,
            executed=executed,
            fitness=risk / depth,
            failing=crashed,
            outcome=Outcome.COLLISION if crashed else Outcome.COMPLETED,
            duration=depth * 10.0,
            genes_started=depth * len(driven),
            genes_reached=depth,
        )

    def _drive(self, scenario):
        existing = [cell for cell in Cell if cell.column >= 0]
        driven = tuple(() for _ in scenario.npcs)
        for gene in range(min(self.genes, scenario.genes)):
            cells = repair_gene(
                [own[-1].cell for own in driven] if gene else None,
                [chain[gene].cell for chain in scenario.npcs],
                existing,
                [toss(scenario.seed, npc, gene) for npc in range(len(driven))],
            )
            driven = tuple(
                (*own, PositionInstruction(cell, chain[gene].speed))
                for own, cell, chain in zip(driven, cells, scenario.npcs, strict=True)
            )
            if any(
                own[-1].cell is Cell.FRONT and own[-1].speed > self.crash_speed for own in driven
            ):
                return driven, True
        return driven, False


@pytest.fixture(scope="session")
def cheap_world():
    """Return the class, so that each example makes its own world."""
    return CheapWorld
