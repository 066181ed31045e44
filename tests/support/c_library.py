"""numpy's functions of single numbers, rounded as the C library rounds them.

On some processors numpy rounds tan, arctan, arcsin and power otherwise than the C library does, and highway-env's
results differ between machines. To compare equations to the last bit on all of them, highway-env gets the C library's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np


def _power(base: float, exponent: float) -> float:
    return base * base if exponent == 2 else math.pow(base, exponent)  # numpy squares by a multiplication, too


FUNCTIONS: dict[str, Callable[..., float]] = {
    "tan": math.tan, "arctan": math.atan, "arcsin": math.asin, "sin": math.sin, "cos": math.cos, "power": _power,
}  # fmt: skip


def of_the_c_library(name: str) -> Callable[..., Any]:
    """A numpy function that rounds as the C library does, for single numbers."""
    numpys, maths = getattr(np, name), FUNCTIONS[name]

    def function(x: Any, *args: Any, **kwargs: Any) -> Any:
        return numpys(x, *args, **kwargs) if np.ndim(x) else np.float64(maths(x, *args, **kwargs))

    return function


@contextmanager
def c_library() -> Iterator[None]:
    """Everybody who calls numpy by these names gets the C library's, for a while."""
    before = {name: getattr(np, name) for name in FUNCTIONS}
    try:
        for name in FUNCTIONS:
            setattr(np, name, of_the_c_library(name))
        yield
    finally:
        for name, function in before.items():
            setattr(np, name, function)
