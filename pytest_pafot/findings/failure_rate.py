"""How often a policy that draws random numbers fails in one scenario, and whether it fails more or less often now.

Source: Wald, "Sequential tests of statistical hypotheses", Annals of Mathematical Statistics 16(2), 1945.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from pytest_pafot.model.scenario import MAX_SEED, Scenario
from pytest_pafot.support.proportions import CONFIDENCE, interval, percent, rarer, upper_bound

FEW_RUNS, MANY_RUNS = 20, 60
"""The number of runs for a rate, and the number if fewer than :data:`ENOUGH` of the first runs fail."""

KNOWN_RUNS = 200
"""The number of runs of a finding with which simpler scenarios are compared, and the largest number for the result."""

ENOUGH = 3
"""The number of failures with which the runs that no longer fail can be told from luck."""

CLEAN = 59
"""The least number of runs without a failure that show a fix: 0.95 ** 59 < 0.05, so with 95 % confidence fewer than 5 %
of all runs fail."""

MOST_CLEAN = 300
"""The largest number of runs of one replay."""

RARER = 0.8
"""The share of a rate from which on a simpler scenario fails clearly more rarely."""

ODDS, SURE_ODDS = math.log(9), math.log(30)
"""The logarithms of the odds at which a simpler scenario is given up or accepted, 9 to 1, and the result, 30 to 1."""

Change = Literal["fixed", "better", "as before", "worse"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureRate:
    """The number of runs of one scenario, and how many of them fail.

    Raises:
        ValueError: if there is no run, or if more runs fail than there are.
    """

    failing: int
    runs: int

    def __post_init__(self) -> None:
        if not 0 <= self.failing <= self.runs or not self.runs:
            raise ValueError(f"failing: expected at most {self.runs} of at least one run, received {self.failing}")

    def __str__(self) -> str:
        return f"{self.failing or 'none'} of {self.runs}"

    @property
    def in_general(self) -> str:
        """The share of all runs that fail, as far as these runs show it with 95 % confidence."""
        low, high = (percent(each) for each in interval(self.failing, self.runs))
        return f"95 %: {low.removesuffix(' %')} to {high}"

    @property
    def clean(self) -> int:
        """The number of runs without any failure that a replay makes to show a fix.

        If the policy still fails as often, so many runs without a failure have a chance of at most 5 %. If no possible
        number has, because it fails too rarely, a replay makes the fewest.
        """
        return next(
            (runs for runs in range(CLEAN, MOST_CLEAN) if self._is_rarer(FailureRate(failing=0, runs=runs))), CLEAN
        )

    def change(self, now: FailureRate) -> Change:
        """Return whether fewer or more runs fail now than in this rate, if that is more than chance."""
        if self._is_rarer(now):
            return "better" if now.failing or now.runs < CLEAN else "fixed"
        return "worse" if now._is_rarer(self) else "as before"

    def _is_rarer(self, now: FailureRate) -> bool:
        return self._chance(now) <= 1 - CONFIDENCE

    def _chance(self, now: FailureRate) -> float:
        return rarer(now.failing, now.runs, self.failing, self.runs)

    def compared(self, now: FailureRate, what: str) -> str:
        """Return a sentence on the change to a rate now; ``what`` is ``runs`` or ``seeds``."""
        change = self.change(now)
        chance = now._chance(self) if change == "worse" else self._chance(now)
        sure = {
            # The label of the replay says whether that is a fix.
            "fixed": f"here in less than {percent(upper_bound(0, now.runs, CONFIDENCE))} of all, 95 % sure",
            "as before": f"as before, {now.in_general}",
        }.get(change, f"{change}, {now.in_general}, by chance with p = {chance:.2g}")
        return f"fails in {now} {what}, {self} when it was found: {sure}"

    def is_as_often(self, outcomes: Sequence[bool], most: int = FEW_RUNS, odds: float = ODDS) -> bool | None:
        """Return whether a simpler scenario, of which each outcome says whether a run fails, fails about as often.

        Return None if more runs are needed to say so.

        It does if that is likelier than each of three others: that it fails half as often, that its rate is
        :data:`RARER` of this one, and that it passes a quarter as often. The runs end before ``most`` if the logarithm
        of the odds for one of these, or against all, reaches ``odds``. With the defaults, a scenario that never fails
        takes two runs at a rate of 0.9, eight at 0.4, and all of them below 0.2. This rate is taken as known, so it
        must be of many runs.
        """
        share = min(self.failing / self.runs, 0.9)  # one run that passes must not decide
        if not share:
            return True  # too rare to compare
        others = [share / 2, share * RARER] + ([(3 + share) / 4] if share < 0.9 else [])
        steps = [
            (math.log((1 - share) / (1 - other)), math.log(share / other)) for other in others
        ]  # of a run that passes, and of one that fails
        least = min(sum(each[fails] for fails in outcomes) for each in steps)
        return least > 0 if len(outcomes) >= most or abs(least) >= odds else None


def with_other_seed(scenario: Scenario, number: int) -> Scenario:
    """Return a scenario in which a policy draws other numbers; ``number`` is 0 for the scenario itself."""
    return replace(scenario, seed=(scenario.seed + number) % (MAX_SEED + 1))
