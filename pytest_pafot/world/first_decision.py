"""What an ADS is given at its first decision and must return, for the message where it fails there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace
from pytest_pafot.world.driving.ads import AdsFactory
from pytest_pafot.world.kernel.observation import Observation


@dataclass(frozen=True, slots=True)
class FirstDecision:
    """How a world asks an ADS."""

    is_si: bool
    """Whether the ADS is given a :class:`pafot.Observation`, rather than an environment's own."""
    text: str
    """A sentence that says what it is given and must return."""


def first_decision(rollout: Callable[[Scenario, AdsFactory], Trace], scenario: Scenario) -> FirstDecision | None:
    """How a world, by its ``rollout``, asks at first in a scenario; None where it does not come so far."""
    seen: list[Any] = []
    trace = rollout(scenario, lambda: seen.append)  # returns None, so that the message says what is expected
    if not seen or trace.error is None:
        return None
    expected = trace.error.message.removeprefix("expected ").partition(", received")[0]
    is_si = isinstance(seen[0], Observation)
    return FirstDecision(is_si, f"The ADS was given {_described(seen[0])}, and must return {expected}.")


def _described(observation: Any) -> str:
    if isinstance(observation, Observation):
        fields = "time, ego, others, lanes, lane_width, speed_limit"
        return f"a pafot.Observation ({fields}, and .array of shape {observation.array.shape})"
    shape = getattr(observation, "shape", None)
    if shape is None:
        return f"a {type(observation).__name__}"
    return f"an array of shape {tuple(shape)} and type {observation.dtype}"
