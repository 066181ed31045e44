"""The search loop: scenarios in, evaluations out, and every distinct find handed on the moment it is there.

It knows neither pytest's items nor files nor worlds: those are given as functions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pytest_pafot.campaign.setup_fault import FirstGeneration
from pytest_pafot.campaign.units import doubt
from pytest_pafot.execution.worker_pool import Lost, ProcessLostError
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.replay import Replayed, covered_by
from pytest_pafot.run import Run
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import (
    CampaignFinished,
    Evaluated,
    Event,
    GenerationFinished,
    LocalSearchFinished,
    LocalSearchStarted,
)
from pytest_pafot.searching.health_check import Health
from pytest_pafot.trace import Outcome

if TYPE_CHECKING:
    from pytest_pafot.attribution.near_misses import NearMiss
    from pytest_pafot.campaign.verdict import Verdict
    from pytest_pafot.findings.signature import Signature
    from pytest_pafot.scenario import Scenario
    from pytest_pafot.trace import Trace


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """What a search runs on.

    Attributes:
        run: simulates a scenario; the scenario is on disk while it does. Raises ``ProcessLostError`` where that took
            place in another process, which did not come back.
        judge: says what the user's function makes of a run; likewise.
        fitness: of a trace, higher is worse for the ego.
        keep: takes a new find (run, verdict, generation, number of the run), saves and announces it.
        keep_lost: takes the first scenario whose process did not come back, likewise.
        lethal: scenarios in which a process died; they are not run.
        alone: the run again by itself where it took place together with others, else None.
        release: is told that what was kept so far is no fault of the set-up, and to be announced.
        near_misses: what the ego nearly had to answer for in a trace, where the algorithm reads that.
    """

    run: Callable[[Scenario], Run]
    judge: Callable[[Run], Verdict]
    fitness: Callable[[Trace], float]
    keep: Callable[[Run, Verdict, int, int], str]
    keep_lost: Callable[[Lost, int, int], str]
    lethal: frozenset[Scenario] = frozenset()
    alone: Callable[[Run], Run | None] = lambda run: None
    release: Callable[[], None] = lambda: None
    near_misses: Callable[[Trace], tuple[NearMiss, ...]] = lambda trace: ()


@dataclass(slots=True)
class Hunt:
    """A search in progress: what it has seen so far.

    Attributes:
        stage: that it runs on.
        replayed: what the replays of the saved scenarios showed.
        finds: ids of new finds by signature, with the number of further runs of each.
        known: failing runs by the id of the saved scenario that covers them.
        verdicts: counts by kind.
        health: of the evaluations.
        generation: of the main search, from 0.
        finished: the last event, once the campaign is over.
        skip: the last exception by which the function declined to judge.
        died: scenarios whose process did not come back to this search.
        first: what the runs of the first generation have in common.
        doubt: about the units of the ADS's actions, once there is one.
    """

    stage: Stage
    replayed: Sequence[Replayed] = ()
    finds: dict[Signature, str] = field(default_factory=dict)
    repeats: Counter[str] = field(default_factory=Counter)
    known: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    health: Health = field(default_factory=Health)
    generation: int = 0
    finished: CampaignFinished | None = None
    skip: BaseException | None = None
    died: set[Scenario] = field(default_factory=set)
    first: FirstGeneration = field(default_factory=FirstGeneration)
    doubt: str = ""

    @property
    def lethal(self) -> frozenset[Scenario]:
        """Scenarios in which a process died, now or earlier; they are not run."""
        return self.stage.lethal | self.died

    @property
    def runs(self) -> int:
        """Simulated scenarios."""
        return self.verdicts.total()

    def evaluate(self, scenarios: Sequence[Scenario]) -> list[Evaluation]:
        """The evaluations that a campaign asks for."""
        return [self._evaluated(scenario) for scenario in scenarios]

    def follow(self, events: Iterable[Event], tick: Callable[[], None]) -> None:
        """Run a campaign to its end; ``tick`` is called after each event.

        Raises:
            SetupFaultError: where the same exception ends all runs of the first generation.
        """
        for event in events:
            self.health = _counted(self.health, event)
            self._note(event)
            tick()

    def _note(self, event: Event) -> None:
        if isinstance(event, GenerationFinished) and event.local_generation == 0:
            self.generation = event.generation + 1
            self.first.end()
        elif isinstance(event, LocalSearchStarted):
            self.generation = event.generation
        elif isinstance(event, LocalSearchFinished):
            self.generation = event.generation + 1
        elif isinstance(event, CampaignFinished):
            self.finished = event

    def _evaluated(self, scenario: Scenario) -> Evaluation:
        if scenario in self.stage.lethal:
            self._settle()
            return _not_run(scenario)
        run = self._run(scenario)
        if isinstance(run, Lost):
            self._settle()
            return self.lose(run)
        verdict = self.stage.judge(run)
        again = self.stage.alone(run) if verdict.failed else None
        if again is not None:  # A find is what its replay will be, also where an ADS does not keep its rows apart.
            run, verdict = again, self.stage.judge(again)
        self.verdicts[verdict.kind] += 1
        self.doubt = self.doubt or doubt(run.trace)
        if self.first.is_alike:
            self.first.see(run, verdict)
            if not self.first.is_alike:
                self.stage.release()
        kind = self._failed(run, verdict) if verdict.failed else None
        if verdict.kind == "skipped":
            self.skip = verdict.exception
        return Evaluation.of(
            run.trace,
            fitness=self.stage.fitness(run.trace),
            failing=verdict.failed,
            discarded=verdict.discarded,
            kind=kind,
            fault=None if kind is None else kind.fault,
            near_misses=self.stage.near_misses(run.trace),
        )

    def _settle(self) -> None:
        """Not every run of the first generation ends in the same exception."""
        if self.first.is_alike:
            self.first.is_alike = False
            self.stage.release()

    def _run(self, scenario: Scenario) -> Run | Lost:
        try:
            return self.stage.run(scenario)
        except ProcessLostError as error:  # A find is made of it outside of the handler: it is no consequence of this.
            return error.lost

    def _failed(self, run: Run, verdict: Verdict) -> Signature | None:
        """A failure is known, or one of this search's own again, or new; returns which it is."""
        if verdict.failure is None:
            return None
        signature = of_failure(run, verdict.failure)
        self._sort(signature, lambda: self.stage.keep(run, verdict, self.generation, self.runs))
        return signature

    def lose(self, lost: Lost) -> Evaluation:
        """A scenario that is not to be run again; what the search knows of it is that, as in later sessions."""
        self.died.add(lost.scenario)
        self._sort(lost.expect.signature, lambda: self.stage.keep_lost(lost, self.generation, self.runs + 1))
        return _not_run(lost.scenario)

    def _sort(self, signature: Signature, keep: Callable[[], str]) -> None:
        saved = covered_by(signature, self.replayed)
        if saved is not None:
            self.known[saved] += 1
        elif signature in self.finds:
            self.repeats[self.finds[signature]] += 1
        else:
            self.finds[signature] = keep()


def _counted(health: Health, event: Event) -> Health:
    return health.counted(event.evaluation, reused=event.reused) if isinstance(event, Evaluated) else health


def _not_run(scenario: Scenario) -> Evaluation:
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
