"""A session's result for programs: its fields, its text and back."""

import json
import re
from dataclasses import fields, replace
from datetime import date

from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.campaign.events import Find, SearchSummary
from pytest_pafot.findings.failure_rate import FailureRate
from pytest_pafot.model.driving_style import Traffic
from pytest_pafot.oracle.run import Run
from pytest_pafot.plugin.failure_reports import SCENARIO
from pytest_pafot.report.page import finding_article
from pytest_pafot.report.session_record import (
    RESULTS,
    TERMINAL_ONLY,
    FindingRecord,
    SessionRecord,
    to_text,
    worst,
)
from pytest_pafot.report.views import finding_view, run_view
from pytest_pafot.world import Highway
from tests.findings.builders import findings, plain_finding
from tests.helpers.hostile import CHARACTERS
from tests.helpers.sessions import read_record
from tests.helpers.tables import table

TEXTS = st.text(CHARACTERS, max_size=20)
FIND = Find(id="a", node_id="test_it.py::x")
COUNTS = st.dictionaries(TEXTS, st.integers(0, 9), max_size=3)
SUMMARIES = st.builds(
    SearchSummary,
    node_id=TEXTS,
    seed=st.integers(0, 2**63),
    finds=st.lists(st.builds(Find, id=TEXTS, node_id=TEXTS, headline=TEXTS), max_size=2).map(tuple),
    unsaved=COUNTS,
    known=COUNTS,
    reached=st.none() | st.floats(0, 1),
    warnings=st.lists(TEXTS, max_size=2).map(tuple),
)
RECORDS = st.builds(
    SessionRecord,
    exit=st.none() | st.integers(0, 5),
    versions=st.dictionaries(TEXTS, TEXTS, max_size=2),
    searches=st.lists(SUMMARIES, max_size=2),
    findings=st.lists(
        findings().map(lambda each: FindingRecord.of(each, FIND)),
        max_size=1,
    ),
    warnings=st.lists(TEXTS, max_size=1),
    problems=st.lists(TEXTS, max_size=1),
)


@given(RECORDS)
def test_every_record_is_read_as_it_was_written(record):
    searches = [
        replace(
            search,
            finds=[find.id for find in search.finds],
            warnings=list(search.warnings),
            notes=list(search.notes),
            requirements=list(search.requirements),
            seconds=0.0,
            process_notes=(),
        )
        for search in record.searches
    ]
    assert read_record(to_text(record)) == replace(record, searches=searches)


def test_finding_names_the_traffic_it_was_driven_in():
    scenario = replace(plain_finding().scenario, traffic=Traffic("everyday", least_gap=4))
    told, finding = "everyday traffic (least_gap 4)", plain_finding(scenario=scenario)
    assert FindingRecord.of(finding, FIND).traffic == told
    assert FindingRecord.of(plain_finding(), FIND).traffic == ""
    view = finding_view(None, finding, node_id="x")
    assert f"<li>{told}</li>" in finding_article(view, 0)
    trace = Highway(duration=1.0).rollout(scenario, lambda: lambda observation: (0.0, 0.0))
    explanation = Run(trace).explain()
    assert explanation.endswith(f", repair seed 7, {told}")
    assert SCENARIO.fullmatch(f"E   {explanation.splitlines()[-1]}")
    assert f"<li>{told}</li>" in finding_article(run_view(trace), 0)


def test_keys_are_sorted_and_include_the_version():
    text = to_text(SessionRecord(searches=[SearchSummary(node_id="a")], exit=1))
    plain = json.loads(text)
    assert plain["pafot_json"] == 1
    assert text == json.dumps(plain, indent=2, sort_keys=True) + "\n"


def test_a_finding_tells_what_its_file_does():
    finding = plain_finding(xfail="issue 12", xfail_until=date(2027, 1, 31))
    record = FindingRecord.of(finding, Find(id="a", node_id="x", label="fixed", path="a b.pafot.yaml"))
    expect = finding.expect
    assert (record.id, record.test, record.time) == (finding.id, finding.test, expect.time)
    assert (record.outcome, record.responsible, record.kind) == ("collision", "ego", finding.signature.slug)
    assert record.xfail == {"reason": "issue 12", "until": "2027-01-31", "flaky": False}
    assert FindingRecord.of(plain_finding(), FIND).xfail is None


def test_a_finding_tells_how_often_it_fails_then_and_now():
    finding, now = plain_finding(rate=FailureRate(failing=14, runs=20)), FailureRate(failing=2, runs=20)
    assert FindingRecord.of(finding, FIND).rate == {"failing": 14, "runs": 20, "of": "seeds", "now": None}
    record = FindingRecord.of(replace(finding, flaky="it differs"), replace(FIND, rate_now=now))
    changed = {"failing": 2, "runs": 20, "change": "better"}
    assert record.rate == {"failing": 14, "runs": 20, "of": "runs", "now": changed}
    assert FindingRecord.of(plain_finding(), FIND).rate is None


def test_no_duration_is_in_it():
    slow, fast = (SearchSummary(node_id="a", seconds=each, process_notes=(f"{each}",)) for each in (1.0, 2.0))
    assert to_text(SessionRecord(searches=[slow])) == to_text(SessionRecord(searches=[fast]))


@table("kind", [SessionRecord, SearchSummary, FindingRecord])
def test_every_record_field_is_described_in_its_docstring(kind):
    told = re.findall(r"^ +(\w+(?:, \w+)*): ", kind.__doc__, re.MULTILINE)
    told = [name for names in told for name in names.split(", ")]
    assert told == [each.name for each in fields(kind) if each.name not in TERMINAL_ONLY]


def test_the_worst_phase_of_an_item_counts():
    assert worst(["passed", "failed", "passed"]) == "failed"
    assert worst(["passed", "xfailed", "error"]) == "error"
    assert worst([]) == RESULTS[0]
