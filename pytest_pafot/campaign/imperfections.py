"""Which imperfections of an ADS's sight a failure needs."""

from __future__ import annotations

from collections.abc import Callable

from pytest_pafot.sight import Sight


def needed_imperfections(sight: Sight, fails: Callable[[Sight], bool]) -> tuple[str, ...]:
    """Names of those without which a test does not fail; none where it fails also with perfect sight.

    With several, each in turn is left out for good where the test still fails without it. So none of those that remain
    can be spared, though others may do as well. It takes a run for perfect sight, and one for each where there are
    several.

    Args:
        sight: with which the test fails.
        fails: whether it does with another one.
    """
    if fails(sight.only(())):
        return ()
    needed = sight.imperfections
    for name in sight.imperfections:
        others = tuple(each for each in needed if each != name)
        if others and fails(sight.only(others)):
            needed = others
    return needed
