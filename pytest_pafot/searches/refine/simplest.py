"""The simplest scenario that reproduces a finding's failure."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.findings.finding import RUNS, FailureRate, signature_of_failure, with_other_seed
from pytest_pafot.findings.shrink import (
    Ahead,
    Attempt,
    Likely,
    OutOfBudget,
    Shown,
    Shrunk,
    Start,
    shrink,
)
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import Failure, Signature, Verdict, severity_of
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import SPEED, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.bench import Bench
from pytest_pafot.searches.events import Phase, Refining
from pytest_pafot.searches.harness import Harness
from pytest_pafot.searches.results import State
from pytest_pafot.searches.store import Store, record_death
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.driving.policy import repeat_action
from pytest_pafot.world.guard.hang_guard import runs_end_in


def showing(
    sighting: Seen,
    scenario: Scenario,
    state: State,
    bench: Bench,
    store: Store,
    most: int | None = None,
) -> Refining[Run | None]:
    """Run a scenario, and return the run if it reproduces the failure within ``most`` decisions."""
    __tracebackhide__ = True
    # It would end another process, and shows nothing about this failure.
    if scenario in state.fatal:
        return None
    try:
        bench.harness.world.check_fits(scenario)
        run = bench.run(scenario, most=most)
        if most is not None and len(run.trace.actions) >= most:  # the limit ended the run
            bench.record.clear()
            return None
        if not shows(sighting, run, bench.finish(run, without_unreached_genes(run)), state, bench):
            return None
    # For example, the ego starts in an outer lane, where there are too few cells.
    except ScenarioError:
        return None
    except ProcessLostError as error:
        yield from record_death(bench.died(error), state, store)
        return None
    return run


def shows(sighting: Seen, run: Run, verdict: Verdict, state: State, bench: Bench) -> bool:
    """Return whether a run reproduces a finding's failure, with the same fault and responsibility."""
    shown = bench.examiner.signature_of(run, verdict)
    # Shrinking must not slip to another failure, which has a finding of its own.
    if shown is None or not is_same(shown, found_as(sighting, state)):
        return False
    return shown.is_property or run.attribution.responsibility == sighting.responsible


def found_as(sighting: Seen, state: State) -> Signature:
    """Return the signature that a finding had before shrinking."""
    return next(signature for signature, id_ in state.finds.items() if id_ == sighting.id)


def is_same(shown: Signature, found: Signature) -> bool:
    """Return whether two failures are the same and have the same fault."""
    return (shown, shown.fault) == (found, found.fault)


def without_unreached_genes(run: Run) -> Scenario:
    """Return the scenario of a run without the genes that the run did not reach."""
    scenario = run.scenario
    return scenario.truncated(
        max(1, min(scenario.genes, int(run.duration / scenario.gene_seconds - 1e-9) + 1))
    )


def announce(ahead: Ahead, state: State, bench: Bench) -> None:
    """Announce the next scenarios to other processes, which can run them in advance."""
    # With one process, running a candidate in advance only wastes it if it is not needed.
    if bench.harness.request.settings.workers < 2:
        return
    # A process would report an unfit candidate as an error of the world.
    fitting = list[Scenario]()
    for each in ahead.candidates:
        with suppress(ScenarioError):
            bench.harness.world.check_fits(each)
            fitting.append(each)
    bench.runner.expect([each for each in fitting if each not in state.fatal], more=ahead.more)


def failure_rate(
    sighting: Seen, scenario: Scenario, state: State, bench: Bench
) -> Refining[FailureRate]:
    """Measure how often the policy fails in a scenario, with different seeds unless the finding is flaky."""
    yield Phase(f"measuring how often {sighting.id} fails", sighting.id)
    # Counted over a fixed number of runs, so that rates of different days can be compared.
    failing = 0
    for number in range(1, RUNS + 1):
        bench.budget.check()
        state.shrink_runs += 1
        repeated = scenario
        if not sighting.is_flaky:
            repeated = with_other_seed(scenario, number)
        failing += bench.finish(bench.run(repeated)).failed
    return FailureRate(failing=failing)


# The largest numbers of runs to shrink one finding, by default. The larger one is for an ADS that is a vehicle class of
# highway-env, which the kernel runs quickly.
ROLLOUTS, ROLLOUTS_IN_KERNEL = 300, 3000

# A candidate must collide at most this much later than the simplest failing scenario so far [s]. Without this limit, a
# candidate that does not fail would run to its end. Of 950 candidates that failed without the limit, 8 collided later,
# and all runs together had a third more decisions.
LATER = 2.0

# The approximate time for the work after shrinking, except confirmation, as a number of runs. One run is for the
# verdict on the shrunk scenario. The others are for the careful driver who takes over. They are fast, because the ADS
# is not called.
RUNS_TO_CONCLUDE = 3


@dataclass(slots=True, kw_only=True)
class Turn:
    """The time and the number of decisions that are available to shrink one finding."""

    end: float  # time at which the turn ends [s], or infinity
    most: float  # number of decisions, for all work on findings so far, at which the turn ends
    to_confirm: int = 0  # number of decisions in a run of the simplest failing scenario so far
    to_conclude: float = 0.0  # estimated time of the work after shrinking [s]
    attempts: int = 0  # number of attempts to shrink so far
    seconds: float = 0.0  # time that the attempts have taken [s]
    is_over: bool = False  # True if shrinking stopped because no time, or no decision, was left

    def check(self, now: float, bench: Bench) -> None:
        """Raise OutOfBudget, now and in later calls, if too little is left for another attempt."""
        # The next attempt is expected to take as long as the earlier ones did on average.
        mean = self.seconds / max(self.attempts, 1)
        # An attempt takes about as many decisions as the simplest failing run. The work after shrinking takes some,
        # too.
        budget = bench.budget
        is_at_limit = budget.asked + (1 + RUNS_TO_CONCLUDE) * self.to_confirm > self.most
        budget.is_at_limit |= is_at_limit
        self.is_over = self.is_over or is_at_limit or now + mean + self.to_conclude >= self.end
        if self.is_over:
            raise OutOfBudget

    def took(self, seconds: float, confirming: float | None) -> None:
        """Record how long [s] an attempt took, including its confirmation if it succeeded."""
        # Failed attempts take time, too, and are most of them.
        self.attempts += 1
        self.seconds += seconds
        if confirming is not None:
            # This is the simplest failure so far, which two runs confirm. If another process ran the attempt in
            # advance, it took no time here.
            self.to_conclude = RUNS_TO_CONCLUDE * max(seconds, confirming / 2) + confirming


@dataclass(frozen=True, slots=True, kw_only=True)
class Simplest:
    """The simplest scenario that reproduces a finding's failure."""

    scenario: Scenario  # the scenario as executed
    shrunk: Shrunk  # statistics of shrinking
    # How often this scenario fails; None if its failure is not random, or if that is not yet known.
    rate: FailureRate | None = None
    is_cut: bool = False  # True if no time, or no decision, was left for more attempts


def simplest_of(
    sighting: Seen, original: Scenario, state: State, bench: Bench, store: Store, turn: Turn
) -> Refining[Simplest]:
    """Shrink a finding's scenario within the limits of its turn."""
    __tracebackhide__ = True
    harness, space, id_ = bench.harness, state.space, sighting.id
    rollouts, top_speed = rollouts_for(harness), harness.world.speed_limit
    repeats = _repeats_collision(sighting, harness)
    # The ego's actions in failing scenarios.
    actions: dict[Scenario, tuple[Any, ...]] = {}
    if sighting.run is not None:
        actions[without_unreached_genes(sighting.run)] = sighting.run.trace.actions
    turn.to_confirm = max(map(len, actions.values()), default=0)

    def actions_in(scenario: Scenario) -> tuple[Any, ...]:
        # The scenario failed in another process, so its actions are not here yet.
        if scenario not in actions:
            actions[scenario] = bench.rerun(scenario).trace.actions
        return actions[scenario]

    def attempt(candidate: Scenario, best: Scenario) -> Refining[Shown]:
        began = bench.clock()
        # Before the run, because a run that the limit cuts short shows nothing.
        turn.check(began, bench)
        yield Phase(f"simplifying {id_}, run {turn.attempts + 1} of {rollouts}", id_)
        most = None
        try:
            with runs_end_in(turn.end - turn.to_conclude - began):
                if repeats is not None:  # the number of decisions within which it must fail
                    most = len(actions_in(best)) + round(LATER * repeats.ads_hz)
                run = yield from showing(sighting, candidate, state, bench, store, most)
        except OutOfTime:
            turn.is_over = True
            raise OutOfBudget from None
        state.shrink_runs += 1
        if run is None:
            turn.took(bench.clock() - began, None)
            return None
        # What the run did not reach cannot matter, and a shorter scenario is simpler.
        scenario = without_unreached_genes(run)
        actions[scenario] = run.trace.actions
        turn.to_confirm = len(run.trace.actions)
        turn.took(
            bench.clock() - began, bench.pace * min(scenario.seconds, harness.world.longest_run)
        )
        return scenario, starts_of(run, top_speed)

    # This is the result if the user allows no attempts.
    scenario, shrunk = original, Shrunk(rollouts=0, is_minimal=False)
    if rollouts:
        is_likely = None if repeats is None else _likely(sighting, turn, state, bench, actions_in)
        asking = shrink(
            original,
            rollouts=rollouts,
            top_speed=top_speed,
            plain=None if space is None else (space.ego_lane, space.ego_speed),  # the default start
            plain_seconds=None if space is None else space.gene_seconds,
            ahead=harness.request.settings.workers,
            asks_likely=is_likely is not None,
        )
        try:
            # The shrinker only decides what to try. This loop runs it, so that progress can be reported
            # in between.
            question = next(asking)
            while True:
                reply: Shown | bool = None
                try:
                    match question:
                        case Attempt(candidate, best):
                            reply = yield from attempt(candidate, best)
                        case Likely(candidate, simplest) if is_likely is not None:
                            reply = is_likely(candidate, simplest)
                        case Ahead():
                            announce(question, state, bench)
                # The shrinker must hear of it, because it returns the best scenario so far.
                except OutOfBudget as over:
                    question = asking.throw(over)
                else:
                    question = asking.send(reply)
        except StopIteration as done:
            scenario, shrunk = done.value
    return Simplest(scenario=scenario, shrunk=shrunk, is_cut=turn.is_over)


def _repeats_collision(sighting: Seen, harness: Harness) -> Trace | None:
    # Return the run of a finding if its recorded decisions repeat the collision without the ADS.
    if sighting.run is None or sighting.is_flaky or sighting.finding.rate is not None:
        return None
    trace = sighting.run.trace
    has_collision = trace.collision is not None and trace.actions
    return trace if has_collision else None


def _likely(
    sighting: Seen,
    turn: Turn,
    state: State,
    bench: Bench,
    actions_in: Callable[[Scenario], tuple[Any, ...]],
) -> Callable[[Scenario, Scenario], bool] | None:
    # Return a function that states whether a small scenario is likely to fail: an ego that repeats the decisions of a
    # failing scenario collides in the same way. That was the case in 27 of 35 small scenarios that failed, and in 225
    # of 4,333 that did not. Return None if the world's `rollout` does not accept decisions. All small scenarios are
    # then run.
    harness, found = bench.harness, found_as(sighting, state)
    if not harness.world.is_resumable:
        return None
    failure = Failure(kind=found.failure, assertion=found.assertion)
    # it accepts decisions, because the world is resumable
    rollout: Callable[..., Trace] = harness.world.rollout

    @cache
    def likely(candidate: Scenario, best: Scenario) -> bool:
        try:
            did = actions_in(best)
        except OutOfTime:
            turn.is_over = True
            raise OutOfBudget from None
        try:
            trace = rollout(candidate, repeat_action(did[-1]), decisions=did)
        except ScenarioError:
            return False
        if trace.collision is None:
            return False
        run = harness.run_of(trace)
        return is_same(
            bench.examiner.beside_accepted(
                signature_of_failure(run, failure), severity_of(run, failure)
            ),
            found,
        )

    return likely


def rollouts_for(harness: Harness) -> int:
    """Return the largest number of runs that may be used to shrink one finding."""
    given = harness.request.settings.shrink_runs
    if given is not None:
        return given
    return ROLLOUTS_IN_KERNEL if harness.world.runs_in_kernel(harness.policy.factory) else ROLLOUTS


def starts_of(run: Run, top_speed: float) -> tuple[Start, ...]:
    """Return the ego's lane and speed [m/s] at the start of each gene in a run, if the road is straight."""
    trace = run.trace
    begins = slice(None, trace.ticks, round(run.scenario.gene_seconds * trace.physics_hz))
    speeds, lanes = trace.ego[begins, SPEED], trace.road.numbers(0)[begins]
    if (lanes < 0).any():
        # the ego left the road, or the road is not straight, so that a later start would be elsewhere on it
        return ()
    return tuple(
        (int(lane), float(min(max(round(speed, 1), 0.0), top_speed)))
        for lane, speed in zip(lanes, speeds, strict=True)
    )
