"""The comparison that decides whether a change made a policy worse.

A policy that drives differently from its reference fails in some scenarios that the reference passes, even if it is
safer. So both policies run the same random scenarios, and those in which only one of them fails are counted.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import tee

from pytest_pafot.algorithms.space import SearchSpace, sample
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import PASSES
from pytest_pafot.model.scenario import rng_of
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searches.bench import Bench
from pytest_pafot.searches.events import Paired, Phase, Refining, SearchEvent
from pytest_pafot.searches.results import Result, State
from pytest_pafot.searches.store import Store, record_death
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.guard.hang_guard import runs_end_in

PAIRS = 700  # the largest number of random scenarios that both policies run


@dataclass(frozen=True, slots=True, kw_only=True)
class FailedOnly:
    """Whether only the new policy fails in a scenario, or only the reference."""

    new: bool = False
    reference: bool = False


@dataclass(slots=True, kw_only=True)
class MadeWorse:
    """The comparison of the new policy with its reference. Findings count only if the new policy is worse."""

    state: State  # the state of a search that has a reference
    bench: Bench
    store: Store
    end: float  # time at which random scenarios must end [s], or infinity
    # counts of the random scenarios
    paired: Paired = field(default_factory=lambda: Paired(most=PAIRS))

    def compare(self, space: SearchSpace) -> Refining[None]:
        """Run random scenarios with both policies, and dismiss the findings if the new policy is no worse."""
        __tracebackhide__ = True
        # The scenarios depend only on the seed of the search and are evaluated in order, so the result is the same with
        # any number of processes. The last number separates their seeds from those of the generations.
        drawn = (sample(space, rng_of(self.store.seed, 0, 0, number)) for number in range(PAIRS))
        scenarios, ahead = tee(drawn)
        bench, fatal = self.bench, self.state.fatal
        results = bench.results(ahead, self.state, fatal.__contains__)
        with bench.runner, suppress(OutOfTime):
            for scenario in scenarios:
                yield Phase(
                    f"comparing policies in random scenario {self.paired.runs + 1} of {PAIRS}",
                    "comparison",
                )
                with runs_end_in(self.end - self.state.clock()):
                    only = FailedOnly()
                    if scenario not in fatal:
                        only = yield from self._failed_only(next(results))
                self.paired = self.paired.with_run(new=only.new, old=only.reference)
                if self.paired.is_worse is not None:
                    break
        # If there was no time to decide, the findings count.
        if self.paired.is_worse is False:
            yield from self._dismiss(self.store.findings.values())

    def _failed_only(self, result: Result) -> Generator[SearchEvent, None, FailedOnly]:
        __tracebackhide__ = True
        bench = self.bench
        # A death is a finding, even if the policies fail equally often.
        if result.ended == "lost":
            yield from record_death(result, self.state, self.store)
        if bench.reference is None or result.kind not in PASSES:
            return FailedOnly(new=result.kind == "failed")
        # The reference has run already if the new policy failed, because only then it decides what counts.
        reference = bench.harness.judge_reference(bench.reference, result.evaluation.scenario)
        bench.record.clear()
        return FailedOnly(reference=reference.failed)

    def _dismiss(self, sightings: Iterable[Seen]) -> Iterator[SearchEvent]:
        # An exception or a hang stays a finding, however often it occurs.
        state, harness = self.state, self.bench.harness
        way_out = (
            f"A search without {harness.request.option('against')} counts and saves such findings"
        )
        told = (
            f"the policy fails no more often than {harness.against_name}: {self.paired}. {way_out}"
        )
        for sighting in list(sightings):
            expect = sighting.finding.expect
            if expect.outcome not in (Outcome.ADS_ERROR, Outcome.HANG):
                yield from self.store.dismiss(sighting, told)
        # A later session that finds one of them again decides again.
        state.finds = {
            signature: id_
            for signature, id_ in state.finds.items()
            if id_ not in self.store.dismissed
        }
