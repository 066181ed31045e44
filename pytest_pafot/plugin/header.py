"""One line of the header of a verbose session: how the kernel runs, found out without importing it.

Registered with ``-v`` alone.
"""

from __future__ import annotations

import os
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

KERNEL = Path(__file__).parents[1] / "world" / "kernel"


def pytest_report_header() -> str:
    """Compiled, interpreted since nothing is compiled, or interpreted as the environment demands."""
    if not any((KERNEL / f"loop{suffix}").exists() for suffix in EXTENSION_SUFFIXES):
        return "pafot: kernel interpreted (not compiled at installation)"
    if os.environ.get("PAFOT_KERNEL") == "interpreted":
        return "pafot: kernel interpreted (PAFOT_KERNEL)"
    return "pafot: kernel compiled"
