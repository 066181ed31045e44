"""The excuse "too little time to respond", put to the test: a driver takes over at that time, in simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_pafot.attribution.last_chance import FREE_FOR, UNSAID, TakeOver, drivers_of, relief_of, repeats
from pytest_pafot.attribution.needless_braking import braking
from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.attribution.sentences import BRAKES, What, escape_sentences
from pytest_pafot.model.trace import Outcome, Trace


@dataclass(frozen=True, slots=True, kw_only=True)
class Escape:
    """A driver took over and avoided a collision for which the rules left the ego too little time.

    Attributes:
        time: time of the ego's decision at which the driver takes over [s], to milliseconds.
        driver: name of the reference driver.
        braking: the driver's hardest deceleration until the time of the impact [m/s^2], to three digits.
        braking_from: time at which the driver begins to brake [s]; ``time`` if it does not brake.
        due: time from which on the rules require braking [s].
        required: deceleration that the rules require unless there is an emergency [m/s^2].
    """

    time: float
    driver: str
    braking: float
    braking_from: float
    due: float
    required: float

    @property
    def sentences(self) -> tuple[str, ...]:
        """The sentences that say what the driver does, and in what the rules require less."""
        return escape_sentences(self.time, self.driver, self.braking, self.braking_from, self.due, self.required)


def escape(trace: Trace, take_over: TakeOver) -> Escape | None:
    """Return how a driver avoids a collision for which the rules left the ego too little time.

    The driver takes over at the ego's last decision up to the time that the verdict names. It avoids the collision if
    it touches no vehicle in the 12 s after that, or until the end of the run, and no two NPCs touch.

    Args:
        trace: trace of the run.
        take_over: function that simulates the run again with a driver that takes over, see
            :meth:`pytest_pafot.world.built_in.BuiltInWorld.take_over`.

    Returns:
        The escape; None if the verdict is a different one, if the driver does not avoid the collision, and if a
        repetition of the run differs from the trace.
    """
    facts = rss_rule(trace).facts
    excuse = next((fact for fact in facts if fact.what is What.HAD_NO_TIME and fact.vehicle == 0), None)
    driver = relief_of(drivers_of(take_over))
    if excuse is None or excuse.due_s is None or driver is None:
        return None
    hz, every = trace.physics_hz, trace.physics_hz // trace.ads_hz
    tick = min(round(excuse.time_s * hz), trace.ticks - 1) // every * every
    taken = take_over(trace, tick, driver)
    if not repeats(taken, trace, tick):
        return None
    has_ended = taken.outcome in (Outcome.COLLISION, *UNSAID)
    if taken.ticks < trace.ticks or (has_ended and taken.ticks <= tick + FREE_FOR * hz):
        return None
    slowed = braking(taken)[tick + 1 : trace.ticks + 1]
    brakes = np.flatnonzero(slowed >= BRAKES)
    begins = tick + int(brakes[0]) if brakes.size else tick
    return Escape(
        time=round(tick / hz, 3),
        driver=driver,
        braking=round(float(slowed.max()), 3) if brakes.size else 0.0,
        braking_from=round(begins / hz, 3),
        due=round(excuse.due_s, 3),
        required=excuse.braking_m_per_s2,
    )
