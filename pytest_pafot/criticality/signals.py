"""Signals: what happened in a run, one value a tick, with name and unit; and the one table of what they measure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality.measures import Encounters
from pytest_pafot.criticality.rss import longitudinal_gap
from pytest_pafot.criticality.zones import Passage, passages, time_advantage
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, FloatArray, Trace

if TYPE_CHECKING:
    from typing import Self

_Array: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]

Worse = Literal["low", "high", "both", "neither"]
"""Which values are worse for the ego: the lowest, the highest, those farthest from 0, or none."""


_REORDER = frozenset({np.flip, np.sort, np.roll, np.partition})
"""Functions of numpy that leave no value at its tick."""

_KEEP_UNIT = frozenset({np.absolute, np.fabs, np.negative, np.positive})


class Signal(_Array):
    """A value at each tick: a numpy array that knows its ticks.

    What numpy makes of it value by value, such as ``abs(signal)``, ``signal / 2`` or ``np.where(..., signal, 0)``, is a
    signal over the same ticks, without a name, and, but for ``abs`` and a sign, without a unit; of two signals the
    first says which ticks those are. What is cut out by ``signal[30:150]`` knows that it begins 30 ticks later, and so
    does ``np.diff``. Any other selection is over no known ticks. Comparisons and sums are plain arrays and numbers.

    Args:
        values: shape [ticks]; copied, and read-only then.
        hz: ticks per second; None where unknown.
        start: the tick that the first value belongs to.
        name: such as ``ego.speed``.
        unit: such as ``m/s``.

    Raises:
        ValueError: for values of another shape.
    """

    hz: float | None = None
    start: int = 0
    name: str = ""
    unit: str = ""

    def __new__(
        cls, values: npt.ArrayLike, *, hz: float | None = None, start: int = 0, name: str = "", unit: str = ""
    ) -> Self:
        """A signal of any values."""
        signal = np.array(values, dtype=np.float64).view(cls)
        if signal.ndim != 1:
            raise ValueError(f"signal {name!r}: expected one value a tick, received an array of shape {signal.shape}")
        signal.__dict__.update(hz=hz, start=start, name=name, unit=unit)
        signal.flags.writeable = False
        return signal

    def __array_finalize__(self, source: object) -> None:
        """Copies are of the same ticks; what numpy makes of other arrays is of none that are known."""
        if isinstance(source, Signal) and source.shape == self.shape:
            self.__dict__.update(source.__dict__)

    def __array_wrap__(self, array: _Array, context: Any = None, return_scalar: bool = False) -> Any:
        """What numpy computed of signals, of which this is the first."""
        if array.shape != self.shape or array.dtype != np.float64:
            return array[()] if return_scalar else array
        signal = array.view(type(self))
        unit = self.unit if context is not None and context[0] in _KEEP_UNIT else ""
        signal.__dict__.update(self.__dict__, name="", unit=unit)
        return signal

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        """Numpy's functions that are no arithmetic, some of which return plain arrays."""
        result = super().__array_function__(func, types, args, kwargs)
        if func in _REORDER:
            return np.asarray(result)
        return self.__array_wrap__(result) if isinstance(result, np.ndarray) else result

    def __getitem__(self, key: Any) -> Any:
        """A value, or some of them."""
        part = super().__getitem__(key)
        if isinstance(part, Signal):
            cut = key[0] if isinstance(key, tuple) and len(key) == 1 else key
            is_stretch = isinstance(cut, slice) and cut.step in (None, 1)
            start = self.start + cut.indices(len(self))[0] if is_stretch else 0
            part.__dict__.update(self.__dict__, hz=self.hz if is_stretch else None, start=start)
        return part

    def __reduce__(self) -> Any:
        made: tuple[Any, ...] = super().__reduce__()  # type: ignore[assignment]
        return *made[:2], (made[2], self.__dict__)

    def __setstate__(self, state: Any) -> None:
        """Pickling makes arrays writeable; a signal that comes back is read-only again."""
        super().__setstate__(state[0])
        self.__dict__.update(state[1])
        self.flags.writeable = False


@dataclass(frozen=True, slots=True)
class Measure:
    """Something to measure at each tick of a run, of the ego or of each NPC; called with a trace it is a fitness.

    Attributes:
        name: such as ``headway``, ``ego.jerk``, or ``npcs.ttc`` for one of each NPC.
        unit: such as ``m/s^3``; empty for a number.
        worse: for the ego: ``low``, ``high``, ``both`` (far from 0) or ``neither``.
        source: what it is, and whose.
        function: of a trace; gives an array of shape [ticks + 1], or [NPCs, ticks + 1] for a value of each NPC.
    """

    name: str
    unit: str
    worse: Worse
    source: str
    function: Callable[[Trace], npt.ArrayLike]

    def __post_init__(self) -> None:
        if self.worse not in get_args(Worse):
            expected = ", ".join(map(repr, get_args(Worse)))
            raise ValueError(f"measure {self.name!r}: expected worse= as one of {expected}, received {self.worse!r}")

    def values(self, trace: Trace) -> FloatArray:
        """All values of a run, shape [ticks + 1] or [NPCs, ticks + 1].

        Raises:
            ValueError: where the function gives an array of another shape.
        """
        values = np.asarray(self.function(trace), dtype=np.float64)
        rows, npcs = trace.ticks + 1, trace.states.shape[1] - 1
        if values.shape not in ((rows,), (npcs, rows)):
            raise ValueError(
                f"measure {self.name!r}: expected one value a tick, shape ({rows},), or of each NPC, ({npcs}, {rows}), "
                f"received shape {values.shape}"
            )
        return values

    def __call__(self, trace: Trace) -> float:
        """As a fitness: the worst value v of all ticks and NPCs, higher = worse, as v / (1 + |v|); 1 and -1 for inf.

        Raises:
            ValueError: for a measure of which no value is worse.
        """
        if self.worse == "neither":
            raise ValueError(f"measure {self.name!r}: expected worse='low', 'high' or 'both', received 'neither'")
        risk = {"low": np.negative, "high": np.positive, "both": np.abs}[self.worse](self.values(trace))
        worst = float(risk.max(initial=-np.inf))
        return math.copysign(1.0, worst) if math.isinf(worst) else worst / (1 + abs(worst))


def leader(trace: Trace) -> npt.NDArray[np.intp]:
    """Index of the NPC ahead of the ego in its lane at each tick, by their centres; -1 without one.

    The nearest one, shape [ticks + 1]. An NPC that crosses is none before it has merged into the ego's way.
    """
    encounters = Encounters(trace)
    is_ahead = encounters.same_lane & ~(encounters.ahead < 0)
    nobody = np.full((1, trace.ticks + 1), np.inf)
    nearest: npt.NDArray[np.intp] = np.vstack((nobody, np.where(is_ahead, encounters.ahead, np.inf))).argmin(axis=0)
    return nearest - 1


def headway(trace: Trace) -> FloatArray:
    """Time that the ego takes from where it is to the rear of its :func:`leader` [s], shape [ticks + 1].

    The gap between the boxes along the lane over the ego's speed; inf without a leader, and where the ego stands.
    """
    ahead, speed = leader(trace), trace.ego[:, SPEED]
    moves = (ahead >= 0) & ~(speed <= 0)
    gap = longitudinal_gap(trace)[moves, ahead[moves]]
    seconds = np.full(len(ahead), np.inf)
    seconds[moves] = gap / speed[moves]
    return seconds


def jerk(trace: Trace) -> FloatArray:
    """Change of a vehicle's acceleration since the tick before, per second [m/s^3], shape [vehicles, ticks + 1].

    0 at the first tick. At the second it counts from the 0 that the first one has, as if nobody had sped up or braked
    before the run.
    """
    acceleration = trace.states[:, :, ACCELERATION].T
    return np.diff(acceleration, prepend=acceleration[:, :1]) * trace.physics_hz


def lateral_acceleration(trace: Trace) -> FloatArray:
    """Speed times the turning rate of the heading since the tick before [m/s^2], shape [vehicles, ticks + 1].

    Positive to the right; 0 at the first tick. It is what pulls a passenger sideways in a steady turn, and leaves out
    the slip of the vehicle, which jumps with the steering angle in a kinematic model.
    """
    heading = np.unwrap(trace.states[:, :, HEADING].T)
    turning: FloatArray = np.diff(heading, prepend=heading[:, :1]) * trace.physics_hz
    return turning * trace.states[:, :, SPEED].T


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoLaneChange:
    """The ego's centre came into another lane than it was in before.

    Attributes:
        tick: the first one in the other lane.
        time: of that tick [s].
        from_lane, to_lane: indices, 0 at the left.
        gap_ahead: along the road to the box of the NPC ahead whose centre is in that lane, too [m]; 0 abreast, inf
            where there is none.
        gap_behind: likewise to the one behind [m].
    """

    tick: int
    time: float
    from_lane: int
    to_lane: int
    gap_ahead: float
    gap_behind: float


def ego_lane_changes(trace: Trace) -> tuple[EgoLaneChange, ...]:
    """The ego's lane changes, first one first; what is off the road in between plays no part."""
    lane = trace.ego[:, LANE]
    on_road = np.flatnonzero(lane >= 0)
    changed = np.flatnonzero(np.diff(lane[on_road])) + 1
    return tuple(_lane_change(trace, int(on_road[at - 1]), int(on_road[at])) for at in changed)


def _lane_change(trace: Trace, before: int, tick: int) -> EgoLaneChange:
    encounters, lane = Encounters(trace), trace.states[tick, :, LANE]
    gap, ahead, is_there = longitudinal_gap(trace)[tick], encounters.ahead[:, tick], encounters.same_lane[:, tick]
    return EgoLaneChange(
        tick=tick,
        time=tick / trace.physics_hz,
        from_lane=int(trace.ego[before, LANE]),
        to_lane=int(lane[0]),
        gap_ahead=float(gap[is_there & ~(ahead < 0)].min(initial=np.inf)),
        gap_behind=float(gap[is_there & (ahead < 0)].min(initial=np.inf)),
    )


def _column(index: int, trace: Trace) -> FloatArray:
    return trace.states[:, :, index].T


def _of_ego(function: Callable[[Trace], FloatArray], trace: Trace) -> FloatArray:
    values: FloatArray = function(trace)[0]
    return values


def _of_npcs(function: Callable[[Trace], FloatArray], trace: Trace) -> FloatArray:
    return function(trace)[1:]


def _encounter(name: str, trace: Trace) -> FloatArray:
    values: FloatArray = getattr(Encounters(trace), name)
    return values


def _time_advantage(trace: Trace) -> FloatArray:
    return time_advantage(trace).T


_speed, _acceleration, _lane = (partial(_column, index) for index in (SPEED, ACCELERATION, LANE))
_TURNING = "speed times the turning rate of the heading since the tick before, positive to the right"
_JERK = "change of the acceleration since the tick before, per second; 0 at the first tick"
_ROAD = "along the road, between the centres"

# Partial functions of functions with names, which travel to other processes.
MEASURES = (
    Measure("ego.speed", "m/s", "high", "as recorded", partial(_of_ego, _speed)),
    Measure("ego.acceleration", "m/s^2", "low", "as recorded; negative in braking", partial(_of_ego, _acceleration)),
    Measure("ego.jerk", "m/s^3", "both", _JERK, partial(_of_ego, jerk)),
    Measure("ego.lateral_acceleration", "m/s^2", "both", _TURNING, partial(_of_ego, lateral_acceleration)),
    Measure("ego.lane", "", "neither", "the lane of its centre, from 0 at the left; -1 off the road",
            partial(_of_ego, _lane)),
    Measure("headway", "s", "low", "gap along the lane to the leader over the ego's speed; inf without a leader, and "
            "where the ego stands", headway),
    Measure("npcs.speed", "m/s", "neither", "as recorded", partial(_of_npcs, _speed)),
    Measure("npcs.acceleration", "m/s^2", "neither", "as recorded", partial(_of_npcs, _acceleration)),
    Measure("npcs.lane", "", "neither", "as the ego's", partial(_of_npcs, _lane)),
    Measure("npcs.ahead", "m", "neither", f"how far it is ahead of the ego {_ROAD}; negative behind, NaN while it "
            "crosses", partial(_encounter, "ahead")),
    Measure("npcs.right", "m", "neither", "how far it is to the right of the ego across the road, between the centres; "
            "NaN while it crosses", partial(_encounter, "right")),
    Measure("npcs.gap", "m", "low", "between its box and the ego's; 0 at contact", partial(_encounter, "gap")),
    Measure("npcs.ttc", "s", "low", "time to contact with the ego at constant velocity, of the boxes; inf if there is "
            "none (Hayward 1972)", partial(_encounter, "ttc")),
    Measure("npcs.time_advantage", "s", "low", "from when one of it and the ego will leave the zone where their ways "
            "meet until the other comes, if both keep their speed; 0 if both are to be there at once, inf if one never "
            "comes, and without a zone (Laureshyn and others 2010)", _time_advantage),
)  # fmt: skip
"""What a run measures by itself, by the names that lead there: ``run.headway``, ``run.ego.jerk``, ``run.npcs[0].ttc``.

One table for the attributes of a run, the fitness of a name, the columns of a frame, and the reference.
"""

BY_NAME = {measure.name: measure for measure in MEASURES}


class Signals:
    """The signals of one run; each measure is computed once."""

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self._values: dict[Measure, FloatArray] = {}

    def of(self, measure: Measure, npc: int | None = None) -> Signal:
        """A measure as a signal, of one NPC where it is of each.

        Raises:
            ValueError: for a measure of each NPC without one, or the other way round.
        """
        values = self._values.get(measure)
        if values is None:
            values = self._values[measure] = measure.values(self.trace)
        if (values.ndim == 2) is (npc is None):
            wanted = "npc=0 and so on, as it is of each NPC" if npc is None else "no npc=, as it is not of each NPC"
            raise ValueError(f"measure {measure.name!r}: expected {wanted}, received npc={npc}")
        name = measure.name if npc is None else f"npcs[{npc}].{measure.name.removeprefix('npcs.')}"
        row = values if npc is None else values[npc]
        return Signal(row, hz=self.trace.physics_hz, name=name, unit=measure.unit)

    def all(self) -> Iterator[Signal]:
        """Each measure of :data:`MEASURES`, of each NPC; those at a zone only of NPCs that have one."""
        npcs = range(self.trace.states.shape[1] - 1)
        crossing = [npc for npc, zone in enumerate(self.trace.zones) if zone is not None]
        for measure in MEASURES:
            of_npcs = crossing if measure.function is _time_advantage else npcs
            of_whom = of_npcs if measure.name.startswith(NpcSignals._of) else (None,)
            yield from (self.of(measure, npc) for npc in of_whom)

    @property
    def ego(self) -> EgoSignals:
        """Those of the ego."""
        return EgoSignals(self)

    @property
    def npcs(self) -> tuple[NpcSignals, ...]:
        """Those of each NPC."""
        return tuple(NpcSignals(self, npc) for npc in range(self.trace.states.shape[1] - 1))


class _Vehicle:
    """The measures of one vehicle as attributes."""

    _of: str

    def __init__(self, signals: Signals, npc: int | None = None) -> None:
        self._signals, self._npc = signals, npc

    def __dir__(self) -> list[str]:
        more = [name for name, value in vars(type(self)).items() if isinstance(value, property)]
        return [*(name.removeprefix(self._of) for name in BY_NAME if name.startswith(self._of)), *more]

    if not TYPE_CHECKING:  # type checkers know every name

        def __getattr__(self, name: str) -> Any:
            __tracebackhide__ = True  # by pytest: the line of the test function is the last one then
            measure = BY_NAME.get(self._of + name)
            if measure is None or name.startswith("_"):
                raise AttributeError(f"{self._of}{name}: expected one of {', '.join(dir(self))}")
            return self._signals.of(measure, self._npc)


class EgoSignals(_Vehicle):
    """Signals of the ego, as in :data:`MEASURES`."""

    _of = "ego."
    speed: Signal
    acceleration: Signal
    jerk: Signal
    lateral_acceleration: Signal
    lane: Signal


class NpcSignals(_Vehicle):
    """Signals of one NPC, as in :data:`MEASURES`."""

    _of = "npcs."
    speed: Signal
    acceleration: Signal
    lane: Signal
    ahead: Signal
    right: Signal
    gap: Signal
    ttc: Signal
    time_advantage: Signal

    @property
    def zone(self) -> Zone | None:
        """The zone in which its way meets the ego's; None for one on the grid."""
        zones = self._signals.trace.zones
        return zones[self._npc or 0] if zones else None

    @property
    def passage(self) -> Passage | None:
        """When it and the ego were in that zone, and how much time was between them; None for one on the grid."""
        return passages(self._signals.trace)[self._npc or 0]
