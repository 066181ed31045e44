"""Shrinking by functions that answer its questions."""

from pytest_pafot.findings import shrink as shrinking
from pytest_pafot.findings.shrink import Ahead, Attempt, Likely


def shrink(
    scenario, attempt, *, starts=lambda scenario: (), expect=lambda candidates, more: None, likely=None, **options
):
    """Return the simplest scenario and the statistics.

    ``attempt`` returns a candidate as driven if it fails, else None.
    """
    questions = shrinking.shrink(scenario, asks_likely=likely is not None, **options)
    answer = None
    try:
        while True:
            match question := questions.send(answer):
                case Attempt(candidate, _):
                    driven = attempt(candidate)
                    answer = None if driven is None else (driven, starts(driven))
                case Likely():
                    answer = likely(*question)
                case Ahead():
                    answer = expect(*question)
    except StopIteration as done:
        return done.value
