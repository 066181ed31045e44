"""What a page says of a session: the order of its findings, its facts, and the findings that it only lists."""

import re

from pytest_pafot.findings.verdict import Severity
from pytest_pafot.report.page import WHOLE, session_facts
from pytest_pafot.searches.options import BY_NAME
from tests.findings.builders import sighting
from tests.helpers.tables import table
from tests.report.builders import as_seen, page_of, real_page, real_views

RANKED = [
    ("new", "ego", 9, 12.0),
    ("new", "both", 2, 10.0),
    ("new", "ego", 9, 3.0),
    ("new", "npc", 1, 20.0),
    ("new", "ego", 9, None),
    ("new", "none", 4, None),
    ("still failing", "ego", 9, 30.0),
]
"""Findings: the label, responsibility, other runs that failed in the same way, and closing speed."""


def seen(place, label, responsible, repeats, closing):
    severity = None if closing is None else Severity(kind="collision", value=closing, unit="m/s")
    return sighting(
        f"a{place}", label=label, responsible=responsible, repeats=repeats, severity=severity
    )


@table("order", [1, -1])
def test_findings_are_sorted_by_novelty_fault_and_severity(order):
    found = [seen(place, *each) for place, each in enumerate(RANKED)]
    assert sorted(found[::order], key=lambda each: (each.label != "new", *each.rank)) == found


def test_findings_of_each_test_are_together_under_its_name_the_worst_test_first():
    named = (("b[x]", "one"), ("a", "two"), ("b[x]", "other"))
    views = [
        as_seen(real_views()[0], finding={"test": test, "id": "1"}, node_id=node_id)
        for test, node_id in named
    ]
    listed = page_of(*views).partition("</nav>")[0]
    shown = re.findall(r'<h3>.*?</h3>|(?<=data-key=").*?(?=")', listed)
    assert shown == ["<h3>b[x]</h3>", "1", "1-2", "<h3>a</h3>", "1-3"]


def test_facts_include_replay_labels_and_versions():
    facts = dict(session_facts([], [sighting("t", label="fixed")]))
    expected = {
        "pytest-pafot",
        "highway-env",
        "numpy",
        "written",
        "replayed",
        "passed (not found again)",
    }
    assert expected <= set(facts)
    assert "base seed" not in facts


def test_further_finding_has_what_it_is_and_its_command(monkeypatch):
    monkeypatch.setattr("pytest_pafot.report.page.WHOLE", 2)
    given = {"headline": "hit <b>", "path": "a b.pafot.yaml"}
    further = as_seen(real_views()[0], finding={"id": "z1"}, **given)
    shown = page_of(*real_views(), further, failures={("t.py::t", "setup"): "x"})
    again = "python -m pytest &#x27;a b.pafot.yaml&#x27;"
    assert "<b>z1</b> hit &lt;b&gt;" in shown
    assert f"<code>{again}</code>" in shown
    assert shown.count("<article id=") == 2
    assert f" {WHOLE} " in BY_NAME["report"].details
    assert "<b>z1</b>" not in real_page()
