"""How near do NPCs come to recorded tracks, and how many OpenSCENARIO files of others are read?

    python -m tests.benchmarks.recordings [--recordings 8] [--scenarios FOLDER] [--vehicles FILE ...]

Records highway-env's own traffic of IDM and MOBIL vehicles, and drives the scenario of each recording for 20 s with an
ego that keeps its speed, as the recorded one does. Prints how far the NPCs are from the tracks. With ``--scenarios``,
also reads all ``.xosc`` files of a folder, with the catalogues of ``--vehicles``, and prints why others are refused.
"""

from __future__ import annotations

import argparse
import csv
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path

import gymnasium
import highway_env  # noqa: F401  (registers highway-v0)
import numpy as np

import pytest_pafot as pafot
from pytest_pafot.extras.recordings.recording import RecordingError
from pytest_pafot.model.trace import X, Y

HZ, SECONDS, BEGIN = 15, 20, 2.0
ROAD = {"lanes_count": 4, "vehicles_count": 14, "vehicles_density": 1.2, "simulation_frequency": HZ}
HERE = ("time", "vehicle", "x", "y", "heading", "speed", "lane", "length", "width")


def recorded_traffic(seed: int, path: Path) -> pafot.Recording:
    """Let the traffic of an environment drive, its ego with constant speed, and return the recording."""
    environment = gymnasium.make("highway-v0", config=ROAD)
    environment.reset(seed=seed)
    road = environment.unwrapped.road
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(HERE)
        for tick in range(HZ * (SECONDS + 5)):
            for number, car in enumerate(road.vehicles):
                name, (x, y) = f"npc{number - 1}" if number else "ego", car.position.tolist()
                row = [tick / HZ, name, x, -y, -car.heading, car.speed, car.lane_index[2], car.LENGTH, car.WIDTH]
                table.writerow(row)
            road.act()
            road.step(1 / HZ)
    return pafot.recorded(path)


def distances_as_recorded(recording: pafot.Recording) -> list[float]:
    """Return how far each NPC that drives as recorded is from its track at most, until it leaves it [m]."""
    scenario, ego = recording.scenario(at=BEGIN, seconds=SECONDS), recording.vehicle("ego").at(BEGIN)[0]
    nearest = sorted(recording.vehicles, key=lambda each: abs(each.at(BEGIN)[0, X] - ego[X]))[1:]
    world = pafot.Highway(lanes=4, speed_limit=36.3, duration=float(SECONDS))
    trace, found = world.rollout(scenario, lambda: lambda seen: (0.0, 0.0)), []
    begin = trace.states[0, 0, [X, Y]]
    for npc, vehicle in enumerate(nearest[: len(scenario.npcs)]):
        until = trace.ticks if trace.handed_over[npc] is None else trace.handed_over[npc]
        track = vehicle.at(BEGIN + trace.times[: until + 1])[:, [X, Y]] - ego[[X, Y]]
        missed = trace.states[: until + 1, npc + 1, [X, Y]] - begin - track
        found.append(float(np.hypot(*missed.T).max()))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, default=8)
    parser.add_argument("--scenarios", type=Path)
    parser.add_argument("--vehicles", type=Path, nargs="*", default=[])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        paths = [(seed, Path(folder) / f"{seed}.csv") for seed in range(arguments.recordings)]
        recordings = [recorded_traffic(seed, path) for seed, path in paths]
    found = [each for recording in recordings for each in distances_as_recorded(recording)]
    shares = ", ".join(f"{share:.0%}: {np.quantile(found, share):.2f} m" for share in (0.5, 0.75, 0.9, 1.0))
    sys.stdout.write(f"{len(found)} tracks, farthest at any moment: {shares}\n")
    reasons: Counter[str] = Counter()
    for path in sorted(arguments.scenarios.rglob("*.xosc")) if arguments.scenarios else ():
        try:
            pafot.recorded(path, vehicles=arguments.vehicles)
            reasons["read"] += 1
        except RecordingError as error:
            reasons[re.sub(r"-?\d[\d.]*|'.*'", "..", error.received)[:80]] += 1
    for reason, count in reasons.most_common():
        sys.stdout.write(f"{count:4} {reason}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
