"""Temporal logic over signals that tells by how much a formula holds, at every tick.

Signal temporal logic with its quantitative semantics (Donze and Maler, "Robust Satisfaction of Temporal Logic over
Real-Valued Signals", FORMATS 2010), over the ticks of a run that ends. What a window has beyond the last tick says
nothing: where all of it lies there, ``always`` holds by infinity, and ``eventually`` and ``until`` fail by it. NaN
wherever a formula looks makes it NaN.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality.signals import Signal

Within = tuple[float, float]
"""From so many seconds later to so many, both included."""

_ROUNDING = 1e-9
"""Of seconds times ticks per second; a tick at the very end of a window is in it [1]."""


class Margin(Signal):
    """By how much something holds at each tick: positive where it does, negative where it does not.

    In the unit of the signal that it speaks of. ``&``, ``|`` and ``~`` are and, or and not. A margin times a positive
    number is one, too: what is added up in different units can be made comparable so.

    Attributes:
        is_formula: whether it looks ahead in time, so that its first value is the verdict on the whole run; otherwise
            each value is one on its own tick.
    """

    is_formula: bool = False

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        """What numpy computed of margins is a formula where one of them is."""
        result = super().__array_wrap__(array, context, return_scalar)
        if isinstance(result, Margin) and context is not None:
            result.is_formula = any(getattr(each, "is_formula", False) for each in context[1])
        return result

    def __and__(self, other: Any) -> Margin:
        """Both hold: the lesser margin."""
        return _joined(np.minimum, self, other)

    def __or__(self, other: Any) -> Margin:
        """One of them holds: the greater margin."""
        return _joined(np.maximum, self, other)

    def __invert__(self) -> Margin:
        """It does not hold: the negative margin."""
        return _like(self, np.negative(self), is_formula=self.is_formula)


def above(signal: npt.ArrayLike, bound: npt.ArrayLike) -> Margin:
    """By how much a signal is above a bound, a number or one for each tick, at each tick; 0 at the bound."""
    signal = signal if isinstance(signal, Signal) else Signal(signal)
    return _like(signal, np.subtract(signal, bound), is_formula=False)


def below(signal: npt.ArrayLike, bound: npt.ArrayLike) -> Margin:
    """By how much a signal is below a bound, a number or one for each tick, at each tick; 0 at the bound."""
    return ~above(signal, bound)


def always(margin: Margin, within: Within | None = None) -> Margin:
    """The least margin from each tick on, or of the ticks ``within`` so many seconds after it.

    Raises:
        TypeError: for what is no margin.
        ValueError: for a window in which no tick lies, or in seconds where nobody knows how many ticks those are.
    """
    return ~eventually(~_checked(margin), within)


def eventually(margin: Margin, within: Within | None = None) -> Margin:
    """The greatest margin from each tick on, or of the ticks ``within`` so many seconds after it.

    Raises:
        TypeError: for what is no margin.
        ValueError: for a window in which no tick lies, or in seconds where nobody knows how many ticks those are.
    """
    first, last = _window(_checked(margin), within)
    later = np.concatenate((np.asarray(margin), np.full(last, -np.inf)))[first:]
    greatest = np.lib.stride_tricks.sliding_window_view(later, last - first + 1).max(axis=1)
    return _like(margin, greatest, is_formula=True)


def until(left: Margin, right: Margin, within: Within | None = None) -> Margin:
    """The right one comes to hold, ``within`` so many seconds after each tick, and up to there the left one holds.

    At the tick at which the right one holds, the left one need not.

    Raises:
        TypeError: for what is no margin.
        ValueError: for margins over different ticks, and for windows as in :func:`always`.
    """
    either = left | right
    if within is None and not np.isnan(either).any():
        best, later = [], -math.inf
        for holds, comes in zip(reversed(left.tolist()), reversed(right.tolist()), strict=True):
            later = max(comes, min(holds, later))
            best.append(later)
        return _like(either, best[::-1], is_formula=True)
    first, last = _window(either, within)
    ticks = len(either)
    greatest, held = np.full(ticks, -np.inf), np.full(ticks, np.inf)
    for ahead in range(min(last + 1, ticks)):
        now = slice(0, ticks - ahead)
        if ahead >= first:
            greatest[now] = np.maximum(greatest[now], np.minimum(held[now], right[ahead:]))
        held[now] = np.minimum(held[now], left[ahead:])
    return _like(either, greatest, is_formula=True)


def _like(signal: Signal, values: npt.ArrayLike, *, is_formula: bool) -> Margin:
    """Values over the ticks and in the unit of a signal."""
    margin = Margin(values, hz=signal.hz, start=signal.start, unit=signal.unit)
    margin.is_formula = is_formula
    return margin


def _joined(choose: Any, left: Margin, right: Any) -> Margin:
    over = [(len(each), each.start, each.hz) for each in (left, _checked(right))]
    knows_both = None not in (left.hz, right.hz)
    if len(left) != len(right) or (knows_both and over[0] != over[1]):
        texts = [f"{ticks} from tick {start} on at {hz or 'any number of'} ticks a second" for ticks, start, hz in over]
        raise ValueError(
            f"expected margins over the same ticks, received {texts[0]}, and {texts[1]}; cut one to the ticks of the "
            "other, such as signal[1:] beside np.diff(signal)"
        )
    values = choose(np.asarray(left), np.asarray(right))
    is_formula = left.is_formula or right.is_formula
    margin = _like(right if left.hz is None else left, values, is_formula=is_formula)
    margin.unit = left.unit if left.unit == right.unit else ""
    return margin


def _checked(margin: Any) -> Margin:
    if not isinstance(margin, Margin):
        raise TypeError(
            f"expected a margin, such as pafot.above(run.headway, 0.5), received {type(margin).__name__}; a comparison "
            "such as run.headway > 0.5 does not say by how much it holds"
        )
    return margin


def _window(margin: Margin, within: Within | None) -> tuple[int, int]:
    """The first and the last tick of a window, counted from each tick; the last one no farther than the run is long."""
    if within is None:
        return 0, len(margin) - 1
    if margin.hz is None:
        raise ValueError(
            f"within={within}: expected a margin of a signal that knows its ticks a second, received one without; "
            "make it of a signal of the run, or of pafot.Signal(values, hz=run.trace.physics_hz)"
        )
    if np.shape(within) != (2,) or not 0 <= within[0] <= within[1] or math.isinf(within[0]):
        raise ValueError(f"within: expected seconds (from, to) with 0 <= from <= to, received {within!r}")
    first, end = math.ceil(within[0] * margin.hz - _ROUNDING), within[1] * margin.hz + _ROUNDING
    if first > end:
        raise ValueError(f"within: expected a window with a tick in it, of {margin.hz:g} a second, received {within!r}")
    first = min(first, len(margin))
    return first, max(first, math.floor(min(end, len(margin) - 1)))
