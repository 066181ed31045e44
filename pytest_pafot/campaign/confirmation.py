"""Whether a find is what it seems: the same run once more, and once by other means."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from pytest_pafot.campaign.harness import is_same_run
from pytest_pafot.execution.worker_pool import ProcessLostError
from pytest_pafot.findings.finding import message_of
from pytest_pafot.findings.replay import disagreement
from pytest_pafot.run import Run
from pytest_pafot.world.driving.failure import UNFIT, let_through

if TYPE_CHECKING:
    from pytest_pafot.scenario import Scenario

NOT_REPEATED = "running it again gave another run"


def difference(run: Run, again: Callable[[Scenario], Run], elsewhere: Callable[[Scenario], Run | None]) -> str:
    """What differs when a scenario is run again; empty where the find is confirmed.

    Args:
        run: that is a find.
        again: the same means; the run must be equal to the last bit.
        elsewhere: highway-env's own environment, or None; the run must end in the same way.
    """
    try:
        if not is_same_run(run, again(run.scenario)):
            return NOT_REPEATED
        other = _seen_elsewhere(run, elsewhere)
    except ProcessLostError as error:
        return f"the process that ran it again {error.lost.how}"
    differs = other if isinstance(other, str) else "" if other is None else disagreement(run, other)
    return f"in highway-env's own environment: {differs}" if differs else ""


def _seen_elsewhere(run: Run, elsewhere: Callable[[Scenario], Run | None]) -> Run | str | None:
    """The run there, or what was raised instead."""
    try:
        return elsewhere(run.scenario)
    except ProcessLostError:
        raise
    except UNFIT as error:  # whatever an environment or an ADS raises there is what differs
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
