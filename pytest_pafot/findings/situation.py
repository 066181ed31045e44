"""The situation from which a failure arose."""
# There are two reasons why a saved scenario passes: the policy now handles the situation, or the situation no longer
# occurs. NPCs drive to positions relative to the ego, so a situation is an NPC's position relative to the ego shortly
# before the ego's mistake. A reaction of the ego, such as braking earlier, must not change whether the situation
# occurred. With an NPC that crosses, a situation is the times at which the NPC and the ego would arrive at their zone.

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pytest_pafot.attribution.responsibility import DRIFTING, braking, frame_of
from pytest_pafot.attribution.sentences import BRAKES
from pytest_pafot.criticality import RoadFrame
from pytest_pafot.findings.verdict import AT_ZONES, Failure
from pytest_pafot.model.trace import ALONG, LANE, FloatArray, Outcome, Trace
from pytest_pafot.model.trace import SPEED as SPEEDS
from pytest_pafot.oracle.run import Run

# The tolerances were chosen by replaying failures of policies with seeded defects, both with the repaired policies and
# with policies that avoid the situation; docs/explanation/findings.md explains the tolerances.

# the situation of a failure without a collision is taken this time before the failure [s]
BEFORE = 2.0
# All runs start in the same way, so in these first seconds [s], a situation counts only if the saved one was there.
START = 4.0
# An NPC is in a lane if its centre is at most this far from the lane's centre, in widths of the ego's lane.
HALF_LANE = 0.5
PLACE = 5.0
# Two positions of an NPC are near each other if they differ by up to 5 m, or by 25 % of the distance to the ego.
PLACE_SHARE = 0.25
# Two speeds of an NPC are near each other if the NPC's speed relative to the ego differs by up to this [m/s].
SPEED = 3.0
# They are also near each other if the NPC's own speed differs by up to 3 m/s, and the ego's speed by up to this [m/s].
EGO_SPEED = 9.0
REACH = 20.0
# A leader may be up to 20 m ahead, or twice the saved distance, because an ego that brakes earlier stays farther
# away. ``REACH`` is in metres, ``REACH_FACTOR`` has no unit.
REACH_FACTOR = 2.0
# A leader must be slower than the ego by this proportion of the saved difference, or by that difference minus 3 m/s.
SLOWER_SHARE = 0.6
# A leader is compared with the ego's highest speed in the last seconds [s], because an ego that responds slows down.
ANSWER = 10.0
ARRIVAL = 1.0
# Two times to a zone are near each other if they differ by up to 1 s, or by half of the saved time.
ARRIVAL_SHARE = 0.5
# A time to a zone assumes the highest speed of the last seconds [s], because an ego that gives way slows down.
APPROACH = 3.0
# A time to a zone assumes at least this speed [m/s], because a stationary vehicle would never arrive.
LEAST_SPEED = 0.1


def situation_of(run: Run, failure: Failure, time: float) -> Situation | ZoneSituation | None:
    """Return the situation from which a failure arose, or None."""
    npc = run.event_npc
    if failure.check is not None:
        npc = failure.check.npc
    elif run.ads_error is not None or run.outcome is Outcome.OFF_ROAD:
        npc = None
    if npc is None or not np.isfinite(run.trace.states).all():
        return None
    if run.trace.zones and run.trace.zones[npc] is not None:
        return ZoneSituation.from_run(run, failure, npc, time)
    return Situation.from_run(run, failure, npc, time)


def tick_of_mistake(run: Run, failure: Failure) -> int | None:
    """Return the tick of the lane change, braking or danger that led to a collision, or None."""
    if run.collision is None or failure.check is not None:
        return None
    return run.attribution.tick


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """The position and speed of an NPC relative to the ego at one moment."""

    npc: int  # index of the NPC in the scenario
    time: float  # time of the moment [s]
    # gap between the bumpers along the road [m]; minus the overlap if they are side by side
    gap: float
    # `ahead` if the NPC's centre is ahead of the ego's centre, otherwise `behind`
    place: Literal["ahead", "behind"]
    # number of lanes from the ego's lane to the NPC's lane; negative to the left
    lanes_to_right: int
    ego_speed: float  # along the road [m/s]
    # Along the road [m/s]. For a leader, ahead in the ego's lane, it is the lowest speed from the moment to the
    # failure.
    npc_speed: float

    @classmethod
    def from_run(cls, run: Run, failure: Failure, npc: int, time: float) -> Self:
        # The moment is the time of the ego's mistake or, if that is unknown, 2 s before the failure. If the ego was
        # changing lanes then, or braking for nothing, it is the last moment before the ego started to. Otherwise, if
        # the NPC entered the ego's lane only later, it is the moment at which the NPC was in the lane.
        trace, mistake = run.trace, tick_of_mistake(run, failure)
        frame, hz = frame_of(trace), trace.physics_hz
        end = min(round(time * hz), trace.ticks)
        tick, since = end, max(end - round(BEFORE * hz), 0)
        is_steady, is_needless = np.abs(frame.drift[0]) < DRIFTING, False
        if mistake is not None:
            tick = since = mistake
            # An ego that brakes for nothing has chosen its speed, so its speed before the braking counts.
            if run.attribution.fault in ("braked-for-nothing", "stopped-for-nothing"):
                is_steady, is_needless = braking(trace) < BRAKES, True
        lanes = _lanes_between(trace, frame, npc)
        steady = np.flatnonzero(is_steady[: tick + 1])
        if steady.size and (is_needless or steady[-1] < tick):
            tick = int(steady[-1])
        else:
            tick = since
            inside = np.flatnonzero(np.abs(lanes[tick : end + 1]) <= HALF_LANE)
            if inside.size:
                tick += int(inside[0])
        speed = frame.speed[npc + 1, tick]
        # A leader that brakes is as slow as it becomes.
        if round(lanes[tick]) == 0 and frame.ahead[npc, tick] > 0:
            speed = frame.speed[npc + 1, tick : end + 1].min()
        return cls._at(tick, trace, npc, speed)

    @classmethod
    def _at(cls, tick: int, trace: Trace, npc: int, npc_speed: float) -> Self:
        frame = frame_of(trace)
        ahead = frame.ahead[npc, tick]
        return cls(
            npc=npc,
            time=round(tick / trace.physics_hz, 3),
            gap=_in_tenths(abs(ahead) - frame.half_lengths(npc)[tick]),
            place="ahead" if ahead > 0 else "behind",
            lanes_to_right=round(float(_lanes_between(trace, frame, npc)[tick])),
            ego_speed=_in_tenths(frame.speed[0, tick]),
            npc_speed=_in_tenths(npc_speed),
        )

    def distances(self, trace: Trace) -> FloatArray:
        # The distances of a run from the situation at each tick: along the road, in lanes and in speeds, in units of
        # the tolerance, shape [3, ticks + 1]. The situation occurs at a tick if all three are at most 1.
        frame, npc = frame_of(trace), self.npc
        ahead, ego, speed = frame.ahead[npc], frame.speed[0], frame.speed[npc + 1]
        is_early = np.arange(len(ego)) < round(min(self.time, START) * trace.physics_hz)
        slower = self.ego_speed - self.npc_speed
        apart = self.gap + frame.half_lengths(npc)  # between the centres
        if self.lanes_to_right == 0 and self.place == "ahead":
            ego = _highest(np.where(is_early, 0.0, ego), trace, ANSWER)
            reach = np.maximum(REACH, REACH_FACTOR * apart)
            along = np.where(ahead > 0, ahead / reach, np.inf)
            lacking = min(SLOWER_SHARE * slower, slower - SPEED) - (ego - speed)
            speeds = np.maximum(1 + lacking / SPEED, 0)
        else:
            then = apart if self.place == "ahead" else -apart
            along = np.abs(ahead - then) / np.maximum(PLACE, PLACE_SHARE * apart)
            along = np.where(is_early, np.inf, along)
            # An NPC whose own speed matches, such as one that overtakes, may be next to an ego of a different speed.
            own_speed = np.abs(speed - self.npc_speed) / SPEED
            egos_speed = np.abs(ego - self.ego_speed) / EGO_SPEED
            relative_speed = np.abs(ego - speed - slower) / SPEED
            speeds = np.minimum(relative_speed, np.maximum(own_speed, egos_speed))
        aside = np.abs(_lanes_between(trace, frame, npc) - self.lanes_to_right) / HALF_LANE
        return np.stack((along, aside, speeds))

    def nearest_in(self, trace: Trace) -> Self:
        """Return the situation in a run that was closest to this one."""
        tick = _nearest_tick(self, trace)
        return self._at(tick, trace, self.npc, frame_of(trace).speed[self.npc + 1, tick])

    def __str__(self) -> str:
        place, lane = "side by side with the ego", "in the ego's lane"
        if self.gap > 0:
            place = f"{self.gap:.1f} m {self.place}"
        lanes, side = abs(self.lanes_to_right), "right"
        if self.lanes_to_right < 0:
            side = "left"
        if lanes == 1:
            lane = f"one lane to the {side}"
        elif lanes:
            lane = f"{lanes} lanes to the {side}"
        speeds = f"at {self.npc_speed:.1f} m/s, with the ego at {self.ego_speed:.1f} m/s"
        return f"{place} {lane} {speeds}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneSituation:
    """The times until a crossing NPC and the ego reach their conflict zone."""

    # The times assume the highest speed of the last 3 s, because an ego that responds slows down. They are negative for
    # a vehicle in the zone or after it.

    npc: int  # index of the NPC in the scenario
    time: float  # time of the moment [s]
    npc_enters: float  # time from the moment until the NPC's centre is at the start of the zone [s]
    ego_enters: float  # time from the moment until the ego's centre is at the start of the zone [s]
    ego_speed: float  # along the ego's path [m/s]
    npc_speed: float  # along the NPC's path [m/s]

    @classmethod
    def from_run(cls, run: Run, failure: Failure, npc: int, time: float) -> Self:
        # The moment is the time of the ego's mistake or, if that is unknown, 2 s before the failure. If the mistake is
        # to enter the zone, the moment is 2 s before the mistake.
        trace, mistake = run.trace, tick_of_mistake(run, failure)
        tick, fault = round(time * trace.physics_hz), run.attribution.fault
        if mistake is not None:
            tick = mistake
        if mistake is None or fault is None or fault in AT_ZONES:
            tick = max(tick - round(BEFORE * trace.physics_hz), 0)
        return cls._at(min(tick, trace.ticks), trace, npc)

    @classmethod
    def _at(cls, tick: int, trace: Trace, npc: int) -> Self:
        ego_enters, npc_enters = _times_to_zone(trace, npc)
        ego_speed, npc_speed = trace.states[tick, [0, npc + 1], SPEEDS]
        return cls(
            npc=npc,
            time=round(tick / trace.physics_hz, 3),
            npc_enters=_in_tenths(npc_enters[tick]),
            ego_enters=_in_tenths(ego_enters[tick]),
            ego_speed=_in_tenths(ego_speed),
            npc_speed=_in_tenths(npc_speed),
        )

    def distances(self, trace: Trace) -> FloatArray:
        # As for `Situation.distances`, but in the two times and the NPC's speed.
        ego_enters, npc_enters = _times_to_zone(trace, self.npc)
        is_early = np.arange(trace.ticks + 1) < min(self.time, START) * trace.physics_hz
        ego_enters = np.where(is_early, np.inf, ego_enters)
        distances = []
        for now, then in ((ego_enters, self.ego_enters), (npc_enters, self.npc_enters)):
            distances.append(np.abs(now - then) / max(ARRIVAL, ARRIVAL_SHARE * abs(then)))
        speeds = trace.states[:, self.npc + 1, SPEEDS]
        return np.stack((*distances, np.abs(speeds - self.npc_speed) / SPEED))

    def nearest_in(self, trace: Trace) -> Self:
        """Return the situation in a run that was closest to this one."""
        return self._at(_nearest_tick(self, trace), trace, self.npc)

    def __str__(self) -> str:
        places = []
        for time in (self.npc_enters, self.ego_enters):
            where = "from" if time >= 0 else "past the start of"
            places.append(f"{abs(time):.1f} s {where}")
        npc = f"{places[0]} its zone at {self.npc_speed:.1f} m/s"
        return f"{npc}, with the ego {places[1]} it at {self.ego_speed:.1f} m/s"


def _in_tenths(value: float) -> float:
    # Round a value, which may be of numpy, so that it is never -0.0.
    return round(float(value), 1) + 0.0


def _nearest_tick(situation: Situation | ZoneSituation, trace: Trace) -> int:
    squares = situation.distances(trace) ** 2
    return int(squares.sum(axis=0).argmin())


def _times_to_zone(trace: Trace, npc: int) -> tuple[FloatArray, FloatArray]:
    # The times of the ego and of the NPC [s].
    zone, on_way = trace.zones[npc], trace.on_way
    assert zone is not None and on_way is not None, "the NPC crosses"  # noqa: S101, PT018
    egos, npcs = (
        np.maximum(_highest(trace.states[:, vehicle, SPEEDS], trace, APPROACH), LEAST_SPEED)
        for vehicle in (0, npc + 1)
    )
    left = zone.ego[0] - trace.track_of(0)[:, ALONG]
    return left / egos, (zone.npc[0] - on_way[:, npc]) / npcs


def _highest(speeds: FloatArray, trace: Trace, seconds: float) -> FloatArray:
    # Within the last `seconds`.
    ticks = round(seconds * trace.physics_hz)
    return np.asarray(sliding_window_view(np.pad(speeds, (ticks, 0)), ticks + 1).max(axis=1))


def seconds_after(situation: Situation | ZoneSituation | None, run: Run) -> float | None:
    """Return how long [s] a run continued after a situation first occurred, or None."""
    if situation is None or not _can_be_compared(situation, run.trace):
        return None
    came_up = np.flatnonzero(situation.distances(run.trace).max(axis=0) <= 1)
    if not came_up.size:
        return None
    return run.duration - float(came_up[0]) / run.trace.physics_hz


def missed(situation: Situation | ZoneSituation | None, run: Run) -> str:
    """Return a sentence about a situation that did not occur in a run, or an empty string if it did."""
    if situation is None or not _can_be_compared(situation, run.trace):
        return ""
    if seconds_after(situation, run) is not None:
        return ""
    now = situation.nearest_in(run.trace)
    return (
        f"the situation did not occur: before the saved run failed, NPC {situation.npc} was {situation}. In this run, "
        f"the NPC came closest to this after {now.time:.1f} s, when it was {now}"
    )


def _can_be_compared(situation: Situation | ZoneSituation, trace: Trace) -> bool:
    # Positions must be finite, and the NPC crosses if and only if the situation is at a zone.
    crosses = bool(trace.zones) and trace.zones[situation.npc] is not None
    return bool(np.isfinite(trace.states).all()) and isinstance(situation, ZoneSituation) == crosses


def _lanes_between(trace: Trace, frame: RoadFrame, npc: int) -> FloatArray:
    # In widths of the ego's lane.
    widths = np.array([lane.width for lane in trace.lanes])
    # Off the road, the lane is -1.
    lane_of_ego = np.maximum(trace.states[:, 0, LANE].astype(np.intp), 0)
    return np.asarray(frame.right[npc] / widths[lane_of_ego])
