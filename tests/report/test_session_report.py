"""The report of a session: its order, from any order of events, and its files."""

import re
from dataclasses import replace

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.findings.severity import Severity
from pytest_pafot.report.page import WHOLE, Draft, render_page
from pytest_pafot.report.page_data import Report
from tests.findings.builders import sighting
from tests.helpers.tables import table
from tests.report.builders import as_seen, real_report

RANKED = [
    ("b1", "new", "ego", 9, 12.0),
    ("b2", "still failing", "ego", 9, 30.0),  # known, but its test comes first
    ("a1", "new (flaky: the outcome)", "both", 2, 10.0),
    ("a2", "new", "ego", 9, 3.0),
    ("a4", "new", "npc", 1, 20.0),
    ("a5", "new", "ego", 9, None),
    ("a6", "new", "nobody can tell", 4, None),
    ("a7", "still failing", "ego", 9, 30.0),
]
"""Findings: a name, whose first letter is the test's, the label, responsibility, runs and closing speed."""


def shown(name="a1", label="new", responsibility="ego", runs=1, closing=None, **seen):
    severity = None if closing is None else Severity(kind="collision", value=closing, unit="m/s")
    finding = as_seen(real_report().findings[0], finding={"test": name[0]}, node_id=name, severity=severity, **seen)
    return replace(finding, label=label, responsibility=responsibility, runs=runs)


def report_of(draft, findings=(), *, errors=(), **more):
    given = {"project": "highway", "command": "pytest", "is_interrupted": False} | more
    return draft.report(findings=findings, errors=errors, **given)


@table("told", [RANKED, RANKED[::-1], RANKED[3:] + RANKED[:3]])
def test_findings_are_sorted_by_novelty_fault_and_severity(told):
    report = report_of(Draft(target="x"), [shown(*each) for each in told])
    assert [finding.node_id for finding in report.findings] == [name for name, *_ in RANKED]


def test_facts_include_replay_labels_and_versions():
    replays = [sighting(f"t{number}", label=label) for number, label in enumerate(("fixed", "still failing", "fixed"))]
    facts = dict(report_of(Draft(target="x"), replays=replays).facts)
    assert facts["replayed"] == "3 saved scenarios: 2 passes, 1 still failing"
    assert {"pytest-pafot", "highway-env", "numpy", "written"} <= set(facts)
    assert "base seed" not in facts


@table(
    ("count", "errors", "title"),
    [
        (0, (), "highway: 0 findings"),
        (1, (), "highway: 1 finding"),
        (2, (("test_it.py::test_a", "a fault"),), "highway: 1 error, 2 findings"),
    ],
)
def test_the_title_counts_errors_first(count, errors, title):
    findings = [shown(f"a{number}") for number in range(count)]
    assert report_of(Draft(target="x"), findings, errors=errors).title == title


MANY = [shown(f"{'ab'[number % 2]}{number}", closing=float(number % 37)) for number in range(WHOLE + 7)]


def test_worst_findings_are_whole_and_all_others_rows():
    draft = Draft(target="x")
    for each in MANY:
        draft.take(finding=each)
    report = report_of(draft, draft.findings.values())
    assert len(report.findings) == WHOLE
    assert {each.node_id for each in (*report.findings, *report.further)} == {each.node_id for each in MANY}
    whole, rows = ([each.sighting.severity.value for each in part] for part in (report.findings, report.further))
    assert min(whole) >= max(rows)
    by_id = {each.node_id: each for each in MANY}
    assert all(each == by_id[each.node_id] for each in report.findings)
    assert all(each.sighting is by_id[each.node_id].sighting for each in (*report.findings, *report.further))
    assert report.title == f"highway: {WHOLE + 7} findings"
    assert f"the worst {WHOLE} are whole" in BY_NAME["report"].details


def test_row_has_what_file_and_command_of_its_finding():
    finding = shown("a1", closing=3.0)
    row = shown("a1", closing=3.0, path="pafot_corpus/a1.yaml")
    row = replace(row, headline="hit <b>", deadline="brake by 2.0 s", command="pytest 'a b.py::t'", vehicles=())
    page = render_page(Report(title="t", findings=(finding,), further=(row,)))
    (section,) = re.findall('<section[^>]* id="further".*?</section>', page, re.DOTALL)
    assert "1 further finding" in section
    assert "the 1 worst findings whole" in section
    assert "<p>hit &lt;b&gt;; brake by 2.0 s</p>" in section
    assert ", pafot_corpus/a1.yaml</p>" in section
    assert "at fault" not in section  # the headline says it
    assert "<code>pytest &#x27;a b.py::t&#x27; --pafot-report=one.html</code>" in section
    assert page.count('href="#further"') == 1
    assert (
        "further"
        not in render_page(Report(title="t", findings=(finding,))).partition("<body>")[2].partition("<script")[0]
    )


def test_whole_finding_has_the_runs_and_label_of_the_end():
    draft = Draft(target="x")
    draft.take(finding=shown(runs=1))
    (stored,) = draft.findings.values()
    (finding,) = report_of(draft, [replace(stored, runs=8, label="flaky")]).findings
    assert finding == shown(runs=8, label="flaky")
