"""Tools that every package of the plugin may need. They know nothing about scenarios.

This module has those that every session needs from its start. A test may freeze the clock with freezegun, which then
replaces the functions of ``time`` and the classes of ``datetime`` in all modules; this one is imported before that.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Any

monotonic = partial(time.perf_counter)
"""A clock that only goes forward [s], also where a test freezes the clock: freezegun replaces no ``partial``."""

_ISOLATES: list[Callable[[], bool]] = [lambda: False]


def import_late(name: str) -> Any:
    """Import a library that only some runs need, with the true classes of ``datetime``.

    Parts of pandas are compiled for these. If it is first imported with those of freezegun, the process dies.
    """
    shown = {each: vars(datetime)[each] for each in ("date", "datetime")}
    for each, cls in shown.items():
        setattr(datetime, each, next(base for base in cls.__mro__ if base.__module__ == "datetime"))
    try:
        return import_module(name)
    finally:
        vars(datetime).update(shown)


@contextmanager
def isolating(asked: Callable[[], bool]) -> Iterator[None]:
    """Let :func:`isolates` call a function in this context. It is only called then, since it may refuse an option."""
    _ISOLATES.append(asked)
    try:
        yield
    finally:
        _ISOLATES.pop()


def isolates() -> bool:
    """Return whether a policy drives in another process first; False outside of a test.

    The plugin knows that of the test that runs, and the fixture ``pafot_simulate`` does not get it as an argument.

    Raises:
        RequestError: if an option on which that depends is wrong.
    """
    return _ISOLATES[-1]()
