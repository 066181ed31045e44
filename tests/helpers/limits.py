"""The limits of NPCs, calculated from the states of a run alone."""

import numpy as np

from pytest_pafot.model.trace import HEADING, SPEED
from pytest_pafot.model.vehicle_type import CAR

ROUNDING = 1e-6
SINGLE = 1e-4
"""The share of a limit by which values with single precision may exceed it."""


def limits(world, trace):
    """Yield whether each limit of the NPCs is kept, the limit, and what the NPCs do."""
    stated, npcs, dt = world.limits, trace.npcs, trace.dt
    speed = npcs[..., SPEED]
    acceleration = np.concatenate([np.zeros_like(speed[:1]), np.diff(speed, axis=0) / dt])
    is_standing = (speed[1:] <= ROUNDING) | (speed[:-1] <= ROUNDING)
    jerk = np.where(is_standing, 0.0, np.diff(acceleration, axis=0) / dt)
    turns = (np.diff(npcs[..., HEADING], axis=0) + np.pi) % (2 * np.pi) - np.pi
    angle = trace.road.angles[:, 1:]
    angle = np.where([zone is None for zone in trace.zones or [None] * npcs.shape[1]], angle, 0.0)
    aside = speed[:-1] * turns / dt
    for npc, vehicle in enumerate(trace.scenario.all_vehicles):
        own = stated.for_vehicle(vehicle)
        who = "NPCs" if vehicle == CAR else f"a {vehicle.name}"
        top = min(own.overspeed * world.speed_limit, vehicle.top_speed)
        for name, values, low, high in (
            ("speed", speed, 0.0, top),
            ("acceleration", acceleration, -own.braking, own.acceleration),
            ("jerk", jerk, -own.jerk, own.jerk),
            ("heading", angle, -own.heading, own.heading),
            ("lateral acceleration", aside, -own.lateral_acceleration, own.lateral_acceleration),
        ):
            least = float(np.min(values[:, npc], initial=0.0))
            most = float(np.max(values[:, npc], initial=0.0))
            spare = ROUNDING + SINGLE * max(abs(low), high)
            promise = f"the {name} of {who} is from {low:g} to {high:g}"
            yield low - spare <= least and most <= high + spare, promise, f"{least:g} to {most:g}"
