"""The results and counts of runs, without the runs' traces."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Set
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, Literal, Self

from pytest_pafot.algorithms.evaluation import Evaluation, Health, PlanFinished
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.execution.pool import OUT_OF_MEMORY, WORLD_HANGS, RunItHere
from pytest_pafot.execution.runner import (
    CapturedOutput,
    Chunk,
    Job,
    LostRun,
    Timed,
    expectation,
    run_recorded,
)
from pytest_pafot.findings.finding import (
    Expect,
    Finding,
    Found,
    is_faster,
    signature_of_failure,
    speed_of,
)
from pytest_pafot.findings.sighting import Alike, Died
from pytest_pafot.findings.verdict import CHECK_FAILED, Failure, Severity, Signature, Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.harness import Cause, Harness, cause_of, headline, unit_doubt
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import flag
from pytest_pafot.support.references import policy_name
from pytest_pafot.support.text import plural
from pytest_pafot.world import codec

# The kinds of verdicts on runs that failed, even if the failure does not count.
FAILING = ("failed", "common")
Fails = Literal["", "ego", "check", "otherwise"]

# For each known failure, the highest accepted closing speed [m/s], and the id of the file that accepts it.
Accepted = dict[Signature, tuple[float, str]]

# the kinds of verdicts on runs for which the test function was not called
UNJUDGED = ("npc", "invalid")


@dataclass(frozen=True, slots=True, kw_only=True)
class Failed:
    """A failure that counts and is new to the process that simulated its run."""

    signature: Signature  # the identity of the failure
    finding: Finding  # the content of the file, except for the number of the generation
    headline: str  # one line on the failure
    text: str  # the message of the failure, without a traceback
    # The trace, which another run of the scenario must repeat; None if it depends on wall-clock time.
    trace: Trace | None
    drew: bool = False  # whether the policy drew random numbers

    def found_in(self, generation: int) -> Finding:
        """Return the content of the finding's file, including the generation in which it was found."""
        return replace(self.finding, found=replace(self.finding.found, generation=generation))


# The process that simulates a scenario also evaluates the run. It sends a Result, or only Counts, but not the trace,
# which is large.
@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """The result of a run, without its trace."""

    # The evaluation for the algorithm. Its kind is the signature of the failure, if that counts.
    evaluation: Evaluation
    kind: str  # kind of the verdict
    ended: str  # how the run ended; `lost` if its process died or hung
    responsible: str | None = None  # side responsible for the collision, or None
    # How the run failed, even if that does not count: `ego` for a collision for which the ego is responsible, alone or
    # with the NPC, `check` for a failed check, `otherwise` for any other failure; empty if it passed.
    fails: Fails = ""
    decisions: int = 0  # number of decisions of the ADS
    severity: Severity | None = None  # severity of a failure; None if nothing measures it
    failed: Failed | None = None  # the failure, if it counts and is new
    cause: Cause | None = None  # cause of a failure that can be a fault of the set-up
    caught: tuple[str, ...] = ()  # names of checks that failed although the test function passed
    doubt: str = ""  # a hint if the actions seem to have wrong units
    # How the reference itself failed in the scenario; empty if it did not, None if it was not run.
    broken: str | None = None

    def beside(self, reference: Verdict) -> Self:
        # The failure counts only if the reference passes. If its run is invalid, the comparison is invalid, too.
        failure = reference.failure if reference.is_ads else None
        broken = "" if failure is None else f"{failure.kind}: {failure.message}"
        # Only then does the failure count as one of the new policy.
        if reference.passes:
            return replace(self, broken=broken)
        # The reference fails, too, so this is no evidence against the tested policy, and no file is made of it.
        evaluation = replace(self.evaluation, failing=False, kind=None)
        kind = "invalid" if reference.kind == "invalid" else "common"
        return replace(self, evaluation=evaluation, kind=kind, failed=None, broken=broken)


@dataclass(frozen=True, slots=True, kw_only=True)
class Examiner:
    """The evaluator of runs, which works in the process that simulates them."""

    harness: Harness  # contains the test function
    fitness: Callable[[Run], float]  # fitness of a run
    seed: int  # seed of the search
    # Returns the columns of a run table, as the note of an evaluation; None without a table.
    note: Callable[[Run, Verdict], Mapping[str, Any]] | None = None
    # the failures that saved scenarios show or accept
    accepted: Accepted = field(default_factory=dict)

    def __call__(self, trace: Trace, known: Collection[Signature] = ()) -> Result:
        # For a known failure, only the signature is returned.
        __tracebackhide__ = True
        run = self.harness.run_of(trace)
        verdict = self.harness.judge(run)
        signature = self.signature_of(run, verdict)
        failed = None
        # The file's content contains a trace and takes milliseconds, so it is made only for new failures.
        if signature is not None and signature not in known and verdict.failure is not None:
            failed = self._failed(run, verdict.failure, signature, verdict)
        evaluation = Evaluation.from_trace(
            trace,
            fitness=self.fitness(run),
            failing=verdict.failed,
            discarded=verdict.discarded,
            kind=signature,
            margins=verdict.margins,
            note=None if self.note is None else self.note(run, verdict),
        )
        caught = set[str]()
        # In a run that failed, the failed checks are part of the failure.
        if verdict.kind == "passed":
            caught = {each.name for each in verdict.checks if not each.holds}
        return Result(
            evaluation=evaluation,
            kind=verdict.kind,
            ended=str(run.outcome),
            responsible=run.responsibility,
            fails=_how_it_fails(run, verdict),
            decisions=len(trace.actions),
            severity=verdict.severity,
            failed=failed,
            cause=cause_of(run, verdict),
            caught=tuple(caught),
            doubt=unit_doubt(trace),
        )

    def signature_of(self, run: Run, verdict: Verdict) -> Signature | None:
        """Return the signature of the run's failure, or None if it does not count."""
        if not verdict.failed or verdict.failure is None:
            return None
        return self.beside_accepted(signature_of_failure(run, verdict.failure), verdict.severity)

    def beside_accepted(self, signature: Signature, severity: Severity | None) -> Signature:
        """Return the signature of a failure, or a different signature if it is worse than the accepted failure."""
        # Without this, an accepted scrape would hide every later crash of the same kind.
        most, id_ = self.accepted.get(signature, (math.inf, ""))
        return replace(signature, worse_than=id_) if is_faster(severity, most) else signature

    def _failed(self, run: Run, failure: Failure, signature: Signature, verdict: Verdict) -> Failed:
        harness = self.harness
        finding = Finding.from_run(
            run,
            failure,
            test=harness.node_id,
            world=codec.described(harness.world),
            found=replace(
                found_by(harness, self.seed), worst_closing_speed=speed_of(verdict.severity)
            ),
            perception=harness.policy.sight,
            against="" if harness.against is None else harness.against.name,
            root=str(harness.root),
        )
        return Failed(
            signature=signature,
            finding=finding,
            headline=finding.with_sight(headline(run, verdict)),
            text=str(verdict.exception) if verdict.is_ads else f"{failure.kind}: {failure.message}",
            trace=None if verdict.is_timed else run.trace,
            drew=run.trace.drew,
        )


def _how_it_fails(run: Run, verdict: Verdict) -> Fails:
    if verdict.kind not in FAILING:
        return ""
    # If the ADS raised an exception or hung, that is the failure, even if a collision followed.
    if run.responsibility in ("ego", "both") and not verdict.is_ads:
        return "ego"
    # What remains is a failed assertion, or an exception.
    return "check" if verdict.is_check else "otherwise"


def found_by(harness: Harness, seed: int, generation: int = 0, algorithm: str = "") -> Found:
    """Return the origin of a finding: seed, generation, algorithm, policy and versions."""
    # Failures that no algorithm found, such as dead processes of earlier sessions, have a name of their own.
    algorithm = algorithm or harness.request.algorithm.name
    policy = policy_name(harness.policy.factory)
    return Found(
        seed=seed,
        generation=generation,
        algorithm=algorithm,
        policy=policy,
        versions=harness.versions,
    )


def death_of(
    harness: Harness,
    scenario: Scenario,
    expect: Expect,
    *,
    found: Found,
    world: Mapping[str, Any] | None = None,
) -> Finding:
    """Return the content of the file for a scenario in which a process died or hung."""
    how = "hang" if expect.outcome is Outcome.HANG else "crash"
    return Finding(
        id=f"{how}-{scenario.id}",
        test=harness.node_id,
        scenario=scenario,
        world=world or codec.described(harness.world),
        expect=expect,
        found=found,
        perception=harness.policy.sight,
    )


def headline_of_death(death: LostRun) -> str:
    """Return one line on the loss of a process."""
    how = "hang" if death.is_hang else "crash"
    return f"{how}: the process that ran this scenario {death.end}"


def cause_of_death(death: LostRun | Died, way_out: str) -> str:
    """Return the likely cause of the loss of a process, with ``way_out`` as advice."""
    if death.end == OUT_OF_MEMORY:
        return "the ADS uses more and more memory, or needs more than its limit"
    if death.end == WORLD_HANGS:
        return f"the world hangs, or is too slow. If it is too slow, set a longer hang_limit and {way_out}"
    if not death.is_hang:
        return "the likely cause is a crash in native code, a call that ends the process, or a lack of memory"
    return (
        "the ADS hangs in code that does not return to the interpreter, ignores the interrupt, or uses a library that "
        f"does not work in a forked process. In the last case, {way_out}"
    )


def result_of_death(death: LostRun, harness: Harness, seed: int) -> Result:
    """Return the result for a scenario in which a process of this search died or hung."""
    expect = expectation(death)
    # A hang is not repeated, because it has already taken the whole time limit of a decision.
    again = "" if death.is_hang else ", even when it was repeated"
    why = cause_of_death(death, f"delete the file, and use {flag('workers', 1)}")
    failed = Failed(
        signature=expect.signature,
        finding=death_of(harness, death.task, expect, found=found_by(harness, seed)),
        headline=headline_of_death(death),
        text=f"the {death.who} that ran this scenario {death.end}{again}: {why}",
        trace=None,
    )
    evaluation = replace(
        not_run(death.task), failing=True, kind=expect.signature, outcome=expect.outcome
    )
    return Result(evaluation=evaluation, kind="failed", ended="lost", failed=failed)


def common_death(scenario: Scenario) -> Result:
    """Return the result for a scenario in which a process died, and which the reference fails, too."""
    return Result(evaluation=not_run(scenario), kind="common", ended="lost")


def not_run(scenario: Scenario) -> Evaluation:
    """Return an evaluation that teaches an algorithm nothing, because a process died in the scenario."""
    return Evaluation(
        scenario=scenario,
        executed=scenario,
        fitness=0.0,
        failing=False,
        outcome=Outcome.ADS_ERROR,
        duration=0.0,
        genes_started=0,
        genes_reached=0,
        interaction=False,
        discarded=True,
    )


@dataclass(slots=True, kw_only=True)
class Counts:
    """The counts for some runs. ``+=`` adds the counts for later runs."""

    # Numbers of runs by kind of verdict. They add up to the number of runs, as do the next two.
    kinds: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)  # numbers of runs by outcome
    # numbers of runs by who was responsible, or `none`
    responsibilities: Counter[str] = field(default_factory=Counter)
    # Numbers of valid runs that were neither rejected nor skipped, by how they failed, see Result.
    fails: Counter[str] = field(default_factory=Counter)
    # the runs with each failure that counts
    failures: dict[Signature, Alike] = field(default_factory=dict)
    # Numbers of runs by the cause of a failure that may be a fault of the set-up.
    causes: Counter[Cause] = field(default_factory=Counter)
    # Numbers of passed runs by the names of checks that failed in them.
    caught: Counter[str] = field(default_factory=Counter)
    decisions: int = 0  # number of decisions of the ADS
    # counts that show whether the runs tested anything
    health: Health = field(default_factory=Health)
    doubt: str = ""  # the first doubt in a run, see Result
    # the first failure of the reference itself; empty if it did not fail in all its runs
    broken: str | None = None

    @property
    def runs(self) -> int:
        return self.kinds.total()

    @property
    def is_alike(self) -> bool:
        """True if all evaluated runs failed with the same cause."""
        judged = self.runs - sum(self.kinds[kind] for kind in UNJUDGED)
        return len(self.causes) <= 1 and self.causes.total() == judged

    @classmethod
    def from_result(cls, result: Result, number: int = 0) -> Self:
        evaluation, counts = result.evaluation, cls()
        counts.kinds[result.kind] = 1
        counts.outcomes[result.ended] = 1
        counts.responsibilities[result.responsible or "none"] = 1
        # The failure rate is a fraction of the runs that could have failed.
        if not evaluation.discarded and result.kind != "invalid":
            counts.fails[result.fails] = 1
        if isinstance(evaluation.kind, Signature):
            counts.failures[evaluation.kind] = Alike(
                runs=1, number=number, severity=result.severity, least=result.severity
            )
        # Runs that passed have no cause, and then not all runs are alike.
        if result.cause is not None:
            counts.causes[result.cause] = 1
        counts.caught.update(result.caught)
        counts.decisions, counts.health = result.decisions, Health.of_runs(1, [evaluation])
        counts.doubt, counts.broken = result.doubt, result.broken
        return counts

    def __iadd__(self, other: Counts) -> Self:
        # Counters are added by name, so that a new one cannot be forgotten.
        for name in _COUNTERS:
            getattr(self, name).update(getattr(other, name))
        for signature, more in other.failures.items():
            self.failures[signature] = self.failures.get(signature, Alike()) + more
        self.decisions += other.decisions
        self.health += other.health
        self.doubt = self.doubt or other.doubt
        # None means that the reference did not run. It has failed in all its runs only if no part is empty.
        if None in (self.broken, other.broken):
            self.broken = other.broken if self.broken is None else self.broken
        else:
            self.broken = other.broken and self.broken
        return self


_COUNTERS = [each.name for each in fields(Counts) if str(each.type).startswith("Counter")]


@dataclass(slots=True, kw_only=True)
class Driver:
    """The function that other processes call to simulate chunks of a random search."""

    examiner: Examiner  # evaluates each run
    # returns the scenario with a number; None before the search starts
    drawn: Callable[[int], Scenario] | None = None

    def __call__(
        self,
        chunk: Chunk,
        job: Job,
        record: CrashRecord,
        say: Callable[[Timed | RunItHere], object],
    ) -> None:
        """Sample and simulate the scenarios of a chunk, and pass the results to ``say``."""
        assert self.drawn is not None  # noqa: S101  (it is set before the first chunk)
        # The process learns new failures within the chunk, but not those of other chunks, so a failure can be
        # reported twice.
        known = set(chunk.known)
        examine = partial(self.examiner, known=known)
        counted = Timed(Counts(), CapturedOutput(), 0.0)
        for number in range(chunk.first, chunk.end):
            answer = self._answer(number, chunk, job, record, examine)
            # A message costs the session more time than a run, so runs that are only counted share a message.
            match answer:
                case Timed(Result(failed=None) as result) if self.examiner.note is None:
                    counted.value.__iadd__(Counts.from_result(result, number))
                    counted = Timed(
                        counted.value,
                        counted.output.followed_by(answer.output),
                        counted.seconds + answer.seconds,
                    )
                    continue
                case Timed(Result() as result):
                    known |= {result.evaluation.kind} - {None}
                case _:
                    pass
            # What was counted comes before this message, because the session counts in the order of numbers.
            if counted.value.runs:
                say(counted)
                counted = Timed(Counts(), CapturedOutput(), 0.0)
            say(answer)
        if counted.value.runs:
            say(counted)

    def _answer(
        self,
        number: int,
        chunk: Chunk,
        job: Job,
        record: CrashRecord,
        examine: Callable[[Trace], Result],
    ) -> Timed | RunItHere:
        assert self.drawn is not None  # noqa: S101  (as above)
        scenario = self.drawn(number)
        # The session has noted a death in this scenario, and must not lose a second process to it.
        if scenario in chunk.fatal:
            return RunItHere(LookupError("a process died in this scenario before"))
        try:
            ran = run_recorded(job, record, scenario, read=examine)
        except MemoryError:  # The session must not use up its memory in the same way.
            raise
        except Exception as error:  # noqa: BLE001  (the session runs it again, and reports what is raised)
            return RunItHere(error)
        if isinstance(ran.value, Result):
            return ran
        return RunItHere(LookupError("only the session can evaluate this run"))


@dataclass(slots=True, kw_only=True)
class State:
    """The state of a search in progress."""

    counts: Counts = field(default_factory=Counts)  # counts of all runs so far
    # scenarios in which a process died; they are not run
    fatal: set[Scenario] = field(default_factory=set)
    is_random: bool = False  # whether all scenarios are random
    space: SearchSpace | None = None  # the space of its scenarios; None if it only replays
    clock: Callable[[], float] = monotonic  # returns the time [s]
    began: float = 0.0  # the time at which this session started [s]
    # ids of saved scenarios by their failure
    shown: Mapping[Signature, str] = field(default_factory=dict)
    finds: dict[Signature, str] = field(default_factory=dict)  # ids of new findings by signature
    is_set_up: bool = False  # True once the set-up is known to have no fault
    first: Scenario | None = None  # the first scenario that may show a fault of the set-up
    first_skipped: Scenario | None = None  # the first scenario that the test function skipped
    shrink_runs: int = 0  # number of attempts to shrink findings, and of runs for rates
    shrink_decisions: int = 0  # number of decisions of the ADS in these runs
    moment_runs: int = 0  # number of runs to find the moments of findings
    moment_decisions: int = 0  # number of decisions of the ADS in these runs
    generation: int = 0  # generation of the main search, from 0
    finished: PlanFinished | None = None  # the last event of the plan

    @property
    def runs(self) -> int:
        return self.counts.runs

    @property
    def is_alike(self) -> bool:
        """True while all runs so far may show the same fault in the set-up."""
        return not self.is_set_up and self.counts.is_alike

    @property
    def known(self) -> Set[Signature]:
        """The failures that are saved or that this search has already found."""
        return self.shown.keys() | self.finds.keys()

    @property
    def covered(self) -> Counter[str]:
        """The number of runs with each saved scenario's failure, by the scenario's id."""
        covered = Counter[str]()
        for signature, alike in self.counts.failures.items():
            if signature in self.shown:
                covered[self.shown[signature]] += alike.runs
        return covered

    def alike(self, find_id: str) -> Alike:
        """Return the counts for the other runs with a new finding's failure."""
        kept = Alike()
        for signature, id_ in self.finds.items():
            if id_ == find_id:
                kept = self.counts.failures.get(signature, kept)
        # -1 if only a run to shrink another finding failed in this way
        return replace(kept, runs=kept.runs - 1)

    @property
    def failures(self) -> dict[Signature, str]:
        """The id of the saved or new finding for each failure that occurred."""
        shown = {each: self.shown[each] for each in self.counts.failures if each in self.shown}
        return shown | self.finds

    @property
    def known_alone(self) -> str:
        """A note if only known failures of checks occurred, otherwise an empty string."""
        checks = {id_ for signature, id_ in self.shown.items() if signature.failure == CHECK_FAILED}
        covered = self.covered
        if (
            not covered
            or covered.total() < self.counts.kinds["failed"]
            or not checks.issuperset(covered)
        ):
            return ""
        names = " and ".join(f"saved-{id_}" for id_ in sorted(covered))
        which = "only the known check"
        if len(covered) > 1:
            which += "s"
        return f"{which} {names} failed, in {plural(covered.total(), 'run')}"

    def warnings(self, harness: Harness) -> tuple[str, ...]:
        counts = self.counts
        warnings = counts.health.warnings()
        excused = counts.kinds["npc"]
        # Otherwise, such a search would be green although the test never ran.
        if excused and not counts.kinds["passed"] and not counts.kinds["failed"]:
            warnings.append(
                f'the test function was never called, because blame="{harness.request.blame}" excludes all '
                f"{plural(excused, 'failure')} of this search. Search longer"
            )
        warnings += [
            f"check {name!r} failed in {runs} of {counts.kinds['passed']} runs that passed, because the test function "
            "caught its exception. Do not catch it, or use pafot.target, which never fails"
            for name, runs in sorted(counts.caught.items())
        ]
        if counts.broken:
            warnings.append(
                "the reference itself failed in all its runs, so no failure could count. Its first failure was "
                f"{counts.broken}. Correct the reference, its factory, or the world= in which it drives"
            )
        return tuple(warnings)

    @property
    def seconds(self) -> float:
        return self.clock() - self.began

    def take(self, result: Result) -> None:
        number = self.generation if self.is_random else self.runs
        self.counts += Counts.from_result(result, number)
        if result.ended == "lost":  # It is not run again, because another process would die.
            self.fatal.add(result.evaluation.scenario)
        if result.cause is not None:
            self.first = self.first or result.evaluation.executed
        if result.kind == "skipped":
            self.first_skipped = self.first_skipped or result.evaluation.executed

    def forget_findings(self) -> None:
        """Remove all failures, because they are due to a fault in the set-up."""
        self.counts.failures.clear()
        self.finds.clear()
