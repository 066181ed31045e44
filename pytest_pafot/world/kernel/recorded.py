"""NPCs that drive as recorded, and when they are handed over to attentive driving.

A recorded driver had reacted to the recorded ego. One that drives otherwise meets cars that cannot react to it, and a
collision with such a car would be nobody's fault. So an NPC leaves its track for good

- when its track ends;
- when the first of its own steps begins;
- when it would come near a vehicle that does not drive as recorded: less than ``ALONG`` ahead or behind and ``ACROSS``
  beside it within the next ``SECONDS``, if the NPC follows its track, and keeps its speed after its end, and the other
  keeps its speed, and goes on across the road for ``ASIDE``. In this time a driver reacts after 1 s, and loses 10 m/s
  by braking with 5 m/s^2.

An NPC that is directly ahead of the other is not handed over: whoever drives behind has to look.

An ego drives as recorded as long as it is within ``APART`` of the recorded ego. That is less than half the width of a
car, so nobody would have driven otherwise for it. NPCs drive as recorded if their instruction says nothing else.
"""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np

from pytest_pafot.model.instructions.recorded import APART
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.director import Director, Npc, Start, TrackedNpc
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.kernel.road_directors import NetworkDirector
from pytest_pafot.world.limits import NpcLimits

ALONG, ACROSS = 2.0, 0.3
"""The gaps between two boxes that are near, along the road and across it [m]."""
SECONDS, SAMPLE, ASIDE = 3.0, 0.2, 1.0
"""How far ahead an NPC looks, in which steps, and how long the other goes on across the road [s]."""


class RecordedDirector(Director):
    """The director of the NPCs of one run on a straight road, of whom some drive as recorded.

    Arguments are those of :class:`Director`.
    """

    def __init__(self, scenario: Scenario, *others: Any, **common: Any) -> None:
        super().__init__(scenario, *others, **common)
        self._tracked = [npc for npc in self.npcs if isinstance(npc, TrackedNpc)]
        self._ego_track: Any = array("d")
        self._start = 0.0
        self._across = scenario.ego_lane * self._lane_width
        if scenario.ego_track is not None:
            ticks = math.floor(scenario.ego_track.seconds * self._hz + 1e-6)
            self._ego_track = _rows(scenario.ego_track.at(np.arange(ticks + 1) / self._hz))

    @property
    def handed_over(self) -> tuple[int | None, ...]:
        """The tick at which each NPC left its recording; None if it has not."""
        return tuple([npc.left if isinstance(npc, TrackedNpc) and npc.left >= 0 else None for npc in self.npcs])

    def started(self, starts: list[Start]) -> list[Start]:
        """Return the starts of all NPCs, those that drive as recorded at the beginning of their tracks."""
        found = list(starts)
        for npc in self._tracked:
            along = starts[npc.index][0]
            npc.states = self._states(npc, along)
            found[npc.index] = (along, tuple(npc.states[:4]))
        return found

    def _states(self, npc: TrackedNpc, along: float) -> Any:
        """Return the states of an NPC at the ticks of its track, in road coordinates, if it starts at a place [m]."""
        instruction = npc.chain[0]
        ticks = max(math.floor(instruction.end * self._hz + 1e-6), 1)
        states = instruction.at(np.arange(ticks + 1) / self._hz)
        states[:, 0] += along - states[0, 0]
        states[:, 1] += self._across
        return _rows(states)

    def command(self, ego: Body) -> None:
        """Release the NPCs that leave their tracks, and set the controls of all that do not follow one."""
        if self._tick == 0:
            self._start = ego.x
        for npc in self._tracked:
            if npc.left < 0 and (4 * (npc.tick + 2) > len(npc.states) or self._leaves(npc, ego)):
                npc.left = self._tick
                npc.kept_lane, npc.kept_speed, npc.ramp = npc.lane, npc.speed, npc.limits.braking
                npc.asked, npc.course = npc.acceleration, npc.heading
        Director.command(self, ego)  # C methods have no super()

    def _control(self, npc: Npc, ego: Body) -> None:
        if isinstance(npc, TrackedNpc) and npc.left < 0:
            npc.heading_for = npc.lane
            return
        Director._control(self, npc, ego)

    def _leaves(self, npc: TrackedNpc, ego: Body) -> bool:
        """Return whether an NPC leaves its track now."""
        if self._is_due(npc, ego):
            return True
        is_own = npc.is_own
        if not (is_own and self._is_as_recorded(ego)) and self._nears(npc, ego):
            return True
        for other in self.npcs:
            if other is npc:
                continue
            if is_own and isinstance(other, TrackedNpc):
                tracked = other
                if tracked.is_own and tracked.left < 0:
                    continue
            if self._nears(npc, other):
                return True
        return False

    def _is_as_recorded(self, ego: Body) -> bool:
        """Return whether the ego is near the recorded one."""
        track, row = self._ego_track, 4 * self._tick
        if row >= len(track):
            return False
        along, across = ego.x - self._start - track[row], ego.y - self._across - track[row + 1]
        return bool(along * along + across * across <= APART * APART)

    def _nears(self, npc: TrackedNpc, other: Body) -> bool:
        """Return whether an NPC that follows its track will come near a vehicle that is not directly behind it."""
        states = npc.states
        along, across = (npc.length + other.length) / 2.0, (npc.width + other.width) / 2.0
        if npc.x > other.x and abs(npc.y - other.y) < across:
            return False
        along, across = along + ALONG, across + ACROSS
        forward, aside = other.speed * math.cos(other.heading), other.speed * math.sin(other.heading)
        last, step = len(states) // 4 - 1, max(round(SAMPLE * self._hz), 1)
        for later in range(0, round(SECONDS * self._hz) + 1, step):
            tick = min(npc.tick + later, last)
            seconds, row, beyond = later / self._hz, 4 * tick, (npc.tick + later - tick) / self._hz
            distance = states[row] + states[row + 3] * beyond - other.x - forward * seconds
            beside = states[row + 1] - other.y - aside * min(seconds, ASIDE)
            if abs(distance) < along and abs(beside) < across:
                return True
        return False


class RecordedNetworkDirector(NetworkDirector):
    """The director of the NPCs of one run on a road of any shape, of whom some drive as recorded.

    Their tracks bend with the road: x is along the ego's way, and y across its lanes, as if they all had the width of
    the ego's. So they stay in their lanes, and drive there as much faster than recorded as an outer lane is longer.

    Arguments are those of :class:`NetworkDirector`.
    """

    def __init__(self, scenario: Scenario, road: Any, limits: NpcLimits, **common: Any) -> None:
        super().__init__(scenario, road, limits, **common)
        del common["start_cells"]
        lanes = Lanes(road.lane_count, road.lane_width, road.end)
        # Who leaves its track follows from places along the road and across it, as on a straight road with these lanes.
        self._watch = RecordedDirector(scenario, lanes, limits, speed_limit=road.speed_limit, cells=(), **common)
        self._watch.npcs = self.npcs
        self._watch._tracked = [npc for npc in self.npcs if isinstance(npc, TrackedNpc)]
        self._twins: dict[int, TrackedNpc] = {}  # the same NPCs in world coordinates

    @property
    def handed_over(self) -> tuple[int | None, ...]:
        """The tick at which each NPC left its recording; None if it has not."""
        return self._watch.handed_over

    def started(self, starts: list[Start]) -> list[Start]:
        """Return the starts of all NPCs, those that drive as recorded at the beginning of their tracks."""
        found = list(starts)
        for npc in self._watch._tracked:
            along = starts[npc.index][0]
            npc.states = self._watch._states(npc, along)
            twin = TrackedNpc(npc.index, npc.chain, npc.length, npc.width)
            twin.states = _rows(self._road.followed(np.asarray(npc.states).reshape(-1, 4), npc.bends))
            self._twins[npc.index] = twin
            found[npc.index] = (along, tuple(twin.states[:4]))
        return found

    def in_world(self) -> list[Body]:
        """Return a body for each NPC in world coordinates; those of recorded ones follow their tracks."""
        bodies = NetworkDirector.in_world(self)
        for index, twin in self._twins.items():
            bodies[index] = twin
        return bodies

    def command(self, ego: Body) -> None:
        """Release the NPCs that leave their tracks, and set the controls of all that do not follow one."""
        watch = self._watch
        watch._tick = self._tick
        if self._tick == 0:
            watch._start = ego.x
        for npc in watch._tracked:
            twin: TrackedNpc = self._twins[npc.index]
            npc.tick = twin.tick
            if npc.left < 0 and (4 * (npc.tick + 2) > len(npc.states) or watch._leaves(npc, ego)):
                npc.left = twin.left = self._tick
                npc.kept_lane, npc.kept_speed, npc.ramp = npc.lane, npc.speed, npc.limits.braking
                npc.asked, npc.course = twin.acceleration, twin.heading
        NetworkDirector.command(self, ego)  # C methods have no super()

    def _control(self, npc: Npc, ego: Body) -> None:
        if isinstance(npc, TrackedNpc) and npc.left < 0:
            npc.heading_for = npc.lane
            return
        NetworkDirector._control(self, npc, ego)


def _rows(states: Any) -> Any:
    return array("d", np.ascontiguousarray(states).ravel().tolist())
