"""Fixtures that return factories of the policies under test, as ``@pafot.search`` requires."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from example_ads import constant_speed, idm_mobil


@pytest.fixture(params=["constant-speed", "idm-mobil"])
def ads(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return a factory that creates a new ADS for each scenario. Each parameter is a separate test."""
    return constant_speed.make if request.param == "constant-speed" else idm_mobil.make


@pytest.fixture
def fiss() -> Callable[..., Any]:
    """Return a factory that creates a new FISS+ planner for each scenario. Requires the extra ``fiss``."""
    pytest.importorskip("fiss_planner", reason='requires pip install "pytest-pafot[fiss]"')
    from example_ads import fiss as module  # noqa: PLC0415

    return module.make


@pytest.fixture
def expert() -> Callable[..., Any]:
    """Return the factory of MetaDrive's PPO expert. Requires the extra ``metadrive``."""
    pytest.importorskip(
        "metadrive", reason='requires Python 3.11 and pip install "pytest-pafot[metadrive]"'
    )
    from pytest_pafot.simulators import metadrive  # noqa: PLC0415

    return metadrive.expert
