"""A session's result for programs: its fields, its text and back."""

import json
import re
from dataclasses import fields, replace
from datetime import date

from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.campaign.events import SearchSummary
from pytest_pafot.findings.failure_rate import FailureRate
from pytest_pafot.findings.sighting import Sighting
from pytest_pafot.oracle.run import Run
from pytest_pafot.plugin.failure_reports import SCENARIO
from pytest_pafot.report.page import finding_article
from pytest_pafot.report.session_record import (
    FINDING,
    NOT_WRITTEN,
    RESULTS,
    SessionRecord,
    finding_entry,
    to_text,
    worst,
)
from pytest_pafot.world import Highway
from tests.findings.builders import findings, plain_finding, sighting
from tests.helpers.hostile import CHARACTERS
from tests.helpers.sessions import read_record
from tests.helpers.tables import table
from tests.report.builders import view_of

TEXTS = st.text(CHARACTERS, max_size=20)
COUNTS = st.dictionaries(TEXTS, st.integers(0, 9), max_size=3)
SUMMARIES = st.builds(
    SearchSummary,
    node_id=TEXTS,
    seed=st.integers(0, 2**63),
    finds=st.lists(
        st.builds(Sighting, finding=st.sampled_from([plain_finding(), plain_finding(id="A_b.c-d")]), node_id=TEXTS),
        max_size=2,
    ).map(tuple),  # of these, a summary has the id
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
        findings().map(lambda each: finding_entry(Sighting(finding=each, node_id="test_it.py::x"))), max_size=1
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
            seconds=0.0,
            process_notes=(),
        )
        for search in record.searches
    ]
    assert read_record(to_text(record)) == replace(record, searches=searches)


def test_finding_names_the_traffic_it_was_driven_in():
    scenario = replace(plain_finding().scenario, traffic="everyday")
    told, finding = "everyday traffic (as most drivers drive)", plain_finding(scenario=scenario)
    assert finding_entry(sighting(finding={"scenario": scenario}))["traffic"] == told
    assert finding_entry(sighting())["traffic"] == ""
    view = view_of(None, finding)
    assert f"<li>{told}</li>" in finding_article(view, 0)
    trace = Highway(duration=1.0).rollout(scenario, lambda: lambda observation: (0.0, 0.0))
    explanation = Run(trace).explain()
    assert explanation.endswith(f", repair seed 7, {told}")
    assert SCENARIO.fullmatch(f"E   {explanation.splitlines()[-1]}")
    assert f"<li>{told}</li>" in finding_article(view_of(trace), 0)


def test_keys_are_sorted_and_include_the_version():
    text = to_text(SessionRecord(searches=[SearchSummary(node_id="a")], exit=1))
    plain = json.loads(text)
    assert plain["pafot_json"] == 2
    assert text == json.dumps(plain, indent=2, sort_keys=True) + "\n"


def test_a_finding_tells_what_its_file_does():
    seen = sighting(finding={"xfail": "issue 12", "xfail_until": date(2027, 1, 31)}, label="fixed", path="a b.yaml")
    entry, expect = finding_entry(seen), seen.finding.expect
    assert (entry["id"], entry["test"], entry["time"]) == (seen.id, seen.finding.test, expect.time)
    assert (entry["outcome"], entry["responsible"]) == ("collision", "ego")
    assert (entry["kind"], entry["file"]) == (seen.finding.signature.slug, "a b.yaml")
    assert entry["xfail"] == {"reason": "issue 12", "until": "2027-01-31"}
    assert finding_entry(sighting())["xfail"] is None


def test_a_finding_tells_how_often_it_fails_then_and_now():
    then, now = FailureRate(failing=7), FailureRate(failing=2)
    entry = finding_entry(sighting(finding={"rate": then}))
    assert entry["rate"] == {"failing": 7, "runs": 10, "of": "seeds", "now": None}
    entry = finding_entry(sighting(finding={"rate": then, "flaky": "it differs"}, label="drifted", rate=now))
    assert entry["rate"] == {"failing": 7, "runs": 10, "of": "runs", "now": {"failing": 2, "runs": 10}}
    assert finding_entry(sighting())["rate"] is None


def test_of_a_file_that_cannot_be_read_an_entry_has_all_keys():
    entry = finding_entry(None, node_id="a", detail="not YAML")
    assert (entry.keys(), entry["status"], entry["detail"]) == (FINDING.keys(), "error", "not YAML")
    entry["sentences"].append("x")
    assert finding_entry(None)["sentences"] == []


def test_no_duration_is_in_it():
    slow, fast = (SearchSummary(node_id="a", seconds=each, process_notes=(f"{each}",)) for each in (1.0, 2.0))
    assert to_text(SessionRecord(searches=[slow])) == to_text(SessionRecord(searches=[fast]))


@table("kind", [SessionRecord, SearchSummary])
def test_every_record_field_is_described_in_its_docstring(kind):
    told = re.findall(r"^ +(\w+(?:, \w+)*): ", kind.__doc__, re.MULTILINE)
    told = [name for names in told for name in names.split(", ")]
    assert told == [each.name for each in fields(kind) if each.name not in NOT_WRITTEN]


def test_the_worst_phase_of_an_item_counts():
    assert worst(["passed", "failed", "passed"]) == "failed"
    assert worst(["passed", "xfailed", "error"]) == "error"
    assert worst([]) == RESULTS[0]
