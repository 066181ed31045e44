"""What one search runs and judges with: a world, an ADS, a test function; where what it finds lies; and its runs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pytest_pafot.attribution.last_chance import Avoidance, LastChance, avoidance, last_decision
from pytest_pafot.campaign.request import Request, RequestError
from pytest_pafot.campaign.verdict import Test, Verdict, judge, no_skip, reference_outcomes, skips
from pytest_pafot.execution.crash_records import CrashRecord, Leftover, left_by
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Runner, runner_for
from pytest_pafot.execution.scenario_pool import ExecutionError, Job
from pytest_pafot.execution.separate_runs import replay_in_gym_apart
from pytest_pafot.findings.signature import PROCESS_CRASH, Failure
from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import ReferenceOutcome, Run
from pytest_pafot.searching.fitness import referred_to
from pytest_pafot.world import AdsFactoryError, WorldError, codec, protocol
from pytest_pafot.world.driving.ads import hint_at_object, preload
from pytest_pafot.world.guard.failure import exits, let_through

# The reference of a search: a policy beside the one that is tested, such as the one before a change.


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """A policy that failures are held against."""

    ads: Callable[..., Any]  # its factory
    name: str  # by which files call it; empty for a factory that no text can refer to

    @property
    def shown(self) -> str:
        """What the summary calls it."""
        return self.name or "the reference"


def reference_of(given: object, fixture: Callable[[str], Callable[..., Any]]) -> Reference | None:
    """The reference that the option ``against`` gives: a factory, its ``module:factory``, or a fixture by its name.

    Raises:
        RequestError: for anything else, or a module or a name that there is not.
    """
    if given is None:
        return None
    if isinstance(given, str) and ":" not in given:
        return Reference(ads=fixture(given), name=given)
    try:
        ads = referred_to(given) if isinstance(given, str) else given
    except ValueError as error:
        raise RequestError(f"against: {error}") from error
    if not callable(ads):
        raise RequestError(
            "against: expected a factory such as `lambda: OldPlanner()`, its module:factory, or the name of a fixture "
            f"that gives it, received {ads!r:.100}. {hint_at_object(ads)}".removesuffix(". ")
        )
    return Reference(ads=ads, name=given if isinstance(given, str) else _name_of(ads))


def _name_of(factory: Callable[..., Any]) -> str:
    name = f"{getattr(factory, '__module__', '')}:{getattr(factory, '__qualname__', '')}"
    try:
        return name if referred_to(name) is factory else ""
    except ValueError:
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Harness:
    """How scenarios are run and judged for one test, parameters included."""

    request: Request
    world: Any  # of new scenarios
    ads: Callable[..., Any]
    test: Test
    test_file: str
    node_id: str  # of the test, free of what the plugin adds
    saved_node_id: Callable[[str], str]  # under which a saved scenario of an id is a test of its own
    folder: Path  # of the test's saved scenarios
    records: Path  # folder of the crash records
    root: Path  # folder of the project, which paths are told relative to
    versions: dict[str, str]  # of the packages that a run depends on
    against: Reference | None = None  # that must pass where a failure shall count
    executor: Executor | None = None  # that makes the runs of a search, where the user has one
    states: Path | None = None  # folder of the states of searches that go on in other sessions, where there is one

    def job(self, world: Any = None, owner: str = "") -> Job:
        """What any process needs to run scenarios: of this test, in the world of new ones, unless others are given.

        Raises:
            RequestError: for a world that cannot be used, or an ADS that cannot be loaded.
        """
        world = self.world if world is None else world
        with refusals():  # whether a pafot.World can be used shows when its environment is made
            data = codec.described(world)
            preload(self.ads)
        owner = owner or self.node_id
        memory = self.request.settings.memory
        return Job(
            world=world,
            ads=self.ads,
            records=self.records,
            owner=owner,
            world_data=data,
            root=self.root,
            memory=memory,
        )

    def seen(self, trace: Trace, world: Any = None) -> Run:
        """The run that a trace is the record of, in the world of new scenarios unless another is given."""
        world = self.world if world is None else world
        known, take_over = protocol.reference_world(world), protocol.taking_over(world)
        return Run(trace, decision_limit=self.request.decision_limit, world=known, take_over=take_over)

    def judge(self, run: Run) -> Verdict:
        """What the user's function, or the failure of the ADS, makes of a run."""
        __tracebackhide__ = True
        return judge(run, self.test, blame=self.request.blame, test_file=self.test_file)

    def reference_outcomes(self, run: Run, verdict: Verdict) -> dict[str, ReferenceOutcome]:
        """What becomes of the reference drivers where a run fails; empty where it is the ADS itself that failed."""
        if verdict.is_ads or run.world is None:
            return {}
        return dict(reference_outcomes(run, self.test, blame=self.request.blame, test_file=self.test_file))

    @property
    def against_name(self) -> str:
        """Return what the reference that failures are held against is called; empty without one."""
        return "" if self.against is None else self.against.shown

    def last_chance(self, run: Run, verdict: Verdict) -> LastChance | None:
        """Simulate when a reference driver could last have prevented what failed.

        For a collision it is that of the run. For a failed check it is the last decision before the check was worst
        from which the driver keeps it to the end of the run. None for all else, and where a check does not say when.
        """
        take_over = run.take_over
        if take_over is None or verdict.failure is None or verdict.severity is None:
            return None
        check = verdict.failure.check
        if check is None:
            return run.last_chance
        if check.time is None:
            return None

        until = min(round(check.time * run.trace.physics_hz), run.trace.ticks)

        def keeps(taken: Trace) -> bool:
            # Whoever is to blame for a later collision, the function is asked; an earlier one shows nothing.
            asked = judge(self.seen(taken), self.test, blame="any", test_file=self.test_file)
            made = [each for each in asked.checks if each.name == check.name]
            return taken.ticks >= until and bool(made) and all(each.holds for each in made)

        return last_decision(run.trace, until, take_over, keeps)

    def avoidance(self, run: Run, verdict: Verdict) -> Avoidance | None:
        """Simulate from when on braking avoids the collision that failed; None where something else did."""
        failure = verdict.failure
        if run.take_over is None or failure is None or failure.check is not None or verdict.severity is None:
            return None
        return avoidance(run.trace, run.attribution.fault, run.take_over)

    def judge_trace(self, world: Any, trace: Trace) -> Verdict:
        """What the function makes of a trace from a world."""
        return self.judge(self.seen(trace, world))

    def reference_runner(self, job: Job, record: CrashRecord, *, isolate: bool) -> Runner | None:
        """Who makes the runs of the reference, one by one, and apart where the ADS runs so; None without one."""
        if self.against is None:
            return None
        with refusals():
            return runner_for(replace(job, ads=self.against.ads, reference=self.against.shown), record, isolate=isolate)

    def judge_reference(self, runner: Runner, scenario: Scenario, world: Any = None) -> Verdict:
        """What the function makes of the reference in a scenario; to raise, to hang or to end its process is to fail.

        Raises:
            RequestError: for a factory that cannot be used, or a scenario that does not fit.
        """
        __tracebackhide__ = True
        try:
            with refusals("the reference"):
                trace = runner.run(scenario, afresh=True)
        except ProcessLostError as error:
            return Verdict(kind="failed", failure=Failure(kind=PROCESS_CRASH, message=error.how), is_ads=True)
        except RequestError as error:
            named = "" if self.against is None else f" ({self.against.shown})"
            raise RequestError(f"against{named}: {str(error).removeprefix('ads: ')}") from None
        return self.judge_trace(self.world if world is None else world, trace)

    def fails_with(self, ads: Callable[..., Any], scenario: Scenario, record: CrashRecord) -> bool:
        """Whether the test fails in a scenario with another ADS in the place of its own."""
        __tracebackhide__ = True
        job = replace(self.job(), ads=ads)
        with refusals(), runner_for(job, record, isolate=self.request.settings.isolate) as runner:
            try:
                run = self.seen(runner.run(scenario, afresh=True))
            except ProcessLostError:
                return True
        verdict = self.judge(run)
        record.clear()
        return verdict.failed

    @contextmanager
    def recording(self, job: Job) -> Iterator[CrashRecord]:
        """The record of what runs now; gone at the end, however that comes, unless the process dies."""
        try:
            with job.crash_record() as record:
                yield record
        finally:
            if self.records == self.folder.parents[1]:  # the corpus, where there is no cache to keep records in
                with suppress(OSError):  # It holds findings, or was never made.
                    self.records.rmdir()

    def left_behind(self, owner: str = "") -> list[Leftover]:
        """The records of processes that died in runs of this test, or of another owner of crash records."""
        return left_by(owner or self.node_id, self.records)


@contextmanager
def refusals(whose: str = "the ADS") -> Iterator[None]:
    """Errors that are the user's to mend, of a world, a factory, a scenario or a process, as errors of the request."""
    __tracebackhide__ = True
    try:
        yield
    except (WorldError, AdsFactoryError, ScenarioError, ExecutionError) as error:
        raise RequestError(str(error)) from None
    except skips() as error:  # of the factory: what the ADS raises is in the trace
        raise RequestError(no_skip(f"the factory of {whose}", error)) from None
    except exits() as error:
        let_through(error)
        raise RequestError(
            f"expected the factory of {whose} to leave the session alone, received pytest.exit({str(error)!r}); raise "
            "an exception of another kind"
        ) from None


@dataclass(frozen=True, slots=True)
class Simulation:
    """The runs of one search, each with its scenario on disk, in the record of this process, until it is judged."""

    harness: Harness
    runner: Runner
    record: CrashRecord
    reference: Runner | None = None  # of the policy that failures are held against

    def run(self, scenario: Scenario, *, afresh: bool = False) -> Run:
        """One run, whose verdict follows; ``afresh`` as in :meth:`pytest_pafot.execution.runner.Runner.run`.

        Raises:
            ProcessLostError: where another process made it, and did not come back.
            RequestError: for a world, factory or scenario that does not fit.
        """
        __tracebackhide__ = True
        with refusals():
            trace = self.runner.run(scenario, afresh=afresh)
        return self.harness.seen(trace)

    def judge(self, run: Run, scenario: Scenario | None = None) -> Verdict:
        """The verdict on the last run; the reference has the scenario given, or the run's own, where that fails."""
        __tracebackhide__ = True
        verdict = self.harness.judge(run)
        if verdict.failed and self.reference is not None:
            verdict = verdict.beside(self.harness.judge_reference(self.reference, scenario or run.scenario))
        self.record.clear()
        return verdict

    def is_common(self, scenario: Scenario) -> bool:
        """Whether the reference does not pass a scenario, either, in which the ADS ended its process."""
        __tracebackhide__ = True
        if self.reference is None:
            return False
        verdict = self.harness.judge_reference(self.reference, scenario)
        self.record.clear()
        return not verdict.passes

    def rerun(self, scenario: Scenario) -> Run:
        """One run without a verdict, with the ADS asked for every decision."""
        __tracebackhide__ = True
        run = self.run(scenario, afresh=True)
        self.record.clear()
        return run

    def rerun_one_by_one(self, leftover: Leftover) -> None:
        """Run by itself what was in lock step when a process died, so that a second death has one name."""
        __tracebackhide__ = True
        leftover.discard()  # before another death, of which it would otherwise be the cause for ever
        for scenario in leftover.scenarios:
            self.rerun(scenario)

    def rerun_in_gym(self, scenario: Scenario) -> Run | None:
        """One run by ``env.step`` of highway-env's own environment; None in a world that has none."""
        __tracebackhide__ = True
        world = protocol.gym_replaying(self.harness.world)
        if world is None:
            return None
        self.record.write(scenario)
        with refusals():
            if self.harness.request.settings.isolate:
                trace = replay_in_gym_apart(self.harness.job(), self.record, scenario)
            else:
                trace = world.rollout_in_gym(scenario, self.harness.ads)
        self.record.clear()
        return Run(trace, decision_limit=self.harness.request.decision_limit)


def checked_factory(given: object, name: str) -> Callable[..., Any]:
    """The ADS factory that the fixture of a name gives.

    Raises:
        RequestError: where it is none.
    """
    if not callable(given):
        hint = hint_at_object(given)
        raise RequestError(
            f"expected the fixture {name!r} to give a factory, a function that makes a fresh ADS for each scenario "
            f"such as `return lambda: MyPlanner()`, received {given!r:.100}{f'. {hint}' if hint else ''}"
        )
    return given


def source_file(function: Callable[..., Any], default: str = "") -> str:
    """The file in which a function is written, whatever wraps it."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return default if code is None else str(code.co_filename)


def is_same_run(a: Run, b: Run) -> bool:
    """Whether two runs are the same to the last bit."""
    first, second = a.trace.states, b.trace.states
    return a.outcome == b.outcome and first.shape == second.shape and first.tobytes() == second.tobytes()
