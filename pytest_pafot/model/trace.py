"""The record of one run: every vehicle at every physics tick, and how the run ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import Chromosome, Scenario, with_targets
from pytest_pafot.support.shown import Shown

FloatArray = npt.NDArray[np.float64]

Side = Literal["front", "rear", "left", "right"]

Plan = tuple[tuple[float, float, float], ...]
"""The places at which an ADS intends to be: the time since its decision [s], x [m], y [m]."""

X, Y, HEADING, SPEED, ACCELERATION, STEERING, LANE = range(7)
"""Columns of :attr:`Trace.states`."""

ALONG, ACROSS, ANGLE, OFFSET, STRETCH = range(5)
"""Columns of :attr:`Trace.track`."""


class Outcome(StrEnum):
    """The ways in which a run can end."""

    SAFE = "safe"
    """The run lasted for its full duration, and none of the other outcomes occurred."""
    OFF_ROAD = "off_road"
    """The ego's centre was off the road, which ends runs on roads that are not straight."""
    LEFT_ROUTE = "left_route"
    """The ego entered a lane that does not belong to its route, which the grid follows; the run ended there."""
    END_OF_ROAD = "end_of_road"
    """A vehicle reached the end of the road; the run ended there."""
    COLLISION = "collision"
    """The ego's box touched an NPC's or a fixed object; the run ended there."""
    INVALID = "invalid"
    """Two NPCs touched, or an NPC touched a fixed object; the run says nothing about the ego and ended there."""
    ADS_ERROR = "ads_error"
    """The ADS raised an exception or returned no valid action; the run ended there."""
    HANG = "hang"
    """One decision of the ADS took longer than the hang limit, which is in wall-clock time."""


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
        time: time of that tick [s].
        npc: index of the NPC in the scenario; None for a fixed object.
        side: side of the ego that was hit.
        cell: cell of the NPC's centre at the impact, or before it if the centre was already in the ego's own cell. None
            if an NPC that crosses was not on the ego's way, and for a fixed object.
        ego_speed, npc_speed: speeds at the impact [m/s]; a fixed object's is 0.
        closing_speed: magnitude of the difference of the two velocities [m/s], which include the slip of a turning
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
        where = "" if self.cell is None else f" in cell {int(self.cell)}"
        what = "a fixed object" if self.npc is None else f"NPC {self.npc}"
        return f"<Collision after {self.time:.1f} s: {what}{where}, {self.side} of the ego>"


@dataclass(frozen=True, slots=True, kw_only=True)
class AdsError:
    """An error of the ADS, which did not return an action.

    Attributes:
        kind: name of the exception class; ``BadAction`` for an action that is not valid, ``Hang`` for a decision that
            took too long.
        message: message of the error, one line.
        traceback: traceback through the user's code; empty for a bad action.
        tick: physics tick of the decision.
        interrupted: whether the ADS hung and was interrupted.
    """

    kind: str
    message: str
    traceback: str
    tick: int
    interrupted: bool = False

    @property
    def text(self) -> str:
        """The kind and the message in one line."""
        return self.message if self.message.startswith(self.kind) else f"{self.kind}: {self.message}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace(Shown):
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
        physics_hz: ticks per second.
        ads_hz: decisions of the ADS per second; divides ``physics_hz``.
        actions: the actions that the ADS returned, one per decision; none if the ADS is a vehicle class, which
            decides at every tick.
        decided: the ticks at which the ADS was asked, if it was not asked ``ads_hz`` times a second, for example
            because a wrapper repeats actions; otherwise empty. :attr:`decision_ticks` has them in either case.
        plans: the plan that the ADS returned with each action, None for an action without one; x and y are in the
            coordinates of ``states``. Empty if the ADS returned no plan. Decisions that were given to the run, in place
            of calls of the ADS, have no plan.
        arrivals: for each NPC and each gene that was started, the tick at which the NPC reached the target, or None.
        off_road_tick: first tick with the ego's centre off the road, or None.
        max_decision_seconds: longest decision of the ADS in wall-clock time [s]; not reproducible.
        track: None on straight roads; otherwise float64, read-only, shape [ticks + 1, vehicles, 5] with columns: along
            the ego's way [m], across it to the right [m], angle to it [rad], offset from the centre of the vehicle's
            lane [m], metres that the vehicle drives per metre of the way (more on the outside of a bend). NaN for an
            NPC that crosses, while it is not on the ego's way.
        zones: for each NPC the zone in which its way meets the ego's, None for an NPC that does not cross. Empty if no
            NPC crosses.
        on_way: position of each NPC that crosses, along its own way [m], or None if no NPC crosses; float64, read-only,
            shape [ticks + 1, NPCs]. NaN for NPCs that do not cross.
        driven: for each NPC and started gene, the cell that the NPC drove to. It differs from ``executed`` if cells
            that the road does not have were skipped, which no chain can express. Empty if it equals ``executed``.
        begun: for each NPC the ticks at which the steps of its manoeuvre began. Empty if no NPC has one.
        obstacles: the fixed objects on the road that vehicles can touch: x [m], y [m], heading [rad], length and width
            [m].
        drew: True if the run drew from a global random generator, so that another seed may give another run.
    """

    scenario: Scenario
    executed: Scenario
    outcome: Outcome
    states: FloatArray
    sizes: FloatArray
    lanes: tuple[Lane, ...]
    physics_hz: int
    ads_hz: int
    collision: Collision | None = None
    error: AdsError | None = None
    actions: tuple[Any, ...] = ()
    plans: tuple[Plan | None, ...] = ()
    decided: tuple[int, ...] = ()
    arrivals: tuple[tuple[int | None, ...], ...] = ()
    off_road_tick: int | None = None
    max_decision_seconds: float = field(default=0.0, compare=False)
    track: FloatArray | None = None
    zones: tuple[Zone | None, ...] = ()
    on_way: FloatArray | None = None
    driven: tuple[tuple[Cell, ...], ...] = ()
    begun: tuple[tuple[int, ...], ...] = ()
    obstacles: tuple[tuple[float, float, float, float, float], ...] = ()
    drew: bool = False

    def steps_begun(self, npc: int) -> tuple[int, ...]:
        """Return the ticks at which the steps of an NPC's manoeuvre began; empty without a manoeuvre."""
        return self.begun[npc] if npc < len(self.begun) else ()

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
        return self.decided or range(0, self.ticks + (self.error is not None), self.physics_hz // self.ads_hz)

    @property
    def ego(self) -> FloatArray:
        """The ego's states, shape [ticks + 1, 7]."""
        return self.states[:, 0]

    @property
    def npcs(self) -> FloatArray:
        """The NPCs' states, shape [ticks + 1, NPCs, 7]."""
        return self.states[:, 1:]

    def track_of(self, vehicle: int) -> FloatArray:
        """Return the track of a vehicle, shape [ticks + 1, 5].

        Raises:
            ValueError: if the road is straight, because no track is recorded then.
        """
        if self.track is None:
            raise ValueError("track: expected a run on a road that is not straight, received one on a straight road")
        return self.track[:, vehicle]

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
        return self.states[..., HEADING] - self.lanes[0].heading if self.track is None else self.track[..., ANGLE]

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
