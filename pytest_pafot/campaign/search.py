"""One search, from the replay of what is saved to its findings, told to whoever listens.

Read :meth:`Search.run` from the top: replays, the loop over generations, simplification, the summary.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from pytest_pafot.attribution.near_misses import near_misses
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.campaign.confirmation import difference
from pytest_pafot.campaign.events import Kept, Listener, SearchStarted
from pytest_pafot.campaign.harness import Harness
from pytest_pafot.campaign.loop import SearchLoop
from pytest_pafot.campaign.options import FULL, LOCAL, PROFILES
from pytest_pafot.campaign.recorder import Recorder
from pytest_pafot.campaign.replays import Replays
from pytest_pafot.campaign.request import Request, RequestError, build_space
from pytest_pafot.campaign.setup_fault import SetupFaultError
from pytest_pafot.campaign.simplification import Simplification
from pytest_pafot.campaign.simulation import Simulation
from pytest_pafot.campaign.summary import Progress, SearchSummary
from pytest_pafot.campaign.time_limit import TimeLimit
from pytest_pafot.campaign.verdict import no_skip, skips
from pytest_pafot.corpus.saved import Saved, saved_in
from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.crash_records import Leftover
from pytest_pafot.execution.job import Job
from pytest_pafot.execution.retrying import Retried, retry
from pytest_pafot.execution.runner import runner_for
from pytest_pafot.scenario import Scenario
from pytest_pafot.searching import Algorithm, run_campaign
from pytest_pafot.searching.fitness import Fitness, FitnessError, resolve
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.world import WorldError, codec, protocol
from pytest_pafot.world.driving.failure import is_interruption

DONE = "all generations done"
AFTER_A_DEATH = "ran as with --pafot-isolate, since a process has died in this search before"


def search_seed(base_seed: int, node_id: str) -> int:
    """The seed of a search: a function of the base seed and its test's node id, the same in every process."""
    digest = hashlib.sha256(f"{base_seed}:{node_id}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchResult:
    """What came of a search.

    Attributes:
        summary: how it went.
        kept: the finds that are new.
        count: of distinct new finds, whether they were kept or only counted.
        first: the exception of the first find; None without one.
        fault: of the set-up, as the exception to show in the place of finds.
        skip: by which the function declined to judge every run.
        is_vacuous: whether nothing was tested.
    """

    summary: SearchSummary
    kept: tuple[Kept, ...]
    count: int
    first: BaseException | None
    fault: BaseException | None
    skip: BaseException | None
    is_vacuous: bool


@dataclass(slots=True, kw_only=True)
class Search:
    """A search of one test.

    Attributes:
        node_id: under which it is told.
        harness: what it runs and judges with.
        listener: is told what happens.
        clock: seconds since any moment.
        limit: when it must end, by that clock.
        replays: how saved scenarios are run.
        stops_at_first: whether it ends at its first new finding.
        progress_seconds: between two tellings of progress.
        notes: to be told once in the summary.
        shrink_runs: taken to simplify finds.
    """

    node_id: str
    harness: Harness
    listener: Listener
    clock: Callable[[], float]
    limit: TimeLimit
    replays: Replays
    stops_at_first: bool = False
    progress_seconds: float = 10.0
    notes: list[str] = field(default_factory=list)
    shrink_runs: int = 0
    started: float = field(init=False)
    told_at: float = field(init=False)

    def __post_init__(self) -> None:
        self.started = self.told_at = self.clock()

    @property
    def seed(self) -> int:
        """Of this search."""
        return search_seed(self.harness.request.settings.seed, self.harness.node_id)

    def run(self) -> SearchResult:
        """Replay what is saved, search, simplify, and tell how it went.

        Raises:
            RequestError: where the search cannot be run as it is asked for.
        """
        __tracebackhide__ = True
        harness, settings = self.harness, self.harness.request.settings
        fitness = checked_fitness(harness.request)
        space = build_space(harness.request, harness.world) if settings.generations else None
        speed_limit = float(harness.world.speed_limit)
        self.listener(SearchStarted(node_id=self.node_id, seed=self.seed, speed_limit=speed_limit))
        job = harness.job()
        with ExitStack() as stack:
            record = stack.enter_context(harness.recording(job))
            runner = runner_for(
                job,
                record,
                workers=settings.workers,
                isolate=settings.isolate,
                can_lock_step=not settings.isolate and harness.can_lock_step,
                can_resume=harness.can_resume,
            )
            simulation = Simulation(harness, runner, record)
            stack.push(runner.__exit__)  # ends the processes of what runs after the search, too
            recorder = Recorder(
                harness=harness,
                seed=self.seed,
                confirm=lambda run: difference(run, simulation),
                listener=self.listener,
            )
            retried = [self._retried(leftover, recorder, simulation) for leftover in harness.left_behind()]
            self.notes += [note for each in retried for note in each.notes]
            saved = saved_in(harness.folder)
            recorder.replayed = frozenset(each.path for each in saved)
            wants_near_misses = harness.request.algorithm.reads_near_misses and harness.request.blame == "ego"
            loop = SearchLoop(
                simulation=simulation,
                recorder=recorder,
                fitness=fitness,
                listener=self.listener,
                near_misses=near_misses if wants_near_misses else None,
                fatal={each.finding.scenario for each in saved if each.finding is not None and each.is_crash},
            )
            reason, fault = "interrupted", None
            try:
                with runner:
                    reason = self._searched(loop, space, recorder, saved, runner.announce)
                recorder.release()
                self._simplify(loop, recorder, simulation)
            except SetupFaultError as error:
                reason, fault = "error", error
                recorder.withdraw()
                loop.known.clear()  # A saved scenario that ends in the same error now was saved for something else.
            except BaseException as error:
                reason = "interrupted" if is_interruption(error) else "error"
                raise
            finally:
                recorder.release()
                for each in retried:
                    if each.pending is not None:
                        each.pending.discard()
                self.notes += runner.notes
                if record.error is not None:
                    self.notes.append(str(record.error))
                summary = self._summary(loop, recorder, reason)
                self.listener(summary)
        return SearchResult(
            summary=summary,
            kept=tuple(recorder.kept.values()),
            count=recorder.count,
            first=recorder.first,
            fault=None if fault is None else fault.shown(harness.world, harness.ads),
            skip=loop.skip if loop.skip is not None and loop.verdicts["skipped"] == loop.runs else None,
            is_vacuous=loop.health.vacuous,
        )

    def _retried(self, leftover: Leftover, recorder: Recorder, simulation: Simulation) -> Retried:
        """What came of the record of a process that died: what it ran runs again, in the world that it ran in."""
        harness, world = self.harness, self.harness.world
        job: Job | None = harness.job()
        if leftover.world is not None and leftover.world != harness.job().world_data:
            try:
                world = None if codec.is_code(leftover.world) else codec.from_dict(leftover.world)
            except (WorldError, TypeError, ValueError):
                world = None
            job = None if world is None else harness.job(world)
        return retry(
            leftover,
            job,
            partial(harness.judge_trace, world),
            isolate=harness.request.settings.isolate,
            keep=recorder.keep_crash,
            run_here=simulation.rerun_one_by_one,
        )

    def _searched(
        self,
        loop: SearchLoop,
        space: SearchSpace | None,
        recorder: Recorder,
        saved: Sequence[Saved],
        announce: Callable[[Sequence[Scenario]], None],
    ) -> str:
        """Run the campaign; returns why it ended."""
        __tracebackhide__ = True
        settings = self.harness.request.settings
        if space is None:
            return "replay only"
        replayed = [self.replays.shown_by(each) for each in saved]
        loop.replayed = [each for each in replayed if each is not None]
        limit = 1 if self.stops_at_first else settings.stop_after
        events = run_campaign(
            checked_algorithm(self.harness, space),
            loop.evaluate,
            generations=settings.generations,
            seed=self.seed,
            max_seconds=max(0.0, self.limit.until - self.clock()),
            clock=self.clock,
            stop=lambda: limit is not None and recorder.count >= limit,
            foresee=lambda scenarios: announce([each for each in scenarios if each not in loop.fatal]),
        )
        try:
            loop.follow(events, lambda: self._tell_progress(loop, recorder))
        except FitnessError as error:
            raise RequestError(str(error)) from None
        except skips() as error:
            raise RequestError(no_skip("the fitness", error)) from None
        reasons = {"generations": DONE, "time": self.limit.flag, "stopped": "enough findings"}
        return "interrupted" if loop.finished is None else reasons[loop.finished.reason]

    def _simplify(self, loop: SearchLoop, recorder: Recorder, simulation: Simulation) -> None:
        """Simplify the finds, try reference drivers in their scenarios, and tell everybody what came of it."""
        __tracebackhide__ = True
        simplification = Simplification(
            simulation=simulation,
            recorder=recorder,
            fatal=loop.fatal,
            lose=loop.lose,
            is_over=lambda: self.clock() > self.limit.until,
            tell=lambda phase: self._tell_progress(loop, recorder, phase),
        )
        simplification.run_all()
        self.shrink_runs = simplification.runs
        if simplification.is_cut:
            self.notes.append(
                f"shrinking was cut by {self.limit.flag}: the same seed may give other scenarios next time"
            )

    def _tell_progress(self, loop: SearchLoop, recorder: Recorder, phase: str = "") -> None:
        now = self.clock()
        if now - self.told_at < self.progress_seconds:
            return
        self.told_at = now
        generations = self.harness.request.settings.generations
        self.listener(
            Progress(
                node_id=self.node_id,
                generation=min(loop.generation + 1, generations),
                generations=generations,
                runs=loop.runs,
                failing=loop.verdicts["failed"],
                finds=recorder.count,
                seconds=now - self.started,
                phase=phase,
            )
        )

    def _summary(self, loop: SearchLoop, recorder: Recorder, reason: str) -> SearchSummary:
        settings, health = self.harness.request.settings, loop.health
        if loop.doubt:
            self.notes.append(loop.doubt)
        if reason == self.limit.flag:
            self.notes.append(f"cut by {reason}: the same seed may find other scenarios next time")
        self.notes += self._left_undone(loop, recorder, reason)
        finds = [kept.find for kept in recorder.kept.values()]
        return SearchSummary(
            node_id=self.node_id,
            algorithm=self.harness.request.algorithm.name,
            profile=settings.profile,
            base_seed=settings.seed,
            seed=self.seed,
            generations=loop.generation if loop.finished is None else loop.finished.generations,
            asked=settings.generations,
            reason=reason,
            seconds=self.clock() - self.started,
            runs=loop.runs,
            known_runs=health.reused,
            invalid=loop.verdicts["invalid"],
            npc=loop.verdicts["npc"],
            rejected=loop.verdicts["rejected"],
            skipped=loop.verdicts["skipped"],
            reached=health.reached_share if health.genes_started else None,
            no_interaction=health.no_interaction,
            failing=loop.verdicts["failed"],
            finds=tuple(replace(find, repeats=loop.repeats[find.id]) for find in finds),
            unsaved={id_: 1 + loop.repeats[id_] for id_ in recorder.unsaved},
            shrink_runs=self.shrink_runs,
            known=dict(loop.known),
            warnings=tuple(_warnings(loop)) if reason in (DONE, self.limit.flag) else (),
            notes=tuple(self.notes),
            coverage=health.coverage.describe(float(self.harness.world.speed_limit)) if loop.runs else "",
        )

    def _left_undone(self, loop: SearchLoop, recorder: Recorder, reason: str) -> Iterator[str]:
        """What a longer search would do besides, and how to have it."""
        settings = self.harness.request.settings
        left = [kept for kept in recorder.kept.values() if kept.is_firm and kept.finding.shrunk is None]
        if left and settings.shrink_rollouts and reason in ("interrupted", "error"):
            what = "1 new finding was" if len(left) == 1 else f"{len(left)} new findings were"
            first = "delete what is saved of it and " if any(kept.file for kept in left) else ""
            yield f"ended before {what} shrunk: {first}search again with --pafot-seed={settings.seed}"
        is_default = settings.profile == LOCAL and settings.generations == PROFILES[LOCAL]["generations"]
        if is_default and reason == DONE and not loop.verdicts["failed"] and not recorder.count:
            yield (
                f"{settings.generations} generations are a short search: "
                f"--pafot-generations={PROFILES[FULL]['generations']} looks further"
            )


def isolated_after_a_death(harness: Harness, replays: Replays) -> Harness:
    """The same with its runs in other processes, where one of its ADSs died in a session before.

    Only where processes are forked: elsewhere not every factory can be handed to another one.
    """
    settings = harness.request.settings
    if scenario_pool.METHOD != "fork" or settings.isolate or not settings.generations:
        return harness
    crashes = [each for each in saved_in(harness.folder) if each.is_crash]
    if not harness.left_behind() and not any(replays.still_fails(each) for each in crashes):
        return harness
    return replace(harness, request=replace(harness.request, settings=replace(settings, isolate=True)))


def checked_algorithm(harness: Harness, space: SearchSpace) -> Algorithm[Any]:
    """The search algorithm.

    Raises:
        RequestError: where it does not take the settings or the road, or its library is not installed.
    """
    request = harness.request
    try:
        algorithm = request.algorithm.make(space, population=request.settings.population)
        request.algorithm.check_road(is_straight=protocol.road_start(harness.world) is None)
    except ValueError as error:
        raise RequestError(str(error)) from None
    return algorithm


def checked_fitness(request: Request) -> Fitness:
    """The fitness of a search; under ``blame="ego"`` it is steered towards what the ego is responsible for.

    Raises:
        RequestError: for a fitness that does not exist.
    """
    try:
        return resolve(request.fitness, responsible=is_ego_responsible if request.blame == "ego" else None)
    except FitnessError as error:
        raise request.error("fitness=...", error) from None


def _warnings(loop: SearchLoop) -> list[str]:
    """The search's health, and whether the test function was asked at all."""
    warnings = loop.health.warnings()
    if loop.verdicts["npc"] and not loop.verdicts["passed"] and not loop.verdicts["failed"]:
        warnings.append(
            "the test function was never called: all runs that it could judge were collisions that an NPC is "
            'responsible for, which blame="ego" leaves out; search longer'
        )
    return warnings
