"""The table of a search's runs, with a row for each scenario."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pytest_pafot.algorithms.evaluation import Evaluated
from pytest_pafot.findings.verdict import Signature, Verdict
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.events import SearchEvent, SearchStarted

COLUMNS: Mapping[str, str] = {
    "test": "node id of the search",
    "seed": "seed of the search",
    "run": "number of the row, counted from 1",
    "generation": "number of the generation, counted from 0",
    "local_generation": "number of the local generation, counted from 1; 0 outside a local search",
    "scenario": "id of the scenario, six hexadecimal digits",
    "scenario_seed": "seed of the scenario",
    "reused": "True if an earlier run provided the result",
    "ego_lane": "the ego's initial lane",
    "ego_speed": "the ego's initial speed [m/s]",
    "npcs": "number of NPCs",
    "gene_seconds": "duration of an instruction [s]",
    "traffic": "style of the traffic; `paper` in a world without styles",
    "vehicles": "JSON: vehicles of the NPCs, up to the last one that is not a car",
    "genes": "JSON: each NPC's instructions, in SI units: cell or lane and speed, or zone, speed, slot and act",
    "outcome": "how the run ended, such as `collision`",
    "verdict": "passed, failed, npc (an NPC's fault, which blame excludes), common (the reference fails, too), "
    "invalid, rejected or skipped",
    "failing": "True if the run counts as a failure",
    "fitness": "fitness of the run; higher is worse for the ego",
    "duration": "simulated time [s]",
    "collision_time": "time of the collision [s]",
    "npc": "number of the NPC in the collision, counted from 0",
    "side": "side on which the ego was hit",
    "closing_speed": "closing speed at impact [m/s]",
    "responsibility": "who is responsible: ego, npc, both or none",
    "fault": "fault of the ego, such as `leader-unanswered`",
    "kind": "short name of the failure; different failures can have the same name",
    "least_gap": "smallest gap between the boxes of ego and NPC [m]",
    "least_time_to_contact": "smallest time to contact with an NPC [s]",
    "hardest_braking": "hardest braking of the ego [m/s^2]",
    "margins": "JSON: the worst margin of each check, negative if it failed",
}
"""The columns of the table in order, with their meanings. A cell without a value is empty."""

Row = dict[str, Any]


@dataclass(slots=True)
class RunTable:
    """A table that collects its rows from the events of a search."""

    test: str = ""
    seed: int = 0
    rows: list[Row] = field(default_factory=list)

    def see(self, event: SearchEvent) -> None:
        match event:
            case SearchStarted():
                self.test, self.seed = event.node_id, event.seed
            case Evaluated():
                of_search = {"test": self.test, "seed": self.seed, "run": len(self.rows) + 1}
                self.rows.append(row_of(event) | (event.evaluation.note or {}) | of_search)


def row_of(event: Evaluated) -> Row:
    """Return a row with the columns that can be filled from an evaluation."""
    evaluation, reused = event.evaluation, event.reused
    scenario, hit, kind = evaluation.scenario, evaluation.collision, evaluation.kind
    row = dict.fromkeys(COLUMNS) | {
        "generation": event.generation,
        "local_generation": event.local_generation,
        "scenario": scenario.id,
        "scenario_seed": scenario.seed,
        "reused": reused,
        "ego_lane": scenario.ego_lane,
        "ego_speed": scenario.ego_speed,
        "npcs": len(scenario.npcs),
        "gene_seconds": scenario.gene_seconds,
        "traffic": scenario.traffic,
        "vehicles": json.dumps([each.plain() for each in scenario.vehicles], separators=(",", ":")),
        "genes": scenario.chains_text,
        "outcome": str(evaluation.outcome),
        "failing": evaluation.failing,
        # also if the process died
        "verdict": "failed" if evaluation.failing and not reused else None,
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
    return row


def note_of(run: Run, verdict: Verdict) -> Row:
    """Return the columns that can be filled only from the run and its verdict."""
    blame = None if run.collision is None else run.attribution
    return {
        "verdict": verdict.kind,
        "responsibility": None if blame is None else blame.responsibility,
        "fault": None if blame is None else blame.fault,
        "least_gap": _finite(run.min_distance),
        "least_time_to_contact": _finite(run.min_ttc),
        "hardest_braking": run.hardest_brake,
        "margins": json.dumps({name: _finite(margin) for name, margin in verdict.margins}),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
