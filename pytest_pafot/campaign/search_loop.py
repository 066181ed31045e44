"""The loop of a search: scenarios in, evaluations out, and every distinct find handed on the moment it is there."""

from __future__ import annotations

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

# What a search reads from every run, read in the process that has made it, so that this one need not.

FITNESS = "fitness"
"""The name of what a search maximises, among the readings of a trace."""


def read_ahead(fitness: Callable[[Trace], float] | None, trace: Trace) -> None:
    """Read what will be asked for; the trace keeps it. The fitness is None where it stays in the session."""
    trace.reading("interaction", interaction_of)
    unit_doubt(trace)
    mistake_of(trace)
    if fitness is not None:
        trace.reading(FITNESS, fitness)


@dataclass(slots=True, kw_only=True)
class SearchLoop:
    """A search in progress: what it has seen so far."""

    simulation: Simulation
    recorder: Recorder
    fitness: Callable[[Trace], float]  # of a trace, higher is worse for the ego
    space: SearchSpace | None = None  # from which scenarios are drawn; None for replays alone
    listener: Listener = lambda event: None
    is_steered_by_checks: bool = True  # whether the margins of checks are objectives beside the fitness
    fatal: set[Scenario] = field(default_factory=set)  # in which a process died, earlier or in this search; not run
    shown: Mapping[Signature, str] = field(default_factory=dict)  # by saved scenarios now: their ids by signature
    finds: dict[Signature, str] = field(default_factory=dict)  # ids of new finds by signature
    repeats: Counter[str] = field(default_factory=Counter)  # further runs of each new find, by id
    known: Counter[str] = field(default_factory=Counter)  # failing runs by the id of the file that covers them
    verdicts: Counter[str] = field(default_factory=Counter)  # counts by kind
    caught: Counter[str] = field(default_factory=Counter)  # passed runs by the name of a check that failed in them
    counted: Health = field(default_factory=Health)  # of the evaluations that were counted
    uncounted: list[events.Evaluated] = field(default_factory=list)
    generation: int = 0  # of the main search, from 0
    finished: events.CampaignFinished | None = None  # the last event, once the campaign is over
    skip: BaseException | None = None  # the last exception by which the function declined to judge
    first: FirstGeneration = field(default_factory=FirstGeneration)
    doubt: str = ""  # about the units of the ADS's actions, once there is one
    # Of the reference, once it was run: what it failed by itself, or empty as soon as it did not
    broken: str | None = None

    @property
    def runs(self) -> int:
        """Simulated scenarios."""
        return self.verdicts.total()

    @property
    def health(self) -> Health:
        """Whether the search tested anything."""
        self.count()
        return self.counted

    @property
    def known_alone(self) -> str:
        """That all that failed are checks whose failures are saved; empty where anything else failed, or nothing."""
        checks = {id_ for signature, id_ in self.shown.items() if signature.failure == CHECK_FAILED}
        if not self.known or self.known.total() < self.verdicts["failed"] or not checks.issuperset(self.known):
            return ""
        names = " and ".join(f"saved-{id_}" for id_ in sorted(self.known))
        which = "a failed check" if len(self.known) == 1 else "failed checks"
        return f"all {plural(self.known.total(), 'failing run')} are known, by {names}, {which}; nothing else failed"

    @property
    def warnings(self) -> tuple[str, ...]:
        """The search's health, and whether the test function was asked at all, and kept to itself what failed."""
        warnings = self.health.warnings(self.known.total())
        excused = self.verdicts["npc"] + self.verdicts["unpreventable"]
        if excused and not self.verdicts["passed"] and not self.verdicts["failed"]:
            blame, what = self.simulation.harness.request.blame, "collisions that an NPC is responsible for"
            if self.verdicts["unpreventable"]:
                what = "failures that no reference driver would have prevented, or " + what
            warnings.append(
                f"the test function judged nothing: all runs that it could judge were {what}, which "
                f'blame="{blame}" leaves out; search longer'
            )
        warnings += [
            f"check {name!r} failed in {runs} of {self.verdicts['passed']} runs that passed: the test function caught "
            "it; let it through, or take pafot.target, which never fails"
            for name, runs in sorted(self.caught.items())
        ]
        if self.broken:
            warnings.append(
                f"the reference itself failed wherever it was run, at first by {self.broken}, so that nothing could "
                "count; correct it, its factory, or the world= that it drives in"
            )
        return tuple(warnings)

    def evaluate(self, scenario: Scenario) -> Evaluation:
        """Return the evaluation that a campaign asks for."""
        run = lost = None
        if scenario not in self.fatal:
            try:
                run = self.simulation.run(scenario)
            except ProcessLostError as error:
                lost = error
        if run is not None:
            return self._judged(run)
        self.first.is_alike = False
        self.recorder.release()
        if lost is not None:  # Outside of the handler: the find that is made of it is no consequence of it.
            self.verdicts["failed" if self.lose(lost) else "common"] += 1
        # All that is known of a scenario in which a process died: it is not run again.
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

    def follow(self, campaign: Iterable[events.Event], tick: Callable[[], None]) -> None:
        """Run a campaign to its end; ``tick`` is called after each event.

        Raises:
            SetupFaultError: where the same exception ends all runs of the first generation.
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
        """Count what was evaluated since this was done last, which no scenario has to wait for."""
        for event in self.uncounted:
            self.counted = self.counted.counted(event.evaluation, reused=event.reused)
        self.uncounted.clear()

    def lose(self, lost: LostRun) -> bool:
        """Know of a scenario whose process did not come back; it is not run again, in later sessions either.

        Whether that counts as a failure: not where the reference does not pass, either.
        """
        self.fatal.add(lost.task)
        if self.simulation.is_common(lost.task):
            return False
        self._count(expectation(lost).signature, lambda: self.recorder.keep_lost(lost, self.generation, self.runs + 1))
        return True

    def _judged(self, run: Run) -> Evaluation:
        is_alone = self.simulation.runner.is_alone
        verdict = self.simulation.judge(run)
        self.listener(Judged(run=run, verdict=verdict))
        if verdict.failed and not is_alone:  # A find is what its replay will be, also where a batch mixes up its rows.
            run = self.simulation.run(run.trace.scenario, afresh=True)
            verdict = self.simulation.judge(run)
            self.listener(Judged(run=run, verdict=verdict))
        self.verdicts[verdict.kind] += 1
        if verdict.kind == "passed":
            self.caught.update({check.name for check in verdict.checks if not check.holds})
        self.doubt = self.doubt or unit_doubt(run.trace)
        if self.first.is_alike:
            self.first.see(run, verdict)
        if not self.first.is_alike:
            self.recorder.release()
        signature, failure = None, verdict.failure if verdict.failed else None
        if failure is not None:
            signature = of_failure(run, failure)
            self._count(signature, lambda: self.recorder.keep(run, verdict, self.generation, self.runs))
        if verdict.kind == "skipped":
            self.skip = verdict.exception
        if verdict.reference is not None and self.broken != "":
            broken = verdict.reference.failure if verdict.reference.is_ads else None
            self.broken = "" if broken is None else self.broken or f"{broken.kind}: {broken.message}"
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
        """A failure is known, or one of this search's own again, or new."""
        if signature in self.shown:
            self.known[self.shown[signature]] += 1
        elif signature in self.finds:
            self.repeats[self.finds[signature]] += 1
        else:
            self.finds[signature] = keep()
