"""What an ADS decided in earlier runs, for runs that begin alike."""

from __future__ import annotations

from collections import deque
from typing import Any

from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.evaluation_cache import Chains, plain_chains
from pytest_pafot.trace import Trace

DECISIONS = 100_000
"""Decisions kept at most: some 300 runs of a minute at five a second, which is about 15 MB."""

_Key = tuple[object, ...]
_Actions = tuple[Any, ...]


class DecisionCache:
    """Decisions of the last runs of one ADS in one world, found again by what they depended on.

    Up to the end of its gene ``g`` a run depends on the first ``g`` genes of each NPC and on the start alone; the
    decision at that very tick, before the next gene begins, is the last one that does. For what two scenarios must
    have in common see :class:`~pytest_pafot.searching.evaluation_cache.EvaluationCache`: the chains as driven, or as
    asked for with the seed. Where NPCs with Lane-Instructions start may be drawn by the seed, which is then always part
    of it.

    Only an ADS that decides from its observation alone decides the same there.

    Args:
        decisions: kept at most; the oldest runs are forgotten first.
    """

    def __init__(self, decisions: int = DECISIONS) -> None:
        self._room = decisions
        self._kept = 0
        self._known: dict[_Key, tuple[_Actions, int]] = {}
        self._runs: deque[tuple[_Actions, list[_Key]]] = deque()

    def remember(self, trace: Trace) -> None:
        """Keep the decisions of a run, in the place of older ones that were the same."""
        actions, scenario = trace.actions, trace.scenario
        if not actions or len(actions) > self._room:
            return
        gene_ticks, every = round(scenario.gene_seconds * trace.physics_hz), trace.physics_hz // trace.ads_hz
        asked, driven = plain_chains(scenario), plain_chains(trace.executed)
        keys = []
        for genes in range(1, min(-(-trace.ticks // max(gene_ticks, 1)), scenario.genes) + 1):
            count = min(genes * gene_ticks // every + 1, len(actions))
            by_chains, by_seed = _key(scenario, driven, genes, None), _key(scenario, asked, genes, scenario.seed)
            by_both = [by_chains] if by_chains[-1] == by_seed[-1] else [by_chains, by_seed]
            for key in by_both if scenario.positions else [by_seed]:
                self._known[key] = (actions, count)
                keys.append(key)
        self._runs.append((actions, keys))
        self._kept += len(actions)
        while self._kept > self._room:
            oldest, keys = self._runs.popleft()
            self._kept -= len(oldest)
            for key in keys:
                if key in self._known and self._known[key][0] is oldest:  # else a later run has taken its place
                    del self._known[key]

    def recall(self, scenario: Scenario) -> _Actions:
        """The first decisions in a run of the scenario, as far as earlier runs tell; often none."""
        chains = plain_chains(scenario)
        for genes in range(scenario.genes, 0, -1):
            for seed in (None, scenario.seed):
                known = self._known.get(_key(scenario, chains, genes, seed))
                if known is not None:
                    actions, count = known
                    return actions[:count]
        return ()


def _key(scenario: Scenario, chains: Chains, genes: int, seed: int | None) -> _Key:
    shared = tuple([chain[:genes] for chain in chains])
    return scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds, seed, shared
