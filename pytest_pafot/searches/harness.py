"""The world, policy, test function and folders of a search."""

from __future__ import annotations

import hashlib
import inspect
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.execution.crash_records import CrashRecord, Leftover, left_by
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Cluster, ExecutionError, Here, Job, runner_for
from pytest_pafot.findings.finding import ads_failure, raised_failure
from pytest_pafot.findings.verdict import PROCESS_CRASH, Failure, Verdict, severity_of
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import WORLD_HANG, Outcome, Trace
from pytest_pafot.oracle.run import Recording, Rejected, Run, recorded
from pytest_pafot.searches.request import AgainstError, Request
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.process import REPLACED
from pytest_pafot.support.references import factory_named, name_of, source_files
from pytest_pafot.world import AdsFactoryError, WorldError, codec
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import Perception, Policy, hint_at_object, sight_of
from pytest_pafot.world.guard.hang_guard import UNFIT, exits, is_interruption, let_through
from pytest_pafot.world.kernel.action import LaneCommand, possible_acceleration, possible_steering
from pytest_pafot.world.limits import TOP_SPEED

# The user's test function, with all arguments except the run already bound. It asserts, and returns None.
Test = Callable[[Run], Any]


class PlainFailure(Exception):  # noqa: N818  (its name is printed as the failure)
    """A failure without a traceback, which would show only this package's code."""


def source_file(function: Callable[..., Any], default: str = "") -> str:
    """Return the source file of a function, ignoring decorators."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    return default if code is None else str(code.co_filename)


def judge(run: Run, test: Test, *, blame: str, test_file: str | None = None) -> Verdict:
    """Evaluate a run with the test function, unless the ADS failed or NPCs touched.

    Raises:
        BaseException: any exception that is not a result of the run, such as an interrupt or a timeout of the item.
    """
    if run.outcome is Outcome.INVALID:
        return Verdict(kind="invalid")
    # The failing line in this file identifies a failure.
    if test_file is None:
        # A decorated function has the file of its innermost function, in which its assertions are.
        test_file = source_file(test)
    # An exception of the ADS comes before anything that the test could say about the run.
    broken = ads_failure(run)
    if broken is not None:
        is_timed = run.outcome is Outcome.HANG
        timing = ""
        if is_timed:
            timing = " (depends on wall-clock time)"
        exception = PlainFailure(ads_text(broken, timing))
        return Verdict(
            kind="failed", exception=exception, failure=broken, is_timed=is_timed, is_ads=True
        )
    # The function is not called for collisions for which only an NPC is responsible.
    if blame != "any" and run.responsibility == "npc":
        return Verdict(kind="npc")
    return _verdict_of_test(run, test, test_file)


def _verdict_of_test(run: Run, test: Test, test_file: str) -> Verdict:
    # Checks and targets of the function are noted while it runs, because its exception carries only the failed
    # one.
    recording = Recording(
        hz=run.trace.physics_hz, ticks=run.trace.ticks, npcs=len(run.scenario.npcs)
    )
    try:
        with recorded(recording):
            result = test(run)
    except Rejected:
        return Verdict(kind="rejected")
    except xfails() as error:
        raise RequestError(
            f"the test function called pytest.xfail({str(error)!r}), which would hide a failure. To accept a failure, "
            "add a line `xfail:` to the file of its saved scenario. To discard a run, call pafot.reject()."
        ) from None
    except skips() as skipped:
        return Verdict(kind="skipped", exception=skipped)
    except RequestError:
        raise
    except UNFIT as error:
        if is_interruption(error):
            raise
        # Any exception is a failure of the property, as in a test without a search.
        failure = raised_failure(error, test_file)
        return Verdict(
            kind="failed",
            exception=error,
            failure=failure,
            checks=tuple(recording.checks),
            severity=severity_of(run, failure),
        )
    if result is not None:
        raise RequestError(
            f"the test function returned {result!r:.60}, but it must assert and return None. Write `assert ...` "
            "instead of `return ...`."
        )
    return Verdict(kind="passed", checks=tuple(recording.checks))


def ads_text(failure: Failure, timing: str = "") -> str:
    """Return a message about a failure of the ADS or the environment, with its traceback."""
    who = "environment" if failure.kind == WORLD_HANG else "ADS"
    text = f"the {who} failed: {failure.kind}: {failure.message}{timing}"
    if failure.traceback:
        text += f"\n\n{failure.traceback.rstrip()}"
    return text


def headline(run: Run, verdict: Verdict) -> str:
    """Return one line about a finding's event, with the test function's message if that adds anything."""
    failure = verdict.failure
    # The event is worth more than the assertion, which is the same for all findings of a test.
    line = collision_in_short(run) or run.explain().splitlines()[0]
    if failure is None:
        return line
    # After an exception, the end of the run says nothing that the exception does not.
    if verdict.is_ads:
        return f"{failure.kind}: {failure.message}"
    if failure.check is not None:
        return str(failure.check)
    first = failure.message.partition("\n")[0].strip()
    is_bare = run.collision is not None and first.startswith("assert ")
    # The message adds nothing if it starts as the line does.
    if is_bare or not first or re.split(r":|, | at ", line)[0] in first:
        return line
    described = f"{first[:120]} ({line})"
    if isinstance(verdict.exception, AssertionError):
        return described
    return f"{type(verdict.exception).__name__}: {described}"


def collision_in_short(run: Run) -> str:
    """Return one line about who hit whom and who is at fault, or an empty string without a collision."""
    return run.impact and f"{run.impact}; {AT_FAULT[run.attribution.responsibility]}"


def skips() -> tuple[type[BaseException], ...]:
    """Return the exception classes that pytest reports as a skip or an xfail."""
    # The package does not import pytest here. Code that raises one of these exceptions has already imported its module.
    found: list[type[BaseException]] = []
    # The value of a module that must not be imported is None.
    if sys.modules.get("pytest") is not None:
        found += [sys.modules["pytest"].skip.Exception, *xfails()]
    if sys.modules.get("unittest") is not None:
        found.append(sys.modules["unittest"].SkipTest)
    return tuple(found)


def xfails() -> tuple[type[BaseException], ...]:
    """Return the exception class of ``pytest.xfail()``, or an empty tuple without pytest."""
    if sys.modules.get("pytest") is None:
        return ()
    return (sys.modules["pytest"].xfail.Exception,)


def assertions() -> tuple[type[BaseException], ...]:
    """Return the exception classes that a violated property raises."""
    if sys.modules.get("pytest") is None:
        return (AssertionError,)
    return (AssertionError, sys.modules["pytest"].fail.Exception)


def no_skip(who: str, error: BaseException) -> str:
    """Return the error message for a skip where skips are not allowed."""
    return (
        f"{who} raised {type(error).__name__}({str(error)!r}), but a skip there would hide that nothing was tested. "
        "Call pytest.skip() in the fixture or in the test function, or mark the test with "
        "@pytest.mark.skipif."
    )


Cause = tuple[str, str]  # the class of an exception, and where it was raised

# A steering angle above which the units of an action are doubtful [rad]: no car reaches it.
NO_STEERING = math.pi / 2
# An acceleration above which the units of an action are doubtful [m/s^2]: no car reaches it. Large negative
# accelerations are allowed, because planners use them to brake as hard as possible.
NO_ACCELERATION = 30.0


class SetupFaultError(Exception):
    """An exception that ends all first runs of a search, or a replay and random runs, in the same way."""

    def __init__(self, run: Run, verdict: Verdict, runs: str, *, is_replay: bool = False) -> None:
        super().__init__(f"{runs} ended with {verdict.exception!r}")
        self.run, self.verdict, self.runs, self.is_replay = run, verdict, runs, is_replay

    @property
    def received(self) -> str:
        failure = self.verdict.failure
        if failure is None:
            return ""
        return f"{failure.kind}: {failure.message}"

    def first_decision(self, world: BaseWorld, policy: Policy) -> str:
        """Return a hint about the decision that the world expects, or an empty string."""
        # Such a policy makes no decisions that could have wrong units.
        if policy.drives_itself:
            return ""
        asked = world.first_decision(self.run.trace.scenario)
        if asked is None:
            return ""
        advice = asked.advice
        # If the world has no advice, it depends on whether the decision is in SI units or the environment's.
        if not advice and asked.is_si:
            advice = 'A policy for a highway-env environment needs world=pafot.World("highway-v0", config=...).'
        elif not advice:
            advice = (
                "A policy needs the config= and the wrappers= with which it was trained. A planner in SI units "
                "needs pafot.Highway, which is the default world, or pafot.World(..., planner_hz=5)."
            )
        return f"\n\n{asked.text} {advice}"

    def shown(self, world: BaseWorld, policy: Policy) -> BaseException:
        """Return the exception to raise, with an explanation and advice."""
        verdict = self.verdict
        nothing, again = "so nothing was saved", "search"
        if self.is_replay:
            nothing, again = "so it shows nothing about any saved scenario", "replay"
        if verdict.is_ads or verdict.exception is None:
            asked = self.first_decision(world, policy)
            return PlainFailure(
                f"{verdict.exception}\n\n"
                f"This happened in {self.runs}, at the first decision. It is an error in the set-up and not a finding, "
                f"{nothing}. Correct the ADS, its factory, or the world= in which it drives, and {again} again.{asked}"
            )
        verdict.exception.add_note(
            f"This happened in {self.runs}, whatever the ego did. It is an error in the test function and not a "
            f"finding, {nothing}. Correct the line and {again} again. Use assert if it should be a finding."
        )
        return verdict.exception


def cause_of(run: Run, verdict: Verdict) -> Cause | None:
    """Return the cause of a failure that could be due to a fault in the set-up, or None."""
    failure = verdict.failure  # an assertion is never a fault of the set-up
    if (
        failure is None
        or failure.kind == AssertionError.__name__
        or isinstance(verdict.exception, assertions())
    ):
        return None
    # The place of an error of the test function is the line of that function.
    if not verdict.is_ads:
        return failure.kind, failure.assertion
    error = run.ads_error
    # After the first decision, or if the ADS hangs, the cause can be the scenario or the machine.
    if error is None or error.tick > 0 or error.interrupted:
        return None
    # The innermost frame is the place. Messages can differ from run to run, and are not compared.
    places = [line for line in error.traceback.splitlines() if "File " in line]
    return error.kind, places[-1] if places else ""


def unit_doubt(trace: Trace) -> str:
    """Return a hint if a planner's actions seem not to be in SI units, or an empty string."""
    steering = speed = acceleration = 0.0
    # one loop without calls, which is fast, because each run is checked
    for action in trace.actions:
        if type(action) is tuple and len(action) == 2:
            wanted, angle = action
            if not -steering <= angle <= steering:
                steering = abs(angle)
        elif isinstance(action, LaneCommand):
            wanted = action.acceleration or 0.0
            speed = max(speed, action.speed or 0.0)
        else:
            continue
        if wanted > acceleration:  # noqa: PLR1730  (a call for each decision is slower)
            acceleration = wanted
    if steering > NO_STEERING:
        return (
            f"the ADS requested a steering angle of {steering:.3g} rad, but only "
            f"{possible_steering(steering):.2f} rad takes effect. Convert degrees with math.radians(...). An action is "
            "(acceleration, steering), in this order"
        )
    if speed > TOP_SPEED:
        return (
            f"the ADS requested a speed of {speed:.3g} m/s, but no vehicle drives faster than {TOP_SPEED:g} m/s. "
            "Divide km/h by 3.6"
        )
    if acceleration > NO_ACCELERATION:
        return (
            f"the ADS requested an acceleration of {acceleration:.3g} m/s^2, but only "
            f"{possible_acceleration(acceleration):g} m/s^2 takes effect. An action is (acceleration, steering), not a "
            "speed"
        )
    return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """A policy, such as an earlier version, with which a search compares the tested policy."""

    policy: Policy
    name: str  # the name in saved files; empty if no string can refer to the factory

    @property
    def shown(self) -> str:
        return self.name or "the reference"


def reference_of(
    given: object, fixture: Callable[[str], Callable[..., Any]], tested: Policy
) -> Reference | None:
    """Return the reference that the option ``against`` specifies, or None.

    Raises:
        AgainstError: if ``given`` does not specify a different factory.
    """
    if given is None:
        return None
    found: Any = given
    name = ""
    if isinstance(given, str):
        name = given
        # Names of fixtures contain no colon.
        find = factory_named if ":" in given else fixture
        try:
            found = find(given)
        except ValueError as error:
            raise AgainstError(f"against: {error}") from error
    if not callable(found):
        problem = (
            "expected a factory such as `lambda: OldPlanner()`, its name as module:factory, or the name of a fixture "
            f"that returns a factory, received {found!r:.100}"
        )
        hint = hint_at_object(found)
        if hint:
            problem += f". {hint}"
        raise AgainstError(f"against: {problem}")
    reference = Reference(policy=Policy(found), name=name or name_of(found))
    # A comparison with itself would always be green.
    same = same_policy(tested.factory, found)
    if same:
        raise AgainstError(f"against ({reference.shown}): {same}")
    return reference


def same_policy(ads: Callable[..., Any], other: Callable[..., Any]) -> str:
    """Return an error message if two factories make the same policy, or an empty string."""
    # They do if they have the same perception, name and arguments, and if all their source files have the same content.
    # All files count, because a copy of one module still imports the other modules of the present policy.
    # The same policy behind a different perception decides differently.
    if sight_of(ads) != sight_of(other):
        return ""
    ads, other = (each.ads if isinstance(each, Perception) else each for each in (ads, other))
    if ads is not other:
        parts = [_parts(each) for each in (ads, other)]
        # Factories without a name, such as lambdas, may differ in what they have captured.
        if None in parts or parts[0] != parts[1]:
            return ""
        files, others = source_files(ads), source_files(other)
        if not files or _contents(files, others) != _contents(others, files):
            return ""
    return (
        "expected a different policy, received one with the same name and the same files as the tested policy. If the "
        "policy has not changed, skip the comparison. Otherwise, put the earlier policy, with all its modules, into a "
        "package with a different name."
    )


def _parts(factory: Any) -> object:
    # Return None if the name does not identify the policy that the factory makes.
    if isinstance(factory, partial):
        inner = _parts(factory.func)
        return None if inner is None else (inner, repr(factory.args), repr(factory.keywords))
    name = getattr(factory, "__qualname__", None)
    return None if name is None or "<" in name else name


# Signs that a module opens data next to its file. A copy of the module then opens other data.
BY_ITS_PLACE = re.compile(rb"__file__|__path__|__spec__|__package__|resources|get_data")


def _contents(
    files: Mapping[Path, tuple[str, str]], others: Mapping[Path, tuple[str, str]]
) -> Counter[str]:
    # Hash the source files. If they open data next to them, hash the data, too, except in folders that both have.
    hashes = Counter(digest for _, digest in files.values())
    if any(path.is_file() and BY_ITS_PLACE.search(path.read_bytes()) for path in files):
        folders = {path.parent for path in files} - {path.parent for path in others}
        data = (
            path
            for folder in folders
            for path in folder.rglob("*")
            if path.suffix not in (".py", ".pyc")
        )
        hashes.update(
            hashlib.sha256(path.read_bytes()).hexdigest() for path in data if path.is_file()
        )
    return hashes


@dataclass(frozen=True, slots=True, kw_only=True)
class Harness:
    """The world, policy, test function and folders for the scenarios of one test."""

    request: Request
    world: BaseWorld  # the world of the search; a saved scenario may have a different one
    policy: Policy
    test: Test
    test_file: str
    node_id: str  # the node id of the test, without the part that the plugin adds
    # returns the node id of the item for the id of a saved scenario
    saved_node_id: Callable[[str], str]
    folder: Path  # the folder of the test's saved scenarios
    records: Path  # the folder of crash records
    root: Path  # the folder of the project; paths in messages are relative to it
    versions: dict[str, str]  # versions of the packages that affect a run
    # the reference, which must pass a scenario for a failure to count
    against: Reference | None = None
    cluster: Cluster | None = None  # the workers on other machines that run scenarios, if any
    # True if the run is the only argument of the test function, so that forked processes can call it, too
    needs_only_run: bool = False

    def job(self, world: BaseWorld | None = None, owner: str = "") -> Job:
        """Return the job for a worker process, by default in the search's world."""
        world = self.world if world is None else world
        with refusals():  # only building the environment shows whether a pafot.World can be used
            data = codec.described(world)
            with REPLACED.shown(True):
                self.policy.preload()
        owner = owner or self.node_id  # crashes are recorded under this node id
        return Job(
            world=world,
            policy=self.policy,
            records=self.records,
            owner=owner,
            world_data=data,
            root=self.root,
        )

    def run_of(self, trace: Trace, world: BaseWorld | None = None) -> Run:
        return (self.world if world is None else world).run_of(trace)

    def judge(self, run: Run) -> Verdict:
        __tracebackhide__ = True
        return judge(run, self.test, blame=self.request.blame, test_file=self.test_file)

    @property
    def against_name(self) -> str:
        return "" if self.against is None else self.against.shown

    def judge_trace(self, world: BaseWorld, trace: Trace) -> Verdict:
        return self.judge(self.run_of(trace, world))

    def reference_runner(self, job: Job, record: CrashRecord, *, isolate: bool) -> Here | None:
        if self.against is None:
            return None
        with refusals():
            job = replace(job, policy=self.against.policy, reference=self.against.shown)
            return runner_for(job, record, isolate=isolate)

    def judge_reference(
        self, runner: Here, scenario: Scenario, world: BaseWorld | None = None
    ) -> Verdict:
        __tracebackhide__ = True
        return self.run_reference(runner, scenario, world)[1]

    def run_reference(
        self, runner: Here, scenario: Scenario, world: BaseWorld | None = None
    ) -> tuple[Run | None, Verdict]:
        """Run the reference in a scenario. Return the run (None if its process was lost) and the verdict."""
        __tracebackhide__ = True
        try:
            with refusals("the reference"):
                trace = runner.once(scenario)
        except ProcessLostError as error:
            return None, Verdict(
                kind="failed", failure=Failure(kind=PROCESS_CRASH, message=error.end), is_ads=True
            )
        except RequestError as error:
            # The message was written for the tested policy. The user must see that the reference is
            # meant.
            text = str(error).removeprefix("ads: ").removeprefix(f"{self.against_name}: ")
            named = f" ({self.against_name})" if self.against_name else ""
            raise AgainstError(f"against{named}: {text}") from None
        run = self.run_of(trace, world)
        return run, self.judge(run)

    @contextmanager
    def recording(self, job: Job) -> Iterator[CrashRecord]:
        """Provide a crash record, which stays on disk only if the process dies."""
        try:
            with job.crash_record() as record:
                yield record
        finally:
            # The folder has records of other processes, or was never created.
            with suppress(OSError):
                self.records.rmdir()

    def left_behind(self, owner: str = "") -> list[Leftover]:
        """Return the crash records of processes that died during runs of this test."""
        return left_by(owner or self.node_id, self.records)


@contextmanager
def refusals(whose: str = "the ADS") -> Iterator[None]:
    """Turn errors that the user can correct into a :class:`RequestError`."""
    __tracebackhide__ = True
    try:
        yield
    except (WorldError, AdsFactoryError, ScenarioError, ExecutionError) as error:
        raise RequestError(str(error)) from None
    except skips() as error:  # raised by the factory: exceptions of the ADS are in the trace
        raise RequestError(no_skip(f"the factory of {whose}", error)) from None
    except exits() as error:
        let_through(error)
        raise RequestError(
            f"the factory of {whose} called pytest.exit({str(error)!r}), but a factory must not end the session. "
            "Raise a different exception."
        ) from None


def checked_factory(given: object, name: str) -> Callable[..., Any]:
    """Return the value of a fixture if it is an ADS factory, or raise an error."""
    # A common mistake is to return the policy itself, which would keep its state from run to run.
    if not callable(given):
        hint = hint_at_object(given)
        raise RequestError(
            f"expected the fixture {name!r} to return a factory, which makes a new ADS for each scenario, such as "
            f"`lambda: MyPlanner()`, received {given!r:.100}{f'. {hint}' if hint else ''}"
        )
    return given


def is_same_run(a: Run, b: Run) -> bool:
    """Return whether two runs are identical to the last bit."""
    first, second = a.trace.states, b.trace.states
    return (
        a.outcome == b.outcome
        and first.shape == second.shape
        and first.tobytes() == second.tobytes()
    )


def begins_alike(run: Run, longer: Run) -> bool:
    """Return whether ``longer`` starts with the same states as ``run``."""
    # Bytes and not values, because NaN differs from itself.
    first, second = run.trace.states, longer.trace.states
    # nothing to continue
    if len(second) <= len(first) or run.outcome not in (Outcome.COMPLETED, Outcome.OFF_ROAD):
        return is_same_run(run, longer)
    return first.tobytes() == second[: len(first)].tobytes()
