"""What a search reads from every run, read in the process that has made it, so that this one need not."""

from __future__ import annotations

from collections.abc import Callable

from pytest_pafot.attribution.mistakes import mistake_of
from pytest_pafot.attribution.near_misses import Floors, near_misses
from pytest_pafot.campaign.setup_fault import unit_doubt
from pytest_pafot.searching.evaluation import interaction_of
from pytest_pafot.trace import Outcome, Trace

FITNESS = "fitness"
"""The name of what a search maximises, among the readings of a trace."""


def read_ahead(fitness: Callable[[Trace], float] | None, trace: Trace, floors: Floors) -> None:
    """Read what will be asked for; the trace keeps it. The fitness is None where it stays in the session."""
    trace.reading("interaction", interaction_of)
    unit_doubt(trace)
    mistake_of(trace)
    if fitness is not None:
        trace.reading(FITNESS, fitness)
    if trace.outcome is not Outcome.INVALID:
        near_misses(trace, floors)
