"""One search from its first replay to its verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.attribution.near_misses import NearMiss, near_misses
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.campaign.confirmation import difference
from pytest_pafot.campaign.harness import Bench
from pytest_pafot.campaign.options import FULL, LOCAL, PROFILES
from pytest_pafot.campaign.recorder import Keeper
from pytest_pafot.campaign.replays import replay_for_search
from pytest_pafot.campaign.request import RequestError, build_space
from pytest_pafot.campaign.search import Hunt, Stage
from pytest_pafot.campaign.setup_fault import SetupFaultError
from pytest_pafot.campaign.simplification import Shrinking
from pytest_pafot.campaign.summary import Progress, SearchSummary
from pytest_pafot.campaign.verdict import Verdict, no_skip, skips
from pytest_pafot.corpus.saved import Saved, saved_in
from pytest_pafot.execution.crash_records import InFlight, Leftover
from pytest_pafot.execution.known_decisions import Resuming
from pytest_pafot.execution.prefetch import METHOD, Isolated, ahead_of, isolated_of
from pytest_pafot.execution.recovery import settle
from pytest_pafot.execution.separate_process import replay_in_gym_apart
from pytest_pafot.execution.together import LockStep, noted
from pytest_pafot.plugin import messages, node_ids
from pytest_pafot.plugin.crash_folder import left_behind
from pytest_pafot.plugin.failure_reports import SUMMARY
from pytest_pafot.plugin.report_pages import showing_of
from pytest_pafot.plugin.session import SHARED
from pytest_pafot.plugin.time_limits import TimeLimit, searches_left, time_limit
from pytest_pafot.report import terminal
from pytest_pafot.run import Run
from pytest_pafot.scenario import Scenario
from pytest_pafot.searching import Algorithm, run_campaign, sample
from pytest_pafot.searching.fitness import Fitness, FitnessError, resolve
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.world.driving.failure import is_interruption
from pytest_pafot.world.protocol import road_start

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request
    from pytest_pafot.plugin.page_messages import Showing
    from pytest_pafot.trace import Trace

DONE = "all generations done"
AFTER_A_DEATH = "ran as with --pafot-isolate, since a process has died in this search before"


@dataclass(frozen=True, slots=True)
class Watched:
    """Runs of a search, with the scenario on disk until its verdict is known."""

    bench: Bench
    flight: InFlight
    ahead: LockStep | Isolated
    resuming: Resuming

    @classmethod
    def of(cls, bench: Bench, flight: InFlight) -> Watched:
        """Runs in the way that the ADS and the settings ask for."""

        def together(scenarios: Sequence[Scenario]) -> list[Trace]:
            __tracebackhide__ = True
            flight.record(*scenarios)
            return bench.rolled_out_together(scenarios)

        if bench.request.settings.isolate:
            return cls(bench, flight, isolated_of(bench), Resuming(is_wanted=False))
        is_wanted = None if bench.can_lock_step else False
        ahead = LockStep(apart=ahead_of(bench), together=together, is_wanted=is_wanted)
        return cls(bench, flight, ahead, Resuming(is_wanted=None if bench.can_resume else False))

    def __enter__(self) -> Watched:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if isinstance(self.ahead, Isolated):  # others have ended by then
            self.ahead.__exit__(kind, value, traceback)

    def run(self, scenario: Scenario) -> Run:
        """One run, whose verdict follows; what a pure ADS decides may be known from earlier ones.

        Raises:
            ProcessLostError: where another process made it, and did not come back.
        """
        __tracebackhide__ = True
        return self._made(scenario, lambda each: self._run_here(each, self.resuming.decisions(each)))

    def afresh(self, scenario: Scenario) -> Run:
        """The same, with the ADS asked for every decision."""
        __tracebackhide__ = True
        return self._made(scenario, self._run_here)

    def _made(self, scenario: Scenario, here: Callable[[Scenario], Trace]) -> Run:
        __tracebackhide__ = True
        trace = self.ahead.run(scenario, here)
        self.flight.record(scenario)
        if not self.ahead.was_together(trace):  # what is decided for many at once is not relied on
            self.resuming.remember(trace)
        return self.bench.seen(trace, self.bench.world)

    def _run_here(self, scenario: Scenario, decisions: Sequence[Any] = ()) -> Trace:
        __tracebackhide__ = True
        self.flight.record(scenario)
        is_known = None not in (self.ahead.is_wanted, self.resuming.is_wanted)
        ads = None if is_known else noted(self.bench.ads, self._saw)
        return self.bench.rolled_out(scenario, self.bench.world, ads, decisions)

    def _saw(self, ads: Any) -> None:
        self.ahead.saw(ads)
        self.resuming.saw(ads)

    def judge(self, run: Run) -> Verdict:
        """The verdict on the last run."""
        __tracebackhide__ = True
        verdict = self.bench.judge(run)
        self.flight.clear()
        return verdict

    def alone(self, run: Run) -> Run | None:
        """The last run again by itself, where it took place together with others."""
        __tracebackhide__ = True
        return self.run(run.trace.scenario) if self.ahead.was_together(run.trace) else None

    def retry(self, leftover: Leftover) -> None:
        """Run by itself what was in lock step when a process died, so that a second death has one name."""
        __tracebackhide__ = True
        leftover.discard()  # before another death, of which it would otherwise be the cause for ever
        for scenario in leftover.together:
            self.rerun(scenario)

    def rerun(self, scenario: Scenario) -> Run:
        """One run without a verdict, with the ADS asked for every decision."""
        __tracebackhide__ = True
        run = self.afresh(scenario)
        self.flight.clear()
        return run

    def elsewhere(self, scenario: Scenario) -> Run | None:
        """One run in highway-env's own environment, where the world has one."""
        __tracebackhide__ = True
        self.flight.record(scenario)
        replay = partial(replay_in_gym_apart, self.bench) if isinstance(self.ahead, Isolated) else None
        run = self.bench.simulate_in_gym(scenario, replay)
        self.flight.clear()
        return run


@dataclass(slots=True)
class Searching:
    """A search of one item.

    Attributes:
        bench: that it runs on.
        seed: of the search.
        clock: seconds since any moment.
        started: when the search began.
        limit: when it must end.
        told_at: when progress was told last.
        notes: to be told once in the summary.
        shrink_runs: taken to simplify finds.
        showing: how it shows what happens, where a page is asked for.
    """

    bench: Bench
    seed: int
    clock: Callable[[], float]
    started: float = field(init=False)
    limit: TimeLimit = field(init=False)
    told_at: float = field(init=False)
    notes: list[str] = field(default_factory=list)
    shrink_runs: int = 0
    showing: Showing | None = field(init=False)

    def __post_init__(self) -> None:
        self.showing = showing_of(self.bench.item, self.bench.request.settings)
        self.started = self.told_at = self.clock()
        item = self.bench.item
        self.limit = time_limit(
            self.bench.request.settings,
            now=self.started,
            began=item.config.stash[SHARED].began,
            left=searches_left(item),
        )

    def run(self) -> None:
        """Replay, search, report; fails the item when there is something new, or nothing was tested."""
        __tracebackhide__ = True
        fitness = checked_fitness(self.bench)
        space = checked_space(self.bench) if self.bench.request.settings.generations else None
        messages.send(self.bench.item, "start", {})
        with self.bench.in_flight(self.bench.world) as flight, Watched.of(self.bench, flight) as watched:
            keeper = Keeper(
                bench=self.bench,
                seed=self.seed,
                confirm=lambda run: difference(run, watched.rerun, watched.elsewhere),
                showing=self.showing,
            )
            settled = [
                settle(self.bench, leftover, keeper.keep_crash, watched.retry)
                for leftover in left_behind(self.bench.item, self.bench.request)
            ]
            self.notes += [note for each in settled for note in each.notes]
            saved = saved_in(self.bench.folder)
            keeper.replayed = frozenset(each.path for each in saved)
            hunt = Hunt(
                stage=Stage(
                    run=watched.run,
                    judge=watched.judge if self.showing is None else self.showing.judging(watched.judge),
                    fitness=fitness,
                    keep=keeper.keep,
                    keep_lost=keeper.keep_lost,
                    lethal=_lethal(saved),
                    alone=watched.alone,
                    release=keeper.release,
                    near_misses=near_misses if _asks_for_near_misses(self.bench.request) else _nobody_asks,
                )
            )
            reason, fault = "interrupted", None
            try:
                with watched.ahead as ahead:
                    reason = self._hunted(hunt, space, keeper, saved, ahead)
                keeper.release()
                self._shrunk(hunt, keeper, watched)
            except SetupFaultError as error:
                reason, fault = "error", error
                keeper.withdraw()
                hunt.known.clear()  # A saved scenario that ends in the same error now was saved for something else.
            except BaseException as error:
                reason = "interrupted" if is_interruption(error) else "error"
                raise
            finally:
                keeper.release()
                for each in settled:
                    if each.pending is not None:
                        each.pending.discard()
                self.notes += watched.ahead.notes
                if flight.error is not None:
                    self.notes.append(str(flight.error))
                search = self._summary(hunt, keeper, reason)
                messages.send(self.bench.item, "search", search.to_plain())
                self._show(hunt, search)
        if fault is not None:  # Outside of the handler, so that the same is not shown twice.
            raise fault.shown(self.bench)
        self._conclude(hunt, keeper, search)

    def _hunted(
        self,
        hunt: Hunt,
        space: SearchSpace | None,
        keeper: Keeper,
        saved: list[Saved],
        ahead: LockStep | Isolated,
    ) -> str:
        """Run the campaign; returns why it ended."""
        __tracebackhide__ = True
        settings = self.bench.request.settings
        if space is None:
            return "replay only"
        replayed = [replay_for_search(self.bench, each) for each in saved]
        hunt.replayed = [each for each in replayed if each is not None]
        limit = 1 if _stops_at_first(self.bench.item.config) else settings.stop_after
        events = run_campaign(
            checked_algorithm(self.bench, space),
            hunt.evaluate,
            generations=settings.generations,
            seed=self.seed,
            max_seconds=max(0.0, self.limit.until - self.clock()),
            clock=self.clock,
            stop=lambda: limit is not None and keeper.count >= limit,
            foresee=lambda scenarios: ahead.foresee([each for each in scenarios if each not in hunt.lethal]),
        )
        try:
            followed = events if self.showing is None else self.showing.noted(events)
            hunt.follow(followed, lambda: self._tick(hunt, keeper))
        except FitnessError as error:
            raise RequestError(str(error)) from None
        except skips() as error:
            raise RequestError(no_skip("the fitness", error)) from None
        reasons = {"generations": DONE, "time": self.limit.flag, "stopped": "enough findings"}
        return "interrupted" if hunt.finished is None else reasons[hunt.finished.reason]

    def _shrunk(self, hunt: Hunt, keeper: Keeper, watched: Watched) -> None:
        """Simplify the finds, try reference drivers in their scenarios, and tell everybody what came of it."""
        __tracebackhide__ = True
        shrinking = Shrinking(
            bench=self.bench,
            keeper=keeper,
            run=watched.run,
            afresh=watched.afresh,
            judge=watched.judge,
            lethal=hunt.lethal,
            lose=hunt.lose,
            rollouts=self.bench.request.settings.shrink_rollouts,
            is_over=lambda: self.clock() > self.limit.until,
            tell=lambda phase: self._tick(hunt, keeper, phase),
        )
        shrinking.run_all()
        self.shrink_runs = shrinking.runs
        if shrinking.is_cut:
            self.notes.append(
                f"shrinking was cut by {self.limit.flag}: the same seed may give other scenarios next time"
            )

    def _tick(self, hunt: Hunt, keeper: Keeper, phase: str = "") -> None:
        now = self.clock()
        if now - self.told_at < self.bench.item.config.stash[SHARED].progress_seconds:
            return
        self.told_at = now
        generations = self.bench.request.settings.generations
        progress = Progress(
            node_id=self.bench.item.nodeid,
            generation=min(hunt.generation + 1, generations),
            generations=generations,
            runs=hunt.runs,
            failing=hunt.verdicts["failed"],
            finds=keeper.count,
            seconds=now - self.started,
            phase=phase,
        )
        messages.send(self.bench.item, "progress", asdict(progress))

    def _summary(self, hunt: Hunt, keeper: Keeper, reason: str) -> SearchSummary:
        settings, health = self.bench.request.settings, hunt.health
        if hunt.doubt:
            self.notes.append(hunt.doubt)
        finds = tuple(replace(find, repeats=hunt.repeats[find.id]) for find in keeper.finds)
        if reason == self.limit.flag:
            self.notes.append(f"cut by {reason}: the same seed may find other scenarios next time")
        self.notes += self._left_undone(hunt, keeper, reason)
        return SearchSummary(
            node_id=self.bench.item.nodeid,
            algorithm=self.bench.request.algorithm.name,
            profile=settings.profile,
            base_seed=settings.seed,
            seed=self.seed,
            generations=hunt.generation if hunt.finished is None else hunt.finished.generations,
            asked=settings.generations,
            reason=reason,
            seconds=self.clock() - self.started,
            runs=hunt.runs,
            known_runs=health.reused,
            invalid=hunt.verdicts["invalid"],
            npc=hunt.verdicts["npc"],
            rejected=hunt.verdicts["rejected"],
            skipped=hunt.verdicts["skipped"],
            reached=health.reached_share if health.genes_started else None,
            no_interaction=health.no_interaction,
            failing=hunt.verdicts["failed"],
            finds=finds,
            unsaved={id_: 1 + hunt.repeats[id_] for id_ in keeper.unsaved},
            shrink_runs=self.shrink_runs,
            known=dict(hunt.known),
            warnings=tuple(_warnings(hunt)) if reason in (DONE, self.limit.flag) else (),
            notes=tuple(self.notes),
            coverage=health.coverage.describe(float(self.bench.world.speed_limit)) if hunt.runs else "",
        )

    def _left_undone(self, hunt: Hunt, keeper: Keeper, reason: str) -> Iterator[str]:
        """What a longer search would do besides, and how to have it."""
        settings = self.bench.request.settings
        left = [kept for kept in keeper.kept.values() if kept.is_firm and kept.finding.shrunk is None]
        if left and settings.shrink_rollouts and reason in ("interrupted", "error"):
            what = "1 new finding was" if len(left) == 1 else f"{len(left)} new findings were"
            first = "delete what is saved of it and " if any(kept.file for kept in left) else ""
            yield f"ended before {what} shrunk: {first}search again with --pafot-seed={settings.seed}"
        is_default = settings.profile == LOCAL and settings.generations == PROFILES[LOCAL]["generations"]
        if is_default and reason == DONE and not hunt.verdicts["failed"] and not keeper.count:
            yield (
                f"{settings.generations} generations are a short search: "
                f"--pafot-generations={PROFILES[FULL]['generations']} looks further"
            )

    def _show(self, hunt: Hunt, search: SearchSummary) -> None:
        """Show the search on the page, unless it only replayed."""
        if self.showing is None or not self.showing.events:
            return
        known = {node_ids.saved_node_id(self.bench.item, id_): count for id_, count in hunt.known.items()}
        cut_by = search.reason if search.reason in ("error", "interrupted") else ""
        self.showing.searched(search.finds, known, float(self.bench.world.speed_limit), cut_by)

    def _conclude(self, hunt: Hunt, keeper: Keeper, search: SearchSummary) -> None:
        __tracebackhide__ = True
        if keeper.count:
            self.bench.item.stash[SUMMARY] = terminal.failure_line(search)
            if self.bench.item.config.getoption("usepdb", False) and keeper.first is not None:
                keeper.first.add_note(terminal.failure_message(search))
                raise keeper.first  # The debugger then stands where the test function failed.
            pytest.fail(terminal.failure_message(search), pytrace=False)
        if search.reason == "replay only":
            return
        if hunt.skip is not None and hunt.verdicts["skipped"] == hunt.runs:
            raise hunt.skip
        if hunt.health.vacuous:
            self._fail("the search tested nothing", search.warnings)
        if search.warnings and self.bench.request.settings.strict_health:
            self._fail("health warnings (--pafot-strict-health)", search.warnings)

    def _fail(self, what: str, why: Sequence[str]) -> None:
        __tracebackhide__ = True
        self.bench.item.stash[SUMMARY] = f"{what}: {'; '.join(why)}"
        pytest.fail("\n".join([f"{what}:", *why]), pytrace=False)


def isolated_after_a_death(bench: Bench) -> Bench:
    """The same with its runs in other processes, where one of its ADS's died in a session before.

    Only where processes are forked: elsewhere not every factory can be handed to another one.
    """
    settings = bench.request.settings
    if METHOD != "fork" or settings.isolate or not settings.generations or not _is_deadly(bench):
        return bench
    return replace(bench, request=replace(bench.request, settings=replace(settings, isolate=True)))


def _is_deadly(bench: Bench) -> bool:
    """Whether a session died in this search, and left a record of it or a file whose scenario still kills."""
    if left_behind(bench.item, bench.request):
        return True
    crashes = [each for each in saved_in(bench.folder) if each.is_crash]
    replayed = [replay_for_search(bench, each) for each in crashes]
    return any(each is not None and each.observed == each.signature for each in replayed)


def checked_space(bench: Bench) -> SearchSpace:
    """The space of scenarios, tried once so that a wrong argument is one clear error.

    Raises:
        RequestError: when no scenario can be made of it.
    """
    import numpy as np  # noqa: PLC0415

    space = build_space(bench.request, bench.world)
    try:
        sample(space, np.random.default_rng(0))
    except (TypeError, ValueError) as error:
        given = ", ".join(f"{name}={value!r}" for name, value in bench.request.space.items())
        raise RequestError(f"@pafot.search({given}): {error}") from None
    return space


def checked_algorithm(bench: Bench, space: SearchSpace) -> Algorithm[Any]:
    """The search algorithm.

    Raises:
        RequestError: where it does not take the settings or the road, or its library is not installed.
    """
    settings, chosen = bench.request.settings, bench.request.algorithm
    try:
        algorithm = chosen.make(space, population=settings.population)
        chosen.check_road(is_straight=road_start(bench.world) is None)
    except ValueError as error:
        raise RequestError(str(error)) from None
    return algorithm


def _asks_for_near_misses(request: Request) -> bool:
    """Whether it matters whose a collision is, to a search that makes use of it."""
    return request.blame == "ego" and request.algorithm.reads_near_misses


def _nobody_asks(trace: Trace) -> tuple[NearMiss, ...]:
    """No near-misses, where nobody reads them."""
    return ()


def checked_fitness(bench: Bench) -> Fitness:
    """The fitness of the search; under ``blame="ego"`` it is steered towards what the ego is responsible for.

    Raises:
        RequestError: for a fitness that does not exist.
    """
    responsible = is_ego_responsible if bench.request.blame == "ego" else None
    try:
        return resolve(bench.request.fitness, responsible=responsible)
    except FitnessError as error:
        raise RequestError(f"@pafot.search(fitness=...): {error}") from None


def _warnings(hunt: Hunt) -> list[str]:
    """The search's health, and whether the test function was asked at all."""
    warnings = hunt.health.warnings()
    if hunt.verdicts["npc"] and not hunt.verdicts["passed"] and not hunt.verdicts["failed"]:
        warnings.append(
            "the test function was never called: all runs that it could judge were collisions that an NPC is "
            'responsible for, which blame="ego" leaves out; search longer'
        )
    return warnings


def _lethal(saved: list[Saved]) -> frozenset[Scenario]:
    return frozenset(each.finding.scenario for each in saved if each.finding is not None and each.is_crash)


def _stops_at_first(config: pytest.Config) -> bool:
    """Whether the session ends at the first failure, which a loop inside of an item must do by itself."""
    return bool(config.getoption("usepdb", False)) or config.getoption("maxfail", 0) == 1
