"""CommonRoad scenarios in XML, versions 2018b and 2020a: obstacles with trajectories, and the lanelets as lanes."""

from __future__ import annotations

import math

import numpy as np

from pytest_pafot.extending import FloatArray, Lane
from pytest_pafot.extras.recordings.recording import RecordedVehicle, Recording
from pytest_pafot.extras.recordings.tables import Between, parts, states_of
from pytest_pafot.extras.recordings.xml_data import Element
from pytest_pafot.support.text import plural

ROOT = "commonRoad"
SHAPES = "its shape as a rectangle; circles and polygons are not read"


def read(root: Element, between: Between) -> Recording:
    """Return the dynamic obstacles and the lanelets of a scenario: y and headings grow to the left there.

    Obstacles without a trajectory, such as predicted sets of places, and those that stand are left out.
    """
    step = root.number("timeStepSize")
    if step <= 0:
        raise root.error("seconds, above 0", f"{step:g}", "correct the value", "timeStepSize")
    first, last = between or (-math.inf, math.inf)
    vehicles: list[RecordedVehicle] = []
    without = 0
    # 2020a has the element dynamicObstacle, 2018b has obstacle with a role.
    old = [each for each in root.all("obstacle") if _text(each, "role") == "dynamic"]
    for each in (*root.all("dynamicObstacle"), *old):
        trajectory, shape = each.find("trajectory"), each.get("shape")
        if trajectory is None:
            without += 1
            continue
        box = shape.find("rectangle")
        if box is None or len(shape.children) != 1:
            raise shape.error(SHAPES, ", ".join(child.tag for child in shape.children), "remove the obstacle")
        size = box.get("length").content(), box.get("width").content()
        rows = np.array([_row(state, step) for state in (each.get("initialState"), *trajectory.all("state"))])
        rows = rows[(rows[:, 0] >= first) & (rows[:, 0] <= last)]
        if not len(rows):
            continue
        if min(size) <= 0 or (np.diff(rows[:, 0]) <= 0).any():
            raise each.error("a size above 0, and times that grow", f"{size}", "correct the obstacle")
        times, x, left, angle, speed = rows.T
        states = states_of(x, -left, -angle, np.abs(speed))
        vehicles += parts(each.values.get("id", ""), _text(each, "type"), size, times, states, 1 / step)
    if not vehicles:
        raise root.error("dynamic obstacles with trajectories", "none", "give another file or time")
    lanes = tuple(_lane(each) for each in root.all("lanelet"))
    notes = (f"{plural(without, 'obstacle')} without a trajectory left out",) if without else ()
    return Recording(vehicles=tuple(vehicles), rate=1 / step, lanes=lanes, source=str(root.path), notes=notes)


def _text(element: Element, name: str) -> str:
    found = element.find(name)
    return "" if found is None else found.text


def _row(state: Element, step: float) -> list[float]:
    """Return time, x, y, orientation and velocity of a state; of an interval, its middle."""
    point = state.get("position/point")
    numbers = [_exact(state.get(name)) for name in ("time", "orientation", "velocity")]
    return [numbers[0] * step, point.get("x").content(), point.get("y").content(), *numbers[1:]]


def _exact(value: Element) -> float:
    if value.find("exact") is not None:
        return value.get("exact").content()
    return (value.get("intervalStart").content() + value.get("intervalEnd").content()) / 2


def _lane(lanelet: Element) -> Lane:
    """Return a lanelet as a lane; without points if its two edges are one straight piece each."""
    left, right = (
        np.array([(each.get("x").content(), -each.get("y").content()) for each in lanelet.all(f"{side}/point")])
        for side in ("leftBound", "rightBound")
    )
    if len(left) < 2 or len(left) != len(right):
        expected, received = "as many points on both sides, at least two", f"{len(left)} and {len(right)}"
        raise lanelet.error(expected, received, "correct the lanelet")
    line: FloatArray = (left + right) / 2
    ahead = np.diff(line, axis=0)
    angles = np.arctan2(ahead[:, 1], ahead[:, 0])
    is_straight = np.ptp(np.unwrap(angles)) < 1e-6
    return Lane(
        x=float(line[0, 0]),
        y=float(line[0, 1]),
        heading=float(angles[0]),
        length=float(np.hypot(*ahead.T).sum()),
        width=float(np.median(np.hypot(*(right - left).T))),
        speed_limit=math.inf,
        points=() if is_straight else tuple((x, y) for x, y in line.tolist()),
    )
