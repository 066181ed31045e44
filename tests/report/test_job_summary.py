"""The summary of a CI job is short, and only this plugin's own text in it is markup."""

import re
from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.findings.verdict import Severity
from pytest_pafot.report.session_record import MAX_LISTED, markdown
from pytest_pafot.searches.events import Ending, Search
from pytest_pafot.support.text import code, plain
from tests.findings.builders import sighting
from tests.helpers.hostile import CHARACTERS
from tests.helpers.tables import table
from tests.report.builders import session_of


def finding(id_="a", label="new", finding=None, **changes):
    known = {
        "headline": "collision after 5.4 s",
        "path": f"corpus/{id_}.pafot.yaml",
        "label": label,
    }
    known["node_id"] = f"test_it.py::x[saved-{id_}]"
    return sighting(id_, finding={"test": "test_it.py::x"} | (finding or {}), **known | changes)


def search(runs=40, **changes):
    known = {
        "reason": Ending.RUNS,
        "kinds": Counter(passed=runs),
        "asked": {"runs": 40},
        "base_seed": 5,
    }
    return Search(node_id="test_it.py::x[search]", **known | changes)


def told(*seen, page="", **more):
    """Return the summary of a session with these findings."""
    return markdown(session_of(seen=seen, **more), page=page)


def test_unrelated_session_has_no_job_summary():
    assert told(exit=1) == ""


def hits(speed):
    return Severity(kind="collision", value=speed, unit="m/s")


def test_worst_finding_comes_first_in_each_group():
    jerk = Severity(kind="check", value=15.1, unit="m/s^3", margin=-0.755, name="jerk")
    findings = [
        finding("a", severity=jerk, responsible="ego"),
        finding("b", severity=hits(3.0), responsible="both"),
        finding("c"),
        finding("d", severity=hits(30.0), responsible="npc"),
        finding("e", severity=hits(9.8), responsible="ego"),
        finding(
            "f", "still failing", severity=hits(12.1), before=hits(8.0), reference_passes=False
        ),
    ]
    for some, order in (([*findings[:4], *findings[5:]], "bdacf"), (findings[1:], "ebdcf")):
        text = told(*some)
        assert "".join(re.findall(r"corpus/(\w)\.pafot", text)) == order


def test_long_lists_are_cut():
    fixed = [finding(f"f{number}", "fixed", headline="") for number in range(MAX_LISTED + 5)]
    *lines, last = told(*fixed).splitlines()
    assert sum(line.startswith("- `") for line in lines) == MAX_LISTED
    assert last.startswith("- ... and 5 more: ")


def test_five_failures_of_all_lists_are_told_whole():
    new = [finding(str(number)) for number in range(3)]
    known = [finding(f"k{number}", "still failing") for number in range(4)]
    text = told(*new, *known, finding("c", "drifted"), page="report.html")
    assert text.count("\n- `") == 5
    assert told(searches=[search()]).count("\n") == 3


@table(("text", "expected"), [
    ("a *b* _c_ `d`", r"a \*b\* \_c\_ \`d\`"),
    ("[x](javascript:y) ![z](q)", r"\[x\](javascript:y) \!\[z\](q)"),
    ("<img src=x onerror=y>&amp;", "&lt;img src=x onerror=y&gt;&amp;amp;"),
    ("a | b\n# c\x1b[31m", r"a \| b\\n\# c\\x1b\[31m"),
    ("- a", r"\- a"),
    ("+", r"\+"),
    ("---", r"\---"),
    ("12. a", r"12\. a"),
    ("$x$ @me :tada:", r"<span>$</span>x<span>$</span> @&#8203;me :&#8203;tada:"),
    ("#12 gh-12", r"\#&#8203;12 gh-&#8203;12"),
    ("https://a.b www.c.d", r"https\://a.b www\.c.d"),
])  # fmt: skip
def test_texts_of_others_are_no_markup(text, expected):
    assert plain(text) == expected


@table(("text", "expected"), [("a", "`a`"), ("a`b", "``a`b``"), ("`", "`` ` ``"), ("", "` `")])
def test_code_is_fenced_by_enough_backticks(text, expected):
    assert code(text) == expected


@given(st.text(CHARACTERS, max_size=400))
def test_no_text_ends_its_line_or_opens_tag(text):
    for shown in (plain(text), code(text)):
        assert len(shown.splitlines()) <= 1
    # the one tag, which keeps $ from math
    assert not re.search("[<>]", plain(text).replace("<span>$</span>", ""))
    fence = re.match("`+", code(text))[0]
    assert code(text).count(fence) == 2
