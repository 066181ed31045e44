"""What an ADS decided in earlier runs, for runs that begin alike."""

from __future__ import annotations

from collections import deque
from typing import Any

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace

DECISIONS = 100_000
"""Decisions kept at most: some 300 runs of a minute at five a second, which is about 15 MB."""

_Key = tuple[object, ...]
_Actions = tuple[Any, ...]
_Chains = tuple[tuple[tuple[object, float], ...], ...]


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
        actions = trace.actions
        if not actions or len(actions) > self._room:
            return
        gene_ticks, every = round(trace.scenario.gene_seconds * trace.physics_hz), trace.physics_hz // trace.ads_hz
        asked = driven = _chains(trace.scenario)
        if trace.executed is not trace.scenario:
            driven = _chains(trace.executed)
        keys = []
        for genes in range(1, _genes_begun(trace, gene_ticks) + 1):
            count = min(genes * gene_ticks // every + 1, len(actions))
            for key in _keys_of_run(trace.scenario, _cut(asked, genes), _cut(driven, genes)):
                self._known[key] = (actions, count)
                keys.append(key)
        self._runs.append((actions, keys))
        self._kept += len(actions)
        while self._kept > self._room:
            self._forget_oldest()

    def _forget_oldest(self) -> None:
        actions, keys = self._runs.popleft()
        self._kept -= len(actions)
        for key in keys:
            if key in self._known and self._known[key][0] is actions:  # else a later run has taken its place
                del self._known[key]

    def recall(self, scenario: Scenario) -> _Actions:
        """The first decisions in a run of the scenario, as far as earlier runs tell; often none."""
        chains = _chains(scenario)
        for genes in range(scenario.genes, 0, -1):
            shared = _cut(chains, genes)
            for seed in (None, scenario.seed):
                known = self._known.get(_key(scenario, shared, seed))
                if known is not None:
                    actions, count = known
                    return actions[:count]
        return ()


def _genes_begun(trace: Trace, gene_ticks: int) -> int:
    return min(-(-trace.ticks // max(gene_ticks, 1)), trace.scenario.genes)


def _keys_of_run(scenario: Scenario, asked: _Chains, driven: _Chains) -> list[_Key]:
    """By the chains as driven whatever the seed, and by those asked for with the seed, where these are others."""
    by_seed = _key(scenario, asked, scenario.seed)
    if not scenario.positions:
        return [by_seed]
    by_chains = _key(scenario, driven, None)
    return [by_chains] if asked == driven else [by_chains, by_seed]


def _chains(scenario: Scenario) -> _Chains:
    """The genes as plain values, which are hashed and compared sooner."""
    return tuple([tuple([(gene.target, gene.speed) for gene in chain]) for chain in scenario.npcs])


def _cut(chains: _Chains, genes: int) -> _Chains:
    return tuple([chain[:genes] for chain in chains])


def _key(scenario: Scenario, chains: _Chains, seed: int | None) -> _Key:
    return scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds, seed, chains
