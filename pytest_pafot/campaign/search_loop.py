"""The loop of a search: it runs and evaluates scenarios, and records every distinct finding at once."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from pytest_pafot.attribution.mistakes import mistake_of
from pytest_pafot.campaign.events import Judged, Listener
from pytest_pafot.campaign.harness import Simulation
from pytest_pafot.campaign.recorder import Recorder
from pytest_pafot.campaign.setup_fault import FirstGeneration, unit_doubt
from pytest_pafot.campaign.verdict import worst_margins
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import LostRun, expectation
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.signature import CHECK_FAILED, Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching import events
from pytest_pafot.searching.evaluation import Evaluation, interaction_of
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support.text import plural
from pytest_pafot.world.guard.hang_guard import runs_end_in

# Values that a search reads from every run. They are read in the process that made the run, to relieve this one.

FITNESS = "fitness"
"""The name under which a trace stores its fitness."""


def read_ahead(fitness: Callable[[Trace], float] | None, trace: Trace) -> None:
    """Compute the values of a trace that the search will need, in the process that made the trace, which stores them.

    ``fitness`` is None if the user's own function computes it, which runs only in the main process.
    """
    trace.reading("interaction", interaction_of)
    unit_doubt(trace)
    mistake_of(trace)
    if fitness is not None:
        trace.reading(FITNESS, fitness)


@dataclass(slots=True, kw_only=True)
class SearchLoop:
    """A search in progress, with everything that it has seen so far."""

    simulation: Simulation
    recorder: Recorder
    fitness: Callable[[Trace], float]  # the fitness of a trace; higher is worse for the ego
    space: SearchSpace | None = None  # the space from which scenarios are sampled; None for replays only
    listener: Listener = lambda event: None
    is_steered_by_checks: bool = True  # True if margins of checks are objectives, in addition to the fitness
    seconds_left: Callable[[], float] = lambda: math.inf  # the time after which a run ends between decisions [s]
    fatal: set[Scenario] = field(default_factory=set)  # scenarios in which a process died; they are not run
    shown: Mapping[Signature, str] = field(default_factory=dict)  # ids of saved scenarios by the failure they show now
    finds: dict[Signature, str] = field(default_factory=dict)  # ids of new findings by signature
    repeats: Counter[str] = field(default_factory=Counter)  # number of other runs that show a new finding, by id
    known: Counter[str] = field(default_factory=Counter)  # number of failing runs by the file that covers them
    verdicts: Counter[str] = field(default_factory=Counter)  # number of verdicts by kind
    caught: Counter[str] = field(default_factory=Counter)  # number of passed runs by a check that failed in them
    counted: Health = field(default_factory=Health)  # health of the evaluations that were counted
    uncounted: list[events.Evaluated] = field(default_factory=list)
    generation: int = 0  # generation of the main search, from 0
    finished: events.CampaignFinished | None = None  # the last event, once the campaign is over
    skip: BaseException | None = None  # the last skip of the test function
    first: FirstGeneration = field(default_factory=FirstGeneration)
    doubt: str = ""  # a doubt about the units of the ADS's actions, if any
    # how the reference itself failed in all its runs so far; empty if it did not in one of them, None before the first
    broken: str | None = None

    @property
    def runs(self) -> int:
        """The number of scenarios that were simulated so far."""
        return self.verdicts.total()

    @property
    def health(self) -> Health:
        """The figures that say whether the search tested anything."""
        self.count()
        return self.counted

    @property
    def known_alone(self) -> str:
        """A note if all failures so far are known failures of checks; empty if nothing or anything else failed."""
        checks = {id_ for signature, id_ in self.shown.items() if signature.failure == CHECK_FAILED}
        if not self.known or self.known.total() < self.verdicts["failed"] or not checks.issuperset(self.known):
            return ""
        names = " and ".join(f"saved-{id_}" for id_ in sorted(self.known))
        which = "a failed check" if len(self.known) == 1 else "failed checks"
        return f"all {plural(self.known.total(), 'failing run')} are known, by {names}, {which}; nothing else failed"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the search's health, and about a test function or reference with which nothing can fail."""
        warnings = self.health.warnings(self.known.total())
        excused = self.verdicts["npc"] + self.verdicts["unpreventable"]
        if excused and not self.verdicts["passed"] and not self.verdicts["failed"]:
            blame, what = self.simulation.harness.request.blame, "collisions that an NPC is responsible for"
            if self.verdicts["unpreventable"]:
                what = "failures that no reference driver would have prevented, or " + what
            warnings.append(
                f"the test function judged nothing: all runs that it could judge were {what}, which "
                f'blame="{blame}" excludes; search longer'
            )
        warnings += [
            f"check {name!r} failed in {runs} of {self.verdicts['passed']} runs that passed: the test function caught "
            "its exception; do not catch it, or use pafot.target, which never fails"
            for name, runs in sorted(self.caught.items())
        ]
        if self.broken:
            warnings.append(
                f"the reference itself failed in all its runs, at first with {self.broken}, so no failure could count; "
                "correct the reference, its factory, or the world= in which it drives"
            )
        return tuple(warnings)

    def evaluate(self, scenario: Scenario) -> Evaluation:
        """Run and judge a scenario; return its evaluation for the algorithm.

        Raises:
            OutOfTime: if the time of the search is over before that; the scenario then counts nowhere.
        """
        run = lost = None
        with runs_end_in(self.seconds_left()):
            if scenario not in self.fatal:
                try:
                    run = self.simulation.run(scenario)
                except ProcessLostError as error:
                    lost = error
            if run is not None:
                return self._judged(run)
        self.first.is_alike = False
        self.recorder.release()
        if lost is not None:  # Outside of the handler, so that the finding's exception has no context.
            self.verdicts["failed" if self.lose(lost) else "common"] += 1
        # Nothing is known about a scenario in which a process died, and it is not run again.
        return Evaluation(
            scenario=scenario,
            executed=scenario,
            fitness=0.0,
            failing=False,
            outcome=Outcome.SAFE,
            duration=0.0,
            genes_started=0,
            genes_reached=0,
            interaction=False,
            discarded=True,
        )

    def follow(self, campaign: Iterable[events.Event], tick: Callable[[], None] = lambda: None) -> None:
        """Process the events of a campaign to its end. ``tick`` is called after each event.

        Raises:
            SetupFaultError: if all runs of the first generation end in the same exception.
        """
        for event in campaign:
            self.listener(event)
            match event:
                case events.Evaluated():
                    self.uncounted.append(event)
                case events.GenerationFinished(local_generation=0):
                    self.generation = event.generation + 1
                    self.first.end()
                case events.LocalSearchStarted():
                    self.generation = event.generation
                case events.LocalSearchFinished():
                    self.generation = event.generation + 1
                case events.CampaignFinished():
                    self.finished = event
            tick()

    def count(self) -> None:
        """Count the evaluations since the last call. Counting is delayed so that no scenario has to wait for it."""
        for event in self.uncounted:
            self.counted = self.counted.counted(event.evaluation, reused=event.reused)
        self.uncounted.clear()

    def lose(self, lost: LostRun) -> bool:
        """Record a scenario whose process died or hung, so that it is never run again, not even in later sessions.

        Return whether that is a failure. It is none if the reference does not pass the scenario either.
        """
        self.fatal.add(lost.task)
        if self.simulation.is_common(lost.task):
            return False
        self._count(expectation(lost).signature, lambda: self.recorder.keep_lost(lost, self.generation, self.runs + 1))
        return True

    def _judged(self, run: Run) -> Evaluation:
        is_alone = self.simulation.runner.is_alone
        verdict = self.simulation.judge(run)
        judged = [Judged(run=run, verdict=verdict)]
        if verdict.failed and not is_alone:  # Run it alone as its replay will, in case a batch mixes up its rows.
            run = self.simulation.run(run.trace.scenario, afresh=True)
            verdict = self.simulation.judge(run)
            judged.append(Judged(run=run, verdict=verdict))
        for event in judged:  # After both runs, because the time limit may end the second one, and then none counts.
            self.listener(event)
        self.verdicts[verdict.kind] += 1
        # What says that the set-up is wrong: a check that the function catches, units, the same error in all runs. As
        # soon as two runs differ, the findings that were held back are no fault of the set-up.
        if verdict.kind == "passed":
            self.caught.update({check.name for check in verdict.checks if not check.holds})
        self.doubt = self.doubt or unit_doubt(run.trace)
        if self.first.is_alike:
            self.first.see(run, verdict)
        if not self.first.is_alike:
            self.recorder.release()
        # A failure is known, repeated or new, by its signature; a new one is saved here, before the next run.
        signature, failure = None, verdict.failure if verdict.failed else None
        if failure is not None:
            signature = of_failure(run, failure)
            self._count(signature, lambda: self.recorder.keep(run, verdict, self.generation, self.runs))
        if verdict.kind == "skipped":
            self.skip = verdict.exception
        if verdict.reference is not None and self.broken != "":
            broken = verdict.reference.failure if verdict.reference.is_ads else None
            self.broken = "" if broken is None else self.broken or f"{broken.kind}: {broken.message}"
        # The algorithm sees how bad the run was, and in which way it failed, so that it can look for other ways.
        check = None if failure is None else failure.check
        return Evaluation.of(
            run.trace,
            fitness=run.trace.reading(FITNESS, self.fitness),
            failing=verdict.failed,
            discarded=verdict.discarded,
            kind=signature,
            mistake=(None if signature is None else signature.mistake) if check is None else check.name,
            margins=worst_margins(verdict) if self.is_steered_by_checks else (),
        )

    def _count(self, signature: Signature, keep: Callable[[], str]) -> None:
        """Count a failure as known, as a repetition in this search, or as new; ``keep`` records a new failure."""
        if signature in self.shown:
            self.known[self.shown[signature]] += 1
        elif signature in self.finds:
            self.repeats[self.finds[signature]] += 1
        else:
            self.finds[signature] = keep()
