"""Fixtures with the policies under test, as the factories that ``@pafot.search`` requires."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from example_ads import constant_speed, idm_mobil


@pytest.fixture(params=["constant-speed", "idm-mobil"])
def ads(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return a factory that makes a fresh ADS for each scenario; each policy becomes its own test."""
    return constant_speed.make if request.param == "constant-speed" else idm_mobil.make


@pytest.fixture
def fiss() -> Callable[..., Any]:
    """Return a factory that makes a fresh FISS+ planner for each scenario; needs the extra ``fiss``."""
    pytest.importorskip("fiss_planner", reason='needs pip install "pytest-pafot[fiss]"')
    from example_ads import fiss as module  # noqa: PLC0415

    return module.make


@pytest.fixture
def expert() -> Callable[..., Any]:
    """Return the factory of MetaDrive's PPO expert; needs the extra ``metadrive``."""
    pytest.importorskip("metadrive", reason='needs Python 3.11 and pip install "pytest-pafot[metadrive]"')
    from pytest_pafot.simulators import metadrive  # noqa: PLC0415

    return metadrive.expert
