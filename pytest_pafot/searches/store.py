"""The findings of one search and their files."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import assert_never

from pytest_pafot.corpus.layout import SUFFIX, relative
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import CorpusWriteError, free_path, rewrite, write
from pytest_pafot.execution.crash_records import Leftover
from pytest_pafot.execution.runner import LostRun, expectation
from pytest_pafot.findings.finding import Expect, Finding, portable, speed_of
from pytest_pafot.findings.sighting import Discovery, Finished, Judged, Seen
from pytest_pafot.findings.verdict import PROCESS_CRASH, Signature, Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searches.bench import Confirmation, Differs, NoTime, Same
from pytest_pafot.searches.events import SearchEvent
from pytest_pafot.searches.harness import Harness, PlainFailure
from pytest_pafot.searches.results import (
    Counts,
    Result,
    State,
    cause_of_death,
    death_of,
    found_by,
    headline_of_death,
)
from pytest_pafot.support.errors import CorpusError, flag
from pytest_pafot.support.process import REPLACED, postponed

# The remark on a finding that there was no time to run again.
UNCONFIRMED = "it was not confirmed, because the time ran out"

# The expected result in the file of a scenario in which a process died for an unknown reason.
UNSEEN_CRASH = Expect(
    failure=PROCESS_CRASH,
    outcome=Outcome.ADS_ERROR,  # The ADS is the only code that can kill a process.
    time=0.0,
    message="the process ended while it ran this scenario",
)


@dataclass(frozen=True, slots=True)
class Saved:
    """A new finding of a search, saved but not yet reported."""

    seen: Seen

    @property
    def id(self) -> str:
        return self.seen.id


@dataclass(frozen=True, slots=True)
class OnlyCounted:
    """A new failure of a search that saves no findings."""

    id: str


@dataclass(frozen=True, slots=True, kw_only=True)
class EarlyFailure:
    """A failure that arrived before its turn, with its file unless it could not be saved."""

    result: Result
    number: int  # the number of its run
    files: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Settled:
    """A failure that counts although its turn never came."""

    signature: Signature
    id: str
    counts: Counts


@dataclass(slots=True, kw_only=True)
class Store:
    """The findings of one search, each saved immediately."""

    harness: Harness
    seed: int
    # Files that were replayed before the search. They do not show the findings that are saved here.
    replayed: frozenset[Path] = frozenset()
    findings: dict[str, Seen] = field(default_factory=dict)  # the findings so far, by id
    only_counts: bool = False  # True if failures are only counted, and not saved as findings
    # the exception of the first finding, for a debugger
    first_exception: BaseException | None = None
    # ids of findings that are saved but not yet reported
    held: list[str] = field(default_factory=list)
    # headlines of findings that do not count, by id
    dismissed: dict[str, str] = field(default_factory=dict)
    # failures that arrived before their turn
    early: dict[Signature, EarlyFailure] = field(default_factory=dict)
    # False once findings are reported immediately, because they are no fault of the set-up
    is_holding: bool = True

    @property
    def count(self) -> int:
        return len(self.findings) - len(self.held)

    @property
    def firm(self) -> int:
        """The number of findings that can be shrunk."""
        return sum(each.is_firm for each in self.findings.values())

    def add(self, result: Result, generation: int) -> Saved | OnlyCounted:
        """Save a new finding without reporting it. If failures are only counted, just return its id."""
        failed = result.failed
        assert failed is not None  # noqa: S101  (the failure is new)
        # The process that found the failure does not know the number of the generation.
        finding = failed.found_in(generation)
        self._forget_early(finding, failed.signature)
        # A comparison of algorithms counts failures, and must not write into anybody's corpus.
        if self.only_counts:
            return OnlyCounted(finding.id)
        verdict = Verdict(
            kind="failed", exception=PlainFailure(failed.text), severity=result.severity
        )
        # An interrupt must not separate saving a finding from noting that it is held back.
        with postponed():
            seen = self._saved(finding, failed.headline, verdict, has_drawn=failed.drew)
            return Saved(self._held(seen))

    def confirmed(self, seen: Seen, confirmation: Confirmation) -> Seen:
        """Update a finding with the comparison with its second run, and return the new version."""
        match confirmation:
            case Same():
                pass
            case Differs(why=why):
                # The file states it as well, because a replay must not trust a single run of a flaky
                # scenario.
                seen = self.call_flaky(seen, why)
            case NoTime():
                seen = replace(seen, unshrunk=UNCONFIRMED)
            case _:
                assert_never(confirmation)
        for again in confirmation.again:
            # This process has no run of its own if another process found the failure.
            seen = seen.with_observed(ended=Finished(run=again.run, verdict=again.verdict))
        self.findings[seen.id] = seen
        return seen

    def add_early(self, result: Result, number: int, known: Collection[Signature]) -> None:
        """Save a new failure before its turn, so that it is not lost if the session is killed."""
        failed = result.failed
        # Only the first of several equal failures is saved. Which one that is does not depend on the number
        # of processes, because the one with the lowest number replaces it in its turn.
        if failed is None or failed.signature in known or failed.signature in self.early:
            return
        finding = failed.found_in(number)
        with postponed():  # An interrupt must not leave a file that no report mentions.
            files: tuple[Path, ...] = ()
            if self.harness.request.settings.save != "none":
                path, finding = free_path(self.harness.folder, finding, self.replayed)
                with suppress(CorpusWriteError):  # The error is reported in its turn.
                    if write(path, finding):
                        files = (path,)
            early = EarlyFailure(result=result, number=number, files=files)
            self.early[failed.signature] = early

    def _forget_early(self, finding: Finding, signature: Signature) -> None:
        # Remove the file of an early failure if the same failure came before it in another run.
        early = self.early.pop(signature, None)
        for path in () if early is None else early.files:
            if path != free_path(self.harness.folder, finding, self.replayed)[0]:
                _remove_early(path)

    def settle(self, *, keeps: bool) -> Iterator[Settled]:
        """Turn early failures into findings and yield them, or just remove their files."""
        for signature, early in [*self.early.items()]:
            if not keeps:
                for path in early.files:
                    _remove_early(path)
                continue
            added = self.add(early.result, early.number)
            if isinstance(added, Saved):
                self.findings[added.id] = replace(added.seen, unshrunk=UNCONFIRMED)
            counts = Counts.from_result(early.result, early.number)
            # Passing runs before it are not counted, so the failure rate would be too high.
            counts.fails.clear()
            yield Settled(signature=signature, id=added.id, counts=counts)
        self.early.clear()

    def release(self) -> Iterator[Seen]:
        """Yield the findings that were held back. Later findings are reported immediately."""
        self.is_holding = False
        # A copy, because publishing a finding removes it from the list.
        for find_id in tuple(self.held):
            yield from self.publish(self.findings[find_id])

    def withdraw(self) -> Iterator[Seen]:
        """Remove the findings that were held back, and yield those whose files cannot be removed."""
        # The failures of later scenarios have the same cause, so their files are removed, too.
        deque(self.settle(keeps=False), maxlen=0)
        withdrawn = [self.findings.pop(find_id) for find_id in self.held]
        self.held.clear()
        self.is_holding = False
        for sighting in withdrawn:
            try:
                if sighting.path:
                    self.file_of(sighting).unlink(missing_ok=True)
            except OSError:
                yield from self.publish(sighting)
        if not any(each.path for each in withdrawn):
            # Nothing was saved, and the folders may be behind a link, where nothing may be removed.
            return
        with suppress(OSError):  # Folders with other content stay.
            self._remove_folders()

    def dismiss(self, sighting: Seen, why: str) -> Iterator[Seen]:
        """Remove the file of a finding that does not count, and report it."""
        sighting = sighting.with_observed(label="no worse")
        sighting = replace(sighting, detail=why, unshrunk="")
        if sighting.path:
            # A file that cannot be removed stays, and is reported with its path.
            with suppress(OSError):
                self.file_of(sighting).unlink(missing_ok=True)
                sighting = replace(sighting, path="")
            with suppress(OSError):  # Folders with other content stay.
                self._remove_folders()
        with postponed():
            del self.findings[sighting.id]
            self.dismissed[sighting.id] = sighting.headline
            self.first_exception = next((each.raised for each in self.findings.values()), None)
            yield sighting

    def _remove_folders(self) -> None:
        for folder in (self.harness.folder, *self.harness.folder.parents[:2]):
            folder.rmdir()

    def publish(self, sighting: Seen) -> Iterator[Seen]:
        """Yield a new or updated finding, which is reported once the next event is requested."""
        with postponed():
            self.findings[sighting.id] = sighting
            # The exception of the first finding is updated when the finding is simplified.
            if self.first_exception is None or sighting.id == next(iter(self.findings)):
                self.first_exception = sighting.raised
            yield sighting
            if sighting.id in self.held:
                self.held.remove(sighting.id)

    def call_flaky(self, sighting: Seen, difference: str) -> Seen:
        """Mark a finding as flaky, in memory and in its file, with the ``difference`` between its runs."""
        # The file can be replayed elsewhere, so it must not contain paths of this machine.
        flaky = portable(difference, str(self.harness.root))
        marked = replace(sighting, finding=replace(sighting.finding, flaky=flaky), unshrunk="")
        self.findings[sighting.id] = self.rewritten(marked)
        return self.findings[sighting.id]

    @REPLACED.shown(False)
    def rewritten(self, sighting: Seen) -> Seen:
        """Write a changed finding to its file, and return it."""
        if not sighting.path:
            return sighting
        try:
            return replace(sighting, finding=rewrite(self.file_of(sighting), sighting.finding))
        except CorpusWriteError as error:
            return replace(sighting, detail=f"could not be updated: {error}")

    def note_worst(self, state: State) -> Iterator[Seen]:
        """Save the highest closing speed of runs with the same failure, and yield the changed findings."""
        for sighting in [*self.findings.values()]:
            found, worst = sighting.finding.found, speed_of(state.alike(sighting.id).severity)
            if worst is not None and worst > (found.worst_closing_speed or 0.0):
                noted = replace(sighting.finding, found=replace(found, worst_closing_speed=worst))
                yield from self.publish(self.rewritten(replace(sighting, finding=noted)))

    def file_of(self, sighting: Seen) -> Path:
        return self.harness.folder / f"{sighting.id}{SUFFIX}"

    def add_crash(self, leftover: Leftover, scenario: Scenario, deaths: Sequence[LostRun]) -> Seen:
        """Save a scenario in which an earlier session's process died.

        ``deaths`` has the death of the process that ran the scenario again, if that died, too.
        """
        text = f"a process (pid {leftover.pid}) died while it ran this scenario"
        expect = UNSEEN_CRASH
        line = "crash: a process died while it ran this scenario"
        for death in deaths:
            why = cause_of_death(death, "delete the file")
            text += f", and the process that ran it again {death.end}: {why}"
            expect = expectation(death)
            line = headline_of_death(death)
        if not deaths:
            text += (
                ". Possible causes are a crash in native code, something that accumulates from run to run, such as "
                "memory, and a signal from outside. If something else killed the process, delete the file"
            )
        found = found_by(self.harness, self.seed, algorithm="crash")
        finding = death_of(self.harness, scenario, expect, found=found, world=leftover.world)
        verdict = Verdict(kind="failed", exception=PlainFailure(text))
        with postponed():
            return self._held(self._saved(finding, line, verdict))

    def _held(self, sighting: Seen) -> Seen:
        self.findings[sighting.id] = sighting
        self.held.append(sighting.id)
        return sighting

    @REPLACED.shown(False)  # restores functions that the test function has replaced
    def _saved(
        self, finding: Finding, line: str, verdict: Verdict, *, has_drawn: bool = False
    ) -> Seen:
        path, finding = free_path(self.harness.folder, finding, self.replayed)
        # Two failures can have the same scenario, and so the same id, but need one file each.
        while finding.id in self.findings:
            finding = replace(finding, id=f"{finding.id}-again")
            path = self.harness.folder / f"{finding.id}{SUFFIX}"
        problem = ""
        try:
            # The finding is reported all the same, with the option as the reason why it has no file.
            if self.harness.request.settings.save == "none":
                problem = flag("save", "none")
            # Between the check and the write, another session may use the name for its own finding.
            while not problem and not write(path, finding):
                other, renamed = free_path(self.harness.folder, finding, self.replayed)
                if other == path:
                    break
                path, finding = other, renamed
        except CorpusWriteError as error:
            problem = str(error)
        return Seen(
            finding=finding,
            node_id=self.harness.saved_node_id(finding.id),
            headline=line,
            path="" if problem else relative(path, self.harness.root),
            detail=problem,
            observed=Discovery(
                ended=Judged(verdict=verdict), severity=verdict.severity, has_drawn=has_drawn
            ),
        )


def _remove_early(path: Path) -> None:
    # The file stays if someone has accepted its failure or put another file there.
    with suppress(OSError, CorpusError):
        if load(path).xfail is None:
            path.unlink()


def record_death(result: Result, state: State, store: Store) -> Iterator[SearchEvent]:
    """Save a scenario in which a process was lost, unless its failure is known. ``State.take`` counts it."""
    # Before anything else, so that no later step runs it again.
    state.fatal.add(result.evaluation.scenario)
    failed = result.failed
    if failed is None or failed.signature in state.known:
        return
    added = store.add(result, state.generation)
    if isinstance(added, Saved):
        yield from store.publish(added.seen)
    state.finds[failed.signature] = added.id
