"""What it takes to drive a recorded run again up to a tick, and to have a reference driver take over the ego there."""

from __future__ import annotations

from dataclasses import dataclass

from pytest_pafot.trace import Trace
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.reference_drivers import ReferenceDriver

WATCHED = 6.0
"""For how long a driver has watched when it takes over [s]: long enough to have noticed whatever there is."""


class RecordedBody(Body):
    """The ego of a run, in the states that were recorded up to a tick, whatever its controls are; then it drives.

    What it did is recorded again to the bit, which decisions that are given again allow for planners only.
    """

    def __init__(self, trace: Trace, tick: int) -> None:
        super().__init__(*trace.sizes[0])
        self._rows = iter(trace.ego[1 : tick + 1].tolist())

    def step(self, dt: float) -> None:
        """Where it was at the next tick; from the last recorded one on, as any body."""
        row = next(self._rows, None)
        if row is None:
            super().step(dt)
            return
        self.place(*row[:4])
        self.acceleration, self.steering = row[4:6]


@dataclass(slots=True)
class Relief:
    """A reference driver that takes over at a time [s], having watched; before, what it returns has no effect."""

    driver: ReferenceDriver
    time: float

    def __call__(self, observation: Observation) -> tuple[float, float]:
        """Acceleration [m/s^2] and steering [rad]."""
        if observation.time >= self.time:
            return self.driver(observation)
        if observation.time >= self.time - WATCHED:
            self.driver.watch(observation)
        return 0.0, 0.0
