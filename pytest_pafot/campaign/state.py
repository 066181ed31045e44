"""What a search knows of all its runs: its counts and failures, in this session and in those that it resumes."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Judged, SearchEvent
from pytest_pafot.campaign.harness import Harness
from pytest_pafot.campaign.options import Settings
from pytest_pafot.campaign.setup_fault import FirstGeneration
from pytest_pafot.campaign.state_file import FLAG, StateFile
from pytest_pafot.campaign.store import Store
from pytest_pafot.campaign.tallies import Tally
from pytest_pafot.campaign.verdict import FAILING, Counts, Verdict, fails_by_ego
from pytest_pafot.corpus.layout import link_below
from pytest_pafot.corpus.saved import refusal
from pytest_pafot.execution.scenario_pool import LostRun, expectation
from pytest_pafot.findings.finding import Manner
from pytest_pafot.findings.shrink import Shown
from pytest_pafot.findings.signature import CHECK_FAILED, Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching import events
from pytest_pafot.searching.ask_tell import Algorithm
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.plan import Plan
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.references import referred_to
from pytest_pafot.support.source_files import source_digests
from pytest_pafot.support.text import plural
from pytest_pafot.world import codec

COUNTED_AT_ONCE = 16
"""The number of evaluations after which their health is counted: then it takes less time than for each alone."""

Answered = tuple[str, Shown]
"""An attempt to shrink a finding: the id of the candidate, and the result of its run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EarlierFind:
    """A finding of an earlier session of the same search.

    Attributes:
        id: the id of the finding, which is the name of its file.
        signature: distinguishes the finding from other findings.
        repeats: the number of other runs that failed in the same way.
        found: the scenario as found, its generation and the number of its run; None if the finding was only counted.
        is_due: True if the finding still must be simplified.
        answers: the attempts to shrink the finding so far, in their order; empty if it is not due.
    """

    id: str
    signature: Signature
    repeats: int
    found: tuple[Scenario, int, int] | None
    is_due: bool
    answers: tuple[Answered, ...]


@dataclass(slots=True)
class RandomRuns:
    """The first runs of a search, whose scenarios are random.

    Attributes:
        evaluated: the number of evaluated scenarios.
        runs: the number of runs that say something about the ego.
        at_fault: the number of those with a collision for which the ego is responsible, alone or with the NPC.
        otherwise: the number of those that failed in any other way, such as by a check or an error of the ADS.
        checks: the number of the latter that failed a check.
        most: the number of random scenarios with which the search begins; infinite if all are random.
        judged: the events of runs whose scenarios were not evaluated yet.
    """

    evaluated: int = 0
    runs: int = 0
    at_fault: int = 0
    otherwise: int = 0
    checks: int = 0
    most: float = field(init=False, default=0.0)
    judged: dict[Scenario, Judged] = field(init=False, default_factory=dict)

    @property
    def is_whole(self) -> bool:
        """True if all random scenarios at the beginning of the search were run."""
        return self.evaluated >= self.most

    def see(self, event: SearchEvent) -> None:
        """Count an event of the beginning. A scenario may be judged twice before it is evaluated."""
        if self.is_whole:
            return
        if isinstance(event, Judged):
            self.judged[event.scenario] = event
        elif isinstance(event, events.Evaluated):
            judged = self.judged.pop(event.evaluation.scenario, None)
            if judged is None or judged.verdict.discarded or judged.verdict.kind == "invalid":
                self._add(1, 0, 0, 0, 0)
            else:
                is_at_fault = fails_by_ego(judged.verdict, judged.responsibility)
                is_other = judged.verdict.kind in FAILING and not is_at_fault
                self._add(1, 1, is_at_fault, is_other, is_other and judged.verdict.is_check)

    def take(self, evaluated: int, runs: int, at_fault: int, otherwise: int, checks: int) -> None:
        """Count runs that another process has judged, which are all of the beginning or none."""
        if not self.is_whole:
            self._add(evaluated, runs, at_fault, otherwise, checks)

    def _add(self, evaluated: int, runs: int, at_fault: int, otherwise: int, checks: int) -> None:
        self.evaluated, self.runs = self.evaluated + evaluated, self.runs + runs
        self.at_fault, self.otherwise = self.at_fault + at_fault, self.otherwise + otherwise
        self.checks += checks


@dataclass(slots=True, kw_only=True)
class State:
    """A search in progress, with everything that it has seen so far.

    The first fields, which can be given, are what a file of ``--pafot-resume`` stores of a search, in this order.

    Runs that this process judges are counted by :meth:`take` and, from the events of the plan, by :meth:`see`; those
    that another one judges by :meth:`take_tally`.
    """

    before: tuple[str, ...] = ()  # ids of the files saved before the search; others with its seed are its own findings
    seconds: float = 0.0  # the time of all earlier sessions [s]
    earlier: tuple[EarlierFind, ...] = ()  # the findings of earlier sessions in the order of discovery
    covered: Counter[str] = field(default_factory=Counter)  # number of failing runs by the file that covers them
    counts: Counts = field(default_factory=Counts)  # numbers of runs by verdict, outcome and who was responsible
    caught: Counter[str] = field(default_factory=Counter)  # number of passed runs by a check that failed in them
    doubt: str = ""  # a doubt about the units of the ADS's actions, if any
    avoidable: str = ""  # what happened in the first run that is excused though braking late avoids the collision
    # how the reference itself failed in all its runs so far; empty if it did not in one of them, None before the first
    broken: str | None = None
    fatal: set[Scenario] = field(default_factory=set)  # scenarios in which a process died; they are not run
    random: RandomRuns = field(default_factory=RandomRuns)
    counted: Health = field(default_factory=Health)  # health of the evaluations that were counted

    space: SearchSpace | None = field(init=False, default=None)  # None for replays only
    plan: Plan[Any] | None = field(init=False, default=None)  # None before the first run
    file: StateFile | None = field(init=False, default=None)  # None if the search is in one session
    clock: Callable[[], float] = field(init=False, default=monotonic)  # returns the seconds since some moment
    began: float = field(init=False, default=0.0)  # the time at which this session began [s]
    shown: Mapping[Signature, str] = field(init=False, default_factory=dict)  # ids of saved scenarios by their failure
    finds: dict[Signature, str] = field(init=False, default_factory=dict)  # ids of new findings by signature
    repeats: Counter[str] = field(init=False, default_factory=Counter)  # number of other runs that show one, by id
    # for each failure that a saved scenario shows and each manner of it, the id of the first scenario of this session
    manners: dict[Signature, dict[Manner, str]] = field(init=False, default_factory=dict)
    failures: dict[Signature, str] = field(init=False, default_factory=dict)  # ids by failures that this session showed
    # results of the attempts to shrink each finding so far, by the id of the finding
    answers: dict[str, list[Answered]] = field(init=False, default_factory=dict)
    refined: set[str] = field(init=False, default_factory=set)  # ids of findings for which no step is left to do
    shrink_runs: int = field(init=False, default=0)  # number of attempts to shrink findings, and of runs for rates
    shrink_decisions: int = field(init=False, default=0)  # that the ADS made in these
    moment_runs: int = field(init=False, default=0)  # number of runs in which the ADS is asked again beside a run
    moment_decisions: int = field(init=False, default=0)  # that the ADS made in these
    uncounted: list[events.Evaluated] = field(init=False, default_factory=list)
    generation: int = field(init=False, default=0)  # generation of the main search, from 0
    finished: events.CampaignFinished | None = field(init=False, default=None)  # the last event of the plan
    skip: BaseException | None = field(init=False, default=None)  # the last skip of the test function
    first_generation: FirstGeneration = field(init=False, default_factory=FirstGeneration)
    # the numbers of runs and generations of earlier sessions; None if there is none
    done_before: tuple[int, int] | None = field(init=False, default=None)
    # ids of findings that still must be shrunk, but not in this session, which has no time left for them
    postponed: set[str] = field(init=False, default_factory=set)

    @property
    def runs(self) -> int:
        """The number of scenarios that were simulated so far."""
        return self.counts.kinds.total()

    @property
    def health(self) -> Health:
        """The figures that say whether the search tested anything."""
        self.count()
        return self.counted

    def count(self) -> None:
        """Count the evaluations since the last call. Counting is delayed so that no scenario has to wait for it."""
        self.counted += Health.of(self.uncounted)
        self.uncounted.clear()

    @property
    def known_alone(self) -> str:
        """A note if all failures so far are known failures of checks; empty if nothing or anything else failed."""
        checks = {id_ for signature, id_ in self.shown.items() if signature.failure == CHECK_FAILED}
        if (
            not self.covered
            or self.covered.total() < self.counts.kinds["failed"]
            or not checks.issuperset(self.covered)
        ):
            return ""
        names = " and ".join(f"saved-{id_}" for id_ in sorted(self.covered))
        which = "a failed check" if len(self.covered) == 1 else "failed checks"
        return f"all {plural(self.covered.total(), 'failing run')} are known, by {names}, {which}; nothing else failed"

    def warnings(self, harness: Harness) -> tuple[str, ...]:
        """Return warnings about the search's health, and about a test or reference with which nothing can fail."""
        warnings = self.health.warnings()
        excused = sum(self.counts.kinds[kind] for kind in ("npc", "avoidable", "unpreventable"))
        if excused and not self.counts.kinds["passed"] and not self.counts.kinds["failed"]:
            warnings.append(
                f'the test function judged nothing: blame="{harness.request.blame}" excludes all '
                f"{plural(excused, 'failure')} that it could judge; search longer"
            )
        warnings += [
            f"check {name!r} failed in {runs} of {self.counts.kinds['passed']} runs that passed: the test function "
            "caught its exception; do not catch it, or use pafot.target, which never fails"
            for name, runs in sorted(self.caught.items())
        ]
        if self.broken:
            warnings.append(
                f"the reference itself failed in all its runs, at first with {self.broken}, so no failure could count; "
                "correct the reference, its factory, or the world= in which it drives"
            )
        return tuple(warnings)

    @property
    def seconds_so_far(self) -> float:
        """The time that the search has taken so far, in all its sessions [s]."""
        return self.clock() - self.began + self.seconds

    def budget(self, settings: Settings) -> tuple[int | None, int | None]:
        """Return the numbers of runs and generations after which this session ends, counted from the first one on."""
        runs, generations = self.done_before or (0, 0)
        return (
            None if settings.runs is None else runs + settings.runs,
            None if settings.generations is None else generations + settings.generations,
        )

    def resume(self, earlier: State, *, runs: int, generations: int) -> None:
        """Go on from the state of an earlier session, after so many runs and generations."""
        most = self.random.most
        for each in fields(self):
            if each.init:
                setattr(self, each.name, getattr(earlier, each.name))
        self.random.most = most
        self.finds = {each.signature: each.id for each in earlier.earlier}
        self.repeats = Counter({each.id: each.repeats for each in earlier.earlier})
        self.done_before, self.generation = (runs, generations), generations

    def offer(self, store: Store) -> None:
        """Write the state, unless it was written shortly before: a session that is killed loses little."""
        if self.file is not None and self.file.is_due:
            self._write(self.file, store)

    def write(self, store: Store) -> None:
        """Write the state at the end of a session."""
        if self.file is not None and self.finished is not None:
            self._write(self.file, store)

    def _write(self, file: StateFile, store: Store) -> None:
        if self.plan is not None:
            file.write(self.plan.checkpoint(), self.stored(store))

    def close(self) -> None:
        """Release the file for other sessions."""
        if self.file is not None:
            self.file.release()

    def stored(self, store: Store) -> State:
        """Return what the file has to say of this state."""
        findings = store.findings
        found = {each.id: each.found for each in self.earlier}
        for id_, each in findings.items():  # the scenario as found, before shrinking
            finding = each.finding
            found[id_] = (finding.original or finding.scenario, finding.found.generation, each.number)
        due = self.postponed | {id_ for id_, each in findings.items() if each.is_firm and id_ not in self.refined}
        finds = (
            EarlierFind(
                id=id_,
                signature=signature,
                repeats=self.repeats[id_],
                found=found.get(id_),
                is_due=id_ in due,
                answers=tuple(self.answers.get(id_, ())) if id_ in due else (),
            )
            for signature, id_ in self.finds.items()
        )
        self.count()
        return replace(self, seconds=self.seconds_so_far, earlier=tuple(finds))

    def see(self, event: SearchEvent) -> None:
        """Count what an event says.

        Raises:
            SetupFaultError: if all runs of the first generation end in the same exception.
        """
        self.random.see(event)
        match event:
            case events.Evaluated():
                self.uncounted.append(event)
                if len(self.uncounted) >= COUNTED_AT_ONCE:
                    self.count()
            case events.GenerationFinished(local_generation=0):
                self.generation = event.generation + 1
                self.first_generation.end()
            case events.LocalSearchStarted():
                self.generation = event.generation
            case events.LocalSearchFinished():
                self.generation = event.generation + 1
            case events.CampaignFinished():
                self.finished = event

    def take(self, run: Run, verdict: Verdict, caught: Iterable[str], doubt: str) -> None:
        """Count a run that this process has judged."""
        self.counts.add(verdict.kind, run.outcome, run.responsibility)
        # What says that the set-up is wrong: a check that the function catches, units, the same error in all runs. As
        # soon as two runs differ, the findings that were held back are no fault of the set-up.
        self.caught.update(caught)
        self.doubt = self.doubt or doubt
        self.avoidable = self.avoidable or verdict.excused
        if self.first_generation.is_alike:
            self.first_generation.see(run, verdict)
        if verdict.kind == "skipped":
            self.skip = verdict.exception
        if verdict.reference is not None and self.broken != "":
            broken = verdict.reference.failure if verdict.reference.is_ads else None
            self.broken = "" if broken is None else self.broken or f"{broken.kind}: {broken.message}"

    def take_tally(self, tally: Tally) -> None:
        """Count runs that another process has judged and counted."""
        self.random.take(*tally.random)
        self.counted += tally.health
        self.counts += tally.counts
        self.caught.update(tally.caught)
        self.doubt = self.doubt or tally.doubt
        self.avoidable = self.avoidable or tally.avoidable
        if self.first_generation.is_alike:
            self.first_generation.see_others(tally.counts.kinds)
        for signature, runs in tally.failed.items():
            if self.knows(signature):  # unless this process has judged the first of these runs otherwise
                self.repeat(signature, runs)
        for signature, manner, id_ in tally.manners:
            self.see_manner(signature, manner, id_)

    def knows(self, signature: Signature) -> bool:
        """Return whether a saved scenario shows a failure, or this search has found it before."""
        return signature in self.shown or signature in self.finds

    def repeat(self, signature: Signature, runs: int = 1) -> None:
        """Count runs with a failure that the search :meth:`knows`."""
        id_ = self.failures[signature] = self.shown.get(signature) or self.finds[signature]
        (self.covered if signature in self.shown else self.repeats)[id_] += runs

    def add(self, signature: Signature, find_id: str) -> None:
        """Take a new finding."""
        self.finds[signature] = self.failures[signature] = find_id

    def see_manner(self, signature: Signature, manner: Manner | None, scenario_id: str) -> None:
        """Remember how a failure came about that a saved scenario shows."""
        if signature in self.shown and manner is not None:
            self.manners.setdefault(signature, {}).setdefault(manner, scenario_id)

    def forget_findings(self) -> None:
        """Forget the failures of a search whose set-up is at fault: they must not count as findings or as known."""
        self.covered.clear()
        self.failures.clear()
        self.finds.clear()

    def found_before(self, store: Store) -> Counter[str]:
        """Return the number of failing runs for each saved finding of an earlier session, by the finding's id."""
        listed = {*store.findings}
        return Counter({id_: 1 + self.repeats[id_] for id_ in self.finds.values() if id_ not in listed})

    @property
    def notes(self) -> list[str]:
        """Lines for the summary on earlier sessions and their findings."""
        problem, anew = ("", "") if self.file is None else (self.file.problem, self.file.anew)
        postponed = f"no time was left to shrink {plural(len(self.postponed), 'finding')} of earlier sessions"
        return [
            *([f"resumed after {plural(self.done_before[0], 'run')} of earlier sessions"] if self.done_before else []),
            *([postponed] if self.postponed else []),
            *filter(None, [problem, anew]),
        ]


def lose(lost: LostRun, state: State, bench: Bench, store: Store, runs: int = 0) -> Generator[SearchEvent, None, str]:
    """Record a scenario whose process died or hung, so that it is never run again, not even in later sessions.

    ``runs`` is 1 if a run of the search died, and 0 if it was one to shrink, to examine or to compare a finding.
    Return the kind of the verdict. It is no failure if the reference does not pass the scenario either.
    """
    state.fatal.add(lost.task)
    if bench.is_common(lost.task):
        return "common"
    signature = expectation(lost).signature
    if state.knows(signature):
        state.repeat(signature, runs)
    else:
        sighting = store.add_lost(lost, state.generation)
        yield from store.publish(sighting)
        state.add(signature, sighting.id)
        state.repeats[sighting.id] += runs - 1
    return "failed"


def check_states(resume: str, here: Path) -> None:
    """Refuse a folder of states behind a link, because files are written and removed in that folder.

    ``resume`` is the path that the user gave, relative to ``here``.

    Raises:
        RequestError: if a relative path contains a link.
    """
    link = None if Path(resume).is_absolute() else link_below(here, here / resume)
    if link is not None:
        raise RequestError(f"{FLAG}: {refusal(link)}")


def agreed(harness: Harness, algorithm: Algorithm[Any], space: SearchSpace) -> dict[str, Any]:
    """Return the settings in which a state and a search must agree, as plain data.

    They include the hashes of the user's source files: those of the test, the ADS, the reference, the algorithm, the
    fitness and the world, with all that these files import. The code of a notebook has no file, and is not included.
    """
    request, sight = harness.request, harness.policy.sight
    names: list[str] = [each.name for each in fields(algorithm)] if is_dataclass(algorithm) else []
    values = {
        "test": harness.node_id,
        "seed": request.settings.seed,
        "algorithm": {"name": algorithm.name, **{name: getattr(algorithm, name) for name in names if name != "space"}},
        "space": space.plain,
        "world": codec.described(harness.world),
        "blame": request.blame,
        "fitness": request.fitness,
        "against": None if harness.against is None else harness.against.shown,
        "sight": None if sight is None else asdict(sight),
        "versions": harness.versions,
        "code": _code(harness),
    }
    data: dict[str, Any] = json.loads(json.dumps(values, default=_named))
    return data


def _code(harness: Harness) -> dict[str, str]:
    fitness, request = harness.request.fitness, harness.request
    own = referred_to(fitness) if isinstance(fitness, str) and ":" in fitness else fitness
    of_file = next(
        (each for each in [*sys.modules.values()] if getattr(each, "__file__", None) == harness.test_file), None
    )
    against = None if harness.against is None else harness.against.policy.factory
    given = (of_file, harness.test, harness.policy.factory, against, request.algorithm.made_by, own)
    return source_digests(*given, *codec.code_of(harness.world), here=harness.root)


def _named(value: object) -> str:
    """Return a text for an object that is not plain data: a function's name, or a text that may differ by process."""
    name = getattr(value, "__qualname__", None)
    return repr(value) if name is None else f"{getattr(value, '__module__', '')}:{name}"
