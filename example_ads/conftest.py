"""The policies under test, as the factories that ``@pafot.search`` asks for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from example_ads import constant_speed, idm_mobil


@pytest.fixture(params=["constant-speed", "idm-mobil"])
def ads(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Makes one fresh ADS per scenario; each policy becomes a test of its own."""
    return constant_speed.make if request.param == "constant-speed" else idm_mobil.make


@pytest.fixture
def fiss() -> Callable[..., Any]:
    """Makes one fresh FISS+ planner per scenario, where the extra is installed."""
    pytest.importorskip("fiss_planner", reason='needs pip install "pytest-pafot[fiss]"')
    from example_ads import fiss as module  # noqa: PLC0415

    return module.make
