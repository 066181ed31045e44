"""A session's result for programs: its fields, its text and back."""

import json
import re
from collections import Counter
from dataclasses import asdict, fields, replace
from datetime import date

from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.findings.finding import FailureRate
from pytest_pafot.findings.sighting import Alike
from pytest_pafot.findings.verdict import Severity
from pytest_pafot.oracle.run import Run
from pytest_pafot.report.page import finding_article
from pytest_pafot.report.session import Session
from pytest_pafot.report.session_record import FINDING, NOT_WRITTEN, finding_entry, to_text
from pytest_pafot.report.terminal import add_event
from pytest_pafot.searches.events import Search
from pytest_pafot.world import Highway
from tests.findings.builders import findings, plain_finding, sighting
from tests.helpers.hostile import CHARACTERS
from tests.helpers.sessions import read_record
from tests.helpers.tables import table
from tests.report.builders import as_seen, view_of

TEXTS = st.text(CHARACTERS, max_size=20)
COUNTS = st.dictionaries(TEXTS, st.integers(0, 9), max_size=3)
SEARCHES = st.builds(
    Search,
    node_id=TEXTS,
    seed=st.integers(0, 2**63),
    known=COUNTS,
    kinds=COUNTS.map(Counter),
    reached=st.none() | st.floats(0, 1),
    warnings=st.lists(TEXTS, max_size=2).map(tuple),
)


@given(SEARCHES, findings(), TEXTS, TEXTS)
def test_every_record_is_read_as_it_was_written(search, finding, warning, problem):
    session = Session(exit=1, warnings=[warning], problems=[problem])
    add_event(session, replace(search, finds=(sighting("a"), sighting("A_b.c-d"))))
    add_event(session, replace(sighting(node_id="test_it.py::x"), finding=finding))
    record = read_record(to_text(session, root="/nowhere", day="2027-01-31"))
    assert (record.exit, record.day) == (1, "2027-01-31")
    assert (record.warnings, record.problems) == ([warning], [problem])
    (told,) = record.searches
    assert (told.node_id, told.seed, told.reached) == (search.node_id, search.seed, search.reached)
    expected = search.kinds, search.known, list(search.warnings)
    assert (told.kinds, told.known, told.warnings) == expected
    assert (told.finds, told.runs) == (["a", "A_b.c-d"], search.runs)
    assert [each.signature for each in record.findings] == [finding.signature.told]


def test_finding_names_the_traffic_it_was_driven_in():
    scenario = replace(plain_finding().scenario, traffic="everyday")
    finding = plain_finding(scenario=scenario)
    told = finding_entry(sighting(finding={"scenario": scenario}))["traffic"]
    assert "everyday" in told
    assert finding_entry(sighting())["traffic"] == ""
    trace = Highway(duration=1.0).rollout(scenario, lambda: lambda observation: (0.0, 0.0))
    for view in (view_of(None, finding), view_of(trace)):
        assert f"<li>{told}</li>" in finding_article(view, 0)
    assert Run(trace).explain().endswith(f", scenario seed 7, {told}")


def test_keys_are_sorted_and_include_the_version():
    session = Session(exit=1)
    add_event(session, Search(node_id="a"))
    text = to_text(session, root="")
    plain = json.loads(text)
    assert plain["pafot_json"] == 5
    assert text == json.dumps(plain, indent=2, sort_keys=True) + "\n"


def test_a_finding_tells_what_its_file_does():
    seen = sighting(
        finding={"xfail": "issue 12", "xfail_until": date(2027, 1, 31)},
        label="fixed",
        path="a b.yaml",
    )
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
    entry = finding_entry(
        sighting(finding={"rate": then, "flaky": "it differs"}, label="drifted", rate=now)
    )
    expected = {"failing": 7, "runs": 10, "of": "runs", "now": {"failing": 2, "runs": 10}}
    assert entry["rate"] == expected
    assert finding_entry(sighting())["rate"] is None


def test_of_a_file_that_cannot_be_read_an_entry_has_all_keys():
    entry = finding_entry(None, node_id="a", detail="not YAML")
    assert (entry.keys(), entry["status"], entry["detail"]) == (FINDING.keys(), "error", "not YAML")
    entry["sentences"].append("x")
    assert finding_entry(None)["sentences"] == []


def test_no_duration_is_in_it():
    def text(seconds):
        session = Session()
        add_event(session, Search(node_id="a", seconds=seconds, process_notes=(f"{seconds}",)))
        return to_text(session, root="")

    assert text(1.0) == text(2.0)


@table(("thing", "names"), [
    (Search, {each.name for each in fields(Search)} - {*NOT_WRITTEN}), (finding_entry, FINDING.keys()),
])  # fmt: skip
def test_every_key_is_described_in_a_docstring(thing, names):
    told = re.findall(r"^ +(\w+(?:, \w+)*): ", thing.__doc__, re.MULTILINE)
    assert sorted(name for names in told for name in names.split(", ")) == sorted(names)


def test_a_finding_tells_of_the_worst_run_that_failed_like_it():
    own, worse = (Severity(kind="collision", value=speed, unit="m/s") for speed in (3.0, 14.2))
    seen = sighting(severity=own, alike=Alike(runs=11, number=87, severity=worse))
    assert "14.2 m/s" in seen.worst
    assert replace(seen, alike=Alike(runs=11, number=3, severity=own)).worst == ""
    assert finding_entry(seen)["worst"] == {"number": 87, "severity": asdict(worse)}
    assert "3.0 to 14.2 m/s" in seen.impacts
    view = as_seen(view_of(None, plain_finding()), observed=seen.observed, alike=seen.alike)
    assert f"<li>{seen.worst}</li>" in finding_article(view, 0)
