"""Checks: assertions of a test function that report a margin, which is the distance of a value from its bound.

A plain ``assert`` reports only that it failed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np

from pytest_pafot.model.trace import FloatArray
from pytest_pafot.support.errors import POSITIVE, checked_number

# Discarding a scenario in a test function.


class Rejected(BaseException):
    """The exception that :func:`reject` raises; not an ``Exception``, so that the test's handlers do not catch it."""


def reject() -> NoReturn:
    """Discard the current scenario: it counts neither as passed nor as failed."""
    raise Rejected("pafot.reject() discards a scenario of a @pafot.search test; do not call it in any other code")


LONGEST_NAME = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A value of one run that was compared with its bounds.

    Attributes:
        name: name of the check; two failures of checks with the same name count as the same failure.
        value: worst value of the run [unit]; NaN fails.
        margin: distance of the value from its bound, divided by the scale of the check; negative if the bound is
            broken, minus infinity for NaN.
        at_most, at_least: bounds [unit]; None if there is no such bound.
        unit: unit of the value.
        time: time of the worst value [s]; None if unknown.
        npc: index of the NPC that the check is about; None if unknown.
        values: all values, one per tick, if the check received such an array; otherwise None.
    """

    name: str
    value: float
    margin: float
    at_most: float | None = None
    at_least: float | None = None
    unit: str = ""
    time: float | None = None
    npc: int | None = None
    values: FloatArray | None = field(default=None, compare=False, repr=False)

    @property
    def bounds(self) -> dict[str, float | None]:
        """The two bounds, by the argument names ``at_most`` and ``at_least``."""
        return {"at_most": self.at_most, "at_least": self.at_least}

    @property
    def holds(self) -> bool:
        """True if the value is within its bounds."""
        return self.margin >= 0

    def __str__(self) -> str:
        """Return the check in words, such as ``jerk 35.1 > 20 m/s^3 at 4.2 s``."""
        bound, sign = self.at_most, "<=" if self.holds else ">"
        if self.at_least is not None and (bound is None or self.value < self.at_least):
            bound, sign = self.at_least, ">=" if self.holds else "<"
        is_told = bound is not None
        sign = "is not within" if is_told and math.isnan(self.value) else sign
        held = f" {sign} {bound:g}" if is_told else ""
        when = "" if self.time is None else f" at {self.time:.1f} s"
        who = "" if self.npc is None else f" (NPC {self.npc})"
        return f"{self.name} {_short(self.value, bound)}{held}{f' {self.unit}' if self.unit else ''}{when}{who}"


class CheckFailed(AssertionError):  # noqa: N818  (it reads as what happened)
    """Error for a check whose bound is broken; its attribute ``check`` has the value, the time and the NPC."""

    __module__ = "pytest_pafot"  # users import it from there, and tracebacks show this name

    def __init__(self, check: Check) -> None:
        if not isinstance(check, Check):
            raise TypeError(f"CheckFailed: expected a Check, received {check!r:.80}; pafot.check(...) raises it")
        super().__init__(str(check))
        self.check = check

    def __reduce__(self) -> tuple[type[CheckFailed], tuple[Check]]:
        return type(self), (self.check,)


@dataclass(slots=True)
class Recording:
    """The checks of one run, in the order in which they were made.

    Attributes:
        hz: ticks per second of the run.
        ticks: number of ticks in the run.
        npcs: number of NPCs in the run; None if unknown.
        checks: checks that the test function made in the run.
    """

    hz: int
    ticks: int
    npcs: int | None = None
    checks: list[Check] = field(default_factory=list)


_RECORDING: ContextVar[Recording | None] = ContextVar("pafot_checks", default=None)
"""The recording of the run that is being evaluated now. It is a context variable so that checks in a test function do
not need the run as an argument."""


@contextmanager
def recorded(recording: Recording) -> Iterator[None]:
    """Add the checks that are made inside the ``with`` block to a recording."""
    token = _RECORDING.set(recording)
    try:
        yield
    finally:
        _RECORDING.reset(token)


def check(
    value: Any,
    *,
    name: str,
    at_most: float | None = None,
    at_least: float | None = None,
    unit: str = "",
    at: float | None = None,
    npc: int | None = None,
    scale: float | None = None,
) -> None:
    """Assert that a value is within its bounds, and report the margin to the search.

    Args:
        value: a number, or an array with one value per tick, such as ``run.ego.jerk``, of which the worst counts. NaN
            fails.
        name: of the check; failures of one name are one finding.
        at_most, at_least: bounds [unit]; one is required.
        unit: such as ``"m/s^3"``.
        at: time of the event [s]; by default that of an array's worst tick.
        npc: index of the NPC that it is about; -1, as in ``run.leader``, means none.
        scale: divisor of the margin [unit], to compare checks; by default the bound, or 1 if it is 0.

    Raises:
        CheckFailed: if a bound is broken.
        ValueError: if the check is not valid.
    """
    __tracebackhide__ = True  # pytest then shows the line of the test function as the last one
    what = f"check {name!r}"
    if at_most is None and at_least is None:
        raise ValueError(f"{what}: expected at_most=, at_least= or both, received neither")
    values = _values(value, name)
    # All bounds become margins in the same direction, of which the smallest counts.
    signed = [(bound, sign) for bound, sign in ((at_most, -1.0), (at_least, 1.0)) if bound is not None]
    bounds = [(checked_number(bound, what, "a finite bound"), sign) for bound, sign in signed]
    with np.errstate(invalid="ignore"):
        margins = np.min([sign * (values - bound) / _scale(name, bound, scale) for bound, sign in bounds], axis=0)
    # NaN must never pass: it is worse than any number.
    margins = np.where(np.isnan(margins), -np.inf, margins)
    tick, recording = int(margins.argmin()), _RECORDING.get()
    # An array has the ticks of the evaluated run if it has one value per tick of that run.
    hz = None if recording is None or values.size == 1 or values.size != recording.ticks + 1 else recording.hz
    time = None if hz is None else tick / hz
    if at is not None:
        time = checked_number(at, what, "at= as seconds since the run began", least=0.0)
    made = Check(
        name=_named(name),
        value=float(values[tick]),
        margin=float(margins[tick]),
        at_most=None if at_most is None else float(at_most),
        at_least=None if at_least is None else float(at_least),
        unit=_unit(name, unit),
        time=time,
        npc=_npc(name, npc),
        values=None if hz is None else values,
    )
    # A check that holds is recorded, too: an algorithm of the user's may learn from its margin.
    if recording is not None:
        recording.checks.append(made)
    if not made.holds:
        raise CheckFailed(made)


def _values(value: Any, name: str) -> FloatArray:
    try:
        values = np.atleast_1d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"check {name!r}: expected a number or an array of them, received {value!r:.80}") from error
    if values.ndim != 1 or not values.size:
        raise ValueError(
            f"check {name!r}: expected a number, or an array with one value per tick, received an array of shape "
            f"{values.shape}; check each NPC by itself"
        )
    return values


def require(holds: bool, assertion: str, explain: Callable[[], str]) -> None:
    """Assert as ``assert`` does, also under ``python -O``, which switches assertions off.

    Args:
        holds: what must be true.
        assertion: its source text, which identifies the failure as that of an ``assert`` does.
        explain: returns the message, if it is not true.

    Raises:
        AssertionError: if it is not true. Its attribute ``assertion`` is the text.
    """
    __tracebackhide__ = True
    if not holds:
        error = AssertionError(explain())
        error.assertion = assertion  # type: ignore[attr-defined]
        raise error


def _named(name: str) -> str:
    if not isinstance(name, str) or not name.strip() or len(name) > LONGEST_NAME or not name.isprintable():
        raise ValueError(f"name: expected a printable text of 1 to {LONGEST_NAME} characters, received {name!r:.100}")
    return name.strip()


def _scale(name: str, bound: float, scale: float | None) -> float:
    divisor = abs(bound) or 1.0 if scale is None else scale
    return checked_number(divisor, f"check {name!r}", "a scale above 0", least=POSITIVE)


def _unit(name: str, unit: object) -> str:
    if not isinstance(unit, str) or len(unit) > LONGEST_NAME or not unit.isprintable():
        raise ValueError(f"check {name!r}: expected a short printable unit such as 'm/s^3', received {unit!r:.100}")
    return unit


def _npc(name: str, npc: Any) -> int | None:
    recording = _RECORDING.get()
    most = None if recording is None else recording.npcs
    is_index = isinstance(npc, (int, np.integer)) and not isinstance(npc, bool) and npc >= -1
    if npc is not None and not (is_index and (most is None or npc < most)):
        there = "" if most is None else f", at most {most - 1}"
        raise ValueError(f"check {name!r}: expected npc= as the index of an NPC{there}, received {npc!r:.100}")
    return None if npc is None or npc < 0 else int(npc)


def _short(value: float, bound: float | None) -> str:
    """Return a value with few digits, but enough of them to show on which side of its bound it is."""
    texts = [f"{value:.1f}"] if 1 <= abs(value) < 1e4 else []
    texts += [f"{value:.{digits}g}" for digits in range(3, 17)]
    if bound is None or math.isnan(value):
        return texts[0]
    if value == bound:
        return f"{value:g}"
    return next(
        (text for text in texts if float(text) != bound and (float(text) > bound) == (value > bound)), texts[-1]
    )
