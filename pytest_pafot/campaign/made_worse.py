"""Whether a change made a policy worse."""
# A search looks for failures that the reference passes, so it finds some in any policy that drives a little
# differently, even in a safer one. So both policies run the same random scenarios, and those in which only one of them
# fails are counted.

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import tee

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Paired, Phase, Refining, SearchEvent
from pytest_pafot.campaign.results import Result, State
from pytest_pafot.campaign.store import Store, lose
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import LostRun
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import PASSES
from pytest_pafot.model.scenario import rng_of
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching.space import SearchSpace, sample
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.guard.hang_guard import runs_end_in

PAIRS = 700  # the largest number of random scenarios that both policies drive


@dataclass(slots=True, kw_only=True)
class MadeWorse:
    """The decision which findings show that the new policy is worse."""

    state: State  # a part of the search, which has a reference
    bench: Bench
    store: Store
    end: float  # time at which random scenarios must end [s], or infinity
    paired: Paired = field(default_factory=lambda: Paired(most=PAIRS))  # counts of the random scenarios

    def compare(self, space: SearchSpace) -> Refining[None]:
        """Run random scenarios with both policies, and dismiss findings that are no worse."""
        # The scenarios depend only on the seed of the search, and are evaluated in order. So the result is the same
        # with any number of processes.
        __tracebackhide__ = True
        # Numbers that follow those of a generation, so no generation of the search draws the same.
        drawn = (sample(space, rng_of(self.store.seed, 0, 0, number)) for number in range(PAIRS))
        scenarios, ahead = tee(drawn)
        bench, fatal = self.bench, self.state.fatal
        results = bench.results(ahead, self.state, fatal.__contains__)
        with bench.runner, suppress(OutOfTime):
            for scenario in scenarios:
                yield Phase(f"comparing in random scenario {self.paired.runs + 1} of {PAIRS}", "comparison")
                with runs_end_in(self.end - self.state.clock()):
                    new, old = (False, False) if scenario in fatal else (yield from self._fail(next(results)))
                self.paired = self.paired.with_run(new=new, old=old)
                if self.paired.is_worse is not None:
                    break
        # What no time was left to decide counts.
        if self.paired.is_worse is False:
            yield from self._dismiss(self.store.findings.values())

    def _fail(self, result: Result | LostRun) -> Generator[SearchEvent, None, tuple[bool, bool]]:
        # Whether only the new policy fails, and whether only the reference does.
        __tracebackhide__ = True
        bench = self.bench
        if isinstance(result, ProcessLostError):
            result = yield from lose(result, self.state, bench, self.store)
        if bench.reference is None or result.kind not in PASSES:
            return result.kind == "failed", False
        reference = bench.harness.judge_reference(bench.reference, result.evaluation.scenario)
        bench.record.clear()
        return False, reference.failed

    def _dismiss(self, sightings: Iterable[Seen]) -> Iterator[SearchEvent]:
        # A policy that raised or hung keeps its findings: how often that happens does not matter.
        state, harness = self.state, self.bench.harness
        way_out = f"a search without {harness.request.option('against')} counts and saves such findings"
        told = f"the policy fails no more often than {harness.against_name}: {self.paired}; {way_out}"
        for sighting in list(sightings):
            expect = sighting.finding.expect
            if expect.outcome not in (Outcome.ADS_ERROR, Outcome.HANG):
                yield from self.store.dismiss(sighting, told)
        # A later session that finds one again decides again.
        state.finds = {signature: id_ for signature, id_ in state.finds.items() if id_ not in self.store.dismissed}
