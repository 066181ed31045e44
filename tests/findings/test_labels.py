"""What was observed in a replay, and its label."""

from itertools import product
from typing import get_args

import pytest

from pytest_pafot.findings.sighting import GROUPS, Label, New, Observed, label
from tests.findings.builders import sighting
from tests.helpers.tables import table

PASSES, FAILS = {"is_handled": True}, {"fails": True, "is_same": True}


@table(("expected", "facts"), [
    ("error", {"is_error": True}),
    ("still failing", FAILS),
    ("still failing", FAILS | {"is_elsewhere": True, "reference_passes": True}),
    ("still failing", FAILS | {"reference_passes": False}),
    ("still failing", PASSES | {"elsewhere": "hit-2"}),  # the search of the session found it
    ("drifted", {}),
    ("drifted", {"fails": True}),
    ("drifted", {"searched": 40}),
    ("drifted", {"elsewhere": "hit-2"}),
    ("drifted", PASSES | {"is_elsewhere": True, "searched": 40}),
    ("drifted", PASSES | {"is_rare": True, "searched": 40}),
    ("drifted", PASSES | {"is_elsewhere": True, "reference_passes": True}),
    ("drifted", {"reference_passes": False}),
    ("accepted", FAILS | {"is_accepted": True}),
    ("accepted", {"fails": True, "is_accepted": True}),
    ("accepted", {"is_unsteady": True, "is_accepted": True}),  # it passes by chance
    ("passes", PASSES),
    ("passes", PASSES | {"is_accepted": True}),
    ("passes", PASSES | {"reference_passes": True}),
    # both drove the same scenario
    ("passes", PASSES | {"reference_passes": False, "is_elsewhere": True}),
    ("fixed", PASSES | {"searched": 40}),
    ("fixed", PASSES | {"searched": 40, "reference_passes": False, "is_rare": True}),
])  # fmt: skip
def test_each_label_follows_from_the_facts(expected, facts):
    assert label(Observed(**facts)) == expected


@pytest.mark.parametrize("others", list(product((False, True), repeat=3)))
def test_nothing_is_said_of_a_policy_that_drives_a_scenario_in_different_ways(others):
    names = ("fails", "is_same", "reference_passes")
    facts = dict(zip(names, others, strict=True))
    assert label(Observed(is_unsteady=True, is_handled=True, searched=40, **facts)) == "flaky"


def test_there_are_seven_labels_and_two_words_for_new_findings():
    assert {*GROUPS} - {*get_args(Label)} == {*get_args(New), *PASSED}
    assert {*get_args(Label)} - {*GROUPS} == {"fixed", "passes"}
    assert len(get_args(Label)) == 7


PASSED = "passed", "passed (found in another scenario)", "passed (not found again)"


@pytest.mark.parametrize(("result", "more"), [
    ("still failing", FAILS),
    (PASSED[0], PASSES),
    (PASSED[1], PASSES | {"elsewhere": "hit-2"}),
    (PASSED[2], PASSES | {"searched": 40}),
])  # fmt: skip
def test_summaries_call_no_pass_a_fix_and_no_pass_a_failure(result, more):
    assert sighting("a", label="drifted", **more).result == result
    assert result in GROUPS
