"""The runs with which findings are refined: of other scenarios, with other seeds, and what they show."""

from __future__ import annotations

from contextlib import suppress

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Phase, Refining
from pytest_pafot.campaign.state import State, lose
from pytest_pafot.campaign.store import Store
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.findings.failure_rate import RUNS, FailureRate, with_other_seed
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.shrink import Ahead, OutOfBudget
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.signature import Signature
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import OutOfTime


def showing(
    sighting: Seen, scenario: Scenario, state: State, bench: Bench, store: Store, most: int | None = None
) -> Refining[Run | None]:
    """Run a scenario; return the run if it shows the failure of a finding in fewer than ``most`` decisions."""
    __tracebackhide__ = True
    if scenario in state.fatal:
        return None
    try:
        bench.harness.world.check_fits(scenario)
        run = bench.run(scenario, announced=True, most=most)
        if most is not None and len(run.trace.actions) >= most:  # what ended it is no failure of the ADS
            bench.record.clear()
            return None
        if not shows(sighting, run, bench.finish(run, driven(run)), state):
            return None
    except ScenarioError:  # For example, it begins in an outer lane, next to which there are too few cells.
        return None
    except ProcessLostError as error:
        yield from lose(error, state, bench, store)
        return None
    return run


def shows(sighting: Seen, run: Run, verdict: Verdict, state: State) -> bool:
    """Return whether a run shows the failure of a finding, and by the same fault, so its name still fits."""
    shown = of_failure(run, verdict.failure) if verdict.failed and verdict.failure is not None else None
    return shown is not None and is_same(shown, signature_of(sighting, state))


def signature_of(sighting: Seen, state: State) -> Signature:
    """Return the signature that a finding had when it was found."""
    return next(signature for signature, id_ in state.finds.items() if id_ == sighting.id)


def is_same(shown: Signature, found: Signature) -> bool:
    """Return whether two failures are the same, by the same fault."""
    return (shown, shown.fault) == (found, found.fault)


def driven(run: Run) -> Scenario:
    """Return the scenario of a run without the genes that the run did not reach. The run stays the same."""
    scenario = run.scenario
    return scenario.truncated(max(1, min(scenario.genes, int(run.duration / scenario.gene_seconds - 1e-9) + 1)))


def announce(ahead: Ahead, state: State, bench: Bench) -> None:
    """Let scenarios be run in advance, if they can be run at all, and if more than one is run at the same time."""
    if bench.harness.request.settings.workers < 2:
        return
    fitting = list[Scenario]()
    for each in ahead.candidates:
        with suppress(ScenarioError):
            bench.harness.world.check_fits(each)
            fitting.append(each)
    bench.runner.announce([each for each in fitting if each not in state.fatal], more=ahead.more)


def check_limits(bench: Bench) -> None:
    """Raise OutOfTime if the time for the work on findings is over, and OutOfBudget if its decisions are used up."""
    if bench.clock() >= bench.refining_end:
        raise OutOfTime
    if bench.asked >= bench.refining_most:
        bench.is_at_limit = True
        raise OutOfBudget


def failure_rate(sighting: Seen, scenario: Scenario, state: State, bench: Bench) -> Refining[FailureRate]:
    """Return how often the policy fails in a scenario of a finding, with other seeds, or again and again if flaky."""
    yield Phase(f"measuring how often {sighting.id} fails", sighting.id)
    failing = 0
    for number in range(1, RUNS + 1):
        check_limits(bench)
        state.shrink_runs += 1
        failing += bench.finish(bench.run(scenario if sighting.is_flaky else with_other_seed(scenario, number))).failed
    return FailureRate(failing=failing)
