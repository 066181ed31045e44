"""What earlier runs of a campaign already showed, so that no scenario is simulated twice."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from pytest_pafot.scenario import SHIFTS, Gene, PositionInstruction, Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.repair import repaired

_Chains = tuple[tuple[int, ...], ...]
_Key = tuple[object, ...]


class Memory:
    """Evaluations, found again by everything that their runs depended on.

    A run that ended in gene ``d`` depended on the first ``d`` genes of each NPC and on the start alone. Another
    scenario that agrees in these gives the same run, in two cases: it agrees with the chains as driven, which are
    a fixed point of the repair whatever the seed; or with the chains as asked for and with the seed.
    """

    def __init__(self) -> None:
        self._evaluations: dict[_Key, Evaluation] = {}
        self._depths: list[int] = []

    @classmethod
    def of(cls, evaluations: Iterable[Evaluation]) -> Memory:
        """A memory of these evaluations."""
        memory = cls()
        for evaluation in evaluations:
            memory.add(evaluation)
        return memory

    def add(self, evaluation: Evaluation) -> None:
        """Remember a run; of several with the same key the first stays."""
        depth = evaluation.depth
        if depth not in self._depths:
            self._depths = sorted([*self._depths, depth])
        asked, driven = _chains(evaluation.scenario), _chains(evaluation.executed)
        self._evaluations.setdefault(_key(evaluation.scenario, driven, depth, None), evaluation)
        if asked != driven:
            seed = evaluation.scenario.seed
            self._evaluations.setdefault(_key(evaluation.scenario, asked, depth, seed), evaluation)

    def recall(self, scenario: Scenario) -> Evaluation | None:
        """The evaluation that a run of the scenario would have, or None when no earlier run tells.

        Its genes that no run came to are the scenario's own, so that the search can still use them.
        """
        chains = _chains(scenario)
        for depth in self._depths:
            known = self._evaluations.get(_key(scenario, chains, depth, None))
            if known is not None:
                return replace(known, scenario=scenario, executed=scenario)
            known = self._evaluations.get(_key(scenario, chains, depth, scenario.seed))
            if known is not None:
                return replace(known, scenario=scenario, executed=_driven(known, scenario, depth))
        return None


def _driven(known: Evaluation, scenario: Scenario, depth: int) -> Scenario:
    """The chains that a known run drove, and then the scenario's own genes.

    The first of these may need repair, since it follows other cells than those asked for.
    """
    chains = [driven[:depth] + own[depth:] for driven, own in zip(known.executed.npcs, scenario.npcs, strict=True)]
    return repaired(chains, scenario.seed, scenario)


def _chains(scenario: Scenario) -> _Chains:
    """The genes as whole numbers, which hash faster than the values themselves."""
    return tuple(tuple(_code(gene) * 1_000_000 + round(gene.speed * 10) for gene in chain) for chain in scenario.npcs)


def _code(gene: Gene) -> int:
    return gene.cell if isinstance(gene, PositionInstruction) else 9 + SHIFTS.index(gene.lane)


def _key(scenario: Scenario, chains: _Chains, depth: int, seed: int | None) -> _Key:
    start = (scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds)
    return (*start, seed, depth, *(chain[:depth] for chain in chains))
