"""Whether a find is what it seems: the same run once more, and once by other means."""

from __future__ import annotations

from pytest_pafot.campaign.harness import Simulation, is_same_run
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.findings.finding import message_of
from pytest_pafot.findings.replay import disagreement
from pytest_pafot.run import Run
from pytest_pafot.world.driving.failure import UNFIT, let_through

NOT_REPEATED = "running it again gave another run"


def difference(run: Run, simulation: Simulation) -> str:
    """What differs when a scenario is run again; empty where the find is confirmed.

    The same means must give a run that is equal to the last bit; highway-env's own environment, in a world that has
    one, must end the run in the same way.
    """
    try:
        if not is_same_run(run, simulation.rerun(run.scenario)):
            return NOT_REPEATED
        differs = _difference_in_gym(run, simulation)
    except ProcessLostError as error:
        return f"the process that ran it again {error.how}"
    return f"in highway-env's own environment: {differs}" if differs else ""


def _difference_in_gym(run: Run, simulation: Simulation) -> str:
    try:
        other = simulation.rerun_in_gym(run.scenario)
    except ProcessLostError:
        raise
    except UNFIT as error:  # whatever an environment or an ADS raises there is what differs
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
    return "" if other is None else disagreement(run, other)
