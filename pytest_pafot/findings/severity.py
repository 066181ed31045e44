"""How bad a failure is: the speed of an impact, or by how much a check is broken; and which finding comes first."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import total_ordering
from typing import Any, Literal, Self

from pytest_pafot.findings.signature import SLOW_DECISION, Failure, Signature, normalised
from pytest_pafot.oracle.checks import Check
from pytest_pafot.oracle.run import Run

WORSE_BY = {"collision": 0.1, "check": 0.01}
"""From which difference on a failure has become worse: of closing speeds [m/s], and of margins."""


@total_ordering
@dataclass(frozen=True, slots=True, kw_only=True)
class Severity:
    """How bad a failure is: the larger, the worse. Any collision is worse than any failed check.

    Collisions compare by their closing speeds, failed checks by their margins, which have no unit.

    Attributes:
        kind: ``collision`` or ``check``.
        value: the closing speed at the impact [m/s], which is the magnitude of the difference of the two velocities; of
            a check, by how much its bound is broken [unit]. None where a check measured no finite number: the worst.
        unit: of the value.
        margin: of a check, in units of its scale, negative; None where the value is, and of a collision.
        name: of the check; empty for a collision.
    """

    kind: Literal["collision", "check"]
    value: float | None
    unit: str = ""
    margin: float | None = None
    name: str = ""

    @property
    def delta_v(self) -> float | None:
        """By how much a collision changes the velocity of each, where both are as heavy and stay together [m/s]."""
        return None if self.kind == "check" or self.value is None else round(self.value / 2, 6)

    @property
    def figure(self) -> str:
        """Return the value in short, without its unit."""
        if self.value is None:
            return "no finite number"
        return f"{self.value:.1f}" if self.kind == "collision" else f"{self.value:.3g}"

    def __str__(self) -> str:
        """Say what happens, such as ``hits at 9.8 m/s``."""
        figure = f"{self.figure} {self.unit}".rstrip()
        return f"hits at {figure}" if self.kind == "collision" else f"breaks {self.name} by {figure}"

    @property
    def further(self) -> str:
        """Return what a headline does not say: of a collision the delta-v, of a check by how much, and its margin."""
        if self.delta_v is not None:
            return f"delta-v {self.delta_v:.1f} m/s"
        by = f"by {self.figure} {self.unit}".rstrip()
        return "no finite number" if self.margin is None else f"{by}, margin {self.margin:.3g}"

    def is_fault(self, responsible: str) -> bool:
        """Return whether it is a collision that the ego answers for, alone or with the NPC."""
        return self.kind == "collision" and responsible in ("ego", "both")

    def data(self) -> dict[str, Any]:
        """Return the fields and the delta-v, for programs."""
        return {**asdict(self), "delta_v": self.delta_v}

    @classmethod
    def of_data(cls, data: Mapping[str, Any]) -> Self:
        """Return the value that :meth:`data` has made data of."""
        return cls(**{name: value for name, value in data.items() if name != "delta_v"})

    @property
    def figures(self) -> tuple[int, float, float]:
        """Return what is compared first; larger figures are worse."""
        value = math.inf if self.value is None else self.value
        if self.kind == "collision":
            return 2, value, 0.0
        return 1, math.inf if self.margin is None else -self.margin, value

    def __lt__(self, other: Severity) -> bool:
        return (self.figures, self.name, self.unit) < (other.figures, other.name, other.unit)


def severity_of(run: Run, failure: Failure) -> Severity | None:
    """Return how bad a failure of a run is; None for what has no measure, such as an ADS that raises or hangs.

    A failed check is measured by its bound, whatever else happened in the run. An assertion that speaks of something
    else than the collision has no measure, as its numbers are not known.
    """
    if failure.check is not None:
        return _of_check(failure.check)
    text = normalised(failure.assertion, failure.message)
    signature = Signature(failure=failure.kind, assertion=text, outcome=run.outcome, responsibility="none")
    if run.collision is None or failure.kind == SLOW_DECISION or signature.is_property:
        return None
    return Severity(kind="collision", value=round(run.collision.closing_speed, 6), unit="m/s")


def _of_check(check: Check) -> Severity:
    over = -math.inf if check.at_most is None else check.value - check.at_most
    under = -math.inf if check.at_least is None else check.at_least - check.value
    by = max(over, under)
    if not math.isfinite(by + check.margin):
        return Severity(kind="check", value=None, unit=check.unit, name=check.name)
    value, margin = float(f"{by:.6g}"), float(f"{check.margin:.6g}")  # the same in any process
    return Severity(kind="check", value=value, unit=check.unit, margin=margin, name=check.name)


def worst_first(responsible: str, severity: Severity | None) -> tuple[float, ...]:
    """Return a key by which findings are sorted: collisions that the ego answers for, then others.

    In each of the two the worst comes first, and what nothing measures last. Whoever sorts puts before the key what
    must come first anyway, and behind it what decides between findings that are as bad.
    """
    if severity is None:
        return 1, 0, 0.0, 0.0
    return not severity.is_fault(responsible), *(-each for each in severity.figures)


def worsening(now: Severity | None, before: Severity | None) -> str:
    """Say by how much a failure became worse, as in ``hits at 12.1 m/s, 8.0 before``; empty where it did not.

    Two collisions compare by their closing speeds, two failures of one check by their margins, and a collision is worse
    than what is none. Other failures do not compare.
    """
    if now is None:
        return ""
    if before is None or now.kind != before.kind:
        return f"{now}, no collision before" if now.kind == "collision" else ""
    is_same = (now.name, now.unit) == (before.name, before.unit)
    if not is_same or now.figures[1] - before.figures[1] < WORSE_BY[now.kind] or now.figure == before.figure:
        return ""
    return f"{now}, {before.figure} before"
