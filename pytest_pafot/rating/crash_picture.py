"""The end of an episode as an animated picture, drawn as the pictures of findings are."""

from __future__ import annotations

import numpy as np

from pytest_pafot.report.animation import animate
from pytest_pafot.report.finding_view import FRAMES_PER_SECOND
from pytest_pafot.report.page_data import EventView, FindingView, LaneView, RoadView, VehicleView
from pytest_pafot.trace import FloatArray
from pytest_pafot.world.engines.episode import Episode, EpisodeRecording

NEAREST = 7
"""So many other vehicles are drawn, those that are nearest to the ego at the end."""
CELLS = 8


def picture(episode: Episode, headline: str) -> bytes:
    """An APNG of the last seconds of an episode, which must be recorded.

    Raises:
        AnimationError: without Pillow.
    """
    if episode.recording is None:
        raise ValueError("episode: expected one with a recording")
    return animate(_view(episode, episode.recording, headline))


def _view(episode: Episode, recording: EpisodeRecording, headline: str) -> FindingView:
    states, hz = recording.states, recording.physics_hz
    last = len(states) - 1
    ticks = sorted({*range(0, last + 1, max(1, round(hz / FRAMES_PER_SECOND))), last})
    distance = np.hypot(*(states[-1, 1:, :2] - states[-1, 0, :2]).T)
    shown = [0, *(np.argsort(distance, kind="stable")[:NEAREST] + 1)]  # NaN, who has gone, comes last
    return FindingView(
        id=f"seed-{episode.seed}",
        node_id="",
        test="",
        headline=headline,
        explanation="",
        responsibility="none",
        road=_road(recording),
        vehicles=tuple(_vehicle(recording, int(index), ticks) for index in shown),
        times=tuple(round(tick / hz, 3) for tick in ticks),
        instructions=(),
        event=EventView(kind=str(episode.outcome), time=episode.seconds, npc=0 if len(shown) > 1 else None),
        yaml="",
        command="",
        grid=((None,) * CELLS,) * len(ticks) if recording.lanes[0].points else (),
    )


def _road(recording: EpisodeRecording) -> RoadView:
    lanes, bent = recording.lanes, bool(recording.lanes[0].points)
    return RoadView(
        lanes=() if bent else tuple(lane.y for lane in lanes),
        lane_width=lanes[0].width,
        speed_limit=max(lane.speed_limit for lane in lanes),
        clearance=0.0,
        shapes=tuple(LaneView(points=lane.points, width=lane.width) for lane in lanes) if bent else (),
    )


def _vehicle(recording: EpisodeRecording, index: int, ticks: list[int]) -> VehicleView:
    length, width = recording.sizes[index]
    along, across, heading, speed = (_numbers(recording.states[ticks, index, column]) for column in range(4))
    return VehicleView(
        name=f"NPC {index - 1}" if index else "ego",
        length=float(length),
        width=float(width),
        along=along,
        across=across,
        heading=heading,
        speed=speed,
    )


def _numbers(values: FloatArray) -> tuple[float | None, ...]:
    return tuple(round(float(value), 3) if np.isfinite(value) else None for value in values)
