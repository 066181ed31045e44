"""How often a policy that draws random numbers fails in one scenario."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pytest_pafot.model.scenario import MAX_SEED, Scenario

RUNS = 10
"""The number of runs, each with another seed, in which it is counted how often a policy fails."""

ENOUGH = 3
"""The number of failures from which on ten runs without a failure are a fix: with a share of 0.3, the chance that none
of them fails is 0.7 ** 10, less than 3 %."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureRate:
    """The number of runs of one scenario, and how many of them fail."""

    failing: int
    runs: int = RUNS

    def __str__(self) -> str:
        return f"{self.failing or 'none'} of {self.runs}"


def with_other_seed(scenario: Scenario, number: int) -> Scenario:
    """Return a scenario in which a policy draws other numbers; ``number`` is 0 for the scenario itself."""
    return replace(scenario, seed=(scenario.seed + number) % (MAX_SEED + 1))
