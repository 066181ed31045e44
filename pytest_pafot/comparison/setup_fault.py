"""A fault of the set-up: the ADS fails alike at its first decision in all runs, which says nothing of any algorithm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pytest_pafot.comparison.plan import PlanError
from pytest_pafot.findings.finding import first_decision_cause
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import AdsError
from pytest_pafot.world.driving.ads import is_vehicle_class
from pytest_pafot.world.protocol import WorldLike, first_decision


def check_set_up(
    world: WorldLike, factory: Callable[..., Any], scenario: Scenario, errors: Sequence[AdsError | None]
) -> None:
    """Check that an ADS drives at all.

    Args:
        world: in which it drives.
        factory: of the ADS.
        scenario: one of the first generation.
        errors: of the ADS in each run of that generation.

    Raises:
        PlanError: where one cause made it fail at its first decision in all of them.
    """
    causes = {first_decision_cause(error) for error in errors}
    error = errors[0]
    if error is None or len(causes) > 1 or None in causes:
        return
    place = error.traceback.rfind("  File ")
    where = f"\n{error.traceback[place:].rstrip()}" if place >= 0 else ""
    given = "" if is_vehicle_class(factory) else _given_in(world, scenario)
    raise PlanError(
        f"--ads: expected a policy that drives, received {error.kind}: {error.message}{where}\n\n"
        f"So it was in all {len(errors)} runs of the first generation, before anything had happened in them: an error "
        "of the set-up, which says nothing of the algorithms. Correct the ADS, its factory, or the world that it "
        f"drives in (--env and the options after it), and run the command again.\n\n{given}".rstrip()
    )


def _given_in(world: WorldLike, scenario: Scenario) -> str:
    asked = first_decision(world, scenario)
    if asked is None:
        return ""
    if asked.is_si:
        return f"{asked.text} A policy of a highway-env environment needs that environment, such as --env highway-v0."
    return (
        f"{asked.text} The environment has its own configuration here, and no other config=; a planner in SI units "
        "needs the road that is there without --env."
    )
