"""The findings of one search and their files."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Generator, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import SearchEvent
from pytest_pafot.campaign.harness import Harness, PlainFailure
from pytest_pafot.campaign.results import Counts, Result, State, found_by, lost
from pytest_pafot.corpus.layout import SUFFIX, relative
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import CorpusWriteError, free_path, rewrite, write
from pytest_pafot.execution.crash_records import Leftover
from pytest_pafot.execution.pool import OUT_OF_MEMORY, WORLD_HANGS
from pytest_pafot.execution.runner import LostRun, expectation
from pytest_pafot.findings.finding import Expect, Finding, Found, portable, speed_of
from pytest_pafot.findings.sighting import Observed, Seen
from pytest_pafot.findings.verdict import PROCESS_CRASH, Signature, Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import CorpusError, flag
from pytest_pafot.support.process import REPLACED, postponed
from pytest_pafot.world import codec

# The remark on a finding that the time limit left no time to run again.
UNCONFIRMED = "not confirmed: out of time"

# The expected result in the file of a scenario in which a process died for an unknown reason.
UNSEEN_CRASH = Expect(
    failure=PROCESS_CRASH,
    outcome=Outcome.ADS_ERROR,  # The ADS is the only code that can kill a process.
    time=0.0,
    message="the process ended while it ran this scenario",
)


@dataclass(slots=True, kw_only=True)
class Store:
    """The findings of one search, each saved immediately."""

    # Findings are held back until it is clear that they are no fault of the set-up.

    harness: Harness
    seed: int
    # Files that existed before the search; their replays do not show the findings that are saved here.
    replayed: frozenset[Path] = frozenset()
    findings: dict[str, Seen] = field(default_factory=dict)  # the findings so far, by id
    only_counts: bool = False  # True if new failures are only counted, and no finding is made of them
    first_exception: BaseException | None = None  # the exception of the first finding, for a debugger
    held: list[str] = field(default_factory=list)  # ids of findings that are saved and not reported yet
    dismissed: dict[str, str] = field(default_factory=dict)  # headlines of findings that do not count, by id
    # Failures before their turn with the numbers of their runs, and their files, if any.
    early: dict[Signature, tuple[Path | None, Result, int]] = field(default_factory=dict)
    is_holding: bool = True  # False once findings are reported immediately, because they are no fault of the set-up

    @property
    def count(self) -> int:
        """The number of distinct findings reported so far."""
        return len(self.findings) - len(self.held)

    @property
    def firm(self) -> int:
        """The number of findings that can be shrunk."""
        return sum(each.is_firm for each in self.findings.values())

    def add(self, result: Result, generation: int) -> Seen | str:
        """Save a new finding without reporting it yet."""
        # Nothing is saved if failures are only counted. `generation` is counted from 0.
        failed = result.failed
        assert failed is not None  # noqa: S101  (the failure is new)
        finding = failed.found_in(generation)
        self._forget_early(finding, failed.signature)
        if self.only_counts:
            return finding.id
        with postponed():  # Whatever interrupts the search from here on, it ends with a report of what is held.
            verdict = Verdict(kind="failed", exception=PlainFailure(failed.text), severity=result.severity)
            return self._held(self._saved(finding, failed.headline, verdict, has_drawn=failed.drew))

    def confirmed(self, sighting: Seen, run: Run | None, verdict: Verdict | None, differs: str | None) -> Seen:
        """Return a finding with the results of :meth:`.Bench.confirm`."""
        if differs:
            sighting = self.call_flaky(sighting, differs)
        elif differs is None:
            sighting = replace(sighting, unshrunk=UNCONFIRMED)
        if run is not None and verdict is not None:
            observed = replace(sighting.observed, run=run, verdict=verdict)
            sighting = replace(sighting, observed=observed)
        self.findings[sighting.id] = sighting
        return sighting

    def add_early(self, result: Result, number: int, known: Collection[Signature]) -> None:
        """Save a failure that is not yet known and counted."""
        # It must not be lost if the session is killed.
        failed, saved = result.failed, None
        if failed is None or failed.signature in known or failed.signature in self.early:
            return
        finding = failed.found_in(number)
        with postponed():  # A file that an interrupt leaves unnoted would be in no report.
            if self.harness.request.settings.save != "none":
                path, finding = free_path(self.harness.folder, finding, self.replayed)
                with suppress(CorpusWriteError):  # which is reported in its turn
                    saved = path if write(path, finding) else None
            self.early[failed.signature] = saved, result, number

    def _forget_early(self, finding: Finding, signature: Signature) -> None:
        # An early file is removed once a failure of its kind has come before it.
        path, *_ = self.early.pop(signature, (None,))
        if path is not None and path != free_path(self.harness.folder, finding, self.replayed)[0]:
            _remove_early(path)

    def settle(self, *, keeps: bool) -> Iterator[tuple[Signature, str, Counts]]:
        """End the search with failures that were saved before their turn."""
        # They become findings, or their files are removed. Of each finding, the signature, the id, and the counts of
        # its run are yielded.
        for signature, (path, result, number) in [*self.early.items()]:
            if keeps:
                sighting = self.add(result, number)
                id_ = sighting if isinstance(sighting, str) else sighting.id
                if not isinstance(sighting, str):
                    self.findings[id_] = replace(sighting, unshrunk=UNCONFIRMED)
                counts = Counts.of(result, number)
                counts.fails.clear()  # the passing runs next to it are not counted, so the proportion would be too high
                yield signature, id_, counts
            elif path is not None:
                _remove_early(path)
        self.early.clear()

    def release(self) -> Iterator[Seen]:
        """Yield the findings that were held back, and hold back no more."""
        self.is_holding = False
        for find_id in tuple(self.held):
            yield from self.publish(self.findings[find_id])

    def withdraw(self) -> Iterator[Seen]:
        """Remove the files of findings that were held back."""
        # They are a fault of the set-up. Findings with files that cannot be removed are yielded.
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
            return  # Nothing was saved, and the folders may be behind a link, where nothing may be removed.
        with suppress(OSError):  # Folders with other content stay.
            self._remove_folders()

    def dismiss(self, sighting: Seen, why: str) -> Iterator[Seen]:
        """Remove the file of a finding that does not count, and report it."""
        no_worse = replace(sighting.observed, new="no worse")
        sighting = replace(sighting, observed=no_worse, detail=why, unshrunk="")
        if sighting.path:
            with suppress(OSError):  # A file that cannot be removed stays, and is reported with its path.
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
        """Yield a new finding, or an update of one."""
        # It is reported as soon as the next event is requested.
        with postponed():
            self.findings[sighting.id] = sighting
            if self.first_exception is None or sighting.id == next(iter(self.findings)):
                self.first_exception = sighting.raised
            yield sighting
            if sighting.id in self.held:
                self.held.remove(sighting.id)

    def call_flaky(self, sighting: Seen, difference: str) -> Seen:
        """Mark a finding as flaky, here and in its file."""
        # `difference` is what did not repeat.
        flaky = portable(difference, str(self.harness.root))
        marked = replace(sighting, finding=replace(sighting.finding, flaky=flaky), unshrunk="")
        self.findings[sighting.id] = self.rewritten(marked)
        return self.findings[sighting.id]

    @REPLACED.shown(False)
    def rewritten(self, sighting: Seen) -> Seen:
        """Write a changed finding to its file."""
        # The `xfail` in the file stays. If the file cannot be written, the detail of the finding states why.
        if not sighting.path:
            return sighting
        try:
            return replace(sighting, finding=rewrite(self.file_of(sighting), sighting.finding))
        except CorpusWriteError as error:
            return replace(sighting, detail=f"could not be updated: {error}")

    def note_worst(self, state: State) -> Iterator[Seen]:
        """Write the worst speeds of similar runs into files, and yield the findings."""
        for sighting in [*self.findings.values()]:
            found, worst = sighting.finding.found, speed_of(state.alike(sighting.id).severity)
            if worst is not None and worst > (found.worst_closing_speed or 0.0):
                noted = replace(sighting.finding, found=replace(found, worst_closing_speed=worst))
                yield from self.publish(self.rewritten(replace(sighting, finding=noted)))

    def file_of(self, sighting: Seen) -> Path:
        """Return the file of a finding that has one."""
        return self.harness.folder / f"{sighting.id}{SUFFIX}"

    def add_crash(self, leftover: Leftover, scenario: Scenario, again: LostRun | None) -> Seen:
        """Save a scenario in which a process of an earlier session died."""
        # `again` describes how a second process ended that ran the scenario again; None if that is unknown.
        text = f"a process (pid {leftover.pid}) died while it ran this scenario, "
        if again is None:
            text += (
                "because of a crash of native code, something that accumulates from run to run, such as memory, "
                "or a kill from outside. If it was killed from outside, delete the file"
            )
        else:
            text += f"and the one that ran it again {again.end}: {cause(again, 'delete the file')}"
        expect, line = UNSEEN_CRASH, "crash: a process died while it ran this scenario"
        if again is not None:
            expect, line = expectation(again), _headline(again)
        finding = self._death(scenario, expect, found_by(self.harness, self.seed, algorithm="crash"), leftover.world)
        with postponed():
            return self._held(self._saved(finding, line, Verdict(kind="failed", exception=PlainFailure(text))))

    def add_lost(self, lost: LostRun, generation: int) -> Seen:
        """Save a scenario with a process that died or hung."""
        again = "" if lost.is_hang else ", even when it was repeated"
        text = f"the {lost.who} that ran this scenario {lost.end}{again}: "
        text += cause(lost, f"delete the file, and use {flag('workers', 1)}")
        finding = self._death(lost.task, expectation(lost), found_by(self.harness, self.seed, generation), None)
        self._forget_early(finding, finding.signature)
        with postponed():
            died = Verdict(kind="failed", exception=PlainFailure(text))
            return self._held(self._saved(finding, _headline(lost), died))

    def _held(self, sighting: Seen) -> Seen:
        self.findings[sighting.id] = sighting
        self.held.append(sighting.id)
        return sighting

    def _death(self, scenario: Scenario, expect: Expect, found: Found, world: Mapping[str, Any] | None) -> Finding:
        return Finding(
            id=f"{'hang' if expect.outcome is Outcome.HANG else 'crash'}-{scenario.id}",
            test=self.harness.node_id,
            scenario=scenario,
            world=world or codec.described(self.harness.world),
            expect=expect,
            found=found,
            perception=self.harness.policy.sight,
        )

    @REPLACED.shown(False)  # also what the test function itself has replaced
    def _saved(self, finding: Finding, line: str, verdict: Verdict, *, has_drawn: bool = False) -> Seen:
        path, finding = free_path(self.harness.folder, finding, self.replayed)
        while finding.id in self.findings:
            finding = replace(finding, id=f"{finding.id}-again")
            path = self.harness.folder / f"{finding.id}{SUFFIX}"
        problem = ""
        try:
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
            observed=Observed(new="new", fails=True, verdict=verdict, severity=verdict.severity, has_drawn=has_drawn),
        )


def _remove_early(path: Path) -> None:
    # The file stays if somebody has accepted its failure or put another file there.
    with suppress(OSError, CorpusError):
        if load(path).xfail is None:
            path.unlink()


def _headline(lost: LostRun) -> str:
    return f"{'hang' if lost.is_hang else 'crash'}: the process that ran this scenario {lost.end}"


def cause(lost: LostRun, way_out: str) -> str:
    """Return why a process may have died or hung."""
    # With `way_out`, also what to do if the scenario is not the cause.
    if lost.end == OUT_OF_MEMORY:
        return "the ADS uses more and more memory, or needs more than its limit"
    if lost.end == WORLD_HANGS:
        return f"the world hangs, or is that slow (then set a longer hang_limit and {way_out})"
    if not lost.is_hang:
        return "the likely cause is a crash of native code, an exit, or a lack of memory"
    return (
        "the ADS hangs in code that does not return to the interpreter, ignores the interrupt, or uses a library that "
        f"does not work in a forked process (then {way_out})"
    )


def lose(death: LostRun, state: State, bench: Bench, store: Store) -> Generator[SearchEvent, None, Result]:
    """Record a scenario with a lost process, and return its result."""
    # It is never run again, not even in later sessions. It is no failure if the reference does not pass the scenario
    # either.
    state.fatal.add(death.task)
    result = lost(death.task, death, is_common=bench.is_common(death.task))
    signature = result.evaluation.kind
    if isinstance(signature, Signature) and signature not in state.known:
        sighting = store.add_lost(death, state.generation)
        yield from store.publish(sighting)
        state.finds[signature] = sighting.id
    return result
