"""One search, from the replays of saved scenarios to new findings, reported to a listener.

Read :meth:`Search.run` from the top: replays, the loop over generations, simplification, the summary.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.campaign.beginnings import begun_with
from pytest_pafot.campaign.events import (
    ALL_RUN,
    DONE,
    FindTold,
    Listener,
    Progress,
    SearchStarted,
    SearchSummary,
)
from pytest_pafot.campaign.harness import Harness, Simulation, refusals
from pytest_pafot.campaign.made_worse import MadeWorse
from pytest_pafot.campaign.options import FULL, LOCAL, PROFILES, Settings
from pytest_pafot.campaign.replays import Replays
from pytest_pafot.campaign.request import build_space
from pytest_pafot.campaign.resuming import RandomBeginning, Sessions
from pytest_pafot.campaign.search_loop import Counting, Reader, Recorder, SearchLoop, difference, left_out_text
from pytest_pafot.campaign.setup_fault import SetupFaultError
from pytest_pafot.campaign.simplification import Simplification, rollouts_for
from pytest_pafot.campaign.verdict import no_skip, skips
from pytest_pafot.corpus.saved import Saved, saved_in
from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.crash_records import Leftover
from pytest_pafot.execution.runner import Retried, must_stay_here, retry, runner_for
from pytest_pafot.findings.finding import Manner
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.searching import run_campaign
from pytest_pafot.searching.ask_tell import Algorithm, draws_ahead
from pytest_pafot.searching.ask_tell_loop import CheckpointError
from pytest_pafot.searching.fitness import FitnessError, is_built_in, resolve
from pytest_pafot.searching.space import SearchSpace, sample
from pytest_pafot.support.errors import OutOfTime, RequestError, command, flag
from pytest_pafot.support.interrupts import postponed
from pytest_pafot.support.text import plural
from pytest_pafot.world import WorldError, codec, protocol
from pytest_pafot.world.driving.ads import is_vehicle_class, loading_hint, wants_env
from pytest_pafot.world.driving.perception import sight_of
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.failure import is_interruption
from pytest_pafot.world.guard.hang_guard import runs_end_in

FOR_SIMPLIFYING = 1 / 3
"""The largest share of a search's time limit that is reserved to shrink findings and to look at their neighbours."""
RUNS_A_NEIGHBOUR = 4
"""The time for one of a finding's neighbours, as a number of runs: as many are run with smaller steps, up to three
times."""

RUNS_TO_CONFIRM = 4
"""The time to find and confirm a failure, as a number of runs.

The scenario is run, run again, and run in highway-env's own environment, which takes about as long as two runs.
"""

LEAST = 2.0
"""The time that a search has for its replays, its first run and the confirmation of a finding in it, even if its limit
is over by then [s]. So a search of a fast policy tests something although others have used up the session's time."""

MAX_UNLIKE = 3
"""The largest number of scenarios that are named because they fail like a saved scenario in another manner."""

COUNTED_AT_ONCE = 16
"""The number of evaluations after which a search that draws ahead counts them."""

SLOWER = 0.5
"""The difference by which an ego must brake below the environment's least speed to show that it can [m/s]."""

AFTER_A_DEATH = f"ran as with {flag('isolate')}, since a process died in this search before"


def search_seed(base_seed: int, node_id: str) -> int:
    """Return the seed of a search, which depends only on the base seed and on the node id of the test."""
    return int.from_bytes(hashlib.sha256(f"{base_seed}:{node_id}".encode()).digest()[:4], "big")


class TimeLimit(NamedTuple):
    """The time limit of a search, including shrinking: the option's flag, and the time of the end [s] or infinity."""

    flag: str
    until: float


LOST = 10
"""How many times longer than a run before it a run has to be, when the time of the search cuts it, to be told."""


def time_limit(settings: Settings, *, now: float, began: float, left: int) -> TimeLimit:
    """Return the time limit of a search: its own limit or its share of the session's limit, whichever ends first.

    Args:
        settings: the options of the search.
        now: the time at which the search begins [s].
        began: the time at which the session began [s].
        left: the number of searches, including this search, that share the remaining time of the session equally.
    """
    own = TimeLimit(flag("max_time"), now + (math.inf if settings.max_time is None else settings.max_time))
    if settings.total_time is None:
        return own
    share = max(0.0, began + settings.total_time - now) / left
    return min(own, TimeLimit(flag("total_time"), now + share), key=lambda limit: limit.until)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchResult:
    """The result of a search."""

    summary: SearchSummary
    kept: tuple[FindTold, ...]
    count: int  # number of distinct new findings, saved or only counted
    first: BaseException | None  # the exception of the first finding; None without one
    fault: BaseException | None  # a fault of the set-up, as the exception to raise instead of findings
    skip: BaseException | None  # the last skip, if the function skipped every run
    is_vacuous: bool  # True if nothing was tested, or if a broken reference prevented every failure from counting


@contextmanager
def prepared(
    harness: Harness,
    listener: Listener,
    *,
    space: SearchSpace | None = None,
    is_steered: bool = True,
    has_table: bool = False,
    wants_each: bool = True,
) -> Iterator[Sessions]:
    """Build the parts of a search that run scenarios, record findings and count. Stop their processes at the end.

    The search has the space that its request describes, unless one is given. It is steered towards collisions for which
    the ego is responsible, unless ``blame="any"`` or ``is_steered`` is False. With ``has_table``, the listener is
    told all that a table of runs needs, also of runs that another process judges. Without ``wants_each``, the listener
    receives one event for several runs that another process has counted.

    Raises:
        RequestError: for a fitness that does not exist, or a world that cannot be used.
    """
    begun, request, seed = "", harness.request, search_seed(harness.request.settings.seed, harness.node_id)
    if space is None and request.settings.is_search:
        space = build_space(request, harness.world)
        if request.settings.begin_with is not None:
            space, begun = begun_with(request.settings.begin_with, space, harness.world, request, harness.folder)
    is_for_ego = is_steered and request.blame != "any"
    try:
        fitness = resolve(request.fitness, responsible=is_ego_responsible if is_for_ego else None)
    except FitnessError as error:
        raise request.error("fitness=...", error) from None
    job, settings = harness.job(), request.settings
    # The user's own fitness runs only in this process, where its errors are reported.
    is_steered_by_checks = request.fitness == "default"
    why_here = _why_judged_here(harness)
    reader = Reader(
        harness=None if why_here else harness,
        fitness=fitness if is_built_in(request.fitness) else None,
        is_steered_by_checks=is_steered_by_checks,
        has_table=has_table,
    )
    counting = None if why_here else Counting(read=reader, wants_each=wants_each)
    if settings.isolate:  # Isolated processes also make the runs that confirm findings, which the session judges.
        reader = replace(reader, harness=None)
    remark = f"; this process judges all runs, since {why_here}" if why_here else ", which also judge their runs"
    job = replace(job, read=reader, groups=counting, remark=remark)
    with ExitStack() as stack:
        record = stack.enter_context(harness.recording(job))
        with refusals():
            runner = runner_for(
                job,
                record,
                workers=settings.workers,
                isolate=settings.isolate,
                executor=harness.executor,
                times_decisions=request.decision_limit is not None,
            )
        stack.push(runner.__exit__)  # Runs after the search start new processes, which must be stopped as well.
        reference = harness.reference_runner(harness.job(), record, isolate=settings.isolate)
        if reference is not None:
            stack.push(reference.__exit__)
        simulation = Simulation(harness, runner, record, reference)
        confirm = partial(difference, simulation=simulation)
        beginning = RandomBeginning(listener=listener)
        loop = SearchLoop(
            simulation=simulation,
            recorder=Recorder(
                harness=harness,
                seed=seed,
                confirm=confirm,
                listener=listener,
                clock=time.monotonic,
                asked=lambda: runner.asked,
            ),
            space=space,
            fitness=fitness,
            listener=beginning,
            is_steered_by_checks=is_steered_by_checks,
            counting=counting,
        )
        sessions = Sessions(
            harness=harness, seed=seed, loop=loop, beginning=beginning, clock=time.monotonic, begun=begun
        )
        stack.callback(sessions.close)
        yield sessions


def _why_judged_here(harness: Harness) -> str:
    """Return why the processes that make runs do not judge them, too; empty if they do."""
    if not is_built_in(harness.request.fitness):
        return "the fitness is your own"
    if not harness.needs_only_run:
        return "the test function needs more than the run"
    is_apart = harness.executor is not None  # its workers may be on other machines
    return "they were not forked from it" if is_apart or scenario_pool.METHOD != "fork" else ""


@dataclass(slots=True, kw_only=True)
class Search:
    """The search of one test, from the replays of saved scenarios to the summary."""

    node_id: str  # the node id in reports
    sessions: Sessions  # made by :func:`prepared`
    replays: Replays
    limit: TimeLimit
    stops_at_first: bool = False  # True if it ends at its first new finding
    shrinks_later: bool = False  # True if the command ``corpus shrink`` can shrink its findings, which needs the test
    progress_seconds: float = 10.0  # interval between reports of progress [s]
    driver_notes: list[str] = field(default_factory=list)  # notes on drivers of the world that failed
    process_notes: list[str] = field(default_factory=list)  # notes on processes for the summary
    _shrink_runs: int = field(init=False, default=0)
    _neighbour_runs: int = field(init=False, default=0)
    _shrink_decisions: int = field(init=False, default=0)
    _neighbour_decisions: int = field(init=False, default=0)
    _worse: MadeWorse | None = field(init=False, default=None)  # of a search with findings and a reference
    _manners: dict[str, Manner] = field(init=False, default_factory=dict)  # of the saved scenarios, by id
    _told_at: float = field(init=False)
    # the time [s], without what confirmed findings, and the number of runs after the first one, which loads libraries
    _since: tuple[float, int] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._told_at = self.sessions.clock()

    @property
    def harness(self) -> Harness:
        """The harness of the search."""
        return self.sessions.harness

    @property
    def loop(self) -> SearchLoop:
        """The loop over scenarios, with everything that the search has seen so far."""
        return self.sessions.loop

    @property
    def _told_with_warnings(self) -> tuple[str, ...]:
        """The reasons for an end that leave enough runs to warn of their health."""
        return DONE, ALL_RUN, self.limit.flag

    def run(self) -> SearchResult:
        """Replay saved scenarios, search, simplify the findings, and report a summary.

        Findings are reported even after an error.

        Raises:
            RequestError: if the search cannot be run as requested.
        """
        __tracebackhide__ = True
        harness, loop, recorder, simulation = self.harness, self.loop, self.loop.recorder, self.loop.simulation
        recorder.listener(
            SearchStarted(
                node_id=self.node_id,
                seed=self.sessions.seed,
                speed_limit=float(harness.world.speed_limit),
                acts_in_si=protocol.acts_in_si(harness.world, harness.ads),
            )
        )
        began = self.sessions.clock()
        recorder.until = max(self.limit.until, began + LEAST)
        recorder.begins = lambda find_id: self._tell_progress(f"found {find_id}, running it again")
        # A process of an earlier session may have died: its scenarios are tried again before anything else.
        left = harness.left_behind()
        retried = [self._retried(leftover, left) for leftover in left]
        self.process_notes += [note for each in retried for note in each.notes]
        reason, fault = "interrupted", None
        try:
            with simulation.runner:
                reason = self._searched(saved_in(harness.folder), began)
            # All findings are reported and the state is stored before shrinking, which takes long and may be cut.
            recorder.release()
            self.sessions.store()
            # With a reference, the findings that do not show that the policy became worse are not even shrunk.
            if harness.against is not None and loop.space is not None and recorder.count:
                now = self.sessions.clock()
                self._worse = MadeWorse(
                    loop=loop,
                    seed=self.sessions.seed,
                    most=harness.request.settings.pairs,
                    clock=self.sessions.clock,
                    until=now + (self.limit.until - now) / 2,
                    tell=lambda phase: self._tell_progress(phase, "comparison"),
                )
                self._worse.compare(loop.space)
            plain = None if loop.space is None else (loop.space.ego_lane, loop.space.ego_speed)
            work = Simplification(
                loop=loop,
                tell=lambda phase: self._tell_progress(phase, work.current),
                plain=plain,
                plain_seconds=None if loop.space is None else loop.space.gene_seconds,
                neighbours=harness.request.settings.neighbours,
                answers=self.sessions.answers,
                clock=self.sessions.clock,
                until=self.limit.until,
                after_attempt=lambda: self.sessions.after_attempt(work.done),
            )
            try:
                with GENERATORS.held():
                    work.run_all(f"; {flag('resume')} goes on" if self.sessions.go_on else "")
                    if self._worse is not None:
                        self._worse.conclude()
                    if reason in self._told_with_warnings:
                        with suppress(OutOfTime), runs_end_in(self.limit.until - self.sessions.clock()):
                            loop.check_pure()
            finally:  # Even after Ctrl-C, findings that were simplified must not be simplified again.
                self._shrink_runs, self._neighbour_runs = work.runs, work.neighbour_runs
                self._shrink_decisions, self._neighbour_decisions = work.shrink_decisions, work.neighbour_decisions
                self.driver_notes += work.notes
                self.sessions.store(simplified=work.done)
        except SetupFaultError as error:
            reason, fault = "error", error
            recorder.withdraw()
            loop.known.clear()  # The same error ends the saved scenarios now, but was not what they were saved for.
            loop.failures.clear()
            loop.finds.clear()  # They are withdrawn, and must not count as findings of earlier sessions.
        except BaseException as error:
            reason = "interrupted" if is_interruption(error) else "error"
            raise
        finally:
            with postponed():
                recorder.release()
                for each in retried:
                    if each.pending is not None:
                        each.pending.discard()
                self.process_notes += simulation.runner.notes
                if simulation.record.error:
                    self.process_notes += [str(simulation.record.error)]
                summary = self._summary(reason)
                recorder.listener(summary)
        return SearchResult(
            summary=summary,
            kept=tuple(recorder.kept.values()),
            count=recorder.count,
            first=recorder.first,
            fault=None if fault is None else fault.shown(harness.world, harness.ads),
            skip=loop.skip if loop.skip is not None and loop.verdicts["skipped"] == loop.runs else None,
            is_vacuous=loop.health.vacuous or bool(loop.broken),
        )

    def _retried(self, leftover: Leftover, left: Sequence[Leftover]) -> Retried:
        """Run the scenarios again in which a process of an earlier session died; return the result.

        They are run in the world of the dead process. If that world cannot be made, this is only reported. ``left`` are
        the records of all dead processes. If another one died in the same scenario, only the first record counts.
        """
        harness, world = self.harness, self.harness.world
        same = [each for each in left if each.scenarios == leftover.scenarios]
        if same[0] is not leftover:
            leftover.discard()
            return Retried()
        if leftover.world not in (None, harness.job().world_data):
            try:
                world = None if codec.is_code(leftover.world) else codec.from_dict(leftover.world)
            except (WorldError, TypeError, ValueError):
                world = None
        if world is None:
            note = (
                f"a process (pid {leftover.pid}) died while it ran {leftover.scenarios!r:.300} in a world that cannot "
                f"be made here now, {dict(leftover.world or {})!r:.200}; it cannot be tried again, so it is no finding"
            )
            return Retried(notes=(note,), pending=leftover)
        return retry(
            leftover,
            harness.job(world),
            partial(harness.judge_trace, world),
            isolate=harness.request.settings.isolate,
            has_died_twice=sum(not each.is_watched for each in same) > 1,
            keep=self.loop.recorder.keep_crash,
            run_here=self.loop.simulation.rerun_one_by_one,
        )

    def _searched(self, saved: Sequence[Saved], began: float) -> str:
        """Run the campaign; return why it ended. ``began`` is the time at which the search began [s].

        Raises:
            RequestError: if the algorithm does not support the settings, or the fitness cannot be used.
        """
        __tracebackhide__ = True
        if self.loop.space is None:
            return "replay only"
        space, loop, runner = self.loop.space, self.loop, self.loop.simulation.runner
        request, settings = self.harness.request, self.harness.request.settings
        limit = 1 if self.stops_at_first else settings.stop_after
        # The algorithm twice: a policy that decides for many runs at once gets a larger population, but only its first
        # generation shows whether it does.
        try:
            algorithm = request.algorithm.make(space, **_population(settings.population))
            for_batches = request.algorithm.make(
                space, **_population(settings.population or request.algorithm.batch_population)
            )
        except ValueError as error:
            raise RequestError(str(error)) from None
        # What is known before the first run: the state of earlier sessions, and the failures that saved scenarios still
        # show. The search's own findings of earlier sessions are part of that state, not known failures.
        self.sessions.beginning.most = getattr(algorithm, "counted_at_first", 0.0)
        resumed = self.sessions.resume(algorithm, space, saved)
        others = [each for each in saved if not self.sessions.is_own(each)]
        loop.recorder.replayed = frozenset(each.path for each in others)
        loop.fatal |= {each.finding.scenario for each in others if each.finding is not None and each.is_crash}
        search_until = began + (self.limit.until - began) * (1 - FOR_SIMPLIFYING)
        try:
            with runs_end_in(loop.recorder.until - self.sessions.clock()):
                loop.shown = self.replays.shown_by(others)  # Their failures are not new.
                self._manners = {each.id: Manner.of(each.finding.expect) for each in others if each.finding is not None}
                self.sessions.find_again(saved, search_until)
        except OutOfTime:  # It is unknown what is known, so nothing could be called new.
            return self.limit.flag

        def adapted(algorithm: Algorithm[Any], generation: int) -> Algorithm[Any]:
            return for_batches if generation and self.sessions.decides_for_many else algorithm

        runs_before, campaign_began = loop.runs, self.sessions.clock()
        last = campaign_began  # the end of the last run

        def tick() -> None:
            nonlocal last
            last = self.sessions.clock()
            if self._since is None and loop.runs > runs_before:
                self._since = last - loop.recorder.confirm_seconds, loop.runs
            self._tell_progress()

        campaign_ends = self._campaign_ends(campaign_began, runs_before, search_until)

        # A run may be cut when the time is over; the first run gets its time in any case.
        def seconds_left() -> float:
            ends = campaign_ends() if loop.recorder.firm else self.limit.until
            return (ends if loop.runs > runs_before else max(ends, began + LEAST)) - self.sessions.clock()

        is_ahead = draws_ahead(algorithm)
        if loop.counting is not None:
            loop.counting.random_runs, loop.counting.fatal = self.sessions.beginning.most, loop.fatal

        def foresee(scenarios: Iterable[Scenario]) -> None:
            runner.announce((each for each in scenarios if each not in loop.fatal), more=is_ahead)
            if not is_ahead or len(loop.uncounted) >= COUNTED_AT_ONCE:
                loop.count()  # now, because other processes are busy with the scenarios

        # The campaign is a generator: the loop that follows its events makes it draw, run and breed.
        try:
            events = run_campaign(
                algorithm,
                loop.evaluate,
                generations=settings.generations,
                runs=settings.runs,
                seed=self.sessions.seed,
                max_seconds=lambda: max(0.0, campaign_ends() - campaign_began),
                clock=self.sessions.clock,
                stop=lambda: limit is not None and loop.recorder.count >= limit,
                seeds_matter=(sight_of(self.harness.ads) or Sight()).is_drawn,
                foresee=foresee,
                team=None if loop.counting is None else loop,
                adapted=adapted,
                resumed=resumed,
                border=self.sessions.at_border,
            )
            loop.seconds_left = seconds_left
            loop.follow(events, tick)
        except CheckpointError as error:
            raise self.sessions.refused(error) from None
        except FitnessError as error:
            raise RequestError(str(error)) from None
        except skips() as error:
            raise RequestError(no_skip("the fitness", error)) from None
        reasons = {"generations": DONE, "runs": ALL_RUN, "time": self.limit.flag, "stopped": "enough findings"}
        lost, runs = self.sessions.clock() - last, loop.runs - runs_before
        is_cut = loop.finished is not None and loop.finished.reason == "time"
        if is_cut and lost > max(1.0, LOST * (last - campaign_began) / (runs + 1)):
            self.driver_notes.append(
                f"{self.limit.flag} cut a run after {lost:.1f} s, with {plural(runs, 'run')} before it: if a decision "
                "hangs, a longer limit or a shorter hang_limit of the world shows it"
            )
        return "interrupted" if loop.finished is None else reasons[loop.finished.reason]

    def _campaign_ends(self, began: float, runs_before: int, search_until: float) -> Callable[[], float]:
        """Return a function that says when the campaign has to end [s], given its findings so far.

        That leaves the time to simplify its findings, or without any, to confirm one in its last run, as far as can be
        told from the runs so far. Runs of a policy that decides for many at once do not tell how long one alone takes.
        The campaign began at the time ``began`` [s], after ``runs_before`` runs; ``search_until`` is the earliest end
        [s].
        """
        loop, clock, settings = self.loop, self.sessions.clock, self.harness.request.settings
        to_simplify = RUNS_TO_CONFIRM + rollouts_for(self.harness) + RUNS_A_NEIGHBOUR * settings.neighbours
        to_compare = 0 if self.harness.against is None else 2 * settings.pairs

        def ends() -> float:
            run_seconds = (clock() - began) * settings.workers / max(loop.runs - runs_before, 1)
            firm = loop.recorder.firm
            if firm and self.sessions.decides_for_many:
                return search_until
            return max(
                search_until, self.limit.until - (firm * to_simplify + to_compare or RUNS_TO_CONFIRM) * run_seconds
            )

        return ends

    @property
    def _run_seconds(self) -> float:
        """The mean time of a run in the process that makes it [s]; 0 if it is not known yet.

        Confirming a finding is left out: at first most failures are new, and later hardly any.
        """
        loop, runner = self.loop, self.loop.simulation.runner
        if runner.processes.in_use:
            return runner.processes.run_seconds
        # The first runs of an executor come at the same time, after that of one run.
        if self._since is None or (runner.processes.is_elsewhere and not loop.generation):
            return 0.0
        began, before = self._since
        made = loop.runs + runner.ready - before
        return (self.sessions.clock() - loop.recorder.confirm_seconds - began) / made if made else 0.0

    def _tell_progress(self, phase: str = "", of: str = "") -> None:
        now, loop = self.sessions.clock(), self.loop
        if now - self._told_at < self.progress_seconds:
            return
        self._told_at = now
        budget, generations = self.sessions.budget
        runner, run_seconds = loop.simulation.runner, self._run_seconds
        runs_left = 0 if budget is None else budget - loop.runs - runner.ready
        decisions = 0 if self.sessions.is_resumed else loop.decisions  # some of the runs are of an earlier session
        loop.recorder.listener(
            Progress(
                node_id=self.node_id,
                generation=min(loop.generation + 1, generations or loop.generation + 1),
                generations=generations,
                runs=loop.runs,
                budget=budget,
                failing=loop.verdicts["failed"],
                finds=loop.recorder.count,
                seconds=self.sessions.seconds,
                left=runs_left * run_seconds / max(runner.processes.in_use, 1),
                decision_seconds=run_seconds * loop.runs / decisions if decisions else 0.0,
                is_limited=self.limit.until < math.inf,
                phase=phase,
                of=of,
            )
        )

    def _summary(self, reason: str) -> SearchSummary:
        settings, loop, health = self.harness.request.settings, self.loop, self.loop.health
        budget, generations = self.sessions.budget
        is_cut = reason == self.limit.flag and not self.sessions.go_on
        cut = [f"cut by {reason}: the same seed may find other scenarios next time"] * is_cut
        finds = [kept.find for kept in loop.recorder.kept.values()]
        notes = (
            loop.doubt,
            self._excused_late,
            loop.known_alone,
            self._unused,
            self._without_effect,
            *self._unlike_episodes,
            self._out_of_reach,
            loading_hint(self.harness.ads) if loop.runs else "",
        )
        beginning, crossings = self.sessions.beginning, None if loop.space is None else loop.space.crossings
        ways = [] if crossings is None else [zone.way for zone in crossings.zones]
        # An error says nothing about the ego, and a rate of random scenarios that end at the first failure is too high.
        is_cut_short = reason == "error" or (reason == "enough findings" and not beginning.is_whole)
        return SearchSummary(
            node_id=self.node_id,
            algorithm=self.harness.request.algorithm.name,
            profile=settings.profile,
            base_seed=settings.seed,
            seed=self.sessions.seed,
            generations=loop.generation if loop.finished is None else loop.finished.generations,
            asked=generations,
            budget=budget,
            reason=reason,
            seconds=self.sessions.seconds,
            runs=loop.runs,
            known_runs=health.reused,
            invalid=loop.verdicts["invalid"],
            npc=loop.verdicts["npc"] + loop.verdicts["avoidable"],
            avoidable=loop.verdicts["avoidable"],
            unpreventable=loop.verdicts["unpreventable"],
            common=loop.verdicts["common"],
            rejected=loop.verdicts["rejected"],
            skipped=loop.verdicts["skipped"],
            reached=health.reached_share if health.genes_started and health.goals else None,
            no_interaction=health.no_interaction,
            failing=loop.verdicts["failed"],
            finds=tuple(replace(find, repeats=loop.repeats[find.id]) for find in finds),
            unsaved={id_: 1 + loop.repeats[id_] for id_ in loop.recorder.unsaved},
            shrink_runs=self._shrink_runs,
            neighbour_runs=self._neighbour_runs,
            decisions=loop.decisions - self._shrink_decisions - self._neighbour_decisions,
            confirm_decisions=loop.recorder.confirm_decisions,
            shrink_decisions=self._shrink_decisions,
            neighbour_decisions=self._neighbour_decisions,
            reused_decisions=loop.simulation.runner.reused,
            known=dict(loop.known + self.sessions.found_before),
            unlike=self._unlike(),
            failures={signature.text: id_ for signature, id_ in loop.failures.items()},
            warnings=loop.warnings if reason in self._told_with_warnings else (),
            notes=(*self.sessions.notes, *self.driver_notes, *filter(None, notes), *cut, *self._left_undone(reason)),
            process_notes=tuple(self.process_notes),
            against=self.harness.against_name,
            paired=None if self._worse is None else self._worse.paired,
            no_worse=loop.recorder.dismissed,
            random_failing=0 if is_cut_short else beginning.at_fault,
            random_runs=0 if is_cut_short else beginning.runs,
            random_otherwise=0 if is_cut_short else beginning.otherwise,
            given=0 if loop.space is None else min(len(loop.space.first), loop.runs),
            drawn="" if self.loop.space is None else self.loop.space.described,
            coverage=health.coverage.describe(float(self.harness.world.speed_limit), ways) if loop.runs else "",
        )

    def _unlike(self) -> dict[str, tuple[str, ...]]:
        """Return for saved scenarios up to three scenarios that fail like them, but came about in another manner.

        Those that differ most are first, then those that came first.
        """
        found: dict[str, tuple[str, ...]] = {}
        for signature, manners in self.loop.manners.items():
            id_ = self.loop.shown[signature]
            own = self._manners.get(id_)
            if own is None:
                continue
            unlike = [(differs, each) for manner, each in manners.items() if (differs := manner.unlike(own))]
            unlike.sort(key=lambda pair: -len(pair[0]))
            found[id_] = tuple(f"{each} ({'; '.join(differs)})" for differs, each in unlike[:MAX_UNLIKE])
        return {id_: told for id_, told in sorted(found.items()) if told}

    @property
    def _excused_late(self) -> str:
        """A note on collisions that the rules excuse, although braking late, but hard, would have avoided them."""
        count = self.loop.verdicts["avoidable"]
        if not count:
            return ""
        return (
            f"the rules excuse {plural(count, 'collision')} that 6 m/s^2 from 1.4 s after the danger began would have "
            f'avoided, such as: {self.loop.avoidable} blame="avoidable" counts them as failures'
        )

    @property
    def _out_of_reach(self) -> str:
        """A note on what reference drivers can do and the ADS cannot; empty if its actions can stop the ego."""
        speed, kept = protocol.least_action_speed(self.harness.world), self.loop.recorder.kept.values()
        expected = [each.finding.expect for each in kept]
        runs = [each.run.ego.speed for each in kept if each.run is not None]  # which may begin slower, and speed up
        was_slower = any(((each[1:] < each[:-1]) & (each[1:] < speed - SLOWER)).any() for each in runs)
        is_avoided = any(each.avoided_by or "avoids" in (each.reference_drivers or {}).values() for each in expected)
        if speed <= 0 or was_slower or not is_avoided or is_vehicle_class(self.harness.ads):
            return ""
        return (
            f"the environment's actions keep {speed:g} m/s or more, and what braking avoids may need less; "
            "target_speeds in the action of config= lets a policy do so, too"
        )

    @property
    def _without_effect(self) -> str:
        """A note on the options of config= that have no effect, and on what has it in their place; or empty."""
        lane, world = self.harness.request.space.get("ego_lane"), self.harness.world
        if not self.loop.runs:  # the environment may be one that cannot be made
            return ""
        ads = self.harness.ads
        drives_itself = is_vehicle_class(ads)
        simulates = not drives_itself and wants_env(ads)
        given = protocol.options_without_effect(world, drives_itself=drives_itself, simulates=simulates)
        given.pop(f"write ego_lane={lane!r}", None)  # it has been written
        told = [f"{', '.join(names)} ({why})" for why, names in given.items()]
        return f"options of config= without effect in a search: {'; '.join(told)}" if told else ""

    @property
    def _unlike_episodes(self) -> Iterator[str]:
        """Notes on code of the user's environment that has no effect in runs."""
        world = self.harness.world
        if not self.loop.runs or is_vehicle_class(self.harness.ads):
            return
        if told := left_out_text(world):
            yield told
        if protocol.has_traffic_in_reset(world):
            yield "what `reset` does to other vehicles has no effect on NPCs, which begin as their scenario says"

    @property
    def _unused(self) -> str:
        """A note that the search says nothing about traffic on other ways, because no NPC drives there; or empty."""
        world, unused = self.harness.world, protocol.unused_roads(self.harness.world)
        crosses = self.loop.space is not None and self.loop.space.crossings is not None
        if not unused or not self.loop.runs or crosses:
            return ""
        verbs = {"crosses": "crosses", "joins": "joins", "oncoming": "comes towards"}
        none = " or ".join(f"{verb} it" for meeting, verb in verbs.items() if meeting in unused)
        where = getattr(world, "env_id", type(world).__name__)
        which = f"at {where} all NPCs drive along the ego's way: none {none}"
        without = ", and acts= has no effect" if "acts" in self.harness.request.space else ""
        return f"{which}, so the search says nothing about such traffic{without}"

    def _left_undone(self, reason: str) -> Iterator[str]:
        """Yield notes on what the search left undone, and how to continue."""
        request, recorder = self.harness.request, self.loop.recorder
        settings = request.settings
        is_broken_off = reason in ("interrupted", "error")
        firm = [kept for kept in recorder.kept.values() if kept.is_firm]
        left = [kept for kept in firm if (kept.finding.shrunk is None if is_broken_off else kept.find.unshrunk)]
        if left and settings.shrink_rollouts != 0:
            what = "1 new finding was" if len(left) == 1 else f"{len(left)} new findings were"
            first = "delete its files and " if any(kept.file for kept in left) else ""
            again = f"{first}search again with {request.option('seed', settings.seed)}"
            resume = request.option("resume", settings.resume or "FOLDER")
            by_command = self.shrinks_later and all(kept.file for kept in left)
            shrink = f"{command('pytest_pafot', 'corpus', 'shrink', 'FILE')} goes on"
            if not is_broken_off:
                how = shrink if by_command else f"{again} and more time, or with {resume}"
                how = f"{resume} goes on" if self.sessions.go_on else how
                yield f"{self.limit.flag} ended before {what} shrunk: {how}"
            elif not self.sessions.go_on:
                yield f"ended before {what} shrunk: {shrink if by_command else again}"
        is_default = settings.profile == LOCAL and settings.runs == PROFILES[LOCAL]["runs"]
        if is_default and reason == ALL_RUN and not self.loop.verdicts["failed"] and not recorder.count:
            longer = request.option("runs", PROFILES[FULL]["runs"])
            yield f"{settings.runs} runs are a short search; use {longer} for a longer one"


def _population(given: int | None) -> dict[str, int]:
    """Return the population as a parameter of the algorithm; nothing for None, so that its default is used."""
    return {} if given is None else {"population": given}


def may_not_leave(harness: Harness) -> str:
    """Return why the ADS of a harness had better stay in this process, see :func:`must_stay_here`; or empty."""
    try:
        scenario = sample(build_space(harness.request, harness.world), np.random.default_rng(0))
    except RequestError:  # which the search reports
        return ""
    return must_stay_here(harness.job(), scenario)


def isolated_after_a_death(harness: Harness, replays: Replays) -> Harness:
    """Return a harness that runs scenarios in other processes, if an earlier session died in a run of this test.

    This is done only if processes are forked, because otherwise some factories cannot be passed to another process.
    """
    settings = harness.request.settings
    if scenario_pool.METHOD != "fork" or settings.isolate or not settings.is_search:
        return harness
    if harness.left_behind() or any(each.is_crash and replays.still_fails(each) for each in saved_in(harness.folder)):
        return replace(harness, request=replace(harness.request, settings=replace(settings, isolate=True)))
    return harness
