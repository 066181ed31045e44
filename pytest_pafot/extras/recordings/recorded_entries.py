"""The scenarios of a recording as entries of the catalogue, so that ``@pafot.catalogue`` makes a test of each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytest_pafot import Highway, Scenario, Track
from pytest_pafot.extending import RequestError
from pytest_pafot.extras.sweeps.entries import FASTEST, Entry, NoPlaceError, Parameter

LEAST_SEEN = 5.0
"""The shortest time for which a vehicle must be seen to be the ego of a test, unless it is named [s]."""
LANES = (3, 6)
"""The smallest and the largest number of lanes of a highway."""
SECONDS = Parameter(20.0, 1.0, (Track.most - 1) / 10, "s", "how long the others follow their tracks")


class RecordedEntry(Entry):
    """A recording with one of its vehicles as the ego."""

    __slots__ = ()

    def world(self, world: Any = None) -> Any:
        """Return a world, by default a highway with as many lanes as the recorded vehicles use."""
        if world is not None:
            return Entry.world(self, world)
        try:
            scenario = self.scenario(Highway())
        except NoPlaceError:
            return Entry.world(self)  # nothing will be driven
        beside = [float(each[0].track.states[:, 1].max()) for each in scenario.npcs]  # type: ignore[attr-defined]
        lanes = scenario.ego_lane + 1 + round(max([0.0, *beside]) / Track.lane_width)
        return Highway(lanes=min(max(lanes, LANES[0]), LANES[1]), speed_limit=FASTEST, duration=self.seconds)


def entries_of(recording: Any) -> tuple[RecordedEntry, ...]:
    """Return an entry for the ego of a ``Recording``, or else for each vehicle that is seen for five seconds.

    Raises:
        RequestError: if there is no such vehicle, so that nothing would be tested.
    """
    told = [recording.vehicle(recording.ego)] if recording.ego else recording.vehicles
    egos = [each.name for each in told if recording.ego or each.times[-1] - each.times[0] >= LEAST_SEEN]
    if not egos:
        raise RequestError(
            f"{recording.source}: expected a vehicle that is seen for {LEAST_SEEN:g} s or more, in whose place the "
            f"policy drives; received {len(told)}, each of them for less; name one with ego="
        )
    name = Path(recording.source).stem

    def entry(ego: str) -> RecordedEntry:
        def make(values: Mapping[str, float], world: Any) -> Scenario:
            try:
                scenario: Scenario = recording.scenario(ego, seconds=values["seconds"])
            except RequestError as error:  # its vehicle meets nobody, or drives round a bend
                raise NoPlaceError(str(error)) from None
            return scenario

        return RecordedEntry(
            name=f"{name}/{ego}",
            about=f"The vehicles around {ego} drive as recorded.",
            source=recording.source,
            parameters={"seconds": SECONDS},
            make=make,
        )

    return tuple(map(entry, egos))
