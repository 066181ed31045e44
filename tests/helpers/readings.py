"""Collisions that readers decided from traces alone, without seeing any rule: packed traces and the answers.

They come from searches and random scenarios of 107 policies, each with a single defect or habit. Each trace is its last
25 s, in millimetres, millimetres per second and tenths of a milliradian. A reader names the responsible vehicle, and
the answers that a colleague could defend.
"""

from __future__ import annotations

import io
import json
import lzma
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_pafot.model.trace import HEADING, LANE, SPEED, Lane, Outcome, Trace, X, Y
from tests.helpers.traces import collision_at, trace_of

FILE = Path(__file__).parents[1] / "attribution" / "readings.xz"
COLUMNS, SCALES = (X, Y, HEADING, SPEED, LANE), np.array([1e3, 1e3, 1e4, 1e3, 1.0])


@dataclass(frozen=True)
class Read:
    """A collision, the number of its set, 1 to 7, and the answers."""

    number: int
    trace: Trace
    read_in: int
    answers: tuple[tuple[str, tuple[str, ...]], ...]

    def accepts(self, responsibility):
        """Return whether the first reader would defend an answer."""
        return responsibility in self.answers[0][1]


def unpacked(data):
    """Return the trace of packed data, on a straight road without an end."""
    steps = data["steps"].copy()
    steps[1:, :, 0] = np.cumsum(steps[:, :, 0], axis=0)[1:]
    whole = np.cumsum(steps, axis=0)
    states = np.zeros((*whole.shape[:2], 7))
    states[:, :, COLUMNS] = whole / SCALES
    npc, hz = data["npc"], data["hz"]
    speeds = states[-1, :, SPEED]
    speeds = {"ego_speed": speeds[0], "npc_speed": speeds[npc + 1]}
    lanes = [
        Lane(x=-1e5, y=y, heading=0.0, length=2e5, width=width, speed_limit=limit)
        for y, width, limit in data["lanes"]
    ]
    return trace_of(
        *states.swapaxes(0, 1),
        sizes=data["sizes"],
        outcome=Outcome.COLLISION,
        lanes=tuple(lanes),
        physics_hz=hz,
        ads_hz=hz,
        collision=collision_at(
            len(states) - 1, npc=npc, side=data["side"], physics_hz=hz, **speeds
        ),
    )


def load(path=FILE):
    """Load all collisions that readers decided."""
    data = lzma.decompress(path.read_bytes())
    size = int.from_bytes(data[:8], "big")
    head = json.loads(data[8 : 8 + size])
    numbers = np.load(io.BytesIO(data[8 + size :]), allow_pickle=False).astype(np.int64)
    found, begin = [], 0
    for number, (item, (ticks, vehicles, _)) in enumerate(
        zip(head["items"], head["shapes"], strict=True)
    ):
        end = begin + ticks * vehicles
        steps = numbers[:, begin:end].reshape(-1, ticks, vehicles).transpose(1, 2, 0)
        answers = tuple((fault, tuple(others)) for fault, others in item["readings"])
        found.append(
            Read(
                number=number,
                trace=unpacked({**item, "steps": steps}),
                read_in=item["set"],
                answers=answers,
            )
        )
        begin = end
    return found
