"""After a search: each find becomes as simple as it can be, and is tried with reference drivers.

Nothing that was found depends on it: a find is saved and announced before, and its file and its report are replaced
when there is something better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from pytest_pafot.campaign.recorder import Keeper, Kept, what_happened
from pytest_pafot.execution.worker_pool import Lost, ProcessLostError
from pytest_pafot.findings.finding import Expect, Finding, Simplified, of_failure
from pytest_pafot.findings.replay import ending
from pytest_pafot.findings.shrink import Shrunk, SpeedInterval, Start, shrink, size_of
from pytest_pafot.findings.signature import Failure
from pytest_pafot.run import Run
from pytest_pafot.scenario import PositionInstruction, Scenario
from pytest_pafot.trace import LANE, SPEED

if TYPE_CHECKING:
    from pytest_pafot.campaign.harness import Bench
    from pytest_pafot.campaign.verdict import Verdict


@dataclass(slots=True, kw_only=True)
class Shrinking:
    """Simplifies the finds of one search.

    Attributes:
        bench: of the item.
        keeper: of the finds.
        run: simulates a scenario; the scenario is on disk while it does.
        afresh: the same with the ADS asked for every decision, for what is saved.
        judge: says what the test function makes of a run; likewise.
        lethal: scenarios in which a process died; they are not run.
        lose: takes one in which a process dies now.
        rollouts: that each find may take.
        is_over: whether time is up.
        tell: is told what goes on, often.
        runs: taken so far.
        is_cut: whether time was up before the work was done.
    """

    bench: Bench
    keeper: Keeper
    run: Callable[[Scenario], Run]
    afresh: Callable[[Scenario], Run]
    judge: Callable[[Run], Verdict]
    lethal: frozenset[Scenario]
    lose: Callable[[Lost], object]
    rollouts: int
    is_over: Callable[[], bool]
    tell: Callable[[str], None]
    runs: int = field(default=0, init=False)
    is_cut: bool = field(default=False, init=False)

    def run_all(self) -> None:
        """Each find, in the order in which they were found. What does not repeat cannot be shrunk."""
        __tracebackhide__ = True
        for kept in list(self.keeper.kept.values()):
            if kept.is_firm and self.is_over():
                self.is_cut = True
            elif kept.is_firm:
                self._refine_firm(kept)

    def _refine_firm(self, kept: Kept) -> None:
        __tracebackhide__ = True
        try:
            self._refine(kept)
        except ProcessLostError as error:
            self._call_flaky(kept, f"the process that ran it again {error.lost.how}")
            self.lose(error.lost)

    def _refine(self, kept: Kept) -> None:
        """Shrink a find, run the result once more, try reference drivers, and tell."""
        __tracebackhide__ = True
        before = kept.finding
        shrunk = self._shrunk(kept)
        self.runs += shrunk.rollouts
        run, verdict = self._tried(shrunk.scenario, self.afresh)
        differs = self._difference(before, run, verdict)
        if differs and shrunk.scenario != before.scenario:
            # The simplification does not hold; what was found does, or is flaky itself.
            shrunk = Shrunk(scenario=before.scenario, rollouts=shrunk.rollouts, is_minimal=False)
            run, verdict = self._tried(before.scenario, self.afresh)
            differs = self._difference(before, run, verdict)
        if differs:
            self._call_flaky(kept, differs)
        elif verdict.failure is not None and verdict.exception is not None:
            self._conclude(kept, shrunk, run, verdict, verdict.failure, verdict.exception)

    def _shrunk(self, kept: Kept) -> Shrunk:
        __tracebackhide__ = True
        signature, spent = kept.finding.signature, 0
        starts: dict[Scenario, tuple[Start, ...]] = {}

        def attempt(candidate: Scenario) -> Scenario | None:
            nonlocal spent
            if candidate in self.lethal:
                return None
            spent += 1
            self.tell(f"shrinking {kept.find.id}, run {spent} of {self.rollouts}")
            try:
                run, verdict = self._tried(candidate, self.run)
            except ProcessLostError as error:
                self.lose(error.lost)
                return None
            is_same = verdict.failure is not None and of_failure(run, verdict.failure) == signature
            if not is_same:
                return None
            scenario = driven(run)
            starts[scenario] = starts_of(run, float(self.bench.world.speed_limit))
            return scenario

        if self.rollouts == 0:
            return Shrunk(scenario=kept.finding.scenario, rollouts=0, is_minimal=False)
        shrunk = shrink(
            kept.finding.scenario,
            attempt,
            rollouts=self.rollouts,
            top_speed=float(self.bench.world.speed_limit),
            starts=lambda scenario: starts.get(scenario, ()),
            is_over=self.is_over,
        )
        self.is_cut = self.is_cut or (shrunk.rollouts < self.rollouts and self.is_over())
        return shrunk

    def _tried(self, scenario: Scenario, simulate: Callable[[Scenario], Run]) -> tuple[Run, Verdict]:
        __tracebackhide__ = True
        run = simulate(scenario)
        return run, self.judge(run)

    def _difference(self, finding: Finding, run: Run, verdict: Verdict) -> str:
        """What differs from the finding, or in a further run by other means."""
        __tracebackhide__ = True
        if verdict.failure is None or of_failure(run, verdict.failure) != finding.signature:
            return f"a later run of it ended otherwise: {ending(run)}"
        return "" if run.scenario == finding.scenario else self.keeper.confirm(run)

    def _call_flaky(self, kept: Kept, differs: str) -> None:
        self.keeper.kept[kept.find.id] = self.keeper.flaky(kept, differs)

    def _conclude(
        self, kept: Kept, shrunk: Shrunk, run: Run, verdict: Verdict, failure: Failure, exception: BaseException
    ) -> None:
        before = kept.finding
        self.tell(f"trying reference drivers in saved-{kept.find.id}")
        preventable_by = () if run.prevent is None else run.preventable_by
        is_simpler = shrunk.scenario != before.scenario
        how = Simplified(rollouts=shrunk.rollouts, is_minimal=shrunk.is_minimal, speeds=shrunk.intervals)
        finding = replace(
            before,
            scenario=shrunk.scenario,
            expect=Expect.of(run, failure, preventable_by=preventable_by, root=self.bench.root),
            original=before.scenario if is_simpler else None,
            shrunk=how if shrunk.rollouts else None,
        )
        if finding == before:
            return
        kept = self.keeper.rewritten(kept, finding)
        kept = replace(kept, find=replace(kept.find, headline=what_happened(run, verdict)))
        self.keeper.tell(
            kept,
            exception,
            run=run,
            details=_details(finding, before.scenario, self._drivers()),
            more=_more(finding),
            tried=self._drivers(),
        )

    def _drivers(self) -> tuple[str, ...]:
        """Names of the reference drivers that were tried, where the world is one that is known to try these."""
        from pytest_pafot.world import Highway, World  # noqa: PLC0415
        from pytest_pafot.world.reference_drivers import REFERENCES  # noqa: PLC0415

        return tuple(REFERENCES) if isinstance(self.bench.world, (Highway, World)) else ()


def driven(run: Run) -> Scenario:
    """The scenario of a run without the genes that it did not come to, which changes nothing."""
    scenario = run.scenario
    return scenario.truncated(max(1, min(scenario.genes, int(run.duration / scenario.gene_seconds - 1e-9) + 1)))


def starts_of(run: Run, top_speed: float) -> tuple[Start, ...]:
    """The ego's lane and speed at the beginning of each gene that the run came to, where it was on the road.

    Args:
        run: of the scenario.
        top_speed: at which an ego may start [m/s].
    """
    trace = run.trace
    every = round(run.scenario.gene_seconds * trace.physics_hz)
    rows = trace.ego[: trace.ticks : every]
    if trace.track is not None or (rows[:, LANE] < 0).any():
        return ()  # where a road is not straight, what comes later is another road
    return tuple((int(row[LANE]), float(min(max(round(row[SPEED], 1), 0.0), top_speed))) for row in rows)


def _details(finding: Finding, first: Scenario, tried: Sequence[str]) -> list[str]:
    """Lines for the report of a find: its size before and after, who would prevent it."""
    lines: list[str] = []
    if finding.shrunk is not None:
        after = "as simple as it gets" if finding.original is None else f"to {size_of(finding.scenario)}"
        lines.append(
            f"shrunk     from {size_of(first)} {after}{'' if finding.shrunk.is_minimal else ', and could be simpler'}"
        )
    if tried:
        lines.append(f"preventable by {', '.join(finding.expect.preventable_by) or 'none of the reference drivers'}")
    return lines


def _more(finding: Finding) -> list[str]:
    """What a verbose session says besides: how many runs that took, and the speeds that still fail."""
    if finding.shrunk is None:
        return []
    runs = f"{finding.shrunk.rollouts} run{'' if finding.shrunk.rollouts == 1 else 's'}"
    return [f"shrunk in  {runs}", *(f"still      {sentence}" for sentence in speed_sentences(finding))]


def speed_sentences(finding: Finding) -> list[str]:
    """What is known of the speeds at which the scenario still fails."""
    return [] if finding.shrunk is None else [_sentence(finding, each) for each in finding.shrunk.speeds]


def _sentence(finding: Finding, interval: SpeedInterval) -> str:
    gene = finding.scenario.npcs[interval.npc][interval.gene]
    place = f"in cell {int(gene.cell)} ({gene.cell.label})" if isinstance(gene, PositionInstruction) else gene.goal
    from_to = f"any speed from {interval.low:.1f} to {interval.high:.1f} m/s"
    if interval.low == interval.high:
        from_to = f"only a speed of {interval.low:.1f} m/s"
    seconds = interval.gene * finding.scenario.gene_seconds
    return f"NPC {interval.npc} from {seconds:g} s {place}: {from_to} still fails"
