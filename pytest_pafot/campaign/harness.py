"""Everything that one item runs scenarios with: its world, its ADS, its test function, its place on disk."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.request import Request, RequestError, build_world, hint_at_world
from pytest_pafot.campaign.verdict import Test, Verdict, bound_test, judge, no_skip, skips
from pytest_pafot.corpus import layout
from pytest_pafot.execution.crash_records import InFlight
from pytest_pafot.execution.worker_pool import Errand
from pytest_pafot.files import sweep
from pytest_pafot.plugin import node_ids
from pytest_pafot.plugin.crash_folder import flight_folder, owner_of
from pytest_pafot.plugin.marks import WORLD_FIXTURE
from pytest_pafot.run import Run
from pytest_pafot.versions import installed_versions
from pytest_pafot.world.codec import described

if TYPE_CHECKING:
    from pytest_pafot.scenario import Scenario
    from pytest_pafot.trace import Trace

WORLD_ATTRIBUTES = ("rollout", "to_dict", "speed_limit", "longest_run")
"""What a search needs of any world."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """How an item simulates and judges.

    Attributes:
        item: the test.
        request: what its mark asks for.
        world: of new scenarios.
        ads: the factory.
        test: the user's function with its fixtures.
        folder: of the item's saved scenarios.
        versions: of the packages that a run depends on.
    """

    item: pytest.Function
    request: Request
    world: Any
    ads: Callable[[], Any]
    test: Test
    folder: Path
    versions: dict[str, str]

    @classmethod
    def of(cls, item: pytest.Function, request: Request) -> Bench:
        """From an item whose fixtures are set up.

        Raises:
            RequestError: when a fixture gives something that cannot be used.
        """
        world = build_world(request, item.funcargs[WORLD_FIXTURE])
        _check_world(request, world)
        folder = layout.folder_of_test(
            item.path, node_ids.qualified_name(item), request.settings.corpus, item.config.rootpath
        )
        sweep(folder)
        return cls(
            item=item,
            request=request,
            world=world,
            ads=_factory(item, request),
            test=bound_test(item, request.arg),
            folder=folder,
            versions=installed_versions(),
        )

    def simulate(self, scenario: Scenario, world: Any) -> Run:
        """One run; refuses what no finding can be made of.

        Raises:
            RequestError: for a world, factory or scenario that does not fit.
        """
        __tracebackhide__ = True
        return self.seen(self.rolled_out(scenario, world), world)

    def rolled_out(
        self, scenario: Scenario, world: Any, ads: Callable[..., Any] | None = None, decisions: Sequence[Any] = ()
    ) -> Trace:
        """The same, as its trace alone; the ADS is the item's unless given, and not asked for given decisions.

        Raises:
            RequestError: for a world, factory or scenario that does not fit.
        """
        __tracebackhide__ = True
        with self._refusals():
            given = {"decisions": decisions} if decisions else {}  # a world of the user's own need not know of them
            trace: Trace = world.rollout(scenario, ads or self.ads, **given)
        return trace

    def rolled_out_together(self, scenarios: Sequence[Scenario]) -> list[Trace]:
        """Runs in lock step in the world of new scenarios, as traces.

        Raises:
            RequestError: likewise.
        """
        __tracebackhide__ = True
        with self._refusals():
            traces: list[Trace] = self.world.rollout_batch(scenarios, self.ads)
        return traces

    @property
    def can_lock_step(self) -> bool:
        """Whether an ADS with a method ``batch`` would decide for many runs at once.

        Not in a world that cannot do that, not for an ADS that needs the environment of its run, and not where
        decisions have a limit of time, which decisions for many runs do not tell.
        """
        from pytest_pafot.world.driving.ads import is_vehicle_class, wants_env  # noqa: PLC0415

        is_asked = not is_vehicle_class(self.ads) and not wants_env(self.ads)
        if not is_asked or self.request.decision_limit is not None:
            return False
        with self._refusals():  # whether a pafot.World has it shows when its environment is made
            return hasattr(self.world, "rollout_batch") and getattr(self.world, "has_lock_step", True)

    @property
    def can_resume(self) -> bool:
        """Whether decisions of a pure ADS could be taken from earlier runs.

        Only in a world that takes decisions, and not where decisions have a limit of time: those tell none.
        """
        try:
            parameters = inspect.signature(self.world.rollout).parameters
        except (TypeError, ValueError):  # builtins without a signature
            return False
        return "decisions" in parameters and self.request.decision_limit is None

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        """Errors of the world that are the user's to mend, as errors of the request."""
        __tracebackhide__ = True
        from pytest_pafot.scenario import ScenarioError  # noqa: PLC0415
        from pytest_pafot.world import AdsFactoryError, WorldError  # noqa: PLC0415

        try:
            yield
        except (WorldError, AdsFactoryError, ScenarioError) as error:
            raise RequestError(str(error)) from None
        except skips() as error:  # of the factory: what the ADS raises is in the trace
            raise RequestError(no_skip("the factory of the ADS", error)) from None

    def seen(self, trace: Trace, world: Any) -> Run:
        """The run that a trace from a world is the record of."""
        prevent = getattr(world, "preventable_by", None)  # A world of the user's own need not have it.
        return Run(trace, decision_limit=self.request.decision_limit, prevent=prevent)

    def simulate_in_gym(
        self, scenario: Scenario, replay: Callable[[Any, Scenario, Any], Trace] | None = None
    ) -> Run | None:
        """The same by ``env.step`` of the plain environment; None for a world of the user's own, which has none.

        Args:
            scenario: to run.
            replay: does that with a world and a factory, where it shall not be done in this process.
        """
        __tracebackhide__ = True
        from pytest_pafot.world import Highway, World  # noqa: PLC0415
        from pytest_pafot.world.engines.gym_replay import replay_in_gym  # noqa: PLC0415

        if type(self.world) not in (Highway, World):  # one that derives from these may do anything
            return None
        with self._refusals():
            trace = (replay or replay_in_gym)(self.world, scenario, self.ads)
        return Run(trace, decision_limit=self.request.decision_limit)

    def judge(self, run: Run) -> Verdict:
        """What the user's function, or the failure of the ADS, makes of a run."""
        __tracebackhide__ = True
        return judge(run, self.test, blame=self.request.blame, test_file=_source_file(self.item))

    def tried(self, scenario: Scenario, world: Any, owner: str) -> tuple[Run, Verdict]:
        """One run and its verdict, with the scenario on disk meanwhile."""
        __tracebackhide__ = True
        with self.in_flight(world, owner) as flight:
            flight.record(scenario)
            run = self.simulate(scenario, world)
            return run, self.judge(run)

    @property
    def errand(self) -> Errand:
        """What other processes do for this item."""
        return Errand(
            world=self.world,
            ads=self.ads,
            folder=flight_folder(self.item, self.request),
            owner=owner_of(self.item),
            plain_world=described(self.world),
        )

    @contextmanager
    def in_flight(self, world: Any, owner: str = "") -> Iterator[InFlight]:
        """The record of what runs now; gone at the end, however that comes, unless the process dies."""
        folder = flight_folder(self.item, self.request)
        with self._refusals():  # whether a pafot.World can be used shows when its environment is made
            data = described(world)
        try:
            with InFlight(folder, owner or owner_of(self.item), world=data) as flight:
                yield flight
        finally:
            if folder == layout.corpus_root(self.item.path, self.request.settings.corpus, self.item.config.rootpath):
                with suppress(OSError):  # It holds findings, or was never made.
                    folder.rmdir()

    @property
    def root(self) -> str:
        """The rootdir, which paths in files are relative to."""
        return str(self.item.config.rootpath)

    def relative(self, path: Path) -> str:
        """A path as people read it."""
        return layout.relative(path, self.item.config.rootpath)


def is_same_run(a: Run, b: Run) -> bool:
    """Whether two runs are the same to the last bit."""
    return a.outcome == b.outcome and a.trace.states.shape == b.trace.states.shape and _equal(a, b)


def _check_world(request: Request, world: Any) -> None:
    from pytest_pafot.world import Highway, World  # noqa: PLC0415

    if isinstance(world, (Highway, World)):  # whose attributes show when an environment is made
        return
    missing = [name for name in WORLD_ATTRIBUTES if not hasattr(world, name)]
    if missing:
        origin = f"the fixture {WORLD_FIXTURE} to give" if request.world is None else "world= to be"
        raise RequestError(
            f"expected {origin} pafot.Highway(...) or pafot.World(...), or a world of your own with "
            f"{', '.join(WORLD_ATTRIBUTES)}, received {world!r:.100}, which has no {', '.join(missing)}"
            f"{hint_at_world(world)}"
        )


def _source_file(item: pytest.Function) -> str:
    """As in the code of the test function, whatever wraps it."""
    code = getattr(inspect.unwrap(item.obj), "__code__", None)
    return str(item.path) if code is None else str(code.co_filename)


def _equal(a: Run, b: Run) -> bool:
    return a.trace.states.tobytes() == b.trace.states.tobytes()


def _factory(item: pytest.Function, request: Request) -> Callable[[], Any]:
    if not isinstance(request.ads, str):
        return request.ads
    factory = item.funcargs[request.ads]
    if not callable(factory):
        from pytest_pafot.world.driving.ads import hint_at_object  # noqa: PLC0415

        hint = hint_at_object(factory)
        received = f"{factory!r:.100}{f'. {hint}' if hint else ''}"
        raise RequestError(
            f"expected the fixture {request.ads!r} to give a factory, a function that makes a fresh ADS for each "
            f"scenario such as `return lambda: MyPlanner()`, received {received}"
        )
    made: Callable[[], Any] = factory
    return made
