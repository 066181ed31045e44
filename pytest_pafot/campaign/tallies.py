"""What other processes do for a search: they make and judge its runs, count them, and drive whole blocks."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any

from pytest_pafot.campaign.events import Judged
from pytest_pafot.campaign.harness import Harness
from pytest_pafot.campaign.run_table import columns_of, row_of
from pytest_pafot.campaign.setup_fault import unit_doubt
from pytest_pafot.campaign.verdict import (
    FAILING,
    Counts,
    caught_in,
    evaluated,
    fails_by_ego,
    unknown,
)
from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.pool import KILLED, ProcessLostError
from pytest_pafot.execution.scenario_pool import (
    Answer,
    BlockTask,
    CapturedOutput,
    Digest,
    Job,
    LostRun,
    Timed,
    expectation,
    pool_for,
    run_recorded,
)
from pytest_pafot.findings.finding import Manner, failed_as
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import Facts, Run
from pytest_pafot.searching.evaluation import Evaluation, has_interaction
from pytest_pafot.searching.events import RunsEvaluated
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.plan import Learnt, Plan


def facts_of(run: Run, evaluation: Evaluation) -> Facts:
    """Return the facts of a run from what the algorithm sees of it."""
    if run.facts is not None:
        return replace(run.facts, fitness=evaluation.fitness)
    return Facts(run.trace, run.attribution, evaluation.interaction, unit_doubt(run.trace), evaluation.fitness)


@dataclass(frozen=True, slots=True, kw_only=True)
class Digested(Digest):
    """All that a search needs of a run, in the process that has made and judged it.

    ``facts`` is the run itself if the session must judge it, because it failed in a way that is not known.
    """

    evaluation: Evaluation
    event: Judged
    facts: Facts | None
    signature: Signature | None  # of a failure that counts
    manner: Manner | None  # of the same failure
    decisions: int  # of the ADS
    caught: tuple[str, ...]  # the names of checks that failed although the test function passed
    doubt: str  # see :func:`unit_doubt`


UNREMARKABLE = ("passed", "npc", "avoidable", "invalid", "rejected")
"""The kinds of verdicts for which a tally is enough, as it is for failures that the search knows. All other runs are
judged in the session, with their traces.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """Read the trace of a run in the process that made it, so that the process of the session need not.

    With a harness, that process judges the run, too, and sends a tally if nothing failed. Otherwise it sends the trace
    with what the search needs to know of it.

    Attributes:
        harness: has the test function; None if only the process of the session may call it.
        fitness: the fitness of a run; None if it is the user's own function, which runs only in the session.
        is_steered_by_checks: True if margins of checks are objectives, in addition to the fitness.
        has_table: whether a tally has the columns of its runs for the table of runs.
    """

    harness: Harness | None
    fitness: Callable[[Run], float] | None
    is_steered_by_checks: bool
    has_table: bool

    def __call__(self, trace: Trace) -> Tally | Facts:
        """Read a trace; return the tally of the run, or its facts if the session must judge it."""
        digested = self.digested(trace)
        if isinstance(digested, Facts):
            return digested
        return digested.facts or Tally.of([digested])

    def digested(self, trace: Trace, known: Collection[Signature] = ()) -> Digested | Facts:
        """Read a trace; return what a search needs of the run, or its facts if only the session may judge it.

        Of the ``known`` failures no further trace must be sent.
        """
        if self.fitness is None or self.harness is None:
            run = Run(trace)
            fitness = None if self.fitness is None else self.fitness(run)
            return Facts(trace, run.attribution, has_interaction(trace), unit_doubt(trace), fitness)
        run = self.harness.run_of(trace)
        verdict, signature, manner = self.harness.judge(run), None, None
        if verdict.failed and verdict.failure is not None:
            signature, manner = failed_as(run, verdict.failure)
        event = Judged(
            scenario=trace.scenario,
            executed=trace.executed,
            verdict=replace(verdict, checks=(), exception=None),
            known_responsibility=run.responsibility,
            columns=columns_of(run, verdict) if self.has_table else None,
        )
        evaluation = evaluated(run, verdict, signature, self.fitness, self.is_steered_by_checks)
        facts = facts_of(run, evaluation)
        return Digested(
            evaluation=evaluation,
            event=event,
            facts=None if verdict.kind in UNREMARKABLE or signature in known else facts,
            signature=signature,
            manner=manner,
            decisions=len(trace.actions),
            caught=caught_in(verdict),
            doubt=facts.doubt,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally(Digest, RunsEvaluated):
    """The counts of consecutive runs that another process has made and judged; as an event, those of a whole block.

    Attributes:
        decisions: the number of decisions of the ADS in the runs.
        evaluations: the evaluations, packed, because the session seldom needs each of them.
        judged: the event of each run, with its columns of the table of runs, if it was no process that drives a block
            that made it; otherwise None.
        health: the figures on the search's health.
        counts: the counts of the runs.
        caught: numbers of runs by check that failed although they passed.
        failed: numbers of runs by their known failures.
        manners: of each run with a known failure, its manner and the id of its scenario.
        random: the counts of :class:`~pytest_pafot.campaign.state.RandomRuns`, in the order of its fields.
        doubt: see :func:`unit_doubt`.
        avoidable: see :class:`~pytest_pafot.campaign.state.State`.
    """

    decisions: int
    evaluations: bytes
    judged: tuple[Judged, ...] | None
    health: Health
    counts: Counts
    caught: Counter[str]
    failed: Counter[Signature]
    manners: tuple[tuple[Signature, Manner, str], ...]
    random: tuple[int, int, int, int, int]
    doubt: str
    avoidable: str

    @property
    def unpacked(self) -> Sequence[Evaluation]:
        """The evaluations."""
        each: Sequence[Evaluation] = pickle.loads(self.evaluations)  # noqa: S301  (from a process of this session)
        return each

    @classmethod
    def of(cls, runs: Sequence[Digested], generation: int | None = None) -> Tally:
        """Count runs of a generation; without its number, the tally has the event of each run."""
        evaluations, verdicts = [each.evaluation for each in runs], [each.event.verdict for each in runs]
        valid = [each for each in verdicts if not (each.discarded or each.kind == "invalid")]
        failed = [each.event for each in runs if each.event.verdict.kind in FAILING]
        others = [each.verdict for each in failed if not fails_by_ego(each.verdict, each.responsibility)]
        checks = sum(each.is_check for each in others)
        counts = Counts()
        for each in runs:
            counts.add(each.event.verdict.kind, each.evaluation.outcome, each.event.responsibility)
        rows: list[dict[str, Any]] = []
        if generation is not None:
            rows = [
                row_of(each.evaluation, generation) | dict(each.event.columns)
                for each in runs
                if each.event.columns is not None
            ]
        return cls(
            generation=generation or 0,
            runs=len(runs),
            decisions=sum(each.decisions for each in runs),
            evaluations=pickle.dumps(evaluations),
            judged=tuple(each.event for each in runs) if generation is None else None,
            health=Health.of_runs(len(runs), evaluations),
            counts=counts,
            caught=Counter(name for each in runs for name in each.caught),
            failed=Counter(each.signature for each in runs if each.signature is not None),
            manners=tuple(
                (each.signature, each.manner, each.event.executed.id)
                for each in runs
                if each.signature is not None and each.manner is not None
            ),
            random=(len(runs), len(valid), len(failed) - len(others), len(others), checks),
            rows=tuple(rows),
            doubt=next((each.doubt for each in runs if each.doubt), ""),
            avoidable=next((each.excused for each in verdicts if each.excused), ""),
        )


@dataclass(frozen=True, slots=True)
class Recovered:
    """The message of a process that drives a block on the death of its own process in a run that was made again."""

    lost: LostRun


@dataclass(slots=True, kw_only=True)
class BlockDriver:
    """The driving of whole blocks of a search in the processes that run its scenarios.

    Attributes:
        reader: reads and judges each run.
        plan: the plan of the search; None before the search begins.
        random_runs: the number of random scenarios at the beginning of the search that are counted apart.
    """

    reader: Reader
    plan: Plan[Any] | None = None
    random_runs: float = 0.0

    def __call__(self, task: BlockTask, job: Job, record: CrashRecord, say: Callable[[Timed], object]) -> None:
        """Drive a block and say what comes of it, until it ends or only the session can go on."""
        known = set(task.known_failures)
        read = partial(self.reader.digested, known=known)
        if not task.is_apart:
            self._drive(task, known, lambda scenario: run_recorded(job, record, scenario, read), say)
            return
        with pool_for(replace(job, read=read, drive=None), 1) as pool:

            def run(scenario: Scenario) -> Answer:
                answer = pool.fetch(scenario)
                while pool.recovered:
                    say((Recovered(pool.recovered.pop()), CapturedOutput(), 0.0))
                return answer

            self._drive(task, known, run, say)

    def _drive(
        self,
        task: BlockTask,
        known: set[Signature],
        run: Callable[[Scenario], Answer],
        say: Callable[[Timed], object],
    ) -> None:
        assert self.plan is not None and self.plan.length is not None  # noqa: S101, PT018  (only then there are tasks)
        block = self.plan.beginning(task.number)
        counted: list[tuple[Digested, CapturedOutput, float]] = []

        def count() -> None:  # the runs since the last one that the session must judge
            if counted:
                runs, outputs, seconds = zip(*counted, strict=True)
                tally = Tally.of(runs, block.generation)
                say((tally, reduce(CapturedOutput.followed_by, outputs), sum(seconds)))
                counted.clear()

        for _ in range(self.plan.length):
            first = block.state.proposed
            while not block.is_whole:
                scenario = block.scenario()
                try:
                    answer = None if scenario in task.fatal else run(scenario)
                except MemoryError:  # The session must not use up its memory in the same way.
                    raise
                except Exception:  # noqa: BLE001  (the session runs it again, and reports what is raised)
                    answer = None
                if isinstance(answer, ProcessLostError) and answer.end != KILLED:
                    count()
                    say((answer, CapturedOutput(), 0.0))
                    block.take(unknown(scenario, expectation(answer)))
                    continue
                digested, output, seconds = answer if isinstance(answer, tuple) else (None, CapturedOutput(), 0.0)
                # Only the session may judge this run, or report what it raised: it goes on with the block from here.
                if not isinstance(digested, Digested):
                    count()
                    return
                block.take(digested.evaluation)
                # Nothing new: it is counted with the runs next to it, because a message for each would cost the session
                # more than the run itself.
                if digested.facts is None or digested.signature in known:
                    counted.append((digested, output, seconds))
                else:
                    count()
                    say((digested.facts, output, seconds))
                    if digested.signature is not None:
                        known.add(digested.signature)
                # The random runs of the beginning are counted apart, so a tally must not go beyond their end.
                if first + block.index == self.random_runs:
                    count()
            count()
            events = block.learn()
            say((Learnt.packed(block.state, events), CapturedOutput(), 0.0))
