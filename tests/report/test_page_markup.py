"""The words of a page, as a whole text for a run made by hand.

The texts are in ``__snapshots__``. ``--snapshot-update`` rewrites them; read the differences before you commit them.
"""

import re
from dataclasses import replace

from pytest_pafot.campaign.events import Ending, SearchSummary
from pytest_pafot.campaign.verdict import collision_in_short
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.report.page import finding_article, finding_list, render_page, search_article
from pytest_pafot.report.page_data import Report
from pytest_pafot.report.views import finding_view
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import TEST, as_seen, finding_of, scenario, seen_of, view_of


def hand_made_trace():
    """Return a run in which the ego hits a braking NPC ahead after 3.5 s; a second NPC stays at the right."""
    ticks = 52
    npcs = vehicle(40.0, 4.0, speed=10.0, ticks=ticks), vehicle(0.0, 8.0, speed=20.0, ticks=ticks)
    return trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=ticks), *npcs, outcome=Outcome.COLLISION,
        scenario=scenario([(2, 10.0), (2, 8.0)], [(4, 20.0), (4, 20.0)]), arrivals=((30,), (None,)),
    )  # fmt: skip


def hand_made_finding():
    return replace(view_of(hand_made_trace()), yaml="test: '<its>' file\n")


def hand_made_search():
    return SearchSummary(
        node_id=f"{TEST}[search]",
        algorithm="pafot",
        seed=7,
        generations=2,
        asked=3,
        reason=Ending.MAX_TIME,
        runs=8,
        failing=1,
        known_runs=1,
        outcomes={"collision": 1, "safe": 7},
        responsibilities={"ego": 1, "none": 7},
        warnings=("few NPCs reached their cell",),
    )  # fmt: skip


def lines_of(markup):
    """Return HTML with a line for each block and each row of a table."""
    blocks = "article|section|header|nav|div|details|summary|h[1-6]|p|pre|ul|ol|li|dl|table|tr"
    return re.sub(rf">(?=<(?:{blocks})\b)", ">\n", markup)


def test_an_article_on_a_finding_reads_so(snapshot):
    assert lines_of(finding_article(hand_made_finding(), 0)) == snapshot


def test_conditions_stand_below_the_vehicle_that_they_are_about():
    groups = (("NPC 0", ("line 1: a < b  (a = 1) -> True", "line 2")), ("", ("line 3",)))
    finding = replace(hand_made_finding(), happened=(("The moment", "At 3 s.", groups),))
    article = finding_article(finding, 0)
    assert (
        "<h4>NPC 0</h4><ul><li><code>line 1: a &lt; b  (a = 1) \u2192 True</code></li><li><code>line 2</code></li></ul>"
        "<ul><li><code>line 3</code></li></ul>"
    ) in article


def test_article_on_unseen_finding_matches_its_snapshot(snapshot):
    finding = replace(
        as_seen(hand_made_finding(), path="corpus/a.pafot.yaml"), label="new", runs=3, instructions=(),
        happened=(), times=(), vehicles=(),
    )  # fmt: skip
    assert lines_of(finding_article(finding, 1)) == snapshot


def test_finding_list_of_two_tests_matches_its_snapshot(snapshot):
    finding = hand_made_finding()
    other = as_seen(finding, finding={"test": "tests/test_b.py::test_other"})
    other = replace(other, responsibility="npc", label="flaky")
    assert lines_of(finding_list([finding, other])) == snapshot


def test_the_list_has_the_findings_of_each_policy_under_its_test():
    names = ("t.py::test_a[late]", "t.py::test_a[early]", "t.py::test_b", "t.py::test_a[late]")
    listed = finding_list([as_seen(hand_made_finding(), finding={"test": name}) for name in names])
    headings = re.findall(r"<h([34])[^>]*>(.*?)</h|data-index=\"(\d)\"", listed)
    assert [" ".join(filter(None, each)) for each in headings] == [
        '3 test_a <span class="count">3</span>',
        *('4 late <span class="count">2</span>', "0", "3"),
        *('4 early <span class="count">1</span>', "1"),
        *('3 test_b <span class="count">1</span>', "2"),
    ]


def test_a_label_is_said_once_where_all_have_it():
    finding = hand_made_finding()
    known, new = (replace(finding, label=label) for label in ("still failing", "new"))
    other = replace(as_seen(new, finding={"test": "t.py::test_other"}))

    def said(*findings):
        listed = finding_list(findings)
        return re.findall(r"(?:class=\"(?:badge|count)\">|; )([^<]*(?:new|failing))<", listed)

    assert said(known) == ["still failing"]
    assert said(known, known) == ["all still failing"]
    assert said(known, new) == ["still failing", "new"]
    assert said(known, known, other) == ["2, still failing", "1, new"]
    assert said(new, other) == ["all new"]


@table("who", ["ego", "npc", "both", "none"])
def test_a_row_says_when_and_what(who):
    """Its mark says who, so the end of the headline is left out."""
    run = Run(hand_made_trace())
    run.__dict__["attribution"] = replace(run.attribution, responsibility=who)
    finding = replace(hand_made_finding(), headline=collision_in_short(run), responsibility=who)
    assert finding.headline.endswith(" at fault")
    assert '<span class="brief">3.5 s: NPC 0 ahead</span>' in finding_list([finding])
    safe = replace(finding, event=replace(finding.event, kind="safe"), headline="slow")
    assert '<span class="brief">slow</span>' in finding_list([safe])


def test_an_error_of_the_policy_is_the_egos():
    error = AdsError(kind="ValueError", message="no plan", traceback="", tick=30)
    trace = replace(hand_made_trace(), outcome=Outcome.ADS_ERROR, collision=None, error=error)
    view = finding_view(seen_of(trace, finding_of(trace), headline="ValueError: no plan"))
    assert view.headline == f"The ego's policy failed at {view.event.time:.1f} s: ValueError: no plan"
    listed = finding_list([view])
    assert "1 policy error" in listed
    assert "nobody" not in listed


def test_an_article_on_a_search_reads_so(snapshot):
    assert lines_of(search_article(hand_made_search(), 0)) == snapshot


def test_page_with_only_an_error_matches_its_snapshot(snapshot):
    report = Report(
        title="Nothing found",
        facts=(("base seed", "7"), ("pytest-pafot", "0.1.0")),
        command="pytest --pafot-seed=7",
        errors=(("tests/test_c.py::test_c[search]", "E   ValueError: no plan"),),
    )
    body = re.search('<article class="error".*(?=<script type)', render_page(report), re.DOTALL)[0]
    assert lines_of(body) == snapshot
