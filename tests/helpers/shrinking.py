"""Shrinking by functions that answer its questions."""

from pytest_pafot.findings import shrink as shrinking
from pytest_pafot.findings.shrink import Ahead, Attempt, Likely


def shrink(
    scenario,
    attempt,
    *,
    starts=lambda scenario: (),
    expect=lambda candidates, more: None,
    likely=None,
    measure=None,
    **options,
):
    """Return the simplest scenario and the statistics.

    ``attempt`` returns a candidate as driven if it fails, else None; ``measure`` does so when only speeds are measured.
    """
    has_measure = measure is not None
    questions = shrinking.shrink(scenario, asks_likely=likely is not None, measures_again=has_measure, **options)
    answer = None
    try:
        while True:
            match question := questions.send(answer):
                case Attempt(candidate, best):
                    driven = measure(candidate) if has_measure and best is None else attempt(candidate)
                    answer = None if driven is None else (driven, starts(driven))
                case Likely():
                    answer = likely(*question)
                case Ahead():
                    answer = expect(*question)
    except StopIteration as done:
        return done.value
