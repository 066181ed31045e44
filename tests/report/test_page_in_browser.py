"""The page in headless Chromium draws, listens to keys, follows links and makes no network requests."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from pytest_pafot.report.page import render_page
from pytest_pafot.report.page_data import CheckView, Report
from tests.helpers.browser import Browser, find_chromium
from tests.helpers.picture import picture_at
from tests.helpers.situations import lane_change
from tests.report.builders import (
    HOSTILE,
    as_seen,
    bend_report,
    real_report,
    view_of,
)
from tests.report.test_crossing_view import crash, mixed

CHROMIUM = find_chromium()
FILES = Path(__file__).parents[1] / "corpus" / "saved"

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: expected chromium or google-chrome on PATH"),
]

ALL = "[...document.querySelectorAll({selector!r})].map(each => {what})"
TIME = "Number(document.querySelector('article.current .player').dataset.time)"
CURRENT = "Number(document.querySelector('article.current').dataset.index)"
IS_PLAYING = "document.querySelector('article.current .play').textContent === 'Pause'"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    browser = Browser(CHROMIUM, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render_page(real_report()), encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def opened(browser, address):
    pages = []

    def opened(fragment="", **more):
        pages.append(browser.open(address + fragment, **more))
        return pages[-1]

    yield opened
    for page in pages:
        assert page.complaints == []
        page.close()


@pytest.fixture
def page(opened):
    return opened()


def test_legend_explains_trails_even_with_imperfect_perception(page):
    legend = page.evaluate("document.querySelector('article.current .legend').textContent")
    assert "Dotted trails: the last 4 s relative to the ego." in legend

    assert page.complaints == []
    page.close()


def test_page_draws_everything_without_network_requests(page, address):
    assert page.evaluate("document.title") == "Constant speed"
    assert page.evaluate("document.querySelectorAll('article.current .stage svg [data-vehicle]').length") == 3
    assert page.evaluate("document.querySelectorAll('article.current .charts svg .curve').length") > 5
    assert page.asked == [address]


def test_the_first_finding_is_shown_at_its_event(page):
    assert page.evaluate(CURRENT) == 0
    assert page.evaluate(TIME) == pytest.approx(real_report().findings[0].event.time, abs=0.001)
    assert (
        page.evaluate("document.querySelector('article.current .impact-group').getAttribute('visibility')") == "visible"
    )


def test_failed_check_opens_at_moment_with_curve_first(browser, tmp_path):
    finding = real_report().findings[0]
    values = tuple(30.0 if time > 3 else 1.0 for time in finding.times)
    check = CheckView(
        name="jerk", unit="m/s^3", value=35.1, at_most=20.0, time=3.4, values=values, high=40.0, broken=((3.2, 4.0),)
    )
    path = tmp_path / "check.html"
    path.write_text(render_page(Report(title="t", findings=(replace(finding, check=check),))), encoding="utf-8")
    page = browser.open(path.as_uri())
    assert page.evaluate(TIME) == 3.4
    page.press("Home")
    page.press("e")
    assert page.evaluate(TIME) == 3.4
    first = "document.querySelector('article.current .player').firstChild"
    assert page.evaluate(f"{first}.querySelectorAll('.bound, .broken, .event').length") == 4
    assert page.evaluate(f"Number({first}.querySelector('.broken').getAttribute('width')) > 2")
    assert (
        page.evaluate("document.querySelector('article.current .impact-group').getAttribute('visibility')") == "hidden"
    )
    assert page.complaints == []
    page.close()


def test_link_opens_a_finding_at_its_moment(opened):
    finding = real_report().findings[1]
    page = opened(f"#finding={finding.id}&t=2.5")
    assert page.evaluate(CURRENT) == 1
    assert page.evaluate(TIME) == 2.5
    assert page.evaluate("document.querySelector('#list a[aria-current=true] .id').textContent") == finding.id


def test_link_within_the_page_changes_finding_and_time(page):
    first, second = real_report().findings
    page.evaluate(f"location.hash = 'finding={second.id}&t=1.25'")
    page.until(f"{CURRENT} === 1 && {TIME} === 1.25")
    page.evaluate(f"document.querySelector('#list a[href=\"#finding={first.id}\"]').click()")
    page.until(f"{CURRENT} === 0")


def test_the_address_follows_what_is_shown(page):
    page.press("Home")
    assert page.evaluate("location.hash") == f"#finding={real_report().findings[0].id}&t=0.00"


@pytest.mark.parametrize("fragment", ["#finding=unknown&t=3", "#t=nonsense", "#%E0%A4%A", "#finding="])
def test_a_link_to_nothing_shows_the_first_finding(opened, fragment):
    assert opened(fragment).evaluate(CURRENT) == 0


@pytest.mark.parametrize("width", [420, 1360])
def test_the_selected_row_is_in_sight_below_the_filter(browser, tmp_path, width):
    finding = real_report().findings[0]
    findings = tuple(as_seen(finding, finding={"id": f"hit-{number}"}) for number in range(60))
    path = tmp_path / "long.html"
    path.write_text(render_page(Report(title="t", findings=findings)), encoding="utf-8")
    for chosen in (59, 40, 0):
        page = browser.open(f"{path.as_uri()}#finding=hit-{chosen}", width=width)
        top, bottom, filter_bottom, window = page.evaluate(
            "(() => { const box = each => document.querySelector(each).getBoundingClientRect();"
            " const row = box('#list a[aria-current=true]');"
            " return [row.top, row.bottom, box('#filter').bottom, innerHeight]; })()"
        )
        assert 0 < filter_bottom <= top < bottom <= window
        assert page.evaluate("scrollY") == 0
        # What is out of sight is counted above and below the list.
        told = page.evaluate(ALL.format(selector=".more.shown", what="each.textContent"))
        assert [each.split(" more ")[1] for each in told] == {0: ["below"], 40: ["above", "below"], 59: ["above"]}[
            chosen
        ]
        seen = page.evaluate(
            "(() => { const frame = document.querySelector('.rows').getBoundingClientRect();"
            " return [...document.querySelectorAll('#list a')].map(each => each.getBoundingClientRect())"
            ".filter(each => each.top >= frame.top - 1 && each.bottom <= frame.bottom + 1).length; })()"
        )
        assert sum(int(each.split()[1]) for each in told) == 60 - seen
        marked = ALL.format(selector="#list a", what="getComputedStyle(each).borderLeftColor")
        page.press("k")
        colours = page.evaluate(marked)
        assert sorted(map(colours.count, set(colours))) == [1, 59]
        page.close()


def test_a_number_and_its_unit_are_not_parted(browser, tmp_path):
    finding = replace(real_report().findings[0], headline="hit after 3.5 s at 8.0 m/s^2: 3 steps, 2 m away, 4 m/sec")
    path = tmp_path / "units.html"
    path.write_text(render_page(Report.of(finding)), encoding="utf-8")
    page = browser.open(path.as_uri())
    words = page.evaluate("document.querySelector('article.current h2').textContent")
    assert "hit after 3.5\u00a0s at 8.0\u00a0m/s^2: 3 steps, 2\u00a0m away, 4 m/sec" in words
    code = page.evaluate("document.querySelector('article.current .yaml pre').textContent")
    assert code == finding.yaml
    page.close()


@pytest.mark.parametrize("time", ["-5", "1e9", "NaN", "Infinity"])
def test_time_outside_of_run_is_clamped_into_it(opened, time):
    finding = real_report().findings[0]
    shown = opened(f"#finding={finding.id}&t={time}").evaluate(TIME)
    assert 0 <= shown <= finding.duration + 0.001


def test_keys_move_through_time(page):
    end = real_report().findings[0].duration
    page.press("Home")
    assert page.evaluate(TIME) == 0
    page.press("ArrowRight")
    page.press("ArrowRight")
    assert page.evaluate(TIME) == pytest.approx(0.2)
    page.press("ArrowRight", shift=True)
    assert page.evaluate(TIME) == pytest.approx(1.2)
    page.press("ArrowLeft")
    assert page.evaluate(TIME) == pytest.approx(1.1)
    page.press("End")
    assert page.evaluate(TIME) == pytest.approx(end, abs=0.001)
    page.press("Home")
    page.press("e")
    assert page.evaluate(TIME) == pytest.approx(real_report().findings[0].event.time, abs=0.001)


def test_space_plays_and_pauses(page):
    page.press("Home")
    page.press(" ")
    assert page.evaluate(IS_PLAYING)
    page.until(f"{TIME} > 0.05")
    page.press(" ")
    assert not page.evaluate(IS_PLAYING)
    stopped = page.evaluate(TIME)
    assert stopped > 0.05
    assert page.evaluate(f"new Promise(done => setTimeout(() => done({TIME}), 150))") == stopped


def test_space_on_a_button_presses_the_button_alone(page):
    page.press("Home")
    page.evaluate("document.querySelector('article.current .play').focus()")
    page.press(" ")
    assert page.evaluate(IS_PLAYING)


def test_space_plays_after_finding_was_chosen_by_mouse(page):
    page.evaluate("(link => { link.focus(); link.click(); })(document.querySelectorAll('#list a')[1])")
    page.until(f"{CURRENT} === 1")
    page.press(" ")
    assert page.evaluate(IS_PLAYING)


def test_j_and_k_step_through_findings_without_wrapping(page):
    for key, index in (("k", 0), ("j", 1), ("j", 1), ("k", 0)):
        page.press(key)
        assert page.evaluate(CURRENT) == index


def test_keys_do_nothing_while_a_field_has_them(page):
    before = page.evaluate(TIME)
    page.evaluate("document.querySelector('article.current select').focus()")
    page.press("Home")
    assert page.evaluate(TIME) == before


SCRUBBER = "article.current input[type=range]"
BUTTON = "article.current .controls button"
WIDTH = "document.querySelector('article.current .stage [data-vehicle=ego] .ego-body').getBoundingClientRect().width"


def test_each_control_does_what_it_says(browser, tmp_path):
    """They are clicked with a mouse, one after another on one page, of a finding whose event is not at its end."""
    finding = real_report().findings[0]
    finding, path = replace(finding, event=replace(finding.event, time=9.0)), tmp_path / "controls.html"
    path.write_text(render_page(Report.of(finding)), encoding="utf-8")
    page, shown = browser.open(path.as_uri()), f"document.querySelector({SCRUBBER!r}).getAttribute('aria-valuetext')"
    drawn = drawn_vehicles(page)
    # The slider: the time, its text, the clock and the picture follow, and so does the address.
    page.click(SCRUBBER, 0.5)
    middle = page.evaluate(TIME)
    assert middle == pytest.approx(finding.duration / 2, abs=0.05)
    assert page.evaluate(f"Number(document.querySelector({SCRUBBER!r}).value)") == pytest.approx(middle, abs=0.01)
    assert page.evaluate(shown) == f"{middle:.2f} s of {finding.duration:.2f} s"
    assert page.evaluate("location.hash").endswith(f"&t={middle:.2f}")
    assert drawn_vehicles(page) != drawn
    # A click while the picture moves pauses it there.
    page.click(f"{BUTTON}.play")
    assert page.evaluate(IS_PLAYING)
    page.until(f"{TIME} > {middle}")
    page.click(SCRUBBER, 0.25)
    assert not page.evaluate(IS_PLAYING)
    assert page.evaluate(TIME) == pytest.approx(finding.duration / 4, abs=0.3)  # the knob has a width
    # Play and pause.
    page.click(f"{BUTTON}.play")
    paused = page.evaluate(TIME)
    page.until(f"{TIME} > {paused}")
    page.click(f"{BUTTON}.play")
    stopped = page.evaluate(TIME)
    assert not page.evaluate(IS_PLAYING)
    assert page.evaluate("document.querySelector('article.current .play').textContent") == "Play"
    assert page.evaluate(f"new Promise(done => setTimeout(() => done({TIME}), 100))") == stopped
    # The event.
    page.click(f"{BUTTON}:not(.play)")
    assert page.evaluate("document.querySelector('article.current .play + output + input + button').textContent") == (
        "Go to the event"
    )
    assert page.evaluate(TIME) == 9.0
    assert drawn_vehicles(page) == drawn  # the page had opened there
    # The zoom.
    width = page.evaluate(WIDTH)
    page.click(f"{BUTTON}[aria-label='Zoom in']")
    assert page.evaluate(WIDTH) == pytest.approx(1.25 * width, rel=0.01)
    for _ in range(2):
        page.click(f"{BUTTON}[aria-label='Zoom out']")
    assert page.evaluate(WIDTH) == pytest.approx(0.8 * width, rel=0.01)
    assert page.evaluate(TIME) == 9.0
    assert page.complaints == []
    page.close()


def test_the_speed_of_play_is_that_of_the_menu(page):
    """The page's clock is replaced, so that a frame is a tenth of a second, however slow the machine is."""
    page.evaluate(
        "let now = 0, due = []; window.requestAnimationFrame = each => due.push(each);"
        "window.cancelAnimationFrame = () => { due = []; };"
        "window.frame = () => { now += 100; due.splice(0).forEach(each => each(now)); }"
    )
    menu = "document.querySelector('article.current .controls select')"
    assert page.evaluate(f"{menu}.value") == "1"
    assert page.evaluate(f"[...{menu}.options].map(each => each.value)") == ["0.25", "0.5", "1", "2", "4"]
    for speed in (1, 0.25, 4):
        page.evaluate(f"{menu}.value = '{speed}'; {menu}.dispatchEvent(new Event('change'))")
        page.press("Home")
        page.click(f"{BUTTON}.play")
        page.evaluate("frame(); frame(); frame()")  # the first one only sets the clock
        assert page.evaluate(TIME) == pytest.approx(0.2 * speed)


def drawn_vehicles(page):
    """Return where each vehicle is drawn, along and across the road [m]."""
    return page.evaluate(
        "[...document.querySelectorAll('article.current [data-vehicle]')]"
        ".map(each => [Number(each.dataset.along), Number(each.dataset.across)])"
    )


def test_browser_picture_matches_the_one_of_the_scene(opened):
    for finding in real_report().findings:
        page = opened(f"#finding={finding.id}")
        for time in (0.0, 0.777, 2.0, finding.duration):
            page.evaluate(f"location.hash = 'finding={finding.id}&t={time}'")
            page.until(f"Math.abs({TIME} - {time}) < 0.0011")
            picture = picture_at(finding, page.evaluate(TIME))
            drawn = drawn_vehicles(page)
            for (along, across), box in zip(drawn, picture.vehicles, strict=True):
                assert along == pytest.approx(box.along, abs=0.02)
                assert across == pytest.approx(box.across, abs=0.02)
            rings = (
                "[...document.querySelectorAll('article.current .target')].map(each => each.getAttribute('visibility'))"
            )
            assert page.evaluate(rings) == ["hidden" if target is None else "visible" for target in picture.targets]


def test_curved_road_is_drawn_as_in_its_world(browser, tmp_path):
    path = tmp_path / "bend.html"
    path.write_text(render_page(bend_report()), encoding="utf-8")
    (finding,) = bend_report().findings
    page = browser.open(path.as_uri())
    for time in (0.0, 2.777, finding.duration):
        page.evaluate(f"location.hash = 'finding={finding.id}&t={time}'")
        page.until(f"Math.abs({TIME} - {time}) < 0.0011")
        picture = picture_at(finding, page.evaluate(TIME))
        drawn = drawn_vehicles(page)
        for (along, across), box in zip(drawn, picture.vehicles, strict=True):
            assert (along, across) == pytest.approx((box.along, box.across), abs=0.02)
        for name, places in (("cell", picture.cells), ("target", picture.targets)):
            rects = f"[...document.querySelectorAll('article.current rect.{name}')]"
            shown = page.evaluate(f"{rects}.map(each => each.getAttribute('visibility'))")
            assert shown == ["visible" if place is not None and place.exists else "hidden" for place in places]
        angles = page.evaluate(
            "[...document.querySelectorAll('article.current rect.cell')].map(each => each.getAttribute('transform'))"
        )
        for angle, place in zip(angles, picture.cells, strict=True):
            turn = float(angle.removeprefix("rotate(").split()[0])
            assert math.cos(math.radians(turn)) == pytest.approx(math.cos(place.heading), abs=0.01)
    lanes = page.evaluate("document.querySelectorAll('article.current .lane-ground').length")
    assert lanes == len(finding.road.shapes)
    assert page.complaints == []
    page.close()


def test_hostile_text_is_shown_and_never_run(browser, tmp_path):
    findings = tuple(
        replace(
            real_report().findings[0],
            sighting=None,
            name=text,
            headline=text,
            happened=((text, text, ((text, (text,)),)),),
            yaml=text,
            label=text,
        )
        for text in HOSTILE
    )
    path = tmp_path / "hostile.html"
    path.write_text(render_page(Report(title=HOSTILE[0], findings=findings)), encoding="utf-8")
    page = browser.open(path.as_uri())
    for _ in HOSTILE:
        page.press("j")
    assert page.evaluate(CURRENT) == len(HOSTILE) - 1
    assert page.evaluate("typeof window.hacked") == "undefined"
    assert page.evaluate("document.title") == HOSTILE[0]
    assert page.evaluate("document.querySelectorAll('img, script').length") == 2
    assert page.complaints == []
    page.close()


@pytest.mark.parametrize("width", [320, 360, 600, 900, 1360, 2200])
def test_nothing_is_wider_than_the_window(opened, width):
    page = opened(width=width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("document.querySelector('.stage svg').getBoundingClientRect().width") <= width


def test_long_words_do_not_widen_a_narrow_page(browser, tmp_path):
    word = "x" * 300
    finding = replace(
        as_seen(real_report().findings[0], node_id=word, path=word),
        headline=word, label=word, happened=((word, word, ((word, (word,)),)),), yaml=word, command=word,
    )  # fmt: skip
    search = replace(real_report().searches[0], node_id=word, warnings=(word,), outcomes={word: 1})
    report = Report(title=word, facts=((word, word),), command=word, findings=(finding,), searches=(search,))
    path = tmp_path / "long.html"
    path.write_text(render_page(report), encoding="utf-8")
    page = browser.open(path.as_uri(), width=360)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    page.close()


def test_two_findings_with_same_id_have_own_links(browser, tmp_path):
    finding = real_report().findings[0]
    path = tmp_path / "twins.html"
    path.write_text(render_page(Report(title="t", findings=(finding, finding))), encoding="utf-8")
    page = browser.open(f"{path.as_uri()}#finding={finding.id}-2&t=1")
    assert page.evaluate(CURRENT) == 1
    page.press("Home")
    assert page.evaluate("location.hash") == f"#finding={finding.id}-2&t=0.00"
    page.close()


def test_picture_is_redrawn_when_the_window_changes_size(opened):
    page = opened(width=1360)
    page.resize(400)
    page.until("document.querySelector('.stage svg').viewBox.baseVal.width < 400")


def grouped_report():
    """Return findings of three tests, each with a finding of either outcome."""
    base = real_report()
    findings = []
    for name in ("test_first", "test_second", "test_third"):
        for number, kind in enumerate(("collision", "safe")):
            finding = base.findings[number]
            test, id_ = f"t.py::{name}", f"{name[5:]}-{kind}"
            event = replace(finding.event, kind=kind)
            finding = as_seen(finding, finding={"id": id_, "test": test}, node_id=f"{test}[saved-{id_}]")
            findings.append(replace(finding, event=event, assertion=f"assert run.{kind}"))
    searches = tuple(replace(base.searches[0], node_id=f"{name}[search]") for name in ("first", "second"))
    return replace(base, findings=tuple(findings), searches=searches)


@pytest.fixture
def grouped(browser, tmp_path):
    path = tmp_path / "grouped.html"
    path.write_text(render_page(grouped_report()), encoding="utf-8")
    page = browser.open(path.as_uri())
    yield page
    assert page.complaints == []
    page.close()


LISTED = "[...document.querySelectorAll('#list li a')].filter(a => a.offsetParent).map(a => a.dataset.key)"
GROUPS = "[...document.querySelectorAll('#list h3')].filter(h => h.offsetParent).map(h => h.textContent)"


def typed(page, text):
    for key in text:
        page.press(key)


def test_findings_are_listed_by_test(grouped):
    assert grouped.evaluate(GROUPS) == ["test_first 2", "test_second 2", "test_third 2"]


def test_findings_of_one_test_are_one_list(page):
    assert page.evaluate(GROUPS) == []
    assert page.evaluate("document.querySelectorAll('#list ol').length") == 1


def test_text_filter_matches_all_words_by_keyboard_alone(grouped):
    grouped.press("/")
    typed(grouped, "second safe")
    assert grouped.evaluate(LISTED) == ["second-safe"]
    assert grouped.evaluate(GROUPS) == ["test_second 2"]
    assert grouped.evaluate("document.querySelector('article.current .id').textContent") == "second-safe"
    assert grouped.evaluate("document.querySelector('#list .count').textContent") == "1 of 6"
    typed(grouped, "x")
    assert grouped.evaluate(LISTED) == []
    assert grouped.evaluate("document.getElementById('nothing').offsetParent !== null")
    grouped.press("Escape")
    assert len(grouped.evaluate(LISTED)) == 6
    assert grouped.evaluate("document.activeElement.dataset.key") == "second-safe"


def test_outcome_filter_lists_only_the_chosen_outcome(grouped):
    grouped.evaluate(
        "(() => { const each = document.getElementById('outcome'); each.value = 'safe';"
        " each.dispatchEvent(new Event('change')); })()"
    )
    assert grouped.evaluate(LISTED) == ["first-safe", "second-safe", "third-safe"]
    seen = []
    for key in "jjjk":
        grouped.press(key)
        seen.append(grouped.evaluate(CURRENT))
    assert seen == [3, 5, 5, 3]


def test_page_with_one_finding_has_no_filter(browser, tmp_path):
    path = tmp_path / "single.html"
    path.write_text(render_page(Report(title="t", findings=real_report().findings[:1])), encoding="utf-8")
    page = browser.open(path.as_uri())
    page.press("/")
    assert page.evaluate("document.getElementById('filter')") is None
    assert page.complaints == []
    page.close()


def test_the_failing_assertion_stands_above_the_picture(grouped):
    place = "document.querySelector('article.current {}').getBoundingClientRect().top"
    assert grouped.evaluate("document.querySelector('article.current .assertion').textContent") == (
        "assert run.collision"
    )
    assert grouped.evaluate(place.format(".assertion")) < grouped.evaluate(place.format(".stage"))


def test_several_searches_are_folded_and_one_is_open(grouped, page):
    is_open = "[...document.querySelectorAll('.campaign > details')].map(each => each.open)"
    assert grouped.evaluate(is_open) == [False, False]
    assert page.evaluate(is_open) == [True]
    grouped.evaluate("document.querySelector('.campaign summary').focus()")
    grouped.press("Enter")
    assert grouped.evaluate(is_open) == [True, False]


def test_mark_of_the_event_has_the_colour_of_its_line(page):
    colour = "getComputedStyle(document.querySelector('article.current .charts .{}')).{}"
    assert page.evaluate(colour.format("event-mark", "fill")) == page.evaluate(colour.format("event", "stroke"))


def test_there_are_curves_of_acceleration_and_jerk(page):
    titles = page.evaluate(ALL.format(selector="article.current .charts tspan.strong", what="each.textContent"))
    assert titles[-2:] == ["acceleration", "jerk, peak of each frame"]


OVERLAPPING = """(() => {
  const stage = document.querySelector('article.current .stage');
  const isShown = each => getComputedStyle(each).visibility === 'visible' && each.textContent;
  const kinds = '.lane-name text, .label, .impact-label, .zone-label, .cell-number';
  const shown = [...stage.querySelectorAll(kinds)].filter(isShown);
  const named = shown.map(each => [each.textContent, each.getBoundingClientRect()]);
  const pairs = named.flatMap(([name, a], n) => named.slice(n + 1).map(([other, b]) => [name, other, a, b]));
  return pairs.filter(([name, other, a, b]) => (name.length > 1 || other.length > 1)
    && a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)
    .map(([name, other]) => `${name} | ${other}`);
})()"""
"""The pairs of texts in the picture that cover each other, without two numbers of cells."""


def crossing_report():
    return Report(title="junction", findings=(crash(), mixed()))


@pytest.mark.parametrize("width", [420, 1400])
@pytest.mark.parametrize("report", [real_report, bend_report, crossing_report], ids=["straight", "bend", "junction"])
def test_no_text_of_the_picture_covers_another(browser, tmp_path, report, width):
    path = tmp_path / "labels.html"
    path.write_text(render_page(report()), encoding="utf-8")
    page = browser.open(path.as_uri(), width=width)
    for index, finding in enumerate(report().findings):
        page.evaluate(f"document.querySelectorAll('#list a')[{index}].click()")
        page.until(f"{CURRENT} === {index}")
        for key in ("Home", *["ArrowRight"] * int(finding.duration), "e"):
            page.press(key, shift=key == "ArrowRight")
            covered = page.evaluate(OVERLAPPING)
            assert covered == [], (finding.id, page.evaluate(TIME))
    page.close()


UNDER_THE_MARK = """(() => {
  const current = document.querySelector('article.current');
  const mark = current.querySelector('.impact').getBoundingClientRect();
  const [x, y, radius] = [(mark.left + mark.right) / 2, (mark.top + mark.bottom) / 2, mark.width / 2];
  const clamped = (value, low, high) => Math.min(high, Math.max(low, value));
  return [...current.querySelectorAll('.vehicle-label')].filter(each => {
    const box = each.getBoundingClientRect();
    const place = [clamped(x, box.left, box.right), clamped(y, box.top + 4, box.bottom - 4)];
    return Math.hypot(place[0] - x, place[1] - y) < 0.8 * radius;
  }).map(each => each.textContent);
})()"""
"""The numbers of vehicles under the mark at the contact."""


@pytest.mark.parametrize("width", [420, 1400])
@pytest.mark.parametrize(("gap", "away"), [(-5.0, 2), (-1.0, 0)], ids=["side by side", "at a corner"])
def test_the_mark_at_the_contact_covers_no_number_of_a_vehicle(browser, tmp_path, gap, away, width):
    path = tmp_path / "contact.html"
    path.write_text(render_page(Report.of(view_of(lane_change(gap, faster=0.1)))), encoding="utf-8")
    page = browser.open(path.as_uri(), width=width)
    assert (
        page.evaluate("document.querySelector('article.current .impact-group').getAttribute('visibility')") == "visible"
    )
    assert page.evaluate(UNDER_THE_MARK) == []
    leaders = page.evaluate(
        "[...document.querySelectorAll('[data-vehicle] .leader')].filter(each => each.getAttribute('d')).length"
    )
    moved = page.evaluate("document.querySelectorAll('.vehicle-label.away').length")
    assert leaders == moved == (away if width == 420 else 0)  # a larger vehicle has room for its number
    page.press("Home")
    assert page.evaluate("document.querySelectorAll('.vehicle-label.away').length") == 0
    page.close()


def test_lanes_of_a_bend_have_names_away_from_vehicles(browser, tmp_path):
    path = tmp_path / "bend.html"
    path.write_text(render_page(bend_report()), encoding="utf-8")
    page = browser.open(path.as_uri(), width=420)
    assert page.evaluate(ALL.format(selector="article.current .lane-name text", what="each.textContent")) == [
        "lane 0",
        "lane 1",
    ]
    page.press("e")
    apart = (
        "(() => { const box = each => each.getBoundingClientRect();"
        " const of = name => [...document.querySelectorAll(`article.current ${name}`)];"
        " const names = of('.lane-name').filter(each => each.getAttribute('visibility') === 'visible').map(box);"
        " return [names.length, names.filter(a => of('[data-vehicle]').map(box).some(b =>"
        " a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)).length]; })()"
    )
    assert page.evaluate(apart) == [2, 0]
    page.close()


def test_decisions_of_the_policy_stand_on_the_time_axis(browser, tmp_path):
    finding = replace(real_report().findings[0], decisions=((0.0, 2.0, "IDLE"), (2.0, 5.0, "-3.0 m/s^2")))
    path = tmp_path / "decisions.html"
    path.write_text(render_page(Report.of(finding)), encoding="utf-8")
    page = browser.open(path.as_uri())
    titles = page.evaluate(ALL.format(selector="article.current .decision title", what="each.textContent"))
    assert titles == ["0.0 s: IDLE", "2.0 s: -3.0 m/s^2"]
    page.press("Home")
    assert (
        page.evaluate("document.querySelector('article.current .readout tbody tr td:last-child').textContent") == "IDLE"
    )
    page.close()


def luminance(colour):
    channels = [int(part) / 255 for part in re.findall(r"\d+", colour)[:3]]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(a, b):
    low, high = sorted((luminance(a), luminance(b)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_readable_in_light_and_dark_scheme(opened, scheme):
    page = opened(media=[("prefers-color-scheme", scheme)])
    probe = """(ground, ink) => { const each = document.createElement('p'); document.body.append(each);
        each.style.background = `var(--${ground})`; each.style.color = `var(--${ink})`;
        const style = getComputedStyle(each); const both = [style.backgroundColor, style.color];
        each.remove(); return both; }"""
    paper = page.evaluate(f"({probe})('paper', 'ink')[0]")
    assert (luminance(paper) < 0.1) == (scheme == "dark")
    pairs = [(ground, ink) for ground in ("paper", "panel", "sunk", "accent-soft") for ink in ("ink", "soft")]
    pairs += [("warn-soft", "ink"), ("panel", "danger"), ("ego", "ego-ink"), ("road", "soft"), ("road", "danger")]
    poor = {pair: round(contrast(*page.evaluate(f"({probe})(...{list(pair)})")), 2) for pair in pairs}
    assert {pair: value for pair, value in poor.items() if value < 4.5} == {}
    marks = {f"npc{npc}": contrast(*page.evaluate(f"({probe})('road', 'npc{npc}')")) for npc in range(8)}
    assert {name: value for name, value in marks.items() if value < 3} == {}


def test_with_reduced_motion_play_moves_in_steps(opened):
    page = opened(media=[("prefers-reduced-motion", "reduce")])
    page.press("Home")
    page.press(" ")
    page.until(f"{TIME} > 0")
    page.press(" ")
    assert page.evaluate(TIME) % 0.5 == 0


def test_focusable_elements_have_names_and_visible_focus(page):
    nameless = page.evaluate(
        "[...document.querySelectorAll('button, select, input, a')].filter(each =>"
        " !(each.textContent.trim() || each.getAttribute('aria-label'))).length"
    )
    assert nameless == 0
    page.press("Tab")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"


def test_npcs_are_told_apart_without_colour(page):
    def every(selector, what):
        return page.evaluate(ALL.format(selector=f"article.current {selector}", what=what))

    patterns = every(".stage pattern", "[...each.children].map(part => part.tagName + part.getAttribute('d')).join()")
    assert len(patterns) == len(set(patterns)) == 2
    assert every(".vehicle-label", "each.textContent") == ["E", "0", "1"]
    assert {None, "8 4"} <= set(every(".charts path.curve", "each.getAttribute('stroke-dasharray')"))


def test_the_copy_button_tells_what_it_did(page):
    page.evaluate("document.querySelector('article.current .yaml .copy').click()")
    page.until("/Copied|Selected/.test(document.querySelector('article.current .yaml .copy').textContent)")


def test_the_list_of_keys_opens_and_closes(page):
    page.press("?")
    assert page.evaluate("!document.getElementById('key-list').hidden")
    assert page.evaluate("document.getElementById('keys').getAttribute('aria-expanded')") == "true"
    page.press("?")
    assert page.evaluate("document.getElementById('key-list').hidden")


def test_a_page_without_findings_has_no_errors(browser, tmp_path):
    path = tmp_path / "empty.html"
    path.write_text(render_page(Report(title="Nothing")), encoding="utf-8")
    page = browser.open(path.as_uri())
    page.press("j")
    page.press(" ")
    assert page.complaints == []
    page.close()


def test_a_finding_without_frames_can_be_passed_through(browser, tmp_path):
    first, second = real_report().findings
    unseen = replace(as_seen(first, finding={"id": "crash-1"}), times=(), vehicles=())
    path = tmp_path / "unseen.html"
    path.write_text(render_page(Report(title="t", findings=(unseen, second))), encoding="utf-8")
    page = browser.open(path.as_uri())
    page.press(" ")
    page.press("j")
    assert page.evaluate(CURRENT) == 1
    assert page.evaluate(TIME) > 0
    page.press("k")
    assert page.complaints == []
    page.close()
