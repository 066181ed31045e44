"""Replays of saved scenarios, each in the world of its file, with the ADS and the function of its test."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pytest_pafot.campaign.harness import Harness, is_same_run, refusals
from pytest_pafot.campaign.request import RequestError
from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.corpus.reader import located
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import Job, expectation
from pytest_pafot.execution.separate_runs import run_apart
from pytest_pafot.findings.finding import Finding, of_failure
from pytest_pafot.findings.replay import HAS_EVENT, ending, replay_label, unhandled
from pytest_pafot.findings.signature import Failure, Signature
from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.world import WorldError, codec, protocol
from pytest_pafot.world.driving.ads import weights_digest
from pytest_pafot.world.driving.perception import sight_of

FLAKY = "flaky"

BESIDE = {True: "introduced", False: "common", None: ""}
"""The label of a saved scenario that fails, by whether the reference passes the same scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Replays:
    """The replays of the saved scenarios of one test."""

    harness: Harness
    # replays the scenario of a file in a separate session, if no other process can be given what the test needs; raises
    # ``ProcessLostError`` if that session died
    in_own_session: Callable[[Path, Job, Scenario], None]

    def shown_by(self, saved: Iterable[Saved]) -> dict[Signature, str]:
        """Replay saved scenarios; return the *known* failures, each with the id of the first file that shows it.

        A saved scenario, accepted or not, covers the failure that it shows now, even if it was saved for another
        failure. If it passes, it covers nothing. So for each known failure there is an item that fails with it or
        accepts it. A file that cannot be used covers nothing either, as its item reports the error. Nor does a file in
        which the reference fails as well: old failures must not hide new failures.
        """
        known: dict[Signature, str] = {}
        for each in saved:
            owner = self.harness.saved_node_id(each.id)
            with suppress(RequestError):
                world = self.world_of(each)
                shown = self._observed(each, world, owner)
                if shown is not None and self.passes_reference(each, world, owner) is not False:
                    known.setdefault(shown, each.id)
        return known

    def still_fails(self, saved: Saved) -> bool:
        """Return whether a process still dies in a saved scenario, even if the reference's process dies as well."""
        try:
            shown = self._observed(saved, self.world_of(saved), self.harness.saved_node_id(saved.id))
        except RequestError:
            return False
        return shown == _finding(saved).signature

    def _observed(self, saved: Saved, world: Any, owner: str) -> Signature | None:
        try:
            run, verdict = self.tried(saved, world, owner)
        except ProcessLostError as error:
            return expectation(error).signature
        return of_failure(run, verdict.failure) if verdict.failed and verdict.failure is not None else None

    def world_of(self, saved: Saved) -> Any:
        """Return the world in which to replay a file, and check that the scenario fits that world.

        It is the world that the file describes; or the test's world, if the world is code, which files do not contain.

        Raises:
            RequestError: if the world cannot be built, or the scenario does not fit. The message names file and line.
        """
        finding = _finding(saved)
        try:
            if codec.is_code(finding.world):
                world = codec.named(finding.world, self.harness.world)
            else:
                world = codec.of_file(finding.world, finding.scenario, self.harness.world)
            with _naming(saved.path):
                protocol.check_fits(world, finding.scenario)
        except (WorldError, TypeError, ValueError) as error:
            raise RequestError(str(located(saved.path, "world", error))) from None
        return world

    def tried(self, saved: Saved, world: Any, owner: str) -> tuple[Run, Verdict]:
        """Run a saved scenario in a world; return the run and its verdict. ``owner`` is written into the crash record.

        The run is in a separate process with ``--pafot-isolate``, or if a process died or hung in this scenario before.

        Raises:
            ProcessLostError: if the separate process died or hung.
            RequestError: for a world, factory or scenario that does not fit.
        """
        __tracebackhide__ = True
        harness, scenario = self.harness, _finding(saved).scenario
        isolate, trace = harness.request.settings.isolate, None
        job = harness.job(world, owner)
        if self._is_apart(saved, owner):
            with refusals(), _naming(saved.path):
                trace = run_apart(
                    job,
                    scenario,
                    partial(harness.judge_trace, world),
                    isolate=isolate,
                    in_own_session=lambda: self.in_own_session(saved.path, job, scenario),
                )
        with harness.recording(job) as record:
            record.write(scenario)
            if trace is None:
                with refusals(), _naming(saved.path):
                    trace = world.rollout(scenario, harness.ads)
            run = _finding(saved).expect.known_of(harness.seen(trace, world))
            return run, harness.judge(run)

    def _is_apart(self, saved: Saved, owner: str) -> bool:
        harness = self.harness
        return bool(harness.request.settings.isolate or saved.needs_own_process or harness.left_behind(owner))

    def passes_reference(self, saved: Saved, world: Any, owner: str) -> bool | None:
        """Return whether the reference passes a saved scenario; None if the test has no reference."""
        __tracebackhide__ = True
        verdict = self.of_reference(saved, world, owner)
        return None if verdict is None else verdict.passes

    def of_reference(self, saved: Saved, world: Any, owner: str) -> Verdict | None:
        """Return the verdict on the reference in a saved scenario; None if the test has no reference.

        The reference runs in a separate process if the ADS does.
        """
        __tracebackhide__ = True
        harness, scenario = self.harness, _finding(saved).scenario
        job, isolate = harness.job(world, owner), self._is_apart(saved, owner)
        with (
            harness.recording(job) as record,
            harness.reference_runner(job, record, isolate=isolate) or nullcontext() as runner,
        ):
            return None if runner is None else harness.judge_reference(runner, scenario, world)

    def labelled(self, saved: Saved, owner: str) -> tuple[str, Run, Verdict]:
        """Replay a saved scenario; return its label, run and verdict. A replay that passes is run again.

        With a reference, a failure is ``introduced`` if the reference passes, otherwise ``common``. A pass is ``fixed``
        if the reference fails and the situation occurred; otherwise a label ``fixed`` becomes ``fixed before``.

        Raises:
            ProcessLostError: if the process that ran the scenario died or hung.
            RequestError: if the scenario cannot be run. The message names the file, the line and the field.
        """
        __tracebackhide__ = True
        finding, world = _finding(saved), self.world_of(saved)
        run, verdict = self.tried(saved, world, owner)
        failure = verdict.failure if verdict.failed else None
        label: str = replay_label(finding, run, failure, self.harness.versions)
        if finding.expect.is_crash:
            label = "drifted" if verdict.failed else "fixed"  # The process survived, whatever the run shows.
        if label == "fixed" and (self.world_changes(finding) or self.sight_change(finding)):
            label = "drifted"  # It passes in another world or with another sight.
        if verdict.discarded:
            return label, run, verdict
        if verdict.failed:
            reference = self.of_reference(saved, world, owner)
            beside = BESIDE[None if reference is None else reference.passes]
            return beside or label, run, replace(verdict, reference=reference)
        again, second = self.tried(saved, world, owner)
        if second.failed:
            return FLAKY, again, second
        if finding.flaky is not None or not is_same_run(run, again):
            return FLAKY, run, verdict
        passes = self.passes_reference(saved, world, owner)
        if passes and label == "fixed":
            label = "fixed before"
        elif passes is False and not unhandled(finding, run):
            label = "fixed"
        return label, run, verdict

    def world_changes(self, finding: Finding) -> list[str]:
        """Return how the file's world differs from the test's world, or how the file's world cuts the run."""
        own = self.harness.world
        return codec.changes(finding.world, own) or codec.cuts(finding.world, finding.scenario, own)

    def sight_change(self, finding: Finding) -> list[str]:
        """Return how the ADS's sight in the file and now differ; empty if they are the same."""
        then = Sight() if finding.perception is None else finding.perception.sight
        now = sight_of(self.harness.ads) or Sight()
        return [] if then == now else [f"found with {then.described()}, run with {now.described()}"]

    def ads_changes(self, finding: Finding) -> list[str]:
        """Return how the ADS in a file differs from the present ADS: its sight, and its weights if both are known."""
        then, now = finding.found.weights, weights_digest(self.harness.ads)
        return [*self.sight_change(finding), *(["found with other weights"] if then and now and then != now else [])]

    def changes(self, finding: Finding, now: str) -> str:
        """Return the differences between a file and its replay in words; ``now`` is what happened in the replay."""
        versions = self.harness.versions
        changed = [
            f"{name} {version} then, {versions.get(name, 'none')} now"
            for name, version in sorted(finding.found.versions.items())
            if versions.get(name) != version
        ]
        changed += [*self.world_changes(finding), *self.ads_changes(finding)]
        expect = finding.expect
        then = "the process died" if expect.is_crash else _event(expect.outcome, expect.time)
        if expect.check is not None:
            then = f"{expect.assertion} failed at {expect.time:.1f} s"
        event = [] if then == now else [f"{then} in the file, {now} now"]
        return "; ".join([*event, *changed]) or "a different run than before"


def happened(finding: Finding, run: Run, failure: Failure | None) -> str:
    """Return what happened in a replay in words, in the form in which the file's failure is described."""
    if failure is not None and failure.check is not None:
        when = "" if failure.check.time is None else f" at {failure.check.time:.1f} s"
        return f"{failure.check.name} failed{when}"
    if finding.expect.check is not None:
        return ending(run) if failure is None else failure.kind
    return _event(run.outcome, run.event_time) if run.outcome is finding.expect.outcome else ending(run)


def _event(outcome: Outcome, time: float) -> str:
    return f"{outcome}{'' if outcome in HAS_EVENT else ' and most critical'} at {time:.1f} s"


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Add the file and the line to an error in the scenario of a file, even if only a run shows the error."""
    __tracebackhide__ = True
    try:
        yield
    except ScenarioError as error:
        raise RequestError(str(located(path, "scenario", error))) from None


def _finding(saved: Saved) -> Finding:
    if saved.finding is None:
        raise RequestError(saved.error)
    return saved.finding
