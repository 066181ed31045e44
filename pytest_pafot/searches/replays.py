"""Replays of saved scenarios, each in the world that its file describes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from pathlib import Path

from pytest_pafot.algorithms.space import sample
from pytest_pafot.corpus.reader import Saved, located
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import (
    NOT_TRIED_HERE,
    ExecutionError,
    Here,
    LostRun,
    expectation,
    forks,
    judged_apart,
    runner_for,
)
from pytest_pafot.findings.finding import (
    DRIVEN_ON,
    ENOUGH,
    HAS_EVENT,
    RUNS,
    FailureRate,
    Finding,
    beyond_acceptance,
    ending,
    handles,
    has_time,
    is_same_event,
    is_same_failure,
    signature_of_failure,
    with_other_seed,
)
from pytest_pafot.findings.sighting import Observed
from pytest_pafot.findings.verdict import Failure, Signature, Verdict
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import rng_of
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.harness import (
    Harness,
    SetupFaultError,
    begins_alike,
    cause_of,
    headline,
    is_same_run,
    refusals,
)
from pytest_pafot.searches.request import AgainstError, build_space
from pytest_pafot.searches.results import UNJUDGED, Accepted
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.proportions import none_text
from pytest_pafot.world import WorldError, codec
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.guard.chance import GENERATORS

Sought = Callable[[Run, Failure], bool]  # returns whether a failure of a run is the one to look for

# If this many random scenarios end in the same way as a replay, the cause is the set-up and not the scenario.
PROBES = 10

# A part of the notes on what happens in a replay after the saved scenario has ended.
PAST_END = "after the end of the saved scenario"

# The time after the end of a saved run in which a collision with the same NPC counts as the saved collision [s].
SOON = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Replays:
    """The replays of one test's saved scenarios."""

    harness: Harness
    # the day on which acceptances must be valid; None if no failure is accepted
    today: date | None = None

    def shown_by(self, saved: Iterable[Saved]) -> tuple[dict[Signature, str], Accepted]:
        """Replay saved scenarios, and return the known failures and accepted speeds."""
        known: dict[Signature, str] = {}  # the id of the first file that shows each failure
        # infinite speeds for files that are not accepted, because their items fail
        accepted: Accepted = {}

        def cover(signature: Signature, id_: str, most: float) -> None:
            known.setdefault(signature, id_)
            accepted[signature] = max(accepted.get(signature, (0.0, "")), (most, id_))

        # A file covers the failure that it shows now, even if it was saved for another one. So each known failure has
        # an item that fails with it or accepts it. A file covers nothing if it passes, even past its end, or if it
        # cannot be used, which its item reports. It also covers nothing if the reference fails as well, because old
        # failures must not hide new ones.
        for each in saved:
            owner, finding = self.harness.saved_node_id(each.id), each.finding
            # The search could find an accepted flaky failure by chance, so the file covers it even if it passes now.
            if finding is not None and finding.flaky is not None and self.accepts(finding):
                cover(finding.signature, each.id, finding.worst_known)
            with suppress(RequestError):
                world, finding = self.world_of(each), _finding(each)
                now = self._accepted(finding, self._driven(each, world, owner))
                shown = _signature(now)
                # The reference runs past the end of the file if the ADS does. Otherwise, it runs as in a search.
                sought = partial(is_same_failure, finding) if now.is_later else None
                if (
                    shown is not None
                    and self._compared(each, world, owner, now, sought).reference_passes
                    is not False
                ):
                    cover(shown, each.id, finding.worst_known if now.is_accepted else math.inf)
        return known, accepted

    def accepts(self, finding: Finding) -> bool:
        return self.today is not None and finding.is_accepted(self.today)

    def _accepted(self, finding: Finding, now: Observed) -> Observed:
        # Note whether the file accepts the failure, or how the failure exceeds the accepted one.
        if not self.accepts(finding):
            return now
        died = now.verdict.exception if now.verdict is not None else None
        beyond = (
            f"a process that {died.end}"
            if isinstance(died, ProcessLostError) and not now.is_same
            else ""
        )
        if now.run is not None and now.verdict is not None and now.verdict.failure is not None:
            same_versions = not self.version_changes(finding)
            beyond = beyond_acceptance(
                finding, now.run, now.verdict.failure, same_versions=same_versions
            )
        return replace(now, is_accepted=not beyond, beyond=beyond)

    def still_fails(self, saved: Saved) -> bool:
        """Return whether a saved scenario still makes a process die, regardless of the reference."""
        try:
            now = self._driven(saved, self.world_of(saved), self.harness.saved_node_id(saved.id))
        except RequestError:
            return False
        return _signature(now) == _finding(saved).signature

    def world_of(self, saved: Saved) -> BaseWorld:
        """Return the world in which to replay a file.

        Raises:
            RequestError: if the world cannot be built, or the scenario does not fit the world.
        """
        finding = _finding(saved)
        try:
            # Files contain no code. If the file's world is code, use the test's world.
            if codec.is_code(finding.world):
                world = codec.check_named_world(finding.world, self.harness.world)
            else:
                world = codec.world_of_file(finding.world, finding.scenario, self.harness.world)
            with _naming(saved.path):
                world.check_fits(finding.scenario)
        except (WorldError, TypeError, ValueError) as error:
            raise RequestError(str(located(saved.path, "world", error))) from None
        return world

    def tried(self, saved: Saved, world: BaseWorld, owner: str) -> tuple[Run, Verdict]:
        """Run a saved scenario in a world, and return the run and its verdict.

        Raises:
            ProcessLostError: if the run was in a separate process, which died or hung.
            RequestError: if the world, the factory or the scenario cannot be used.
        """
        __tracebackhide__ = True
        harness, scenario = self.harness, _finding(saved).scenario
        isolate, trace = harness.request.settings.isolate, None
        job = harness.job(world, owner)
        if self.is_apart(saved, owner):
            with refusals(), _naming(saved.path):
                try:
                    trace = judged_apart(job, scenario, partial(harness.judge_trace, world))
                except (ProcessLostError, ExecutionError, ScenarioError):
                    raise
                except Exception as error:
                    if isolate:
                        raise
                    raise ExecutionError(
                        "a scenario that has ended a process must run in a separate process, which raised "
                        f"{type(error).__name__}: {error}. {NOT_TRIED_HERE} Otherwise, delete the file. A search can "
                        "find the failure again."
                    ) from None
        with harness.recording(job) as record:
            record.write(scenario)
            if trace is None:
                with refusals(), _naming(saved.path):
                    trace = GENERATORS.run(world.rollout, scenario, job.policy.factory)
            run = harness.run_of(trace, world)
            return run, harness.judge(run)

    def is_apart(self, saved: Saved, owner: str) -> bool:
        harness = self.harness
        return bool(
            harness.request.settings.isolate
            or saved.needs_own_process
            or harness.left_behind(owner)
        )

    def check_set_up(self, saved: Saved, run: Run, verdict: Verdict, owner: str) -> None:
        """Check that a replay fails because of its scenario, and not because of the set-up.

        Raises:
            SetupFaultError: if random scenarios of the test end in the same exception.
        """
        # For example, an ADS with a wrong signature fails at its first decision in any scenario.
        __tracebackhide__ = True
        harness, cause = self.harness, cause_of(run, verdict)
        if cause is None:
            return
        isolate = self.is_apart(saved, owner)
        try:
            space, job = build_space(harness.request, harness.world), harness.job(owner=owner)
            with (
                harness.recording(job) as record,
                refusals(),
                runner_for(job, record, isolate=isolate) as runner,
            ):
                for number in range(PROBES):
                    probe = harness.run_of(runner.once(sample(space, rng_of(number))))
                    judged = harness.judge(probe)
                    if judged.kind not in UNJUDGED and cause_of(probe, judged) != cause:
                        return
        # It is not the error of the replay. The search reports it.
        except (RequestError, ProcessLostError):
            return
        raise SetupFaultError(
            run, verdict, f"this replay and {PROBES} random scenarios", is_replay=True
        )

    def _compared(
        self,
        saved: Saved,
        world: BaseWorld,
        owner: str,
        now: Observed,
        sought: Sought | None = None,
    ) -> Observed:
        # The reference runs in a separate process if the ADS does. If it passes, and a failure is `sought`, it runs
        # again, past the end of the file, and fails if that run shows the failure.
        __tracebackhide__ = True
        run, verdict = self._of_reference(saved, world, owner, is_checked=True)
        if verdict is None or verdict.kind == "invalid":
            return now
        if sought is not None and run is not None and verdict.passes:
            later, then = self._of_reference(saved, _longer(saved, world), owner)
            now = replace(now, is_lost=now.is_lost or later is None)
            failure = None if then is None else then.failure
            if (
                later is not None
                and then is not None
                and failure is not None
                and begins_alike(run, later)
            ):
                verdict = then if has_time(later, failure) and sought(later, failure) else verdict
        # The verdict on the policy includes the verdict on the reference, so that reports can compare the two.
        own = (
            replace(now.verdict, reference=verdict)
            if now.fails and now.verdict is not None
            else now.verdict
        )
        return replace(now, reference_passes=verdict.passes, verdict=own)

    def _of_reference(
        self, saved: Saved, world: BaseWorld, owner: str, *, is_checked: bool = False
    ) -> tuple[Run | None, Verdict | None]:
        # Return None without a reference. The run is also None if the process died or hung.
        __tracebackhide__ = True
        job, isolate = self.harness.job(world, owner), self.is_apart(saved, owner)
        with (
            self.harness.recording(job) as record,
            self.harness.reference_runner(job, record, isolate=isolate) or nullcontext() as runner,
        ):
            if runner is None:
                return None, None
            run, verdict = self.harness.run_reference(runner, _finding(saved).scenario, world)
            if is_checked and run is not None and verdict.is_ads and verdict.failure is not None:
                self._check_reference(runner, world, verdict.failure)
            return run, verdict

    def _check_reference(self, runner: Here, world: BaseWorld, failure: Failure) -> None:
        # If the reference fails in the same way in random scenarios, it cannot drive at all. Without this error, each
        # replay that passes would be called fixed.
        __tracebackhide__ = True
        harness = self.harness
        try:
            space = build_space(harness.request, world)
            for number in range(PROBES):
                probe = harness.judge_reference(runner, sample(space, rng_of(number)), world)
                if probe.failure is None or probe.failure.kind != failure.kind or not probe.is_ads:
                    return
        # The arguments of the test do not fit the world of the file, so nothing can be compared.
        except RequestError:
            return
        raise AgainstError(
            f"against ({harness.against_name}): the reference failed with {failure.kind}: {failure.message} in this "
            f"replay and in {PROBES} random scenarios, so it cannot drive at all. Correct the reference, its factory, "
            "or the world= in which it drives."
        )

    def _driven_on(self, saved: Saved, world: BaseWorld, owner: str) -> Observed:
        # If the run cannot continue past the end of the file, run it to the end, with a note that states why.
        __tracebackhide__ = True
        harness = self.harness
        # A separate session replays a complete file, so it cannot show in which part a process died.
        has_processes = harness.request.settings.isolate or forks() or saved.needs_own_process
        is_lost = not has_processes and bool(harness.left_behind(owner))
        if is_lost:
            note = f"it was not run {PAST_END}, because a process died there before, and this system cannot fork"
        else:
            try:
                run, verdict = self.tried(saved, _longer(saved, world), owner)
                return Observed(run=run, verdict=verdict)
            except ProcessLostError as error:
                if was_lost(_finding(saved), error):
                    error.add_note(f"the process {error.end} {PAST_END}")
                    raise
                # This is not the failure of the file, so it is only noted.
                note, is_lost = f"the process {error.end} {PAST_END}", True
        run, verdict = self.tried(saved, world, owner)
        return Observed(run=run, verdict=verdict, note=note, is_lost=is_lost)

    def _repeated(self, saved: Saved, world: BaseWorld, owner: str, now: Observed) -> Observed:
        # Keep the first run unless the second one fails.
        __tracebackhide__ = True
        finding, (first, _) = _finding(saved), now.ran
        second = self._driven_on(saved, world, owner)
        (run, verdict), is_alike = second.ran, begins_alike(first, second.ran[0])
        is_hit = is_alike and _is_hit_soon(finding, first, run)
        hit = f"the same NPC still collides with the ego {PAST_END} ({headline(run, verdict)})"
        note = hit if is_hit else second.note
        passed = replace(
            now, note=note, is_lost=second.is_lost, is_handled=now.is_handled and not is_hit
        )
        passed = replace(passed, is_unsteady=finding.flaky is not None or not is_alike)
        failure = verdict.failure if verdict.failed else None
        if failure is None:
            return passed
        failed = replace(
            passed,
            fails=True,
            is_same=True,
            is_later=True,
            is_unsteady=True,
            run=run,
            verdict=verdict,
        )
        # The failure occurred after the end of the file, unless the test function or a clock decides by chance.
        if not is_alike or run.trace.ticks <= first.trace.ticks or self.harness.judge(first).failed:
            return failed
        if not has_time(run, failure):
            return passed
        is_event = failure.check is not None or run.outcome in HAS_EVENT
        when = describe_result(finding, run, failure) if is_event else headline(run, verdict)
        if not is_same_failure(finding, run, failure):
            return (
                passed
                if is_hit
                else replace(passed, note=f"a different failure occurs {PAST_END}: {when}")
            )
        note = f"the same failure occurs {PAST_END}: {when}"
        is_firm = finding.flaky is None and self._is_repeatable(saved, world, owner, run)
        return replace(failed, is_unsteady=not is_firm, note=note)

    def _is_repeatable(self, saved: Saved, world: BaseWorld, owner: str, run: Run) -> bool:
        # A run past the end of the file must fail again, and be identical.
        __tracebackhide__ = True
        try:
            again, verdict = self.tried(saved, _longer(saved, world), owner)
        except ProcessLostError:
            return False
        return verdict.failed and is_same_run(run, again)

    def observed(self, saved: Saved, owner: str) -> Observed:
        """Replay a saved scenario, and return the facts that determine its label.

        Raises:
            RequestError: if the scenario cannot be run, or if the reference cannot drive at all. If it is the
                scenario, the message names the file, the line and the field.
        """
        __tracebackhide__ = True
        finding, world = _finding(saved), self.world_of(saved)
        now = self._accepted(finding, self._driven(saved, world, owner))
        if now.is_unsteady or (now.verdict is not None and now.verdict.discarded):
            return now
        sought: Sought | None = partial(is_same_failure, finding)
        if now.fails:
            shown = _signature(now)
            sought = None if now.run is None else lambda *its: signature_of_failure(*its) == shown
        # The comparison shows whether a failure is new with the policy, and whether the reference fails where the
        # policy passes.
        return self._compared(saved, world, owner, now, sought)

    def _driven(self, saved: Saved, world: BaseWorld, owner: str) -> Observed:
        # Run a saved scenario, without the reference. A replay that passes is run again, for DRIVEN_ON longer than the
        # file. If it then fails as the file states, and once more in a third run, it shows the failure of the file. Any
        # other failure in that time is only noted. A file with a rate is run ten more times, and a note states how many
        # of these runs fail. The replay fails if any of them does. If none does, it passes, but that shows nothing if
        # the failure was rare before.
        __tracebackhide__ = True
        finding = _finding(saved)
        changes = [] if finding.expect.is_crash else self.version_changes(finding)
        now = Observed(
            is_elsewhere=bool(changes or self.world_changes(finding) or self.sight_change(finding))
        )
        try:
            run, verdict = self.tried(saved, world, owner)
            is_handled = verdict.passes and handles(finding, run)
            is_same = verdict.failed and is_same_event(finding.expect, run, verdict.failure)
            now = replace(
                now,
                fails=verdict.failed,
                is_same=is_same,
                is_handled=is_handled,
                run=run,
                verdict=verdict,
            )
            # Run a pass again, past the end of the file, because a slower policy fails a little later.
            if (
                not verdict.failed
                and not verdict.discarded
                and not (finding.rate and finding.flaky)
            ):
                now = self._repeated(saved, world, owner, now)
            if finding.rate is not None and not verdict.discarded:
                now = self._by_rate(saved, world, owner, now)
        except ProcessLostError as error:
            died = Verdict(kind="failed", exception=error)
            note, is_same = "; ".join(getattr(error, "__notes__", ())), was_lost(finding, error)
            return replace(now, fails=True, is_same=is_same, note=note, run=None, verdict=died)
        return now

    def _by_rate(self, saved: Saved, world: BaseWorld, owner: str, now: Observed) -> Observed:
        # Run the scenario with ten other seeds, or ten times with the same seed if it is flaky. The situation of the
        # file must be handled in one of these runs, and need not occur in the others.
        __tracebackhide__ = True
        finding, harness = _finding(saved), self.harness
        then, job, how = finding.rate, harness.job(world, owner), "in" if finding.flaky else "with"
        assert then is not None  # noqa: S101  (only for files with a rate)
        shown, failing = _by_chance(finding, now, *now.ran), 0
        with (
            harness.recording(job) as record,
            refusals(),
            runner_for(job, record, isolate=self.is_apart(saved, owner)) as runner,
        ):
            for number in range(1, RUNS + 1):
                scenario = (
                    finding.scenario if finding.flaky else with_other_seed(finding.scenario, number)
                )
                run = harness.run_of(runner.once(scenario), world)
                verdict = harness.judge(run)
                failing += verdict.failed
                if not (shown.fails and shown.is_same):
                    shown = _by_chance(finding, shown, run, verdict)
                if verdict.passes and handles(finding, run):
                    shown = replace(shown, is_handled=True)
        rate = FailureRate(failing=failing)
        drawn = finding.drawn + ("" if failing or finding.flaky else none_text(RUNS, finding.drawn))
        told = f"failed {how} {then} {finding.drawn} when it was found, and now fails {how} {rate} {drawn}"
        return replace(
            shown,
            is_rare=then.failing < ENOUGH,
            note="; ".join(filter(None, [now.note, told])),
            rate=rate,
        )

    def version_changes(self, finding: Finding) -> list[str]:
        then, now = finding.found.versions, self.harness.versions
        other = (name for name in sorted(then) if now.get(name) != then[name])
        return [f"{name} {now.get(name, 'none')} instead of {then[name]}" for name in other]

    def world_changes(self, finding: Finding) -> list[str]:
        # its runs may be shorter than in the file, even if nothing else differs
        own = self.harness.world
        return codec.changes(finding.world, own) or codec.describe_limits(
            finding.world, finding.scenario, own
        )

    def setting_changes(self, finding: Finding) -> list[str]:
        """Describe the differences in world, traffic and perception between a file and the test."""
        # A replay uses the file's traffic and, if the file's world is data, this world.
        elsewhere = ", ".join(
            codec.describe_world_change(finding.world, finding.scenario, self.harness.world)
        )
        told = [f"run in the file's world, not the test's: {elsewhere}"] if elsewhere else []
        then, now = finding.scenario.traffic, self.harness.request.space.get("traffic")
        if now is not None and now != then:
            told.append(f"run in the file's traffic, not the test's: {then} instead of {now}")
        return [*self.world_changes(finding), *told, *self.sight_change(finding)]

    def sight_change(self, finding: Finding) -> list[str]:
        then = finding.perception or Sight()
        now = self.harness.policy.sight or Sight()
        return [] if then == now else [f"found with {then.described}, but run with {now.described}"]

    def changes(self, finding: Finding, now: str) -> str:
        changed = [
            event_change(finding, now),
            *self.version_changes(finding),
            *self.setting_changes(finding),
        ]
        return "; ".join(filter(None, changed)) or "the run differs from the saved one"


def event_change(finding: Finding, now: str) -> str:
    """Describe the difference between a replay's event and the event in its file, if any."""
    expect = finding.expect
    then = "a process crash" if expect.is_crash else _event(expect.outcome, expect.time)
    if expect.check is not None:
        then = f"{expect.assertion} failed at {expect.time:.1f} s"
    return "" if then == now else f"{now} instead of {then}"


def was_lost(finding: Finding, lost: LostRun) -> bool:
    """Return whether a file expects its run's process to be lost in this way."""
    return finding.expect.outcome is Outcome.HANG if lost.is_hang else finding.expect.is_crash


def describe_result(finding: Finding, run: Run, failure: Failure | None) -> str:
    """Describe a replay's result in the same form as the file describes the expected result."""
    if failure is not None and failure.check is not None:
        when = "" if failure.check.time is None else f" at {failure.check.time:.1f} s"
        return f"{failure.check.name} failed{when}"
    if finding.expect.check is not None:
        return ending(run) if failure is None else failure.kind
    return (
        _event(run.outcome, run.event_time)
        if run.outcome is finding.expect.outcome
        else ending(run)
    )


def _signature(now: Observed) -> Signature | None:
    if now.verdict is not None and isinstance(now.verdict.exception, ProcessLostError):
        return expectation(now.verdict.exception).signature
    run, verdict = now.ran
    return (
        signature_of_failure(run, verdict.failure)
        if now.fails and verdict.failure is not None
        else None
    )


def _by_chance(finding: Finding, now: Observed, run: Run, verdict: Verdict) -> Observed:
    # A random failure can occur at any time.
    failure = verdict.failure if verdict.failed else None
    if failure is None:
        return now
    is_same = is_same_failure(finding, run, failure)
    return replace(now, fails=True, is_same=is_same, is_unsteady=False, run=run, verdict=verdict)


def _is_hit_soon(finding: Finding, run: Run, longer: Run) -> bool:
    # Return whether the NPC of the file hits the ego shortly after the end of `run`, which `longer` continues. It does
    # not matter who is responsible, because the same collision may now be the fault of another party.
    expect, hit = finding.expect, longer.collision
    is_collision = (
        expect.outcome is Outcome.COLLISION and expect.check is None and expect.npc is not None
    )
    if not is_collision or run.collision is not None or hit is None or hit.npc != expect.npc:
        return False
    return hit.time <= run.duration + SOON


def _event(outcome: Outcome, time: float) -> str:
    return f"{outcome}{'' if outcome in HAS_EVENT else ' and most critical'} at {time:.1f} s"


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    # Add the file and the line to an error in a saved scenario, which may occur only during the run.
    __tracebackhide__ = True
    try:
        yield
    except ScenarioError as error:
        raise RequestError(str(located(path, "scenario", error))) from None


def _longer(saved: Saved, world: BaseWorld) -> BaseWorld:
    # Return the world with runs that continue past the end of a saved scenario.
    return world.lasting(min(world.longest_run, _finding(saved).scenario.seconds) + DRIVEN_ON)


def _finding(saved: Saved) -> Finding:
    if saved.finding is None:
        raise RequestError(saved.error)
    return saved.finding
