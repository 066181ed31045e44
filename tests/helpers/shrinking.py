"""Shrinking by functions that answer its questions."""

from pytest_pafot.findings import shrink as shrinking
from pytest_pafot.findings.shrink import Ahead, Attempt, Likely, sort_key


def shrink(
    scenario,
    attempt,
    *,
    starts=lambda scenario: (),
    expect=lambda candidates, more: None,
    likely=None,
    **options,
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


def shrunk_by(given, fails, *, rollouts, **options):
    """Shrink by a predicate, and check everything that must be true of every result."""
    asked = []

    def attempt(candidate):
        asked.append(candidate)
        return candidate if fails(candidate) else None

    simplest, how = shrink(given, attempt, rollouts=rollouts, **options)
    assert len(asked) == len(set(asked)) == how.rollouts <= rollouts, (
        "asked twice, or more often than allowed"
    )
    assert fails(simplest), "the result does not fail"
    assert sort_key(simplest) <= sort_key(given), "the result is larger"
    return simplest, how
