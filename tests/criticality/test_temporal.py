"""Temporal logic against its definition, written as loops over ticks, and against a second implementation."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot.criticality.temporal import Margin
from tests.helpers.tables import table
from tests.helpers.traces import random_states, trace_of

HZ = 4
BOUND = 0.5

numbers = st.integers(-9, 9).map(float)
windows = st.tuples(st.integers(0, 6), st.integers(0, 6)).map(sorted).map(tuple) | st.none()
formulas = st.recursive(
    st.tuples(st.sampled_from(["above", "below"]), st.sampled_from("xy")),
    lambda inner: (
        st.tuples(st.just("not"), inner)
        | st.tuples(st.sampled_from(["and", "or"]), inner, inner)
        | st.tuples(st.sampled_from(["always", "eventually"]), windows, inner)
        | st.tuples(st.just("until"), windows, inner, inner)
    ),
    max_leaves=6,
)


def pairs_of_signals(least, values=numbers):
    """Return a strategy for two lists of the same length, with at least this many ticks."""
    lengths = st.integers(least, 12)
    return lengths.flatmap(lambda ticks: st.tuples(*[st.lists(values, min_size=ticks, max_size=ticks)] * 2))


def chosen(cells, choose, default):
    """Choose the least or greatest value with the tick that decides it: the first NaN, otherwise the first one."""
    lost = [cell for cell in cells if math.isnan(cell[0])]
    return lost[0] if lost else choose(cells, key=lambda cell: cell[0], default=(default, math.inf))


def by_definition(formula, values, tick):
    """Return a formula's robustness at a tick, as papers define it, and the deciding tick; windows are in ticks."""
    kind, *rest = formula
    ticks = len(values["x"])
    if kind in ("above", "below"):
        return (values[rest[0]][tick] - BOUND) * (1 if kind == "above" else -1), tick
    if kind == "not":
        value, decider = by_definition(rest[0], values, tick)
        return -value, decider
    if kind in ("and", "or"):
        both = sorted((by_definition(each, values, tick) for each in rest), key=lambda cell: cell[1])
        return chosen(both, min if kind == "and" else max, None)
    first, last = rest[0] or (0, ticks)
    there = [at for at in range(tick + first, tick + last + 1) if at < ticks]
    if kind == "until":
        held = [by_definition(rest[1], values, at) for at in range(tick, max(there, default=tick))]
        ways = [chosen([*held[: at - tick], by_definition(rest[2], values, at)], min, None) for at in there]
        return chosen(ways, max, -math.inf)
    inner = [by_definition(rest[1], values, at) for at in there]
    return chosen(inner, min, math.inf) if kind == "always" else chosen(inner, max, -math.inf)


def margin_of(formula, values):
    kind, *rest = formula
    if kind in ("above", "below"):
        return getattr(pafot, kind)(pafot.Signal(values[rest[0]], hz=HZ), BOUND)
    if kind == "not":
        return ~margin_of(rest[0], values)
    if kind in ("and", "or"):
        left, right = (margin_of(each, values) for each in rest)
        return left & right if kind == "and" else left | right
    within = rest[0] and (rest[0][0] / HZ, rest[0][1] / HZ)
    return getattr(pafot, kind)(*(margin_of(each, values) for each in rest[1:]), within=within)


def text_of(formula):
    """Return a formula's text for rtamt, with windows in ticks of a second."""
    kind, *rest = formula
    if kind in ("above", "below"):
        return f"({rest[0]} {'>=' if kind == 'above' else '<='} {BOUND})"
    if kind in ("not", "and", "or"):
        *left, right = map(text_of, rest)
        return f"({' '.join(left)} {kind} {right})"
    window = f"[{rest[0][0]},{rest[0][1]}]" if rest[0] else ""
    *left, right = map(text_of, rest[1:])
    return f"({' '.join(left)} {kind}{window} {right})"


@settings(max_examples=settings.default.max_examples * 2)  # of seven kinds of formulas, in each other
@given(formulas, pairs_of_signals(1, numbers | st.just(math.nan)))
def test_robustness_and_deciding_tick_match_the_definition(formula, both):
    values = dict(zip("xy", both, strict=True))
    expected = [by_definition(formula, values, tick) for tick in range(len(values["x"]))]
    margin = margin_of(formula, values)
    np.testing.assert_array_equal(np.column_stack((margin, margin.deciders)), expected)


@settings(max_examples=1000, deadline=None)
@given(formulas, pairs_of_signals(2))
def test_robustness_matches_rtamt_at_every_tick(formula, both):
    rtamt = pytest.importorskip("rtamt")
    values = dict(zip("xy", both, strict=True))
    spec = rtamt.StlDiscreteTimeSpecification()
    for name in "xy":
        spec.declare_var(name, "float")
    spec.spec = text_of(formula)
    spec.parse()
    ticks = len(values["x"])
    told = spec.evaluate({"time": list(range(ticks)), **{name: list(each) for name, each in values.items()}})
    assert margin_of(formula, values).tolist() == [robustness for _, robustness in told]


SPEED = pafot.Signal([3.0, 1.0, 2.0], hz=2, start=4, name="ego.speed", unit="m/s")


class TestMargin:
    def test_margin_has_ticks_and_unit_of_its_signal(self):
        for margin in (pafot.above(SPEED, 2.0), pafot.always(~pafot.below(SPEED, 2.0), within=(0, 1))):
            assert (margin.hz, margin.start, margin.unit) == (2, 4, "m/s")

    def test_a_bound_may_be_one_for_each_tick(self):
        assert pafot.above(SPEED, [3.0, 3.0, 3.0]).tolist() == [0.0, -2.0, -1.0]

    def test_margins_in_different_units_have_none_together(self):
        gap = pafot.Signal([5.0, 5.0, 5.0], hz=2, start=4, unit="m")
        assert (pafot.above(SPEED, 2.0) & pafot.above(gap, 1.0)).unit == ""

    def test_only_margin_that_looks_ahead_is_a_formula(self):
        plain = pafot.above(SPEED, 2.0)
        assert not (plain & ~plain | plain).is_formula
        for formula in (pafot.always(plain), pafot.eventually(plain), pafot.until(plain, plain)):
            assert (formula.is_formula, (~formula).is_formula, (plain & formula).is_formula) == (True, True, True)

    def test_scaled_or_pickled_margin_stays_a_margin(self):
        formula = pafot.always(pafot.above(SPEED, 2.0))
        for same in (formula / 10, pickle.loads(pickle.dumps(formula)), formula[1:]):
            assert isinstance(same, Margin)
            assert same.is_formula

    def test_nan_makes_every_margin_that_uses_it_nan(self):
        margin = pafot.above(pafot.Signal([1.0, math.nan, 3.0], hz=2), 2.0)
        assert np.isnan(pafot.eventually(margin)).tolist() == [True, True, False]
        assert np.isnan(margin | ~margin).tolist() == [False, True, False]


class TestWindow:
    def test_window_includes_the_ticks_at_both_ends(self):
        margin = pafot.above(pafot.Signal([1.0, 2.0, 3.0, 4.0, 5.0], hz=10), 0.0)
        assert pafot.eventually(margin, within=(0.0, 0.3))[0] == 4.0
        assert pafot.eventually(margin, within=(0.0, 0.29))[0] == 3.0
        assert pafot.always(margin, within=(0.11, 0.3))[0] == 3.0
        assert pafot.always(margin, within=(0.2, math.inf))[0] == 3.0

    def test_beyond_the_end_always_holds_and_eventually_fails(self):
        margin = pafot.above(SPEED, 2.0)
        assert pafot.always(margin, within=(1e9, 2e9)).tolist() == [math.inf] * 3
        assert pafot.eventually(margin, within=(1.5, 2)).tolist() == [-math.inf] * 3

    @table("within", [(1, 0), (-1, 2), 5, (math.nan, 1), (math.inf, math.inf)])
    def test_what_is_no_window_is_refused(self, within):
        with pytest.raises(ValueError, match=r"expected seconds \(from, to\) with 0 <= from <= to, received"):
            pafot.always(pafot.above(SPEED, 2.0), within=within)

    def test_window_without_a_tick_in_it_is_refused(self):
        with pytest.raises(ValueError, match="expected a window with a tick in it, of 2 a second"):
            pafot.always(pafot.above(SPEED, 2.0), within=(0.1, 0.4))

    def test_seconds_need_a_signal_that_knows_its_ticks(self):
        margin = pafot.above(np.array([1.0, 2.0]), 0.0)
        assert pafot.always(margin).tolist() == [1.0, 2.0]
        with pytest.raises(ValueError, match=r"pafot\.Signal\(values, hz=run\.trace\.physics_hz\)"):
            pafot.always(margin, within=(0, 1))


class TestMistakes:
    @table("wrong", [SPEED > 2.0, SPEED, 1.0])
    def test_a_comparison_of_arrays_is_no_margin(self, wrong):
        margin = pafot.above(SPEED, 2.0)
        untils = (lambda each: pafot.until(margin, each), lambda each: pafot.until(each, margin))
        for use in (pafot.always, lambda each: margin & each, *untils):
            with pytest.raises(TypeError, match="does not say by how much it holds"):
                use(wrong)

    @table("other", [np.diff(SPEED), pafot.Signal(SPEED, hz=3, start=4), pafot.Signal(SPEED, hz=2)])
    def test_margins_over_different_ticks_do_not_go_together(self, other):
        with pytest.raises(ValueError, match="expected margins over the same ticks, received 3 from tick 4 on at 2"):
            pafot.above(SPEED, 2.0) & pafot.above(other, 0.0)

    def test_plain_array_combines_with_signal_of_same_length(self):
        joined = pafot.above(np.zeros(3), 1.0) | pafot.above(SPEED, 2.0)
        assert (joined.tolist(), joined.hz, joined.start) == ([1.0, -1.0, 0.0], 2, 4)


def test_run_property_reads_like_its_spoken_form():
    states = random_states(np.random.default_rng(3), 40, 3)
    run = pafot.Run(trace_of(*states.transpose(1, 0, 2)))
    slows_down = pafot.below(run.ego.acceleration, -1.0)
    formula = pafot.always(pafot.above(run.npcs[0].ttc, 2.0) | pafot.eventually(slows_down, within=(0, 1)))
    expected = min(
        max(run.npcs[0].ttc[tick] - 2.0, *(-1.0 - run.ego.acceleration[tick : tick + 16])) for tick in range(40)
    )
    assert formula[0] == pytest.approx(expected)


def test_until_without_window_spans_all_ticks():
    rng = np.random.default_rng(0)
    for ticks in (1, 2, 30):
        left, right = (pafot.above(pafot.Signal(rng.normal(size=ticks), hz=2), 0.0) for _ in range(2))
        assert pafot.until(left, right).tolist() == pafot.until(left, right, within=(0, 99)).tolist()


def test_numpy_result_of_margin_and_formula_is_formula():
    plain = pafot.above(pafot.Signal([1.0, -1.0], hz=2), 0.0)
    assert np.minimum(plain, pafot.eventually(plain)).is_formula
    assert not np.minimum(plain, plain).is_formula


FORMULA = pafot.eventually(pafot.above(pafot.Signal([1.0, 2.0, 5.0, 3.0, 4.0], hz=2, start=4), 0.0), within=(0, 1))


class TestDeciders:
    @table("same", [-FORMULA, 2 * FORMULA, FORMULA / 10, abs(FORMULA), np.minimum(FORMULA, 4.0), FORMULA[:], ~~FORMULA])
    def test_scaled_formula_is_decided_by_the_same_ticks(self, same):
        assert FORMULA.deciders.tolist() == same.deciders.tolist() == [2, 2, 2, 4, 4]

    def test_deciders_of_a_slice_count_from_its_start(self):
        assert FORMULA[1:4].deciders.tolist() == [1, 1, 3]
        assert FORMULA[1:][1:].deciders.tolist() == [0, 2, 2]

    @table(
        "other",
        [
            FORMULA + FORMULA,
            FORMULA * np.arange(5.0),
            FORMULA[::-1],
            FORMULA[[4, 3, 2, 1, 0]],
            FORMULA.copy(),
            np.where(np.arange(5) > 2, FORMULA, 0.0),
            np.where(np.arange(5) > 2, pafot.above(np.zeros(5), 1.0), FORMULA),
            np.select([np.arange(5) > 2], [pafot.above(np.zeros(5), 1.0)], FORMULA),
            np.cumsum(FORMULA),
            np.maximum.accumulate(FORMULA),
            np.add(FORMULA, 1.0, out=FORMULA.copy()),
            pickle.loads(pickle.dumps(FORMULA)),
        ],
    )
    def test_deciders_are_unknown_for_mixed_or_reordered_formulas(self, other):
        assert other.is_formula
        assert pafot.always(other).deciders.tolist() == [math.inf] * 5

    def test_what_is_known_cannot_be_overwritten(self):
        with pytest.raises(ValueError, match="read-only"):
            (2 * FORMULA)[0] = 9.0

    def test_plain_margins_are_decided_by_their_own_ticks(self):
        plain = pafot.above(SPEED, 2.0)
        for own in (plain + plain, np.where([True, False, True], plain, 9.0), plain[::-1], plain.copy()):
            assert own.deciders.tolist() == [0, 1, 2]
        assert pafot.always(np.where([True, False, True], plain, 9.0)).deciders.tolist() == [2, 2, 2]
