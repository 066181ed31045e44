"""The record of a run, and the trace that is made from it."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pytest_pafot.criticality import RelativePositions
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import HEADING, SPEED, STEERING, AdsError, Collision, FloatArray, Outcome, Trace
from pytest_pafot.world.driving.junction_director import JunctionDirector
from pytest_pafot.world.kernel.bodies import Box, depth, overlap, side_hit
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.kernel.observation import COLUMNS
from pytest_pafot.world.roads.junction import JunctionFrame
from pytest_pafot.world.roads.network import NetworkFrame
from pytest_pafot.world.run_config import Rules


@dataclass(slots=True, kw_only=True)
class Record:
    """The record of a run up to its current tick.

    Attributes:
        sizes: length and width of each vehicle [m].
        rows: :data:`COLUMNS` numbers for each vehicle at each tick.
        tick: the last recorded tick.
        slowest: longest decision of the ADS [s].
        frame: the places of all vehicles on a road that is not straight; None on a straight road.
    """

    rules: Rules
    scenario: Scenario
    director: Director | JunctionDirector
    sizes: list[tuple[float, float]]
    rows: array[float]
    tick: int = 0
    actions: list[Any] = field(default_factory=list)
    slowest: float = 0.0
    frame: NetworkFrame | None = None

    def trace(self, ended: Outcome | None = None, error: AdsError | None = None) -> Trace:
        """Return the trace of the run, given the outcome or the ADS's error that ended the run early, if any did."""
        shape = (self.tick + 1, len(self.sizes), COLUMNS)
        rows = np.frombuffer(self.rows, count=shape[0] * shape[1] * COLUMNS)
        # Read-only, and without a copy if the run has filled the whole buffer.
        states = (rows if rows.size == len(self.rows) else rows.copy()).reshape(shape)
        states.flags.writeable = False
        track = None if self.frame is None else self.frame.track()
        off_road = states[:, 0, -1] < 0
        off_road_tick = int(off_road.argmax()) if off_road.any() else None
        outcome = ended or (Outcome.SAFE if off_road_tick is None else Outcome.OFF_ROAD)
        if error is not None:
            outcome = Outcome.HANG if error.interrupted else Outcome.ADS_ERROR
        return Trace(
            scenario=self.scenario,
            executed=self.director.executed,
            outcome=outcome,
            collision=self._collision(states, track) if outcome is Outcome.COLLISION else None,
            error=error,
            states=states,
            sizes=np.array(self.sizes),
            lanes=self.rules.road.lanes,
            physics_hz=self.rules.physics_hz,
            ads_hz=self.rules.ads_hz,
            actions=tuple(self.actions),
            arrivals=self.director.arrivals,
            off_road_tick=off_road_tick,
            max_decision_seconds=self.slowest,
            track=track,
            zones=self._zones,
            on_way=self.frame.on_way() if isinstance(self.frame, JunctionFrame) else None,
            driven=self.director.driven,
        )

    @property
    def _zones(self) -> tuple[Zone | None, ...]:
        if self.rules.crossings is None:
            return ()
        ways = self.rules.crossings.ways
        return tuple(None if each is None else ways[each.zone].zone for each in self.scenario.crossings)

    def _collision(self, states: FloatArray, track: FloatArray | None) -> Collision:
        now = self._boxes(states[-1])
        touching = [index for index, npc in enumerate(now[1:]) if overlap(now[0], npc)]
        npc = min(touching, key=lambda index: depth(now[0], now[index + 1]))
        before = self._boxes(states[max(self.tick - 1, 0)])
        ego, other = states[-1, 0], states[-1, npc + 1]
        positions = RelativePositions(states, np.array(self.sizes), self.rules.road.lanes, track)
        both = states[-1, [0, npc + 1]]
        course = both[:, HEADING] + np.arctan(0.5 * np.tan(both[:, STEERING]))  # a vehicle with turned wheels slips
        velocity = both[:, SPEED] * np.array([np.cos(course), np.sin(course)])
        return Collision(
            tick=self.tick,
            time=self.tick / self.rules.physics_hz,
            npc=npc,
            side=side_hit(before[0], before[npc + 1]),
            cell=self._cell(npc, positions, track),
            ego_speed=float(ego[SPEED]),
            npc_speed=float(other[SPEED]),
            closing_speed=float(np.hypot(*(velocity[:, 0] - velocity[:, 1]))),
        )

    def _cell(self, npc: int, positions: RelativePositions, track: FloatArray | None) -> Cell | None:
        """Return the cell of an NPC that the ego has touched; None if the NPC was not on the ego's way."""
        if track is not None and np.isnan(track[-1, npc + 1, 0]):
            return None
        cell = positions.last_cell(npc, self.tick)
        crossings = self.scenario.crossings[: npc + 1]
        if cell is not None or (crossings and crossings[-1] is not None):
            return cell
        return self.director.first_cells()[npc - sum(each is not None for each in crossings)]

    def _boxes(self, row: FloatArray) -> list[Box]:
        poses = row[:, :3].tolist()
        return [Box(x, y, heading, *size) for (x, y, heading), size in zip(poses, self.sizes, strict=True)]
