"""Signals of a run, which have one value per tick, a name and a unit, and the table of all measures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality.measures import Encounters, encounters_of, gap, ttc
from pytest_pafot.criticality.rss import longitudinal_gap
from pytest_pafot.criticality.zones import Passage, passages, time_advantage
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, FloatArray, Trace

if TYPE_CHECKING:
    from typing import Self

_Array: TypeAlias = np.ndarray[Any, np.dtype[np.float64]]

Worse = Literal["low", "high", "both", "neither"]
"""Which values of a measure are worse for the ego: low values, high values, values far from 0, or neither."""


_REORDER = frozenset({np.flip, np.sort, np.roll, np.partition})
"""Functions of numpy that move values to other ticks."""

_KEEP_UNIT = frozenset({np.absolute, np.fabs, np.negative, np.positive})


class Signal(_Array):
    """A numpy array with one value per tick of a run, and with the tick that each value belongs to.

    A numpy operation that works value by value, such as ``abs(signal)``, ``signal / 2`` or
    ``np.where(..., signal, 0)``, returns a signal over the same ticks. The new signal has no name. ``abs(signal)`` and
    ``-signal`` keep the unit; all other operations drop it. In an operation on two signals, the first signal determines
    the ticks. A slice such as ``signal[30:150]`` begins 30 ticks later. Any other selection, such as
    ``signal[signal > 1]`` or ``signal[::2]``, returns a signal whose ticks are unknown. Comparisons and sums return
    plain arrays and numbers.

    Args:
        values: one value per tick; the signal stores a read-only copy.
        hz: ticks per second; None if unknown.
        start: tick of the first value.
        name: name, such as ``ego.speed``.
        unit: unit, such as ``m/s``.

    Raises:
        ValueError: if ``values`` is not one-dimensional.
    """

    hz: float | None = None
    start: int = 0
    name: str = ""
    unit: str = ""

    def __new__(
        cls, values: npt.ArrayLike, *, hz: float | None = None, start: int = 0, name: str = "", unit: str = ""
    ) -> Self:
        """Make a signal from any values."""
        signal = np.array(values, dtype=np.float64).view(cls)
        if signal.ndim != 1:
            raise ValueError(f"signal {name!r}: expected one value a tick, received an array of shape {signal.shape}")
        signal.__dict__.update(hz=hz, start=start, name=name, unit=unit)
        signal.flags.writeable = False
        return signal

    def __array_finalize__(self, source: object) -> None:
        """Copy ticks, name and unit from a source signal of the same shape; otherwise they are unknown."""
        if isinstance(source, Signal) and source.shape == self.shape:
            self.__dict__.update(source.__dict__)

    def __array_wrap__(self, array: _Array, context: Any = None, return_scalar: bool = False) -> Any:
        """Make a signal of an array that numpy computed from signals; this signal is the first of them."""
        if array.shape != self.shape or array.dtype != np.float64:
            return array[()] if return_scalar else array
        signal = array.view(type(self))
        unit = self.unit if context is not None and context[0] in _KEEP_UNIT else ""
        signal.__dict__.update(self.__dict__, name="", unit=unit)
        return signal

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        """Call a numpy function that is not arithmetic, and make a signal of the array that it returns."""
        result = super().__array_function__(func, types, args, kwargs)
        if func in _REORDER:
            return np.asarray(result)
        return self.__array_wrap__(result) if isinstance(result, np.ndarray) else result

    def __getitem__(self, key: Any) -> Any:
        """Return one value, or a selection of values as a signal."""
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
        """Restore a pickled signal and make it read-only again: pickling makes arrays writeable."""
        super().__setstate__(state[0])
        self.__dict__.update(state[1])
        self.flags.writeable = False


@dataclass(frozen=True, slots=True)
class Measure:
    """A measure of the ego or of each NPC at each tick of a run; a call with a trace returns a fitness.

    Attributes:
        name: such as ``headway`` or ``ego.jerk``; of a measure of each NPC such as ``npcs.ttc``.
        unit: such as ``m/s^3``; empty for a number.
        worse: values that are worse for the ego: ``low``, ``high``, ``both`` (far from 0) or ``neither``.
        source: definition and publication.
        function: of a trace, returns an array of shape [ticks + 1], or [NPCs, ticks + 1] for a value of each NPC.
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
        """Return all values of a run, shape [ticks + 1] or [NPCs, ticks + 1].

        Raises:
            ValueError: if the function returns an array of a different shape.
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
        """Return the measure as a fitness between -1 and 1, which is higher if the run is worse for the ego.

        It is v / (1 + |v|), where v is the worst value, with its sign changed if low values are worse.

        Raises:
            ValueError: if ``worse`` is ``neither``.
        """
        if self.worse == "neither":
            raise ValueError(f"measure {self.name!r}: expected worse='low', 'high' or 'both', received 'neither'")
        risk = {"low": np.negative, "high": np.positive, "both": np.abs}[self.worse](self.values(trace))
        worst = float(risk.max(initial=-np.inf))
        return math.copysign(1.0, worst) if math.isinf(worst) else worst / (1 + abs(worst))


def leader(trace: Trace) -> npt.NDArray[np.intp]:
    """Return the index of the leader at each tick, the nearest NPC ahead in the ego's lane; -1 if there is none.

    The centres of the vehicles determine the lane and the distance. The shape is [ticks + 1]. An NPC that crosses can
    be the leader only after it has merged into the ego's way.
    """
    encounters = encounters_of(trace)
    is_ahead = encounters.same_lane & ~(encounters.ahead < 0)
    nobody = np.full((1, trace.ticks + 1), np.inf)
    nearest: npt.NDArray[np.intp] = np.vstack((nobody, np.where(is_ahead, encounters.ahead, np.inf))).argmin(axis=0)
    return nearest - 1


def headway(trace: Trace) -> FloatArray:
    """Return the time that the ego needs to reach the rear of its :func:`leader` [s], shape [ticks + 1].

    It is the gap between the boxes along the lane, divided by the ego's speed; inf without a leader or if the ego
    stands.
    """
    ahead, speed = leader(trace), trace.ego[:, SPEED]
    moves = (ahead >= 0) & ~(speed <= 0)
    seconds = np.full(len(ahead), np.inf)
    seconds[moves] = longitudinal_gap(trace)[moves, ahead[moves]] / speed[moves]
    return seconds


def jerk(trace: Trace) -> FloatArray:
    """Return each vehicle's change of acceleration since the previous tick, per second [m/s^3].

    The shape is [vehicles, ticks + 1]. The jerk is 0 at the first tick. The acceleration is 0 at the first tick, too,
    so a vehicle that brakes from the start has a jerk at the second tick.
    """
    acceleration = trace.states[:, :, ACCELERATION].T
    return np.diff(acceleration, prepend=acceleration[:, :1]) * trace.physics_hz


def lateral_acceleration(trace: Trace) -> FloatArray:
    """Return each vehicle's speed times the turning rate of its heading [m/s^2], shape [vehicles, ticks + 1].

    The turning rate is the change since the previous tick, positive to the right, 0 at the first tick. This is the
    acceleration that pulls a passenger sideways in a steady turn. It ignores the slip of the vehicle, which jumps with
    the steering angle in a kinematic model.
    """
    heading = np.unwrap(trace.states[:, :, HEADING].T)
    turning: FloatArray = np.diff(heading, prepend=heading[:, :1]) * trace.physics_hz
    return turning * trace.states[:, :, SPEED].T


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoLaneChange:
    """A lane change of the ego, which is when its centre enters a different lane.

    Attributes:
        tick: first tick in the new lane.
        time: its time [s].
        from_lane, to_lane: their indices.
        gap_ahead, gap_behind: along the road to the nearest NPC with its centre in the new lane [m]; 0 side by side,
            inf if there is none.
    """

    tick: int
    time: float
    from_lane: int
    to_lane: int
    gap_ahead: float
    gap_behind: float


def ego_lane_changes(trace: Trace) -> tuple[EgoLaneChange, ...]:
    """Return the ego's lane changes in the order of their times; ticks at which the ego is off the road are ignored."""
    lane = trace.ego[:, LANE]
    on_road = np.flatnonzero(lane >= 0)
    changed = np.flatnonzero(np.diff(lane[on_road]))
    if not changed.size:
        return ()
    encounters, gap, found = encounters_of(trace), longitudinal_gap(trace), []
    for at in changed:
        before, tick = on_road[at : at + 2].tolist()
        is_there, is_ahead = encounters.same_lane[:, tick], ~(encounters.ahead[:, tick] < 0)
        change = EgoLaneChange(
            tick=tick,
            time=tick / trace.physics_hz,
            from_lane=int(lane[before]),
            to_lane=int(lane[tick]),
            gap_ahead=float(gap[tick, is_there & is_ahead].min(initial=np.inf)),
            gap_behind=float(gap[tick, is_there & ~is_ahead].min(initial=np.inf)),
        )
        found.append(change)
    return tuple(found)


def _recorded(vehicles: int | slice, column: int, trace: Trace) -> FloatArray:
    return trace.states[:, vehicles, column].T


def _ego(function: Callable[[Trace], FloatArray], trace: Trace) -> FloatArray:
    """Return the ego's row of a measure of all vehicles."""
    values: FloatArray = function(trace)[0]
    return values


def _npcs(function: Callable[[Trace], FloatArray], trace: Trace) -> FloatArray:
    """Return a measure of the shape [ticks + 1, NPCs] with a row for each NPC."""
    return function(trace).T


def _ahead(trace: Trace) -> FloatArray:
    return Encounters(trace).ahead  # not the cached one, because the caller may change the array


def _right(trace: Trace) -> FloatArray:
    return Encounters(trace).right


_of_ego, _of_npcs = partial(_recorded, 0), partial(_recorded, slice(1, None))
_TURNING = "speed times turning rate since the tick before, positive to the right"
_JERK = "change of the acceleration since the tick before, per second"
_LANE = "index of that of its centre, on a straight road from 0 at the left; -1 off the road"
_ROAD = "along the road, between the centres"

# Partial functions of named functions, because lambdas cannot be sent to other processes.
MEASURES = (
    Measure("ego.speed", "m/s", "high", "as recorded", partial(_of_ego, SPEED)),
    Measure("ego.acceleration", "m/s^2", "low", "as recorded; negative in braking", partial(_of_ego, ACCELERATION)),
    Measure("ego.jerk", "m/s^3", "both", _JERK, partial(_ego, jerk)),
    Measure("ego.lateral_acceleration", "m/s^2", "both", _TURNING, partial(_ego, lateral_acceleration)),
    Measure("ego.lane", "", "neither", _LANE, partial(_of_ego, LANE)),
    Measure("headway", "s", "low", "gap to the leader, divided by the ego's speed; inf without a leader, or if the "
            "ego stands", headway),
    Measure("npcs.speed", "m/s", "neither", "as recorded", partial(_of_npcs, SPEED)),
    Measure("npcs.acceleration", "m/s^2", "neither", "as recorded", partial(_of_npcs, ACCELERATION)),
    Measure("npcs.lane", "", "neither", _LANE, partial(_of_npcs, LANE)),
    Measure("npcs.ahead", "m", "neither", f"ahead of the ego {_ROAD}; negative behind, NaN while it crosses",
            _ahead),
    Measure("npcs.right", "m", "neither", "right of the ego across the road, between the centres; NaN while it "
            "crosses", _right),
    Measure("npcs.gap", "m", "low", "between the NPC's box and the ego's",
            partial(_npcs, gap)),
    Measure("npcs.ttc", "s", "low", "time to contact of the boxes at constant velocity, or inf (Hayward 1972)",
            partial(_npcs, ttc)),
    Measure("npcs.time_advantage", "s", "low", "from the exit of ego or NPC from their zone to the entry of the "
            "other, if both keep their speed; 0 if both would be there at once, inf if one would never arrive "
            "(Laureshyn and others 2010)",
            partial(_npcs, time_advantage)),
)  # fmt: skip
"""The measures of every run, named like the attributes ``run.headway``, ``run.ego.jerk`` and ``run.npcs[0].ttc``.

This table defines the attributes of a run, the measures that a search accepts as a fitness by name, the columns of
``run.to_pandas()``, and the page of the reference.
"""

BY_NAME = {measure.name: measure for measure in MEASURES}


class Signals:
    """The signals of one run; each measure is computed only once."""

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self._values: dict[Measure, FloatArray] = {}

    def of(self, measure: Measure, npc: int | None = None) -> Signal:
        """Return a measure as a signal; ``npc`` is the index of the NPC if the measure has one value for each NPC.

        Raises:
            ValueError: if ``npc`` is missing, or is given for a measure that is not one of each NPC.
        """
        values = self._values.get(measure)
        if values is None:
            values = self._values[measure] = measure.values(self.trace)
        if (values.ndim == 2) is (npc is None):
            wanted = "npc=0 and so on, because it has a row for each NPC" if npc is None else "no npc="
            raise ValueError(f"measure {measure.name!r}: expected {wanted}, received npc={npc}")
        name = measure.name if npc is None else f"npcs[{npc}].{measure.name.removeprefix('npcs.')}"
        row = values if npc is None else values[npc]
        return Signal(row, hz=self.trace.physics_hz, name=name, unit=measure.unit)

    def all(self) -> Iterator[Signal]:
        """Yield the signals of all measures: one per measure of the ego, and one per NPC for a measure of each NPC.

        The time advantage is defined only for NPCs that cross, so the others have no such signal.
        """
        npcs = range(self.trace.states.shape[1] - 1)
        crossing = [npc for npc, zone in enumerate(self.trace.zones) if zone is not None]
        for measure in MEASURES:
            of_npcs = crossing if measure.name == "npcs.time_advantage" else npcs
            of_whom = of_npcs if measure.name.startswith(NpcSignals._of) else (None,)
            yield from (self.of(measure, npc) for npc in of_whom)

    @property
    def ego(self) -> EgoSignals:
        """The signals of the ego."""
        return EgoSignals(self)

    @property
    def npcs(self) -> tuple[NpcSignals, ...]:
        """The signals of each NPC."""
        return tuple(NpcSignals(self, npc) for npc in range(self.trace.states.shape[1] - 1))


class _Vehicle:
    """A vehicle whose attributes are its measures."""

    _of: str

    def __init__(self, signals: Signals, npc: int | None = None) -> None:
        self._signals, self._npc = signals, npc

    def __dir__(self) -> list[str]:
        more = [name for name, value in vars(type(self)).items() if isinstance(value, property)]
        return [*(name.removeprefix(self._of) for name in BY_NAME if name.startswith(self._of)), *more]

    if not TYPE_CHECKING:  # type checkers know every name

        def __getattr__(self, name: str) -> Any:
            __tracebackhide__ = True  # pytest then shows the line of the test function as the last one
            measure = BY_NAME.get(self._of + name)
            if measure is None or name.startswith("_"):
                raise AttributeError(f"{self._of}{name}: expected one of {', '.join(dir(self))}")
            return self._signals.of(measure, self._npc)


class EgoSignals(_Vehicle):
    """The signals of the ego, see :data:`MEASURES`."""

    _of = "ego."
    speed: Signal
    acceleration: Signal
    jerk: Signal
    lateral_acceleration: Signal
    lane: Signal


class NpcSignals(_Vehicle):
    """The signals of one NPC, see :data:`MEASURES`."""

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
        """The zone where the NPC's way meets the ego's; None for an NPC that does not cross."""
        zones = self._signals.trace.zones
        return zones[self._npc or 0] if zones else None

    @property
    def passage(self) -> Passage | None:
        """The times at which the NPC and the ego were in the zone of their ways; None if it does not cross."""
        return passages(self._signals.trace)[self._npc or 0]
