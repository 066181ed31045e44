"""Other drivers in the ego's place in a finding, who say who could have prevented the failure, and how."""

from __future__ import annotations

from dataclasses import replace

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Note, Phase, Refining
from pytest_pafot.campaign.judging import headline
from pytest_pafot.campaign.refine.simplest import Simplest
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.oracle.run import Run, with_avoidance
from pytest_pafot.support.errors import DriverError


def with_reference_drivers(
    sighting: Seen, simplest: Simplest, run: Run, verdict: Verdict, bench: Bench
) -> Refining[Seen]:
    """Return a finding as its confirmed scenario shows it, with what other drivers do in it.

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
        original=original if scenario != original else None,
        shrunk=simplest.shrunk if simplest.shrunk.rollouts else None,
    )
    # Nothing new: the caller then does not write the file again.
    if finding == before and not sighting.unshrunk:
        return sighting
    return replace(
        sighting,
        finding=finding,
        headline=finding.with_sight(headline(run, verdict)),
        observed=replace(
            sighting.observed, run=shown, verdict=replace(verdict, exception=exception), severity=verdict.severity
        ),
        unshrunk="",
    )
