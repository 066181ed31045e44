"""Temporal logic over signals, which measures at every tick by how much a formula holds.

This is signal temporal logic with its quantitative semantics (Donze and Maler, "Robust Satisfaction of Temporal Logic
over Real-Valued Signals", FORMATS 2010), over the ticks of a run that ends. The part of a window after the last tick
is ignored. If a whole window is after the last tick, ``always`` holds with the margin infinity, and ``eventually`` and
``until`` fail with the margin minus infinity. A formula is NaN if any value in its window is NaN. For
``until``, a NaN of the left property at the last tick of the window does not count.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality.signals import Signal
from pytest_pafot.model.trace import FloatArray

IntArray = npt.NDArray[np.intp]

Within = tuple[float, float]
"""A window (first, last) in seconds after each tick; both ends are included."""

_ROUNDING = 1e-9
"""The tolerance for the rounding of seconds times ticks per second, so that a window contains its last tick [1]."""


class Margin(Signal):
    """The amount by which a property holds at each tick, as a signal: positive if it holds, negative if it does not.

    A margin has the unit of the underlying signal. ``&``, ``|`` and ``~`` mean and, or and not. A margin times a
    positive number is a margin, too, so margins in different units can be made comparable.

    Attributes:
        is_formula: whether the margin looks ahead in time, so that its first value is the verdict on the whole run.
            Otherwise each value is about its own tick.
    """

    __slots__ = ("_deciders",)  # not in __dict__, so that copies by numpy have none until they are set
    is_formula: bool = False

    @property
    def deciders(self) -> FloatArray:
        """The tick from which each value of the margin is taken, counted from the first value, shape [ticks].

        If several ticks have the same value, or NaN, it is the first of them. It is infinite if the value is from no
        tick or if the tick is unknown. A numpy function of one formula and numbers preserves these ticks, and so does a
        slice of known ticks. A numpy function of several arrays makes them unknown if one of the arrays is a formula.
        """
        if not self.is_formula:
            return np.arange(len(self), dtype=np.float64)
        return getattr(self, "_deciders", np.full(len(self), np.inf))

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        """Make a margin of an array that numpy computed from margins; it is a formula if one of those is a formula."""
        result = super().__array_wrap__(array, context, return_scalar)
        if isinstance(result, Margin) and context is not None:
            arrays = [each for each in context[1] if np.ndim(each)]
            result.is_formula = _looks_ahead(arrays)
            if result.is_formula and len(arrays) == 1:
                result._decide(self.deciders)
        return result

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        """Call a numpy function that is not arithmetic, such as ``np.where``, and make a margin of its array."""
        result = super().__array_function__(func, types, args, kwargs)
        if isinstance(result, Margin):
            result.is_formula = _looks_ahead((*args, *kwargs.values()))
        return result

    def __getitem__(self, key: Any) -> Any:
        """Return one value, or a selection of values as a margin."""
        part = super().__getitem__(key)
        if isinstance(part, Margin) and part.is_formula and part.hz is not None:
            part._decide(self.deciders[key] - (part.start - self.start))
        return part

    def __and__(self, other: Any) -> Margin:
        """Return the smaller of the two margins at each tick, which is positive if both properties hold."""
        return _joined(np.minimum, self, other)

    def __or__(self, other: Any) -> Margin:
        """Return the larger of the two margins at each tick, which is positive if at least one property holds."""
        return _joined(np.maximum, self, other)

    def __invert__(self) -> Margin:
        """Return the margin with the opposite sign, which is positive if the property does not hold."""
        return _like(self, -np.asarray(self), self.deciders if self.is_formula else None)

    def _decide(self, deciders: FloatArray) -> None:
        """Make this margin a read-only formula whose values are taken from the ticks ``deciders``."""
        self._deciders, self.is_formula, self.flags.writeable = deciders, True, False


def above(signal: npt.ArrayLike, bound: npt.ArrayLike) -> Margin:
    """Return the margin by which a signal is above a bound, a number or one per tick."""
    signal = signal if isinstance(signal, Signal) else Signal(signal)
    return _like(signal, np.subtract(signal, bound))


def below(signal: npt.ArrayLike, bound: npt.ArrayLike) -> Margin:
    """Return the margin by which a signal is below a bound, a number or one per tick."""
    return ~above(signal, bound)


def always(margin: Margin, within: Within | None = None) -> Margin:
    """Return the smallest margin from each tick on: positive if the property always holds.

    Args:
        margin: margin of the property.
        within: window (first, last) in seconds after each tick; by default it lasts until the end of the run.

    Raises:
        TypeError: if the argument is no margin.
        ValueError: if no tick is in the window, or if it is given in seconds and the ticks per second are unknown.
    """
    return ~eventually(~_checked(margin), within)


def eventually(margin: Margin, within: Within | None = None) -> Margin:
    """Return the largest margin from each tick on: positive if the property holds at some time.

    Args:
        margin: margin of the property.
        within: window (first, last) in seconds after each tick; by default it lasts until the end of the run.

    Raises:
        TypeError: if the argument is no margin.
        ValueError: if no tick is in the window, or if it is given in seconds and the ticks per second are unknown.
    """
    at = _greatest(np.asarray(margin), *_window(_checked(margin), within))
    return _like(margin, np.append(margin, -np.inf)[at], np.append(margin.deciders, np.inf)[at])


def until(left: Margin, right: Margin, within: Within | None = None) -> Margin:
    """Return the margin by which the left property holds, from each tick on, until the right one does.

    At the tick at which the right property holds, the left property need not hold.

    Args:
        left, right: margins of the two properties.
        within: window (first, last) in seconds after each tick in which the right property has to hold; by default it
            lasts until the end of the run.

    Raises:
        TypeError: if an argument is no margin.
        ValueError: if the margins are over different ticks, or for windows as in :func:`always`.
    """
    either = _checked(left) | _checked(right)
    first, last = _window(either, within)
    at = _holding_until(np.asarray(left), np.asarray(right), first, last)
    deciders = np.concatenate((left.deciders, right.deciders, [np.inf]))
    return _like(either, np.concatenate((left, right, [-np.inf]))[at], deciders[at])


def _greatest(values: FloatArray, first: int, last: int) -> IntArray:
    """Return, for the window of each tick, the index of its first NaN or else of its first largest value.

    The window is from ``first`` to ``last`` ticks after the tick. An empty window has the index ``len(values)``.
    """
    later = np.append(values, np.full(last, -np.inf))[first:]
    ahead = np.lib.stride_tricks.sliding_window_view(later, last - first + 1).argmax(axis=1)
    at: IntArray = np.minimum(ahead + np.arange(first, first + len(values)), len(values))
    return at


def _holding_until(left: FloatArray, right: FloatArray, first: int, last: int) -> IntArray:
    """Return the index of the value of ``until`` for each tick, in an array of left, right, and minus infinity.

    In a window, the value is the smallest of ``always`` left up to the window, ``until`` from there on, and
    ``eventually`` right in it (Donze, Ferrere and Maler, "Efficient Robust Monitoring for STL", CAV 2013).
    """
    values = np.concatenate((left, right, [-np.inf]))
    is_nan = np.isnan(values)
    values[is_nan] = 0.0
    ticks, end = np.arange(len(left)), len(left)
    at = np.append(_until_ever(values[:end].tolist(), values[end:-1].tolist()), np.full(first, 2 * end))[first:]
    if first > 0:
        before = _greatest(-values[:end], 0, first - 1)
        at = np.where((values[before] <= values[at]) & (ticks + first < end), before, at)
    comes = end + _greatest(values[end:-1], first, last)
    at = np.where(values[comes] < values[at], comes, at)
    held, come = _next(is_nan[:end], ticks), _next(is_nan[end:-1], ticks + first)
    looks_at = np.maximum(held + 1, ticks + first)  # the tick from which on the NaN of the left one counts
    is_lost = np.minimum(looks_at, come) <= np.minimum(ticks + last, end - 1)
    return np.where(is_lost, np.where(come < looks_at, end + come, held), at)


def _until_ever(left: list[float], right: list[float]) -> list[int]:
    """Return what :func:`_holding_until` returns if the window lasts until the end of the run and no value is NaN."""
    best, at, places = -math.inf, 2 * len(left), []
    for tick in range(len(left) - 1, -1, -1):
        if left[tick] <= best:
            best, at = left[tick], tick
        if right[tick] >= best:
            best, at = right[tick], len(left) + tick
        places.append(at)
    return places[::-1]


def _next(mask: npt.NDArray[np.bool_], ticks: IntArray) -> IntArray:
    """Return, for each of some ticks, the first tick from it on at which a mask is true; a very large one if none."""
    places = np.append(np.flatnonzero(mask), 2 * len(mask) + 1)
    return places[np.searchsorted(places, ticks)]


def _like(signal: Signal, values: npt.ArrayLike, deciders: FloatArray | None = None) -> Margin:
    """Make a margin with the ticks and the unit of a signal; it is a formula if ``deciders`` is given."""
    margin = Margin(values, hz=signal.hz, start=signal.start, unit=signal.unit)
    if deciders is not None:
        margin._decide(deciders)
    return margin


def _looks_ahead(given: Any) -> bool:
    """Return whether a formula is among the arguments of a numpy function."""
    return any(
        _looks_ahead(each) if isinstance(each, (list, tuple)) else getattr(each, "is_formula", False) for each in given
    )


def _joined(choose: Any, left: Margin, right: Any) -> Margin:
    over = [(len(each), each.start, each.hz) for each in (left, _checked(right))]
    knows_both = None not in (left.hz, right.hz)
    if len(left) != len(right) or (knows_both and over[0] != over[1]):
        texts = [f"{ticks} from tick {start} on at {hz or 'any number of'} ticks a second" for ticks, start, hz in over]
        raise ValueError(
            f"expected margins over the same ticks, received {texts[0]}, and {texts[1]}; cut one to the ticks of the "
            "other, such as signal[1:] for np.diff(signal)"
        )
    sides = [np.asarray(left), np.asarray(right)]
    values, deciders = choose(*sides), None
    if left.is_formula or right.is_formula:
        chosen = [(side == values) | np.isnan(side) for side in sides]
        deciders = np.where(chosen, (left.deciders, right.deciders), np.inf).min(axis=0)
    margin = _like(right if left.hz is None else left, values, deciders)
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
    """Return the first and the last tick of a window, counted from the tick that it belongs to.

    The last tick is at most the length of the run.
    """
    if within is None:
        return 0, len(margin) - 1
    if margin.hz is None:
        raise ValueError(
            f"within={within}: expected a margin with a known number of ticks per second, received a margin without "
            "that number; compute the margin from a signal of the run, or from pafot.Signal(values, "
            "hz=run.trace.physics_hz)"
        )
    if np.shape(within) != (2,) or not 0 <= within[0] <= within[1] or math.isinf(within[0]):
        raise ValueError(f"within: expected seconds (from, to) with 0 <= from <= to, received {within!r}")
    first, end = math.ceil(within[0] * margin.hz - _ROUNDING), within[1] * margin.hz + _ROUNDING
    if first > end:
        raise ValueError(f"within: expected a window with a tick in it, of {margin.hz:g} a second, received {within!r}")
    first = min(first, len(margin))
    return first, max(first, math.floor(min(end, len(margin) - 1)))
