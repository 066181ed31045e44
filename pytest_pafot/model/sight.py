"""The sight of an ADS: how far, how late, how exactly and how often it sees other vehicles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.trace import FloatArray
from pytest_pafot.support.errors import FieldError, plain_number
from pytest_pafot.support.text import listed

BoolArray = npt.NDArray[np.bool_]

NOISES = {"position": "m", "speed": "m/s"}
"""The kinds of noise and their units."""


class Glimpse(NamedTuple):
    """The errors with which the ego sees one other vehicle in a decision.

    Attributes:
        other: index of the vehicle among all vehicles except the ego, from 0.
        x, y: errors that are added to the vehicle's position [m].
        speed: error that is added to the vehicle's speed [m/s].
    """

    other: int
    x: float = 0.0
    y: float = 0.0
    speed: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """The limits and errors with which an ADS sees other vehicles; by default there are none.

    Attributes:
        range: largest distance at which other vehicles are seen, from centre to centre [m]; None for no limit.
        latency: time between the measurement of the vehicles and the decision that uses it [s].
        noise: standard deviations of the normally distributed errors of the vehicles' ``position``, along x and along
            y [m], and of their ``speed`` [m/s]. Errors are sampled again for each vehicle and decision.
        dropout: probability that a vehicle is not seen in a decision.

    Raises:
        FieldError: if a value is not valid.
    """

    range: float | None = None
    latency: float = 0.0
    noise: Mapping[str, float] = field(default_factory=dict)
    dropout: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.noise, Mapping) or not self.noise.keys() <= NOISES.keys():
            expected = 'a mapping of "position" [m] and "speed" [m/s], one of them or both'
            raise FieldError(field="noise", expected=expected, received=f"{self.noise!r:.100}")
        noise = {key: float(_number(f"noise.{key}", value, NOISES[key])) for key, value in self.noise.items()}
        checked = {
            "range": None if self.range is None else _number("range", self.range, "m"),
            "latency": _number("latency", self.latency, "s"),
            "noise": {key: value for key, value in noise.items() if value},
            "dropout": _number("dropout", self.dropout, "", 1.0),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def imperfections(self) -> dict[str, Any]:
        """The attributes that limit or disturb the sight, as plain data."""
        return {each.name: getattr(self, each.name) for each in fields(Sight) if self.is_imperfect(each.name)}

    def is_imperfect(self, name: str) -> bool:
        """Return whether one attribute limits or disturbs the sight."""
        value = getattr(self, name)
        return value is not None if name == "range" else bool(value)

    @property
    def is_drawn(self) -> bool:
        """True if chance affects what is seen, so that the seed of a scenario makes a difference."""
        return bool(self.noise or self.dropout)

    @property
    def described(self) -> str:
        """All imperfections in words, such as ``a range of 60 m and 0.3 s of latency``."""
        texts = {
            "range": f"a range of {self.range or 0.0:g} m",
            "latency": f"{self.latency:g} s of latency",
            "noise": f"noise of {listed([f'{value:g} {NOISES[key]}' for key, value in self.noise.items()])}",
            "dropout": f"{100 * self.dropout:g} % dropout",
        }
        return listed([texts[name] for name in self.imperfections] or ["perfect sight"])

    def delay(self, hz: int) -> int:
        """Return the latency in ticks, rounded up, for ``hz`` ticks per second."""
        return math.ceil(self.latency * hz - 1e-9)

    def glimpses(self, states: FloatArray, seed: int, tick: int) -> Iterator[Glimpse]:
        """Yield one glimpse for each other vehicle that the ego sees in the decision at a tick.

        Args:
            states: states of all vehicles when they were measured, shape [vehicles, 7], the ego first; columns as in
                :class:`pytest_pafot.VehicleState`.
            seed: seed of all random numbers in the run. Those of a decision depend only on the seed and the tick.
            tick: tick of the decision.
        """
        others = len(states) - 1
        seen = np.ones(others, dtype=bool)
        if self.range is not None:
            seen &= np.hypot(*(states[1:, :2] - states[0, :2]).T) <= self.range
        errors = np.zeros((others, 3))
        if self.is_drawn:
            random = np.random.default_rng([seed, tick])
            seen &= random.random(others) >= self.dropout
            deviations = [self.noise.get(name, 0.0) for name in ("position", "position", "speed")]
            errors = random.standard_normal((others, 3)) * deviations
        for index in np.flatnonzero(seen).tolist():
            yield Glimpse(index, *errors[index].tolist())


@dataclass(frozen=True, slots=True, kw_only=True)
class SightWithout(Sight):
    """A sight in which, in addition, one NPC is never seen.

    Attributes:
        npc: the NPC's index in the scenario.
    """

    npc: int

    def glimpses(self, states: FloatArray, seed: int, tick: int) -> Iterator[Glimpse]:
        """Yield the glimpses of :meth:`Sight.glimpses` without those of the hidden NPC."""
        return (each for each in Sight.glimpses(self, states, seed, tick) if each.other != self.npc)


def _number(name: str, value: object, unit: str, most: float = math.inf) -> float:
    number = plain_number(value)
    if number is None or not 0 <= number <= most:
        of = f" [{unit}]" if unit else ""
        expected = f"a finite number from 0{of}" if most == math.inf else f"a number from 0 to {most:g}{of}"
        raise FieldError(field=name, expected=expected, received=f"{value!r:.100}")
    return number
