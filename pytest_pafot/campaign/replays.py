"""Replays of saved scenarios, each in the world of its file, with the ADS and the function of its test."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pytest_pafot.campaign.harness import Harness, begins_alike, refusals
from pytest_pafot.campaign.request import AgainstError, RequestError, build_space
from pytest_pafot.campaign.setup_fault import FirstGeneration, SetupFaultError
from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.corpus.reader import located
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Runner, runner_for
from pytest_pafot.execution.scenario_pool import Job, LostRun, expectation
from pytest_pafot.execution.separate_runs import run_apart
from pytest_pafot.findings.finding import Finding, of_failure
from pytest_pafot.findings.replay import DRIVEN_ON, HAS_EVENT, ending, is_same_failure, replay_label, unhandled
from pytest_pafot.findings.signature import SLOW_DECISION, Failure, Signature
from pytest_pafot.model.driving_style import Traffic
from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching.space import sample
from pytest_pafot.world import WorldError, codec, protocol
from pytest_pafot.world.driving.ads import weights_digest
from pytest_pafot.world.driving.perception import sight_of
from pytest_pafot.world.guard.own_worlds import rollout_of

FLAKY = "flaky"

Sought = Callable[[Run, Failure], bool]
"""Whether a failure of a run is the one that is looked for."""

PROBES = 10
"""The number of random scenarios that must end as a replay does, so that the cause is the set-up and no scenario."""

BESIDE = {True: "introduced", False: "common", None: ""}
"""The label of a saved scenario that fails, by whether the reference passes the same scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Replays:
    """The replays of the saved scenarios of one test."""

    harness: Harness
    # replays the scenario of a file in a separate session, if no other process can be given what the test needs; raises
    # ``ProcessLostError`` if that session died
    in_own_session: Callable[[Path, Job, Scenario], None]
    today: date | None = None  # the day for which failures are accepted; None if nothing is accepted

    def shown_by(self, saved: Iterable[Saved]) -> dict[Signature, str]:
        """Replay saved scenarios; return the *known* failures, each with the id of the first file that shows it.

        A saved scenario, accepted or not, covers the failure that it shows now, even if it was saved for another
        failure. If it passes, also when it is driven on, it covers nothing. So for each known failure there is an item
        that fails with it or accepts it. A file that cannot be used covers nothing either, as its item reports the
        error. Nor does a file in which the reference fails as well: old failures must not hide new failures. A flaky
        failure that is accepted is covered even if its replay passes this time: else the search would find it again by
        chance.
        """
        known: dict[Signature, str] = {}
        for each in saved:
            owner, finding = self.harness.saved_node_id(each.id), each.finding
            if finding is not None and finding.flaky is not None and self.accepts(finding):
                known.setdefault(finding.signature, each.id)
            with suppress(RequestError):
                world = self.world_of(each)
                shown, is_later = self._observed(each, world, owner)
                # The reference is driven on if the ADS was. Otherwise it is judged as in a search.
                sought = partial(is_same_failure, _finding(each)) if is_later else None
                if shown is not None and self.passes_reference(each, world, owner, sought) is not False:
                    known.setdefault(shown, each.id)
        return known

    def accepts(self, finding: Finding) -> bool:
        """Return whether the failure of a file is accepted today."""
        return self.today is not None and finding.is_accepted(self.today)

    def still_fails(self, saved: Saved) -> bool:
        """Return whether a process still dies in a saved scenario, even if the reference's process dies as well."""
        try:
            shown, _ = self._observed(saved, self.world_of(saved), self.harness.saved_node_id(saved.id))
        except RequestError:
            return False
        return shown == _finding(saved).signature

    def _observed(self, saved: Saved, world: Any, owner: str) -> tuple[Signature | None, bool]:
        """Return the failure that a saved scenario shows now, and whether it shows it only when it is driven on."""
        try:
            run, verdict = self.tried(saved, world, owner)
            if verdict.failed and verdict.failure is not None:
                return of_failure(run, verdict.failure), False
            if verdict.discarded or protocol.lasting(world) is None:
                return None, False
            run, verdict, _ = self._driven_on(saved, world, owner)
        except ProcessLostError as error:
            return expectation(error).signature, False
        if not verdict.failed or verdict.failure is None or not is_same_failure(_finding(saved), run, verdict.failure):
            return None, False
        return of_failure(run, verdict.failure), True

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
                    trace = rollout_of(world)(scenario, harness.ads)
            run = _finding(saved).expect.known_of(harness.seen(trace, world))
            return run, harness.judge(run)

    def _is_apart(self, saved: Saved, owner: str) -> bool:
        harness = self.harness
        return bool(harness.request.settings.isolate or saved.needs_own_process or harness.left_behind(owner))

    def check_set_up(self, saved: Saved, run: Run, verdict: Verdict, owner: str) -> None:
        """Check that a replay that fails does so by its scenario, and not because the ADS no longer drives at all.

        An ADS whose call has another signature now raises at its first decision whatever the scenario is, and an error
        in the test function occurs in every run. So random scenarios of the test end in the same exception, too.

        Raises:
            SetupFaultError: if all of them do.
        """
        __tracebackhide__ = True
        harness, first = self.harness, FirstGeneration()
        first.see(run, verdict)
        isolate = self._is_apart(saved, owner)
        try:
            space, job = build_space(harness.request, harness.world), harness.job(owner=owner)
            with harness.recording(job) as record, refusals(), runner_for(job, record, isolate=isolate) as runner:
                for number in range(PROBES):
                    probe = harness.seen(runner.run(sample(space, np.random.default_rng(number)), afresh=True))
                    first.see(probe, harness.judge(probe))
                    if not first.is_alike:
                        return
        except (RequestError, ProcessLostError):  # They end differently than the replay; the search reports them.
            return
        raise SetupFaultError(run, verdict, f"this replay and {PROBES} random scenarios", is_replay=True)

    def passes_reference(self, saved: Saved, world: Any, owner: str, sought: Sought | None = None) -> bool | None:
        """Return whether the reference passes a saved scenario; None if the test has no reference."""
        __tracebackhide__ = True
        verdict = self.of_reference(saved, world, owner, sought)
        return None if verdict is None else verdict.passes

    def of_reference(self, saved: Saved, world: Any, owner: str, sought: Sought | None = None) -> Verdict | None:
        """Return the verdict on the reference in a saved scenario; None if the test has no reference.

        The reference runs in a separate process if the ADS does. If it passes, and a failure is ``sought``, it is
        driven on, too, and fails if it shows that failure then.
        """
        __tracebackhide__ = True
        verdict, longer = None, None if sought is None else self._longer(saved, world)
        for each in filter(None, (world, longer)):
            job, isolate = self.harness.job(each, owner), self._is_apart(saved, owner)
            with (
                self.harness.recording(job) as record,
                self.harness.reference_runner(job, record, isolate=isolate) or nullcontext() as runner,
            ):
                if runner is None:
                    return None
                run, now = self.harness.run_reference(runner, _finding(saved).scenario, each)
                if verdict is None and now.is_ads and now.failure is not None:
                    self._check_reference(runner, world, now.failure)
            if verdict is None:
                verdict = now
                if not verdict.passes:
                    break
            elif sought is not None and run is not None and now.failure is not None and sought(run, now.failure):
                verdict = now
        return verdict

    def _check_reference(self, runner: Runner, world: Any, failure: Failure) -> None:
        """Check that the reference failed by the scenario of a replay, and not because it no longer drives at all.

        Otherwise each replay that passes would be called fixed.

        Raises:
            RequestError: if it fails in the same way in random scenarios, too.
        """
        __tracebackhide__ = True
        harness = self.harness
        try:
            space = build_space(harness.request, world)
            for number in range(PROBES):
                probe = harness.judge_reference(runner, sample(space, np.random.default_rng(number)), world)
                if probe.failure is None or probe.failure.kind != failure.kind or not probe.is_ads:
                    return
        except RequestError:  # The arguments of the test do not fit the world of the file, so nothing can be compared.
            return
        raise AgainstError(
            f"against ({harness.against_name}): expected a reference that drives, received {failure.kind}: "
            f"{failure.message} in this replay and {PROBES} random scenarios; correct the reference, its factory, or "
            "the world= in which it drives"
        )

    def _longer(self, saved: Saved, world: Any) -> Any | None:
        """Return the world with runs that go on after the end of a saved scenario; None if the world cannot go on."""
        lasting = protocol.lasting(world)
        with refusals():
            return lasting and lasting(min(world.longest_run, _finding(saved).scenario.seconds) + DRIVEN_ON)

    def _driven_on(self, saved: Saved, world: Any, owner: str) -> tuple[Run, Verdict, str]:
        """Run a saved scenario as in :meth:`tried`, but drive on after its end if the world can.

        The text says that the process died or hung in the time after the end, which is no failure of a file that is
        about something else. The run then ends where the scenario ends.
        """
        __tracebackhide__ = True
        longer = self._longer(saved, world)
        try:
            return *self.tried(saved, world if longer is None else longer, owner), ""
        except ProcessLostError as error:
            if longer is None or was_lost(_finding(saved), error):
                raise
            note = f"driven on past the file's end, the process {error.how}"
        return *self.tried(saved, world, owner), note

    def _repeated(
        self, saved: Saved, world: Any, owner: str, label: str, run: Run, verdict: Verdict
    ) -> tuple[str, Run, Verdict, str]:
        """Run a scenario that passes again, and drive on; return label, run, verdict and text as in :meth:`labelled`.

        The run is the first one, or the second one if that failed.
        """
        __tracebackhide__ = True
        finding = _finding(saved)
        again, second, note = self._driven_on(saved, world, owner)
        is_alike = begins_alike(run, again)
        if second.failed and second.failure is not None:
            # The failure is in the time after the end, unless the test function or a clock decides by chance.
            is_later = is_alike and again.trace.ticks > run.trace.ticks and not self.harness.judge(run).failed
            is_own = is_same_failure(finding, again, second.failure)
            if not is_later or (is_own and (finding.flaky is not None or second.failure.kind == SLOW_DECISION)):
                return FLAKY, again, second, ""
            what = "another failure"
            if is_own:
                what = "the same mistake" if of_failure(again, second.failure).mistake else "the same failure"
            note = f"driven on past the file's end: {what}, {happened(finding, again, second.failure)}"
            if is_own:
                return "still failing", again, second, note
        return (FLAKY if finding.flaky is not None or not is_alike else label), run, verdict, note

    def labelled(self, saved: Saved, owner: str) -> tuple[str, Run, Verdict, str]:
        """Replay a saved scenario; return its label, run, verdict, and a text on the time after the scenario's end.

        A replay that passes is run again, and driven on for :data:`~pytest_pafot.findings.replay.DRIVEN_ON`. If it then
        fails as the file says, it is ``still failing``. Any other failure in that time is only a text.

        With a reference, a failure is ``introduced`` if the reference passes, otherwise ``common``. A pass is ``fixed``
        if the reference fails and the situation occurred; otherwise a label ``fixed`` becomes ``fixed before``. The
        reference is driven on as well.

        Raises:
            ProcessLostError: if the process that ran the scenario died or hung.
            RequestError: if the scenario cannot be run, with the file, the line and the field; or if the reference
                does not drive at all.
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
            return label, run, verdict, ""
        note = ""
        if not verdict.failed:
            label, run, verdict, note = self._repeated(saved, world, owner, label, run, verdict)
            if label == FLAKY:
                return label, run, verdict, note
        if verdict.failed:
            shown = of_failure(run, verdict.failure) if verdict.failure is not None else None
            reference = self.of_reference(saved, world, owner, lambda run, failure: of_failure(run, failure) == shown)
            beside = BESIDE[None if reference is None else reference.passes]
            return beside or label, run, replace(verdict, reference=reference), note
        passes = self.passes_reference(saved, world, owner, partial(is_same_failure, finding))
        if passes and label == "fixed":
            label = "fixed before"
        elif passes is False and not unhandled(finding, run):
            label = "fixed"
        return label, run, verdict, note

    def world_changes(self, finding: Finding) -> list[str]:
        """Return how the file's world differs from the test's world, or how the file's world cuts the run."""
        own = self.harness.world
        return codec.changes(finding.world, own) or codec.cuts(finding.world, finding.scenario, own)

    def setting_changes(self, finding: Finding) -> list[str]:
        """Return all differences between a file and the test now that do not depend on what happens in the replay.

        A replay takes place in the file's world if that is data, and in the file's traffic, whatever the test names.
        """
        elsewhere = ", ".join(codec.elsewhere(finding.world, finding.scenario, self.harness.world))
        told = [f"run in the world of the file, which is not the test's: {elsewhere}"] if elsewhere else []
        then, now = finding.scenario.traffic, self.harness.request.space.get("traffic")
        if now is not None and Traffic.of(now) != then:
            told.append(f"run in the traffic of the file, which is not the test's: {then} there, {Traffic.of(now)} now")
        return [*self.world_changes(finding), *told, *self.ads_changes(finding)]

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
        changed += self.setting_changes(finding)
        expect = finding.expect
        then = "the process died" if expect.is_crash else _event(expect.outcome, expect.time)
        if expect.check is not None:
            then = f"{expect.assertion} failed at {expect.time:.1f} s"
        event = [] if then == now else [f"{then} in the file, {now} now"]
        return "; ".join([*event, *changed]) or "a different run than before"


def was_lost(finding: Finding, lost: LostRun) -> bool:
    """Return whether a file says that a process dies or hangs in its scenario, as this process did."""
    return finding.expect.outcome is Outcome.HANG if lost.is_hang else finding.expect.is_crash


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
