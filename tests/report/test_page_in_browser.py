"""The page in headless Chromium draws, listens to keys, follows links and makes no network requests."""

import numpy as np
import pytest

from tests.helpers.browser import Browser, find_chromium
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import (
    HOSTILE,
    REAL_SEARCH,
    as_seen,
    bend_trace,
    page_of,
    real_page,
    real_views,
    scenario,
    view_of,
)
from tests.report.test_crossing_view import crash
from tests.report.test_lane_instructions import cut_in
from tests.report.test_lane_instructions import view_of as view_of_trace

CHROMIUM = find_chromium()

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(
        CHROMIUM is None, reason="no Chromium here: expected chromium or google-chrome on PATH"
    ),
]

TIME = "Number(document.querySelector('article.current .player').dataset.time)"
CURRENT = "[...document.querySelectorAll('#articles > article')].findIndex(each => each.matches('.current'))"
IS_PLAYING = "document.querySelector('article.current .play').textContent === 'Pause'"
SCRUBBER = "article.current input[type=range]"
BUTTON = "article.current .controls button"
CALM = [("prefers-reduced-motion", "reduce")]
IMPACT = (
    "document.querySelector('article.current .impact').parentElement.getAttribute('visibility')"
)
EGO_WIDTH = (
    "document.querySelector('article.current .stage .ego-body').getBoundingClientRect().width"
)
CLOCK = (
    "let now = 0, due = []; window.requestAnimationFrame = each => due.push(each);"
    "window.cancelAnimationFrame = () => { due = []; };"
    "window.frame = () => { now += 100; due.splice(0).forEach(each => each(now)); }"
)
"""A clock of the page whose frames are a tenth of a second apart, however slow the machine is."""
SPLIT = """(() => {
  const found = [], range = document.createRange();
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let at = walker.nextNode(); at; at = walker.nextNode()) for (const word of at.data.matchAll(/[A-Za-z]{2,}/g)) {
    range.setStart(at, word.index), range.setEnd(at, word.index + word[0].length);
    const lines = new Set([...range.getClientRects()].map(box => Math.round(box.top)));
    if (lines.size > 1 && !at.parentElement.closest("pre, code, .id")) found.push(word[0]);
  }
  return found;
})()"""
"""The words that the page shows on two lines."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    browser = Browser(CHROMIUM, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture
def opened(browser, tmp_path):
    """Return a function that opens the page of a report; no page may complain or ask for anything but itself."""
    pages = []

    def opened(text=None, fragment="", **more):
        path = tmp_path / f"{len(pages)}.html"
        path.write_text(text or real_page(), encoding="utf-8")
        pages.append(browser.open(path.as_uri() + fragment, **more))
        assert pages[-1].asked == [path.as_uri()]
        return pages[-1]

    yield opened
    for page in pages:
        assert page.complaints == []
        page.close()


@pytest.fixture
def page(opened):
    return opened(media=CALM)


def go(page, finding, time):
    page.evaluate(f"location.hash = 'finding={finding.seen.id}&t={time}'")
    page.until(f"Math.abs({TIME} - {time}) < 0.0011")


def test_first_finding_is_drawn_at_its_event_if_motion_is_unwelcome(page):
    assert page.evaluate("document.title") == "t: 2 findings"
    assert (
        page.evaluate(
            "document.querySelectorAll('article.current .stage svg [data-vehicle]').length"
        )
        == 3
    )
    assert (
        page.evaluate("document.querySelectorAll('article.current .charts svg .curve').length") > 5
    )
    assert page.evaluate(CURRENT) == 0
    assert page.evaluate(TIME) == pytest.approx(real_views()[0].event.time, abs=0.001)
    assert page.evaluate(IMPACT) == "visible"
    page.press("Home")
    assert page.evaluate(IMPACT) == "hidden"


def test_a_finding_opens_a_second_before_its_event_and_plays_once(opened):
    page, event = opened(), real_views()[0].event.time
    assert event - 1.001 <= page.evaluate(TIME) <= event
    page.until(f"{TIME} === {event}")
    assert page.evaluate(IMPACT) == "visible"
    # so that a reload plays it again
    assert page.evaluate("location.hash") == f"#finding={real_views()[0].seen.id}"
    page.evaluate(CLOCK)
    page.press("j")
    second = real_views()[1].event.time
    assert page.evaluate(TIME) == pytest.approx(second - 1, abs=0.001)
    page.evaluate("for (let each = 0; each < 12; each += 1) frame()")
    assert page.evaluate(f"[{TIME}, due.length]") == [pytest.approx(second, abs=0.001), 0]
    page.click("article.current .stage")  # plays the whole run
    assert page.evaluate(TIME) == 0
    page.evaluate("frame(); frame(); frame()")
    assert page.evaluate(TIME) == pytest.approx(0.2)
    page.click("article.current .stage")
    assert not page.evaluate(IS_PLAYING)


def test_failed_check_opens_at_its_moment_with_its_curve(opened):
    finding = real_views()[0]
    values = tuple(30.0 if time > 3 else 1.0 for time in finding.times)
    check = {
        "name": "jerk",
        "unit": "m/s^3",
        "value": 35.1,
        "at_most": 20.0,
        "at_least": None,
        "time": 3.4,
        "low": 0.0,
    }
    check |= {"values": values, "high": 40.0, "is_cut": (False, False), "broken": ((3.2, 4.0),)}
    page = opened(page_of(finding.changed(check=check)), media=CALM)
    assert page.evaluate(TIME) == 3.4
    page.press("Home")
    page.press("e")
    assert page.evaluate(TIME) == 3.4
    charts = "document.querySelector('article.current .charts')"
    assert page.evaluate(f"{charts}.querySelectorAll('.bound, .broken, .event').length") == 4


def test_links_and_the_address_name_finding_and_time(opened):
    first, second = real_views()
    page = opened(fragment=f"#finding={second.seen.id}&t=2.5")
    assert (page.evaluate(CURRENT), page.evaluate(TIME)) == (1, 2.5)
    assert (
        page.evaluate("document.querySelector('#list a[aria-current=true] .id').textContent")
        == second.seen.id
    )
    page.evaluate(f"document.querySelector('#list a[data-key=\"{first.seen.id}\"]').click()")
    page.until(f"{CURRENT} === 0")
    page.press("Home")
    assert page.evaluate("location.hash") == f"#finding={first.seen.id}&t=0.00"


@pytest.mark.parametrize("fragment", [
    *("#finding=unknown&t=3", "#t=nonsense", "#%E0%A4%A", "#finding="),
    *(f"#finding={{}}&t={time}" for time in ("-5", "1e9", "NaN", "Infinity")),
])  # fmt: skip
def test_a_link_to_nothing_shows_the_first_finding_and_clamps_its_time(opened, fragment):
    finding = real_views()[0]
    page = opened(fragment=fragment.format(finding.seen.id))
    assert page.evaluate(CURRENT) == 0
    assert 0 <= page.evaluate(TIME) <= finding.times[-1] + 0.001


def test_keys_move_through_time_and_findings(page):
    for key, shift, time in (
        ("Home", False, 0.0),
        ("ArrowRight", False, 0.1),
        ("ArrowRight", True, 1.1),
        ("ArrowLeft", False, 1.0),
        ("End", False, real_views()[0].times[-1]),
        ("e", False, real_views()[0].event.time),
    ):
        page.press(key, shift=shift)
        assert page.evaluate(TIME) == pytest.approx(time, abs=0.001)
    for key, index in (("k", 0), ("j", 1), ("j", 1), ("k", 0)):
        page.press(key)
        assert page.evaluate(CURRENT) == index
    page.press("?")
    assert not page.evaluate("document.getElementById('key-list').hidden")
    before = page.evaluate(TIME)
    page.evaluate("document.querySelector('article.current select').focus()")
    page.press("Home")
    assert page.evaluate(TIME) == before


@pytest.mark.parametrize("focus", ["", "document.querySelector('article.current .play').focus()"])
def test_space_plays_and_pauses(page, focus):
    page.press("Home")
    page.evaluate(focus or "0")
    page.press(" ")
    assert page.evaluate(IS_PLAYING)
    page.until(f"{TIME} > 0.05")
    page.press(" ")
    assert not page.evaluate(IS_PLAYING)
    stopped = page.evaluate(TIME)
    assert page.evaluate(f"new Promise(done => setTimeout(() => done({TIME}), 150))") == stopped


def test_each_control_does_what_it_says(page):
    finding = real_views()[0]
    page.click(SCRUBBER, 0.5)
    middle = page.evaluate(TIME)
    assert middle == pytest.approx(finding.times[-1] / 2, abs=0.05)
    told = f"document.querySelector({SCRUBBER!r}).getAttribute('aria-valuetext')"
    assert page.evaluate(told) == f"{middle:.2f} s of {finding.times[-1]:.2f} s"
    assert page.evaluate("location.hash").endswith(f"&t={middle:.2f}")
    page.click(f"{BUTTON}.play")
    page.until(f"{TIME} > {middle}")
    page.click(SCRUBBER, 0.25)  # pauses there
    assert not page.evaluate(IS_PLAYING)
    # the knob has a width
    assert page.evaluate(TIME) == pytest.approx(finding.times[-1] / 4, abs=0.3)
    page.click(f"{BUTTON}:not(.play)")
    assert page.evaluate(TIME) == pytest.approx(finding.event.time, abs=0.001)
    page.click("article.current .charts svg", 0.5)
    assert 0 < page.evaluate(TIME) < finding.times[-1]
    width = page.evaluate(EGO_WIDTH)
    page.click(f"{BUTTON}[aria-label='Zoom in']")
    assert page.evaluate(EGO_WIDTH) == pytest.approx(1.25 * width, rel=0.02)
    page.click(f"{BUTTON}[aria-label='Zoom out']")
    assert page.evaluate(EGO_WIDTH) == pytest.approx(width, rel=0.02)


def test_the_speed_of_play_is_that_of_the_menu(opened):
    page = opened(fragment=f"#finding={real_views()[0].seen.id}&t=1")
    page.evaluate(CLOCK)
    menu = "document.querySelector('article.current .controls select')"
    for speed in (1, 0.25, 4):
        page.evaluate(f"{menu}.value = '{speed}'; {menu}.dispatchEvent(new Event('change'))")
        page.press("Home")
        page.click(f"{BUTTON}.play")
        page.evaluate("frame(); frame(); frame()")  # the first one only sets the clock
        assert page.evaluate(TIME) == pytest.approx(0.2 * speed)


def at_the_edge():
    """Return a run in the leftmost lane, behind an NPC that is to come to the ego's right."""
    npcs = scenario([(4, 20.0)], ego_speed=20.0)
    cars = (vehicle(0.0, 0.0, speed=20.0, ticks=60), vehicle(30.0, 0.0, speed=20.0, ticks=60))
    return trace_of(*cars, scenario=npcs, arrivals=((None,),))


VIEWS = {
    "straight": lambda: real_views()[0],
    "edge": lambda: view_of_trace(at_the_edge()),
    "bend": lambda: view_of(bend_trace()),
    "lanes": lambda: view_of_trace(cut_in()),
    "junction": crash,
}


@pytest.mark.parametrize("name", VIEWS)
def test_vehicles_are_drawn_between_the_places_of_two_frames(opened, name):
    finding = VIEWS[name]()
    page = opened(page_of(finding))
    for time in (0.0, 0.777, 2.0, finding.times[-1]):
        go(page, finding, time)
        drawn = page.evaluate(
            "[...document.querySelectorAll('article.current [data-vehicle]')]"
            ".map(each => [Number(each.dataset.along), Number(each.dataset.across)])"
        )
        shown = page.evaluate(TIME)
        for place, view in zip(drawn, finding.vehicles, strict=True):
            tracks = (np.array(track, dtype=float) for track in (view.along, view.across))
            assert place == pytest.approx(
                [np.interp(shown, finding.times, track) for track in tracks], abs=0.02
            )
    shapes = page.evaluate("document.querySelectorAll('article.current .lane-ground').length")
    assert shapes == len(finding.road.shapes)


@pytest.mark.parametrize(("name", "time", "cells", "targets"), [
    ("straight", 0.0, "12345678", "1"),
    ("edge", 1.0, "23456", "1"),
    ("lanes", 1.0, "12345678", "1"),
    ("lanes", 3.0, "12345678", ""),
    ("lanes", 13.0, "12345678", "1"),
    ("bend", 1.0, "", ""),
])  # fmt: skip
def test_cells_of_lanes_that_exist_are_drawn_and_targets_until_they_are_reached(
    opened, name, time, cells, targets
):
    finding = VIEWS[name]()
    page = opened(page_of(finding))
    go(page, finding, time)
    for kind, wanted in (("cell", cells), ("target", targets)):
        rects = f"[...document.querySelectorAll('article.current rect.{kind}')]"
        visible = page.evaluate(
            f"{rects}.map(each => each.getAttribute('visibility') === 'visible')"
        )
        assert (
            "".join(str(number) for number, is_visible in enumerate(visible, 1) if is_visible)
            == wanted
        )


def test_hostile_text_is_shown_and_never_run(opened):
    first = real_views()[0]
    findings = tuple(
        as_seen(first, finding={"test": f"t.py::{text}"}, node_id=text, path=text).changed(
            headline=text, yaml=text, happened=((text, text, ((text, (text,)),)),)
        )
        for text in HOSTILE
    )
    page = opened(page_of(*findings, title=HOSTILE[0]))
    for _ in HOSTILE:
        page.press("j")
    assert page.evaluate(CURRENT) == len(HOSTILE) - 1
    assert page.evaluate("typeof window.hacked") == "undefined"
    assert page.evaluate("document.title").startswith(HOSTILE[0])
    assert page.evaluate("document.querySelectorAll('img, script').length") == 2


@pytest.mark.parametrize("text", [real_page, lambda: page_of(crash(), searches=(REAL_SEARCH,))])
def test_nothing_is_wider_than_the_window_and_no_word_is_split(opened, text):
    page = opened(text())
    for width in (320, 360, 390, 600, 641, 768, 901, 1024, 1280, 1920, 2200, 500):
        page.resize(width)
        page.until(
            f"document.querySelector('article.current .stage svg').getBoundingClientRect().width <= {width}"
        )
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert (width, page.evaluate(SPLIT)) == (width, [])


def test_selected_row_of_a_long_list_is_in_sight(opened):
    finding = real_views()[0]
    findings = tuple(as_seen(finding, finding={"id": f"hit-{number}"}) for number in range(60))
    page = opened(page_of(*findings), fragment="#finding=hit-59")
    top, bottom, window = page.evaluate(
        "(row => [row.top, row.bottom, innerHeight])"
        "(document.querySelector('#list a[aria-current=true]').getBoundingClientRect())"
    )
    assert 0 <= top < bottom <= window


def test_page_without_a_player_listens_to_keys_and_steps_go_on(opened):
    empty = opened(page_of())
    for key in ("j", " ", "Home"):
        empty.press(key)
    first, second = real_views()
    unseen = as_seen(first, finding={"id": "crash-1"}).changed(times=(), vehicles=())
    page = opened(page_of(unseen, second))
    page.press(" ")
    page.press("j")
    assert page.evaluate(CURRENT) == 1
    assert page.evaluate(TIME) > 0


def test_copy_button_says_what_it_did(page):
    page.click("article.current [data-copy=code]")
    said = "document.querySelector('article.current [data-copy=code]').textContent"
    page.until(f"['Copied', 'Selected, press Ctrl+C'].includes({said})")


def test_dark_and_light_differ(opened):
    colours = {
        opened(media=[("prefers-color-scheme", scheme)]).evaluate(
            "getComputedStyle(document.body).backgroundColor"
        )
        for scheme in ("light", "dark")
    }
    assert len(colours) == 2
