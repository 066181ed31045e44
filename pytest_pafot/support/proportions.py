"""Shares of trials: exact intervals, and an exact test of two shares on the same trials. Pure, without libraries.

Sources: Clopper, Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
Biometrika 26(4), 1934; McNemar, "Note on the sampling error of the difference between correlated proportions or
percentages", Psychometrika 12(2), 1947, in its exact form; Holm, "A simple sequentially rejective multiple test
procedure", Scandinavian Journal of Statistics 6(2), 1979.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

CONFIDENCE = 0.95


def interval(hits: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """The Clopper-Pearson interval of a share, which covers the true one with at least the confidence.

    From 0 where there is no hit, to 1 where there is nothing else.
    """
    beyond = (1 - confidence) / 2
    return 1 - upper_bound(trials - hits, trials, 1 - beyond), upper_bound(hits, trials, 1 - beyond)


def upper_bound(hits: int, trials: int, confidence: float = CONFIDENCE) -> float:
    """The share above which the true one lies with at most ``1 - confidence``: one end of an interval."""
    if hits >= trials:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(60):  # to the last bit, by bisection
        middle = (low + high) / 2
        if _at_most(hits, trials, middle) > 1 - confidence:
            low = middle
        else:
            high = middle
    return high


def mcnemar(first_only: int, second_only: int) -> float:
    """Two-sided p of trials that only the first hit, and only the second, of two on the same trials."""
    trials = first_only + second_only
    return 1.0 if trials == 0 else min(1.0, 2 * _at_most(min(first_only, second_only), trials, 0.5))


def difference(first_only: int, second_only: int, trials: int) -> tuple[float, float]:
    """Return an interval of the first's share less the second's, which covers the true one with at least 95 %.

    Each of the two shares of trials that tell them apart is in its own interval with 97.5 %.
    """
    one, other = (interval(hits, trials, (1 + CONFIDENCE) / 2) for hits in (first_only, second_only))
    return one[0] - other[1], one[1] - other[0]


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number, so that one test of many is no more likely to err than one alone."""
    adjusted, least = [0.0] * len(p_values), 0.0
    for rank, place in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        least = adjusted[place] = max(least, min(1.0, (len(p_values) - rank) * p_values[place]))
    return adjusted


def _at_most(hits: int, trials: int, share: float) -> float:
    """The probability of so many hits or fewer."""
    if share <= 0.0 or share >= 1.0:
        return float(share <= 0.0)
    hit, miss = math.log(share), math.log1p(-share)
    most = math.lgamma(trials + 1)
    return math.fsum(
        math.exp(most - math.lgamma(k + 1) - math.lgamma(trials - k + 1) + k * hit + (trials - k) * miss)
        for k in range(hits + 1)
    )


def percent(share: float) -> str:
    """As text with two digits that count, or three above 10 %."""
    value = 100 * share
    digits = 0 if value in (0, 100) else 1 if value >= 1 else 2
    return f"{value:.{digits}f} %"


def interval_text(hits: int, trials: int) -> str:
    """``3.8 % (95 %: 2.7 to 5.2 %)``, or where there is no hit ``0 % (95 %: at most 0.37 %)``."""
    low, high = interval(hits, trials)
    if hits == 0:
        return f"0 % (95 %: at most {percent(high)})"
    return f"{percent(hits / trials)} (95 %: {percent(low).removesuffix(' %')} to {percent(high)})"
