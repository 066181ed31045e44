"""The summary of a CI job is short, and only this plugin's own text in it is markup."""

import re
from collections import Counter
from dataclasses import replace
from datetime import date

from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.verdict import Severity
from pytest_pafot.report.session import ADVICE
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


def test_findings_are_counted_and_listed_with_replay_command(snapshot):
    seen = [
        finding("c", "fixed", headline="", searched=40),
        finding("b", "still failing"),
        finding(),
    ]
    assert told(*seen, searches=[search(finds=(seen[2],))]) == snapshot


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
    assert "collision after 5.4 s; the reference also fails; " in text
    assert "; it became worse: it hits at 12.1 m/s instead of 8.0\n" in text


def test_job_summary_without_findings_has_two_lines(snapshot):
    assert told(searches=[search()]) == snapshot


def test_accepted_finding_comes_with_reason_and_last_day():
    text = told(
        finding(label="accepted", finding={"xfail": "issue 12", "xfail_until": date(2027, 1, 31)})
    )
    assert text.startswith(
        "### pafot: nothing new, 1 accepted\n\nNo search was requested.\n\n**Accepted for now**\n"
    )
    assert "collision after 5.4 s; accepted until 2027-01-31: issue 12\n" in text


def test_unsaved_finding_comes_with_its_search_command():
    text = told(finding(path="", detail="--pafot-save=none"), searches=[search()])
    again = "python -m pytest 'test_it.py::x[search]' --pafot-runs=40 --pafot-seed=5"
    assert f"  <br>not saved: --pafot-save=none; `{again}`\n" in text


def test_long_lists_are_cut():
    fixed = [finding(f"f{number}", "fixed", headline="") for number in range(MAX_LISTED + 5)]
    lines = told(*fixed).splitlines()
    assert sum(line.startswith("- `") for line in lines) == MAX_LISTED
    assert lines[-1] == "- ... and 5 more: see `python -m pytest_pafot corpus list`"
    assert lines[0] == f"### pafot: nothing new, {MAX_LISTED + 5} passed (not found again)"


def test_five_failures_of_all_lists_are_told_whole_and_the_others_counted(snapshot):
    new = [finding(str(number)) for number in range(3)]
    known = [finding(f"k{number}", "still failing") for number in range(4)]
    text = told(*new, *known, finding("c", "drifted"), page="report.html")
    assert text == snapshot
    assert text.count("\n- `") == 5


def test_a_failure_comes_with_its_sentences_and_the_decision(snapshot):
    sentences = ("NPC 0 braked at up to 8.0 m/s^2.", "The ego is responsible.")
    moment = Moment(time=4.2, npc=0, seen="9.9 m ahead", action="acceleration 0.3 m/s^2")
    assert (
        told(finding("a", sentences=sentences, moment=moment), finding("b", moment=moment))
        == snapshot
    )


def test_job_summary_says_how_many_random_scenarios_failed():
    one = search(random=Counter(runs=20, at_fault=1, otherwise=15, checks=14))
    other = replace(search(random=Counter(runs=19, at_fault=2)), node_id="y[search]")
    assert told(searches=[one, other]).splitlines()[3:] == ["18 of 39 random scenarios failed."]


def test_job_summary_reports_search_failures_and_problems(snapshot):
    reasons = {"test_it.py::x[search]": "the search tested too little: 40 runs, rejected"}
    results, left = dict.fromkeys(reasons, "failed"), ["c/t/x/a.yaml", "c/t/x/b.yaml"]
    more = {"warnings": ["a: over"], "problems": ["no space"], "left": left}
    text = told(searches=[search()], reasons=reasons, results=results, **more)
    assert text == snapshot
    assert f"- `c/t/x`: {plain(ADVICE)}\n" in text


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
