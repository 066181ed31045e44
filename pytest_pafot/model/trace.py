"""The record of one run: every vehicle at every physics tick, how the run ended, and where vehicles are on its road."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import Chromosome, Scenario, with_targets
from pytest_pafot.model.vehicle_type import CAR, VehicleType

FloatArray = npt.NDArray[np.float64]

Side = Literal["front", "rear", "left", "right"]

X, Y, HEADING, SPEED, ACCELERATION, STEERING, LANE = range(7)
"""Columns of :attr:`Trace.states`."""

ALONG, ACROSS, ANGLE, OFFSET, STRETCH = range(5)
"""Columns of :attr:`Trace.track`."""


class Outcome(StrEnum):
    """The ways in which a run can end."""

    SAFE = "safe"
    """The run lasted for its full duration, or the environment ended it."""
    OFF_ROAD = "off_road"
    """The ego's centre was off the road, which ends runs on roads that are not straight."""
    LEFT_ROUTE = "left_route"
    """The ego entered a lane that does not belong to its route."""
    END_OF_ROAD = "end_of_road"
    """A vehicle reached the end of the road."""
    COLLISION = "collision"
    """The ego's box touched an NPC's or a fixed object."""
    INVALID = "invalid"
    """Two NPCs touched, an NPC touched a fixed object, the user's code failed that ends episodes, or it moved a vehicle
    as no vehicle moves; the run says nothing about the ego."""
    ADS_ERROR = "ads_error"
    """The ADS raised an exception or returned no valid action."""
    HANG = "hang"
    """A decision took longer than the hang limit, or the world hung, by the wall clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lane:
    """A lane: its start, direction and size, and its shape if it is not straight.

    Attributes:
        x, y: start of its centre line [m].
        heading: heading of its centre line at the start [rad].
        length, width: size of the lane [m].
        speed_limit: speed limit on the lane [m/s].
        points: x and y of its centre line from the start to the end [m]; empty for a straight lane.
    """

    x: float
    y: float
    heading: float
    length: float
    width: float
    speed_limit: float
    points: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Collision:
    """The first contact of the ego's box with an NPC's or with a fixed object on the road.

    Attributes:
        tick: physics tick of the first overlap.
        time: its time [s].
        npc: index of the NPC; None for a fixed object.
        side: of the ego that was hit.
        cell: of the NPC's centre at the impact, or before if it was in the ego's own cell then. None for a fixed
            object, and for an NPC that crosses off the ego's way.
        ego_speed, npc_speed: at the impact [m/s]; a fixed object's is 0.
        closing_speed: magnitude of the difference of the velocities [m/s], with the slip of a turning vehicle.
    """

    tick: int
    time: float
    npc: int | None
    side: Side
    cell: Cell | None
    ego_speed: float
    npc_speed: float
    closing_speed: float

    def __repr__(self) -> str:
        where = "" if self.cell is None else f" in cell {int(self.cell)}"
        what = "a fixed object" if self.npc is None else f"NPC {self.npc}"
        return f"<Collision after {self.time:.1f} s: {what}{where}, {self.side} of the ego>"


WORLD_HANG = "WorldHang"
"""The kind of an error that is not the ADS's: a method of the environment, or of a wrapper, did not return."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AdsError:
    """An error of the ADS, which did not return an action.

    Attributes:
        kind: name of the exception class; ``BadAction`` for an action that is not valid, ``Hang`` for a decision that
            took too long, :data:`WORLD_HANG` for code of the environment that did.
        message: message of the error, one line.
        traceback: traceback through the user's code; empty for a bad action.
        tick: physics tick of the decision.
        interrupted: whether the ADS, or the environment, hung and was interrupted.
    """

    kind: str
    message: str
    traceback: str
    tick: int
    interrupted: bool = False

    @property
    def is_of_ads(self) -> bool:
        """False if the environment failed, and not the ADS."""
        return self.kind != WORLD_HANG

    @property
    def text(self) -> str:
        """The kind and the message in one line."""
        return self.message if self.message.startswith(self.kind) else f"{self.kind}: {self.message}"


class RoadOfRun:
    """The road of a run, and where the vehicles are on it. Whoever reads a trace asks it, whatever the kind of road.

    This class is that of straight lanes side by side; its track begins at the origin of the world's coordinates.
    :class:`BentRoadOfRun` overrides all that a bend changes.

    Distances are in metres, across the road to the right, and angles are in rad. Unless a line says otherwise, arrays
    have the shape [vehicles, ticks + 1] or [NPCs, ticks + 1]: with the long dimension innermost, numpy is about three
    times as fast. Each kind of road has formulas of its own. Replays compare their results with saved files, so even
    the order of their operations must stay.

    Attributes:
        is_straight: True if y of ``states`` is across the road, and each lane has the same place along all of it.
    """

    is_straight = True

    def __init__(self, states: FloatArray, lanes: Sequence[Lane]) -> None:
        self._states = states
        self._lanes = lanes

    def column(self, index: int) -> FloatArray:
        """Return one column of the trace's states, shape [vehicles, ticks + 1]."""
        return np.ascontiguousarray(self._states[:, :, index].T)

    @cached_property
    def x(self) -> FloatArray:
        """The x coordinates of all vehicles."""
        return self.column(X)

    @cached_property
    def y(self) -> FloatArray:
        """The y coordinates of all vehicles."""
        return self.column(Y)

    @cached_property
    def direction(self) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of the heading of the ego's lane, each of shape [1, ticks + 1].

        If all lanes have the same heading, as on a straight road, the shape is [1, 1]. While the ego is off the road,
        the heading of the last lane in the list is used.
        """
        headings = [lane.heading for lane in self._lanes]
        if headings.count(headings[0]) == len(headings):
            heading = np.array([headings[:1]])
        else:
            heading = np.array(headings)[self.column(LANE)[:1].astype(np.intp)]
        return np.cos(heading), np.sin(heading)

    @property
    def track(self) -> FloatArray:
        """The places of all vehicles along the road and across it, with the columns of ``Trace.track``."""
        cos, sin = self._cos_sin
        along = self.x * cos + self.y * sin
        return np.stack((along.T, self._across.T, self.angles, self._beside.T, np.ones(along.T.shape)), axis=-1)

    @property
    def heading(self) -> float | None:
        """The heading that all lanes have everywhere; None if there are several."""
        heading = self._lanes[0].heading
        return None if any(lane.heading != heading for lane in self._lanes) else heading

    @property
    def angles(self) -> FloatArray:
        """The headings relative to the road, shape [ticks + 1, vehicles]."""
        return self._states[..., HEADING] - self._lanes[0].heading

    @cached_property
    def is_on_way(self) -> npt.NDArray[np.bool_]:
        """True while an NPC is on the ego's way. An NPC that crosses is on that way only after it has merged."""
        return np.ones((self._states.shape[1] - 1, len(self._states)), dtype=np.bool_)

    @cached_property
    def offsets(self) -> tuple[FloatArray, FloatArray]:
        """The distances of each NPC's centre ahead of the ego's and to the right of it; NaN off the ego's way."""
        (cos, sin), x, y = self.direction, self.x[1:] - self.x[:1], self.y[1:] - self.y[:1]
        return x * cos + y * sin, y * cos - x * sin

    def offset(self, npc: int, tick: int) -> tuple[float, float]:
        """Return the offsets of one NPC at one tick."""
        ego, other = self._states[tick, 0].tolist(), self._states[tick, npc + 1].tolist()
        heading = self._lanes[int(ego[LANE])].heading
        x, y, cos, sin = other[X] - ego[X], other[Y] - ego[Y], math.cos(heading), math.sin(heading)
        return x * cos + y * sin, y * cos - x * sin

    def turned(self, cos: FloatArray, sin: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return cosine and sine of each vehicle's angle to the road, from those of its heading, and the road's own."""
        road_cos, road_sin = self.direction
        return cos * road_cos + sin * road_sin, sin * road_cos - cos * road_sin, road_cos, road_sin

    def displacement(self, vehicle: int, first: int, last: int) -> float:
        """Return how far to the side a vehicle was, between two ticks, of where it is at the last one."""
        states = self._states[first : last + 1, vehicle]
        heading = self._lanes[max(int(states[-1, LANE]), 0)].heading
        across = states[:, Y] * math.cos(heading) - states[:, X] * math.sin(heading)
        return float(abs(across - across[-1]).max())

    def to_edge(self) -> FloatArray:
        """Return the distance of the ego's centre to the nearer road edge, shape [ticks + 1]; negative off the road."""
        cos, sin = math.cos(self._lanes[0].heading), math.sin(self._lanes[0].heading)
        across = self._states[:, 0, Y] * cos - self._states[:, 0, X] * sin
        edges = [(each.y * cos - each.x * sin, each.width / 2) for each in self._lanes]
        left, right = min(centre - width for centre, width in edges), max(centre + width for centre, width in edges)
        return np.minimum(across - left, right - across)

    def numbers(self, vehicle: int) -> FloatArray:
        """Return the lane of a vehicle at each tick, counted from the left; -1 where such a number does not exist."""
        return self._states[:, vehicle, LANE]

    def counted(self, tick: int, vehicle: int) -> float:
        """Return the lane of a vehicle at a tick, counted to the right from some lane of the road; NaN if unknown."""
        lane = float(self._states[tick, vehicle, LANE])
        return lane if lane >= 0 else math.nan

    def direction_of_places(self, tick: int) -> float:
        """Return the heading relative to which places around the ego are described."""
        return self._lanes[0].heading

    def drawn(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Convert world coordinates to those of a picture of the run."""
        lane, (cos, sin) = self._lanes[0], self._cos_sin
        dx, dy = x - lane.x, y - lane.y
        return dx * cos + dy * sin, dy * cos - dx * sin

    @property
    def drawn_headings(self) -> FloatArray:
        """The headings in a picture of the run, shape [ticks + 1, vehicles]."""
        return self.angles

    @property
    def _cos_sin(self) -> tuple[float, float]:
        return float(np.cos(self._lanes[0].heading)), float(np.sin(self._lanes[0].heading))

    @cached_property
    def _across(self) -> FloatArray:
        cos, sin = self._cos_sin
        return np.asarray(self.y * cos - self.x * sin)

    @property
    def _beside(self) -> FloatArray:
        """The offset of each vehicle from the centre of its lane, or of the nearest."""
        (cos, sin), lanes = self._cos_sin, self.column(LANE).astype(np.intp)
        centres = np.array([lane.y * cos - lane.x * sin for lane in self._lanes])
        offset, off = self._across - centres[lanes], lanes < 0
        if off.any():  # off the road: as if there were one more lane on either side
            width = self._lanes[0].width
            beside = np.concatenate((centres, [centres.min() - width, centres.max() + width]))
            apart = self._across[off, None] - beside
            offset[off] = apart[np.arange(len(apart)), np.abs(apart).argmin(axis=1)]
        return np.asarray(offset)


class BentRoadOfRun(RoadOfRun):
    """The road of a run with a recorded track: the ego's way, from which places along and across it are measured."""

    is_straight = False

    def __init__(self, states: FloatArray, lanes: Sequence[Lane], track: FloatArray) -> None:
        super().__init__(states, lanes)
        self._track = track

    @property
    def track(self) -> FloatArray:
        """The recorded track."""
        return self._track

    @property
    def heading(self) -> None:
        """None, because a way may bend."""

    @property
    def angles(self) -> FloatArray:
        """The headings relative to the ego's way at the place of each vehicle."""
        return self._track[..., ANGLE]

    @cached_property
    def is_on_way(self) -> npt.NDArray[np.bool_]:
        """True while the track has a place for an NPC."""
        # A user's world may record NaN for a vehicle, too. Its distances must then stay NaN, so it counts as on the
        # way.
        return ~np.isnan(self._track[:, 1:, ALONG].T) | np.isnan(self.x[1:])

    @cached_property
    def offsets(self) -> tuple[FloatArray, FloatArray]:
        """The distances along and across the ego's way, each measured at the place of the vehicle."""
        columns = self._track.transpose(2, 1, 0)
        ego, npc = columns[:, :1], columns[:, 1:]
        return driven_between(ego, npc), npc[ACROSS] - ego[ACROSS]

    def offset(self, npc: int, tick: int) -> tuple[float, float]:
        """Return the distances along and across the ego's way."""
        ego, other = self._track[tick, 0].tolist(), self._track[tick, npc + 1].tolist()
        return driven_between(ego, other), other[ACROSS] - ego[ACROSS]

    def turned(self, cos: FloatArray, sin: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the angles to the ego's way at the place of each vehicle."""
        angle = self._track[:, :, ANGLE].T
        own_cos, own_sin = np.cos(angle), np.sin(angle)
        return own_cos, own_sin, cos * own_cos + sin * own_sin, sin * own_cos - cos * own_sin

    def displacement(self, vehicle: int, first: int, last: int) -> float:
        """Return the distance across the ego's way."""
        across = self._track[first : last + 1, vehicle, ACROSS]
        return float(abs(across - across[-1]).max())

    def to_edge(self) -> FloatArray:
        """Return half the width of the ego's lane on the road, which has no edge of its own."""
        lane = self._states[:, 0, LANE].astype(np.intp)
        half = np.array([each.width for each in self._lanes])[np.maximum(lane, 0)] / 2
        return np.where(lane < 0, np.minimum(half - np.abs(self._track[:, 0, OFFSET]), -1e-6), half)

    def numbers(self, vehicle: int) -> FloatArray:
        """Return -1 everywhere, because lanes begin and end along the way."""
        return np.full(len(self._states), -1.0)

    def counted(self, tick: int, vehicle: int) -> float:
        """Return the lane, counted from the ego's way."""
        across, offset = self._track[tick, vehicle, [ACROSS, OFFSET]]
        return float(np.round((across - offset) / self._lanes[0].width))

    def direction_of_places(self, tick: int) -> float:
        """Return the ego's own heading."""
        return float(self._states[tick, 0, HEADING])

    def drawn(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return world coordinates unchanged."""
        return x, y

    @property
    def drawn_headings(self) -> FloatArray:
        """The headings in the world's coordinates, without jumps of 2 pi."""
        return np.unwrap(self._states[:, :, HEADING], axis=0)


def driven_between(ego: Any, npc: Any) -> Any:
    """Return the metres driven from the ego to an NPC, from rows of :attr:`Trace.track`.

    This is the difference of the two places on the ego's way, times the mean of the metres that both drive per metre of
    that way. In a circle it is the length of the arc halfway between the arcs of the two vehicles.
    """
    return (npc[ALONG] - ego[ALONG]) * (ego[STRETCH] + npc[STRETCH]) / 2


def road_of_run(states: FloatArray, lanes: Sequence[Lane], track: FloatArray | None) -> RoadOfRun:
    """Return the road of a run, from its states, its lanes and its track if it has recorded one."""
    return RoadOfRun(states, lanes) if track is None else BentRoadOfRun(states, lanes, track)


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """One run, tick by tick. Vehicle 0 is the ego, vehicle ``i + 1`` the NPC ``i`` of the scenario.

    Attributes:
        scenario: the scenario as requested.
        executed: the scenario as driven, after the repair inside the run; a run of it gives the same trace. Genes that
            the run did not reach are as requested.
        outcome: how the run ended.
        collision: the collision; None unless the outcome is ``collision``.
        error: the error of the ADS; None unless the outcome is ``ads_error`` or ``hang``.
        states: float64, read-only, shape [ticks + 1, vehicles, 7] with columns x [m], y [m], heading [rad],
            speed [m/s], acceleration [m/s^2], steering [rad], lane (index into ``lanes``, -1 off the road).
            y grows to the right of the driving direction, as in highway-env. Row ``t`` holds the state at tick
            ``t`` and the acceleration and steering that led to it; those of row 0 are 0.
        sizes: float64, read-only, shape [vehicles, 2]: length and width [m].
        lanes: lanes of the road, from the left. If the road is not straight, first the lanes along the ego's way, then
            all others.
        physics_hz: ticks per second; an int if it is whole.
        ads_hz: decisions of the ADS per second: ``physics_hz`` divided by a whole number.
        actions: the actions that the ADS returned, one per decision; none if the ADS is a vehicle class, which
            decides at every tick.
        decided: the ticks at which the ADS was asked, if it was not asked ``ads_hz`` times a second, for example
            because a wrapper repeats actions; otherwise empty. :attr:`decision_ticks` has them in either case.
        arrivals: for each NPC and each gene that was started, the tick at which the NPC reached the target, or None.
        off_road_tick: first tick with the ego's centre off the road, or None.
        max_decision_seconds: longest decision of the ADS in wall-clock time [s]; not reproducible.
        track: None on straight roads; otherwise float64, read-only, shape [ticks + 1, vehicles, 5] with columns: along
            the ego's way [m], across it to the right [m], angle to it [rad], offset from the centre of the vehicle's
            lane [m], metres that the vehicle drives per metre of the way (more on the outside of a bend). NaN for an
            NPC that crosses, while it is not on the ego's way. :meth:`track_of` has it on straight roads, too.
        zones: for each NPC the zone in which its way meets the ego's, None for an NPC that does not cross. Empty if no
            NPC crosses.
        on_way: position of each NPC that crosses, along its own way [m], or None if no NPC crosses; float64, read-only,
            shape [ticks + 1, NPCs]. NaN for NPCs that do not cross.
        driven: for each NPC and started gene, the cell that the NPC drove to. It differs from ``executed`` if cells
            that the road does not have were skipped, which no chain can express. Empty if it equals ``executed``.
        obstacles: the fixed objects on the road that vehicles can touch: x [m], y [m], heading [rad], length and width
            [m].
        drew: True if the run drew from a global random generator, so that another seed may give another run.
        ego_vehicle: what vehicle the world says that the ego is.
        ended: what of the environment's own ended the run before its time, such as ``GoalEnv._is_terminated``. With
            the outcome ``invalid``, it also has the error that was raised there, or says which vehicle the user's
            code moved as no vehicle moves. Else empty.
    """

    scenario: Scenario
    executed: Scenario
    outcome: Outcome
    states: FloatArray
    sizes: FloatArray
    lanes: tuple[Lane, ...]
    physics_hz: float
    ads_hz: float
    collision: Collision | None = None
    error: AdsError | None = None
    actions: tuple[Any, ...] = ()
    decided: tuple[int, ...] = ()
    arrivals: tuple[tuple[int | None, ...], ...] = ()
    off_road_tick: int | None = None
    max_decision_seconds: float = field(default=0.0, compare=False)
    track: FloatArray | None = None
    zones: tuple[Zone | None, ...] = ()
    on_way: FloatArray | None = None
    driven: tuple[tuple[Cell, ...], ...] = ()
    obstacles: tuple[tuple[float, float, float, float, float], ...] = ()
    drew: bool = False
    ego_vehicle: VehicleType = CAR
    ended: str = ""

    @property
    def users_error_text(self) -> str:
        """A line on the user's code that made the run invalid, with its method; empty if none did."""
        return self.ended if self.outcome is Outcome.INVALID else ""

    def __post_init__(self) -> None:
        for name in ("states", "sizes", "track", "on_way"):
            if getattr(self, name) is None:
                continue
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if array is getattr(self, name) and array.flags.writeable:
                array = array.copy()
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.states.ndim != 3 or self.states.shape[2] != 7:
            raise ValueError(f"states: expected shape [ticks + 1, vehicles, 7], received {self.states.shape}")
        rows, vehicles, _ = self.states.shape
        shapes = {"sizes": (vehicles, 2), "track": (rows, vehicles, 5), "on_way": (rows, vehicles - 1)}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, received {array.shape}")

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled trace and make its arrays read-only again: pickling makes them writeable."""
        self.__dict__.update(state)
        for array in (self.states, self.sizes, self.track, self.on_way):
            if array is not None:
                array.flags.writeable = False

    @property
    def ticks(self) -> int:
        """The number of physics steps in the run."""
        return len(self.states) - 1

    @property
    def dt(self) -> float:
        """The duration of a physics tick [s]."""
        return 1 / self.physics_hz

    @property
    def duration(self) -> float:
        """The simulated duration of the run [s]."""
        return self.ticks / self.physics_hz

    @property
    def times(self) -> FloatArray:
        """The time of every row [s], shape [ticks + 1]."""
        return np.arange(self.ticks + 1) / self.physics_hz

    @property
    def decision_ticks(self) -> Sequence[int]:
        """The ticks at which the ADS was asked for a decision, including one in which it failed."""
        return self.decided or range(0, self.ticks + (self.error is not None), round(self.physics_hz / self.ads_hz))

    @property
    def ego(self) -> FloatArray:
        """The ego's states, shape [ticks + 1, 7]."""
        return self.states[:, 0]

    @property
    def npcs(self) -> FloatArray:
        """The NPCs' states, shape [ticks + 1, NPCs, 7]."""
        return self.states[:, 1:]

    @property
    def road(self) -> RoadOfRun:
        """The road, and where the vehicles are on it."""
        return road_of_run(self.states, self.lanes, self.track)

    def track_of(self, vehicle: int) -> FloatArray:
        """Return the track of a vehicle, shape [ticks + 1, 5]; on a straight road it is computed from ``states``."""
        return self.road.track[:, vehicle]

    def way_of(self, npc: int) -> FloatArray:
        """Return the positions of an NPC along its own way, if the NPC crosses the ego's way [m], shape [ticks + 1].

        Raises:
            ValueError: if no NPC crosses in the run.
        """
        if self.on_way is None:
            raise ValueError("on_way: expected a run in which an NPC crosses the ego's way, received no crossing NPC")
        return self.on_way[:, npc]

    @property
    def angles(self) -> FloatArray:
        """The headings relative to the road [rad], shape [ticks + 1, vehicles]: to the ego's way if the road bends."""
        return self.road.angles

    def rows_until(self, tick: int) -> dict[str, Any]:
        """Return those arrays of the trace that have a row per tick, up to a tick, by the names of their fields."""
        arrays = {name: getattr(self, name) for name in ("states", "track", "on_way")}
        return {name: None if array is None else array[: tick + 1] for name, array in arrays.items()}

    def vehicle_type(self, vehicle: int) -> VehicleType:
        """Return what vehicle the ego is (0), or an NPC (its number plus 1)."""
        return self.scenario.vehicle_of(vehicle - 1) if vehicle else self.ego_vehicle

    @property
    def chains(self) -> tuple[Chromosome, ...]:
        """The chains that the NPCs drove: the chains of ``executed``, with the cells of ``driven`` in their place."""
        return with_targets(self.executed.npcs, self.driven)

    @property
    def speed_limit(self) -> float:
        """The speed limit of the fastest lane [m/s]."""
        return max(lane.speed_limit for lane in self.lanes)

    def __repr__(self) -> str:
        return f"<Trace {self.outcome} after {self.duration:.1f} s of {self.scenario.id}>"


QUANTITIES = (
    *(("x", "m"), ("y", "m"), ("heading", "rad"), ("speed", "m/s"), ("acceleration", "m/s^2"), ("steering", "rad")),
    ("lane", ""),
)
"""The names and the units of the columns of :attr:`Trace.states`."""
SURVIVES = "probably state that survives `start` or `reset`, or a random generator that these do not seed"
"""The cause of a difference between two runs in which the same was decided."""


def first_difference(first: Trace, again: Trace, within: float | None = None) -> str:
    """Return how two runs of one scenario first differ, with the time, the vehicle and the size; empty if they do not.

    Args:
        first, again: the runs.
        within: the largest difference of x and y that does not count [m], if nothing else counts, as for two different
            simulators. None if the runs have to be the same to the last bit; the text then says what caused it.
    """
    ticks = min(len(first.states), len(again.states))
    one, other = (each.states[:ticks] if within is None else each.states[:ticks, :, : Y + 1] for each in (first, again))
    with np.errstate(invalid="ignore"):  # inf - inf
        apart = np.where((one == other) | (np.isnan(one) & np.isnan(other)), 0.0, np.abs(one - other))
    differs = ~(apart <= (within or 0.0))
    if not differs.any():
        ends = [f"{each.outcome} after {each.duration:.4g} s" for each in (first, again)]
        is_same = (first.outcome, first.ticks) == (again.outcome, again.ticks)
        return "" if within is not None or is_same else f"{ends[0]}, then {ends[1]}"
    tick, vehicle, column = np.argwhere(differs)[0].tolist()
    name, unit = QUANTITIES[column]
    who = f"NPC {vehicle - 1}" if vehicle else "the ego"
    what = f"{name} of {who} differs by {apart[tick, vehicle, column]:.2g} {unit}".rstrip()
    what = f"{what} after {first.times[tick]:.3g} s"
    if within is not None or not first.actions:
        return what
    made = sum(each < tick for each in first.decision_ticks)
    with np.printoptions(floatmode="unique", threshold=sys.maxsize):  # actions of any type, to the last bit
        one_made, other_made = (repr(each.actions[:made]) for each in (first, again))
    return f"{what}; {SURVIVES if one_made == other_made else 'the policy had decided otherwise'}"
