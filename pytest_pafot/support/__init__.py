"""A clock, deferred imports, and the isolation of policies in tests."""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Any

# A monotonic clock [s], even if a test freezes the time: freezegun replaces functions of `time` and classes of
# `datetime` in all modules, but not a `partial`.
monotonic = partial(time.perf_counter)

_ISOLATES: list[Callable[[], bool]] = [lambda: False]


def import_late(name: str) -> Any:
    """Import a library with the original ``datetime`` classes, even if a test has frozen the time."""
    # Parts of pandas are compiled for these classes. If the import finds freezegun's classes instead, the process dies.
    shown = {each: vars(datetime)[each] for each in ("date", "datetime")}
    for each, cls in shown.items():
        setattr(datetime, each, next(base for base in cls.__mro__ if base.__module__ == "datetime"))
    try:
        return import_module(name)
    finally:
        vars(datetime).update(shown)


@contextmanager
def isolating(asked: Callable[[], bool]) -> Iterator[None]:
    """Make :func:`isolates` return the result of ``asked`` in this context."""
    _ISOLATES.append(asked)  # called only if needed, because it may reject an option
    try:
        yield
    finally:
        _ISOLATES.pop()


def isolates() -> bool:
    """Return whether a policy must first drive in another process. Outside a test, this is False."""
    # Only the plugin knows the options of the running test. The fixture `pafot_simulate` does not receive them.
    return _ISOLATES[-1]()
