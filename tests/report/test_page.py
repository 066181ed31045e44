"""The page as text: complete, safe, the same every time, and small."""

import base64
import hashlib
import json
import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from importlib.resources import files

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.report.page import (
    ASSETS,
    DRAWN,
    SCRIPTS,
    data_json,
    finding_article,
    finding_list,
)
from tests.helpers.hostile import CHARACTERS
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import (
    HOSTILE,
    REAL_SEARCH,
    as_seen,
    cut_in_trace,
    finding_of,
    page_of,
    real_page,
    real_views,
    scenario,
    view_of,
)


class Reader(HTMLParser):
    """A parser for elements, the text of scripts and styles, and all other text."""

    def __init__(self, page):
        super().__init__(convert_charrefs=True)
        self.tags, self.words, self.raw, self._open = [], [], {}, None
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags += [(tag, dict(attrs))] if tag != "wbr" else []  # where a long name may break
        if tag in ("script", "style"):
            self._open = f"{tag}:{dict(attrs).get('type', '')}"
            self.raw[self._open] = ""

    def handle_endtag(self, tag):
        self._open = None

    def handle_data(self, data):
        if self._open is None:
            self.words.append(data)
        else:
            self.raw[self._open] += data


@pytest.fixture(scope="module")
def page():
    return real_page()


def test_the_page_is_always_the_same_and_refers_to_nothing_outside_itself(page):
    without_time = re.compile(r"[\d-]+ [\d:]+ UTC")
    assert without_time.sub("", real_page()) == without_time.sub("", page)
    reader = Reader(page)
    assert not {"link", "img", "iframe", "object", "embed", "base"} & {
        tag for tag, _ in reader.tags
    }
    addresses = [
        value
        for _, attrs in reader.tags
        for name, value in attrs.items()
        if name in ("src", "href", "action")
    ]
    assert all(address.startswith("#") for address in addresses)
    outside = set(re.findall(r"https?://[^\s\"'<]+", page)) - {"http://www.w3.org/2000/svg"}
    assert not outside
    assert "@import" not in page


def test_page_allows_own_style_and_script_without_connection(page):
    reader = Reader(page)
    policy = next(
        attrs["content"]
        for tag, attrs in reader.tags
        if attrs.get("http-equiv") == "Content-Security-Policy"
    )

    def hash_of(text):
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    assert "default-src 'none'" in policy
    assert f"style-src {hash_of(reader.raw['style:'])};" in policy
    assert f"script-src {hash_of(reader.raw['script:'])};" in policy


def test_everything_in_words_is_there_without_scripts(page):
    words = " ".join(Reader(page).words)
    for finding in real_views():
        for part in (
            finding.seen.id,
            finding.headline,
            finding.yaml,
            "pytest --pafot-generations=8",
        ):
            assert part in words
    assert "45 none, 3 ego, 2 npc" in words


def test_page_data_have_what_the_scripts_read_and_nothing_else(page):
    data = json.loads(Reader(page).raw["script:application/json"])
    scripts = "".join(files(ASSETS).joinpath(name).read_text() for name in SCRIPTS)
    for told, finding in zip(data, real_views(), strict=True):
        assert told == {name: json.loads(json.dumps(finding.view[name])) for name in DRAWN}
    read = {
        *re.findall(r"\bfinding\??\.(\w+)", scripts),
        *re.findall(r"\bfindings\[\w+\]\.(\w+)", scripts),
    }
    read |= {
        name
        for names in re.findall(r"const \{([^}]*)\} = (?:this\.)?finding;", scripts)
        for name in names.split(", ")
    }
    assert {each.strip() for each in read} == set(DRAWN)


def page_that_says(text):
    """Return a page that contains a text everywhere a report can."""
    expect = replace(real_views()[0].seen.finding.expect, responsibility=text)
    named = {"test": f"t.py::test[{text}]", "expect": expect}
    finding = as_seen(real_views()[0], finding=named, node_id=text, path=text).changed(
        headline=text, happened=((text, text, ((text, (text,)),)),), yaml=text
    )
    search = replace(REAL_SEARCH, node_id=text, warnings=(text,), outcomes=Counter({text: 1}))
    return page_of(finding, title=text, searches=(search,), failures={(text, "setup"): text})


def test_hostile_text_stays_text_wherever_it_stands():
    harmless = Reader(page_that_says("harmless"))
    expected = [(tag, list(attrs)) for tag, attrs in harmless.tags]
    for text in HOSTILE:
        page = page_that_says(text)
        page.encode("utf-8")
        hostile = Reader(page)
        assert [(tag, list(attrs)) for tag, attrs in hostile.tags] == expected, text
        assert hostile.raw["script:"] == harmless.raw["script:"], text


def test_view_with_nan_or_infinity_is_refused():
    finding = real_views()[0]
    with pytest.raises(ValueError, match="JSON"):
        page_of(finding.changed(times=(float("nan"),)))


def test_an_empty_report_takes_below_100_kilobytes_and_has_no_searches():
    page = page_of()
    assert len(page.encode()) < 100_000
    assert "Searches" not in Reader(page).words


def test_minute_with_two_npcs_takes_below_65_kilobytes():
    ticks = 900
    lanes = [
        vehicle(x, y, speed=21.37, ticks=ticks)
        for x, y in ((0.123, 4.0), (31.77, 0.0), (-52.3, 8.0))
    ]
    trace = trace_of(*lanes, scenario=scenario([(1, 20.3)] * 6, [(4, 7.7)] * 6))
    assert trace.duration == 60
    views = [as_seen(view_of(trace), finding={"id": id_}) for id_ in ("a", "b")]
    one, two = (len(page_of(*views[:count]).encode()) for count in (1, 2))
    assert two - one < 65_000


@given(st.text(CHARACTERS, max_size=20))
def test_no_text_ends_the_script_element_of_the_data(text):
    data = data_json([real_views()[0].changed(headline=text)])
    assert data.isascii()
    assert not set("<>&") & set(data)
    assert json.loads(data)[0]["headline"] == text


def test_conditions_stand_below_the_vehicle_that_they_are_about():
    groups = (("NPC 0", ("line 1: a < b", "line 2")), ("", ("line 3",)))
    finding = real_views()[0].changed(moment=(("Title", "Text.", groups),))
    article = finding_article(finding, 0)
    places = ('<p class="sentence deed">', "Title", "NPC 0</h4>", 'class="player"')
    assert sorted(places, key=article.index) == [*places]
    rows = [f"<li><code>{row}</code></li>" for row in ("line 1: a &lt; b", "line 2", "line 3")]
    assert f"<h4>NPC 0</h4><ul>{rows[0]}{rows[1]}</ul><ul>{rows[2]}</ul>" in article


def test_an_error_of_the_policy_is_the_egos():
    error = AdsError(
        kind="ValueError",
        message="no plan",
        traceback="Traceback:\n  line 3\nValueError: no plan",
        tick=30,
    )
    trace = replace(cut_in_trace(), outcome=Outcome.ADS_ERROR, collision=None, error=error)
    finding = finding_of(trace)
    expect = replace(finding.expect, traceback=error.traceback)
    view = view_of(trace, replace(finding, expect=expect), headline="ValueError: no plan")
    assert view.moment == (("The traceback", "", (("", ("  line 3", "ValueError: no plan")),)),)
    assert f" {view.event.time:.1f} s: ValueError: no plan" in view.headline
    assert "1 policy error" in finding_list([view])
