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


def test_broken_bound_message_has_value_unit_and_time():
    with recorded(Recording(hz=2, ticks=4)), pytest.raises(CheckFailed) as failed:
        pafot.check(JERK, name="jerk", at_most=20, unit="m/s^3")
    assert str(failed.value) == "jerk = 35.1 > 20 m/s^3 at 1.5 s"
    assert isinstance(failed.value, AssertionError)


def test_lower_bound_message_names_the_npc():
    assert (
        str(made(0.3, at_least=0.5, unit="s", at=4.2, npc=1))
        == "jerk = 0.3 < 0.5 s at 4.2 s (NPC 1)"
    )
    assert str(made(0.7, at_least=0.5, unit="s")) == "jerk = 0.7 >= 0.5 s"
    assert str(made(12.0, at_least=0.5, at_most=10.0)) == "jerk = 12.0 > 10"


def test_a_value_never_reads_as_its_bound():
    assert str(made(0.2963, at_least=0.3)) == "jerk = 0.296 < 0.3"
    assert str(made(20.04, at_most=20.0)) == "jerk = 20.04 > 20"
    assert str(made(20.0, at_most=20.0)) == "jerk = 20 <= 20"
    assert str(made(20.04, at_most=20.03)) == "jerk = 20.04 > 20.03"
    assert str(made(5.56, at_least=5.57)) == "jerk = 5.56 < 5.57"


def test_margin_is_in_units_of_bound_or_scale():
    assert made(15.0, at_most=20.0).margin == 0.25
    assert made(15.0, at_most=20.0, scale=5.0).margin == 1.0
    assert made(15.0, at_least=20.0).margin == -0.25
    assert made(3.0, at_most=0.0).margin == -3.0
    assert made(15.0, at_least=10.0, at_most=20.0).margin == 0.25


def test_without_a_recording_it_only_asserts():
    pafot.check(1.0, name="x", at_most=2.0)
    with pytest.raises(CheckFailed, match=r"x = 3\.0 > 2"):
        pafot.check(3.0, name="x", at_most=2.0)


def test_array_of_different_length_has_no_time():
    assert made(JERK[2:], at_most=20.0).time is None
    assert made(JERK[2:], at_most=20.0, at=9.0).time == 9.0


@given(
    st.lists(st.integers(-99, 99), min_size=1, max_size=9),
    st.integers(-99, 99),
    st.sampled_from(["at_most", "at_least"]),
)
def test_check_holds_exactly_if_worst_value_does(values, bound, side):
    check = made(np.array(values), **{side: bound})
    worst = max(values) if side == "at_most" else min(values)
    assert check.holds == (worst <= bound if side == "at_most" else worst >= bound)
    assert check.value == worst
    assert math.isclose(
        abs(check.margin) * (abs(bound) or 1.0), abs(worst - bound), rel_tol=1e-9, abs_tol=1e-9
    )


def test_nan_fails():
    check = made(np.array([1.0, math.nan]), at_most=20.0)
    assert not check.holds
    assert check.margin == -math.inf
    assert "is not within" in str(check)


def test_infinity_is_beyond_any_bound():
    assert made(math.inf, at_least=1.0).holds
    assert not made(math.inf, at_most=1.0).holds


def test_a_failure_travels_between_processes():
    check = Check(name="jerk", value=35.1, margin=-0.755, at_most=20.0, values=JERK)
    assert pickle.loads(pickle.dumps(CheckFailed(check))).check == check


@table(
    ("value", "arguments", "says"),
    [
        (1.0, {}, "expected at_most=, at_least= or both"),
        ("fast", {"at_most": 1.0}, "expected a number or an array of numbers, received 'fast'"),
        (np.zeros((2, 3)), {"at_most": 1.0}, "shape (2, 3). Check each NPC separately"),
        (np.array([]), {"at_most": 1.0}, "one value per tick"),
        (1.0, {"at_most": math.nan}, "expected a finite number as the bound"),
        (1.0, {"at_most": True}, "expected a finite number as the bound, received True"),
        (1.0, {"at_most": 1.0, "scale": 0.0}, "expected scale= to be a positive number"),
        (10**400, {"at_most": 1.0}, "expected a number or an array of numbers"),
        (1.0, {"at_most": 2.0, "npc": 1.0}, "expected npc= to be the index of an NPC"),
        (1.0, {"at_most": 2.0, "npc": -2}, "expected npc= to be the index of an NPC"),
        (
            1.0,
            {"at_most": 2.0, "at": -1.0},
            "expected at= to be at least 0 seconds after the start of the run",
        ),
        (1.0, {"at_most": 2.0, "unit": "m\n"}, "expected a short printable unit"),
    ],
)
def test_a_check_that_cannot_be_made_says_why(value, arguments, says):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        pafot.check(value, name="jerk", **arguments)
    assert says in str(error.value)


@table("name", ["", " ", "a\nb", "x" * 61, None])
def test_a_check_needs_a_name(name):
    with pytest.raises(ValueError, match="expected 1 to 60 printable characters"):
        pafot.check(1.0, name=name, at_most=2.0)


def test_npc_index_may_come_from_an_array():
    leader = np.array([1, -1])
    assert type(made(1.0, at_most=2.0, npc=leader[0]).npc) is int
    assert made(1.0, at_most=2.0, npc=leader[1]).npc is None
    with (
        recorded(Recording(hz=2, ticks=4, npcs=1)),
        pytest.raises(ValueError, match=r"\(at most 0\), received 1"),
    ):
        pafot.check(1.0, name="gap", at_most=2.0, npc=1)


def test_only_a_check_makes_a_failed_one():
    with pytest.raises(TypeError, match="expected a Check, received 'slow'"):
        CheckFailed("slow")
