"""After a search: each find becomes as simple as it can be, and is tried with reference drivers.

Nothing that was found depends on it: a find is saved and announced before, and its file and its report are replaced
when there is something better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from pytest_pafot.campaign.events import FindTold
from pytest_pafot.campaign.harness import Harness
from pytest_pafot.campaign.search_loop import SearchLoop
from pytest_pafot.campaign.verdict import Verdict, headline
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.findings.finding import Expect, Perceived, of_failure
from pytest_pafot.findings.replay import ending
from pytest_pafot.findings.shrink import Shrunk, Start, shrink
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import LANE, SPEED
from pytest_pafot.oracle.run import Run
from pytest_pafot.world import protocol
from pytest_pafot.world.driving.perception import Perception

# Which imperfections of an ADS's sight a failure needs.


def needed_imperfections(sight: Sight, fails: Callable[[Sight], bool]) -> tuple[str, ...]:
    """Names of those without which a test does not fail; none where it fails also with perfect sight.

    With several, each in turn is left out for good where the test still fails without it. So none of those that remain
    can be spared, though others may do as well. It takes a run for perfect sight, and one for each where there are
    several.

    Args:
        sight: with which the test fails.
        fails: whether it does with another one.
    """
    if fails(sight.only(())):
        return ()
    needed = sight.imperfections
    for name in sight.imperfections:
        others = tuple(each for each in needed if each != name)
        if others and fails(sight.only(others)):
            needed = others
    return needed


ROLLOUTS, ROLLOUTS_IN_KERNEL = 300, 3000
"""Runs that shrinking one find may take by default; more where the kernel runs a vehicle class without any Python."""


@dataclass(slots=True, kw_only=True)
class Simplification:
    """Simplifies the finds of one search."""

    loop: SearchLoop  # of the search
    tell: Callable[[str], None]  # is told what goes on, often
    plain: Start | None = None  # at which an ego starts that the search does not draw elsewhere
    runs: int = field(default=0, init=False)  # taken so far

    def run_all(self) -> None:
        """Each find, in the order in which they were found. What does not repeat cannot be shrunk."""
        __tracebackhide__ = True
        recorder = self.loop.recorder
        for kept in [kept for kept in recorder.kept.values() if kept.is_firm]:
            try:
                self._refine(kept)
            except ProcessLostError as error:
                recorder.call_flaky(kept, f"the process that ran it again {error.how}")
                self.loop.lose(error)

    def _refine(self, kept: FindTold) -> None:
        """Shrink a find, run the result once more, try reference drivers, and tell."""
        __tracebackhide__ = True
        before = kept.finding
        scenario, shrunk = self._shrunk(kept)
        self.runs += shrunk.rollouts
        run, verdict, differs = self._run_again(scenario, kept)
        if differs and scenario != before.scenario:
            # The simplification does not hold; what was found does, or is flaky itself.
            scenario, shrunk = before.scenario, Shrunk(rollouts=shrunk.rollouts, is_minimal=False)
            run, verdict, differs = self._run_again(scenario, kept)
        if differs:
            self.loop.recorder.call_flaky(kept, differs)
        else:
            self._conclude(kept, scenario, shrunk, run, verdict)

    def _shrunk(self, kept: FindTold) -> tuple[Scenario, Shrunk]:
        __tracebackhide__ = True
        loop, harness = self.loop, self.loop.simulation.harness
        rollouts, top_speed = rollouts_for(harness), float(harness.world.speed_limit)
        spent = 0
        starts: dict[Scenario, tuple[Start, ...]] = {}

        def attempt(candidate: Scenario) -> Scenario | None:
            nonlocal spent
            if candidate in loop.fatal:
                return None
            spent += 1
            self.tell(f"shrinking {kept.find.id}, run {spent} of {rollouts}")
            try:
                run = loop.simulation.run(candidate)
            except ProcessLostError as error:
                loop.lose(error)
                return None
            scenario = driven(run)
            verdict = loop.simulation.judge(run, scenario)
            if not self._shows(kept.find.id, run, verdict):
                return None
            starts[scenario] = starts_of(run, top_speed)
            return scenario

        if rollouts == 0:
            return kept.finding.scenario, Shrunk(rollouts=0, is_minimal=False)
        return shrink(
            kept.finding.scenario,
            attempt,
            rollouts=rollouts,
            top_speed=top_speed,
            starts=lambda scenario: starts.get(scenario, ()),
            plain=self.plain,
        )

    def _shows(self, find_id: str, run: Run, verdict: Verdict) -> bool:
        """Whether a run shows the failure of a find; by the same fault, too, so that the find's name still fits."""
        found = next(signature for signature, id_ in self.loop.finds.items() if id_ == find_id)
        shown = of_failure(run, verdict.failure) if verdict.failed and verdict.failure is not None else None
        return shown is not None and (shown, shown.fault) == (found, found.fault)

    def _run_again(self, scenario: Scenario, kept: FindTold) -> tuple[Run, Verdict, str]:
        """A run, its verdict, and what differs from the finding in it, or in a further run by other means."""
        __tracebackhide__ = True
        run = self.loop.simulation.run(scenario, afresh=True)
        verdict = self.loop.simulation.judge(run)
        if not self._shows(kept.find.id, run, verdict):
            otherwise = f"a later run of it ended otherwise: {ending(run)}"
            return run, verdict, "the reference failed when it ran again" if verdict.kind == "common" else otherwise
        return run, verdict, "" if scenario == kept.finding.scenario else self.loop.recorder.confirm(run)

    def _conclude(self, kept: FindTold, scenario: Scenario, shrunk: Shrunk, run: Run, verdict: Verdict) -> None:
        if verdict.failure is None or verdict.exception is None:
            return
        before, harness, recorder = kept.finding, self.loop.simulation.harness, self.loop.recorder
        self.tell(f"trying reference drivers in saved-{kept.find.id}")
        outcomes = harness.reference_outcomes(run, verdict)
        perception = self._perceived(kept, scenario)
        last_chance = None if run.take_over is None else run.last_chance
        finding = replace(
            before,
            scenario=scenario,
            expect=Expect.of(
                run,
                verdict.failure,
                reference_drivers=outcomes,
                last_chance=last_chance,
                against=before.expect.against,
                root=str(harness.root),
            ),
            perception=perception,
            original=before.scenario if scenario != before.scenario else None,
            shrunk=shrunk if shrunk.rollouts else None,
        )
        if finding == before:
            return
        line = headline(run, verdict)
        line = line if perception is None else f"{line}, {perception.sentence}"
        find = replace(kept.find, headline=line)
        recorder.tell(
            replace(recorder.rewritten(kept, finding), find=find, exception=verdict.exception, run=run, is_new=False)
        )

    def _perceived(self, kept: FindTold, scenario: Scenario) -> Perceived | None:
        """Which imperfections of its sight a find needs; None where the ADS has none."""
        before, simulation = kept.finding.perception, self.loop.simulation
        harness, ads = simulation.harness, simulation.harness.ads
        if before is None or not isinstance(ads, Perception):
            return None
        self.tell(f"trying perfect sight in saved-{kept.find.id}")

        def fails(sight: Sight) -> bool:
            return harness.fails_with(ads.seeing(sight), scenario, simulation.record)

        return replace(before, needed=needed_imperfections(before.sight, fails))


def rollouts_for(harness: Harness) -> int:
    """Runs that shrinking one find may take: the user's number, else by how dear a run is."""
    given = harness.request.settings.shrink_rollouts
    if given is not None:
        return given
    return ROLLOUTS_IN_KERNEL if protocol.runs_in_kernel(harness.world, harness.ads) else ROLLOUTS


def driven(run: Run) -> Scenario:
    """The scenario of a run without the genes that it did not come to, which changes nothing."""
    scenario = run.scenario
    return scenario.truncated(max(1, min(scenario.genes, int(run.duration / scenario.gene_seconds - 1e-9) + 1)))


def starts_of(run: Run, top_speed: float) -> tuple[Start, ...]:
    """The ego's lane and speed at the beginning of each gene that the run came to, where it was on the road.

    The speed [m/s] is at most ``top_speed``, at which an ego may start.
    """
    trace = run.trace
    rows = trace.ego[: trace.ticks : round(run.scenario.gene_seconds * trace.physics_hz)]
    if trace.track is not None or (rows[:, LANE] < 0).any():
        return ()  # where a road is not straight, what comes later is another road
    return tuple((int(row[LANE]), float(min(max(round(row[SPEED], 1), 0.0), top_speed))) for row in rows)
