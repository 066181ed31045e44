"""Built-in properties: common requirements for a driving policy, as functions to call in a test.

For example::

    @pafot.search(blame="ego")
    def test_drives_well(run):
        pafot.properties.comfort(run)

Each property except :func:`no_fault` is a check with a name and a margin. A property that does not apply to a run
records no check. *Second hand* marks sources that we know only from quotations. Numbers without a source are our
choices.
"""

from __future__ import annotations

import numpy as np

from pytest_pafot.attribution.responsibility import DISTANCES
from pytest_pafot.criticality import RoadFrame, RssRules
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.oracle.run import Run, check, require
from pytest_pafot.support.errors import checked_number

__all__ = ["comfort", "no_fault", "rss_distance", "stays_on_road"]

__tracebackhide__ = True  # pytest hides these frames, so a traceback ends in the test function

# The scale for margins of gaps to other vehicles [m].
NEAR = 10.0


def no_fault(run: Run) -> None:
    """Assert that the ego is not responsible for a collision, neither alone nor together with an NPC.

    The rules in docs/explanation/verdicts.md decide who is responsible. There is no margin.
    """
    is_free = run.responsibility not in ("ego", "both")
    require(is_free, "run.responsibility not in ('ego', 'both')", run.explain)


def rss_distance(run: Run, *, rules: RssRules = DISTANCES) -> None:
    """Check that the ego keeps the safe distance of Responsibility-Sensitive Safety to NPCs ahead and alongside.

    The value is the gap to the worst NPC minus the safe distance [m]. It must be at least 0. NPCs behind the ego do
    not count. Crossing NPCs count while they are on the ego's path.

    Source: Shalev-Shwartz and others, arXiv:1708.06374 (cited from a secondary source). By default, a gap of two
    seconds is enough behind a leader at the same speed, up to 48 m/s (our choice).
    ``pytest_pafot.criticality.RssRules()`` has Intel's parameters.
    """
    if not isinstance(rules, RssRules):
        raise TypeError(
            f"rss_distance: expected rules=criticality.RssRules(...), received {rules!r:.80}"
        )
    # Side by side, the gap across the road counts. For an NPC ahead, the gap along it counts unless it is safe across.
    frame = RoadFrame(run.trace)
    is_beside = frame.gap_along <= 0
    along = frame.gap_along - frame.safe_along(rules)
    across = frame.gap_across - frame.safe_across(rules)
    beyond = np.where(across < 0, along, np.maximum(along, across))
    beyond = np.where(is_beside, across, beyond).T
    is_judged = (~(frame.ahead < 0) | is_beside.T) & frame.is_on_way
    values = np.where(is_judged, beyond, np.inf)
    if values.size and not np.isposinf(values).all():
        worst = np.where(np.isnan(values), -np.inf, values).min(axis=1)
        npc = int(worst.argmin())
        check(
            values.min(axis=0),
            name="gap minus safe distance",
            at_least=0.0,
            unit="m",
            npc=npc,
            scale=NEAR,
        )


def comfort(
    run: Run,
    *,
    jerk: float | None = 2.5,
    braking: float | None = 3.5,
    lateral_acceleration: float | None = 3.0,
    lateral_jerk: float | None = 5.0,
) -> None:
    """Check that the ride is comfortable, even in bends and when braking for other vehicles.

    Four moving averages are limited: the jerk over 1 s [m/s^3], the deceleration over 2 s [m/s^2], and the
    lateral acceleration [m/s^2] and lateral jerk [m/s^3] over 0.5 s. None disables a limit.

    Sources: ISO 15622:2018, above 20 m/s, and for the lateral limits UN R79, 5.6.2.1.3 (both second hand). ISO 15622
    limits the jerk only while braking. In UN R79, only the lateral jerk is an average.
    """
    asked = {
        "jerk": jerk,
        "braking": braking,
        "lateral_acceleration": lateral_acceleration,
        "lateral_jerk": lateral_jerk,
    }
    for name, most in asked.items():
        if most is not None:
            checked_number(most, "comfort", f"{name} to be a finite number, at least 0", least=0.0)
    ego = run.ego
    hz = run.trace.physics_hz
    if jerk is not None:
        mean = _change(ego.acceleration, 1.0, hz)
        check(abs(mean), name="jerk", at_most=jerk, unit="m/s^3")
    if braking is not None:
        mean = _change(ego.speed, 2.0, hz)
        check(-mean, name="braking", at_most=braking, unit="m/s^2")
    if lateral_acceleration is not None:
        mean = _change(np.cumsum(ego.lateral_acceleration) / hz, 0.5, hz)
        check(abs(mean), name="lateral acceleration", at_most=lateral_acceleration, unit="m/s^2")
    if lateral_jerk is not None:
        mean = _change(ego.lateral_acceleration, 0.5, hz)
        check(abs(mean), name="lateral jerk", at_most=lateral_jerk, unit="m/s^3")


def stays_on_road(run: Run) -> None:
    """Check that the ego's centre stays on the road: its distance to the nearer edge [m] is at least 0.

    On curved roads, the value is half the lane width whenever the ego is on a lane.
    """
    check(run.trace.road.to_edge(), name="road edge", at_least=0.0, unit="m")


def _change(values: FloatArray, seconds: float, hz: float) -> FloatArray:
    # The mean change per second, in the seconds before each tick. Before its first tick, the signal is constant.
    ticks = round(seconds * hz)
    constant = np.full(ticks, values[0])
    before = np.concatenate((constant, values))[: len(values)]
    # ticks / hz and not seconds, since half a second is not a whole number of ticks at 15 Hz
    change: FloatArray = (values - before) / (ticks / hz)
    return change
