"""Whether a test that calls a function of this package drives policies in another process first.

The plugin knows that of the test that runs, and the fixture ``pafot_simulate`` does not get it as an argument.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_ISOLATES: ContextVar[Callable[[], bool]] = ContextVar("pafot_isolates", default=lambda: False)


@contextmanager
def isolating(asked: Callable[[], bool]) -> Iterator[None]:
    """Let :func:`isolates` call a function in this context. It is only called then, since it may refuse an option."""
    token = _ISOLATES.set(asked)
    try:
        yield
    finally:
        _ISOLATES.reset(token)


def isolates() -> bool:
    """Return whether a policy drives in another process first; False outside of a test.

    Raises:
        RequestError: if an option on which that depends is wrong.
    """
    return _ISOLATES.get()()
