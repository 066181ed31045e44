"""How often a policy fails that draws random numbers, and what a change of that means."""

import itertools
import math
import random

import pytest

from pytest_pafot.findings.failure_rate import (
    FEW_RUNS,
    KNOWN_RUNS,
    MAX_SEED,
    ODDS,
    SURE_ODDS,
    FailureRate,
    with_other_seed,
)
from pytest_pafot.support.proportions import rarer
from tests.findings.builders import plain_finding


def rate(failing, runs):
    return FailureRate(failing=failing, runs=runs)


@pytest.mark.parametrize(
    ("then", "now", "change"),
    [
        ((14, 20), (0, 59), "fixed"),
        ((14, 20), (0, 20), "better"),  # too few runs to show that it fails in less than 5 %
        ((14, 20), (3, 20), "better"),
        ((14, 20), (11, 20), "as before"),
        ((3, 20), (14, 20), "worse"),
        ((3, 60), (0, 59), "as before"),  # which luck explains
        ((3, 60), (0, 110), "fixed"),
        ((0, 60), (0, 59), "as before"),
    ],
)
def test_a_change_is_more_than_luck(then, now, change):
    assert rate(*then).change(rate(*now)) == change


@pytest.mark.parametrize(("failing", "runs"), [(20, 20), (3, 20), (4, 60), (3, 60), (2, 60)])
def test_runs_that_show_a_fix_are_unlikely_without_one(failing, runs):
    clean = rate(failing, runs).clean
    # All failures are among the earlier runs, if all runs fail with the same probability.
    luck = math.comb(runs, failing) / math.comb(runs + clean, failing)
    assert luck <= 0.05
    assert clean == 59 or math.comb(runs, failing) / math.comb(runs + clean - 1, failing) > 0.05
    assert 0.95**clean < 0.05


def test_a_sentence_says_how_sure_a_change_is():
    assert rate(14, 20).compared(rate(0, 59), "seeds") == (
        "fails in none of 59 seeds, 14 of 20 when it was found: here in less than 5.0 % of all, 95 % sure"
    )
    assert rate(14, 20).compared(rate(2, 20), "runs") == (
        "fails in 2 of 20 runs, 14 of 20 when it was found: better, 95 %: 1.2 to 31.7 %, by chance with p = 0.00012"
    )
    assert rate(14, 20).compared(rate(13, 20), "runs").endswith(": as before, 95 %: 40.8 to 84.6 %")


@pytest.mark.parametrize(("most", "odds"), [(FEW_RUNS, ODDS), (KNOWN_RUNS, SURE_ODDS)], ids=["a step", "the result"])
def test_a_simpler_scenario_must_fail_about_as_often(most, odds):
    draw = random.Random(1)

    def kept(then, share):
        outcomes = (draw.random() < share for _ in itertools.count())
        return sum(rate(then, 200).is_as_often(outcomes, most, odds) for _ in range(200)) / 200

    is_result = most == KNOWN_RUNS
    assert kept(140, 0.7) > (0.8 if is_result else 0.5)
    assert kept(140, 0.56) < (0.15 if is_result else 0.3)
    assert kept(100, 0.25) < 0.05
    assert kept(100, 0.8) < 0.2
    assert kept(200, 1.0) == 1.0
    assert kept(200, 0.3) < 0.05


@pytest.mark.parametrize(("failing", "runs"), [(200, 2), (180, 2), (80, 8), (30, 20), (1, 20)])
def test_what_never_fails_is_left_the_sooner_the_more_often_the_finding_fails(failing, runs):
    asked = iter([False] * 30)
    assert not rate(failing, 200).is_as_often(asked)
    assert len(list(asked)) == 30 - runs


def test_other_seeds_change_only_the_seed():
    scenario = plain_finding().scenario
    assert with_other_seed(scenario, 0) == scenario
    assert [with_other_seed(scenario, number).seed for number in (1, MAX_SEED)] == [
        scenario.seed + 1,
        scenario.seed - 1,
    ]
    assert with_other_seed(scenario, 1).npcs == scenario.npcs


@pytest.mark.parametrize(("failing", "runs"), [(0, 0), (3, 2), (-1, 2)])
def test_a_rate_is_a_share_of_its_runs(failing, runs):
    with pytest.raises(ValueError, match="failing"):
        rate(failing, runs)


def test_fishers_test_of_the_lady_tasting_tea():
    assert rarer(1, 4, 3, 4) == pytest.approx(17 / 70)
    assert rarer(0, 4, 4, 4) == pytest.approx(1 / 70)
    assert rarer(4, 4, 4, 4) == 1
