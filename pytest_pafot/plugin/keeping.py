"""What happens to a new find: its file first, then a look at whether it repeats, then everybody is told."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from pytest_pafot.findings.corpus import CorpusWriteError, free_path, write
from pytest_pafot.findings.emit import text_of
from pytest_pafot.findings.finding import Expect, Finding, Found
from pytest_pafot.findings.inflight import Leftover
from pytest_pafot.findings.run import Run
from pytest_pafot.findings.signature import Failure
from pytest_pafot.plugin import messages, places
from pytest_pafot.plugin.bench import Bench, is_same_run
from pytest_pafot.plugin.oracle import Verdict, plain_failure
from pytest_pafot.report import terminal
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Outcome

NOT_SAVED = "--pafot-save=none"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kept:
    """A finding with where it lies, or why it lies nowhere."""

    finding: Finding
    path: str = ""
    problem: str = ""
    content: str = ""


@dataclass(slots=True)
class Keeper:
    """Saves and announces the finds of one search.

    Attributes:
        bench: of the item.
        seed: of the search.
        rerun: simulates a scenario again.
        finds: told so far.
        first: the exception of the first find, for a debugger.
    """

    bench: Bench
    seed: int
    rerun: Callable[[Scenario], Run]
    finds: list[terminal.Find] = field(default_factory=list)
    first: BaseException | None = None

    def keep(self, run: Run, verdict: Verdict, generation: int, number: int) -> str:
        """Save a new find, run it once more, and announce it; returns its id.

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
            algorithm=self.bench.request.settings.algorithm,
            versions=self.bench.versions,
        )
        kept = self._saved(self._finding(run, verdict.failure, found))
        headline = run.explain().splitlines()[0]
        is_flaky = False
        try:
            is_flaky = not verdict.is_timed and not is_same_run(run, self.rerun(run.scenario))
        finally:  # An interrupt in the second run must not keep the find from being told.
            self._announce(
                kept,
                verdict.exception,
                self._told(kept, _what(run, headline, verdict), is_flaky=is_flaky, is_timed=verdict.is_timed),
                origin=f"{found.algorithm}, seed {self.seed}, generation {generation}, run {number}",
                explanation="" if headline in str(verdict.exception) else run.explain(),
            )
        return kept.finding.id

    def keep_crash(self, leftover: Leftover) -> None:
        """Save what was in flight when a process died, and announce it."""
        if leftover.scenario is None:
            return
        world: Mapping[str, Any] = leftover.world or self.bench.world.to_dict()
        finding = Finding(
            id=f"crash-{leftover.scenario.id}",
            test=places.base_id(self.bench.item),
            scenario=leftover.scenario,
            world=world,
            expect=Expect(
                failure=places.CRASH,
                # Nobody saw how the run ended; the ADS is the code that a process can die in.
                outcome=Outcome.ADS_ERROR,
                time=0.0,
                message="the process ended while it ran this scenario",
            ),
            found=Found(seed=self.seed, generation=0, algorithm="crash", versions=self.bench.versions),
        )
        kept = self._saved(finding)
        text = (
            f"a process (pid {leftover.pid}) died while it ran this scenario, by a crash of native code, a lack of "
            "memory or a kill from outside; if it was killed from outside, delete the file"
        )
        told = self._told(kept, "crash: a process died while it ran this scenario")
        self._announce(kept, plain_failure(text), told, origin="the record of a session that died")
        leftover.discard()

    def _finding(self, run: Run, failure: Failure, found: Found) -> Finding:
        test = places.base_id(self.bench.item)
        try:
            return Finding.of(run, failure, test=test, world=self.bench.world.to_dict(), found=found)
        except ValueError as error:
            # A world that is no plain data cannot be replayed from a file; the scenario is worth keeping all the same.
            world = {"kind": "unknown", "reason": str(error)}
            return Finding.of(run, failure, test=test, world=world, found=found)

    def _saved(self, finding: Finding) -> _Kept:
        taken = {find.id for find in self.finds}
        path, finding = free_path(self.bench.folder, finding)
        while finding.id in taken:
            finding = replace(finding, id=f"{finding.id}-again")
            path = self.bench.folder / f"{finding.id}{places.SUFFIX}"
        if self.bench.request.settings.save == "none":
            return _Kept(finding=finding, problem=NOT_SAVED)
        try:
            write(path, finding)
        except CorpusWriteError as error:
            return _Kept(finding=finding, problem=str(error), content=text_of(finding))
        return _Kept(finding=finding, path=self.bench.relative(Path(path)))

    def _told(self, kept: _Kept, headline: str, *, is_flaky: bool = False, is_timed: bool = False) -> terminal.Find:
        return terminal.Find(
            id=kept.finding.id,
            node_id=places.saved_node_id(self.bench.item, kept.finding.id),
            headline=headline,
            path=kept.path,
            problem=kept.problem,
            is_flaky=is_flaky,
            is_timed=is_timed,
        )

    def _announce(
        self, kept: _Kept, exception: BaseException, find: terminal.Find, *, origin: str, explanation: str = ""
    ) -> None:
        self.finds.append(find)
        self.first = self.first or exception
        section = terminal.find_section(
            find,
            scenario=repr(kept.finding.scenario),
            origin=origin,
            explanation=explanation,
            content=kept.content,
        )
        report = report_of(self.bench.item, find, exception, section)
        messages.send(
            self.bench.item,
            "find",
            {"node_id": find.node_id, "lines": terminal.found_line(find), "report": report},
        )


def report_of(item: pytest.Item, find: terminal.Find, exception: BaseException, section: str) -> dict[str, Any]:
    """The report of a find as the item that it will be next time, serialised.

    Made by pytest's own hooks, so that marks of the function, such as xfail, act on it.
    """

    def fail() -> None:
        raise exception

    call = pytest.CallInfo.from_call(fail, when="call")
    report: pytest.TestReport = item.ihook.pytest_runtest_makereport(item=item, call=call)
    path, line, _ = report.location
    report.nodeid = find.node_id
    report.location = (path, line, places.saved_name(item, find.id))
    report.sections.append(("pafot", section))
    data: dict[str, Any] = item.config.hook.pytest_report_to_serializable(config=item.config, report=report)
    return data


def _what(run: Run, headline: str, verdict: Verdict) -> str:
    """One line on a find: what happened in the run, and what the function said where that is not the same."""
    if verdict.is_ads and verdict.failure is not None:
        return f"{verdict.failure.kind}: {verdict.failure.message}"
    first = str(verdict.exception).partition("\n")[0].strip()
    is_bare = run.collision is not None and first.startswith("assert ")
    is_told = is_bare or not first or headline.partition(":")[0] in first
    return headline if is_told else f"{type(verdict.exception).__name__}: {first[:120]} ({headline})"
