"""The trace of a run."""

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
from pytest_pafot.model.instructions import Cell, cell_at
from pytest_pafot.model.scenario import Chromosome, Scenario, with_targets
from pytest_pafot.model.vehicle_type import CAR, VehicleType

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

Side = Literal["front", "rear", "left", "right"]

X, Y, HEADING, SPEED, ACCELERATION, STEERING, LANE = range(7)  # columns of :attr:`Trace.states`

ALONG, ACROSS, ANGLE, OFFSET, STRETCH = range(5)  # columns of :attr:`Trace.track`


class Outcome(StrEnum):
    """The ways in which a run can end."""

    COMPLETED = "safe"
    """The run reached its full duration, or the environment ended it."""
    OFF_ROAD = "off_road"
    """The ego's centre left the road, which ends runs on curved roads."""
    LEFT_ROUTE = "left_route"
    """The ego entered a lane that does not belong to its route."""
    END_OF_ROAD = "end_of_road"
    """A vehicle reached the end of the road."""
    COLLISION = "collision"
    """The ego's box touched an NPC or a fixed object."""
    INVALID = "invalid"
    """An NPC touched another NPC or an object, or the user's code failed or moved a vehicle impossibly."""
    ADS_ERROR = "ads_error"
    """The ADS raised an exception or returned an invalid action."""
    HANG = "hang"
    """A decision exceeded the hang limit in wall-clock time, or the world hung."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lane:
    """A lane of the road.

    Attributes:
        x, y: start [m] of the centre line.
        heading: heading [rad] of the centre line at the start.
        length, width: size [m] of the lane.
        speed_limit: speed limit [m/s].
        points: x and y [m] along the centre line; empty for a straight lane.
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
    """The ego's first contact with an NPC or a fixed object.

    Attributes:
        tick: physics tick of the first overlap.
        time: time [s] of the first overlap.
        npc: index of the NPC; None for a fixed object.
        side: side of the ego that was hit.
        cell: cell of the NPC's centre at the impact, or before it if the centre was in the ego's own cell. None for
            a fixed object, and for an NPC off the ego's path.
        ego_speed, npc_speed: speeds [m/s] at the impact; 0 for a fixed object.
        closing_speed: magnitude [m/s] of the difference between the velocities, including the slip of a turning
            vehicle.
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
        what = "a fixed object"
        if self.npc is not None:
            what = f"NPC {self.npc}"
        if self.cell is not None:
            what = f"{what} in cell {int(self.cell)}"
        return f"<Collision after {self.time:.1f} s: {what}, {self.side} of the ego>"


# The kind of error for which the ADS is not the cause: a method of the environment, or of a wrapper, did not return.
WORLD_HANG = "WorldHang"


@dataclass(frozen=True, slots=True, kw_only=True)
class AdsError:
    """An error of an ADS that did not return an action.

    Attributes:
        kind: name of the exception class; ``BadAction`` for an invalid action, ``Hang`` or ``WorldHang`` for code
            that took too long.
        message: message of the error, in one line.
        traceback: traceback through the user's code, or empty.
        tick: physics tick of the decision.
        interrupted: True if the ADS or the environment hung and was interrupted.
    """

    kind: str
    message: str
    traceback: str
    tick: int
    interrupted: bool = False

    @property
    def is_of_ads(self) -> bool:
        """True if the ADS failed, False if the environment failed."""
        return self.kind != WORLD_HANG

    @property
    def text(self) -> str:
        """The error's kind and message."""
        if self.message.startswith(self.kind):
            return self.message
        return f"{self.kind}: {self.message}"


class RoadOfRun:
    """The road of a run, with the positions of the vehicles on it."""

    # Distances are in metres, positive to the right, and angles in rad. Arrays have the shape [vehicles, ticks + 1] or
    # [NPCs, ticks + 1] unless stated otherwise: with the long dimension innermost, numpy is about three times as fast.
    # Replays compare results with saved files, so even the order of the operations must stay the same.

    is_straight = True

    def __init__(self, states: FloatArray, lanes: Sequence[Lane]) -> None:
        self._states = states
        self._lanes = lanes

    def column(self, index: int) -> FloatArray:
        return np.ascontiguousarray(self._states[:, :, index].T)

    @cached_property
    def x(self) -> FloatArray:
        return self.column(X)

    @cached_property
    def y(self) -> FloatArray:
        return self.column(Y)

    @cached_property
    def direction(self) -> tuple[FloatArray, FloatArray]:
        # The cosine and sine of the heading of the ego's lane, each of shape [1, ticks + 1], or [1, 1] if all lanes
        # have the same heading.
        heading = np.array([[lane.heading for lane in self._lanes]])
        if self.heading is None:
            lanes = self.column(LANE)[:1].astype(np.intp)
            heading = heading[0, lanes]
        else:
            heading = heading[:, :1]
        return np.cos(heading), np.sin(heading)

    @property
    def track(self) -> FloatArray:
        cos, sin = self._cos_sin
        along = (self.x * cos + self.y * sin).T
        across = self._across.T
        return np.stack((along, across, self.angles, self._beside.T, np.ones(along.shape)), axis=-1)

    @property
    def heading(self) -> float | None:
        # None if the lanes have different headings.
        headings = {lane.heading for lane in self._lanes}
        if len(headings) == 1:
            return headings.pop()
        return None

    @property
    def angles(self) -> FloatArray:
        # Shape [ticks + 1, vehicles].
        return self._states[..., HEADING] - self._lanes[0].heading

    @cached_property
    def is_on_way(self) -> BoolArray:
        # An NPC that crosses is on the ego's path only after it has merged.
        return np.ones((self._states.shape[1] - 1, len(self._states)), dtype=np.bool_)

    @cached_property
    def offsets(self) -> tuple[FloatArray, FloatArray]:
        # The distances of each NPC ahead of the ego and to the right; NaN off the ego's path.
        cos, sin = self.direction
        x = self.x[1:] - self.x[:1]
        y = self.y[1:] - self.y[:1]
        return x * cos + y * sin, y * cos - x * sin

    @property
    def ahead(self) -> FloatArray:
        """The distance [m] of each NPC's centre ahead of the ego's centre."""
        # On a curved road, the difference of the two positions on the ego's path is multiplied by the mean of the
        # metres that ego and NPC drive per metre of that path. In a circle this is the arc halfway between the arcs of
        # the two vehicles.
        return self.offsets[0]

    @property
    def right(self) -> FloatArray:
        """The distance [m] of each NPC's centre to the right of the ego's centre."""
        # On a curved road, each vehicle's distance to the ego's path is measured at the position of the vehicle.
        return self.offsets[1]

    def offset(self, npc: int, tick: int) -> tuple[float, float]:
        ego = self._states[tick, 0].tolist()
        other = self._states[tick, npc + 1].tolist()
        heading = self._lanes[int(ego[LANE])].heading
        cos = math.cos(heading)
        sin = math.sin(heading)
        x = other[X] - ego[X]
        y = other[Y] - ego[Y]
        return x * cos + y * sin, y * cos - x * sin

    def cell(self, npc: int, tick: int, ego_length: float) -> Cell | None:
        """Return an NPC's cell at a tick, or None if the NPC is in no cell."""
        # Rows are as long as the ego, columns as wide as the ego's lane, or as the first lane if the ego is off the
        # road.
        ahead, right = self.offset(npc, tick)
        lane = max(int(self._states[tick, 0, LANE]), 0)
        return cell_at(ahead, right, ego_length, self._lanes[lane].width)

    def last_cell(self, npc: int, tick: int, ego_length: float) -> Cell | None:
        """Return the cell that an NPC last occupied up to a tick, or None."""
        for each in range(tick, -1, -1):
            # Only the time since the NPC entered the ego's path counts.
            if not self.is_on_way[npc, each]:
                break
            cell = self.cell(npc, each, ego_length)
            if cell is not None:
                return cell
        return None

    def turned(
        self,
        cos: FloatArray,
        sin: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        # The cosine and sine of each vehicle's angle to the road, and the cosine and sine of the road's heading.
        road_cos, road_sin = self.direction
        return cos * road_cos + sin * road_sin, sin * road_cos - cos * road_sin, road_cos, road_sin

    def displacement(self, vehicle: int, first: int, last: int) -> float:
        # The largest sideways distance between the vehicle's last position and its positions since the first tick.
        states = self._states[first : last + 1, vehicle]
        heading = self._lanes[max(int(states[-1, LANE]), 0)].heading
        across = states[:, Y] * math.cos(heading) - states[:, X] * math.sin(heading)
        return float(abs(across - across[-1]).max())

    def to_edge(self) -> FloatArray:
        # The distance of the ego's centre to the nearer edge, negative off the road.
        cos = math.cos(self._lanes[0].heading)
        sin = math.sin(self._lanes[0].heading)
        across = self._states[:, 0, Y] * cos - self._states[:, 0, X] * sin
        edges = [(each.y * cos - each.x * sin, each.width / 2) for each in self._lanes]
        left = min(centre - half for centre, half in edges)
        right = max(centre + half for centre, half in edges)
        return np.minimum(across - left, right - across)

    def numbers(self, vehicle: int) -> FloatArray:
        # The numbers of the vehicle's lanes, counted from the left; -1 if a lane has no number.
        return self._states[:, vehicle, LANE]

    def counted(self, tick: int, vehicle: int) -> float:
        # The number of the vehicle's lane, counted to the right from any lane; NaN if unknown.
        lane = float(self._states[tick, vehicle, LANE])
        if lane >= 0:
            return lane
        return math.nan

    def direction_of_places(self, tick: int) -> float:
        return self._lanes[0].heading

    def drawn(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        # To coordinates of the picture.
        cos, sin = self._cos_sin
        dx = x - self._lanes[0].x
        dy = y - self._lanes[0].y
        return dx * cos + dy * sin, dy * cos - dx * sin

    @property
    def drawn_headings(self) -> FloatArray:
        return self.angles

    @property
    def _cos_sin(self) -> tuple[float, float]:
        heading = self._lanes[0].heading
        return float(np.cos(heading)), float(np.sin(heading))

    @cached_property
    def _across(self) -> FloatArray:
        cos, sin = self._cos_sin
        return np.asarray(self.y * cos - self.x * sin)

    @property
    def _beside(self) -> FloatArray:
        cos, sin = self._cos_sin
        lanes = self.column(LANE).astype(np.intp)
        centres = np.array([lane.y * cos - lane.x * sin for lane in self._lanes])
        offset = self._across - centres[lanes]
        off = lanes < 0
        # off the road, positions are measured as if there were one more lane on either side
        if off.any():
            width = self._lanes[0].width
            beside = np.concatenate((centres, [centres.min() - width, centres.max() + width]))
            apart = self._across[off, None] - beside
            offset[off] = apart[np.arange(len(apart)), np.abs(apart).argmin(axis=1)]
        return np.asarray(offset)


class BentRoadOfRun(RoadOfRun):
    """The road of a run with a recorded track."""

    is_straight = False

    def __init__(self, states: FloatArray, lanes: Sequence[Lane], track: FloatArray) -> None:
        super().__init__(states, lanes)
        self._track = track

    @property
    def track(self) -> FloatArray:
        return self._track

    @property
    def heading(self) -> None:
        """None, because a recorded track has no single heading."""

    @property
    def angles(self) -> FloatArray:
        return self._track[..., ANGLE]

    @cached_property
    def is_on_way(self) -> BoolArray:
        # A user's world can also record NaN for a vehicle. The distances to it must stay NaN, so it counts as on the
        # ego's path.
        return ~np.isnan(self._track[:, 1:, ALONG].T) | np.isnan(self.x[1:])

    @cached_property
    def offsets(self) -> tuple[FloatArray, FloatArray]:
        columns = self._track.transpose(2, 1, 0)
        return _offsets(columns[:, :1], columns[:, 1:])

    def offset(self, npc: int, tick: int) -> tuple[float, float]:
        ego = self._track[tick, 0].tolist()
        return _offsets(ego, self._track[tick, npc + 1].tolist())

    def turned(
        self,
        cos: FloatArray,
        sin: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        angle = self._track[:, :, ANGLE].T
        own_cos = np.cos(angle)
        own_sin = np.sin(angle)
        return own_cos, own_sin, cos * own_cos + sin * own_sin, sin * own_cos - cos * own_sin

    def displacement(self, vehicle: int, first: int, last: int) -> float:
        across = self._track[first : last + 1, vehicle, ACROSS]
        return float(abs(across - across[-1]).max())

    def to_edge(self) -> FloatArray:
        # The track has no edges, so half the width of the ego's lane is used.
        lane = self._states[:, 0, LANE].astype(np.intp)
        widths = np.array([each.width for each in self._lanes])
        half = widths[np.maximum(lane, 0)] / 2
        # off the road, the result must be negative even if the lane next to the ego is wider
        outside = np.minimum(half - np.abs(self._track[:, 0, OFFSET]), -1e-6)
        return np.where(lane < 0, outside, half)

    def numbers(self, vehicle: int) -> FloatArray:
        # Lanes begin and end along the path, so they have no numbers.
        return np.full(len(self._states), -1.0)

    def counted(self, tick: int, vehicle: int) -> float:
        across, offset = self._track[tick, vehicle, [ACROSS, OFFSET]]
        return float(np.round((across - offset) / self._lanes[0].width))

    def direction_of_places(self, tick: int) -> float:
        return float(self._states[tick, 0, HEADING])

    def drawn(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        return x, y

    @property
    def drawn_headings(self) -> FloatArray:
        return np.unwrap(self._states[:, :, HEADING], axis=0)


def _offsets(ego: Any, npc: Any) -> tuple[Any, Any]:
    # The distance of an NPC ahead of the ego and to the right, from the columns of their tracks.
    ahead = (npc[ALONG] - ego[ALONG]) * (ego[STRETCH] + npc[STRETCH]) / 2
    return ahead, npc[ACROSS] - ego[ACROSS]


def road_of_run(states: FloatArray, lanes: Sequence[Lane], track: FloatArray | None) -> RoadOfRun:
    """Return the road of a run. A road without a track is straight."""
    if track is None:
        return RoadOfRun(states, lanes)
    return BentRoadOfRun(states, lanes, track)


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """A run, tick by tick, with the ego as vehicle 0 and NPC ``i`` as vehicle ``i + 1``.

    Attributes:
        scenario: the scenario as requested.
        executed: the scenario as executed, which gives the same trace when it is run.
        outcome: how the run ended.
        collision: the collision, or None.
        error: the error of the ADS, or None.
        states: array of shape [ticks + 1, vehicles, 7] with x [m], y [m] (positive to the right of the driving
            direction), heading [rad], speed [m/s], the acceleration [m/s^2] and steering [rad] that led to the state,
            and lane (index into ``lanes``, -1 off the road).
        sizes: length and width [m] of each vehicle.
        lanes: lanes of the road, from the left; first the lanes along the ego's path.
        physics_hz: ticks per second.
        ads_hz: decisions per second.
        actions: the actions of the ADS, one per decision; empty for a vehicle class.
        decided: the ticks of irregular decisions, or empty.
        arrivals: for each NPC and started gene, the tick at which the NPC reached the target, or None.
        off_road_tick: first tick with the ego's centre off the road, or None.
        max_decision_seconds: longest wall-clock time [s] of a decision.
        track: array of shape [ticks + 1, vehicles, 5] with the position [m] along the ego's path and to the right of
            it, the angle [rad] to it, the offset [m] from the lane's centre, and the metres driven per metre of the
            path. NaN off the ego's path; None on straight roads.
        zones: for each NPC the zone in which it crosses, or None; empty if no NPC crosses.
        on_way: positions [m] along the paths of crossing NPCs, by tick and NPC, or None.
        driven: the executed cells if missing cells were skipped; otherwise empty.
        obstacles: x [m], y [m], heading [rad], length and width [m] of fixed objects.
        drew: True if the run drew from a global random generator.
        ego_vehicle: type of the ego's vehicle.
        ended: the part of the environment that ended the run early, or empty.
    """

    scenario: Scenario
    executed: Scenario
    outcome: Outcome
    states: FloatArray
    sizes: FloatArray
    lanes: tuple[Lane, ...]
    physics_hz: float
    ads_hz: float
    collision: Collision | None = None  # only with the outcome COLLISION
    error: AdsError | None = None  # only with the outcomes ADS_ERROR and HANG
    actions: tuple[Any, ...] = ()
    # for example because a wrapper repeats actions; see decision_ticks
    decided: tuple[int, ...] = ()
    arrivals: tuple[tuple[int | None, ...], ...] = ()
    off_road_tick: int | None = None
    max_decision_seconds: float = field(default=0.0, compare=False)
    track: FloatArray | None = None
    zones: tuple[Zone | None, ...] = ()
    on_way: FloatArray | None = None
    driven: tuple[tuple[Cell, ...], ...] = ()  # no chain can express a step that skips cells
    obstacles: tuple[tuple[float, float, float, float, float], ...] = ()
    drew: bool = False
    ego_vehicle: VehicleType = CAR
    # such as `GoalEnv._is_terminated`; if the run is invalid, with the error raised there
    ended: str = ""

    @property
    def users_error_text(self) -> str:
        # The user's code that made the run invalid, or an empty string.
        if self.outcome is Outcome.INVALID:
            return self.ended
        return ""

    def __post_init__(self) -> None:
        # Arrays become read-only and float64. An array that its owner could still change is copied.
        for name in ("states", "sizes", "track", "on_way"):
            given = getattr(self, name)
            if given is None:
                continue
            array = np.ascontiguousarray(given, dtype=np.float64)
            if array is given and array.flags.writeable:
                array = array.copy()
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.states.ndim != 3 or self.states.shape[2] != 7:
            raise ValueError(
                f"states: expected the shape (ticks + 1, vehicles, 7), received {self.states.shape}"
            )
        rows, vehicles, _ = self.states.shape
        shapes = {
            "sizes": (vehicles, 2),
            "track": (rows, vehicles, 5),
            "on_way": (rows, vehicles - 1),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ValueError(f"{name}: expected the shape {shape}, received {array.shape}")

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Pickling makes arrays writeable.
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
        """The duration [s] of a physics tick."""
        return 1 / self.physics_hz

    @property
    def duration(self) -> float:
        """The simulated duration [s] of the run."""
        return self.ticks / self.physics_hz

    @property
    def times(self) -> FloatArray:
        """The time [s] of every row of ``states``."""
        return np.arange(self.ticks + 1) / self.physics_hz

    @property
    def decision_ticks(self) -> Sequence[int]:
        """The ticks at which decisions were made, including the tick of a decision that failed."""
        if self.decided:
            return self.decided
        end = self.ticks
        if self.error is not None:
            end += 1
        return range(0, end, round(self.physics_hz / self.ads_hz))

    @property
    def ego(self) -> FloatArray:
        """The ego's states, ``states[:, 0]``."""
        return self.states[:, 0]

    @property
    def npcs(self) -> FloatArray:
        """The NPCs' states, ``states[:, 1:]``."""
        return self.states[:, 1:]

    @property
    def road(self) -> RoadOfRun:
        return road_of_run(self.states, self.lanes, self.track)

    def track_of(self, vehicle: int) -> FloatArray:
        """Return a vehicle's track, even on a straight road."""
        return self.road.track[:, vehicle]

    def way_of(self, npc: int) -> FloatArray:
        """Return an NPC's positions [m] along its crossing path, or raise a ValueError."""
        if self.on_way is None:
            raise ValueError(
                "on_way: expected a run in which an NPC crosses the ego's path, received another run"
            )
        return self.on_way[:, npc]

    def zone_of(self, npc: int) -> Zone | None:
        # Empty `zones` mean that no NPC crosses.
        if self.zones:
            return self.zones[npc]
        return None

    def rows_until(self, tick: int) -> dict[str, Any]:
        # The arrays with one row per tick up to this one, by the names of their fields.
        rows = {name: getattr(self, name) for name in ("states", "track", "on_way")}
        given = {name: array[: tick + 1] for name, array in rows.items() if array is not None}
        return rows | given

    def vehicle_type(self, vehicle: int) -> VehicleType:
        if vehicle:
            return self.scenario.vehicle_of(vehicle - 1)
        return self.ego_vehicle

    @property
    def chains(self) -> tuple[Chromosome, ...]:
        return with_targets(self.executed.npcs, self.driven)

    @property
    def speed_limit(self) -> float:
        """The speed limit [m/s] of the fastest lane."""
        return max(lane.speed_limit for lane in self.lanes)

    def __repr__(self) -> str:
        return f"<Trace {self.outcome} after {self.duration:.1f} s of {self.scenario.id}>"


# The names and units of the columns of :attr:`Trace.states`.
QUANTITIES = (
    ("x", "m"),
    ("y", "m"),
    ("heading", "rad"),
    ("speed", "m/s"),
    ("acceleration", "m/s^2"),
    ("steering", "rad"),
    ("lane", ""),
)
# The cause of a difference between two runs with the same actions.
SURVIVES = "the cause is probably state that survives `start` or `reset`, or a random generator that these do not seed"


def vehicle_name(vehicle: int) -> str:
    """Return the name of a vehicle for messages. Number 0 is the ego."""
    if vehicle:
        return f"NPC {vehicle - 1}"
    return "the ego"


def first_difference(first: Trace, again: Trace, within: float | None = None) -> str:
    """Describe the first difference between two runs of one scenario, or return an empty string."""
    # `within` is the largest difference of x and y that is ignored [m]. None requires equality to the last bit, and the
    # result then also states the likely cause.
    ticks = min(len(first.states), len(again.states))
    columns = slice(None) if within is None else slice(Y + 1)
    one = first.states[:ticks, :, columns]
    other = again.states[:ticks, :, columns]
    with np.errstate(invalid="ignore"):  # inf - inf
        is_same = (one == other) | (np.isnan(one) & np.isnan(other))
        apart = np.where(is_same, 0.0, np.abs(one - other))
    differs = ~(apart <= (within or 0.0))
    if not differs.any():
        if within is not None or (first.outcome, first.ticks) == (again.outcome, again.ticks):
            return ""
        ends = [f"{each.outcome} after {each.duration:.4g} s" for each in (first, again)]
        return ", then ".join(ends)
    tick, vehicle, column = np.argwhere(differs)[0].tolist()
    name, unit = QUANTITIES[column]
    size = f"{apart[tick, vehicle, column]:.2g} {unit}".rstrip()
    what = f"{name} of {vehicle_name(vehicle)} differs by {size} after {first.times[tick]:.3g} s"
    if within is not None or not first.actions:
        return what
    made = sum(each < tick for each in first.decision_ticks)
    # actions of any type, to the last bit
    with np.printoptions(floatmode="unique", threshold=sys.maxsize):
        has_same_actions = repr(first.actions[:made]) == repr(again.actions[:made])
    if has_same_actions:
        return f"{what}; {SURVIVES}"
    return f"{what}; the policy had decided differently"
