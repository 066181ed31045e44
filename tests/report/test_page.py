"""The page as text: complete, safe, the same every time, and small."""

import base64
import hashlib
import json
import re
from dataclasses import asdict, replace
from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_pafot.report.page import ASSETS, DRAWN, SCRIPTS, render_page
from pytest_pafot.report.page_data import Report, RunView
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import HOSTILE, as_seen, cut_in_trace, real_report, scenario, values_of, view_of


class Reader(HTMLParser):
    """A parser for elements, the text of scripts and styles, and all other text."""

    def __init__(self, page):
        super().__init__(convert_charrefs=True)
        self.tags, self.words, self.raw, self._open = [], [], {}, None
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
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
    return render_page(real_report())


def test_the_same_report_gives_the_same_page(page):
    assert render_page(real_report()) == page


def test_the_page_refers_to_nothing_outside_itself(page):
    reader = Reader(page)
    assert not {"link", "img", "iframe", "object", "embed", "base"} & {tag for tag, _ in reader.tags}
    addresses = [
        value for _, attrs in reader.tags for name, value in attrs.items() if name in ("src", "href", "action")
    ]
    assert all(address.startswith("#") for address in addresses)
    outside = set(re.findall(r"https?://[^\s\"'<]+", page)) - {"http://www.w3.org/2000/svg"}
    assert not outside
    assert "@import" not in page


def test_page_allows_own_style_and_script_without_connection(page):
    reader = Reader(page)
    policy = next(
        attrs["content"] for tag, attrs in reader.tags if attrs.get("http-equiv") == "Content-Security-Policy"
    )

    def hash_of(text):
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    assert "default-src 'none'" in policy
    assert f"style-src {hash_of(reader.raw['style:'])};" in policy
    assert f"script-src {hash_of(reader.raw['script:'])};" in policy


def test_everything_in_words_is_there_without_scripts(page):
    words = " ".join(Reader(page).words)
    for finding in real_report().findings:
        for part in (finding.id, finding.headline, finding.yaml, finding.command, finding.node_id):
            assert part in words
    assert "Runs by responsibility" in words
    assert any(f"{who} at fault" in words for who in ("ego", "both"))


def test_page_data_have_what_the_scripts_read_and_nothing_else(page):
    data = json.loads(Reader(page).raw["script:application/json"])
    scripts = "".join(files(ASSETS).joinpath(name).read_text() for name in SCRIPTS)
    assert set(data) == set(re.findall(r"\breport\.(\w+)", scripts))
    for told, finding in zip(data["findings"], real_report().findings, strict=True):
        whole = json.loads(json.dumps(asdict(replace(finding, sighting=None))))
        assert told == {name: whole[name] for name in DRAWN}
    read = {*re.findall(r"\bfinding\.(\w+)", scripts), *re.findall(r"report\.findings\[\w+\]\.(\w+)", scripts)}
    assert read == set(DRAWN)


def page_that_says(text):
    """Return a page that contains a text everywhere a report can."""
    finding = replace(
        as_seen(real_report().findings[0], finding={"test": f"t.py::test[{text}]"}, node_id=text, path=text),
        headline=text, happened=((text, text, ((text, (text,)),)),), yaml=text, command=text, label=text,
        responsibility=text,
    )  # fmt: skip
    search = replace(real_report().searches[0], node_id=text, warnings=(text,), outcomes={text: 1})
    return render_page(Report(title=text, facts=((text, text),), command=text, findings=(finding,), searches=(search,)))


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
    finding = real_report().findings[0]
    with pytest.raises(ValueError, match="JSON"):
        render_page(Report(title="t", findings=(replace(finding, times=(float("nan"),)),)))


def test_an_empty_report_says_that_nothing_was_found():
    page = render_page(Report(title="Nothing"))
    assert "No findings" in page
    assert "Searches" not in " ".join(Reader(page).words)


def test_the_page_itself_is_below_100_kilobytes():
    assert len(render_page(Report(title="t")).encode()) < 100_000


def test_minute_with_two_npcs_takes_below_65_kilobytes():
    ticks = 900
    lanes = [vehicle(x, y, speed=21.37, ticks=ticks) for x, y in ((0.123, 4.0), (31.77, 0.0), (-52.3, 8.0))]
    trace = trace_of(*lanes, scenario=scenario([(1, 20.3)] * 6, [(4, 7.7)] * 6))
    assert trace.duration == 60
    one, two = (len(render_page(Report(title="t", findings=(view_of(trace),) * count)).encode()) for count in (1, 2))
    assert two - one < 65_000


def test_positions_are_rounded_so_that_pages_stay_small():
    rng = np.random.default_rng(3)
    states = vehicle(np.cumsum(rng.uniform(1, 2, 90)), 4.0, speed=20.0)
    view = view_of(trace_of(states, states + 0.123456))
    assert all(len(str(value)) <= 8 for value in view.vehicles[1].along)


def test_every_kind_of_view_renders_whatever_it_holds():
    cells = {int: st.integers(1, 8)}

    @given(values_of(RunView, cells))
    @settings(max_examples=15)
    def check(finding):
        render_page(Report(title="t", findings=(finding,)))

    check()


def test_list_names_tests_only_for_several_tests():
    view = view_of(cut_in_trace())
    other = as_seen(view, finding={"id": "other", "test": "tests/test_b.py::test_other"})
    one, several = (render_page(Report(title="t", findings=views)) for views in ((view,), (view, other)))
    assert re.findall(r'<h3 id="group-\d">(\w+) <', several) == ["test_never_at_fault_in_a_collision", "test_other"]
    assert '<h3 id="group-' not in one
