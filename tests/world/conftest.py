"""Environments that exist for one test."""

import gymnasium
import pytest


@pytest.fixture
def register(monkeypatch):
    """Register an environment for one test."""
    monkeypatch.setattr(gymnasium.envs.registration, "registry", {**gymnasium.registry})
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    return gymnasium.register
