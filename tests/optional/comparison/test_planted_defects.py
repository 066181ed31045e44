"""The benchmark of planted defects: when its searches end, and its statistics of invented searches."""

from functools import partial
from types import SimpleNamespace

import pytest

from tests.benchmarks import planted_defects, policies_with_defects
from tests.benchmarks.planted_defects import Searched, grouped, overall_rows, searched

BROKEN = partial(policies_with_defects.make, "OneNudge")
SOUND = partial(policies_with_defects.make, "OneNudge", repaired=("nudge-unchecked",))


def made_up(arm, seed, runs, *, found=True):
    return Searched("nudges", arm, seed, found, runs, 30.0 * runs, 0.01 * runs, 0)


@pytest.fixture
def plant(monkeypatch):
    def planted(twin):
        monkeypatch.setattr(planted_defects, "PLANTED", {"nudges": SimpleNamespace(make=BROKEN, twin=twin)})

    return planted


def test_search_ends_when_only_defective_policy_fails(plant):
    plant(SOUND)
    first = searched("nudges", "default", 0, 100, 100.0)
    assert (first.found, first.shared) == (True, 0)
    assert first.runs < 100
    assert 0 < first.seconds < first.simulated
    again = searched("nudges", "default", 0, first.runs, 100.0)
    assert (again.found, again.runs, again.simulated) == (True, first.runs, first.simulated)
    less = searched("nudges", "default", 0, first.runs - 1, 100.0)
    assert (less.found, less.runs) == (False, first.runs - 1)


@pytest.mark.oracle
def test_failures_shared_with_the_twin_do_not_count(plant):
    plant(BROKEN)
    search = searched("nudges", "default", 0, 60, 100.0)
    assert (search.found, search.runs) == (False, 60)
    assert search.shared >= 1


@pytest.mark.oracle
def test_ratios_use_only_seeds_of_both_searches(monkeypatch):
    few = partial(planted_defects.ratio_interval, draws=100)  # all are the same here
    monkeypatch.setattr(planted_defects, "ratio_interval", few)
    searches = [made_up("default", seed, runs) for seed, runs in enumerate([10, 20, 30])]
    searches += [made_up("random", seed, 2 * runs) for seed, runs in enumerate([10, 20, 30, 500])]
    first, second, *_ = overall_rows("tuning", grouped(searches, ["nudges"], ["default", "random"]))
    assert first.startswith("| tuning | default | 3 of 3 | 0.00 | runs | 20 (10 to -) | 20 (to 1000) |")
    assert second.endswith("| 2 (2 to 2) | 2 (2 to 2) |")
