"""MCAP files for Foxglove: the road and the vehicles as a 3D scene, and each vehicle's numbers for plots."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping

from foxglove import Channel, Context, open_mcap
from foxglove.channels import SceneUpdateChannel
from foxglove.messages import (
    Color,
    CubePrimitive,
    LinePrimitive,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from pytest_pafot import Trace
from pytest_pafot.export.exporter import COLUMNS, edges, name_of, states_of
from pytest_pafot.findings.finding import Finding

NANOSECONDS = 1_000_000_000
HEIGHT = 1.5  # height of the boxes that show vehicles [m]
EGO = Color(r=0.1, g=0.5, b=0.9, a=1)
NPC = Color(r=0.9, g=0.4, b=0.1, a=1)
EDGE = Color(r=0.6, g=0.6, b=0.6, a=1)
# The names of the columns of the states, in their order.
NUMBERS = COLUMNS[2:-2]
SCHEMA = {
    "type": "object",
    "properties": {
        "time": {"type": "number"},
        "vehicles": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "name": {"type": "string"},
                    **{name: {"type": "number"} for name in NUMBERS},
                },
            },
        },
    },
}


def export(finding: Finding, trace: Trace) -> Mapping[str, bytes]:
    """Return an MCAP file with a clock that starts at 0.

    The topics ``/road`` and ``/vehicles`` are for a 3D panel, and ``/states`` is for plots.
    """
    content = io.BytesIO()
    context = Context()
    with open_mcap(content, context=context):
        road = SceneUpdateChannel("/road", context=context)
        vehicles = SceneUpdateChannel("/vehicles", context=context)
        numbers = Channel("/states", schema=SCHEMA, context=context)
        lines = []
        for lane in trace.lanes:
            for line in edges(lane):
                points = [Point3(x=x, y=y, z=0) for x, y in line.tolist()]
                lines.append(LinePrimitive(points=points, thickness=0.15, color=EDGE))
        entity = SceneEntity(frame_id="world", id="road", timestamp=Timestamp(sec=0), lines=lines)
        road.log(SceneUpdate(entities=[entity]), log_time=0)
        for time, states in zip(trace.times.tolist(), states_of(trace).tolist(), strict=True):
            at = round(time * NANOSECONDS)
            boxes = []
            told = []
            for number, state in enumerate(states):
                boxes.append(_box(number, trace, state, at))
                values = zip(NUMBERS, state, strict=True)
                told.append({"name": name_of(number), **dict(values)})
            vehicles.log(SceneUpdate(entities=boxes), log_time=at)
            numbers.log({"time": time, "vehicles": told}, log_time=at)
    return {f"{finding.id}.mcap": content.getvalue()}


def _box(number: int, trace: Trace, state: list[float], at: int) -> SceneEntity:
    # The box that shows a vehicle at a time [ns].
    x, y, heading, *_ = state
    length, width = trace.sizes[number].tolist()
    cube = CubePrimitive(
        pose=Pose(
            position=Vector3(x=x, y=y, z=HEIGHT / 2),
            orientation=Quaternion(
                x=0,
                y=0,
                z=math.sin(heading / 2),
                w=math.cos(heading / 2),
            ),
        ),
        size=Vector3(x=length, y=width, z=HEIGHT),
        color=NPC if number else EGO,
    )
    stamp = Timestamp(sec=at // NANOSECONDS, nsec=at % NANOSECONDS)
    return SceneEntity(frame_id="world", id=name_of(number), timestamp=stamp, cubes=[cube])
