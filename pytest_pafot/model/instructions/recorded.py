"""Recorded tracks, and the instruction with which an NPC drives as recorded."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from pytest_pafot.model.instructions.instruction import (
    MAX_SPEED,
    SPEED_STEPS_PER_MPS,
    Choices,
    Instruction,
    ScenarioError,
    Space,
    checked_number,
    tenths_within,
)
from pytest_pafot.model.instructions.manoeuvre import (
    DEFAULT_STEP,
    PLAIN_OF_STEPS,
    Step,
    checked_steps,
    random_step,
)
from pytest_pafot.support.shown import Pasteable

if TYPE_CHECKING:
    import numpy as np
    from numpy.random import Generator
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

USUAL = 10
"""The places of a track per second, unless it says otherwise. Between two of them a vehicle is on a straight line,
which is less than 2 cm from what a car can do there: an acceleration of 10 m/s^2 makes it 10 / 8 * 0.1^2 m. What no car
can do needs the rate of the recording, such as the jerks with which highway-env's vehicles begin to change lanes."""
RATES = {f"rate {rate}": rate for rate in range(USUAL, 16)}
"""The first lines with which a track says otherwise."""
FARTHEST, HEADING = 5000.0, 1.0
"""The largest distance from the ego's start [m], and the largest angle to the road [rad]."""

APART = 0.9
"""The distance from the recorded ego up to which the ego drives as recorded [m]."""
LATEST, SLOWEST, FASTEST, SHIFTED = 5.0, 0.8, 1.2, 30.0
"""How far a track may be changed: by how much time [s], by which factors of the speed, and by how far ahead [m]. A
factor of 1.2 makes accelerations 1.44 times as large, which a car can do that has not braked hard before."""
VARIED_TIME, VARIED_PLACE = 2.0, 15.0
"""How far a search changes it [s, m]; any change of the speed is allowed up to the limit of the road."""


class _Parsed(Pasteable):
    """The place for what follows from the text of a track; the numbers are read when they are first needed."""

    __slots__ = ("_states", "rate")

    _states: FloatArray
    rate: int


@dataclass(frozen=True, slots=True, repr=False)
class Track(_Parsed):
    """The places of a vehicle, ten times a second or as often as its first line says.

    Attributes:
        text: a line for each tenth of a second, or after a line such as ``rate 15`` for each fifteenth: x [m], y [m],
            heading [rad] and speed [m/s], relative to the ego's lane at its start, x along the road and y and heading
            positive to the right. Numbers have two digits after the point at most, headings four.
        rate: the lines per second, 10 to 15.
    """

    text: str

    most: ClassVar[int] = 401
    """The most lines of places: a file may have eight tracks and that of the ego, twice, within its limit of size."""
    lane_width: ClassVar[float] = 4.0
    """The width of the lanes to which its places belong [m]."""

    def __post_init__(self) -> None:
        lines = self.text.strip().split("\n") if isinstance(self.text, str) else []
        rate = RATES.get(lines[0].strip()) if lines else None
        lines = lines if rate is None else lines[1:]
        if not 2 <= len(lines) <= self.most:
            expected, received = f"a text of 2 to {self.most} lines", f"{self.text!r:.60}, {len(lines)}"
            fix = f"a track has {rate or USUAL} lines for each second"
            raise ScenarioError(field="track", expected=expected, received=received, fix=fix)
        object.__setattr__(self, "rate", rate or USUAL)
        object.__setattr__(self, "text", _text([_row(number, line) for number, line in enumerate(lines, 1)], self.rate))

    @classmethod
    def of(cls, states: Iterable[Sequence[float]], rate: int = 10) -> Track:
        """Return the track with ``rate`` states per second, 10 to 15; shape [rows, 4], rounded as the text is."""
        return cls(_text([[float(each) for each in row] for row in states], rate))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as the text."""
        return Track, (self.text,)

    @property
    def states(self) -> FloatArray:
        """The text as numbers, read-only, shape [lines, 4]."""
        try:
            return self._states
        except AttributeError:
            import numpy as np  # noqa: PLC0415  (strategies of scenarios need no arrays)

            lines = self.text.split("\n")[self.rate != USUAL :]
            states = np.array([line.split() for line in lines], dtype=np.float64)
            states.flags.writeable = False
            object.__setattr__(self, "_states", states)
            return states

    @property
    def seconds(self) -> float:
        """The time from the first line to the last one [s]."""
        return (len(self.states) - 1) / self.rate

    def at(self, times: FloatArray | Sequence[float]) -> FloatArray:
        """Return the states at some times [s], on straight lines between those of the track and before and after it."""
        import numpy as np  # noqa: PLC0415  (as above)

        states = self.states
        places = np.asarray(times, dtype=np.float64) * self.rate
        before = np.clip(np.floor(places), 0, len(states) - 2).astype(int)
        share = (places - before)[:, None]
        found: FloatArray = states[before] + share * (states[before + 1] - states[before])
        is_outside = (places < 0) | (places > len(states) - 1)
        if is_outside.any():  # there, the vehicle keeps its speed and heading
            ends = states[np.where(places < 0, 0, len(states) - 1)]
            driven = (places - np.clip(places, 0, len(states) - 1)) / self.rate * ends[:, 3]
            ends[:, 0] += driven * np.cos(ends[:, 2])
            ends[:, 1] += driven * np.sin(ends[:, 2])
            found[is_outside] = ends[is_outside]
        return found


def _row(number: int, line: str) -> tuple[float, ...]:
    parts = line.split()
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    bounds = (FARTHEST, FARTHEST, HEADING, MAX_SPEED)
    if len(values) != 4 or not all(abs(each) <= most for each, most in zip(values, bounds, strict=True)):
        expected = f"x, y, heading and speed, within {', '.join(f'{most:g}' for most in bounds)}"
        raise ScenarioError(field="track", expected=expected, received=f"{line!r:.60} in line {number}")
    return tuple(values)


def _text(rows: Sequence[Sequence[float]], rate: int) -> str:
    head = [] if rate == USUAL else [f"rate {rate}"]
    return "\n".join([*head, *(" ".join(map(_number, row, (2, 2, 4, 2))) for row in rows)])


def _number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Recorded(Instruction):
    """The only gene of an NPC that drives as recorded, whatever is in its way, as long as the ego does so, too.

    It is handed over to attentive driving in its lane when its track ends, and when an ego that drives otherwise than
    the recorded one comes near it; from then on it does not follow the track. The first of its steps takes it from its
    track, too. On a road that bends, its track bends with the lanes of the ego's way.

    Attributes:
        track: where it drives.
        later: how much later it does so [s], -5 to 5; before, it drives as in the first line.
        pace: how many times as fast, 0.8 to 1.2.
        shift: how much farther ahead [m], -30 to 30.
        steps: what it does instead, from when the first of them begins.
    """

    track: Track
    later: float = 0.0
    pace: float = 1.0
    shift: float = 0.0
    steps: tuple[Step, ...] = ()

    name = "recorded"
    marks = frozenset({"track", "later", "pace", "shift"})
    keeps_start = True
    follows_track = True
    holds_speed = False

    def __post_init__(self) -> None:
        if not isinstance(self.track, Track):
            fix = "write pafot.Track.of(states)"
            raise ScenarioError(field="track", expected="a Track", received=f"{self.track!r:.60}", fix=fix)
        pace = checked_number("pace", self.pace)
        if not SLOWEST <= pace <= FASTEST or abs(pace - round(pace, 2)) > 1e-7:
            expected = f"a factor from {SLOWEST:g} to {FASTEST:g} in steps of 0.01"
            raise ScenarioError(field="pace", expected=expected, received=repr(self.pace))
        steps = checked_steps(self.steps)
        object.__setattr__(self, "pace", round(pace, 2))
        object.__setattr__(self, "later", tenths_within("later", self.later, -LATEST, LATEST))
        object.__setattr__(self, "shift", tenths_within("shift", self.shift, -SHIFTED, SHIFTED))
        object.__setattr__(self, "steps", steps)

    def at(self, times: FloatArray) -> FloatArray:
        """Return the states of the NPC at some times of the run [s], relative to the ego's start; shape [times, 4]."""
        states = self.track.at(self.pace * (times - self.later))
        states[:, 0] += self.shift
        states[:, 3] *= self.pace
        return states

    @property
    def _first(self) -> list[float]:
        first: list[float] = self.track.at([-self.pace * self.later])[0].tolist()
        return [first[0] + self.shift, *first[1:3], first[3] * self.pace]

    @property
    def end(self) -> float:
        """The time of the run at which the track ends [s]."""
        return self.track.seconds / self.pace + self.later

    @property
    def is_as_recorded(self) -> bool:
        """True if it drives at the place and time of its track."""
        return (self.later, self.pace, self.shift) == (0.0, 1.0, 0.0)

    @property
    def speed(self) -> float:  # type: ignore[override]
        """The speed at the start [m/s]."""
        return round(max(self._first[3], 0.0), 1)

    def with_speed(self, speed: float) -> Recorded:
        """Return the instruction with a pace that makes its first speed nearest to another one [m/s]."""
        first = float(self.track.states[0, 3])
        return self if speed == self.speed or first <= 0 else replace(self, pace=_pace(speed / first))

    @property
    def ahead(self) -> float:  # type: ignore[override]
        """The distance at the start from the ego's centre to the NPC's along the road [m]."""
        return self._first[0]

    @property
    def beside(self) -> int:  # type: ignore[override]
        """The number of lanes to the right of the ego's at the start."""
        return round(self._first[1] / Track.lane_width)

    @property
    def goal(self) -> str:
        """The start, what differs from the recording, and the steps in words."""
        return "; ".join([self.place, *(step.words for step in self.steps)])

    @property
    def place(self) -> str:
        """The start, and what differs from the recording, in words: ``as recorded, from 30 m ahead; 0.5 s later``."""
        ahead = round(self.ahead)
        lanes = f", {abs(self.beside)} lane{'s' * (abs(self.beside) > 1)} {'left' if self.beside < 0 else 'right'}"
        start = f"as recorded, from {abs(ahead)} m {'behind' if ahead < 0 else 'ahead'}{lanes if self.beside else ''}"
        return "; but ".join(filter(None, (start, ", ".join(self._changes))))

    @property
    def _changes(self) -> Iterator[str]:
        if self.later:
            yield f"{abs(self.later):g} s {'later' if self.later > 0 else 'earlier'}"
        if self.pace != 1:
            yield f"{abs(round(100 * self.pace) - 100)} % {'faster' if self.pace > 1 else 'slower'}"
        if self.shift:
            yield f"{abs(self.shift):g} m {'farther ahead' if self.shift > 0 else 'farther back'}"

    @property
    def short(self) -> str:
        """The instruction in the text of a scenario."""
        return self.goal

    def plain(self) -> list[Any]:
        """Return the name, the track, what differs from it, and what of each step is not usual."""
        steps = [step.told for step in self.steps]
        return [self.name, self.track.text, self.later, self.pace, self.shift, steps]

    @classmethod
    def read(cls, plain: Sequence[Any]) -> Recorded:
        """Return the instruction with the values of :meth:`plain`."""
        _, text, later, pace, shift, steps = plain
        return cls(track=Track(text), later=later, pace=pace, shift=shift, steps=tuple(Step(**each) for each in steps))

    def in_file(self) -> dict[str, Any]:
        """Return what differs from the recording, of steps what is not usual, and the track as a text."""
        given = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in ("track", "steps")}
        told = {name: value for name, value in given.items() if value != float(name == "pace")}
        steps = {"steps": [step.told for step in self.steps]} if self.steps else {}
        return told | steps | {"track": self.track.text}

    def is_drawn_in(self, space: Space) -> bool:
        """Return whether a search in a space is one around a recording."""
        return space.around is not None

    def varied(self, choices: Choices, rng: Generator) -> Recorded:
        """Return the instruction with another time, pace, place or step, or as it was recorded."""
        kind = rng.random()
        if kind < 0.25:
            return replace(self, later=round(VARIED_TIME * (2 * rng.random() - 1), 1))
        if kind < 0.5:
            fastest = choices.top / SPEED_STEPS_PER_MPS / max(float(self.track.states[:, 3].max()), 0.1)
            fastest = math.floor(100 * fastest) / 100  # the nearest pace could be above the limit
            return replace(self, pace=_pace(min(SLOWEST + (FASTEST - SLOWEST) * rng.random(), max(fastest, 1.0))))
        if kind < 0.7:
            return replace(self, shift=round(VARIED_PLACE * (2 * rng.random() - 1), 1))
        if kind < 0.95:
            step = random_step(choices, rng)
            if step.gap is None:  # at any time of the track, not only at its beginning
                step = replace(step, after=round(self.track.seconds * rng.random(), 1))
            return replace(self, steps=(step,))
        return Recorded(track=self.track)

    @property
    def size(self) -> int:
        """The track and each step."""
        return 1 + len(self.steps)

    @property
    def roughness(self) -> int:
        """Three for each difference from the recording, and one for what is not usual in a step.

        Three are more than a change of the pace could gain by rounding the first speed.
        """
        differs = (self.later != 0, self.pace != 1, self.shift != 0)
        return 3 * sum(differs) + sum(len(step.told) for step in self.steps)

    @property
    def weight(self) -> int:
        """The difference of the NPC from its recording, in tenths of seconds and metres and hundredths of the speed."""
        return round(10 * (abs(self.later) + abs(self.shift)) + 100 * abs(self.pace - 1))

    def plainer(self) -> Iterator[Recorded]:
        """Go back to the recording: as a whole, in one respect, without a step, and half of the way."""
        yield Recorded(track=self.track)
        for share in (0.0, 0.5):
            yield replace(self, later=round(share * self.later, 1))
            yield replace(self, shift=round(share * self.shift, 1))
            yield replace(self, pace=round(1 + share * (self.pace - 1), 2))
        for number, step in enumerate(self.steps):
            changes: list[dict[str, Any]] = [{name: getattr(DEFAULT_STEP, name)} for name in PLAIN_OF_STEPS]
            for each in ((), *((replace(step, **change),) for change in changes)):
                yield replace(self, steps=(*self.steps[:number], *each, *self.steps[number + 1 :]))


def _pace(factor: float) -> float:
    return round(min(max(factor, SLOWEST), FASTEST), 2)
