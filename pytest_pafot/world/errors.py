"""Errors of the world that are the user's to mend, each with the way out in its message."""

from __future__ import annotations

from pytest_pafot.errors import FieldError


class WorldError(FieldError):
    """A world, or a scenario for it, that cannot be run."""


class AdsFactoryError(TypeError):
    """What was given as the ADS factory does not make an ADS for this world."""
