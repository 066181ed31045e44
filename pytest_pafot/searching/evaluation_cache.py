"""What earlier runs of a campaign already showed, so that no scenario is simulated twice."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from pytest_pafot.scenario import SHIFTS, Gene, PositionInstruction, Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.space import repaired

_Chains = tuple[tuple[float, ...], ...]
_Key = tuple[object, ...]


class EvaluationCache:
    """Evaluations, found again by everything that their runs depended on.

    A run that ended in gene ``d`` depended on the first ``d`` genes of each NPC and on the start alone. Another
    scenario that agrees in these gives the same run, in two cases: it agrees with the chains as driven, which are
    a fixed point of the repair whatever the seed; or with the chains as asked for and with the seed.
    """

    def __init__(self) -> None:
        self._evaluations: dict[_Key, dict[int | None, Evaluation]] = {}
        self._depths: list[int] = []

    @classmethod
    def of(cls, evaluations: Iterable[Evaluation]) -> EvaluationCache:
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
        asked = driven = _chains(evaluation.scenario)
        if evaluation.executed is not evaluation.scenario:
            driven = _chains(evaluation.executed)
        # Where NPCs with Lane-Instructions start is repaired by the seed, which no chain as driven tells.
        seed = None if evaluation.scenario.positions else evaluation.scenario.seed
        self._runs(_key(evaluation.scenario, driven, depth)).setdefault(seed, evaluation)
        if asked != driven:
            self._runs(_key(evaluation.scenario, asked, depth)).setdefault(evaluation.scenario.seed, evaluation)

    def _runs(self, key: _Key) -> dict[int | None, Evaluation]:
        """Those with a key, by the seed that they depend on, if they do."""
        return self._evaluations.setdefault(key, {})

    def recall(self, scenario: Scenario) -> Evaluation | None:
        """The evaluation that a run of the scenario would have, or None when no earlier run tells.

        Its genes that no run came to are the scenario's own, so that the search can still use them.
        """
        chains = _chains(scenario)
        for depth in self._depths:
            runs = self._evaluations.get(_key(scenario, chains, depth))
            if runs is None:
                continue
            if None in runs:
                return replace(runs[None], scenario=scenario, executed=scenario)
            if scenario.seed in runs:
                known = runs[scenario.seed]
                return replace(known, scenario=scenario, executed=_driven(known, scenario, depth))
        return None


def _driven(known: Evaluation, scenario: Scenario, depth: int) -> Scenario:
    """The chains that a known run drove, and then the scenario's own genes.

    The first of these may need repair, since it follows other cells than those asked for.
    """
    chains = [driven[:depth] + own[depth:] for driven, own in zip(known.executed.npcs, scenario.npcs, strict=True)]
    return repaired(chains, scenario.seed, scenario)


def _chains(scenario: Scenario) -> _Chains:
    """One number for each gene, which is hashed and compared sooner than the gene; speeds are at most 1000 m/s."""
    return tuple([tuple([10_000 * _code(gene) + gene.speed for gene in chain]) for chain in scenario.npcs])


def _code(gene: Gene) -> int:
    return gene.cell if isinstance(gene, PositionInstruction) else 9 + SHIFTS.index(gene.lane)


def _key(scenario: Scenario, chains: _Chains, depth: int) -> _Key:
    start = (scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds)
    return (*start, depth, *[chain[:depth] for chain in chains])
