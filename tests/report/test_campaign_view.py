"""A search's view of its events."""

from dataclasses import replace

import pytest

from pytest_pafot.model.scenario import LaneInstruction, Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.report.page import campaign_article
from pytest_pafot.report.page_data import CoverageRow
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


def row_of(rows, label):
    return next(row for row in rows if row.label == label)


def test_coverage_tells_requested_from_driven_from_reached():
    asked, driven = scenario([(1, 20.0), (2, 8.0), (3, 4.0)]), scenario([(1, 20.0), (1, 8.0), (2, 4.0)])
    run = evaluation(asked=asked, driven=driven, genes_started=2, arrived=((True, False),))
    shown = view(evaluated(run))
    one, two, three = shown.cells[:3]
    assert (one.requested, one.driven, one.reached) == (1, 2, 1)
    assert (two.requested, two.driven, two.reached) == (1, 0, 0)
    assert (three.requested, three.driven) == (1, 0)
    held, stepped = row_of(shown.steps, "1 to 1"), row_of(shown.steps, "1 to 2")
    assert (held.requested, held.driven, held.reached) == (0, 1, 0)
    assert (stepped.requested, stepped.driven) == (1, 0)


def test_speeds_are_counted_in_bins_up_to_limit():
    asked = scenario([(1, 0.0), (1, 4.9), (1, 5.0), (1, 26.8)])
    shown = view(evaluated(evaluation(asked=asked)), speed_limit=26.8)
    assert [row.label for row in shown.speeds][-1] == "25 to 26.8 m/s"
    assert [row.requested for row in shown.speeds] == [2, 1, 0, 0, 0, 1]


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
    assert len(shown.cells) == 8
    assert len({row.label for row in shown.steps}) == 24
    cells, speeds = (sum(row.driven for row in rows) for rows in (shown.cells, shown.speeds))
    assert cells == speeds > 0
    assert all(row.reached <= row.driven <= row.requested for row in shown.speeds)


def test_page_of_search_in_lanes_counts_lanes_without_cells():
    asked, driven = (
        Scenario(npcs=[[LaneInstruction(lane, 8.0), LaneInstruction("keep", 8.0)]]) for lane in ("left", "keep")
    )
    view = campaign_view("a.py::test", [evaluated(evaluation(asked=asked, driven=driven, arrived=((False, True),)))])
    assert [(row.label, row.requested, row.driven, row.reached) for row in view.lanes] == [
        ("keep", 1, 2, 1),
        ("left", 1, 0, 0),
        ("right", 0, 0, 0),
    ]
    page = campaign_article(view, 0)
    assert "<h4>Lanes</h4>" in page
    assert '<th scope="row">left</th><td>1</td><td>0</td><td>0</td>' in page
    assert "<h4>Cells</h4>" not in page
    assert "arrived in its cell or its lane." in page
    assert campaign_view("a.py::test", ()).lanes == ()


def test_page_of_crossing_search_has_slots_without_cells():
    row = CoverageRow("o1>o3 just after", 3, 2, 1)
    view = campaign_view("a.py::test", ())
    crossed = replace(view, zones=(row,))
    assert "<h4>Cells</h4>" in campaign_article(view, 0)
    page = campaign_article(crossed, 0)
    assert "<h4>Cells</h4>" not in page
    assert "Steps on the ring" not in page
    assert "arrived in its cell or its zone." in page
    assert '<th scope="row">o1&gt;o3</th><td>2 / 3, 1</td>' in page
    both = replace(crossed, cells=(replace(view.cells[0], requested=1), *view.cells[1:]))
    assert "<h4>Cells</h4>" in campaign_article(both, 0)
