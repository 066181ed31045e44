"""A search that goes on in several sessions: each reads the state of the earlier sessions and stores a new state."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pytest_pafot.campaign.events import Judged, Listener, SearchEvent
from pytest_pafot.campaign.harness import Harness
from pytest_pafot.campaign.search_loop import FAILING, SearchLoop, fails_by_ego
from pytest_pafot.campaign.state_file import FLAG, Answer, Counts, EarlierFind, StateFile, state_path
from pytest_pafot.corpus.layout import link_below
from pytest_pafot.corpus.saved import Saved, refusal
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import Algorithm, ResumableSearch
from pytest_pafot.searching.ask_tell_loop import Checkpoint
from pytest_pafot.searching.events import Evaluated, GroupEvaluated
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.references import referred_to
from pytest_pafot.support.source_files import source_digests
from pytest_pafot.support.text import plural
from pytest_pafot.world import codec
from pytest_pafot.world.driving.ads import weights_digest
from pytest_pafot.world.driving.perception import sight_of

# Counts of random scenarios that fail, and that fail by the ego's fault, among the first scenarios of a search.


@dataclass(slots=True, kw_only=True)
class RandomBeginning:
    """A listener that counts the first runs of a search while their scenarios are random, and passes all events on.

    Attributes:
        listener: receives the events.
        most: the number of random scenarios at the beginning of the search; infinite if all are random.
        runs: the number of counted runs so far: runs of random scenarios that say something about the ego.
        at_fault: the number of counted runs with a collision for which the ego is responsible, alone or with the NPC.
        otherwise: the number of counted runs that failed in any other way, such as by a check or an error of the ADS.
    """

    listener: Listener
    most: float = 0.0
    runs: int = 0
    at_fault: int = 0
    otherwise: int = 0
    _evaluated: int = 0
    _judged: dict[Scenario, Judged] = field(default_factory=dict)

    @property
    def is_whole(self) -> bool:
        """True if all random scenarios at the beginning of the search were run."""
        return self._evaluated >= self.most

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """The number of evaluated scenarios, ``runs``, ``at_fault`` and ``otherwise``."""
        return self._evaluated, self.runs, self.at_fault, self.otherwise

    def restore(self, evaluated: int, runs: int, at_fault: int, otherwise: int) -> None:
        """Set the counts to the counts of an earlier session, to continue that session."""
        self._evaluated, self.runs, self.at_fault, self.otherwise = evaluated, runs, at_fault, otherwise

    def __call__(self, event: SearchEvent) -> None:
        """Pass an event on to the listener and count it. A scenario may be judged twice before it is evaluated."""
        self.listener(event)
        if self.is_whole:
            return
        if isinstance(event, GroupEvaluated):
            evaluated, runs, at_fault, otherwise = event.counts.random
            self._evaluated, self.runs = self._evaluated + evaluated, self.runs + runs
            self.at_fault, self.otherwise = self.at_fault + at_fault, self.otherwise + otherwise
        elif isinstance(event, Judged):
            self._judged[event.scenario] = event
        elif isinstance(event, Evaluated):
            self._evaluated += 1
            judged = self._judged.pop(event.evaluation.scenario, None)
            if judged is not None and not (judged.verdict.discarded or judged.verdict.kind == "invalid"):
                self.runs += 1
                if judged.verdict.kind in FAILING:
                    is_at_fault = judged.run is not None and fails_by_ego(judged.run, judged.verdict)
                    self.at_fault += is_at_fault
                    self.otherwise += not is_at_fault


MAX_SAVED = flag("max_saved")


def check_states(resume: str, here: Path) -> None:
    """Refuse a folder of states behind a link, because files are written and removed in that folder.

    ``resume`` is the path that the user gave, relative to ``here``.

    Raises:
        RequestError: if a relative path contains a link.
    """
    link = None if Path(resume).is_absolute() else link_below(here, here / resume)
    if link is not None:
        raise RequestError(f"{FLAG}: {refusal(link)}")


@dataclass(slots=True, kw_only=True)
class Sessions:
    """All sessions of one search, including this session; without a folder of states, there is no other session."""

    harness: Harness
    seed: int  # the seed of the search
    loop: SearchLoop
    beginning: RandomBeginning
    clock: Callable[[], float]  # returns the seconds since some fixed moment
    begun: str = ""  # a note on the saved scenarios with which the search begins
    # results of the attempts to shrink each finding so far, by the id of the finding
    answers: dict[str, list[Answer]] = field(default_factory=dict)
    # ids of findings that still must be shrunk, but not in this session, which has no time left for them
    _postponed: set[str] = field(init=False, default_factory=set)
    _began: float = field(init=False)
    _file: StateFile | None = field(init=False, default=None)
    _last: Callable[[], Checkpoint[Any]] | None = field(init=False, default=None)  # makes the last checkpoint
    _before: tuple[str, ...] = field(init=False, default=())  # ids of files saved before the first session
    _earlier: Counts | None = field(init=False, default=None)
    _runs: int = field(init=False, default=0)  # runs of earlier sessions
    _generations: int = field(init=False, default=0)  # generations of earlier sessions
    # ids of findings of earlier sessions beyond the number that a search saves
    _unsaved_before: set[str] = field(init=False, default_factory=set)

    def __post_init__(self) -> None:
        self._began = self.clock()

    @property
    def go_on(self) -> bool:
        """True if the search stores its state, so that other sessions can resume it."""
        return self._file is not None

    @property
    def is_resumed(self) -> bool:
        """True if an earlier session has made some of the runs."""
        return self._earlier is not None

    @property
    def seconds(self) -> float:
        """The time that the search has taken so far, in all its sessions [s]."""
        return self.clock() - self._began + (0.0 if self._earlier is None else self._earlier.seconds)

    @property
    def budget(self) -> tuple[int | None, int | None]:
        """The numbers of runs and generations after which this session ends, counted from the first session on."""
        settings = self.harness.request.settings
        return (
            None if settings.runs is None else self._runs + settings.runs,
            None if settings.generations is None else self._generations + settings.generations,
        )

    @property
    def decides_for_many(self) -> bool:
        """True if the ADS has decided for many runs at once in any session."""
        earlier = self._earlier is not None and self._earlier.decides_for_many
        return earlier or self.loop.simulation.runner.decides_for_many

    @property
    def found_before(self) -> Counter[str]:
        """The number of failing runs for each saved finding of an earlier session, by the finding's id."""
        loop = self.loop
        told = {*loop.recorder.kept, *loop.recorder.unsaved, *self._unsaved_before}
        return Counter({id_: 1 + loop.repeats[id_] for id_ in loop.finds.values() if id_ not in told})

    @property
    def notes(self) -> list[str]:
        """Lines for the summary on earlier sessions and their findings."""
        went_on = f"resumed after {plural(self._runs, 'run')} of earlier sessions"
        problem, anew = ("", "") if self._file is None else (self._file.problem, self._file.anew)
        unsaved = self._unsaved_before
        shown = plural(sum(1 + self.loop.repeats[id_] for id_ in unsaved), "run")
        left = f"{plural(len(unsaved), 'finding')} of earlier sessions not saved ({MAX_SAVED}), shown by {shown}"
        postponed = f"no time was left to shrink {plural(len(self._postponed), 'finding')} of earlier sessions"
        return [
            *([] if self._earlier is None else [went_on]),
            *([postponed] if self._postponed else []),
            *([left] if unsaved else []),
            *filter(None, [problem, anew, self.begun]),
        ]

    def resume(self, algorithm: Algorithm[Any], space: SearchSpace, saved: Sequence[Saved]) -> Checkpoint[Any] | None:
        """Restore the counts of earlier sessions; return the checkpoint to resume from, or None for a new search.

        Raises:
            RequestError: if the algorithm cannot be resumed, or if the state belongs to another search or is in use by
                another session.
        """
        self._before = tuple(each.id for each in saved)
        if self.harness.states is None:
            return None
        name = self.harness.request.algorithm.name
        if not isinstance(algorithm, ResumableSearch):
            raise RequestError(
                f"{FLAG}: expected an algorithm that can be resumed, such as distinct or random, received {name!r}; "
                f"search without {FLAG}, or add the methods stored and restored to your own algorithm "
                "(pytest_pafot.searching.ResumableSearch)"
            )
        path = state_path(self.harness.states, self.harness.node_id)
        settings = agreed(self.harness, algorithm, space)
        self._file = StateFile(path=path, settings=settings, algorithm=algorithm, clock=self.clock)
        self._file.claim()
        state = self._file.read()
        if state is None:
            return None
        self._earlier, checkpoint = state
        self._before = self._earlier.before
        self._runs, self._generations = checkpoint.sums.simulated, checkpoint.generation
        restore(self._earlier, self.loop, self.beginning)
        self.loop.generation = self._generations
        if checkpoint.sums.evaluated:  # A fault of the set-up would have ended the search in its first session.
            self.loop.first.is_alike = False
            self.loop.recorder.release()
        return checkpoint

    def close(self) -> None:
        """Release the state for other sessions."""
        if self._file is not None:
            self._file.release()

    def refused(self, error: ValueError) -> RequestError:
        """Return the error for a state from which the algorithm cannot resume, with what the user can do."""
        return RequestError(str(error)) if self._file is None else self._file.refused(error)

    def is_own(self, saved: Saved) -> bool:
        """Return whether a saved scenario is a finding of this search from an earlier session."""
        found = None if saved.finding is None else saved.finding.found
        algorithm = self.harness.request.algorithm.name
        is_of_search = found is not None and (found.seed, found.algorithm) == (self.seed, algorithm)
        return self.go_on and is_of_search and saved.id not in self._before

    def find_again(self, saved: Sequence[Saved], until: float) -> None:
        """Run again the findings that earlier sessions have not shrunk, and the findings that have no file.

        If findings without a file were skipped, a search that saves none, or whose corpus was lost, would pass forever.
        After the time ``until`` [s], findings with a file are left to a later session.
        """
        __tracebackhide__ = True
        for find in () if self._earlier is None else self._earlier.finds:
            # There is a file of the same name, or a simpler one of the same kind after `corpus join`.
            is_there = any(
                each.id == find.id or (each.finding is not None and each.finding.signature == find.signature)
                for each in saved
            )
            if find.found is None:
                self._unsaved_before.add(find.id)
                continue
            if is_there and not find.is_due:
                continue
            if is_there and self.clock() >= until:
                self._postponed.add(find.id)
                self.answers[find.id] = list(find.answers)
                continue
            if not is_there:  # forget it, so that it counts as new again, even if the process dies in it
                del self.loop.finds[find.signature]
            scenario, generation, number = find.found
            try:
                run = self.loop.simulation.run(scenario, afresh=True)
            except ProcessLostError as error:
                self.loop.lose(error)
                continue
            verdict = self.loop.simulation.judge(run)
            failure = verdict.failure if verdict.failed else None
            if failure is not None and of_failure(run, failure) == find.signature:
                find_id = self.loop.recorder.keep(run, verdict, generation, number)
                self.loop.finds[find.signature] = self.loop.failures[find.signature] = find_id
                self.answers[find_id] = list(find.answers)

    def at_border(self, checkpoint: Callable[[], Checkpoint[Any]]) -> None:
        """Store the state after a generation, unless it was stored shortly before.

        ``checkpoint`` makes the checkpoint.
        """
        self._last = checkpoint
        if self._file is not None:
            self._file.offer(checkpoint, self._counts)

    def after_attempt(self, simplified: Collection[str]) -> None:
        """Store the answers so far, unless the state was stored shortly before: a killed session loses few of them."""
        if self._file is not None and self._last is not None and self.loop.finished is not None:
            self._file.offer(self._last, partial(self._counts, simplified))

    def store(self, simplified: Collection[str] = ()) -> None:
        """Write the state at the end of the session; ``simplified`` are the ids of findings that are fully shrunk."""
        if self._file is not None and self._last is not None and self.loop.finished is not None:
            self._file.write(self._last(), self._counts(simplified))

    def _counts(self, simplified: Collection[str] = ()) -> Counts:
        loop = self.loop
        kept = loop.recorder.kept
        found = {each.id: each.found for each in (() if self._earlier is None else self._earlier.finds)}
        for id_, each in kept.items():  # the scenario as found, before shrinking
            finding = each.finding
            found[id_] = (finding.original or finding.scenario, finding.found.generation, each.number)
        due = self._postponed | {id_ for id_, each in kept.items() if each.is_firm and id_ not in simplified}
        return Counts(
            before=self._before,
            seconds=self.seconds,
            decides_for_many=self.decides_for_many,
            finds=tuple(
                EarlierFind(
                    id=id_,
                    signature=signature,
                    repeats=loop.repeats[id_],
                    found=found.get(id_),
                    is_due=id_ in due,
                    answers=tuple(self.answers.get(id_, ())) if id_ in due else (),
                )
                for signature, id_ in loop.finds.items()
            ),
            known=loop.known,
            verdicts=loop.verdicts,
            caught=loop.caught,
            doubt=loop.doubt,
            avoidable=loop.avoidable,
            broken=loop.broken,
            fatal=tuple(sorted(loop.fatal, key=Scenario.canonical)),
            random=self.beginning.counts,
            health=loop.health,
        )


def restore(counts: Counts, loop: SearchLoop, beginning: RandomBeginning) -> None:
    """Restore the counts of an earlier session in the loop of a search that has not begun."""
    loop.finds = {each.signature: each.id for each in counts.finds}
    loop.repeats = Counter({each.id: each.repeats for each in counts.finds})
    loop.known, loop.verdicts, loop.caught = map(Counter, (counts.known, counts.verdicts, counts.caught))
    loop.doubt, loop.broken, loop.counted = counts.doubt, counts.broken, counts.health
    loop.avoidable = counts.avoidable
    loop.fatal |= set(counts.fatal)
    beginning.restore(*counts.random)


def agreed(harness: Harness, algorithm: Algorithm[Any], space: SearchSpace) -> dict[str, Any]:
    """Return the settings in which a state and a search must agree, as plain data.

    They include the hashes of the user's source files: those of the test, the ADS, the reference, the algorithm, the
    fitness and the world, with all that these files import. The code of a notebook has no file, and is not included.
    """
    request, sight = harness.request, sight_of(harness.ads)
    names: list[str] = [each.name for each in fields(algorithm)] if is_dataclass(algorithm) else []
    values = {
        "test": harness.node_id,
        "seed": request.settings.seed,
        "algorithm": {"name": algorithm.name, **{name: getattr(algorithm, name) for name in names if name != "space"}},
        "space": space.plain,
        "world": codec.described(harness.world),
        "blame": request.blame,
        "fitness": request.fitness,
        "decision_limit": request.decision_limit,
        "against": None if harness.against is None else harness.against.commit or harness.against.shown,
        "sight": None if sight is None else asdict(sight),
        "weights": weights_digest(harness.ads),
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
    against = None if harness.against is None else harness.against.ads
    given = (of_file, harness.test, harness.ads, against, request.algorithm.made_by, own)
    return source_digests(*given, *codec.code_of(harness.world), here=harness.root)


def _named(value: object) -> str:
    """Return a text for an object that is not plain data: a function's name, or a text that may differ by process."""
    name = getattr(value, "__qualname__", None)
    return repr(value) if name is None else f"{getattr(value, '__module__', '')}:{name}"
