"""The harness of a search: the world, the ADS, the test function and the folders; and the runs made with them."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pytest_pafot.attribution.mistakes import Avoidance, avoidance, keeping_lane
from pytest_pafot.campaign.judging import Test, judge, no_skip, reference_outcomes, skips
from pytest_pafot.campaign.request import AgainstError, Request
from pytest_pafot.execution.crash_records import CrashRecord, Leftover, left_by
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Runner, runner_for
from pytest_pafot.execution.scenario_pool import ExecutionError, Job
from pytest_pafot.findings.decisions import moved_over
from pytest_pafot.findings.signature import PROCESS_CRASH, Failure
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.oracle.run import ReferenceOutcome, Run
from pytest_pafot.support.errors import DriverError, RequestError
from pytest_pafot.support.process import REPLACED
from pytest_pafot.support.references import factory_named, name_of, source_files
from pytest_pafot.world import AdsFactoryError, WorldError, codec
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import Perception, Policy, hint_at_object, sight_of
from pytest_pafot.world.guard.hang_guard import exits, let_through

if TYPE_CHECKING:
    from pytest_pafot.execution.dask_cluster import Cluster

# The reference of a search: a policy with which the tested one is compared, such as its version before a change.


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """The reference of a search: a failure of the tested policy counts only if this policy passes the same scenario."""

    policy: Policy
    name: str  # the name in saved files; empty for a factory that no text can refer to

    @property
    def shown(self) -> str:
        """The name of the reference in the summary."""
        return self.name or "the reference"


def reference_of(given: object, fixture: Callable[[str], Callable[..., Any]], tested: Policy) -> Reference | None:
    """Return the reference of the option ``against`` for a tested policy.

    It is a factory, its ``module:factory[:argument]``, or the name of a fixture.

    Raises:
        AgainstError: if ``given`` is anything else, if the module or the name does not exist, or if it is the policy
            itself.
    """
    if given is None:
        return None
    found: Any = given
    if isinstance(given, str):
        try:
            found = factory_named(given) if ":" in given else fixture(given)
        except ValueError as error:
            raise AgainstError(f"against: {error}") from error
    if not callable(found):
        raise AgainstError(
            "against: expected a factory such as `lambda: OldPlanner()`, its name as module:factory, or the name of a "
            f"fixture that returns a factory, received {found!r:.100}. {hint_at_object(found)}".removesuffix(". ")
        )
    reference = Reference(policy=Policy(found), name=given if isinstance(given, str) else name_of(found))
    if same := same_policy(tested.factory, found):
        raise AgainstError(f"against ({reference.shown}): {same}")
    return reference


def same_policy(ads: Callable[..., Any], other: Callable[..., Any]) -> str:
    """Return why two factories make the same policy, so that it would be compared with itself; empty if they may not.

    They do if they have the same sight, name and arguments, and all files behind them have the same content: a copy of
    one file imports the other modules of the present policy.
    """
    if sight_of(ads) != sight_of(other):
        return ""
    ads, other = (each.ads if isinstance(each, Perception) else each for each in (ads, other))
    if ads is not other:
        parts = [_parts(each) for each in (ads, other)]
        if None in parts or parts[0] != parts[1]:
            return ""
        files, others = source_files(ads), source_files(other)
        if not files or _contents(files, others) != _contents(others, files):
            return ""
    return (
        "expected a policy that differs from the tested one, received one of the same name with the same files, so it "
        "would be compared with itself; put the earlier policy, with all its modules, into a package of another name"
    )


def _parts(factory: Any) -> object:
    """Return the name of a factory in its module, with its arguments; None if its name does not say what it makes."""
    if isinstance(factory, partial):
        inner = _parts(factory.func)
        return None if inner is None else (inner, repr(factory.args), repr(factory.keywords))
    name = getattr(factory, "__qualname__", None)
    return None if name is None or "<" in name else name


BY_ITS_PLACE = re.compile(rb"__file__|__path__|__spec__|__package__|resources|get_data")
"""What a module has that opens data next to it, so that a copy of the module opens other data."""


def _contents(files: Mapping[Path, tuple[str, str]], others: Mapping[Path, tuple[str, str]]) -> Counter[str]:
    """Return the hashes of files and, if they open data by their own place, those of data that only they have."""
    hashes = Counter(digest for _, digest in files.values())
    if any(path.is_file() and BY_ITS_PLACE.search(path.read_bytes()) for path in files):
        folders = {path.parent for path in files} - {path.parent for path in others}
        data = (path for folder in folders for path in folder.rglob("*") if path.suffix not in (".py", ".pyc"))
        hashes.update(hashlib.sha256(path.read_bytes()).hexdigest() for path in data if path.is_file())
    return hashes


@dataclass(frozen=True, slots=True, kw_only=True)
class Harness:
    """Everything that is needed to run and judge scenarios for one test with its parameters."""

    request: Request
    world: BaseWorld  # the world of the search; a saved scenario may have a different one
    policy: Policy
    test: Test
    test_file: str
    node_id: str  # the node id of the test, without the plugin's own part
    saved_node_id: Callable[[str], str]  # returns the node id of a saved scenario's item from its id
    folder: Path  # the folder of the test's saved scenarios
    records: Path  # the folder of crash records
    root: Path  # the folder of the project; paths in messages are relative to it
    versions: dict[str, str]  # versions of the packages on which a run depends
    against: Reference | None = None  # the reference that must pass, so that a failure counts
    cluster: Cluster | None = None  # the workers on other machines for the runs of a search, if any
    # True if the test function takes only the run, so that a process that was forked from this one can call it, too
    needs_only_run: bool = False

    def job(self, world: BaseWorld | None = None, owner: str = "") -> Job:
        """Return the job for a worker process: everything that it needs to run scenarios with the ADS.

        ``world`` is by default the world of the search. ``owner`` is the node id under which crashes of the process are
        recorded, by default the id of this test.

        Raises:
            RequestError: if the world cannot be used, or the ADS cannot be loaded.
        """
        world = self.world if world is None else world
        with refusals():  # only making the environment of a pafot.World shows whether it can be used
            data = codec.described(world)
            with REPLACED.shown(True):
                self.policy.preload()
        owner = owner or self.node_id
        return Job(
            world=world,
            policy=self.policy,
            records=self.records,
            owner=owner,
            world_data=data,
            root=self.root,
        )

    def run_of(self, trace: Trace, world: BaseWorld | None = None) -> Run:
        """Return a trace as the test function sees it; ``world`` is by default the world of the search."""
        return (self.world if world is None else world).run_of(trace)

    def judge(self, run: Run) -> Verdict:
        """Return the verdict on a run. The test function decides, unless the ADS itself failed."""
        __tracebackhide__ = True
        return judge(run, self.test, blame=self.request.blame, test_file=self.test_file)

    def reference_outcomes(self, run: Run, verdict: Verdict) -> tuple[dict[str, ReferenceOutcome], list[DriverError]]:
        """Return how each reference driver fares in the ego's place in a failed run; empty if the ADS itself failed.

        A driver that the world cannot simulate is left out, and its error is among the errors.
        """
        outcomes, errors = dict[str, ReferenceOutcome](), list[DriverError]()
        if verdict.is_ads or run.world is None:
            return outcomes, errors
        for name in run.world.reference_drivers:
            blame = self.request.blame
            try:
                outcomes |= dict(
                    reference_outcomes(run, self.test, blame=blame, test_file=self.test_file, names=[name])
                )
            except DriverError as error:
                errors.append(error)
        return outcomes, errors

    @property
    def against_name(self) -> str:
        """The name of the reference in the summary; empty if the search has no reference."""
        return "" if self.against is None else self.against.shown

    def avoidance(self, run: Run, verdict: Verdict) -> Avoidance | None:
        """Find by simulation when braking, or staying in the lane, avoids the collision; None for any other failure."""
        failure = verdict.failure
        if run.take_over is None or failure is None or failure.check is not None or verdict.severity is None:
            return None
        number = moved_over(run)
        if number is not None:
            return keeping_lane(run.trace, run.trace.decision_ticks[number], run.take_over)
        return avoidance(run.trace, run.attribution.fault, run.take_over)

    def judge_trace(self, world: BaseWorld, trace: Trace) -> Verdict:
        """Return the verdict on a trace that was made in ``world``."""
        return self.judge(self.run_of(trace, world))

    def reference_runner(self, job: Job, record: CrashRecord, *, isolate: bool) -> Runner | None:
        """Return the runner that drives the reference; None if the search has no reference.

        With ``isolate`` the reference runs in a separate process, like the ADS.
        """
        if self.against is None:
            return None
        with refusals():
            job = replace(job, policy=self.against.policy, reference=self.against.shown)
            return runner_for(job, record, isolate=isolate)

    def judge_reference(self, runner: Runner, scenario: Scenario, world: BaseWorld | None = None) -> Verdict:
        """Return the verdict on the reference in a scenario. A reference that raises, hangs or dies has failed."""
        __tracebackhide__ = True
        return self.run_reference(runner, scenario, world)[1]

    def run_reference(
        self, runner: Runner, scenario: Scenario, world: BaseWorld | None = None
    ) -> tuple[Run | None, Verdict]:
        """Return the run of the reference in a scenario, None if its process died or hung, and the verdict on it.

        Raises:
            RequestError: if the reference's factory cannot be used, or the scenario does not fit the world.
        """
        __tracebackhide__ = True
        try:
            with refusals("the reference"):
                trace = runner.run(scenario)
        except ProcessLostError as error:
            return None, Verdict(kind="failed", failure=Failure(kind=PROCESS_CRASH, message=error.end), is_ads=True)
        except RequestError as error:
            text = str(error).removeprefix("ads: ").removeprefix(f"{self.against_name}: ")
            named = f" ({self.against_name})" if self.against_name else ""
            raise AgainstError(f"against{named}: {text}") from None
        run = self.run_of(trace, world)
        return run, self.judge(run)

    @contextmanager
    def recording(self, job: Job) -> Iterator[CrashRecord]:
        """Provide the crash record with the scenario that runs now. It stays on disk only if the process dies."""
        try:
            with job.crash_record() as record:
                yield record
        finally:
            with suppress(OSError):  # It has records of other processes, or was never created.
                self.records.rmdir()

    def left_behind(self, owner: str = "") -> list[Leftover]:
        """Return the crash records of processes that died in runs of this test, or of another ``owner``."""
        return left_by(owner or self.node_id, self.records)


@contextmanager
def refusals(whose: str = "the ADS") -> Iterator[None]:
    """Turn errors that the user can correct into request errors; ``whose`` names the factory that is called."""
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
            f"expected the factory of {whose} to leave the session alone, received pytest.exit({str(error)!r}); raise "
            "another exception"
        ) from None


def checked_factory(given: object, name: str) -> Callable[..., Any]:
    """Return the value of a fixture if it is an ADS factory. ``name`` is the name of the fixture.

    Raises:
        RequestError: if the value is not a factory.
    """
    if not callable(given):
        hint = hint_at_object(given)
        raise RequestError(
            f"expected the fixture {name!r} to return a factory, a function that makes a fresh ADS for each scenario "
            f"such as `return lambda: MyPlanner()`, received {given!r:.100}{f'. {hint}' if hint else ''}"
        )
    return given


def is_same_run(a: Run, b: Run) -> bool:
    """Return whether two runs are identical to the last bit."""
    first, second = a.trace.states, b.trace.states
    return a.outcome == b.outcome and first.shape == second.shape and first.tobytes() == second.tobytes()


def begins_alike(run: Run, longer: Run) -> bool:
    """Return whether a run that may have been driven on is identical to a run until that run's end, to the last bit."""
    first, second = run.trace.states, longer.trace.states
    if len(second) <= len(first) or run.outcome not in (Outcome.SAFE, Outcome.OFF_ROAD):  # nothing to drive on
        return is_same_run(run, longer)
    return first.tobytes() == second[: len(first)].tobytes()
