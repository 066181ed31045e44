"""Manoeuvres, with which an NPC does what is asked for at a distance from the ego."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from itertools import count, product
from typing import TYPE_CHECKING, Any

from pytest_pafot.model.instructions.instruction import (
    FARTHEST,
    MAX_SPEED,
    MOST_BESIDE,
    SPEED_STEPS_PER_MPS,
    Choices,
    Instruction,
    ScenarioError,
    Space,
    WithStart,
    roughness,
    tenths_within,
)
from pytest_pafot.model.instructions.lane import SHIFTS, Shift
from pytest_pafot.support.shown import Pasteable

if TYPE_CHECKING:
    from numpy.random import Generator

LONGEST_HEADWAY = 20.0
"""The largest headway that begins a step [s]."""

LATEST = 600.0
"""The longest time between two steps [s]."""

FASTEST_ASIDE = 5.0
"""The largest lateral speed that a step can ask for [m/s]."""


MOST_STEPS = 16
"""The largest number of steps of a manoeuvre."""

PLAIN_OF_STEPS = ("lane", "lateral_speed", "offset", "speed", "acceleration")
"""What of a step is simplest at its default."""

# What a search samples.

FIRST_GAP, SPACING, SPREAD = 12.0, 24.0, 12.0
"""The gap between the ego and the nearest start, from one start to the next, and the part of it that is sampled [m]."""
LONGEST_VEHICLE = SPACING - SPREAD - 1.0
"""The length of the longest vehicle for which there is room between two starts [m]."""
MOST_ROOM = 20 * SPACING
"""The farthest start that is looked for [m]."""
AHEAD = 0.65
"""Share of the NPCs that start ahead of the ego."""
FEWEST_SAMPLED, MOST_SAMPLED = 6, 14
"""The smallest and the largest number of steps of a sampled manoeuvre."""
BY_GAP, BEHIND = 0.2, 0.25
"""Share of the steps that begin at a gap, and of these the share with the NPC behind the ego; the others are timed."""
NEAR, FAR, LATER = 4.0, 45.0, 4.0
"""The smallest and the largest gap [m], and the longest time after the step before [s]."""
SIDEWAYS = 0.6
"""Share of the steps that change lanes."""
NEAR_EGO, ANY_SPEED = 8.0, 0.5
"""How far a speed is from the ego's first speed at most [m/s], and the share of the speeds that are any."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Step(Pasteable):
    """A step of a :class:`Manoeuvre`: when it begins, and what the NPC does then.

    It begins when ``gap`` or ``headway`` is reached, from either side, or else ``after`` the end of the step before. A
    step ends when the NPC is in its lane, at its offset and at its speed. A step whose distance comes earlier begins
    while the one before it still goes on: the NPC then has the lane of the first and the speed of the second.

    Attributes:
        gap: to the ego, from bumper to bumper [m]; negative if the NPC is behind.
        headway: the same in the time that the rear vehicle takes for it [s].
        after: since the end of the step before, or the beginning of the run [s].
        lane: ``"keep"``, ``"left"`` or ``"right"`` of that of the step before. Without such a lane, the NPC keeps its
            own, and the step is not as asked.
        lateral_speed: highest speed across the road [m/s]; a change to a lane of 4 m then takes about 4 s.
        offset: from the centre of that lane, positive to the right [m].
        speed: target speed [m/s]; None for that of the step before.
        acceleration: towards that speed, up or down, a positive number [m/s^2].
    """

    gap: float | None = None
    headway: float | None = None
    after: float = 0.0
    lane: Shift = "keep"
    lateral_speed: float = 1.5
    offset: float = 0.0
    speed: float | None = None
    acceleration: float = 3.0

    def __post_init__(self) -> None:
        given = [name for name in ("gap", "headway") if getattr(self, name) is not None]
        given += ["after"] if self.after else []
        if len(given) > 1:
            expected, received = "one of gap, headway and after", " and ".join(given)
            raise ScenarioError(field="step", expected=expected, received=received, fix="the others begin steps, too")
        for name, least, most in STEP_BOUNDS:
            if getattr(self, name) is not None or name not in ("gap", "headway", "speed"):
                object.__setattr__(self, name, tenths_within(name, getattr(self, name), least, most))
        if self.lane not in SHIFTS:
            raise ScenarioError(field="lane", expected=f"one of {', '.join(SHIFTS)}", received=repr(self.lane))

    @property
    def column(self) -> int:
        """The target lane as a number of lanes to the right of that of the step before: -1, 0 or +1."""
        return (0, -1, 1)[SHIFTS.index(self.lane)]

    @property
    def told(self) -> dict[str, Any]:
        """The fields that differ from their defaults, as files contain them."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in values.items() if value != getattr(DEFAULT_STEP, name)}

    @property
    def is_by_distance(self) -> bool:
        """True if a distance to the ego begins the step."""
        return self.gap is not None or self.headway is not None

    @property
    def trigger(self) -> str:
        """The trigger in words: ``at a gap of 20 m``; empty if it begins as the step before ends."""
        for value, what, unit in ((self.gap, "gap", "m"), (self.headway, "headway", "s")):
            if value is not None:
                return f"at a {what} of {abs(value):g} {unit}{' behind' if value < 0 else ''}"
        return f"{self.after:g} s later" if self.after else ""

    @property
    def act(self) -> str:
        """The act in words: ``left at 1.5 m/s, to 5 m/s at 3 m/s^2``."""
        aside = "" if self.lane == "keep" else f"{self.lane} at {self.lateral_speed:g} m/s"
        offset = f"{abs(self.offset):g} m {'left' if self.offset < 0 else 'right'} of the centre" if self.offset else ""
        speed = "" if self.speed is None else f"to {self.speed:g} m/s at {self.acceleration:g} m/s^2"
        return ", ".join(filter(None, (aside, offset, speed))) or "hold"

    @property
    def words(self) -> str:
        """The trigger and the act in words."""
        return f"{self.trigger} {self.act}".lstrip()


STEP_BOUNDS = (
    ("gap", -FARTHEST, FARTHEST),
    ("headway", -LONGEST_HEADWAY, LONGEST_HEADWAY),
    ("after", 0.0, LATEST),
    ("lateral_speed", 0.1, FASTEST_ASIDE),
    ("offset", -1.9, 1.9),
    ("speed", 0.0, MAX_SPEED),
    ("acceleration", 0.1, 20.0),
)
"""The smallest and largest number that each field of a step may have."""


DEFAULT_STEP = Step()
"""A step that holds lane and speed."""


def checked_steps(given: Any) -> tuple[Step, ...]:
    """Return the steps of an NPC; refuse other objects and too many steps."""
    steps = tuple(given) if isinstance(given, (list, tuple)) else (given,)
    if not all(isinstance(step, Step) for step in steps) or len(steps) > MOST_STEPS:
        expected = f"at most {MOST_STEPS} of pafot.Step(...)"
        raise ScenarioError(field="steps", expected=expected, received=repr(given))
    return steps


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Manoeuvre(WithStart):
    """The only gene of an NPC that does what is asked for: a start relative to the ego, and steps.

    In the traffic of the paper's style, the NPC does it whatever is in its way, except vehicles that cross its way; in
    hostile or everyday traffic it gives way as the others there. Physical limits hold in both. ``run.asked`` tells what
    became of it.

    Attributes:
        beside: lane at the start: lanes to the right of the ego's.
        ahead: at the start, from the ego's front to the NPC's rear [m]. Negative: from the ego's rear to its front. 0:
            level with the ego, in another lane.
        speed: at the start [m/s].
        steps: what it does then; afterwards it keeps lane and speed.
    """

    beside: int
    ahead: float
    speed: float
    steps: tuple[Step, ...] = ()

    name = "manoeuvre"
    marks = frozenset({"beside", "ahead", "steps"})

    def __post_init__(self) -> None:
        self.check_start()
        object.__setattr__(self, "steps", checked_steps(self.steps))

    @property
    def goal(self) -> str:
        """The start and the steps in words."""
        return "; ".join([self.place, *(step.words for step in self.steps)])

    def plain(self) -> list[Any]:
        """Return the name, the speed, the start, and what of each step is not usual."""
        return [self.name, self.speed, self.beside, self.ahead, [step.told for step in self.steps]]

    @classmethod
    def read(cls, plain: Sequence[Any]) -> Manoeuvre:
        """Return the instruction with the values of :meth:`plain`."""
        _, speed, beside, ahead, steps = plain
        return cls(beside=beside, ahead=ahead, speed=speed, steps=tuple(Step(**each) for each in steps))

    def in_file(self) -> dict[str, Any]:
        """Return the fields; of steps only what is not usual."""
        told = {"steps": [step.told for step in self.steps]} if self.steps else {}
        return Instruction.in_file(self) | told

    def is_drawn_in(self, space: Space) -> bool:
        """Return whether a search in a space has NPCs with manoeuvres."""
        return space.instructions == "manoeuvres" or space.around is not None

    def varied(self, choices: Choices, rng: Generator) -> Manoeuvre:
        """Return a manoeuvre with another step, one step more or less, or another speed at the start."""
        steps, kind = self.steps, rng.random()
        place = int(rng.integers(len(steps))) if steps else 0
        if steps and kind < 0.6:
            return replace(self, steps=(*steps[:place], random_step(choices, rng), *steps[place + 1 :]))
        if steps and kind < 0.75:
            return replace(self, steps=(*steps[:place], *steps[place + 1 :]))
        if len(steps) < MOST_SAMPLED and kind < 0.9:
            return replace(self, steps=(*steps[:place], random_step(choices, rng), *steps[place:]))
        return replace(self, speed=_speed(choices, rng))

    def mixed(self, other: Instruction, rng: Generator) -> tuple[Instruction, Instruction] | None:
        """Return two children with each other's steps. Starts stay, so that no two NPCs touch there."""
        if not isinstance(other, Manoeuvre):
            return None
        return replace(self, steps=other.steps), replace(other, steps=self.steps)

    def beside_others(self, choices: Choices, others: Sequence[Sequence[Instruction]], rng: Generator) -> Manoeuvre:
        """Return another manoeuvre, whose start is free."""
        return random_manoeuvre(choices, others, rng)

    @property
    def size(self) -> int:
        """The start and each step."""
        return 1 + len(self.steps)

    def moves(self, before: Any) -> int:
        """Return the number of changes of lanes."""
        return sum(step.lane != "keep" for step in self.steps)

    @property
    def roughness(self) -> int:
        """The distances of places, times and speeds from multiples of 5 and of 1, and the number of unusual values."""
        numbers = [self.ahead, *(step.gap or step.headway or step.after for step in self.steps)]
        numbers += [step.speed or 0.0 for step in self.steps]
        unusual = sum(name in PLAIN_OF_STEPS for step in self.steps for name in step.told)
        return unusual + sum(roughness(round(abs(each) * SPEED_STEPS_PER_MPS)) for each in numbers)

    @property
    def weight(self) -> int:
        """Nothing, because no manoeuvre is simpler than another one for its speed."""
        return 0

    def plainer(self) -> Iterator[Manoeuvre]:
        """Leave out each step, give it the defaults, and round its distance or time and its speed; round the start."""
        steps = self.steps
        for number, step in enumerate(steps):
            changes: list[dict[str, Any]] = [{name: getattr(DEFAULT_STEP, name)} for name in PLAIN_OF_STEPS]
            for unit, name in product((5, 1), ("after", "gap", "headway", "speed")):
                value = getattr(step, name)
                if value:
                    changes.append({name: float(round(value / unit) * unit)})
            for each in ((), *((replace(step, **change),) for change in changes)):
                yield replace(self, steps=(*steps[:number], *each, *steps[number + 1 :]))
        for unit in (5, 1):
            with suppress(ScenarioError):  # in the ego's lane, no manoeuvre starts level with it
                yield replace(self, ahead=float(round(self.ahead / unit) * unit))


def random_manoeuvre(choices: Choices, others: Sequence[Sequence[Instruction]], rng: Generator) -> Manoeuvre:
    """Sample the manoeuvre of an NPC beside ``others``.

    The NPCs of a scenario start one behind the other, ahead of the ego or behind it, so that no two of them touch,
    whatever their lanes are.
    """
    taken = {slot for chain in others for slot in _slots(chain[0], choices.longest)}
    slot = next(each for each in count() if not {(-1, each), (1, each)} & taken)
    gap = FIRST_GAP + SPREAD * rng.random()
    lane = int(rng.integers(choices.lanes)) if choices.lanes else choices.ego_lane
    steps = tuple(random_step(choices, rng) for _ in range(int(rng.integers(FEWEST_SAMPLED, MOST_SAMPLED + 1))))
    side = 1 if rng.random() < AHEAD else -1
    if slot >= places(
        choices.room, side
    ):  # the road is too short there: start anywhere else, next to an NPC if need be
        free = [
            (side, slot)
            for slot, side in product(range(max(places(choices.room, -1), places(choices.room, 1))), (side, -side))
            if slot < places(choices.room, side) and (side, slot) not in taken
        ]
        if not free:
            expected, received = f"at most {len(others)} NPCs with manoeuvres", f"{len(others) + 1}"
            fix = "the road has no more room ahead of the ego's start and behind it; ask for fewer NPCs"
            raise ScenarioError(field="npcs", expected=expected, received=received, fix=fix)
        side, slot = free[0]
    ahead = round(side * (gap + SPACING * slot), 1)
    beside = min(max(lane - choices.ego_lane, -MOST_BESIDE), MOST_BESIDE)
    return Manoeuvre(beside=beside, ahead=ahead, speed=_speed(choices, rng), steps=steps)


def places(room: tuple[float, float], side: int) -> int:
    """Return how many NPCs can start behind the ego (-1) or ahead of it (1) with this room behind and ahead [m]."""
    return int(min(room[side > 0], MOST_ROOM) // SPACING)


def _slots(first: Instruction, longest: float) -> set[tuple[int, int]]:
    """Return the slots that a start takes: one for a manoeuvre; two for others, which start anywhere."""
    if not first.keeps_start or first.follows_track:  # around a recording, the starts are compared with all tracks
        return set()
    side, gap, reach = 1 if first.ahead > 0 else -1, abs(first.ahead), longest + 1
    ends = [gap - reach, gap + reach - FIRST_GAP]
    if isinstance(first, Manoeuvre):
        ends = [gap - FIRST_GAP + 0.05]
    return {(side, max(0, int(end // SPACING))) for end in ends}


def random_step(choices: Choices, rng: Generator) -> Step:
    """Sample a step."""
    trigger: dict[str, float] = {"after": round(LATER * rng.random(), 1)}
    if rng.random() < BY_GAP:
        gap = NEAR + (FAR - NEAR) * rng.random()
        trigger = {"gap": round(-gap if rng.random() < BEHIND else gap, 1)}
    return Step(
        **trigger,
        lane=SHIFTS[int(rng.integers(1, 3))] if choices.lanes and rng.random() < SIDEWAYS else "keep",
        lateral_speed=round(1 + 2 * rng.random(), 1),
        speed=_speed(choices, rng),
        acceleration=round(1 + 6 * rng.random(), 1),
    )


def _speed(choices: Choices, rng: Generator) -> float:
    low, high = choices.low, choices.top
    if rng.random() >= ANY_SPEED:
        near = round(10 * (choices.ego_speed + NEAR_EGO * (2 * rng.random() - 1)))
        return min(max(near, low), high) / 10
    return int(rng.integers(low, high + 1)) / 10
