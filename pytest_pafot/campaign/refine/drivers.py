"""Other drivers in the ego's place in a finding, who say who could have prevented the failure, and how."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Note, Phase, Refining
from pytest_pafot.campaign.refine.simplest import Simplest
from pytest_pafot.campaign.verdict import Verdict, headline
from pytest_pafot.findings.finding import Expect, Perceived
from pytest_pafot.findings.sighting import Sighting
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.oracle.run import Run, with_avoidance
from pytest_pafot.support.errors import DriverError
from pytest_pafot.world.driving.perception import Perception


def with_drivers(
    sighting: Sighting, simplest: Simplest, run: Run, verdict: Verdict, bench: Bench
) -> Refining[Sighting]:
    """Return a finding as its confirmed scenario shows it, with what other drivers, and perfect sight, do in it.

    It keeps the scenario as found.
    """
    if verdict.failure is None or verdict.exception is None:
        return sighting
    harness, scenario = bench.harness, simplest.scenario
    before = replace(sighting.finding, rate=simplest.rate)
    original = before.original or before.scenario
    yield Phase(f"trying reference drivers in saved-{sighting.id}", sighting.id)
    outcomes, errors = harness.reference_outcomes(run, verdict)
    # When would a driver have had to take over and brake? The world simulates it.
    avoided, exception = None, verdict.exception
    try:
        avoided = harness.avoidance(run, verdict)
    except DriverError as error:  # the world cannot simulate the driver
        errors.append(error)
    for each in errors:
        yield Note(f"{each}; findings say nothing of what this driver would have done")
    shown = run if avoided is None else with_avoidance(run, avoided)
    if shown.sentences != run.sentences:  # the message of the failure may contain them
        again = harness.judge(shown)
        exception = (again.exception if again.failed else None) or exception
    perception = yield from _perceived(sighting, scenario, bench)
    # The file says from now on what the simple scenario shows; only its name and its origin are those of the first run.
    finding = replace(
        before,
        scenario=scenario,
        expect=Expect.of(
            run,
            verdict.failure,
            reference_drivers=outcomes,
            avoided_by=avoided,
            against=before.expect.against,
            root=str(harness.root),
        ),
        perception=perception,
        original=original if scenario != original else None,
        shrunk=simplest.shrunk if simplest.shrunk.rollouts else None,
    )
    # Nothing new: the caller then does not write the file again.
    if finding == before and not sighting.unshrunk:
        return sighting
    line = headline(run, verdict)
    return replace(
        sighting,
        finding=finding,
        headline=line if perception is None else f"{line}, {perception.sentence}",
        severity=verdict.severity,
        unshrunk="",
        exception=exception,
        run=shown,
        is_first=False,
    )


def _perceived(sighting: Sighting, scenario: Scenario, bench: Bench) -> Refining[Perceived | None]:
    """Return the imperfections of the ADS's perception that a finding needs; None if its perception is perfect."""
    before, harness, ads = sighting.finding.perception, bench.harness, bench.harness.policy.factory
    if before is None or not isinstance(ads, Perception):
        return None
    yield Phase(f"trying perfect sight in saved-{sighting.id}", sighting.id)

    def fails(sight: Sight) -> bool:
        return harness.fails_with(ads.seeing(sight), scenario, bench.record)

    return replace(before, needed=needed_imperfections(before.sight, fails))


def needed_imperfections(sight: Sight, fails: Callable[[Sight], bool]) -> tuple[str, ...]:
    """Return the names of the imperfections that a failure needs; empty if the test fails with perfect sight, too.

    One imperfection after the other is removed from the sight if the test still fails without it. So each remaining
    imperfection is needed, although another set of imperfections may be enough as well. This takes one run with perfect
    sight and, if there are several imperfections, a run for each of them.

    Args:
        sight: the sight with which the test fails.
        fails: returns whether the test fails with another sight.
    """
    if fails(sight.only(())):
        return ()
    needed = sight.imperfections
    for name in sight.imperfections:
        others = tuple(each for each in needed if each != name)
        if others and fails(sight.only(others)):
            needed = others
    return needed
