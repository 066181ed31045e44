"""Recorded tracks as values, in the coordinates of a trace, and the scenario whose NPCs drive as they do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_pafot import Recorded, Scenario, Track, VehicleType, catalogue
from pytest_pafot.extending import HEADING, SPEED, FloatArray, Lane, RequestError, X, Y
from pytest_pafot.support.errors import FieldError, sentence
from pytest_pafot.support.text import meant, visible

LONGEST_GAP = 1.0
"""The longest time for which a vehicle that was not seen is taken to have driven on evenly [s]."""
STANDING = 0.5
"""The speed below which a direction that was computed from movements is noise [m/s]."""
EGO_NAMES = ("ego", "hero", "egovehicle", "ego_vehicle")
"""The names, in lower case, by which the ego is found if nobody names it."""
LANE_WIDTH = 3.5
"""The width of the lanes of a recording that has none [m]."""
MOST_NPCS, FARTHEST, MOST_BESIDE = 8, 200.0, 8
"""The most NPCs that a scenario can have, and how far from the ego one can start [m, lanes]."""
RATE, FASTEST_RATE = 10, 15
"""The rate of tracks, and the highest one that a track can keep [1/s]."""
STRAIGHT = 0.4
"""The largest heading of a vehicle that drives along the road [rad]."""
LEAST_ROOM = 1.0
"""The gap to others along the road that a vehicle keeps on its way to where it is first seen [m]."""


class RecordingError(FieldError):
    """Error for a file that cannot be read as a recording, with the line (from 1) if it is known."""

    def __init__(
        self, path: Path, expected: str, received: str, fix: str, *, field: str = "", line: int | None = None
    ) -> None:
        place = f"{path}" if line is None else f"{path}:{line}"
        text = f"{place}: {sentence(field, expected, received, fix)}"
        super().__init__(text, field=field, expected=expected, received=received, fix=fix)
        self.path, self.line = path, line


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedVehicle:
    """One vehicle of a recording, from when it was first seen until it was last seen.

    Attributes:
        name: its name or number in the data. If it was not seen for more than a second, what came later is another
            vehicle, with ``/2`` after its name.
        kind: its class in the words of the data, such as ``car`` or ``truck``; empty if they do not say.
        length, width: its size [m].
        times: float64, read-only, shape [rows]: the times at which it was seen, on the clock of the data [s].
        states: float64, read-only, shape [rows, 4], with the first columns of ``Trace.states``: x and y of its centre
            [m], heading [rad], speed [m/s].
    """

    name: str
    kind: str
    length: float
    width: float
    times: FloatArray
    states: FloatArray

    def __post_init__(self) -> None:
        for name in ("times", "states"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def at(self, times: FloatArray | float) -> FloatArray:
        """Return its states at some times, between rows by straight lines; shape [times, 4], NaN if it was not seen.

        A heading turns the shorter way.
        """
        columns = [*self.states.T]
        columns[HEADING] = np.unwrap(columns[HEADING])
        asked = np.atleast_1d(times)
        found = [np.interp(asked, self.times, column, left=math.nan, right=math.nan) for column in columns]
        return np.stack(found, axis=-1)

    @property
    def vehicle_type(self) -> VehicleType:
        """The type of vehicle that it is as an NPC."""
        return VehicleType.recorded(self.length, self.width, float(self.states[:, SPEED].max()))

    def __repr__(self) -> str:
        seen = f"{self.times[0]:g} to {self.times[-1]:g} s"
        return f"<RecordedVehicle {self.name}: {self.kind or 'of unknown class'}, {seen}>"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """Tracks of vehicles, in the coordinates of a trace: y and headings grow to the right.

    :func:`pytest_pafot.recorded` reads one. :meth:`scenario` makes a scenario whose NPCs drive along its tracks, and
    the arrays can be plotted and measured.

    Attributes:
        vehicles: all vehicles, in the order of the data. Each has rows only for the time in which it was seen.
        rate: rows per second of the data [1/s]. Of a vehicle that was not seen for up to a second, the missing rows
            are on straight lines between its others.
        lanes: the lanes that the data have; empty if they have none. Once an ego is named, those in its direction come
            first, from the left. A lane whose speed limit is not known has an infinite one.
        ego: the name of the vehicle in whose place a policy drives; None if nobody has said.
        source: the file, for messages.
        notes: what was left out or estimated, in sentences.
    """

    vehicles: tuple[RecordedVehicle, ...]
    rate: float
    lanes: tuple[Lane, ...] = ()
    ego: str | None = None
    source: str = ""
    notes: tuple[str, ...] = ()

    def vehicle(self, name: object) -> RecordedVehicle:
        """Return the vehicle with a name.

        Raises:
            RequestError: if there is none.
        """
        names = [vehicle.name for vehicle in self.vehicles]
        if str(name) not in names:
            some = ", ".join(f"{each:.60}" for each in names[:10]) + (
                f" and {len(names) - 10} more" if len(names) > 10 else ""
            )
            received = f"received {name!r:.60}{meant(str(name), names)}"
            raise RequestError(visible(f"{self.source}: expected one of the vehicles {some}, {received}"))
        return self.vehicles[names.index(str(name))]

    def seen_from(self, name: object) -> Recording:
        """Return the recording with a vehicle as its ego, turned so that the road is along x in its direction.

        The direction is that of the straight lane nearest to its first place, or else its own first one.
        """
        ego = self.vehicle(name)
        x, y, heading, _ = ego.states[0].tolist()
        along = [lane for lane in self.lanes if not lane.points and math.cos(lane.heading - heading) > 0]
        if along:
            heading = min(along, key=lambda each: abs(_aside(each, x, y))).heading
        cos, sin = math.cos(heading), math.sin(heading)

        def turned(places: FloatArray) -> FloatArray:
            return np.stack([places @ (cos, sin), places @ (-sin, cos)], axis=-1)

        def of_lane(lane: Lane) -> Lane:
            (start,), points = turned(np.array([[lane.x, lane.y]])), turned(np.array(lane.points or [(0.0, 0.0)]))
            angle = math.remainder(lane.heading - heading, math.tau)
            line = tuple((x, y) for x, y in points.tolist()) if lane.points else ()
            return replace(lane, x=float(start[0]), y=float(start[1]), heading=angle, points=line)

        lanes = sorted(map(of_lane, self.lanes), key=lambda lane: (math.cos(lane.heading) < 0, lane.y))
        if heading == 0.0:  # its numbers stay those of the data
            return replace(self, lanes=tuple(lanes), ego=ego.name)
        vehicles = []
        for vehicle in self.vehicles:
            angles = (vehicle.states[:, [HEADING]] - heading + math.pi) % math.tau - math.pi
            states = np.hstack([turned(vehicle.states[:, [X, Y]]), angles, vehicle.states[:, [SPEED]]])
            vehicles.append(replace(vehicle, states=states))
        return replace(self, vehicles=tuple(vehicles), lanes=tuple(lanes), ego=ego.name)

    def scenario(self, ego: object = None, at: float | None = None, seconds: float = 20.0) -> Scenario:
        """Return a scenario that starts as the recording is at a time, and whose NPCs then drive as recorded.

        The NPCs are the eight vehicles nearest to the ego that drive in its direction at that time, and if they are
        fewer, the first that come later. Each has its size, and follows its track (:class:`pytest_pafot.Recorded`) as
        long as the policy drives as the recorded ego did. Lanes of the recording become lanes of 4 m. Before a vehicle
        is first seen, it drives at its first speed along the road to that place. If it would touch another vehicle
        there, it is left out. One that leaves the recording goes on attentively in its lane. The road has lanes to the
        left of the recorded ones if a vehicle drives there.

        Args:
            ego: the vehicle in whose place the policy drives; the recording's ego by default.
            at: the time of the start on the clock of the data [s]; when the ego is first seen by default.
            seconds: how long the NPCs follow their tracks [s].

        Raises:
            RequestError: if the recording lacks the ego or the time, or nothing drives near the ego then, or the road
                is not straight.
        """
        if ego is None and self.ego is None:
            raise RequestError(f"{self.source}: expected a vehicle in whose place the policy drives; give it as ego=")
        seen = self.seen_from(self.ego if ego is None else ego)
        own = seen.vehicle(seen.ego)
        start = float(own.times[0] if at is None else at)
        longest = (Track.most - 1) / RATE
        if not own.times[0] <= start <= own.times[-1] or not 0.0 < seconds <= longest:
            raise RequestError(
                f"{self.source}: expected a time at which {own.name} was seen, from {own.times[0]:g} to "
                f"{own.times[-1]:g} s, and at most {longest:g} s, received at={start:g} and seconds={seconds:g}"
            )
        here = own.at(start)[0]
        bent = np.abs(own.at(own.times[(own.times >= start) & (own.times <= start + seconds)])[:, HEADING])
        if max(bent.max(initial=0.0), abs(here[HEADING])) > STRAIGHT:
            raise RequestError(
                f"{self.source}: expected an ego that drives along a straight road from {start:g} s on, received "
                f"{own.name}, which turns by {math.degrees(bent.max(initial=0.0)):.0f} degrees; start at another time"
            )
        columns = _Columns(seen.lanes, float(here[Y]))
        lane = columns.of(here[Y])
        found: list[tuple[float, float, int, RecordedVehicle]] = []
        for other in seen.vehicles:
            first = max(start, float(other.times[0]))
            if other is own or first > min(other.times[-1], own.times[-1]) or first >= start + seconds:
                continue
            state, its = other.at(first)[0], own.at(first)[0]
            is_near = abs(state[X] - its[X]) < FARTHEST and abs(columns.of(state[Y]) - lane) <= MOST_BESIDE
            if is_near and abs(state[HEADING]) < STRAIGHT:
                found.append((first, abs(state[X] - its[X]), len(found), other))
        nearest: list[RecordedVehicle] = []
        for first, *_, other in sorted(found):
            if len(nearest) < MOST_NPCS and (first == start or _has_come(other, [own, *nearest], start)):
                nearest.append(other)
        if not nearest:
            raise RequestError(
                f"{self.source}: expected vehicles within {FARTHEST:g} m of {own.name} that drive in its direction at "
                f"{start:g} s, received none; start at another time"
            )
        return self._as_recorded(own, nearest, start, seconds, columns)

    @property
    def entries(self) -> Sequence[Any]:
        """The scenarios of the recording as entries of the catalogue: of its ego, or else of each vehicle."""
        from pytest_pafot.extras.recordings.recorded_entries import entries_of  # noqa: PLC0415  (only tests need the catalogue)

        return entries_of(self)

    def __call__(self, test: Any) -> Any:
        """Make an item of a test for each scenario of the recording, as ``@pafot.catalogue(recording)`` does."""
        return catalogue(self)(test)

    def _as_recorded(
        self, own: RecordedVehicle, others: Sequence[RecordedVehicle], start: float, seconds: float, columns: _Columns
    ) -> Scenario:
        x, y, _, speed = own.at(start)[0].tolist()
        lane, rate = columns.of(y), round(self.rate)
        if abs(rate - self.rate) > 0.01 or not RATE <= rate <= FASTEST_RATE or seconds * rate > Track.most - 1:
            rate = RATE

        def track(vehicle: RecordedVehicle) -> Track | None:
            states = _driven(vehicle, start, seconds, rate)
            across = Track.lane_width * (columns.shares(states[:, Y]) - lane) if columns.are_known else states[:, Y] - y
            places = np.stack([states[:, X] - x, across, states[:, HEADING], states[:, SPEED]], axis=-1)
            return Track.of(places, rate) if len(places) > 1 else None

        known = [(found, other.vehicle_type) for other in others if (found := track(other)) is not None]
        if not known:
            raise RequestError(
                f"{self.source}: expected vehicles that are seen for some time from {start:g} s on, received none; "
                "start at another time"
            )
        leftmost = min(float(each.states[:, 1].min()) for each, _ in known)
        return Scenario(
            npcs=tuple((Recorded(track=each),) for each, _ in known),
            ego_lane=max(lane if columns.are_known else 1, round(-leftmost / Track.lane_width)),
            ego_speed=max(speed, 0.0),
            vehicles=tuple(each for _, each in known),
            ego_track=track(own),
        )

    def __repr__(self) -> str:
        ego = "" if self.ego is None else f", ego {self.ego}"
        return f"<Recording {self.source}: {len(self.vehicles)} vehicles{ego}, {self.rate:g} rows a second>"


class _Columns:
    """The lanes in the direction of x as columns from 0 at the left; between two middles, a share of a lane."""

    def __init__(self, lanes: Sequence[Lane], y: float) -> None:
        middles = sorted((lane.y, lane.width) for lane in lanes if not lane.points and math.cos(lane.heading) > 0.9)
        self.are_known = bool(middles)
        middles = [each for n, each in enumerate(middles) if not n or each[0] > middles[n - 1][0] + each[1] / 2]
        middles = middles or [(y, LANE_WIDTH)]
        (left, wide), (right, broad) = middles[0], middles[-1]
        self._places = np.array([left - 20 * wide, *(place for place, _ in middles), right + 20 * broad])
        self._columns = np.array([-20.0, *range(len(middles)), len(middles) + 19.0])

    def shares(self, y: FloatArray) -> FloatArray:
        found: FloatArray = np.interp(y, self._places, self._columns)
        return found

    def of(self, y: float) -> int:
        return round(float(self.shares(np.array([y]))[0]))


def _aside(lane: Lane, x: float, y: float) -> float:
    return (y - lane.y) * math.cos(lane.heading) - (x - lane.x) * math.sin(lane.heading)


def _has_come(vehicle: RecordedVehicle, others: Sequence[RecordedVehicle], start: float) -> bool:
    """Return whether a vehicle can have driven to where it is first seen without touching another one on its way."""
    seconds = float(vehicle.times[0]) - start
    mine, size = _driven(vehicle, start, seconds, RATE), vehicle.vehicle_type
    for other in others:
        if other.name.partition("/")[0] == vehicle.name.partition("/")[0]:
            return False  # it was lost in between, and its first part goes on
        its, its_size = _driven(other, start, seconds, RATE), other.vehicle_type
        both = min(len(mine), len(its))
        along, across = np.abs(mine[:both, [X, Y]] - its[:both, [X, Y]]).T
        is_near = along < (size.length + its_size.length) / 2 + LEAST_ROOM
        if (is_near & (across < (size.width + its_size.width) / 2)).any():
            return False
    return True


def _driven(vehicle: RecordedVehicle, start: float, seconds: float, rate: float) -> FloatArray:
    """Return the states of a vehicle at a rate from a time on, until it leaves the recording or the road.

    Before it is first seen, it drives at its first speed along the road.
    """
    end = min(seconds, float(vehicle.times[-1]) - start)
    times = start + np.arange(math.floor(end * rate + 1e-6) + 1) / rate
    states = vehicle.at(np.clip(times, vehicle.times[0], vehicle.times[-1]))  # a sum may round up beyond the last time
    early = np.minimum(times - vehicle.times[0], 0.0)
    states[:, X] += early * states[0, SPEED]
    states[early < 0, HEADING] = 0.0
    turned = np.abs(states[:, HEADING]) > STRAIGHT
    return states[: turned.argmax()] if turned.any() else states
