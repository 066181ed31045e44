"""Exact confidence intervals of shares of trials, and exact tests of two shares; without numpy.

Sources: Clopper, Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
Biometrika 26(4), 1934; McNemar, "Note on the sampling error of the difference between correlated proportions or
percentages", Psychometrika 12(2), 1947, in its exact form; Holm, "A simple sequentially rejective multiple test
procedure", Scandinavian Journal of Statistics 6(2), 1979; Wald, "Sequential tests of statistical hypotheses", The
Annals of Mathematical Statistics 16(2), 1945.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

CONFIDENCE = 0.95
LEVEL = 0.01
"""The largest chance with which a comparison of two versions of a policy may claim a difference where there is none.
Policies are compared after each change: with 0.05, one of twenty changes without an effect might be called worse."""
WORSE = 0.7
"""The share of trials that only the first hit, of those that only one hit, from which on the first is clearly worse."""
MISSED = 0.05
"""The largest chance with which a first that is clearly worse may be called no worse."""
_UNEVEN, _EVEN = math.log((1 - MISSED) / LEVEL), math.log(MISSED / (1 - LEVEL))
FEWEST = math.ceil(-math.log2(LEVEL))
"""The smallest number of trials that only one hit with which :func:`hits_more` can say that the first hits more."""


def interval(hits: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the Clopper-Pearson interval of a share: it contains the true share with at least this confidence.

    The interval starts at 0 if there is no hit, and ends at 1 if every trial is a hit.
    """
    beyond = (1 - confidence) / 2
    return 1 - upper_bound(trials - hits, trials, 1 - beyond), upper_bound(hits, trials, 1 - beyond)


def upper_bound(hits: int, trials: int, confidence: float = CONFIDENCE) -> float:
    """Return the upper limit of a share: the true share is above it with probability at most ``1 - confidence``."""
    if hits >= trials:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(60):  # bisection: 60 halvings reach the last bit of a float
        middle = (low + high) / 2
        if _at_most(hits, trials, middle) > 1 - confidence:
            low = middle
        else:
            high = middle
    return high


def mcnemar(first_only: int, second_only: int) -> float:
    """Return the two-sided p-value of McNemar's test from the trials that only the first, or only the second, hit."""
    trials = first_only + second_only
    return 1.0 if trials == 0 else min(1.0, 2 * _at_most(min(first_only, second_only), trials, 0.5))


def hits_more(first_only: int, second_only: int, *, is_last: bool = False) -> bool | None:
    """Return whether the first hits more of the same trials than the second; None if that is not known.

    This is Wald's sequential test. It may be asked after each trial, so that clear cases end early. Of the trials that
    only one hits, the first hits half if both are alike, and :data:`WORSE` of them if it is clearly worse. After the
    last trial, the exact sign test decides what lies between, unless fewer than :data:`FEWEST` trials differ.
    """
    evidence = first_only * math.log(2 * WORSE) + second_only * math.log(2 * (1 - WORSE))
    if evidence >= _UNEVEN or evidence <= _EVEN:
        return evidence > 0
    if not is_last or first_only + second_only < FEWEST:
        return None
    return first_only > second_only and mcnemar(first_only, second_only) <= 2 * LEVEL  # of one side


def difference(first_only: int, second_only: int, trials: int) -> tuple[float, float]:
    """Return an interval of the first share minus the second share, with a confidence of at least 95 %.

    ``first_only`` and ``second_only`` are the trials that only one of the two hit. The interval of each of these two
    shares has a confidence of 97.5 %.
    """
    one, other = (interval(hits, trials, (1 + CONFIDENCE) / 2) for hits in (first_only, second_only))
    return one[0] - other[1], one[1] - other[0]


def holm(p_values: Sequence[float]) -> list[float]:
    """Return Holm-adjusted p-values: the chance of one or more false positives is as small as with a single test."""
    adjusted, least = [0.0] * len(p_values), 0.0
    for rank, place in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        least = adjusted[place] = max(least, min(1.0, (len(p_values) - rank) * p_values[place]))
    return adjusted


def _at_most(hits: int, trials: int, share: float) -> float:
    """Return the probability of at most ``hits`` hits if the true share is ``share``."""
    if share <= 0.0 or share >= 1.0:
        return float(share <= 0.0)
    hit, miss = math.log(share), math.log1p(-share)
    most = math.lgamma(trials + 1)
    return math.fsum(
        math.exp(most - math.lgamma(k + 1) - math.lgamma(trials - k + 1) + k * hit + (trials - k) * miss)
        for k in range(hits + 1)
    )


def percent(share: float) -> str:
    """Format a share as a percentage with two significant digits, or three above 10 %."""
    value = 100 * share
    digits = 0 if value in (0, 100) else 1 if value >= 1 else 2
    return f"{value:.{digits}f} %"


def none_text(trials: int, what: str = "scenarios") -> str:
    """Return what no hit in independent random trials says: ``, so in at most 2.0 % of such scenarios, with ...``."""
    most = 100 * upper_bound(0, trials) - 1e-9  # or its last bit would decide on the rounding up
    rounded = math.ceil(10 * most) / 10 if most < 10 else math.ceil(most)
    return f", so in at most {rounded:g} % of such {what}, with 95 % confidence"


def interval_text(hits: int, trials: int) -> str:
    """Format a share with its interval: ``3.8 % (95 %: 2.7 to 5.2 %)``, or ``0 % (95 %: at most 0.37 %)``."""
    low, high = interval(hits, trials)
    if hits == 0:
        return f"0 % (95 %: at most {percent(high)})"
    return f"{percent(hits / trials)} (95 %: {percent(low).removesuffix(' %')} to {percent(high)})"
