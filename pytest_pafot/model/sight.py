"""The sight of an ADS: how far, how late, how exactly and how often it sees other vehicles, and what hides them.

Also in which order it sees them, the ghosts among them, and how exactly it knows its own state.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.trace import FloatArray
from pytest_pafot.support.errors import FieldError, plain_number
from pytest_pafot.support.text import listed

BoolArray = npt.NDArray[np.bool_]

NOISES = {"position": "m", "speed": "m/s"}
"""The kinds of noise and their units."""

OWN = {"position": "m", "heading": "rad", "speed": "m/s"}
"""The errors of the ego's own state and their units."""

GHOSTS = {"rate": "1/s", "lifetime": "s"}
"""The values of ghosts and their units."""

MOST_GHOSTS = 100.0
"""The largest rate of ghosts [1/s]. Each decision looks through all ghosts of the run so far."""

GHOST_AHEAD, GHOST_ASIDE, GHOST_SPEED = 100.0, 6.0, 5.0
"""Where ghosts appear, relative to the ego: largest distances along and across the road [m], and the standard deviation
of their speed [m/s]. To the sides these are the ego's lane and the lanes next to it, if they are 4 m wide."""

GHOST_LENGTH, GHOST_WIDTH = 5.0, 2.0
"""The size of a ghost [m], which is that of the NPCs."""

# Each kind of chance has random numbers of its own, so that no imperfection changes what is drawn for another one.
# NumPy fills seeds up with zeros, so these must not be 0: [seed, tick] are the seeds of noise and dropout.
_SHUFFLING, _GHOSTS, _OWN = 1, 2, 3

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


class Ghost(NamedTuple):
    """A vehicle that the ego sees and that does not exist.

    Attributes:
        number: how many ghosts appeared before it in the run.
        ahead, right: its place along and across the road, relative to the ego [m].
        faster: its speed relative to the ego's [m/s].
    """

    number: int
    ahead: float
    right: float
    faster: float


class OwnErrors(NamedTuple):
    """The errors with which the ego knows its own state in a run: x, y [m], heading [rad] and speed [m/s]."""

    x: float
    y: float
    heading: float
    speed: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """The limits and errors with which an ADS sees other vehicles and itself; by default there are none.

    Attributes:
        range: largest distance at which other vehicles are seen, from centre to centre [m]; None for no limit.
        latency: time between the measurement of the vehicles and the decision that uses it [s].
        noise: standard deviations of the normally distributed errors of the vehicles' ``position``, along x and along
            y [m], and of their ``speed`` [m/s]. Errors are sampled again for each vehicle and decision.
        dropout: probability that a vehicle is not seen in a decision.
        occlusion: whether a vehicle hides the vehicles behind it, see :func:`hidden`.
        shuffled: whether the other vehicles are in a random order, sampled again for each decision.
        ghosts: how many ghosts appear per second, ``rate`` [1/s], and their mean ``lifetime`` [s]; see
            :meth:`ghosts_at`.
        own_bias: standard deviations of the normally distributed errors of the ego's own ``position``, along x and
            along y [m], ``heading`` [rad] and ``speed`` [m/s]. Errors are sampled once for each run.

    Raises:
        FieldError: if a value is not valid.
    """

    range: float | None = None
    latency: float = 0.0
    noise: Mapping[str, float] = field(default_factory=dict)
    dropout: float = 0.0
    occlusion: bool = False
    shuffled: bool = False
    ghosts: Mapping[str, float] = field(default_factory=dict)
    own_bias: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.range is not None:
            object.__setattr__(self, "range", _number("range", self.range, "m"))
        object.__setattr__(self, "latency", _number("latency", self.latency, "s"))
        expected = 'a mapping of "position" [m] and "speed" [m/s], one of them or both'
        object.__setattr__(self, "noise", _without_zeros(_numbers("noise", self.noise, NOISES, expected)))
        object.__setattr__(self, "dropout", _number("dropout", self.dropout, "", 1.0))
        for name in ("occlusion", "shuffled"):
            if not isinstance(getattr(self, name), bool):
                raise FieldError(field=name, expected="True or False", received=f"{getattr(self, name)!r:.100}")
        expected = 'a mapping of "rate" [1/s] and "lifetime" [s], both of them'
        ghosts = _numbers("ghosts", self.ghosts, GHOSTS, expected, {"rate": MOST_GHOSTS})
        if ghosts and ghosts.keys() != GHOSTS.keys():
            raise FieldError(field="ghosts", expected=expected, received=f"{self.ghosts!r:.100}")
        object.__setattr__(self, "ghosts", ghosts if all(ghosts.values()) else {})
        expected = 'a mapping of "position" [m], "heading" [rad] and "speed" [m/s], one of them or more'
        object.__setattr__(self, "own_bias", _without_zeros(_numbers("own_bias", self.own_bias, OWN, expected)))

    @property
    def imperfections(self) -> tuple[str, ...]:
        """The names of the attributes that limit or disturb the sight, in the order of the attributes."""
        return tuple(each.name for each in fields(Sight) if getattr(self, each.name) != getattr(_PERFECT, each.name))

    @property
    def is_drawn(self) -> bool:
        """True if chance affects what is seen, so that the seed of a scenario makes a difference."""
        return bool(self.noise or self.dropout or self.shuffled or self.ghosts or self.own_bias)

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
            "noise": f"noise of {listed([f'{value:g} {NOISES[key]}' for key, value in self.noise.items()])}",
            "dropout": f"{100 * self.dropout:g} % dropout",
            "occlusion": "occlusion",
            "shuffled": "a shuffled order",
            "ghosts": "{rate:g} ghosts per second that last {lifetime:g} s".format(**(self.ghosts or _NO_GHOSTS)),
            "own_bias": f"an own bias of {listed([f'{value:g} {OWN[key]}' for key, value in self.own_bias.items()])}",
        }
        told = [texts[name] for name in self.imperfections if names is None or name in names]
        return listed(told or ["perfect sight"])

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

    def order(self, ids: Sequence[int], seed: int, tick: int) -> list[int]:
        """Return the places in ``ids`` of the vehicles in the order in which the ego sees them at a tick.

        Each id has a random number of its own, by which they are sorted. So the order of two vehicles is the same
        whether a third one is seen or not.
        """
        places = list(range(len(ids)))
        if self.shuffled and ids:
            numbers = np.random.default_rng([seed, tick, _SHUFFLING]).random(max(ids) + 1)
            places.sort(key=lambda place: float(numbers[ids[place]]))
        return places

    def ghosts_at(self, seed: int, time: float) -> Iterator[Ghost]:
        """Yield the ghosts that the ego sees at a time [s] of a run.

        Ghosts appear at random times (a Poisson process), and each lasts for a random time (exponentially distributed).
        A ghost appears anywhere within :data:`GHOST_AHEAD` and :data:`GHOST_ASIDE`, and keeps its speed relative to
        the ego. Those beyond the range, or where the ego itself is, are not seen.
        """
        if not self.ghosts:
            return
        random, number, born = np.random.default_rng([seed, 0, _GHOSTS]), 0, 0.0
        while True:
            born += float(random.exponential()) / self.ghosts["rate"]
            if born > time:
                return
            gone = born + float(random.exponential()) * self.ghosts["lifetime"]
            ahead, right = (random.uniform(-1.0, 1.0, 2) * (GHOST_AHEAD, GHOST_ASIDE)).tolist()
            faster = float(random.standard_normal()) * GHOST_SPEED
            ahead += faster * (time - born)
            is_inside = abs(ahead) < GHOST_LENGTH and abs(right) < GHOST_WIDTH
            is_near = self.range is None or math.hypot(ahead, right) <= self.range
            if time < gone and is_near and not is_inside:
                yield Ghost(number, ahead, right, faster)
            number += 1

    def own_errors(self, seed: int) -> OwnErrors:
        """Return the errors of the ego's own state in a run with this seed."""
        deviations = [self.own_bias.get(name, 0.0) for name in ("position", "position", "heading", "speed")]
        errors = np.random.default_rng([seed, 0, _OWN]).standard_normal(4) * deviations
        return OwnErrors(*errors.tolist())


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


def _numbers(
    name: str, values: object, units: Mapping[str, str], expected: str, most: Mapping[str, float] | None = None
) -> dict[str, float]:
    """Return a mapping of some of the names in ``units`` to numbers from 0, each up to the value in ``most``."""
    if not isinstance(values, Mapping) or not values.keys() <= units.keys():
        raise FieldError(field=name, expected=expected, received=f"{values!r:.100}")
    most = most or {}
    return {
        key: float(_number(f"{name}.{key}", value, units[key], most.get(key, math.inf)))
        for key, value in values.items()
    }


def _without_zeros(values: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in values.items() if value}


def _number(name: str, value: object, unit: str, most: float = math.inf) -> float:
    number = plain_number(value)
    if number is None or not 0 <= number <= most:
        of = f" [{unit}]" if unit else ""
        expected = f"a finite number from 0{of}" if most == math.inf else f"a number from 0 to {most:g}{of}"
        raise FieldError(field=name, expected=expected, received=f"{value!r:.100}")
    return number


_NO_GHOSTS = {"rate": 0.0, "lifetime": 0.0}
_PERFECT = Sight()
