"""The verdict of a test function on a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import total_ordering
from types import MappingProxyType
from typing import ClassVar, Literal, Self

from pytest_pafot.findings.signature import CHECK_FAILED, Failure, Signature, normalised
from pytest_pafot.oracle.checks import Check
from pytest_pafot.oracle.run import Run


@total_ordering
@dataclass(frozen=True, slots=True, kw_only=True)
class Severity:
    """The severity of a failure: larger is worse. Any collision is worse than any failed check.

    Collisions are compared by their closing speeds, and failed checks by their margins, which have no unit.

    Attributes:
        kind: ``collision`` or ``check``.
        value: the closing speed at the impact [m/s], which is the magnitude of the difference of the two velocities;
            for a check, the amount by which its bound is broken [unit]. None, the worst, if a check measured no finite
            number.
        unit: unit of ``value``.
        margin: negative margin of a check in units of its scale; None for a collision, or if ``value`` is None.
        name: name of the check; empty for a collision.
    """

    WORSE_BY: ClassVar[Mapping[str, float]] = MappingProxyType({"collision": 0.1, "check": 0.01})
    """The smallest difference at which a failure counts as worse: in closing speed [m/s], or in a check's margin."""

    kind: Literal["collision", "check"]
    value: float | None
    unit: str = ""
    margin: float | None = None
    name: str = ""

    @property
    def figure(self) -> str:
        """The value in short, without its unit."""
        if self.value is None:
            return "no finite number"
        return f"{self.value:.1f}" if self.kind == "collision" else f"{self.value:.3g}"

    def __str__(self) -> str:
        """Describe the failure, such as ``hits at 9.8 m/s``."""
        figure = f"{self.figure} {self.unit}".rstrip()
        return f"hits at {figure}" if self.kind == "collision" else f"breaks {self.name} by {figure}"

    def is_fault(self, responsible: str) -> bool:
        """Return whether the failure is a collision that the ego is responsible for, alone or with the NPC."""
        return self.kind == "collision" and responsible in ("ego", "both")

    @property
    def figures(self) -> tuple[int, float, float]:
        """The numbers by which two severities are compared first; larger is worse."""
        value = math.inf if self.value is None else self.value
        if self.kind == "collision":
            return 2, value, 0.0
        return 1, math.inf if self.margin is None else -self.margin, value

    @staticmethod
    def worst_first(responsible: str, severity: Severity | None) -> tuple[float, ...]:
        """Return a sort key for findings: collisions that the ego is responsible for first, then other failures.

        Each group is sorted from the worst, and failures without a measure are last. Callers put more important
        criteria before this key, and tie-breakers after it. ``responsible`` is ``ego``, ``npc``, ``both`` or ``none``.
        """
        if severity is None:
            return 1, 0, 0.0, 0.0
        return not severity.is_fault(responsible), *(-each for each in severity.figures)

    def __lt__(self, other: Severity) -> bool:
        return (self.figures, self.name, self.unit) < (other.figures, other.name, other.unit)


def severity_of(run: Run, failure: Failure) -> Severity | None:
    """Return how bad a failure of a run is; None for a failure without a measure, such as an ADS that raises or hangs.

    A failed check is measured against its bound, whatever else happened in the run. An assertion that is not about the
    collision has no measure, because the numbers that it compares are not known.
    """
    if failure.check is not None:
        return _of_check(failure.check)
    text = normalised(failure.assertion, failure.message)
    signature = Signature(failure=failure.kind, assertion=text, outcome=run.outcome, responsibility="none")
    return _of_collision(signature, None if run.collision is None else round(run.collision.closing_speed, 6))


def _of_collision(signature: Signature, closing_speed: float | None) -> Severity | None:
    if closing_speed is None or signature.is_property:
        return None
    return Severity(kind="collision", value=closing_speed, unit="m/s")


def _of_check(check: Check) -> Severity:
    over = -math.inf if check.at_most is None else check.value - check.at_most
    under = -math.inf if check.at_least is None else check.at_least - check.value
    by = max(over, under)
    if not math.isfinite(by + check.margin):
        return Severity(kind="check", value=None, unit=check.unit, name=check.name)
    value, margin = float(f"{by:.6g}"), float(f"{check.margin:.6g}")  # rounded, so that it is equal in every process
    return Severity(kind="check", value=value, unit=check.unit, margin=margin, name=check.name)


def worsening(now: Severity | None, before: Severity | None) -> str:
    """Say how much worse a failure became, as in ``hits at 12.1 m/s, 8.0 before``; empty if it did not become worse.

    Two collisions are compared by closing speed and two failures of one check by margin; a collision is worse than any
    other failure. Other pairs cannot be compared.
    """
    if now is None:
        return ""
    if before is None or now.kind != before.kind:
        return f"{now}, no collision before" if now.kind == "collision" else ""
    is_same = (now.name, now.unit) == (before.name, before.unit)
    if not is_same or now.figures[1] - before.figures[1] < Severity.WORSE_BY[now.kind] or now.figure == before.figure:
        return ""
    return f"{now}, {before.figure} before"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The verdict of the test function, the oracle, on a run."""

    # ``failed`` is a finding. ``rejected`` and ``skipped`` are no judgement. ``npc`` is a collision for which an NPC is
    # responsible, unless ``blame="any"``, and ``avoidable`` one that braking late, but hard, would have avoided, unless
    # ``blame="avoidable"``. ``unpreventable`` is a failure that no reference driver would have prevented,
    # with ``blame="preventable"``. ``common`` is a failure that the reference does not pass either. ``invalid`` is a
    # crash between NPCs.
    kind: Literal["passed", "failed", "rejected", "skipped", "npc", "avoidable", "unpreventable", "common", "invalid"]
    exception: BaseException | None = None  # the exception of the function, if it failed or skipped
    failure: Failure | None = None
    checks: tuple[Check, ...] = ()  # the checks that the function made, in order, up to one that failed
    is_timed: bool = False  # True if it depends on wall-clock time
    is_ads: bool = False  # True if the ADS itself failed, whatever the function asserts
    severity: Severity | None = None  # severity of the failure; None if there is none, or if nothing measures it
    excused: str = ""  # what happened in a run that is ``avoidable``
    reference: Verdict | None = None  # verdict on the reference in the same scenario; None if it was not run

    @property
    def failed(self) -> bool:
        """True if the run is a failure that counts, so it is a finding."""
        return self.kind == "failed"

    @property
    def is_check(self) -> bool:
        """True if a check with a bound is broken."""
        return self.failure is not None and self.failure.kind == CHECK_FAILED

    @property
    def passes(self) -> bool:
        """True if the test passes in the run, or if ``blame`` excludes the run's failure."""
        return self.kind in ("passed", "npc", "avoidable", "unpreventable")

    @property
    def discarded(self) -> bool:
        """True if the test function declined to judge the run: it skipped or rejected it."""
        return self.kind in ("rejected", "skipped")

    @property
    def margins(self) -> tuple[tuple[str, float], ...]:
        """The worst margin of each check that the test function made, sorted by the check's name."""
        worst: dict[str, float] = {}
        for each in self.checks:
            worst[each.name] = min(each.margin, worst.get(each.name, math.inf))
        return tuple(sorted(worst.items()))

    @property
    def worsening(self) -> str:
        """The words for how much worse the failure is than the reference's in its scenario; empty if it is no worse."""
        return "" if self.reference is None else worsening(self.severity, self.reference.severity)

    def beside(self, reference: Verdict) -> Self:
        """Return the verdict together with the verdict on the reference in the same scenario.

        The failure counts only if the reference passes.
        """
        return replace(self, kind="failed" if reference.passes else "common", reference=reference)
