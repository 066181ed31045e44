"""Versions of numpy's functions that round like the C library and IEEE 754, for single numbers and points.

On some processors, numpy rounds tan, arctan, arctan2, arcsin and power differently from the C library, and its dot
product and norm multiply and add in one operation. So highway-env's results differ between machines. To compare
equations to the last bit on every machine, highway-env gets the C library's functions, and a dot product and a norm
that round each product.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np


def _power(base: float, exponent: float) -> float:
    # numpy also squares by a multiplication
    return base * base if exponent == 2 else math.pow(base, exponent)


FUNCTIONS: dict[str, Callable[..., float]] = {
    "tan": math.tan, "arctan": math.atan, "arctan2": math.atan2, "arcsin": math.asin, "sin": math.sin, "cos": math.cos,
    "power": _power,
}  # fmt: skip


def of_the_c_library(name: str) -> Callable[..., Any]:
    """Return a numpy function that rounds like the C library for single numbers."""
    numpys, maths = getattr(np, name), FUNCTIONS[name]

    def function(x: Any, *args: Any, **kwargs: Any) -> Any:
        # numpy's own answer is slow for numbers
        is_single = isinstance(x, (float, int, np.number)) or not np.ndim(x)
        return np.float64(maths(x, *args, **kwargs)) if is_single else numpys(x, *args, **kwargs)

    return function


def dot_of_products() -> Callable[[Any, Any], Any]:
    """Return a version of ``numpy.dot`` that rounds both products of two points, then their sum."""
    numpys = np.dot

    def dot(a: Any, b: Any) -> Any:
        if type(a) is type(b) is np.ndarray:  # `np.shape` takes longer than the products
            are_points = a.shape == b.shape == (2,)
        else:
            are_points = np.shape(a) == np.shape(b) == (2,)
        return a[0] * b[0] + a[1] * b[1] if are_points else numpys(a, b)

    return dot


def norm_of_products() -> Callable[..., Any]:
    """Return a version of ``numpy.linalg.norm`` that rounds both squares of a point, then their sum."""
    numpys = np.linalg.norm

    def norm(x: Any, *args: Any, **kwargs: Any) -> Any:
        return (
            np.sqrt(x[0] * x[0] + x[1] * x[1])
            if np.shape(x) == (2,)
            else numpys(x, *args, **kwargs)
        )

    return norm


@contextmanager
def c_library() -> Iterator[None]:
    """Replace these functions of numpy for the length of a ``with`` block, for every caller."""
    functions = {"dot": dot_of_products(), **{name: of_the_c_library(name) for name in FUNCTIONS}}
    with patch.multiple(np, **functions), patch.object(np.linalg, "norm", norm_of_products()):
        yield
