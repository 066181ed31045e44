"""How a test function discards a scenario.

The module is not called ``reject``: once imported, it would take the place of the function as ``pytest_pafot.reject``.
"""

from __future__ import annotations

from typing import NoReturn


class Rejected(BaseException):
    """Raised by :func:`reject`. No ``Exception``, so that the test's own handlers do not swallow it."""


def reject() -> NoReturn:
    """Discard the scenario that is running: it counts neither as passed nor as failed."""
    raise Rejected("pafot.reject() discards a scenario of a @pafot.search test; nothing else catches it")
