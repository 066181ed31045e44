"""Findings of searches without a grid are displayed without cells."""

import pytest

from pytest_pafot.model.scenario import LaneInstruction, Scenario
from pytest_pafot.report.drawing import speed_texts
from pytest_pafot.report.markup import instruction_table
from pytest_pafot.report.page import render_page
from pytest_pafot.report.page_data import Report
from pytest_pafot.report.picture import instruction_at, picture_at
from tests.helpers.browser import Browser, find_chromium
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import view_of


@pytest.fixture
def view():
    chain = (LaneInstruction("left", 25.0), LaneInstruction("keep", 8.0))
    cars = (vehicle(x, speed=20.0, ticks=225) for x in (0.0, 30.0))
    trace = trace_of(*cars, scenario=Scenario(npcs=(chain,)), arrivals=((30, None),))
    return view_of(trace)


def test_an_instruction_has_its_lane_and_no_cell(view):
    first, second = view.instructions
    assert (first.lane, first.cell, first.requested, first.arrived) == ("left", 0, 0, 2.0)
    assert (second.lane, second.started, second.arrived) == ("keep", True, None)


def test_no_line_leads_to_a_cell(view):
    assert instruction_at(view, 0, 1.0)[1] == "approach"
    assert picture_at(view, 1.0).targets == (None,)
    assert speed_texts(view, picture_at(view, 1.0))[-1] == "NPC 0 20.0 m/s"


def test_the_table_says_where_to_in_words(view):
    table = instruction_table(view.instructions)
    assert "<td>lane left</td><td>25.0</td><td>at 2.0 s</td>" in table
    assert "<td>keep lane</td><td>8.0</td><td>not reached</td>" in table


@pytest.mark.processes
@pytest.mark.skipif(find_chromium() is None, reason="no Chromium here: expected chromium or google-chrome on PATH")
def test_page_names_lanes_and_draws_no_cell_lines(view, tmp_path):
    path = tmp_path / "report.html"
    report = Report(title="t", facts=(), command="pytest", findings=(view,), campaigns=())
    path.write_text(render_page(report), encoding="utf-8")
    browser = Browser(find_chromium(), tmp_path / "profile")
    try:
        page = browser.open(f"{path.as_uri()}#finding={view.id}&t=1")
        text = page.evaluate("document.querySelector('article.current').textContent")
        assert "lane left at 25.0 m/s" in text
        assert "NPC 0, 0.0 s: lane left, 25.0 m/s; reached at 2.0 s" in text
        assert "undefined" not in text
        assert page.complaints == []
        page.evaluate(f"location.hash = 'finding={view.id}&t=12'")
        page.until("document.querySelector('article.current').textContent.includes('keep lane at 8.0 m/s')")
    finally:
        browser.close()
