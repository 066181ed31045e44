"""What happens to a new find: its file first, then a look at whether it repeats, then everybody is told."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.confirmation import NOT_REPEATED
from pytest_pafot.campaign.harness import Bench
from pytest_pafot.campaign.summary import Find
from pytest_pafot.campaign.verdict import Verdict, plain_failure
from pytest_pafot.corpus import layout
from pytest_pafot.corpus.writer import CorpusWriteError, free_path, rewrite, write
from pytest_pafot.corpus.yaml_text import text_of
from pytest_pafot.execution.crash_records import Leftover
from pytest_pafot.execution.worker_pool import Lost
from pytest_pafot.findings.finding import Expect, Finding, Found, message_of, portable
from pytest_pafot.findings.signature import PROCESS_CRASH, Failure
from pytest_pafot.grid import Cell
from pytest_pafot.plugin import messages, node_ids
from pytest_pafot.plugin.failure_reports import is_compact, summarise
from pytest_pafot.plugin.session import SHARED
from pytest_pafot.report import terminal
from pytest_pafot.run import Run
from pytest_pafot.trace import Outcome
from pytest_pafot.world import codec as worlds

if TYPE_CHECKING:
    from pytest_pafot.plugin.page_messages import Showing
    from pytest_pafot.scenario import Scenario

NOT_SAVED = "--pafot-save=none"

UNSEEN_CRASH = Expect(
    failure=PROCESS_CRASH,
    outcome=Outcome.ADS_ERROR,  # The ADS is the code that a process can die in.
    time=0.0,
    message="the process ended while it ran this scenario",
)
"""What a scenario is expected to show in which a process died, nobody knows how."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """A finding with where it lies, or why it lies nowhere, and how it is told.

    Attributes:
        finding: as it lies in its file.
        find: as the terminal tells it.
        origin: how it was found, in one line.
        file: of it, or None.
        content: of the file that could not be written, or empty.
    """

    finding: Finding
    find: Find
    origin: str
    file: Path | None = None
    content: str = ""

    @property
    def is_firm(self) -> bool:
        """Whether its runs are expected to repeat, so that it can be shrunk."""
        return not (self.find.is_flaky or self.find.is_timed or self.finding.expect.is_crash)


@dataclass(frozen=True, slots=True, kw_only=True)
class Held:
    """A find that is saved and not told yet."""

    kept: Kept
    exception: BaseException
    run: Run


@dataclass(slots=True)
class Keeper:
    """Saves and announces the finds of one search.

    Attributes:
        bench: of the item.
        seed: of the search.
        confirm: says what differs when a run is repeated; empty where nothing does.
        showing: how finds are shown, where a page is asked for.
        replayed: files that were there before the search; a find that comes to be kept is not what they show.
        kept: the finds told so far, by id.
        unsaved: ids of those that the limit of saved scenarios left out.
        first: the exception of the first find, for a debugger.
        held: finds that may turn out to be a fault of the set-up; None once finds are told at once.
    """

    bench: Bench
    seed: int
    confirm: Callable[[Run], str]
    showing: Showing | None = None
    replayed: frozenset[Path] = frozenset()
    kept: dict[str, Kept] = field(default_factory=dict)
    unsaved: list[str] = field(default_factory=list)
    first: BaseException | None = None
    held: list[Held] | None = field(default_factory=list)

    @property
    def finds(self) -> list[Find]:
        """As the terminal tells them."""
        return [kept.find for kept in self.kept.values()]

    @property
    def count(self) -> int:
        """Distinct finds, whether they were kept or only counted."""
        return len(self.kept) + len(self.unsaved) - len(self.held or ())

    def keep(self, run: Run, verdict: Verdict, generation: int, number: int) -> str:
        """Save a new find, run it again to confirm it, and announce it or hold it; returns its id.

        Args:
            run: that failed.
            verdict: on it.
            generation: of the search, from 0.
            number: of the run in the search, from 1.
        """
        if verdict.failure is None or verdict.exception is None:
            raise ValueError(f"verdict: expected a failed one, received {verdict!r}")
        found = Found(
            seed=self.seed,
            generation=generation,
            algorithm=self.bench.request.algorithm.name,
            versions=self.bench.versions,
        )
        finding = self._finding(run, verdict.failure, found)
        if self._is_full():
            self.unsaved.append(finding.id)
            self.first = self.first or verdict.exception
            return finding.id
        origin = f"{found.algorithm}, seed {self.seed}, generation {generation}, run {number}"
        kept = self._saved(finding, what_happened(run, verdict), origin, is_timed=verdict.is_timed)
        differs = ""
        try:
            differs = "" if verdict.is_timed else self.confirm(run)
        finally:  # An interrupt in these runs must not keep the find from being told.
            if differs:
                kept = self.flaky(kept, differs)
            if self.held is None:
                self.tell(kept, verdict.exception, run=run, is_new=True)
            else:
                self.kept[kept.find.id] = kept
                self.held.append(Held(kept=kept, exception=verdict.exception, run=run))
        return kept.find.id

    def release(self) -> None:
        """Announce what is held, and from now on each find at once."""
        held, self.held = self.held or [], None
        for each in held:
            self.tell(each.kept, each.exception, run=each.run, is_new=True)

    def withdraw(self) -> None:
        """Undo what is held: it is no finding. What cannot be removed is told after all."""
        for each in self.held or ():
            del self.kept[each.kept.find.id]
        held, self.held = self.held or [], None
        self.unsaved.clear()
        for each in held:
            try:
                if each.kept.file is not None:
                    each.kept.file.unlink(missing_ok=True)
            except OSError:
                self.tell(each.kept, each.exception, run=each.run, is_new=True)
        with suppress(OSError):  # They hold something else.
            for folder in (self.bench.folder, *self.bench.folder.parents[:2]):
                folder.rmdir()

    def flaky(self, kept: Kept, difference: str) -> Kept:
        """The same as a find that does not repeat, in its file too."""
        marked = self.rewritten(kept, replace(kept.finding, flaky=portable(difference, self.bench.root)))
        return replace(marked, find=replace(kept.find, difference=difference))

    def rewritten(self, kept: Kept, finding: Finding) -> Kept:
        """The same with another finding, in its file too; as it was, with the reason, where that cannot be written."""
        if kept.file is None:
            return replace(kept, finding=finding, content=text_of(finding) if kept.content else "")
        try:
            return replace(kept, finding=rewrite(kept.file, finding))
        except CorpusWriteError as error:
            return replace(kept, origin=f"{kept.origin}; its file is as first found: {error}")

    def tell(
        self,
        kept: Kept,
        exception: BaseException,
        *,
        run: Run | None = None,
        is_new: bool = False,
        details: Sequence[str] = (),
        more: Sequence[str] = (),
        tried: Sequence[str] = (),
    ) -> None:
        """Announce a find, or tell more of it: the last report of a find is the one that counts.

        Args:
            kept: the find.
            exception: that the test function raised.
            run: of the scenario in the file; None where nobody saw how it ended.
            is_new: whether the terminal says so now.
            details: further lines for its report.
            more: further ones for a verbose session.
            tried: reference drivers that were tried in its scenario.
        """
        self.kept[kept.find.id] = kept
        if self.first is None or kept.find.id == next(iter(self.kept)):
            self.first = exception
        config = self.bench.item.config
        width = config.stash[SHARED].width
        explanation = "" if run is None else run.explain()
        if is_compact(config):  # without its last line, which names the scenario as the file does
            explanation = explanation.rpartition("\n")[0]
        more = (f"scenario   {kept.finding.scenario!r}", f"found by   {kept.origin}", *more)
        section = terminal.find_section(
            kept.find,
            explanation="" if explanation.partition("\n")[0] in message_of(exception) else explanation,
            content=kept.content,
            details=details,
            more=() if is_compact(config) else more,
            advice=_advice(kept.find),
            width=width,
        )
        report = report_of(self.bench.item, kept.find, exception, section)
        lines = terminal.found_lines(kept.find, width) if is_new else []
        messages.send(self.bench.item, "find", {"node_id": kept.find.node_id, "lines": lines, "report": report})
        if self.showing is not None:
            self.showing.find(kept.find, kept.finding, None if run is None else run.trace, tried=tried)

    def keep_crash(self, leftover: Leftover, scenario: Scenario, again: Lost | None) -> None:
        """Save what was in flight when a process died, and announce it.

        Args:
            leftover: of the process.
            scenario: that it ran.
            again: what became of the process that ran it again; None where none could tell.
        """
        found = Found(seed=self.seed, generation=0, algorithm="crash", versions=self.bench.versions)
        others = " and others in lock step" if leftover.together else ""
        text = f"a process (pid {leftover.pid}) died while it ran this scenario{others}, "
        if leftover.is_tried:
            text += (
                "which ran to its end when the next session tried it alone, and that session died as well: by what "
                "builds up from run to run, such as memory, or by a kill from outside; then delete the file"
            )
        elif again is None:
            text += (
                "by a crash of native code, a lack of memory or a kill from outside; if it was killed from outside, "
                "delete the file"
            )
        else:
            text += f"and the one that ran it again {again.how}: {cause(again, 'delete the file')}"
        headline = "crash: a process died while it ran this scenario" if again is None else _headline(again)
        expect = UNSEEN_CRASH if again is None else again.expect
        kept = self._saved(
            self._death(scenario, expect, found, leftover.world),
            headline,
            "the record of a session that died",
            is_timed=again is not None and again.is_hang,
        )
        self._tell_death(kept, text)

    def keep_lost(self, lost: Lost, generation: int, number: int) -> str:
        """Save a scenario whose process did not come back to this search, and announce it; returns its id.

        Args:
            lost: the scenario, and what became of the process.
            generation: of the search, from 0.
            number: of the run in the search, from 1.
        """
        algorithm = self.bench.request.algorithm.name
        found = Found(seed=self.seed, generation=generation, algorithm=algorithm, versions=self.bench.versions)
        alone = "" if lost.is_hang else ", and so it was when nothing else ran"
        text = f"the process (pid {lost.pid}) that ran this scenario {lost.how}{alone}: "
        text += cause(lost, "--pafot-workers=1 finds nothing here; delete the file")
        origin = f"{algorithm}, seed {self.seed}, generation {generation}, run {number}"
        finding = self._death(lost.scenario, lost.expect, found)
        kept = self._saved(finding, _headline(lost), origin, is_timed=lost.is_hang)
        self._tell_death(kept, text)
        return kept.find.id

    def _tell_death(self, kept: Kept, text: str) -> None:
        """Announce a find whose run nobody saw."""
        self.tell(kept, plain_failure(text), is_new=True)

    def _death(
        self, scenario: Scenario, expect: Expect, found: Found, world: Mapping[str, Any] | None = None
    ) -> Finding:
        return Finding(
            id=f"{'hang' if expect.outcome is Outcome.HANG else 'crash'}-{scenario.id}",
            test=node_ids.base_id(self.bench.item),
            scenario=scenario,
            world=world or worlds.described(self.bench.world),
            expect=expect,
            found=found,
        )

    def _is_full(self) -> bool:
        """Whether the test has as many saved scenarios as it may have."""
        files = layout.files_in(self.bench.folder)  # None of a folder that cannot be read; writing into it says why.
        return max(len(files), len(self.kept)) >= self.bench.request.settings.max_saved

    def _finding(self, run: Run, failure: Failure, found: Found) -> Finding:
        test = node_ids.base_id(self.bench.item)
        world, root = worlds.described(self.bench.world), self.bench.root
        return Finding.of(run, failure, test=test, world=world, found=found, root=root)

    def _saved(self, finding: Finding, headline: str, origin: str, *, is_timed: bool = False) -> Kept:
        path, finding = free_path(self.bench.folder, finding, self.replayed)
        while finding.id in self.kept:
            finding = replace(finding, id=f"{finding.id}-again")
            path = self.bench.folder / f"{finding.id}{layout.SUFFIX}"
        node_id = node_ids.saved_node_id(self.bench.item, finding.id)
        find = Find(id=finding.id, node_id=node_id, headline=headline, is_timed=is_timed)
        if self.bench.request.settings.save == "none":
            return Kept(finding=finding, find=replace(find, problem=NOT_SAVED), origin=origin)
        try:
            write(path, finding)
        except CorpusWriteError as error:
            find = replace(find, problem=str(error))
            return Kept(finding=finding, find=find, origin=origin, content=text_of(finding))
        find = replace(find, path=self.bench.relative(path))
        return Kept(finding=finding, find=find, origin=origin, file=path)


def report_of(item: pytest.Item, find: Find, exception: BaseException, section: str) -> dict[str, Any]:
    """The report of a find as the item that it will be next time, serialised.

    Made by pytest's own hooks, so that marks of the function, such as xfail, act on it.
    """

    def fail() -> None:
        raise exception

    call = pytest.CallInfo.from_call(fail, when="call")
    report: pytest.TestReport = item.ihook.pytest_runtest_makereport(item=item, call=call)
    path, line, _ = report.location
    summarise(report, find.summary)
    report.nodeid = find.node_id
    report.location = (path, line, node_ids.saved_name(item, find.id))
    report.sections.append(("pafot", section))
    if find.path:
        report.user_properties.append(("pafot_file", find.path))  # for files such as JUnit's, which have no sections
    data: dict[str, Any] = item.config.hook.pytest_report_to_serializable(config=item.config, report=report)
    return data


def what_happened(run: Run, verdict: Verdict) -> str:
    """One line on a find: what happened in the run, and what the function said where that is not the same."""
    if verdict.is_ads and verdict.failure is not None:
        return f"{verdict.failure.kind}: {verdict.failure.message}"
    headline = collision_in_short(run) or run.explain().splitlines()[0]
    first = verdict.failure.message.partition("\n")[0].strip() if verdict.failure is not None else ""
    is_bare = run.collision is not None and first.startswith("assert ")
    is_told = is_bare or not first or headline.partition(":")[0] in first
    kind = "" if isinstance(verdict.exception, AssertionError) else f"{type(verdict.exception).__name__}: "
    return headline if is_told else f"{kind}{first[:120]} ({headline})"


def collision_in_short(run: Run) -> str:
    """One line on the collision of a run: when, with whom, and whose fault; empty without one."""
    hit = run.collision
    if hit is None:
        return ""
    place = hit.cell.label.replace("front", "ahead").replace("rear", "behind").replace("-", " ")
    place = f"on the {place}" if hit.cell in (Cell.LEFT, Cell.RIGHT) else place
    who = {"ego": "ego", "npc": "NPC", "both": "both"}.get(run.responsibility or "", "nobody")
    return f"collision after {hit.time:.1f} s: NPC {hit.npc} {place}, {who} at fault"


def _advice(find: Find) -> str:
    """Why a find that does not repeat is as it was found, and what to do."""
    if not find.is_flaky:
        return ""
    draws = (
        "; the ADS probably draws random numbers: seed it in its factory, or let a model take its best action (of "
        "Stable-Baselines3: predict(..., deterministic=True))"
    )
    return f"what does not repeat is not shrunk{draws if find.difference == NOT_REPEATED else ''}"


def _headline(lost: Lost) -> str:
    return f"{'hang' if lost.is_hang else 'crash'}: the process that ran this scenario {lost.how}"


def cause(lost: Lost, way_out: str) -> str:
    """Why a process may not come back, with the way out where the scenario is not to blame."""
    if not lost.is_hang:
        return "by a crash of native code, an exit or a lack of memory"
    return (
        "the ADS hangs in code that does not return to the interpreter, or swallows its interruption, or uses a "
        f"library that does not work in a forked process (then {way_out})"
    )
