"""The end of an ADS, when the run that it drives is over."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pytest_pafot.world.driving.failure import UNFIT, error_of
from pytest_pafot.world.driving.hang_guard import HangGuard


@contextmanager
def closing(ads: Any, hang_limit: float) -> Iterator[None]:
    """Call the method ``close`` of an ADS, where it has one, when a ``with`` block ends, however that ends.

    What the ADS has driven by then counts as it was: where ``close`` raises, or takes longer than ``hang_limit`` [s], a
    ``RuntimeWarning`` says so.
    """
    try:
        yield
    finally:
        close = None if isinstance(ads, type) else getattr(ads, "close", None)
        if callable(close):
            _close(close, HangGuard(hang_limit))


def _close(close: Callable[[], Any], guard: HangGuard) -> None:
    try:
        with guard:
            guard.decision_starts()
            try:
                close()
            finally:
                guard.decision_ends()
    except UNFIT as error:
        failed = error_of(error, 0, guard)
        what = f"that it takes at most the hang limit, {guard.limit:g} s" if failed.interrupted else "no exception"
        received = "one that was interrupted then" if failed.interrupted else f"{failed.kind}: {failed.message}"
        text = f"ads.close: expected {what}, received {received}; the run before it counts as it was"
        warnings.warn(text, RuntimeWarning, stacklevel=2)
