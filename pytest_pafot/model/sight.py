"""The sight of an ADS: how far, how late, how exactly and how often it sees other vehicles, and what hides them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.trace import FloatArray
from pytest_pafot.support.errors import FieldError, plain_number

BoolArray = npt.NDArray[np.bool_]

NOISES = {"position": "m", "speed": "m/s"}
"""The kinds of noise and their units."""

POINTS = np.array([(0.0, 0.0), (0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)])
"""The points of a vehicle's box that the ego looks at: centre and corners, as multiples of its length and width."""


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
        occlusion: whether a vehicle hides the vehicles behind it, see :func:`hidden`.

    Raises:
        FieldError: if a value is not valid.
    """

    range: float | None = None
    latency: float = 0.0
    noise: Mapping[str, float] = field(default_factory=dict)
    dropout: float = 0.0
    occlusion: bool = False

    def __post_init__(self) -> None:
        if self.range is not None:
            object.__setattr__(self, "range", _number("range", self.range, "m"))
        object.__setattr__(self, "latency", _number("latency", self.latency, "s"))
        if not isinstance(self.noise, Mapping) or not self.noise.keys() <= NOISES.keys():
            expected = 'a mapping of "position" [m] and "speed" [m/s], one of them or both'
            raise FieldError(field="noise", expected=expected, received=f"{self.noise!r:.100}")
        noise = {name: float(_number(f"noise.{name}", value, NOISES[name])) for name, value in self.noise.items()}
        object.__setattr__(self, "noise", {name: deviation for name, deviation in noise.items() if deviation})
        object.__setattr__(self, "dropout", _number("dropout", self.dropout, "", 1.0))
        if not isinstance(self.occlusion, bool):
            raise FieldError(field="occlusion", expected="True or False", received=f"{self.occlusion!r:.100}")

    @property
    def imperfections(self) -> tuple[str, ...]:
        """The names of the attributes that limit or disturb the sight, in the order of the attributes."""
        return tuple(each.name for each in fields(Sight) if getattr(self, each.name) != getattr(_PERFECT, each.name))

    @property
    def is_drawn(self) -> bool:
        """True if chance affects what is seen, so that the seed of a scenario makes a difference."""
        return bool(self.noise or self.dropout)

    @property
    def is_memoryless(self) -> bool:
        """True if the sight depends only on the vehicles' present positions, neither on the past nor on chance."""
        return not (self.latency or self.is_drawn)

    def only(self, names: Collection[str]) -> Self:
        """Return this sight with only the named imperfections; everything else is perfect."""
        return replace(self, **{name: getattr(_PERFECT, name) for name in self.imperfections if name not in names})

    def to_dict(self) -> dict[str, Any]:
        """Return the imperfections and their values as plain data."""
        return {name: getattr(self, name) for name in self.imperfections}

    def described(self, names: Collection[str] | None = None) -> str:
        """Describe all imperfections, or only the named ones, such as ``0.3 s of latency and occlusion``."""
        texts = {
            "range": f"a range of {self.range or 0.0:g} m",
            "latency": f"{self.latency:g} s of latency",
            "noise": f"noise of {' and '.join(f'{self.noise[name]:g} {NOISES[name]}' for name in self.noise)}",
            "dropout": f"{100 * self.dropout:g} % dropout",
            "occlusion": "occlusion",
        }
        told = [texts[name] for name in self.imperfections if names is None or name in names] or ["perfect sight"]
        return " and ".join(filter(None, [", ".join(told[:-1]), told[-1]]))

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
        if self.occlusion:
            seen &= ~hidden(states)
        errors = np.zeros((others, 3))
        if self.dropout or self.noise:
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
        npc: the NPC's index in the scenario; None for no NPC.
    """

    npc: int | None

    def glimpses(self, states: FloatArray, seed: int, tick: int) -> Iterator[Glimpse]:
        """Yield the glimpses of :meth:`Sight.glimpses` without those of the hidden NPC."""
        return (each for each in Sight.glimpses(self, states, seed, tick) if each.other != self.npc)


def hidden(states: FloatArray) -> BoolArray:
    """Return a mask of the other vehicles that the ego cannot see, shape [vehicles - 1].

    A vehicle is hidden if the five straight lines from the ego's centre to its centre and its four corners all run
    through boxes of other vehicles, not necessarily of the same vehicle. All vehicles have the same height.

    Args:
        states: see :meth:`Sight.glimpses`.
    """
    eye, others = states[0, :2], states[1:]
    centres, half = others[:, :2], others[:, 5:7] / 2
    cos, sin = np.cos(others[:, 2]), np.sin(others[:, 2])
    turns = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)  # from the road's frame to a box's own
    corners = np.einsum("tij,tpi->tpj", turns, 2 * POINTS * half[:, None])
    lines = centres[:, None] + corners - eye
    start = np.einsum("bij,bj->bi", turns, eye - centres)[:, None, None]
    way = np.einsum("bij,tpj->btpi", turns, lines)
    half = half[:, None, None]
    # A line along a side of a box divides by 0 or nearly 0: the infinities say whether it is next to the box or in it.
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        ends = np.stack([(-half - start) / way, (half - start) / way])
    enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    blocked = (enter < leave) & (enter < 1.0) & (leave > 0.0)
    blocked[np.arange(len(others)), np.arange(len(others))] = False  # no vehicle hides itself
    hides: BoolArray = blocked.any(axis=0).all(axis=1)
    return hides


def _number(name: str, value: object, unit: str, most: float = math.inf) -> float:
    number = plain_number(value)
    if number is None or not 0 <= number <= most:
        of = f" [{unit}]" if unit else ""
        expected = f"a finite number from 0{of}" if most == math.inf else f"a number from 0 to {most:g}"
        raise FieldError(field=name, expected=expected, received=f"{value!r:.100}")
    return number


_PERFECT = Sight()
