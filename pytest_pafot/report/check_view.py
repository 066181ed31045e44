"""What the page shows of a check that failed: its figures, and the curve of its values with the bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pytest_pafot.attribution.lane_changes import stretches
from pytest_pafot.checks import Check
from pytest_pafot.report.page_data import CheckView
from pytest_pafot.trace import FloatArray, Trace

REACH = 3
"""How far a curve is shown on the side that keeps the bound, in multiples of the bound or of what breaks it."""


def check_tick(trace: Trace, check: Check | None) -> int | None:
    """The tick at which a check was worst; None where it does not say, or says one outside of the run."""
    if check is None or check.time is None or not 0 <= check.time <= trace.duration:
        return None
    return round(check.time * trace.physics_hz)


def check_view(check: Check, trace: Trace, ticks: Sequence[int]) -> CheckView:
    """The view of a check that failed in a run, at the ticks of the frames.

    There is a curve where it is known which ticks its values belong to.
    """
    tick, hz = check_tick(trace, check), trace.physics_hz
    view = CheckView(
        name=check.name,
        unit=check.unit,
        value=check.value if math.isfinite(check.value) else None,
        at_most=check.at_most,
        at_least=check.at_least,
        time=None if tick is None else round(tick / hz, 3),
    )
    if check.values is None or check.start + len(check.values) > trace.ticks + 1:
        return view
    end, (low, high) = check.start + len(check.values), _axis(check, check.values)
    digits = max(4, 4 - math.floor(math.log10(high - low)))
    values, excess = np.full(trace.ticks + 1, np.nan), np.full(trace.ticks + 1, -np.inf)
    values[check.start : end], excess[check.start : end] = check.values, _excess(check, check.values)
    spans = [range(before + 1, tick + 1) for before, tick in pairwise([-1, *ticks])]
    worst = [values[span[int(excess[span].argmax())]] for span in spans]
    return replace(
        view,
        values=tuple(None if np.isnan(value) else round(float(value), digits) for value in np.clip(worst, low, high)),
        low=low,
        high=high,
        is_cut=(bool((values < low).any()), bool((values > high).any())),
        broken=tuple((round(first / hz, 3), round((end - 1) / hz, 3)) for first, end in stretches(excess > 0)),
    )


def _excess(check: Check, values: FloatArray) -> FloatArray:
    """By how much each value breaks its bounds, negative where it keeps them; NaN breaks any."""
    over = [values - check.at_most] if check.at_most is not None else []
    under = [check.at_least - values] if check.at_least is not None else []
    excess: FloatArray = np.max([*over, *under], axis=0)
    return np.where(np.isnan(excess), np.inf, excess)


def _axis(check: Check, values: FloatArray) -> tuple[float, float]:
    """From where to where the values are worth showing: all that breaks a bound, and some of what keeps it."""
    bounds = [bound for bound in (check.at_most, check.at_least) if bound is not None]
    shown = [*values[np.isfinite(values)], *bounds]
    low, high = float(min(shown)), float(max(shown))
    broken_by = max(abs(check.value - bound) for bound in bounds) if math.isfinite(check.value) else 0.0
    reach = REACH * (max(broken_by, *map(abs, bounds)) or 1.0)
    if check.at_least is None:
        low = max(low, bounds[0] - reach)
    if check.at_most is None:
        high = min(high, bounds[0] + reach)
    step = 10.0 ** math.floor(math.log10(high - low or 1.0) - 0.5)
    return round(math.floor(low / step) * step, 12), round(max(math.ceil(high / step) * step, low + step), 12)
