"""What other processes do for a search: they draw its scenarios, make and judge the runs, and count them."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any

from pytest_pafot.campaign.events import Judged
from pytest_pafot.campaign.harness import Harness
from pytest_pafot.campaign.judging import (
    FAILING,
    Counts,
    caught_in,
    evaluated,
    fails_by_ego,
)
from pytest_pafot.campaign.run_table import columns_of, row_of
from pytest_pafot.campaign.setup_fault import unit_doubt
from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.scenario_pool import (
    CapturedOutput,
    Chunk,
    Digest,
    Job,
    Timed,
    run_recorded,
)
from pytest_pafot.findings.finding import Manner, failed_as
from pytest_pafot.findings.sighting import Alike, worse
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import Facts, Run
from pytest_pafot.searching.evaluation import Evaluation, Health, RunsEvaluated, has_interaction


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
        has_table: whether a tally has the columns of its runs for the table of runs.
    """

    harness: Harness | None
    fitness: Callable[[Run], float] | None
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
        evaluation = evaluated(run, verdict, signature, self.fitness)
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
    """The counts of consecutive runs that another process has made and judged; as an event, those of a chunk.

    Attributes:
        decisions: the number of decisions of the ADS in the runs.
        evaluations: the evaluations, packed; none of a chunk without rows, since nothing is learnt.
        judged: the event of each run, with its columns of the table of runs, if it was not in a chunk; otherwise None.
        health: the figures on the search's health.
        counts: the counts of the runs.
        caught: numbers of runs by check that failed although they passed.
        failed: numbers of runs by their known failures.
        manners: of each run with a known failure, its manner and the id of its scenario.
        random: the counts of :class:`~pytest_pafot.campaign.state.RandomRuns`, in the order of its fields.
        worst: of the runs with a failure the worst one, by failure; its number is that in the search.
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
    worst: Mapping[Signature, Alike]
    random: tuple[int, int, int, int, int]
    doubt: str
    avoidable: str

    @property
    def unpacked(self) -> Sequence[Evaluation]:
        """The evaluations."""
        each: Sequence[Evaluation] = pickle.loads(self.evaluations)  # noqa: S301  (from a process of this session)
        return each

    @classmethod
    def of(cls, runs: Sequence[Digested], first: int | None = None) -> Tally:
        """Count runs of a chunk from a number on; without a number, the tally has the event of each run."""
        evaluations, verdicts = [each.evaluation for each in runs], [each.event.verdict for each in runs]
        valid = [each for each in verdicts if not (each.discarded or each.kind == "invalid")]
        failed = [each.event for each in runs if each.event.verdict.kind in FAILING]
        others = [each.verdict for each in failed if not fails_by_ego(each.verdict, each.responsibility)]
        checks = sum(each.is_check for each in others)
        counts = Counts()
        for each in runs:
            counts.add(each.event.verdict.kind, each.evaluation.outcome, each.event.responsibility)
        rows: list[dict[str, Any]] = []
        if first is not None:
            rows = [
                row_of(each.evaluation, number) | dict(each.event.columns)
                for number, each in enumerate(runs, first)
                if each.event.columns is not None
            ]
        worst: dict[Signature, Alike] = {}
        for number, each in enumerate(runs, first or 0):
            if each.signature is not None:
                seen = Alike(number=number, severity=each.event.verdict.severity)
                worst[each.signature] = worse(worst.get(each.signature), seen)
        return cls(
            generation=first or 0,
            runs=len(runs),
            decisions=sum(each.decisions for each in runs),
            evaluations=pickle.dumps(evaluations if first is None or rows else ()),
            judged=tuple(each.event for each in runs) if first is None else None,
            health=Health.of_runs(len(runs), evaluations),
            counts=counts,
            caught=Counter(name for each in runs for name in each.caught),
            failed=Counter(each.signature for each in runs if each.signature is not None),
            manners=tuple(
                (each.signature, each.manner, each.event.executed.id)
                for each in runs
                if each.signature is not None and each.manner is not None
            ),
            worst=worst,
            random=(len(runs), len(valid), len(failed) - len(others), len(others), checks),
            rows=tuple(rows),
            doubt=next((each.doubt for each in runs if each.doubt), ""),
            avoidable=next((each.excused for each in verdicts if each.excused), ""),
        )


@dataclass(slots=True, kw_only=True)
class Driver:
    """The driving of chunks of a random search in the processes that run its scenarios.

    Attributes:
        reader: reads and judges each run.
        drawn: returns the scenario of a number; None before the search begins.
    """

    reader: Reader
    drawn: Callable[[int], Scenario] | None = None

    def __call__(self, chunk: Chunk, job: Job, record: CrashRecord, say: Callable[[Timed], object]) -> None:
        """Draw and drive the scenarios of a chunk, and say what comes of them."""
        assert self.drawn is not None  # noqa: S101  (only then there are tasks)
        known = set(chunk.known)
        read = partial(self.reader.digested, known=known)
        counted: list[tuple[Digested, CapturedOutput, float]] = []

        def count() -> None:  # the runs since the last one that the session must see
            if counted:
                runs, outputs, seconds = zip(*counted, strict=True)
                tally = Tally.of(runs, chunk.first + done - len(counted))
                say((tally, reduce(CapturedOutput.followed_by, outputs), sum(seconds)))
                counted.clear()

        for done in range(chunk.end - chunk.first):
            scenario = self.drawn(chunk.first + done)
            try:
                answer = None if scenario in chunk.fatal else run_recorded(job, record, scenario, read)
            except MemoryError:  # The session must not use up its memory in the same way.
                raise
            except Exception:  # noqa: BLE001  (the session runs it again, and reports what is raised)
                answer = None
            digested, output, seconds = (None, CapturedOutput(), 0.0) if answer is None else answer
            # Nothing new: it is counted with the runs next to it, since a message costs the session more than a run.
            if isinstance(digested, Digested) and (digested.facts is None or digested.signature in known):
                counted.append((digested, output, seconds))
                continue
            count()
            if isinstance(digested, Digested):
                say((digested.facts, output, seconds))
                if digested.signature is not None:
                    known.add(digested.signature)
            else:  # Only the session may run it, or judge it.
                say((None, CapturedOutput(), 0.0))
        done = chunk.end - chunk.first
        count()
