import math
import pickle
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot.oracle.run import Check, CheckFailed, Recording, recorded
from tests.helpers.tables import table

JERK = np.array([0.0, 3.0, -1.0, 35.1, 12.0])


def made(value, *, hz=2, ticks=4, **bounds):
    """Return the only check of a run, whether it holds or not."""
    recording = Recording(hz=hz, ticks=ticks)
    with recorded(recording), suppress(CheckFailed):
        pafot.check(value, name="jerk", **bounds)
    return recording.checks[0]


CHECKS = {
    "a bound and a time": (JERK, {"at_most": 20, "unit": "m/s^3"}),
    "an NPC": (0.3, {"at_least": 0.5, "unit": "s", "at": 4.2, "npc": 1}),
    "a bound that holds": (0.7, {"at_least": 0.5, "unit": "s"}),
    "two bounds": (12.0, {"at_least": 0.5, "at_most": 10.0}),
    "a value near its lower bound": (0.2963, {"at_least": 0.3}),
    "a value near its upper bound": (20.04, {"at_most": 20.0}),
    "the bound itself": (20.0, {"at_most": 20.0}),
    "a longer bound": (20.04, {"at_most": 20.03}),
    "hundredths": (5.56, {"at_least": 5.57}),
    "no number": (np.array([1.0, math.nan]), {"at_most": 20.0}),
}


def test_broken_bound_has_value_and_time():
    with recorded(Recording(hz=2, ticks=4)), pytest.raises(CheckFailed) as failed:
        pafot.check(JERK, name="jerk", at_most=20, unit="m/s^3")
    check = failed.value.check
    assert (check.value, check.time, check.npc) == (35.1, 1.5, None)
    assert isinstance(failed.value, AssertionError)
    held = [made(value, **bounds).holds for value, bounds in CHECKS.values()]
    assert held == [False, False, True, False, False, False, True, False, False, False]


def test_margin_is_in_units_of_bound_or_scale():
    assert made(15.0, at_most=20.0).margin == 0.25
    assert made(15.0, at_most=20.0, scale=5.0).margin == 1.0
    assert made(15.0, at_least=20.0).margin == -0.25
    assert made(3.0, at_most=0.0).margin == -3.0
    assert made(15.0, at_least=10.0, at_most=20.0).margin == 0.25


def test_without_a_recording_it_only_asserts():
    pafot.check(1.0, name="x", at_most=2.0)
    with pytest.raises(CheckFailed):
        pafot.check(3.0, name="x", at_most=2.0)


def test_array_of_different_length_has_no_time():
    assert made(JERK[2:], at_most=20.0).time is None
    assert made(JERK[2:], at_most=20.0, at=9.0).time == 9.0


numbers = st.integers(-99, 99)


@given(st.lists(numbers, min_size=1, max_size=9), numbers, st.sampled_from(["at_most", "at_least"]))
def test_check_holds_exactly_if_worst_value_does(values, bound, side):
    check = made(np.array(values), **{side: bound})
    worst = max(values) if side == "at_most" else min(values)
    assert check.holds == (worst <= bound if side == "at_most" else worst >= bound)
    assert check.value == worst
    margin = abs(check.margin) * (abs(bound) or 1.0)
    assert math.isclose(margin, abs(worst - bound), rel_tol=1e-9, abs_tol=1e-9)


def test_nan_fails_and_infinity_is_beyond_any_bound():
    check = made(np.array([1.0, math.nan]), at_most=20.0)
    assert (check.holds, check.margin) == (False, -math.inf)
    assert made(math.inf, at_least=1.0).holds
    assert not made(math.inf, at_most=1.0).holds


def test_a_failure_travels_between_processes():
    check = Check(name="jerk", value=35.1, margin=-0.755, at_most=20.0, values=JERK)
    assert pickle.loads(pickle.dumps(CheckFailed(check))).check == check


IMPOSSIBLE = {
    "no bound": (1.0, {}),
    "a text": ("fast", {"at_most": 1.0}),
    "a value for each NPC": (np.zeros((2, 3)), {"at_most": 1.0}),
    "no value": (np.array([]), {"at_most": 1.0}),
    "no number as a bound": (1.0, {"at_most": math.nan}),
    "a truth value as a bound": (1.0, {"at_most": True}),
    "no scale": (1.0, {"at_most": 1.0, "scale": 0.0}),
    "a huge number": (10**400, {"at_most": 1.0}),
    "half an NPC": (1.0, {"at_most": 2.0, "npc": 1.0}),
    "a negative NPC": (1.0, {"at_most": 2.0, "npc": -2}),
    "a time before the start": (1.0, {"at_most": 2.0, "at": -1.0}),
    "a unit of two lines": (1.0, {"at_most": 2.0, "unit": "m\n"}),
    **{f"the name {name!r:.5}": (1.0, {"at_most": 2.0, "name": name}) for name in ("", " ", "a\nb", "x" * 61, None)},
}  # fmt: skip


def check(value, arguments):
    pafot.check(value, **{"name": "jerk", **arguments})


@table(("value", "arguments"), IMPOSSIBLE.values())
def test_a_check_that_cannot_be_made_is_refused(value, arguments):
    with pytest.raises(ValueError, match=r"^(check 'jerk'|name):"):
        check(value, arguments)


def check_npc_beyond():
    with recorded(Recording(hz=2, ticks=4, npcs=1)):
        pafot.check(1.0, name="gap", at_most=2.0, npc=1)


def test_npc_index_may_come_from_an_array():
    leader = np.array([1, -1])
    assert type(made(1.0, at_most=2.0, npc=leader[0]).npc) is int
    assert made(1.0, at_most=2.0, npc=leader[1]).npc is None
    with pytest.raises(ValueError, match=r"^check 'gap':"):
        check_npc_beyond()


def test_only_a_check_makes_a_failed_one():
    with pytest.raises(TypeError):
        CheckFailed("slow")
