"""A search's view of its events."""

from dataclasses import replace

import pytest

from pytest_pafot.model.scenario import CrossingInstruction, Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.report.views import campaign_view
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import (
    CampaignFinished,
    CampaignStarted,
    Evaluated,
    GenerationFinished,
)
from tests.report.builders import campaign_parts, scenario


def evaluation(fitness=1.0, *, asked=None, driven=None, **more):
    asked = asked or scenario([(1, 20.0), (2, 8.0)])
    driven = driven or asked
    fields = {"failing": False, "outcome": Outcome.SAFE, "duration": 20.0, "genes_reached": 0, "interaction": True}
    fields["genes_started"] = sum(map(len, driven.npcs))
    return Evaluation(scenario=asked, executed=driven, fitness=fitness, **(fields | more))


def generation(number, *population, local=0):
    return GenerationFinished(generation=number, local_generation=local, population=population, elites=0)


def evaluated(each, *, reused=False):
    return Evaluated(generation=0, local_generation=0, index=0, evaluation=each, reused=reused)


def view(*events, **more):
    return campaign_view("n", events, **more)


def test_coverage_is_told_as_in_the_summary():
    asked, driven = scenario([(1, 20.0), (2, 8.0), (3, 4.0)]), scenario([(1, 20.0), (1, 8.0), (2, 4.0)])
    run = evaluation(asked=asked, driven=driven, genes_started=2, arrived=((True, False),))
    told = "reached 1/8 cells, 0/24 ring steps, 1/6 speed bins; requested 3/8, 2/24, 3/6"
    assert view(evaluated(run), speed_limit=26.8).coverage == told


def test_coverage_of_crossing_traffic_names_its_slots():
    asked = Scenario(npcs=[[CrossingInstruction("o1>o3", 0.5, 8.0)]])
    run = evaluation(asked=asked, genes_started=1, arrived=((True,),))
    assert "1/5 slots at zones" in view(evaluated(run)).coverage


def test_reused_evaluations_count_only_as_reused():
    failing = evaluated(evaluation(failing=True))
    shown = view(failing, replace(failing, reused=True))
    assert (shown.simulated, shown.failing, shown.reused) == (1, 1, 1)
    assert shown.outcomes == (("safe", 1),)


def test_counts_come_the_most_frequent_first():
    shown = view(responsibilities={"npc": 2, "ego": 7, "none": 2})
    assert shown.responsibilities == (("ego", 7), ("none", 2), ("npc", 2))


def test_interrupted_search_is_displayed_up_to_its_end():
    shown = view(CampaignStarted(algorithm="pafot", generations=9, seed=4), generation(0, evaluation()))
    assert (shown.algorithm, shown.seed, shown.asked, shown.reason, shown.generations) == ("pafot", 4, 9, "", 1)


def test_warnings_are_those_of_the_searchs_health():
    assert view().warnings[0].startswith("no scenario was simulated")


@pytest.fixture(scope="module")
def real():
    events = campaign_parts()
    return events, campaign_view("n", iter(events))


def test_a_real_search_adds_up(real):
    events, shown = real
    finished = next(event for event in events if isinstance(event, CampaignFinished))
    assert shown.simulated == finished.simulated == sum(count for _, count in shown.outcomes)
    assert shown.generations == finished.generations == shown.asked
