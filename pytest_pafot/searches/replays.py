"""Replays of saved scenarios, each in the world that its file describes."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import assert_never

from pytest_pafot.algorithms.space import sample
from pytest_pafot.corpus.reader import Saved, located
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import (
    NOT_TRIED_HERE,
    ExecutionError,
    forks,
    judged_apart,
    runner_for,
)
from pytest_pafot.findings.finding import (
    DRIVEN_ON,
    ENOUGH,
    HAS_EVENT,
    RUNS,
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
from pytest_pafot.findings.sighting import (
    Acceptance,
    Beyond,
    Died,
    Finished,
    NotMade,
    Replay,
    Shows,
    Try,
    Which,
)
from pytest_pafot.findings.verdict import Failure, Signature, Verdict
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import rng_of
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Outcome, Trace
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

    def accepts(self, finding: Finding) -> bool:
        return self.today is not None and finding.is_accepted(self.today)

    def is_apart(self, saved: Saved, owner: str) -> bool:
        """Return whether a saved scenario must run in a separate process."""
        if self.harness.request.settings.isolate or saved.needs_own_process:
            return True
        return bool(self.harness.left_behind(owner))

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

    def tried(self, saved: Saved, world: BaseWorld, owner: str) -> Finished | Died:
        """Run a saved scenario in a world, and return the run and its verdict, or how its process died.

        Raises:
            RequestError: if the world, the factory or the scenario cannot be used.
        """
        __tracebackhide__ = True
        harness, scenario = self.harness, _finding(saved).scenario
        job = harness.job(world, owner)
        trace: Trace | None = None
        if self.is_apart(saved, owner):
            judge = partial(harness.judge_trace, world)
            with refusals(), _naming(saved.path):
                try:
                    apart = _trace_or_death(partial(judged_apart, job, scenario, judge))
                except (ExecutionError, ScenarioError):
                    raise
                except Exception as error:
                    # With --pafot-isolate, the user has chosen a separate process. Otherwise, the error needs the
                    # reason why there is one.
                    if harness.request.settings.isolate:
                        raise
                    raise ExecutionError(
                        "a scenario that has ended a process must run in a separate process, which raised "
                        f"{type(error).__name__}: {error}. {NOT_TRIED_HERE} Otherwise, delete the file. A search can "
                        "find the failure again."
                    ) from None
            if isinstance(apart, Died):
                return apart
            trace = apart
        # Even after a run in a separate process, the test function evaluates it here, where its fixtures and
        # breakpoints are. It can end this process, too, so the scenario is on record meanwhile.
        with harness.recording(job) as record:
            record.write(scenario)
            if trace is None:
                with refusals(), _naming(saved.path):
                    trace = GENERATORS.run(world.rollout, scenario, job.policy.factory)
            run = harness.run_of(trace, world)
            return Finished(run=run, verdict=harness.judge(run))

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
                now = self._driven(each, world, owner)
                # The reference runs past the end of the file if the ADS does. Otherwise, it runs as in a search.
                sought = [finding.signature] if now.is_later else []
                most = finding.worst_known if now.acceptance == "accepted" else math.inf
                for signature in _failures_of(now):
                    compared = self._compared(each, world, owner, now, sought)
                    if compared.reference_passes is not False:
                        cover(signature, each.id, most)
        return known, accepted

    def still_fails(self, saved: Saved) -> bool:
        """Return whether a saved scenario still makes a process die, regardless of the reference."""
        try:
            now = self._driven(saved, self.world_of(saved), self.harness.saved_node_id(saved.id))
        except RequestError:
            return False
        return _finding(saved).signature in _failures_of(now)

    def observed(self, saved: Saved, owner: str) -> Replay:
        """Replay a saved scenario, and return the runs and the other facts that determine its label.

        Raises:
            RequestError: if the scenario cannot be run, or if the reference cannot drive at all. If it is the
                scenario, the message names the file, the line and the field.
        """
        __tracebackhide__ = True
        world = self.world_of(saved)
        now = self._driven(saved, world, owner)
        # If the runs differ by chance, a comparison with the reference would show chance, too.
        if now.is_unsteady:
            return now
        # The comparison shows whether a failure is new with the policy, and whether the reference fails where the
        # policy passes.
        match now.ran:
            case Died():
                # There is no run, and so no failure to look for past the end of the file.
                return self._compared(saved, world, owner, now, [])
            case Finished(verdict=verdict) if verdict.discarded:
                return now
            case Finished():
                sought = _failures_of(now) or [_finding(saved).signature]
                return self._compared(saved, world, owner, now, sought)
            case _:
                assert_never(now.ran)

    def _driven(self, saved: Saved, world: BaseWorld, owner: str) -> Replay:
        # Run a saved scenario, without the reference, and note whether the file accepts the failure.
        __tracebackhide__ = True
        harness, finding = self.harness, _finding(saved)
        # The versions of packages affect positions, on which the death of a process does not depend.
        versions = () if finding.expect.is_crash else version_changes(harness, finding)
        is_elsewhere = versions or world_changes(harness, finding) or sight_change(harness, finding)
        now = Replay(
            tries=tuple(self._tries(saved, world, owner)),
            against=harness.against_name,
            is_flaky=finding.flaky is not None,
            is_rare=finding.rate is not None and finding.rate.failing < ENOUGH,
            is_elsewhere=bool(is_elsewhere),
        )
        if not self.accepts(finding):
            return now
        return replace(now, acceptance=_acceptance(harness, finding, now))

    def _tries(self, saved: Saved, world: BaseWorld, owner: str) -> Iterator[Try]:
        # Yield the runs of the tested policy. A death that makes the replay fail ends it.
        __tracebackhide__ = True
        harness, finding = self.harness, _finding(saved)

        # Run the scenario to the end of the file.
        ended = self.tried(saved, world, owner)
        yield _compare_with_file(finding, Which.AS_SAVED, ended)
        if isinstance(ended, Died) or ended.verdict.discarded:
            return

        # Run a pass again, for DRIVEN_ON longer than the file, because a slower policy fails a little later. If it then
        # fails as the file states, and once more in a third run, it shows the failure of the file. Any other failure in
        # that time is only noted. The runs of a flaky file with a rate differ anyway, and more of them follow.
        if not ended.verdict.failed and not (finding.rate and finding.flaky):
            longer, which = _longer(saved, world), Which.CONTINUED
            # A separate session replays a complete file, so it cannot show in which part a process died.
            has_processes = harness.request.settings.isolate or forks() or saved.needs_own_process
            second: Finished | Died | NotMade = NotMade()
            if has_processes or not harness.left_behind(owner):
                second = self.tried(saved, longer, owner)
            if not isinstance(second, Finished):
                is_saved_failure = isinstance(second, Died) and _is_saved_death(finding, second)
                shows = Shows.SAME if is_saved_failure else Shows.ONLY_NOTED
                yield Try(which, second, shows)
                if is_saved_failure:
                    return
                # It remains to be seen whether the policy repeats the run up to the end of the file.
                which, second = Which.AS_SAVED_AGAIN, self.tried(saved, world, owner)
                if isinstance(second, Died):
                    yield _compare_with_file(finding, which, second)
                    return
            after = _compare_with_pass(harness, finding, ended.run, which, second)
            yield after
            # A flaky file stays flaky, whatever a third run shows.
            if after.repeats and after.fails and finding.flaky is None:
                third = self.tried(saved, longer, owner)
                is_firm = False
                if isinstance(third, Finished) and third.verdict.failed:
                    is_firm = is_same_run(second.run, third.run)
                confirming = Which.CONTINUED_AGAIN
                yield Try(confirming, third, Shows.NOTHING, repeats=is_firm)

        # Run the scenario of a file with a rate ten more times: with other seeds, or with the same one if the file is
        # flaky. The replay fails if any of these runs does. If none does, it passes, but that shows nothing if the
        # failure was rare before.
        if finding.rate is None:
            return
        job = harness.job(world, owner)
        with (
            harness.recording(job) as record,
            refusals(),
            runner_for(job, record, isolate=self.is_apart(saved, owner)) as runner,
        ):
            for number in range(1, RUNS + 1):
                scenario = finding.scenario
                if not finding.flaky:
                    scenario = with_other_seed(scenario, number)
                trace = _trace_or_death(partial(runner.once, scenario))
                if isinstance(trace, Died):
                    yield _compare_with_file(finding, Which.REPEATED, trace)
                    return
                run = harness.run_of(trace, world)
                repeated = Finished(run=run, verdict=harness.judge(run))
                yield _compare_with_file(finding, Which.REPEATED, repeated)

    def _compared(
        self,
        saved: Saved,
        world: BaseWorld,
        owner: str,
        now: Replay,
        sought: Collection[Signature],
    ) -> Replay:
        # Add the runs of the reference. If it passes, and failures are sought, it runs again, past the end of the file,
        # and fails if that run shows one of them.
        __tracebackhide__ = True
        first = self._of_reference(saved, world, owner, is_checked=True)
        match first:
            case NotMade() | Finished(verdict=Verdict(kind="invalid")):
                return now  # Nothing is known about the reference.
            case Finished(run=run, verdict=verdict) if verdict.passes:
                tries = [Try(Which.AS_SAVED, first, Shows.HANDLED)]
            case Finished() | Died():
                failed = Try(Which.AS_SAVED, first, Shows.OTHER)
                return replace(now, reference=(failed,))
            case _:
                assert_never(first)
        if sought:
            later = self._of_reference(saved, _longer(saved, world), owner)
            shows = Shows.NOTHING
            match later:
                # A run that starts differently, or a failure of the whole run, cannot be compared.
                case Finished(run=continued, verdict=Verdict(failure=Failure() as failure)):
                    is_comparable = begins_alike(run, continued) and has_time(continued, failure)
                    if is_comparable and signature_of_failure(continued, failure) in sought:
                        shows = Shows.SAME
            tries.append(Try(Which.CONTINUED, later, shows))
        return replace(now, reference=tuple(tries))

    def _of_reference(
        self, saved: Saved, world: BaseWorld, owner: str, *, is_checked: bool = False
    ) -> Finished | Died | NotMade:
        # Run the scenario with the reference, if there is one, in a separate process if the ADS ran in one.
        __tracebackhide__ = True
        harness = self.harness
        job, isolate = harness.job(world, owner), self.is_apart(saved, owner)
        with (
            harness.recording(job) as record,
            harness.reference_runner(job, record, isolate=isolate) or nullcontext() as runner,
        ):
            if runner is None:
                return NotMade()
            run, verdict = harness.run_reference(runner, _finding(saved).scenario, world)
            if run is None:
                return Died(end="died or hung")
            if not is_checked or not verdict.is_ads or verdict.failure is None:
                return Finished(run=run, verdict=verdict)
            # If the reference fails in the same way in random scenarios, it cannot drive at all. Without this error,
            # each replay that passes would be called fixed.
            failure = verdict.failure
            try:
                space = build_space(harness.request, world)
                for number in range(PROBES):
                    probe = harness.judge_reference(runner, sample(space, rng_of(number)), world)
                    is_other = probe.failure is None or probe.failure.kind != failure.kind
                    if is_other or not probe.is_ads:
                        return Finished(run=run, verdict=verdict)
            # The arguments of the test do not fit the world of the file, so nothing can be compared.
            except RequestError:
                return Finished(run=run, verdict=verdict)
        raise AgainstError(
            f"against ({harness.against_name}): the reference failed with {failure.kind}: {failure.message} in this "
            f"replay and in {PROBES} random scenarios, so it cannot drive at all. Correct the reference, its factory, "
            "or the world= in which it drives."
        )


def _trace_or_death(run: Callable[[], Trace]) -> Trace | Died:
    # Call a function that runs a scenario in a separate process.
    __tracebackhide__ = True
    try:
        return run()
    except ProcessLostError as lost:
        return Died(end=lost.end, pid=lost.pid, is_hang=lost.is_hang)


def _compare_with_file(finding: Finding, which: Which, ended: Finished | Died) -> Try:
    # Compare a run that is no longer than the file with the file.
    match ended:
        case Died():
            is_same = _is_saved_death(finding, ended)
        case Finished(run=run, verdict=Verdict(failure=Failure() as failure)):
            is_same = is_same_event(finding.expect, run, failure)
            # A failure that occurs by chance can occur at any time.
            if finding.rate is not None:
                is_same = is_same_failure(finding, run, failure)
        case Finished(run=run, verdict=verdict):
            if verdict.passes and handles(finding, run):
                return Try(which, ended, Shows.HANDLED)
            return Try(which, ended, Shows.NOTHING)
        case _:
            assert_never(ended)
    return Try(which, ended, Shows.SAME if is_same else Shows.OTHER)


def _compare_with_pass(
    harness: Harness, finding: Finding, first: Run, which: Which, second: Finished
) -> Try:
    # Compare a run with the file and with an earlier run that passed, which it should continue or repeat.
    __tracebackhide__ = True
    run, failure = second.run, second.verdict.failure
    is_alike, hits = begins_alike(first, run), _hits_soon(finding, first, run)
    shows = Shows.STILL_COLLIDES if hits else Shows.NOTHING
    if failure is None:
        return Try(which, second, shows, repeats=is_alike)
    # The failure occurred after the end of the file, unless the test function or a clock decides by chance.
    is_after = is_alike and run.trace.ticks > first.trace.ticks
    if not is_after or harness.judge(first).failed:
        # Only for a file with a rate does it matter which failure occurs by chance. Any other file is flaky.
        is_same = finding.rate is None or is_same_failure(finding, run, failure)
        return Try(which, second, Shows.SAME if is_same else Shows.OTHER, repeats=False)
    # A value of the whole run, such as the distance driven, cannot be evaluated in a longer run.
    if has_time(run, failure):
        if is_same_failure(finding, run, failure):
            shows = Shows.SAME
        # The collision with the same NPC concerns the file more than a different failure.
        elif not hits:
            shows = Shows.ONLY_NOTED
    return Try(which, second, shows)


def _hits_soon(finding: Finding, run: Run, longer: Run) -> bool:
    # Return whether the NPC of the file hits the ego shortly after the end of `run`, which `longer` continues. It does
    # not matter who is responsible, because the same collision may now be the fault of another party.
    expect, hit = finding.expect, longer.collision
    if expect.outcome is not Outcome.COLLISION or expect.check is not None or expect.npc is None:
        return False
    if run.collision is not None or hit is None or hit.npc != expect.npc:
        return False
    return hit.time <= run.duration + SOON and begins_alike(run, longer)


def _is_saved_death(finding: Finding, died: Died) -> bool:
    # Return whether a file expects that the process dies, or hangs, as it did.
    if died.is_hang:
        return finding.expect.outcome is Outcome.HANG
    return finding.expect.is_crash


def _failures_of(now: Replay) -> list[Signature]:
    # The failure that a replay shows, if any.
    match now.ran:
        case Died() as died:
            return [died.signature]
        case Finished(run=run, verdict=Verdict(failure=Failure() as failure)):
            return [signature_of_failure(run, failure)]
        case _:
            return []


def _acceptance(harness: Harness, finding: Finding, now: Replay) -> Acceptance:
    # Compare the failure of a replay with the one that its file accepts.
    match now.ran:
        case Died(end=end) if not now.is_same:
            return Beyond(why=f"a process that {end}")
        case Finished(run=run, verdict=Verdict(failure=Failure() as failure)):
            same_versions = not version_changes(harness, finding)
            why = beyond_acceptance(finding, run, failure, same_versions=same_versions)
            if why:
                return Beyond(why=why)
    return "accepted"


def check_set_up(
    harness: Harness, run: Run, verdict: Verdict, *, owner: str, isolate: bool
) -> None:
    """Check that a replay fails because of its scenario, and not because of the set-up.

    Raises:
        SetupFaultError: if random scenarios of the test end in the same exception.
    """
    # For example, an ADS with a wrong signature fails at its first decision in any scenario.
    __tracebackhide__ = True
    cause = cause_of(run, verdict)
    if cause is None:
        return
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
    runs = f"this replay and {PROBES} random scenarios"
    raise SetupFaultError(run, verdict, runs, is_replay=True)


# Sentences about a replay.


def note_on(finding: Finding, now: Replay) -> str:
    """Describe what happened after the end of the saved run, and how often the replay fails now."""
    notes = [_note_past_end(finding, now)]
    then, rate = finding.rate, now.rate
    if then is not None and rate is not None:
        how, drawn = "with", finding.drawn
        if finding.flaky:
            how = "in"
        elif not rate.failing:
            drawn += none_text(RUNS, finding.drawn)
        before = f"failed {how} {then} {finding.drawn} when it was found"
        notes.append(f"{before}, and now fails {how} {rate} {drawn}")
    return "; ".join(filter(None, notes))


def _note_past_end(finding: Finding, now: Replay) -> str:
    # A death up to the end of the file is all that matters.
    if isinstance(now.ran, Died) and now.shown.which is not Which.CONTINUED:
        return ""
    first = now.tries[0].ended
    for each in now.second:
        match each:
            case Try(shows=Shows.SAME, repeats=True, ended=Finished() as ended):
                return f"the same failure occurs {PAST_END}: {_event_in(finding, ended)}"
            case Try(shows=Shows.ONLY_NOTED, ended=Finished() as ended):
                return f"a different failure occurs {PAST_END}: {_event_in(finding, ended)}"
            case Try(ended=Finished(run=run, verdict=verdict)):
                if isinstance(first, Finished) and _hits_soon(finding, first.run, run):
                    how = headline(run, verdict)
                    return f"the same NPC still collides with the ego {PAST_END} ({how})"
    for each in now.tries:
        match each:
            case Try(which=Which.CONTINUED, ended=NotMade()):
                because = "a process died there before, and this system cannot fork"
                return f"it was not run {PAST_END}, because {because}"
            case Try(which=Which.CONTINUED, ended=Died(end=end)):
                return f"the process {end} {PAST_END}"
    return ""


def _event_in(finding: Finding, ended: Finished) -> str:
    run, failure = ended.run, ended.verdict.failure
    # If the run has no event of its own, only the message of the test function tells what failed.
    is_check = failure is not None and failure.check is not None
    if is_check or run.outcome in HAS_EVENT:
        return describe_result(finding, run, failure)
    return headline(run, ended.verdict)


# How the conditions of a replay differ from those of its file.


def version_changes(harness: Harness, finding: Finding) -> list[str]:
    """Describe the packages whose versions differ."""
    then, now = finding.found.versions, harness.versions
    other = [name for name in sorted(then) if now.get(name) != then[name]]
    return [f"{name} {now.get(name, 'none')} instead of {then[name]}" for name in other]


def world_changes(harness: Harness, finding: Finding) -> list[str]:
    """Describe the differences between the worlds of a file and of the test that affect a replay."""
    # its runs may be shorter than in the file, even if nothing else differs
    changed = codec.changes(finding.world, harness.world)
    return changed or codec.describe_limits(finding.world, finding.scenario, harness.world)


def sight_change(harness: Harness, finding: Finding) -> list[str]:
    """Describe the difference in perception, if any."""
    then = finding.perception or Sight()
    now = harness.policy.sight or Sight()
    if then == now:
        return []
    return [f"found with {then.described}, but run with {now.described}"]


def setting_changes(harness: Harness, finding: Finding) -> list[str]:
    """Describe the differences in world, traffic and perception between a file and the test."""
    # A replay uses the file's traffic and, if the file's world is data, this world.
    told = world_changes(harness, finding)
    elsewhere = codec.describe_world_change(finding.world, finding.scenario, harness.world)
    changed = ", ".join(elsewhere)
    if changed:
        told = [*told, f"run in the file's world, not the test's: {changed}"]
    then, now = finding.scenario.traffic, harness.request.space.get("traffic")
    if now is not None and now != then:
        told = [*told, f"run in the file's traffic, not the test's: {then} instead of {now}"]
    return [*told, *sight_change(harness, finding)]


def changes(harness: Harness, finding: Finding, now: str) -> str:
    """Describe all differences between a replay, with the result ``now``, and its file."""
    changed = [
        event_change(finding, now),
        *version_changes(harness, finding),
        *setting_changes(harness, finding),
    ]
    return "; ".join(filter(None, changed)) or "the run differs from the saved one"


def event_change(finding: Finding, now: str) -> str:
    """Describe the difference between a replay's event and the event in its file, if any."""
    expect = finding.expect
    if expect.check is not None:
        then = f"{expect.assertion} failed at {expect.time:.1f} s"
    elif expect.is_crash:
        then = "a process crash"
    else:
        then = _event(expect.outcome, expect.time)
    if then == now:
        return ""
    return f"{now} instead of {then}"


def describe_result(finding: Finding, run: Run, failure: Failure | None) -> str:
    """Describe a replay's result in the same form as the file describes the expected result."""
    if failure is not None and failure.check is not None:
        if failure.check.time is None:
            return f"{failure.check.name} failed"
        return f"{failure.check.name} failed at {failure.check.time:.1f} s"
    if finding.expect.check is not None and failure is not None:
        return failure.kind
    # Only the outcome of the file is worth a time if nothing happened at that time.
    if finding.expect.check is None and run.outcome is finding.expect.outcome:
        return _event(run.outcome, run.event_time)
    return ending(run)


def _event(outcome: Outcome, time: float) -> str:
    if outcome in HAS_EVENT:
        return f"{outcome} at {time:.1f} s"
    return f"{outcome} and most critical at {time:.1f} s"


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
