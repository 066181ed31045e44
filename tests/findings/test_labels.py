"""What was observed in a replay, and its label."""

from itertools import product

import pytest

from pytest_pafot.findings.labels import Label, Observed
from tests.helpers.tables import table

PASSES, FAILS = {"shows": Label.FIXED}, {"shows": Label.STILL_FAILING, "fails": True}


@table(
    ("label", "facts"),
    [
        ("fixed", PASSES),
        ("drifted", PASSES | {"is_elsewhere": True}),
        ("drifted", PASSES | {"is_hit": True}),
        ("drifted", PASSES | {"is_rare": True}),
        ("drifted", {"shows": "drifted"}),
        (Label.JUDGED_OTHERWISE, {"shows": Label.JUDGED_OTHERWISE}),
        ("still failing", FAILS),
        ("drifted", {"shows": "drifted", "fails": True}),
        # Beside a reference, a pass is new only if the reference fails.
        ("fixed before", PASSES | {"reference_passes": True}),
        ("drifted", PASSES | {"is_hit": True, "reference_passes": True}),
        ("drifted", {"shows": "drifted", "reference_passes": True}),
        (Label.JUDGED_OTHERWISE, {"shows": Label.JUDGED_OTHERWISE, "reference_passes": True}),
        ("fixed", PASSES | {"is_elsewhere": True, "reference_passes": False}),
        ("fixed", {"shows": "drifted", "reference_passes": False}),
        ("drifted", {"shows": "drifted", "reference_passes": False, "is_handled": False}),
        ("drifted", PASSES | {"reference_passes": False, "is_hit": True}),
        ("introduced", FAILS | {"reference_passes": True}),
        ("introduced", {"shows": "drifted", "fails": True, "reference_passes": True}),
        (Label.COMMON, FAILS | {"reference_passes": False}),
    ],
)
def test_each_label_follows_from_the_facts(label, facts):
    assert Observed(**facts).label == label


@pytest.mark.parametrize("others", list(product((False, True), repeat=3)))
def test_nothing_is_said_of_a_policy_that_drives_a_scenario_in_different_ways(others):
    names = ("fails", "is_hit", "reference_passes")
    assert Observed(shows=Label.FIXED, is_unsteady=True, **dict(zip(names, others, strict=True))).label == Label.FLAKY
