"""Pictures of runs with crossing NPCs have ways and zones, and words for places without a cell."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.model.instructions import CrossingInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.report.page import render_page
from pytest_pafot.report.page_data import Report
from pytest_pafot.report.views import run_view
from tests.helpers.browser import Browser, find_chromium
from tests.helpers.crossing_traces import CROSSES, MERGES, ZONES, junction_trace
from tests.helpers.picture import picture_at
from tests.report.builders import HOSTILE


@cache
def mixed():
    """Return an NPC that crosses after the ego, one that merges ahead of it, and one on the grid."""
    return run_view(junction_trace((CROSSES, 0.0), (MERGES, 0.0), (None, 20.0)))


@cache
def crash():
    """Return a run in which an NPC from the left hits the ego; a second NPC is still on its way."""
    return run_view(junction_trace((CROSSES, 10.0), (MERGES, -60.0), hits=0, seconds=4.8))


@cache
def real():
    """Return a run with two NPCs at a junction of highway-env."""
    world = pafot.World("intersection-v0")
    told = CrossingInstruction("o1>o3", 0.0, 8.0), CrossingInstruction("o3>o1", 1.0, 7.0)
    scenario = Scenario(npcs=[[each] for each in told], ego_lane=0, ego_speed=world.crossings.ego_speed)
    return world.rollout(scenario, lambda: lambda seen: 1)


def test_npc_off_the_ego_way_has_no_cell():
    ego, crosses, merges, ahead = mixed().vehicles
    assert ego.cells == ()
    assert set(crosses.cells) == {None}
    frame = next(frame for frame, time in enumerate(mixed().times) if time > 4.1)
    assert set(merges.cells[:frame]) == {None}
    assert set(merges.cells[frame:]) == set(ahead.cells) == {2}


def test_zone_has_words_way_and_times_of_both():
    _, crosses, merges, ahead = mixed().vehicles
    assert (crosses.zone.name, crosses.zone.stretch) == (CROSSES, (55.5, 64.5))
    assert (crosses.zone.of_ego, crosses.zone.of_npc) == ((4.6, 5.467), (5.6, 6.467))
    assert merges.zone.of_ego == (6.0, 8.0)
    assert ahead.zone is None
    assert (ahead.on_way, ahead.advantage) == ((), ())
    assert crosses.on_way[0] == 0.0
    assert crosses.advantage[-1] == pytest.approx(0.13, abs=0.01)


def test_zone_never_reached_has_no_time():
    hit, waits = (vehicle.zone for vehicle in crash().vehicles[1:])
    assert hit.of_ego == (4.6, None)
    assert (waits.of_ego, waits.of_npc) == (None, None)


def test_zone_area_is_where_bodies_are_inside_it():
    zone = mixed().vehicles[1].zone
    assert zone.way[0] == (50.0, -60.0)
    assert zone.way[-1] == (50.0, 60.0)
    assert zone.area == ((50.0, -2.0), (50.0, -1.0), (50.0, 0.0), (50.0, 1.0), (50.0, 2.0))
    assert zone.width == 4.0
    first, *_, last = mixed().vehicles[2].zone.area
    assert first == pytest.approx((75 - 15 * np.cos(0.5), 15 - 15 * np.sin(0.5)), abs=0.05)  # 7.5 m of 15 m turned
    assert last[1] == pytest.approx(0.0, abs=0.05)


def test_zone_with_unknown_way_is_named_but_undrawn():
    trace = junction_trace((CROSSES, 0.0))
    view = run_view(replace(trace, zones=(replace(ZONES[CROSSES], line=()),)))
    assert (view.vehicles[1].zone.way, view.vehicles[1].zone.area) == ((), ())


def test_world_gives_ways_that_its_npcs_drive():
    trace = real()
    view = run_view(trace)
    for npc, vehicle in enumerate(view.vehicles[1:]):
        way, places = np.array(vehicle.zone.way), trace.states[:, npc + 1, :2]
        gaps = np.hypot(*(places[:, None] - way).transpose(2, 0, 1)).min(axis=1)
        assert gaps.max() < 1.3  # there is a point every 2 m
    assert view.grid == ()
    assert view.event.cell is None


def test_instructions_are_in_words():
    crosses, merges, ahead = mixed().instructions
    assert (crosses.zone, crosses.slot, crosses.words) == (
        CROSSES,
        "0.5 s after the ego",
        "from the left, 0.5 s after the ego leaves",
    )
    assert (crosses.cell, crosses.requested, crosses.arrived) == (0, 0, 5.6)
    assert merges.words.startswith("from the right, ")
    assert (ahead.zone, ahead.slot, ahead.words) == ("", "", "")


def test_where_all_cross_there_is_no_grid():
    assert crash().grid == ()
    assert len(mixed().grid) == len(mixed().times)
    assert not any(cell.exists for cell in picture_at(crash(), 3.0).cells)
    assert picture_at(mixed(), 3.0).cells[1].exists


def test_hostile_names_of_zones_are_escaped():
    """Files cannot have such names; a user's own world can."""
    zone = replace(ZONES[CROSSES], way=HOSTILE[0])
    view = run_view(replace(junction_trace((CROSSES, 0.0)), zones=(zone,)))
    rows = tuple(replace(row, zone=HOSTILE[0], words=HOSTILE[2]) for row in view.instructions)
    page = render_page(Report.of(replace(view, instructions=rows)))
    assert HOSTILE[0] not in page
    assert HOSTILE[2] not in page


# In the browser.


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    browser = Browser(find_chromium(), tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


def texts(page, selector):
    shown = page.evaluate(f"[...document.querySelectorAll('article.current {selector}')].map(each => each.textContent)")
    return [each.replace("\u00a0", " ") for each in shown]


def opened(browser, folder, view, time, **more):
    path = folder / "report.html"
    path.write_text(render_page(Report.of(view)), encoding="utf-8")
    return browser.open(f"{path.as_uri()}#finding={view.id}&t={time}", **more)


in_a_browser = pytest.mark.skipif(
    find_chromium() is None, reason="no Chromium here: expected chromium or google-chrome on PATH"
)


@pytest.mark.processes
@in_a_browser
def test_the_page_draws_ways_zones_and_labels(browser, tmp_path):
    page = opened(browser, tmp_path, mixed(), 3.4)
    assert texts(page, ".zone-label") == ["0.5 s after the ego"] * 2
    assert texts(page, ".zone title") == ["zone of NPC 0, o3>o1", "zone of NPC 1, o2>o4"]
    assert len(texts(page, "path.way")) == 2
    rows = [text for text in texts(page, ".readout tbody tr") if "NPC" in text]
    assert "22 m before the zone" in rows[0]
    assert "from the left, 0.5 s after the ego leaves, 10.0 m/s" in rows[0]
    assert "in the zone" in rows[1]
    assert "2 front" in rows[2]
    page.evaluate(f"location.hash = 'finding={mixed().id}&t=7'")
    page.until("document.querySelector('.readout').textContent.includes('past the zone')")
    assert "; entered at 5.6 s" in texts(page, ".readout tbody tr")[1]
    assert "2 front" in texts(page, ".readout tbody tr")[2]  # it has merged
    titles = texts(page, ".charts text.label")
    assert "expected time between the two at their zone [s]" in titles
    assert len(texts(page, ".block-zone")) == len(texts(page, ".block-ego")) == 2
    assert "undefined" not in page.evaluate("document.querySelector('article.current').textContent")
    assert page.complaints == []
    page.close()


@pytest.mark.processes
@in_a_browser
def test_a_contact_at_a_junction_is_drawn_larger_until_the_reader_zooms(browser, tmp_path):
    page = opened(browser, tmp_path, crash(), 1.8)
    size = (
        "(() => { const [stage, ego] = ['.stage svg', '.ego-body']"
        ".map(each => document.querySelector(`article.current ${each}`));"
        " return [stage.viewBox.baseVal.height, Number(ego.getAttribute('width'))]; })()"
    )
    far_height, far = page.evaluate(size)
    page.press("e")
    near_height, near = page.evaluate(size)
    assert near == pytest.approx(2.2 * far, rel=0.01)
    assert near_height == pytest.approx(far_height, rel=0.02)
    page.press("-")
    _, zoomed = page.evaluate(size)
    assert zoomed == pytest.approx(0.8 * near, rel=0.01)
    page.press("Home")
    assert page.evaluate(size)[1] == pytest.approx(zoomed, rel=0.01)
    page.close()


@pytest.mark.processes
@in_a_browser
@pytest.mark.parametrize("width", [320, 400, 900, 1360])
def test_crossing_npc_is_visible_long_before_contact(browser, tmp_path, width):
    """At 10 m/s each, the two are 42 m apart 3 s before. A page on a telephone shows half of that sideways."""
    page = opened(browser, tmp_path, crash(), 1.8, width=width)
    drawn = page.evaluate(
        "document.querySelector('article.current [data-vehicle=\"NPC 0\"]').getAttribute('visibility')"
    )
    assert drawn == "visible"
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    cells = page.evaluate(
        "[...document.querySelectorAll('article.current rect.cell')].map(each => each.getAttribute('visibility'))"
    )
    assert set(cells) == {"hidden"}
    assert page.complaints == []
    page.close()
