"""The limits and errors of an ADS's perception of other vehicles."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np

from pytest_pafot.model.instructions import set_fields
from pytest_pafot.model.scenario import rng_of
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.support.errors import FieldError, plain_number
from pytest_pafot.support.text import listed

Noise = Literal["position", "speed"]
NOISES = {"position": "m", "speed": "m/s"}  # the kinds of noise and their units


@dataclass(frozen=True, kw_only=True)
class Sight:
    """The limits and errors of perception.

    Attributes:
        range: largest distance [m], from centre to centre, at which other vehicles are seen; None for no limit.
        latency: time [s] from the measurement of the vehicles to the decision that uses it.
        noise: standard deviations of the normal errors in ``position`` [m], along x and y, and in ``speed`` [m/s],
            sampled for each vehicle and decision.
        dropout: probability that a vehicle is not seen at a decision.
    """

    range: float | None = None
    latency: float = 0.0
    noise: Mapping[Noise, float] = field(default_factory=dict, hash=False)
    dropout: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.noise, Mapping) or not self.noise.keys() <= NOISES.keys():
            expected = 'a mapping with the keys "position" [m], "speed" [m/s] or both'
            raise FieldError(field="noise", expected=expected, received=f"{self.noise!r:.100}")
        noise = {}
        for key, value in self.noise.items():
            deviation = float(_number(f"noise.{key}", value, NOISES[key]))
            if deviation:
                noise[key] = deviation
        set_fields(
            self,
            noise=noise,
            latency=_number("latency", self.latency, "s"),
            dropout=_number("dropout", self.dropout, "", 1.0),
        )
        if self.range is not None:
            set_fields(self, range=_number("range", self.range, "m"))

    @property
    def imperfections(self) -> dict[str, Any]:
        found = {each.name: getattr(self, each.name) for each in fields(Sight)}
        for name, value in [*found.items()]:
            # a range of 0 is a limit, unlike 0 in the other fields
            if value is None or (not value and name != "range"):
                del found[name]
        return found

    @property
    def is_drawn(self) -> bool:
        # Only then does the seed of a scenario make a difference.
        return bool(self.noise or self.dropout)

    @property
    def described(self) -> str:
        told = []
        if self.range is not None:
            told.append(f"a range of {self.range:g} m")
        if self.latency:
            told.append(f"{self.latency:g} s of latency")
        if self.noise:
            noise = [f"{value:g} {NOISES[key]}" for key, value in self.noise.items()]
            told.append(f"noise of {listed(noise)}")
        if self.dropout:
            told.append(f"{100 * self.dropout:g} % dropout")
        return listed(told or ["perfect perception"])

    def delay(self, hz: float) -> int:
        # In ticks, rounded up.
        return math.ceil(self.latency * hz - 1e-9)

    def glimpses(
        self,
        states: FloatArray,
        seed: int,
        tick: int,
    ) -> list[tuple[int, float, float, float]]:
        # The index and the measurement errors of each vehicle that is seen.
        # `states` has the shape [vehicles, 7], with the ego first. The errors are those of x [m], y [m] and speed
        # [m/s]. Their random numbers depend only on the seed and the tick.
        others = len(states) - 1
        errors = np.zeros((others, 3))
        seen = np.ones(others, dtype=bool)
        if self.range is not None:
            x, y = (states[1:, :2] - states[0, :2]).T
            seen = np.hypot(x, y) <= self.range
        if self.is_drawn:
            random = rng_of([seed, tick])
            seen &= random.random(others) >= self.dropout
            deviations = [self.noise.get(name, 0.0) for name in ("position", "position", "speed")]
            errors = random.standard_normal((others, 3)) * deviations
        return [(index, *errors[index].tolist()) for index in np.flatnonzero(seen).tolist()]


def _number(name: str, value: object, unit: str, most: float = math.inf) -> float:
    number = plain_number(value)
    if number is None or not 0 <= number <= most:
        expected = f"a number from 0 to {most:g}"
        if unit:
            expected = f"a finite value of at least 0 {unit}"
        raise FieldError(field=name, expected=expected, received=f"{value!r:.100}")
    return number
