"""Tools for all packages of the plugin."""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Any

# A monotonic clock [s], even if a test freezes the time: freezegun replaces functions of `time` and classes of
# `datetime` in all modules, but no `partial`.
monotonic = partial(time.perf_counter)

_ISOLATES: list[Callable[[], bool]] = [lambda: False]


def import_late(name: str) -> Any:
    """Import a library that only some runs need, while ``datetime`` has its original classes."""
    # Parts of pandas are compiled for these classes. If it is first imported with those of freezegun, the process dies.
    shown = {each: vars(datetime)[each] for each in ("date", "datetime")}
    for each, cls in shown.items():
        setattr(datetime, each, next(base for base in cls.__mro__ if base.__module__ == "datetime"))
    try:
        return import_module(name)
    finally:
        vars(datetime).update(shown)


@contextmanager
def isolating(asked: Callable[[], bool]) -> Iterator[None]:
    """Make :func:`isolates` call a function in this context."""
    _ISOLATES.append(asked)  # called only if needed, since it may reject an option
    try:
        yield
    finally:
        _ISOLATES.pop()


def isolates() -> bool:
    """Return whether a policy first drives in another process, or False outside of a test."""
    # The plugin knows it of the running test, and the fixture `pafot_simulate` does not get it as an argument.
    return _ISOLATES[-1]()
