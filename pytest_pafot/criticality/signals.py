"""The signals of a run, the table of all measures, and the times at which crossing NPCs pass their zones."""

# A vehicle is in a zone as long as its box could touch the box of a vehicle on the other path.
#
# Sources: Allen, Shin, Cooper, "Analysis of traffic conflicts and collisions", Transportation Research Record 667,
# 1978, for post-encroachment time; Laureshyn, Svensson, Hyden, "Evaluation of traffic safety, based on micro-level
# behavioural data", Accident Analysis and Prevention 42, 2010, for time advantage, which predicts that time.

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality.measures import encounters_of, gap, longitudinal_gap, ttc
from pytest_pafot.model.crossings import Stretch, Zone
from pytest_pafot.model.trace import ACCELERATION, ALONG, HEADING, LANE, SPEED, FloatArray, Trace

ROUNDING = 1e-6  # tolerance for the rounding of a time in ticks


@dataclass(frozen=True, slots=True, kw_only=True)
class Passage:
    """The times at which the ego and an NPC were in the zone where their paths cross.

    Attributes:
        npc: index of the NPC.
        zone: zone where the two paths cross.
        ego_enters, npc_enters: time [s] of the vehicle's first tick in the zone, or inf.
        ego_leaves, npc_leaves: time [s] of the vehicle's first tick after the zone, or inf.
    """

    npc: int
    zone: Zone
    ego_enters: float
    ego_leaves: float
    npc_enters: float
    npc_leaves: float

    @property
    def post_encroachment_time(self) -> float:
        """The time [s] between one vehicle's exit from the zone and the other vehicle's entry. Lower is worse."""
        if math.inf in (self.ego_enters, self.npc_enters):
            return math.inf  # one of them never arrived
        # It is 0 if both were in the zone together.
        return max(self.npc_enters - self.ego_leaves, self.ego_enters - self.npc_leaves, 0.0)


def passages(trace: Trace) -> tuple[Passage | None, ...]:
    """Return, for each NPC, the passage through the zone where its path crosses the ego's, or None without a zone."""
    # A user's world may record zones without the positions of the vehicles on their paths.
    if not trace.zones or not _has_positions(trace):
        return (None,) * len(trace.npcs[0])
    found = [_passage(trace, npc, zone) for npc, zone in enumerate(trace.zones)]
    return tuple(found)


def time_advantage(trace: Trace) -> FloatArray:
    """Return the post-encroachment time [s] that would result if the ego and the NPC kept their speeds.

    It is infinite if either would never reach the zone, or if the NPC does not cross the ego's path.
    """
    advantage = np.full(trace.npcs.shape[:2], np.inf)
    for npc, zone in enumerate(trace.zones):
        if zone is None:
            continue
        if not _has_positions(trace):
            advantage[:, npc] = np.nan
            continue
        (ego_enters, ego_leaves), (npc_enters, npc_leaves) = (
            [_seconds_to(place, along, speed, trace.physics_hz) for place in stretch]
            for along, speed, stretch in _paths_to_zone(trace, npc, zone)
        )
        with np.errstate(invalid="ignore"):  # inf - inf, if both never arrive
            gap = np.maximum(npc_enters - ego_leaves, ego_enters - npc_leaves)
        # If both would be in the zone together, the advantage is 0.
        is_alone = np.isposinf(ego_enters) | np.isposinf(npc_enters)
        gap = np.maximum(gap, 0.0)
        advantage[:, npc] = np.where(is_alone, np.inf, gap)
    return advantage


def _has_positions(trace: Trace) -> bool:
    # Whether the run has the positions of all vehicles on the paths of its zones.
    return trace.on_way is not None and not trace.road.is_straight


def _passage(trace: Trace, npc: int, zone: Zone | None) -> Passage | None:
    if zone is None:
        return None
    (ego_enters, ego_leaves), (npc_enters, npc_leaves) = (
        [_first_at(place, along) / trace.physics_hz for place in stretch]
        for along, _, stretch in _paths_to_zone(trace, npc, zone)
    )
    return Passage(
        npc=npc,
        zone=zone,
        ego_enters=ego_enters,
        ego_leaves=ego_leaves,
        npc_enters=npc_enters,
        npc_leaves=npc_leaves,
    )


def _paths_to_zone(
    trace: Trace,
    npc: int,
    zone: Zone,
) -> tuple[tuple[FloatArray, FloatArray, Stretch], ...]:
    # For the ego and the NPC: the positions along the path [m], the speeds [m/s], and the section of the zone.
    speeds = trace.states[:, :, SPEED]
    ego = (trace.track_of(0)[:, ALONG], speeds[:, 0], zone.ego)
    return ego, (trace.way_of(npc), speeds[:, npc + 1], zone.npc)


def _first_at(place: float, along: FloatArray) -> float:
    # The first tick at which a vehicle had reached a position [m]; inf if never, NaN if a position is unknown.
    if np.isnan(along).any():
        return math.nan
    ticks = np.flatnonzero(along >= place)
    if ticks.size:
        return float(ticks[0])
    return math.inf


def _seconds_to(place: float, along: FloatArray, speed: FloatArray, hz: float) -> FloatArray:
    # The seconds until a vehicle reaches a position at its present speed, at each tick.
    ticks = np.arange(len(along))
    is_moving = speed > 0
    seconds = (place - along) / np.where(is_moving, speed, 1.0)
    ahead = np.where(is_moving, seconds, np.inf)
    # After the vehicle has reached the position, the time is 0 or negative.
    first = _first_at(place, along)
    since = (min(first, len(along)) - ticks) / hz
    return np.where(ticks >= first, since, ahead)


# The values of a measure that are worse for the ego: low values, high values, values far from 0, or no values.
Worse = Literal["low", "high", "both", "neither"]


@dataclass(frozen=True, slots=True)
class Measure:
    """A measure of the ego, or of each NPC, at every tick of a run. It is also a fitness function of the run."""

    name: str  # such as `ego.jerk`, or `npcs.ttc` for each NPC
    unit: str  # such as `m/s^3`; empty for a number
    worse: Worse
    source: str  # definition and publication
    # returns the shape [ticks + 1], or [NPCs, ticks + 1] for each NPC
    function: Callable[[Trace], FloatArray]

    def __call__(self, trace: Trace) -> float:
        """Return the run's worst value of the measure as a fitness between -1 and 1."""
        # v / (1 + |v|) for the worst value v, with the opposite sign if low values are worse. A measure for which no
        # values are worse cannot be a fitness.
        signs = {"low": np.negative, "high": np.positive, "both": np.abs}
        risk = signs[self.worse](self.function(trace))
        worst = float(risk.max(initial=-np.inf))
        if math.isinf(worst):
            return math.copysign(1.0, worst)
        return worst / (1 + abs(worst))


def leader(trace: Trace) -> npt.NDArray[np.intp]:
    """Return, for each tick, the index of the nearest NPC ahead in the ego's lane, or -1."""
    encounters = encounters_of(trace)
    ahead = encounters.road.ahead
    is_leading = encounters.same_lane & ~(ahead < 0)
    nobody = np.full((1, trace.ticks + 1), np.inf)
    leading = np.where(is_leading, ahead, np.inf)
    distances = np.vstack((nobody, leading))
    nearest: npt.NDArray[np.intp] = distances.argmin(axis=0)
    return nearest - 1


def headway(trace: Trace) -> FloatArray:
    """Return, for each tick, the time [s] until the ego reaches the rear of its :func:`leader`."""
    ahead = leader(trace)
    speed = trace.ego[:, SPEED]
    moves = (ahead >= 0) & ~(speed <= 0)
    seconds = np.full(len(ahead), np.inf)  # without a leader, or while the ego is stationary
    gaps = longitudinal_gap(trace)[moves, ahead[moves]]
    seconds[moves] = gaps / speed[moves]
    return seconds


def jerk(trace: Trace) -> FloatArray:
    """Return each vehicle's change in acceleration per second [m/s^3], as an array of shape [vehicles, ticks + 1]."""
    acceleration = trace.states[:, :, ACCELERATION].T
    # The acceleration is 0 at the first tick, so a vehicle that brakes from the start has a jerk at the second tick.
    return np.diff(acceleration, prepend=acceleration[:, :1]) * trace.physics_hz


def lateral_acceleration(trace: Trace) -> FloatArray:
    """Return the product of each vehicle's speed and turning rate [m/s^2], with shape [vehicles, ticks + 1]."""
    # This is the acceleration that pulls a passenger sideways in a steady turn. It ignores the slip, which jumps with
    # the steering angle in a kinematic model.
    heading = np.unwrap(trace.states[:, :, HEADING].T)
    turning: FloatArray = np.diff(heading, prepend=heading[:, :1]) * trace.physics_hz
    return turning * trace.states[:, :, SPEED].T


@dataclass(frozen=True, slots=True, kw_only=True)
class EgoLaneChange:
    """A lane change of the ego, in which its centre enters another lane.

    Attributes:
        tick: first tick in the new lane.
        time: time [s] of this tick.
        from_lane, to_lane: indices of the old and the new lane.
        gap_ahead, gap_behind: gap [m] along the road to the nearest NPC in the new lane, or inf. The gap to an NPC next
            to the ego is 0.
    """

    tick: int
    time: float
    from_lane: int
    to_lane: int
    gap_ahead: float
    gap_behind: float


def ego_lane_changes(trace: Trace) -> tuple[EgoLaneChange, ...]:
    """Return the ego's lane changes in order, ignoring ticks at which the ego is off the road."""
    lane = trace.ego[:, LANE]
    on_road = np.flatnonzero(lane >= 0)
    changed = np.flatnonzero(np.diff(lane[on_road]))
    if not changed.size:
        return ()
    encounters = encounters_of(trace)
    gap = longitudinal_gap(trace)
    found = []
    for at in changed:
        before, tick = on_road[at : at + 2].tolist()
        is_there = encounters.same_lane[:, tick]
        is_ahead = ~(encounters.road.ahead[:, tick] < 0)
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
    values: FloatArray = function(trace)[0]  # the ego is the first vehicle
    return values


def _npcs(function: Callable[[Trace], FloatArray], trace: Trace) -> FloatArray:
    return function(trace).T


def _ahead(trace: Trace) -> FloatArray:
    return trace.road.ahead  # not a cached one, because the caller may change the array


def _right(trace: Trace) -> FloatArray:
    return trace.road.right


_of_ego = partial(_recorded, 0)
_of_npcs = partial(_recorded, slice(1, None))
_TURNING = "speed times the mean turning rate since the previous tick, positive to the right"
_JERK = "change of the acceleration since the previous tick, per second"
_LANE = "index of the lane that contains the centre, from 0 at the left of a straight road; -1 off the road"
_ROAD = "along the road, between the centres"

# This table defines the attributes of a run, the measures that `fitness=` accepts, the columns of `run.to_pandas()`,
# and a table in the documentation. It uses partial functions, because lambdas cannot be sent to other processes.
MEASURES = (
    Measure("ego.speed", "m/s", "high", "as recorded", partial(_of_ego, SPEED)),
    Measure("ego.acceleration", "m/s^2", "low", "as recorded; negative during braking", partial(_of_ego, ACCELERATION)),
    Measure("ego.jerk", "m/s^3", "both", _JERK, partial(_ego, jerk)),
    Measure("ego.lateral_acceleration", "m/s^2", "both", _TURNING, partial(_ego, lateral_acceleration)),
    Measure("ego.lane", "", "neither", _LANE, partial(_of_ego, LANE)),
    Measure("headway", "s", "low", "gap to the leader, divided by the ego's speed; inf without a leader, or if the "
            "ego is stationary", headway),
    Measure("npcs.speed", "m/s", "neither", "as recorded", partial(_of_npcs, SPEED)),
    Measure("npcs.acceleration", "m/s^2", "neither", "as recorded", partial(_of_npcs, ACCELERATION)),
    Measure("npcs.lane", "", "neither", _LANE, partial(_of_npcs, LANE)),
    Measure("npcs.ahead", "m", "neither", f"distance ahead of the ego {_ROAD}; negative behind, NaN while "
            "the NPC is not on the ego's path", _ahead),
    Measure("npcs.right", "m", "neither", "lateral distance of the NPC's centre to the right of the "
            "ego's centre; NaN while the NPC is not on the ego's path", _right),
    Measure("npcs.gap", "m", "low", "gap between the boxes of the NPC and the ego",
            partial(_npcs, gap)),
    Measure("npcs.ttc", "s", "low", "time until the boxes touch at constant velocity, or inf (Hayward 1972)",
            partial(_npcs, ttc)),
    Measure("npcs.time_advantage", "s", "low", "time from one vehicle's exit from the zone to the other's entry, at "
            "their present speeds; 0 if both would be in the zone together, inf if one would never arrive "
            "(Laureshyn and others 2010)",
            partial(_npcs, time_advantage)),
)  # fmt: skip
"""All measures, each named after the attribute of a run that contains its values."""

BY_NAME = {measure.name: measure for measure in MEASURES}


class Signals:
    """The lazily computed signals of one run."""

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self._values: dict[Callable[[Trace], npt.ArrayLike], FloatArray] = {}

    def values_of(
        self,
        function: Callable[[Trace], npt.ArrayLike],
        npc: int | None = None,
    ) -> FloatArray:
        """Return the read-only values of a function of the trace, one per tick.

        Args:
            function: function that returns an array of shape [ticks + 1], or [NPCs, ticks + 1].
            npc: index of an NPC, if the array has the second shape.

        Raises:
            ValueError: if the array has a different shape, or ``npc`` does not match the shape.
        """
        values = self._values.get(function)  # each function of the trace is called only once
        if values is None:
            values = np.array(function(self.trace), dtype=np.float64)
            rows = self.trace.ticks + 1
            npcs = len(self.trace.npcs[0])
            if values.shape not in ((rows,), (npcs, rows)):
                raise ValueError(
                    f"signal {_name_of(function)}: expected an array of shape ({rows},), with one value per tick, or "
                    f"({npcs}, {rows}), with one per NPC and tick, but received one of shape {values.shape}"
                )
            values.flags.writeable = False
            self._values[function] = values
        wanted = ""
        if npc is None and values.ndim == 2:
            wanted = "an index such as npc=0, because the signal has one row for each NPC"
        if npc is not None and values.ndim == 1:
            wanted = "no npc="
        if wanted:
            raise ValueError(
                f"signal {_name_of(function)}: expected {wanted}, but received npc={npc}"
            )
        if npc is None:
            return values
        row: FloatArray = values[npc]
        return row

    def all(self) -> Iterator[tuple[str, FloatArray]]:
        # Yields the name and the values of each measure, with `npcs[0].ttc` and so on for a measure of each NPC.
        for measure in MEASURES:
            vehicle, _, name = measure.name.partition(".")
            if vehicle != "npcs":
                yield measure.name, self.values_of(measure.function)
                continue
            for npc in range(len(self.trace.npcs[0])):
                # The time advantage is defined only for NPCs that cross.
                if name != "time_advantage" or self.trace.zone_of(npc) is not None:
                    yield f"npcs[{npc}].{name}", self.values_of(measure.function, npc)

    @property
    def ego(self) -> EgoSignals:
        return EgoSignals(self)

    @property
    def npcs(self) -> tuple[NpcSignals, ...]:
        return tuple(NpcSignals(self, npc) for npc in range(len(self.trace.npcs[0])))


def _name_of(function: object) -> str:
    return repr(getattr(function, "__name__", function))


class _Vehicle:
    _of: str

    def __init__(self, signals: Signals, npc: int | None = None) -> None:
        self._signals = signals
        self._npc = npc

    def __dir__(self) -> list[str]:
        measures = [name.removeprefix(self._of) for name in BY_NAME if name.startswith(self._of)]
        more = [name for name, value in vars(type(self)).items() if isinstance(value, property)]
        return measures + more

    if not TYPE_CHECKING:  # type checkers know every name

        def __getattr__(self, name: str) -> Any:
            # pytest then shows the line of the test function as the last one
            __tracebackhide__ = True
            measure = BY_NAME.get(self._of + name)
            if measure is None or name.startswith("_"):
                raise AttributeError(f"{self._of}{name}: expected one of {', '.join(dir(self))}")
            return self._signals.values_of(measure.function, self._npc)


class EgoSignals(_Vehicle):
    """The signals of the ego, as listed in :data:`MEASURES`."""

    _of = "ego."
    speed: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    lateral_acceleration: FloatArray
    lane: FloatArray


class NpcSignals(_Vehicle):
    """The signals of one NPC, as listed in :data:`MEASURES`."""

    _of = "npcs."
    speed: FloatArray
    acceleration: FloatArray
    lane: FloatArray
    ahead: FloatArray
    right: FloatArray
    gap: FloatArray
    ttc: FloatArray
    time_advantage: FloatArray

    @property
    def zone(self) -> Zone | None:
        """The zone where the NPC's path crosses the ego's path, or None."""
        return self._signals.trace.zone_of(self._npc or 0)

    @property
    def passage(self) -> Passage | None:
        """The times at which the NPC and the ego pass their zone, or None."""
        return passages(self._signals.trace)[self._npc or 0]
