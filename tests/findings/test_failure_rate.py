"""How often a policy fails that draws random numbers."""

from dataclasses import replace

from pytest_pafot.findings.failure_rate import ENOUGH, MAX_SEED, RUNS, with_other_seed
from tests.findings.builders import plain_finding


def test_runs_without_a_failure_are_hardly_luck_if_enough_failed_before():
    assert (1 - ENOUGH / RUNS) ** RUNS < 0.05


def test_other_seeds_change_only_the_seed():
    scenario = plain_finding().scenario
    assert with_other_seed(scenario, 0) == scenario
    for number, seed in ((1, scenario.seed + 1), (MAX_SEED, scenario.seed - 1)):
        assert with_other_seed(scenario, number) == replace(scenario, seed=seed)
