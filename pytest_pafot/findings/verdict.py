"""The verdict of a test function on a run."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Self

from pytest_pafot.findings.severity import Severity, worsening
from pytest_pafot.findings.signature import CHECK_FAILED, Failure
from pytest_pafot.oracle.checks import Check


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
