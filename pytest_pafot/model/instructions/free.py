"""Free NPCs, which a driver of their own drives, such as a model of traffic or the policy under test."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pytest_pafot.model.instructions.instruction import (
    MOST_BESIDE,
    NEAR,
    SPEED_STEPS_PER_MPS,
    Choices,
    Instruction,
    ScenarioError,
    Space,
    WithStart,
    roughness,
)
from pytest_pafot.model.instructions.manoeuvre import Manoeuvre

if TYPE_CHECKING:
    from numpy.random import Generator

BUILT_IN_DRIVERS = ("idm", "mobil", "policy")
"""The drivers that need no code of the user's, the simplest first."""

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")
"""The pattern of a driver's name, which stands in files and tables."""

# What a search samples.

JUMP, OTHER_DRIVER, OTHER_LANE = 0.1, 0.3, 0.5
"""The share by which a mutation moves the start towards the ego, at most; the share of the mutations with another
driver, and up to which they have another lane. Half of the others move the start, and half change the speed."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Free(WithStart):
    """The only gene of an NPC that a driver of its own drives: a start relative to the ego, and the driver's name.

    The NPC is its driver's ego: the driver decides as often as the ego's, and sees the road from the NPC's place.

    Attributes:
        beside, ahead, speed: the start, as that of a :class:`Manoeuvre`; the speed is also the desired one of ``idm``
            and ``mobil`` [m, m/s].
        driver: ``idm``, highway-env's ``IDMVehicle`` in its lane; ``mobil``, with lane changes; ``policy``, the policy
            under test; or a name in ``drivers=`` of the search.
    """

    beside: int
    ahead: float
    speed: float
    driver: str

    name = "free"
    marks = frozenset({"beside", "ahead", "driver"})
    drives_itself = True

    def __post_init__(self) -> None:
        self.check_start()
        object.__setattr__(self, "driver", checked_driver(self.driver))

    @property
    def place(self) -> str:
        """The start and the driver in words."""
        return f"{self.start}, driven by {self.driver}"

    @property
    def goal(self) -> str:
        """The start and the driver in words."""
        return self.place

    def mixed(self, other: Instruction, rng: Generator) -> tuple[Instruction, Instruction] | None:
        """Return two children with each other's drivers. Starts stay, so that no two NPCs touch there."""
        if not isinstance(other, Free):
            return None
        return replace(self, driver=other.driver), replace(other, driver=self.driver)

    def is_drawn_in(self, space: Space) -> bool:
        """Return whether a search in a space has NPCs with this driver."""
        return self.driver in space.drivers

    def varied(self, choices: Choices, rng: Generator) -> Free:
        """Return an NPC with another driver, lane, distance or speed at the start."""
        kind, others = rng.random(), [each for each in choices.drivers if each != self.driver]
        if others and kind < OTHER_DRIVER:
            return replace(self, driver=others[int(rng.integers(len(others)))])
        if choices.lanes and self.ahead and kind < OTHER_LANE:
            lane = int(rng.integers(choices.lanes)) - choices.ego_lane
            return replace(self, beside=min(max(lane, -MOST_BESIDE), MOST_BESIDE))
        if abs(self.ahead) < choices.nearest_row and kind < (1 + OTHER_LANE) / 2:
            # Nobody else starts between it and the ego.
            return replace(self, ahead=_toward(self.ahead, JUMP * rng.random()))
        return replace(self, speed=choices.safe_speed(abs(self.ahead), rng))

    def beside_others(self, choices: Choices, others: Sequence[Sequence[Instruction]], rng: Generator) -> Free:
        """Return another free NPC, whose start is free."""
        return random_free(choices, others, rng)

    @property
    def roughness(self) -> int:
        """The distance of its place from multiples of 5 and of 1, and how much a reader must know of its driver."""
        known = BUILT_IN_DRIVERS.index(self.driver) if self.driver in BUILT_IN_DRIVERS else len(BUILT_IN_DRIVERS)
        return 1 + known + roughness(round(abs(self.ahead) * SPEED_STEPS_PER_MPS))

    @property
    def weight(self) -> int:
        """Nothing, because no free NPC is simpler than another one for its speed."""
        return 0

    def plainer(self) -> Iterator[Instruction]:
        """Keep lane and speed instead, have a simpler driver, and round the distance of the start."""
        yield Manoeuvre(beside=self.beside, ahead=self.ahead, speed=self.speed)
        for driver in BUILT_IN_DRIVERS:
            yield replace(self, driver=driver)
        for unit in (5, 1):
            with suppress(ScenarioError):  # in the ego's lane, none starts level with it
                yield replace(self, ahead=float(round(self.ahead / unit) * unit))


def _toward(ahead: float, share: float) -> float:
    """Return a start that is nearer to the ego by a share, but not nearer than the smallest gap that is sampled."""
    return round(math.copysign(max(abs(ahead) * (1 - share), min(abs(ahead), NEAR)), ahead), 1)


def checked_driver(name: object) -> str:
    """Return the name of a driver.

    Raises:
        ScenarioError: if it is no such name.
    """
    if not isinstance(name, str) or not NAME.fullmatch(name):
        expected = f"{', '.join(BUILT_IN_DRIVERS)}, or a name in drivers= of the search"
        fix = "a name has up to 40 letters, digits, _ and -, and begins with a letter"
        raise ScenarioError(field="driver", expected=expected, received=f"{name!r:.100}", fix=fix)
    return str(name)


def random_free(choices: Choices, others: Sequence[Sequence[Instruction]], rng: Generator) -> Free:
    """Sample a free NPC beside ``others``."""
    start = Free.random_start(choices, others, rng)
    return Free(**start, driver=choices.drivers[int(rng.integers(len(choices.drivers)))])
