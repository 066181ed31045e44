"""Simplification after a search: each finding is shrunk, and reference drivers are tried in it.

No finding depends on simplification: each finding is saved and reported before, and the simpler version replaces its
file and report. If a time limit cuts the simplification, a later session continues with the stored answers. Shrinking
then makes the same attempts in the same order, so it has the same result.
"""

from __future__ import annotations

import math
import pickle
from bisect import bisect_right
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from typing import Any, TypeVar

from pytest_pafot.campaign.events import FindTold
from pytest_pafot.campaign.harness import Harness, begins_alike, limits_of, refusals
from pytest_pafot.campaign.search_loop import SearchLoop
from pytest_pafot.campaign.state_file import Answer, Shown
from pytest_pafot.campaign.verdict import Verdict, headline
from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import call_apart, runner_for
from pytest_pafot.findings.finding import Expect, Perceived, ending, of_failure
from pytest_pafot.findings.neighbours import Breadth, breadth_of
from pytest_pafot.findings.reactions import Reaction
from pytest_pafot.findings.shrink import OutOfBudget, Shrunk, Start, shrink
from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import LANE, SPEED, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import DriverError, OutOfTime, RequestError
from pytest_pafot.support.text import one_line
from pytest_pafot.world import codec, protocol
from pytest_pafot.world.driving.ads import is_vehicle_class, wants_env
from pytest_pafot.world.driving.perception import Perception, sight_of, without
from pytest_pafot.world.guard.failure import is_interruption
from pytest_pafot.world.guard.hang_guard import runs_end_in
from pytest_pafot.world.guard.own_worlds import rollout_of

ClaimT = TypeVar("ClaimT")

# The imperfections of an ADS's sight that a failure needs.


def needed_imperfections(sight: Sight, fails: Callable[[Sight], bool]) -> tuple[str, ...]:
    """Return the names of the imperfections that a failure needs; empty if the test fails with perfect sight, too.

    One imperfection after the other is removed from the sight if the test still fails without it. So each remaining
    imperfection is needed, although another set of imperfections may be enough as well. This takes one run with perfect
    sight and, if there are several imperfections, a run for each of them.

    Args:
        sight: the sight with which the test fails.
        fails: returns whether the test fails with another sight.
    """
    if fails(sight.only(())):
        return ()
    needed = sight.imperfections
    for name in sight.imperfections:
        others = tuple(each for each in needed if each != name)
        if others and fails(sight.only(others)):
            needed = others
    return needed


ROLLOUTS, ROLLOUTS_IN_KERNEL = 300, 3000
"""The default limits of the runs that shrink one finding.

The larger limit is for an ADS that is a vehicle class of highway-env, because the kernel runs it quickly.
"""


RUNS_TO_CONCLUDE = 3
"""The approximate time for the work after shrinking, except confirmation, as a number of runs.

One run is for the verdict on the shrunk scenario. The others are for reference drivers, which are fast because the ADS
is not called.
"""


@dataclass(slots=True, kw_only=True)
class _Turn:
    """The share of the remaining time in which one finding is shrunk.

    Attributes:
        until: the time at which the share ends [s], or infinity.
        to_conclude: the estimated time to run the shrunk scenario again and to try reference drivers [s].
        attempts: the number of attempts to shrink so far.
        seconds: the time that the attempts have taken [s].
        is_over: True if shrinking was stopped because no time was left.
    """

    until: float
    to_conclude: float = 0.0
    attempts: int = 0
    seconds: float = 0.0
    is_over: bool = False

    def check(self, now: float) -> None:
        """Raise OutOfBudget if no time is left for another attempt and the work after it, and in all later calls."""
        mean = self.seconds / max(self.attempts, 1)
        self.is_over = self.is_over or now + mean + self.to_conclude >= self.until
        if self.is_over:
            raise OutOfBudget

    def took(self, seconds: float, confirming: float | None) -> None:
        """Record an attempt that took some time [s].

        If the attempt is the simplest failing scenario so far, ``confirming`` is the time to confirm it [s]; else None.
        """
        self.attempts += 1
        self.seconds += seconds
        if confirming is not None:
            self.to_conclude = RUNS_TO_CONCLUDE * seconds + confirming


@dataclass(slots=True, kw_only=True)
class Simplification:
    """The simplification of the findings of one search.

    Attributes:
        loop: the loop of the search.
        tell: is called often, with a text on the current work.
        plain: the default start of the ego, which shrinking prefers.
        plain_seconds: the default duration of a gene, which shrinking prefers [s].
        neighbours: the number of neighbours of each finding to run.
        answers: the results of attempts in this session or an earlier one, by the id of the finding.
        clock: returns the seconds since some fixed moment.
        until: the time at which the simplification must end [s], or infinity.
        done: the ids of the findings for which nothing is left to do.
        current: the id of the finding that is simplified or examined now.
        runs: the number of runs so far in this session, except those of neighbours.
        neighbour_runs: the number of runs of neighbours.
        notes: notes on what could not be found out about findings.
    """

    loop: SearchLoop
    tell: Callable[[str], None]
    plain: Start | None
    plain_seconds: float | None
    neighbours: int
    answers: dict[str, list[Answer]]
    clock: Callable[[], float]
    until: float = math.inf
    done: set[str] = field(default_factory=set, init=False)
    current: str = field(default="", init=False)
    runs: int = field(default=0, init=False)
    neighbour_runs: int = field(default=0, init=False)
    notes: list[str] = field(default_factory=list, init=False)

    def run_all(self, way_on: str) -> None:
        """Simplify the findings in the order of discovery, except those that cannot be shrunk.

        These are findings that are flaky, depend on wall-clock time or are crashes.

        With a time limit, each finding gets an equal share of the time that is left. Unused time goes to the next
        findings, then to findings that were cut. ``way_on`` says how the user can go on with a finding that stays cut.
        """
        __tracebackhide__ = True
        recorder = self.loop.recorder
        finds, before = [find_id for find_id, kept in recorder.kept.items() if kept.is_firm], -1
        while finds and self.runs > before:  # After a round without runs there is no time left.
            before, round_ = self.runs, finds
            for number, find_id in enumerate(round_):
                self.current = find_id
                self._have_turn(find_id, sharing=len(round_) - number)
            finds = [find_id for find_id in round_ if find_id not in self.done]
        for kept in [recorder.kept[find_id] for find_id in finds]:
            cut = "not shrunk: out of time" if kept.finding.shrunk is None else "shrunk in part: out of time"
            find = replace(kept.find, unshrunk=f"{kept.find.unshrunk or cut}{way_on}")
            recorder.tell(replace(kept, find=find, is_new=False))
        if self.neighbours:
            for kept in [each for find_id, each in recorder.kept.items() if each.is_firm and find_id in self.done]:
                self.current = kept.find.id
                self._examine(kept)

    def _examine(self, kept: FindTold) -> None:
        """Run the neighbours of a finding, and report how many fail in the same way, unless the time ends before.

        No error ends the search here, because a user's world may not expect scenarios other than those of a search.
        """
        __tracebackhide__ = True
        find, told, found = kept.find, "neighbours", kept.run
        try:
            self._check_time()
            with runs_end_in(self.until - self.clock()):
                breadth = self._breadth(kept)
                find = replace(find, breadth=breadth)
                if breadth is not None:
                    labelled = replace(kept.finding, neighbours=breadth.at_full_steps)
                    kept = self.loop.recorder.rewritten(kept, labelled)
                self.loop.recorder.tell(replace(kept, find=find, is_new=False))
                if found is not None:
                    told = "reactions"
                    find = replace(find, reactions=self._reactions(find.id, found))
                    self.loop.recorder.tell(replace(kept, find=find, is_new=False))
        except OutOfTime:
            self.notes.append(f"no {told} of saved-{find.id}: out of time")
        except Exception as error:
            if is_interruption(error):
                raise
            self.notes.append(f"no {told} of saved-{find.id}: {type(error).__name__}: {one_line(str(error))}")

    def _check_time(self) -> None:
        if self.clock() >= self.until:
            raise OutOfTime

    def _breadth(self, kept: FindTold) -> Breadth | None:
        """Run the neighbours of a finding, and return how many fail in the same way; None if it has none."""
        numbers = count(1)

        def fails(scenario: Scenario) -> bool | None:
            self._check_time()
            self.tell(f"running neighbour {next(numbers)} of {kept.find.id}")
            self.neighbour_runs += 1
            run = self._showing(kept.find.id, scenario)
            if run is not None and kept.run is not None and begins_alike(kept.run, run):
                return None  # its run is that of the finding, so it is no neighbour
            return run is not None

        limits = limits_of(self.loop.simulation.harness.world)
        return breadth_of(kept.finding.scenario, self.neighbours, fails=fails, limits=limits)

    def _reactions(self, find_id: str, found: Run) -> tuple[Reaction, ...]:
        """Run a finding again with each NPC hidden from the ADS, and return how its decisions differ.

        Nothing can be hidden from a vehicle class, which reads the road itself, or in a world that is not built in.
        """
        harness, trace = self.loop.simulation.harness, found.trace
        if is_vehicle_class(harness.ads) or not codec.is_built_in(harness.world):
            return ()
        # An ADS that never reacts to a vehicle may not have seen it. Its observations are then the same without it.
        # An ADS with the environment sees more than its observations. A planner with perfect sight sees everybody.
        sees_all = sight_of(harness.ads) is None and getattr(harness.world, "planner_hz", 1) is not None
        is_noted = not (sees_all or self._is_out_of_reach or wants_env(harness.ads))
        told: list[Reaction] = []
        without_it: list[list[bytes]] = []  # for each NPC, the observations until the event with it hidden
        until, times = found.event_time, [tick / trace.physics_hz for tick in trace.decision_ticks]
        decisions = bisect_right(times, until + 1e-9)
        for npc in range(len(found.scenario.npcs)):
            self.tell(f"hiding NPC {npc} of {find_id}")
            seen: list[bytes] = []
            hidden = self._driven(found.scenario, npc, seen if is_noted else None)
            if hidden is None:
                return ()
            told.append(Reaction.of(npc, trace.actions, hidden.actions, times=times, until=until))
            without_it.append(seen[:decisions])
        if is_noted and any(each.time is None for each in told):
            self.tell(f"driving {find_id} again")
            whole: list[bytes] = []
            self._driven(found.scenario, None, whole)
            told = [
                replace(each, unseen=each.time is None and bool(seen) and seen == whole[:decisions])
                for each, seen in zip(told, without_it, strict=True)
            ]
        return tuple(told) if trace.actions else ()

    def _driven(self, scenario: Scenario, npc: int | None, seen: list[bytes] | None) -> Trace | None:
        """Run a scenario with an NPC hidden from the ADS, and add its observations to a list, if there is one.

        Returns:
            The run; None if nothing can be hidden in an observation, such as a picture.
        """
        self._check_time()
        self.neighbour_runs += 1
        harness, record = self.loop.simulation.harness, self.loop.simulation.record
        job = replace(harness.job(), ads=without(harness.ads, npc, None if seen is None else partial(_note, seen)))
        isolate = harness.request.settings.isolate
        try:
            with refusals():
                if isolate and seen is not None:  # the other process notes what it sees in a copy of the list
                    trace, noted = call_apart(job, scenario, lambda *run: (rollout_of(job.world)(*run), seen))
                    seen += noted
                    return trace
                with runner_for(job, record, isolate=isolate) as runner:
                    return runner.run(scenario, afresh=True)
        except RequestError:
            return None
        finally:
            record.clear()

    @property
    def _is_out_of_reach(self) -> bool:
        """True if the ADS is called in processes that are no copies of this one: nothing in them can be read."""
        return self.loop.simulation.harness.request.settings.isolate and scenario_pool.METHOD != "fork"

    def _have_turn(self, find_id: str, sharing: int) -> None:
        """Simplify a finding in its share of the remaining time; ``sharing`` is the number of equal shares."""
        __tracebackhide__ = True
        now, kept = self.clock(), self.loop.recorder.kept[find_id]
        if now >= self.until:
            return
        try:
            with runs_end_in(self.until - now):
                is_done = self._refine(kept, _Turn(until=now + (self.until - now) / sharing))
        except OutOfTime:  # The finding stays as it was. What is known of shrinking it is among the answers.
            is_done = False
        except ProcessLostError as error:
            self.loop.recorder.call_flaky(kept, f"the process that ran it again {error.how}")
            self.loop.lose(error)
            is_done = True
        if is_done:
            self.done.add(find_id)

    def _refine(self, kept: FindTold, turn: _Turn) -> bool:
        """Shrink a finding, run the result again, try reference drivers, and report; return True if nothing is left."""
        __tracebackhide__ = True
        found = kept.finding.original or kept.finding.scenario
        scenario, shrunk = self._shrunk(kept, found, turn)
        self.runs += turn.attempts
        is_as_told = turn.is_over and scenario == kept.finding.scenario
        if is_as_told or self.clock() + turn.to_conclude > self.until:
            return False
        run, verdict, differs = self._run_again(scenario, kept)
        if differs and len(self.answers[kept.find.id]) > turn.attempts:
            self.answers[kept.find.id].clear()  # Some are from earlier sessions: the ADS may have changed since.
            return self._refine(kept, _Turn(until=turn.until))
        if differs and scenario != found:
            # The simplified scenario does not repeat, so fall back to the scenario as found, which may be flaky, too.
            scenario, shrunk, turn.is_over = found, Shrunk(rollouts=shrunk.rollouts, is_minimal=False), False
            run, verdict, differs = self._run_again(scenario, kept)
        if differs:
            self.loop.recorder.call_flaky(kept, differs)
        else:
            self._conclude(kept, scenario, shrunk, run, verdict)
        return bool(differs) or not turn.is_over

    def _shrunk(self, kept: FindTold, found: Scenario, turn: _Turn) -> tuple[Scenario, Shrunk]:
        __tracebackhide__ = True
        harness, answers = self.loop.simulation.harness, self.answers.setdefault(kept.find.id, [])
        rollouts, top_speed = rollouts_for(harness), float(harness.world.speed_limit)
        starts: dict[Scenario, tuple[Start, ...]] = {}
        asked = 0

        def attempt(candidate: Scenario) -> Scenario | None:
            nonlocal asked
            # Shrinking asks the same questions in the same order, so an earlier session's answers serve as a prefix.
            if asked < len(answers) and answers[asked][0] != candidate.id:
                del answers[asked:]  # They are from a session with other settings, which made other attempts.
            if asked == len(answers):
                began = self.clock()
                turn.check(began)
                self.tell(f"shrinking {kept.find.id}, run {asked + 1} of {rollouts}")
                try:
                    with runs_end_in(turn.until - turn.to_conclude - began):
                        shown = self._shown(kept.find.id, candidate, top_speed)
                except OutOfTime:
                    turn.is_over = True
                    raise OutOfBudget from None
                answers.append((candidate.id, shown))
                turn.took(self.clock() - began, None if shown is None else self._confirming(shown[0]))
            _, shown = answers[asked]
            asked += 1
            if shown is None:
                return None
            scenario, starts[scenario] = shown
            return scenario

        if rollouts == 0:
            return found, Shrunk(rollouts=0, is_minimal=False)
        return shrink(
            found,
            attempt,
            rollouts=rollouts,
            top_speed=top_speed,
            starts=lambda scenario: starts.get(scenario, ()),
            plain=self.plain,
            plain_seconds=self.plain_seconds,
        )

    def _confirming(self, scenario: Scenario) -> float:
        """Return the estimated time to confirm a scenario [s], from the slowest confirmation so far."""
        longest_run = float(self.loop.simulation.harness.world.longest_run)
        return self.loop.recorder.pace * min(scenario.seconds, longest_run)

    def _shown(self, find_id: str, candidate: Scenario, top_speed: float) -> Shown:
        """Run a simpler candidate for a finding; return the scenario as driven, with the ego's state at each gene.

        Return None if the candidate does not show the finding's failure.
        """
        __tracebackhide__ = True
        run = self._showing(find_id, candidate)
        return None if run is None else (driven(run), starts_of(run, top_speed))

    def _showing(self, find_id: str, candidate: Scenario) -> Run | None:
        """Run a scenario; return the run if it shows the failure of a finding, otherwise None."""
        __tracebackhide__ = True
        loop = self.loop
        if candidate in loop.fatal:
            return None
        try:
            protocol.check_fits(loop.simulation.harness.world, candidate)
            run = loop.simulation.run(candidate)
        except ScenarioError:  # For example, it begins in an outer lane, next to which there are too few cells.
            return None
        except ProcessLostError as error:
            loop.lose(error)
            return None
        verdict = loop.simulation.judge(run, driven(run))
        return run if self._shows(find_id, run, verdict) else None

    def _shows(self, find_id: str, run: Run, verdict: Verdict) -> bool:
        """Return whether a run shows the failure of a finding, and by the same fault, so its name still fits."""
        found = next(signature for signature, id_ in self.loop.finds.items() if id_ == find_id)
        shown = of_failure(run, verdict.failure) if verdict.failed and verdict.failure is not None else None
        return shown is not None and (shown, shown.fault) == (found, found.fault)

    def _run_again(self, scenario: Scenario, kept: FindTold) -> tuple[Run, Verdict, str]:
        """Run a scenario from scratch; return the run, its verdict, and its difference from the finding, if any."""
        __tracebackhide__ = True
        run = self.loop.simulation.run(scenario, afresh=True)
        verdict = self.loop.simulation.judge(run)
        if not self._shows(kept.find.id, run, verdict):
            otherwise = f"a later run of it ended differently: {ending(run)}"
            return run, verdict, "the reference failed when it ran again" if verdict.kind == "common" else otherwise
        is_confirmed = scenario == kept.finding.scenario and not kept.find.unshrunk
        return run, verdict, "" if is_confirmed else self.loop.recorder.confirmed(run)

    def _conclude(self, kept: FindTold, scenario: Scenario, shrunk: Shrunk, run: Run, verdict: Verdict) -> None:
        if verdict.failure is None or verdict.exception is None:
            return
        before, harness, recorder = kept.finding, self.loop.simulation.harness, self.loop.recorder
        found = before.original or before.scenario
        # Drivers in the ego's place say who could have prevented the failure, and how.
        self.tell(f"trying reference drivers in saved-{kept.find.id}")
        outcomes = harness.reference_outcomes(run, verdict, self._note)
        avoided, known, exception = self._claimed(lambda: harness.avoidance(run, verdict)), run, verdict.exception
        if avoided is not None:
            known = replace(run, avoided_by=avoided)
        if known.sentences != run.sentences:  # the message of the failure may contain them
            again = harness.judge(known)
            exception = again.exception if again.failed and again.exception is not None else exception
        perception = self._perceived(kept, scenario)
        # The file now says what the shrunk scenario shows, and keeps the scenario as found.
        finding = replace(
            before,
            scenario=scenario,
            expect=Expect.of(
                run,
                verdict.failure,
                reference_drivers=outcomes,
                avoided_by=avoided,
                escaped_by=self._claimed(lambda: harness.escape(run, verdict)),
                against=before.expect.against,
                root=str(harness.root),
            ),
            perception=perception,
            original=found if scenario != found else None,
            shrunk=shrunk if shrunk.rollouts else None,
        )
        if finding == before and not kept.find.unshrunk:
            return
        line = headline(run, verdict)
        line = line if perception is None else f"{line}, {perception.sentence}"
        responsible = finding.expect.responsibility
        find = replace(kept.find, headline=line, severity=verdict.severity, responsible=responsible, unshrunk="")
        recorder.tell(
            replace(recorder.rewritten(kept, finding), find=find, exception=exception, run=known, is_new=False)
        )

    def _claimed(self, claim: Callable[[], ClaimT | None]) -> ClaimT | None:
        """Return what a driver in the ego's place shows; None with a note if the world cannot simulate the driver."""
        try:
            return claim()
        except DriverError as error:
            self._note(error)
            return None

    def _note(self, error: DriverError) -> None:
        note = f"{error}; findings say nothing of what this driver would have done"
        if note not in self.notes:
            self.notes.append(note)

    def _perceived(self, kept: FindTold, scenario: Scenario) -> Perceived | None:
        """Return the imperfections of the ADS's perception that a finding needs; None if its perception is perfect."""
        before, simulation = kept.finding.perception, self.loop.simulation
        harness, ads = simulation.harness, simulation.harness.ads
        if before is None or not isinstance(ads, Perception):
            return None
        self.tell(f"trying perfect sight in saved-{kept.find.id}")

        def fails(sight: Sight) -> bool:
            return harness.fails_with(ads.seeing(sight), scenario, simulation.record)

        return replace(before, needed=needed_imperfections(before.sight, fails))


def rollouts_for(harness: Harness) -> int:
    """Return the largest number of runs to shrink one finding: as the user set it, or by how fast the ADS is."""
    given = harness.request.settings.shrink_rollouts
    if given is not None:
        return given
    return ROLLOUTS_IN_KERNEL if protocol.runs_in_kernel(harness.world, harness.ads) else ROLLOUTS


def driven(run: Run) -> Scenario:
    """Return the scenario of a run without the genes that the run did not reach. The run stays the same."""
    scenario = run.scenario
    return scenario.truncated(max(1, min(scenario.genes, int(run.duration / scenario.gene_seconds - 1e-9) + 1)))


def starts_of(run: Run, top_speed: float) -> tuple[Start, ...]:
    """Return the ego's lane and speed at the beginning of each gene that the run reached; empty if it left the road.

    The speed [m/s] is at most ``top_speed``, which is the highest start speed of an ego.
    """
    trace = run.trace
    rows = trace.ego[: trace.ticks : round(run.scenario.gene_seconds * trace.physics_hz)]
    if trace.track is not None or (rows[:, LANE] < 0).any():
        return ()  # on a road that is not straight, a later start would be on a different part of the road
    return tuple((int(row[LANE]), float(min(max(round(row[SPEED], 1), 0.0), top_speed))) for row in rows)


def _note(seen: list[bytes], observation: Any) -> None:
    """Add an observation to a list, if it can be compared: the bytes of equal arrays, tuples and mappings are equal."""
    with suppress(Exception):  # A class of the user's own may not be picklable, and the ADS must not notice.
        seen.append(pickle.dumps(observation))
