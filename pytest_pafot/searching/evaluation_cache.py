"""Results of earlier runs of a campaign, so that none of the last ten thousand runs is simulated twice."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import replace
from itertools import islice

from pytest_pafot.model.scenario import SHIFTS, CrossingInstruction, Gene, PositionInstruction, Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.space import repaired

Chains = tuple[tuple[float | CrossingInstruction, ...], ...]  # one number per gene, or a whole Crossing-Instruction
_Key = tuple[object, ...]
_Place = tuple[_Key, int | None]  # a key, and the seed if it matters

Remembered = tuple[Evaluation | None, tuple[int, ...]]
"""A run, and the numbers, from 0, of the keys that lead to it; None for the run if no key does."""

EVALUATIONS = 10_000
"""The largest number of remembered runs, in 25 MB with two NPCs and 90 MB with six; a forgotten run is simulated
again."""


class EvaluationCache:
    """A cache of evaluations; the key of an evaluation is everything that its run depended on.

    A run that ended in gene ``d`` depended only on the start and on the first ``d`` genes of each NPC. A different
    scenario gives the same run in two cases. Either its start and these genes equal the start and genes that were
    driven, which repair does not change for any seed. Or they equal those that were requested, and the seed is equal.

    Args:
        evaluations: evaluations that are known from the beginning.
        seeds_matter: True if the seed affects more than the repair, such as what the ADS sees. The seeds must then be
            equal in both cases.
    """

    def __init__(self, evaluations: Iterable[Evaluation] = (), *, seeds_matter: bool = False) -> None:
        self._seeds_matter = seeds_matter
        self._evaluations: dict[_Key, dict[int | None, Evaluation]] = {}  # by key, then by the seed if it matters
        self._depths: list[int] = []
        # each run, the oldest first, with the places that lead only to it
        self._runs: deque[tuple[Remembered, list[_Place]]] = deque()
        for evaluation in evaluations:
            self.add(evaluation)

    def add(self, evaluation: Evaluation) -> None:
        """Remember a run; if several runs have the same key, the first one stays."""
        own = [
            (number, (key, needed))
            for number, (key, needed) in enumerate(self._places(evaluation))
            if needed not in self._evaluations.get(key, {})
        ]
        numbers, places = tuple(number for number, _ in own), [place for _, place in own]
        self._put((evaluation if own else None, numbers), places)

    def restore(self, remembered: Iterable[Remembered]) -> None:
        """Add the runs that :meth:`remembered` of a different cache returned.

        Raises:
            ValueError: for a number of a key that its run does not have.
        """
        for evaluation, numbers in remembered:
            places = [] if evaluation is None else self._places(evaluation)
            if any(not 0 <= number < len(places) for number in numbers):
                raise ValueError(f"expected numbers of {len(places)} keys, received {numbers} of {evaluation!r:.60}")
            self._put((evaluation, numbers), [places[number] for number in numbers])

    def remembered(self, but: int = 0) -> tuple[Remembered, ...]:
        """Return the remembered runs, the oldest first, without the last ``but`` runs."""
        return tuple(run for run, _ in islice(self._runs, len(self._runs) - but))

    def _put(self, run: Remembered, places: list[_Place]) -> None:
        evaluation = run[0]
        if evaluation is not None:
            if evaluation.depth not in self._depths:
                self._depths = sorted([*self._depths, evaluation.depth])
            for key, needed in places:
                self._evaluations.setdefault(key, {})[needed] = evaluation
        self._runs.append((run, places))

    def _places(self, evaluation: Evaluation) -> list[_Place]:
        """Return the keys under which a run is found: its chains as driven, and as requested if they differ."""
        depth = evaluation.depth
        asked = driven = plain_chains(evaluation.scenario)
        if evaluation.executed is not evaluation.scenario:
            driven = plain_chains(evaluation.executed)
        seed = evaluation.scenario.seed if self._seeds_matter else None
        keys = [(driven, seed)] if asked == driven else [(driven, seed), (asked, evaluation.scenario.seed)]
        return [(_key(evaluation.scenario, chains, depth), needed) for chains, needed in keys]

    def forget(self, room: int = EVALUATIONS) -> None:
        """Forget the oldest runs until at most ``room`` runs are left."""
        while len(self._runs) > room:
            for key, needed in self._runs.popleft()[1]:
                del self._evaluations[key][needed]
                if not self._evaluations[key]:
                    del self._evaluations[key]

    def recall(self, scenario: Scenario) -> Evaluation | None:
        """Return the evaluation that a run of the scenario would have, or None if no earlier run shows it.

        Genes that begin after the end of the earlier run are the scenario's own, so that the search can vary them.
        """
        chains = plain_chains(scenario)
        for depth in self._depths:
            runs = self._evaluations.get(_key(scenario, chains, depth))
            if runs is None:
                continue
            if None in runs:
                return replace(runs[None], scenario=scenario, executed=scenario)
            if scenario.seed in runs:
                known = runs[scenario.seed]
                pairs = zip(known.executed.npcs, scenario.npcs, strict=True)
                mixed = [driven[:depth] + own[depth:] for driven, own in pairs]
                # The first of these genes may need repair, because it now follows other cells than those requested.
                return replace(known, scenario=scenario, executed=repaired(mixed, scenario.seed, scenario))
        return None


def plain_chains(scenario: Scenario) -> Chains:
    """Return the chains with a number for each gene, which is fast to hash and compare; speeds are at most 1000 m/s."""
    return tuple([tuple([_code(gene) for gene in chain]) for chain in scenario.npcs])


def _code(gene: Gene) -> float | CrossingInstruction:
    if isinstance(gene, PositionInstruction):
        return 10_000 * gene.cell + gene.speed
    return gene if isinstance(gene, CrossingInstruction) else 10_000 * (9 + SHIFTS.index(gene.lane)) + gene.speed


def _key(scenario: Scenario, chains: Chains, depth: int) -> _Key:
    start = (scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds, scenario.traffic)
    return (*start, depth, *[chain[:depth] for chain in chains])
