"""Signals of a run, which have one value per tick, the table of all measures, and the passages of NPCs that cross.

A passage is what ego and NPC do in the zone where their ways meet: when each is in it, how narrowly they pass, and
whether the NPC came as it was asked to. The beginning and end of a zone are those of :class:`~pytest_pafot.Zone`. A
vehicle is in a zone as long as its box could touch the box of a vehicle on the other way.

Sources: Allen, Shin, Cooper, "Analysis of traffic conflicts and collisions", Transportation Research Record 667, 1978,
for post-encroachment time; Laureshyn, Svensson, Hyden, "Evaluation of traffic safety, based on micro-level behavioural
data", Accident Analysis and Prevention 42, 2010, for time advantage, which is the predicted post-encroachment time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from pytest_pafot.criticality.measures import Encounters, encounters_of, gap, longitudinal_gap, ttc
from pytest_pafot.model.crossings import Stretch, Zone
from pytest_pafot.model.trace import ACCELERATION, ALONG, HEADING, LANE, SPEED, FloatArray, Trace

ROUNDING = 1e-6
"""The tolerance for the rounding of a time in ticks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Passage:
    """The times at which the ego and an NPC were in the zone where their ways meet.

    Attributes:
        npc: its index.
        zone: zone where the two ways meet.
        ego_enters, npc_enters: time of its first tick in the zone [s]; inf if it never was there.
        ego_leaves, npc_leaves: time of its first tick after it [s]; inf if it did not leave.
    """

    npc: int
    zone: Zone
    ego_enters: float
    ego_leaves: float
    npc_enters: float
    npc_leaves: float

    @property
    def post_encroachment_time(self) -> float:
        """The time between the first vehicle's exit from the zone and the second one's entry [s]; lower is worse.

        0 if both were in the zone at the same time, inf if one of them never arrived.
        """
        if math.inf in (self.ego_enters, self.npc_enters):
            return math.inf
        return max(self.npc_enters - self.ego_leaves, self.ego_enters - self.npc_leaves, 0.0)


def passages(trace: Trace) -> tuple[Passage | None, ...]:
    """Return for each NPC the passage of the zone where its way meets the ego's; None if it does not cross.

    None, too, if a user's world records zones but not the vehicles' positions on their ways.
    """
    zones = trace.zones if _has_places(trace) else ()
    return tuple(_passage(trace, npc, zone) for npc, zone in enumerate(zones or (None,) * len(trace.npcs[0])))


def time_advantage(trace: Trace) -> FloatArray:
    """Return the post-encroachment time that would result if ego and NPC kept their speeds [s]; lower is worse.

    Shape [ticks + 1, NPCs]. 0 if both would be in the zone at the same time. Infinite if one of them would never reach
    the zone, and for an NPC that does not cross. After a vehicle has entered or left the zone, the actual time is used.
    """
    advantage = np.full((trace.ticks + 1, trace.states.shape[1] - 1), np.inf)
    for npc, zone in enumerate(trace.zones):
        if zone is None:
            continue
        if not _has_places(trace):
            advantage[:, npc] = np.nan
            continue
        ego, other = (
            [_seconds_to(place, along, trace.states[:, vehicle, SPEED], trace.physics_hz) for place in stretch]
            for vehicle, along, stretch in _ways(trace, npc, zone)
        )
        with np.errstate(invalid="ignore"):  # inf - inf, if both never arrive
            gap = np.maximum(other[0] - ego[1], ego[0] - other[1])
        is_alone = np.isposinf(ego[0]) | np.isposinf(other[0])
        advantage[:, npc] = np.where(is_alone, np.inf, np.maximum(gap, 0.0))
    return advantage


def times_expected(trace: Trace, npc: int, tick: int) -> tuple[Stretch, Stretch]:
    """Return when the ego would have been in the zone of an NPC at its speed of a tick, and when the NPC was [s].

    Both are the times of entering and leaving. What the NPC had not reached at the end of the run is at its speed then.
    """
    zone: Any = trace.zones[npc]
    hz = trace.physics_hz
    ego_enters, ego_leaves, enters, leaves = (
        at / hz + float(_seconds_to(place, along, trace.states[:, vehicle, SPEED], hz)[at])
        for at, (vehicle, along, stretch) in zip((tick, trace.ticks), _ways(trace, npc, zone), strict=True)
        for place in stretch
    )
    return (ego_enters, ego_leaves), (enters, leaves)


def _has_places(trace: Trace) -> bool:
    """Return whether a run has the places of all vehicles on the ways for which its zones are."""
    return trace.on_way is not None and not trace.road.is_straight


def _passage(trace: Trace, npc: int, zone: Zone | None) -> Passage | None:
    if zone is None:
        return None
    enters_and_leaves = [
        [_first_at(place, along) / trace.physics_hz for place in stretch]
        for _, along, stretch in _ways(trace, npc, zone)
    ]
    (ego_enters, ego_leaves), (npc_enters, npc_leaves) = enters_and_leaves
    return Passage(
        npc=npc, zone=zone, ego_enters=ego_enters, ego_leaves=ego_leaves, npc_enters=npc_enters, npc_leaves=npc_leaves
    )


def _ways(trace: Trace, npc: int, zone: Zone) -> tuple[tuple[int, FloatArray, Stretch], ...]:
    """Return for the ego and for an NPC: vehicle index, positions along its way [m], and its stretch of the zone."""
    on_way: Any = trace.on_way
    return (0, trace.track_of(0)[:, ALONG], zone.ego), (npc + 1, on_way[:, npc], zone.npc)


def _first_at(place: float, along: FloatArray) -> float:
    """Return the first tick at which a vehicle had reached a place [m]; inf if never, NaN if a position is unknown."""
    if np.isnan(along).any():
        return math.nan
    ticks = np.flatnonzero(along >= place)
    return float(ticks[0]) if ticks.size else math.inf


def _seconds_to(place: float, along: FloatArray, speed: FloatArray, hz: float) -> FloatArray:
    """Return, for each tick, the seconds until a vehicle reaches a place at its present speed.

    From the tick at which the vehicle reaches the place on, they are 0 or negative and count the time since then.
    """
    ticks = np.arange(len(along))
    is_moving = speed > 0
    ahead: FloatArray = np.where(is_moving, (place - along) / np.where(is_moving, speed, 1.0), np.inf)
    first = _first_at(place, along)
    return np.where(ticks >= first, (min(first, len(along)) - ticks) / hz, ahead)


SLOT = 0.3
"""The tolerance of a slot [s]."""
ADAPTING_UNTIL, WAITING = 3.0, 0.5
"""The time before its entry into the zone until which an NPC adapts to the ego's arrival [s], and the smallest share of
its speed to which it slows down for that; both are those of ``world/kernel/crossing.py``."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What an NPC that crosses was asked for.

    Attributes:
        npc: index of the NPC.
        what: ``slot``; or ``zone`` if it did not come to its zone.
        asked: the slot that was asked [s]; NaN if it did not come.
        was: what it was [s]; NaN if it did not come.
    """

    npc: int
    what: str
    asked: float = math.nan
    was: float = math.nan

    @property
    def is_met(self) -> bool:
        """True if it was as asked."""
        return abs(self.was - self.asked) <= SLOT

    @property
    def words(self) -> str:
        """The words for it: ``slot asked 0.5 s, was 0.6 s``."""
        if self.what == "zone":
            return "the NPC did not come to its zone"
        return f"slot asked {self.asked:g} s, was {self.was:.1f} s"


def asked(trace: Trace) -> tuple[Asked, ...]:
    """Return what the crossing NPCs of a run were asked for; empty without them."""
    found: list[Asked] = []
    for npc, instruction in enumerate(trace.scenario.crossings):
        if instruction is not None and instruction.act == "pass":
            found += _of_crossing(trace, npc, instruction.slot)
    return tuple(found)


def _of_crossing(trace: Trace, npc: int, slot: float) -> Iterator[Asked]:
    """Yield the slot of an NPC, at the ego's speed when the NPC no longer adapted to the ego.

    An ego may answer in two ways that leave no slot to judge. It may wait for the NPC, which does not become slow
    enough to come after it. Or it may slow down in the zone, so that the NPC waits for it.
    """
    passage = passages(trace)[npc]
    if passage is None:
        return
    if passage.npc_enters == math.inf:
        is_broken_off = trace.collision is not None or trace.error is not None or trace.off_road_tick == trace.ticks
        if not is_broken_off:
            yield Asked(npc, "zone")
        return
    until = max(round((passage.npc_enters - ADAPTING_UNTIL) * trace.physics_hz), 0)
    if min(trace.ego[: until + 1, SPEED]) < WAITING * trace.ego[0, SPEED]:
        return
    (ego_enters, ego_leaves), (enters, leaves) = times_expected(trace, npc, until)
    was = enters - ego_leaves if slot > 0 else leaves - ego_enters
    if slot == 0:
        was = (enters + leaves - ego_enters - ego_leaves) / 2
    has_left = passage.ego_leaves < math.inf  # else, as after a collision, it would have left at its last speed
    left = passage.ego_leaves if has_left else times_expected(trace, npc, trace.ticks)[0][1]
    if was - slot <= SLOT or left <= ego_leaves + SLOT:
        yield Asked(npc, "slot", slot, was)


Worse = Literal["low", "high", "both", "neither"]
"""Which values of a measure are worse for the ego: low values, high values, values far from 0, or neither."""


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
    function: Callable[[Trace], FloatArray]

    def __call__(self, trace: Trace) -> float:
        """Return the measure as a fitness between -1 and 1, which is higher if the run is worse for the ego.

        It is v / (1 + |v|), where v is the worst value, with its sign changed if low values are worse. No measure
        without a worse side is a fitness.
        """
        risk = {"low": np.negative, "high": np.positive, "both": np.abs}[self.worse](self.function(trace))
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
    """The signals of one run; each function of its trace is called only once."""

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self._values: dict[Callable[[Trace], npt.ArrayLike], FloatArray] = {}

    def of(self, function: Callable[[Trace], npt.ArrayLike], npc: int | None = None) -> FloatArray:
        """Return the read-only values of a function of the trace, one value per tick.

        Args:
            function: returns an array of shape [ticks + 1], or [NPCs, ticks + 1] for a value of each NPC.
            npc: index of the NPC if the function has one value for each NPC.

        Raises:
            ValueError: if the function returns an array of a different shape, or if ``npc`` is missing, or is given
                for a function that has no row for each NPC.
        """
        values = self._values.get(function)
        if values is None:
            values = np.array(function(self.trace), dtype=np.float64)
            rows, npcs = self.trace.ticks + 1, self.trace.states.shape[1] - 1
            if values.shape not in ((rows,), (npcs, rows)):
                raise ValueError(
                    f"signal {_named(function)}: expected one value a tick, shape ({rows},), or of each NPC, "
                    f"({npcs}, {rows}), received shape {values.shape}"
                )
            values.flags.writeable = False
            self._values[function] = values
        if (values.ndim == 2) is (npc is None):
            wanted = "npc=0 and so on, because it has a row for each NPC" if npc is None else "no npc="
            raise ValueError(f"signal {_named(function)}: expected {wanted}, received npc={npc}")
        return values if npc is None else values[npc]

    def all(self) -> Iterator[tuple[str, FloatArray]]:
        """Yield the name and the values of all measures: one of the ego, and one per NPC for a measure of each NPC.

        The time advantage is defined only for NPCs that cross, so the others have no such signal.
        """
        npcs = range(self.trace.states.shape[1] - 1)
        crossing = [npc for npc, zone in enumerate(self.trace.zones) if zone is not None]
        for measure in MEASURES:
            vehicle, _, name = measure.name.partition(".")
            if vehicle == "npcs":
                for npc in crossing if name == "time_advantage" else npcs:
                    yield f"npcs[{npc}].{name}", self.of(measure.function, npc)
            else:
                yield measure.name, self.of(measure.function)

    @property
    def ego(self) -> EgoSignals:
        """The signals of the ego."""
        return EgoSignals(self)

    @property
    def npcs(self) -> tuple[NpcSignals, ...]:
        """The signals of each NPC."""
        return tuple(NpcSignals(self, npc) for npc in range(self.trace.states.shape[1] - 1))


def _named(function: object) -> str:
    return repr(getattr(function, "__name__", function))


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
            return self._signals.of(measure.function, self._npc)


class EgoSignals(_Vehicle):
    """The signals of the ego, see :data:`MEASURES`."""

    _of = "ego."
    speed: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    lateral_acceleration: FloatArray
    lane: FloatArray


class NpcSignals(_Vehicle):
    """The signals of one NPC, see :data:`MEASURES`."""

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
        """The zone where the NPC's way meets the ego's; None for an NPC that does not cross."""
        zones = self._signals.trace.zones
        return zones[self._npc or 0] if zones else None

    @property
    def passage(self) -> Passage | None:
        """The times at which the NPC and the ego were in the zone of their ways; None if it does not cross."""
        return passages(self._signals.trace)[self._npc or 0]
