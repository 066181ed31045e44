"""All runs of a search as a table: a row for each scenario that was tried, whether it failed or not."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.campaign.events import Judged, SearchEvent, SearchStarted
from pytest_pafot.campaign.verdict import worst_margins
from pytest_pafot.findings.signature import Signature
from pytest_pafot.searching.events import Evaluated

COLUMNS: Mapping[str, str] = {
    "test": "node id of the search",
    "seed": "of the search",
    "run": "number of the row in its search, from 1",
    "generation": "from 0",
    "local_generation": "of a local search, from 1; 0 outside of one",
    "scenario": "id of the scenario, six hexadecimal digits",
    "reused": "whether an earlier run had shown what the scenario does, so that it was not simulated",
    "ego_lane": "the ego's first lane, from 0 at the left",
    "ego_speed": "its first speed [m/s]",
    "npcs": "how many NPCs",
    "gene_seconds": "how long an instruction lasts [s]",
    "traffic": "style of the traffic",
    "genes": "JSON: for each NPC its instructions, as cell or lane and speed [m/s], or as zone, speed, slot [s], act",
    "outcome": "how the run ended, such as `collision`",
    "verdict": "what the test says of it: passed, failed, npc (an NPC's fault, which blame leaves out), unpreventable, "
    "common (the reference fails, too), invalid, rejected, skipped",
    "failing": "whether it is a failure",
    "fitness": "what the search climbs; higher is worse for the ego",
    "duration": "simulated [s]",
    "collision_time": "[s]",
    "npc": "that was hit, from 0",
    "side": "of the ego that was hit",
    "closing_speed": "at the impact [m/s]",
    "responsibility": "for the collision: ego, npc, both or none",
    "fault": "of the ego, such as `leader-unanswered`",
    "kind": "of the failure; failures of one kind are one finding",
    "least_gap": "between the ego and any NPC, bumper to bumper [m]",
    "least_time_to_contact": "[s]",
    "hardest_braking": "of the ego [m/s^2]",
    "margins": "JSON: the worst margin of each check that the test made, negative where it failed",
}
"""The columns of the table in their order, and what they mean. A cell is empty where there is nothing to tell."""

Row = dict[str, Any]


@dataclass(slots=True)
class RunTable:
    """Makes rows of what a search tells; rows that are taken are gone."""

    test: str = ""
    seed: int = 0
    number: int = 0
    rows: list[Row] = field(default_factory=list)
    _judged: dict[str, Row] = field(default_factory=dict)  # what a run showed, by the id of its scenario

    def see(self, event: SearchEvent) -> None:
        """Take an event of the search."""
        match event:
            case SearchStarted():
                self.test, self.seed = event.node_id, event.seed
            case Judged():
                self._judged[event.run.scenario.id] = _of_run(event)
            case Evaluated():
                self.number += 1
                self.rows.append(self._row(event))

    def taken(self) -> list[Row]:
        """Return the rows since this was last asked."""
        rows, self.rows = self.rows, []
        return rows

    def _row(self, event: Evaluated) -> Row:
        evaluation = event.evaluation
        scenario, hit, kind = evaluation.scenario, evaluation.collision, evaluation.kind
        row = dict.fromkeys(COLUMNS) | {
            "test": self.test,
            "seed": self.seed,
            "run": self.number,
            "generation": event.generation,
            "local_generation": event.local_generation,
            "scenario": scenario.id,
            "reused": event.reused,
            "ego_lane": scenario.ego_lane,
            "ego_speed": scenario.ego_speed,
            "npcs": len(scenario.npcs),
            "gene_seconds": scenario.gene_seconds,
            "traffic": scenario.traffic.style,
            "genes": json.dumps(scenario.plain()[0], separators=(",", ":")),
            "outcome": str(evaluation.outcome),
            "failing": evaluation.failing,
            "fitness": _finite(evaluation.fitness),
            "duration": evaluation.duration,
            "kind": kind.slug if isinstance(kind, Signature) else None,
        }
        if hit is not None:
            row |= {
                "collision_time": hit.time,
                "npc": hit.npc,
                "side": hit.side,
                "closing_speed": hit.closing_speed,
            }
        return row | self._judged.get(scenario.id, {})


def _of_run(event: Judged) -> Row:
    run, verdict = event.run, event.verdict
    blame = None if run.collision is None else rss_rule(run.trace)
    return {
        "verdict": verdict.kind,
        "responsibility": None if blame is None else blame.responsibility,
        "fault": None if blame is None else blame.fault,
        "least_gap": _finite(run.min_distance),
        "least_time_to_contact": _finite(run.min_ttc),
        "hardest_braking": run.hardest_brake,
        "margins": json.dumps({name: _finite(margin) for name, margin in worst_margins(verdict)}),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
