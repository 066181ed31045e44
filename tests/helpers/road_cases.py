"""Scenarios for worlds of any road, and a check of the NPC limits on a finished trace, by highway-env's own lanes."""

from __future__ import annotations

import functools
import math
from typing import ClassVar

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road, RoadNetwork

from pytest_pafot import World
from pytest_pafot.algorithms.space import space_on
from pytest_pafot.model.trace import ALONG, HEADING, SPEED, X, Y
from tests.helpers.world_cases import beyond, bounds_of_motion, own_limits, wrapped


class OwnEnvironment(AbstractEnv):
    """A user's environment without rewards that ends after its duration; its road is made in ``_reset``."""

    options: ClassVar = {}
    """What its configuration has more, or otherwise."""

    @classmethod
    def default_config(cls):
        return {**super().default_config(), **cls.options}

    def open(self, lanes, place, heading=0.0, speed=10.0, road=Road):
        """Make a road of lanes with the nodes before and after each of them, and put the ego on it."""
        network = RoadNetwork()
        for before, after, lane in lanes:
            network.add_lane(before, after, lane)
        self.road = road(network, np_random=self.np_random)
        self.vehicle = self.action_type.vehicle_class(self.road, place, heading, speed)
        self.road.vehicles.append(self.vehicle)

    def _reward(self, action):
        return 0.0

    def _is_terminated(self):
        return False

    def _is_truncated(self):
        return self.time >= self.config["duration"]


ENVIRONMENTS = (
    "exit-v0", "exit-v1", "intersection-v0", "intersection-v1", "intersection-v2", "lane-keeping-v0", "merge-v0",
    "merge-v1", "merge-generic-v0", "merge-generic-v1", "racetrack-v0", "racetrack-v1", "racetrack-large-v0",
    "racetrack-large-v1", "racetrack-oval-v0", "racetrack-oval-v1", "roundabout-v0", "roundabout-v1",
    "roundabout-generic-v0", "roundabout-generic-v1", "two-way-v0", "u-turn-v0", "u-turn-v1",
)  # fmt: skip
"""All of highway-env's environments except straight roads, parking lots and those with more than one ego."""
ROADS = tuple(
    env_id
    for env_id in ENVIRONMENTS
    if env_id.endswith("-v1") or env_id in ("intersection-v0", "lane-keeping-v0", "two-way-v0")
)
"""Each road and route once: the versions differ only in observations and actions, which do not matter here.

The first version of the intersection has its own route.
"""

ON_LANE_MARGIN = 0.1
"""The distance that a corner may be beyond the edge of all lanes [m]."""
IN_A_GAP_MARGIN = 0.6
"""The same distance in some roundabouts [m]. A gap of 6 m between two lanes bends by 50 degrees there, and a vehicle on
its way leaves both lanes.
"""
WITH_GAPS = ("roundabout-v0", "roundabout-v1")


@functools.cache
def world_of(env_id, duration=None):
    """Return a world, made once because the survey of a road takes as long as many runs on it.

    Runs go on to the end of the road, past those of merges and intersections.
    """
    return World(env_id, duration=duration, ends="duration")


def space_of(world, npcs=2, traffic="paper"):
    """Return the plugin's search space in a world with its own start."""
    return space_on(
        world.speed_limit, world.longest_run, {"npcs": npcs, "traffic": traffic}, world.road_start
    )


def off_lanes(network, trace):
    """Return the largest distance of the NPCs' corners beyond the edges of all lanes of a network [m]."""
    some = trace.npcs[:: max(1, trace.physics_hz // 5)]
    states = some.reshape(-1, 7)
    length, width = np.tile(trace.sizes[1:], (len(some), 1)).T[..., None]
    heading, centre = states[:, HEADING], states[:, [X, Y]]
    forward = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * length / 2
    right = np.stack([-np.sin(heading), np.cos(heading)], axis=-1) * width / 2
    worst = 0.0
    for a in (-1, 1):
        for b in (-1, 1):
            worst = max(
                worst,
                *(beyond_edges(network, corner) for corner in centre + a * forward + b * right),
            )
    return worst


def beyond_edges(network, point):
    """Return the distance from a point to the nearest lane's edge [m], negative on a lane."""
    best = math.inf
    for lane in network.lanes_list():
        longitudinal, lateral = lane.local_coordinates(point)
        if -5 <= longitudinal <= lane.length + 5:
            best = min(best, abs(lateral) - lane.width_at(longitudinal) / 2)
            if best < 0:
                break
    return best


def violations(trace, world):
    """Return the limits that the NPCs break, as texts with the worst value."""
    limits, s = world.limits, trace.npcs
    bounds, _ = bounds_of_motion(s, limits, *own_limits(trace, limits, world.speed_limit), trace.dt)
    ticks = range(0, trace.ticks + 1, 3)
    direction, fastest = lanes_of(trace, world.road, ticks)
    beside = IN_A_GAP_MARGIN if world.env_id in WITH_GAPS else ON_LANE_MARGIN
    bounds |= {
        "speed in the bend": (s[ticks, :, SPEED] - fastest, -np.inf, 0.0),
        "angle to the lane": (
            wrapped(s[ticks, :, HEADING] - direction),
            -limits.heading,
            limits.heading,
        ),
        "forward motion": (np.diff(trace.track[:, 1:, ALONG], axis=0), -1e-9, np.inf),
        "off the lanes": (np.array([off_lanes(world.network, trace)]), -np.inf, beside),
    }
    return beyond(bounds)


def lanes_of(trace, road, ticks):
    """Return each NPC's lane direction [rad] and sqrt(a / curvature) there [m/s], by the road's own line."""
    direction = np.zeros((len(ticks), trace.npcs.shape[1]))
    fastest = np.full(direction.shape, np.inf)
    for row, npc in np.ndindex(direction.shape):
        tick = ticks[row]
        along = trace.track[tick, npc + 1, ALONG]
        lane = next(
            number for number, column in enumerate(road.columns)
            if column.part[road.bends.point(along)] == trace.npcs[tick, npc, 6] or number == len(road.columns) - 1
        )  # fmt: skip
        direction[row, npc] = road.bends.direction_at(lane, along)
        x, y, _ = zip(
            *(road.position(along + step, lane) for step in (-1.5, 0.0, 1.5)), strict=True
        )
        turn = math.atan2(y[2] - y[1], x[2] - x[1]) - math.atan2(y[1] - y[0], x[1] - x[0])
        bend = abs((turn + math.pi) % (2 * math.pi) - math.pi) / math.hypot(
            x[2] - x[1], y[2] - y[1]
        )
        lateral = min(4.0, trace.scenario.vehicle_of(npc).lateral_acceleration)
        fastest[row, npc] = math.sqrt(lateral / max(bend, 1e-9))
    return direction, fastest
