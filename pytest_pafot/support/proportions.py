"""Exact confidence intervals and tests of proportions, without numpy."""

from __future__ import annotations

import math
from collections.abc import Sequence

# Sources: Clopper, Pearson, Biometrika 26(4), 1934; McNemar, Psychometrika 12(2), 1947, in its exact form; Holm,
# Scandinavian Journal of Statistics 6(2), 1979; Wald, The Annals of Mathematical Statistics 16(2), 1945.

CONFIDENCE = 0.95
# The maximum probability with which a comparison of two policies reports a difference that does not exist. Policies are
# compared after each change. With 0.05, one harmless change in twenty might be reported as worse.
LEVEL = 0.01
# Of the trials that only one of two policies hits, a clearly worse policy hits this proportion.
WORSE = 0.7
# The maximum probability with which a clearly worse policy is reported as no worse.
MISSED = 0.05
_UNEVEN = math.log((1 - MISSED) / LEVEL)
_EVEN = math.log(MISSED / (1 - LEVEL))
# With fewer trials that only one policy hits, `hits_more` cannot give a result.
FEWEST = math.ceil(-math.log2(LEVEL))


def interval(hits: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the Clopper-Pearson interval of a proportion."""
    # The interval starts at 0 if there is no hit, and ends at 1 if every trial is a hit.
    one_sided = 1 - (1 - confidence) / 2
    low = 1 - upper_bound(trials - hits, trials, one_sided)
    return low, upper_bound(hits, trials, one_sided)


def upper_bound(hits: int, trials: int, confidence: float) -> float:
    """Return the one-sided upper Clopper-Pearson limit of a proportion."""
    if hits >= trials:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(60):  # bisection; 60 halvings reach the last bit of a float
        middle = (low + high) / 2
        if _at_most(hits, trials, middle) > 1 - confidence:
            low = middle
        else:
            high = middle
    return high


def mcnemar(first_only: int, second_only: int) -> float:
    """Return the two-sided p-value of McNemar's test."""
    trials = first_only + second_only  # the trials that only one of the two policies hits
    return min(1.0, 2 * _at_most(min(first_only, second_only), trials, 0.5))


def hits_more(first_only: int, second_only: int, *, is_last: bool = False) -> bool | None:
    """Return whether the first policy hits more of the same trials than the second, or None if that is unclear."""
    # Wald's sequential test, so that clear cases end early. Of the trials that only one policy hits, the first hits
    # half if both are equal, and WORSE if it is clearly worse. After the last trial, the exact sign test decides.
    for_first = first_only * math.log(2 * WORSE)
    evidence = for_first + second_only * math.log(2 * (1 - WORSE))
    if not _EVEN < evidence < _UNEVEN:
        return evidence > 0
    if not is_last or first_only + second_only < FEWEST:
        return None
    return first_only > second_only and mcnemar(first_only, second_only) <= 2 * LEVEL  # one-sided


def difference(first_only: int, second_only: int, trials: int) -> tuple[float, float]:
    """Return an interval, with at least 95 % confidence, for the first proportion minus the second."""
    # Each of the two intervals has a confidence of 97.5 %.
    confidence = (1 + CONFIDENCE) / 2
    low, high = interval(first_only, trials, confidence)
    other_low, other_high = interval(second_only, trials, confidence)
    return low - other_high, high - other_low


def holm(p_values: Sequence[float]) -> list[float]:
    """Return Holm-adjusted p-values."""
    # The probability of any false positive is then as low as in a single test.
    adjusted = [*p_values]
    least = 0.0
    order = sorted(range(len(adjusted)), key=p_values.__getitem__)
    for rank, index in enumerate(order):
        p = min(1.0, (len(order) - rank) * p_values[index])
        least = max(least, p)
        adjusted[index] = least
    return adjusted


def _at_most(hits: int, trials: int, share: float) -> float:
    # The probability of at most `hits` hits if the true proportion is `share`.
    if share <= 0.0 or share >= 1.0:
        return float(share <= 0.0)
    hit = math.log(share)
    miss = math.log1p(-share)
    most = math.lgamma(trials + 1)
    terms = []
    for k in range(hits + 1):
        ways = most - math.lgamma(k + 1) - math.lgamma(trials - k + 1)
        terms.append(math.exp(ways + k * hit + (trials - k) * miss))
    return math.fsum(terms)


def percent(share: float) -> str:
    """Format a proportion as a percentage with two significant digits, or three above 10 %."""
    value = 100 * share
    if value in (0, 100):
        return f"{value:.0f} %"
    if value >= 1:
        return f"{value:.1f} %"
    return f"{value:.2f} %"


def none_text(trials: int, what: str = "scenarios") -> str:
    """Return the end of a sentence about trials without hits, such as ``, so it occurs in at most 2 % of ...``."""
    return f", so it occurs in {_most_without_hits(trials)} of such {what} (95 % confidence)"


def _most_without_hits(trials: int) -> str:
    # otherwise, its last bit would decide whether it is rounded up
    most = 100 * interval(0, trials)[1] - 1e-9
    parts = 100  # of a percent
    if most >= 10:
        parts = 1
    elif most >= 1:
        parts = 10
    return f"at most {math.ceil(most * parts) / parts:g} %"


def interval_text(hits: int, trials: int) -> str:
    """Format a proportion with its interval, such as ``3.8 % (95 %: 2.7 to 5.2 %)``."""
    if hits == 0:
        return f"0 % (95 %: {_most_without_hits(trials)})"
    low, high = interval(hits, trials)
    return f"{percent(hits / trials)} (95 %: {percent(low).removesuffix(' %')} to {percent(high)})"
