"""Simplification after a search: each finding is shrunk, and reference drivers are tried in it.

No finding depends on simplification: each finding is saved and reported before, and the simpler version replaces its
file and report. If a time limit cuts the simplification, a later session continues with the stored answers. Shrinking
then makes the same attempts in the same order, so it has the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import count, islice
from typing import Any, TypeVar

from pytest_pafot.campaign.events import ENDED_OTHERWISE, FindTold, SearchEvent
from pytest_pafot.campaign.harness import Harness, begins_alike, limits_of, refusals
from pytest_pafot.campaign.moments import braked_for, moment_of, text_of
from pytest_pafot.campaign.state import Answer, Shown, State, lose
from pytest_pafot.campaign.store import Store
from pytest_pafot.campaign.verdict import Verdict, headline
from pytest_pafot.campaign.workers import Workers
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import call_apart, runner_for
from pytest_pafot.findings.decisions import (
    HARDER,
    NEEDLESS,
    Answers,
    Moment,
    braking_of,
    counted,
    deciding,
    differ,
    vehicle_of,
    window,
)
from pytest_pafot.findings.failure_rate import (
    ENOUGH,
    FEW_RUNS,
    KNOWN_RUNS,
    MANY_RUNS,
    SURE_ODDS,
    FailureRate,
    with_other_seed,
)
from pytest_pafot.findings.finding import Expect, Perceived, ending, of_failure
from pytest_pafot.findings.neighbours import Breadth, breadth_of
from pytest_pafot.findings.shrink import Likely, OutOfBudget, Shrunk, Start, shrink, sort_key
from pytest_pafot.findings.signature import Failure, Signature
from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import LANE, SPEED, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import DriverError, OutOfTime, RequestError
from pytest_pafot.support.source_files import source_files
from pytest_pafot.support.text import one_line
from pytest_pafot.world import codec
from pytest_pafot.world.driving.ads import is_vehicle_class, wants_env
from pytest_pafot.world.driving.conditions import Conditions
from pytest_pafot.world.driving.perception import Perception, sight_of, without
from pytest_pafot.world.driving.shadow import Aside, Question, beside, repeating
from pytest_pafot.world.guard.failure import is_interruption
from pytest_pafot.world.guard.hang_guard import runs_end_in
from pytest_pafot.world.guard.own_worlds import rollout_of
from pytest_pafot.world.kernel.action import checked_si_action

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


BATCH = 16
"""The number of candidates that an ADS that decides for many runs at once drives in one batch."""

MANY = 1_000_000
"""More lanes than there are, for actions that a run has checked before."""

LATER = 2.0
"""The time by which a simpler candidate may collide later than the simplest failing scenario so far [s].

A candidate that does not fail would else be driven to the end of its scenario. Of 950 candidates that were kept without
this limit, 8 collided later, and all runs together had a third more decisions.
"""

RUNS_TO_CONCLUDE = 3
"""The approximate time for the work after shrinking, except confirmation, as a number of runs.

One run is for the verdict on the shrunk scenario. The others are for reference drivers, which are fast because the ADS
is not called.
"""

RUNS_TO_COMPARE = KNOWN_RUNS + MANY_RUNS
"""The number of runs to conclude that compare rates: of what is simplest, and of that once more for its file."""


@dataclass(slots=True, kw_only=True)
class _Turn:
    """The share of the remaining time in which one finding is shrunk.

    Attributes:
        until: the time at which the share ends [s], or infinity.
        runs_to_compare: the number of runs that compare rates at the end.
        to_conclude: the estimated time of the work after shrinking [s].
        attempts: the number of attempts to shrink so far.
        seconds: the time that the attempts have taken [s].
        is_over: True if shrinking was stopped because no time was left.
    """

    until: float
    runs_to_compare: int = 0
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
            # It is confirmed by two runs. One that another process made in advance took no time here, and an attempt
            # takes many where rates are compared.
            run = confirming / 2 if self.runs_to_compare else max(seconds, confirming / 2)
            self.to_conclude = (RUNS_TO_CONCLUDE + self.runs_to_compare) * run + confirming


@dataclass(slots=True, kw_only=True)
class Simplification:
    """The simplification of the findings of one search.

    Attributes:
        state, workers, store: the parts of the search.
        send: receives the events of what becomes of the findings.
        tell: is called often, with a text on the current work.
        until: the time at which the simplification must end [s], or infinity.
        after_attempt: is called after each attempt to shrink, when its answer is in the state.
        done: the ids of the findings for which no shrinking is left to do.
        examined: the ids of those whose neighbours were run, or had no time left.
        current: the id of the finding that is simplified or examined now.
        runs: the number of attempts to shrink so far in this session, and of runs for rates.
        neighbour_runs: the number of runs of neighbours.
        shrink_decisions: the number of decisions of the ADS to shrink the findings, known as soon as that is done.
        neighbour_decisions: that of neighbours, and of the ADS beside a run, known at the end.
        notes: notes on what could not be found out about findings.
    """

    state: State
    workers: Workers
    store: Store
    send: Callable[[Iterable[SearchEvent]], None]
    tell: Callable[[str], None]
    until: float = math.inf
    after_attempt: Callable[[], None] = lambda: None
    done: set[str] = field(default_factory=set, init=False)
    examined: set[str] = field(default_factory=set, init=False)
    current: str = field(default="", init=False)
    runs: int = field(default=0, init=False)
    neighbour_runs: int = field(default=0, init=False)
    shrink_decisions: int = field(default=0, init=False)
    neighbour_decisions: int = field(default=0, init=False)
    notes: list[str] = field(default_factory=list, init=False)
    # how often a policy that draws random numbers fails in the scenario as found of the finding that is shrunk now
    _known: FailureRate | None = field(default=None, init=False)
    # what the ego did in the failing scenarios of the finding that is shrunk now
    _actions: dict[Scenario, tuple[Any, ...]] = field(default_factory=dict, init=False)

    def run_all(self, way_on: str) -> None:
        """Simplify the findings in the order of discovery, except those that cannot be shrunk.

        These are findings that depend on wall-clock time, are crashes, or are flaky in another way than by chance.

        With a time limit, each finding gets an equal share of the time that is left. Unused time goes to the next
        findings, then to findings that were cut. ``way_on`` says how the user can go on with a finding that stays cut.
        """
        __tracebackhide__ = True
        runner = self.workers.runner
        runner.read_here()  # Candidates are judged by the failure of one finding, which no other process knows.
        before = self.workers.decisions
        with runner:
            try:
                self._shrink_all(way_on)
            finally:
                shrunk = self.workers.decisions
                self.shrink_decisions = shrunk - before
            try:
                for kept in list(self.store.findings.values()) if self._neighbours else ():
                    if kept.is_firm and kept.find.id in self.done:
                        self.current = kept.find.id
                        self._examine(kept)
                        self.examined.add(self.current)
            finally:
                self.neighbour_decisions = self.workers.decisions - shrunk

    @property
    def finished(self) -> set[str]:
        """The ids of the findings for which a later session has nothing left to do."""
        findings = self.store.findings
        unexamined = {
            id_ for id_ in self.done - self.examined if self._neighbours and id_ in findings and findings[id_].is_firm
        }
        return self.done - unexamined

    def _shrink_all(self, way_on: str) -> None:
        __tracebackhide__ = True
        finds, before = [find_id for find_id, kept in self.store.findings.items() if kept.is_firm or kept.is_random], -1
        while finds and self.runs > before:  # After a round without runs there is no time left.
            before, round_ = self.runs, finds
            for number, find_id in enumerate(round_):
                self.current = find_id
                self._have_turn(find_id, sharing=len(round_) - number)
            finds = [find_id for find_id in round_ if find_id not in self.done]
        for kept in [self.store.findings[find_id] for find_id in finds]:
            cut = "not shrunk: out of time" if kept.finding.shrunk is None else "shrunk in part: out of time"
            find = replace(kept.find, unshrunk=f"{kept.find.unshrunk or cut}{way_on}")
            self._report(replace(kept, find=find, is_new=False))

    def _examine(self, kept: FindTold) -> None:
        """Run the neighbours of a finding, and report how many fail in the same way, unless the time ends before.

        No error ends the search here, because a user's world may not expect scenarios other than those of a search.
        """
        __tracebackhide__ = True
        find, told, found = kept.find, "neighbours", kept.run
        try:
            self._check_time()
            with runs_end_in(self.until - self.state.clock()):
                breadth = self._breadth(kept)
                find = replace(find, breadth=breadth)
                if breadth is not None:
                    labelled = replace(kept.finding, neighbours=breadth)
                    kept = self.store.rewritten(kept, labelled)
                self._report(replace(kept, find=find, is_new=False))
                if found is not None:
                    told = "decisions"
                    answers, moment = self._decisions(kept, found)
                    find = replace(find, answers=answers, moment=moment)
                    self._report(replace(kept, find=find, is_new=False))
                    told = "conditions"
                    find = replace(find, moment=self._with_conditions(found, moment))
                    self._report(replace(kept, find=find, is_new=False))
        except OutOfTime:
            self.notes.append(f"no {told} of saved-{find.id}: out of time")
        except Exception as error:
            if is_interruption(error):
                raise
            self.notes.append(f"no {told} of saved-{find.id}: {type(error).__name__}: {one_line(str(error))}")

    def _report(self, told: FindTold) -> None:
        self.send(self.store.report(told))

    def _check_time(self) -> None:
        if self.state.clock() >= self.until:
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

        limits = limits_of(self.workers.harness.world)
        return breadth_of(
            kept.finding.scenario,
            self._neighbours,
            fails=fails,
            limits=limits,
            ahead=self._ahead,
            expect=self._expect,
        )

    def _decisions(self, kept: FindTold, found: Run) -> tuple[Answers | None, Moment | None]:
        """Return how many decisions depend on the vehicle of a failure, and the last that could have avoided it.

        The finding's run is driven again by its recorded actions. Fresh policies decide beside it, with all that the
        policy saw and without a vehicle. Nothing can be hidden from a vehicle class, which reads the road itself, from
        a policy that has the environment, or in a world that is not built in. Nothing is said of a policy that decides
        otherwise when it sees the same.
        """
        harness, expect, trace = self.workers.harness, kept.finding.expect, found.trace
        if is_vehicle_class(harness.ads) or wants_env(harness.ads) or not codec.is_built_in(harness.world):
            return None, None
        moment = None if harness.against is None else self._first_difference(trace)
        npc = vehicle_of(found, expect)
        if npc is None or not trace.actions:
            return None, moment
        number = None if moment is not None else deciding(found, expect)
        question = None if number is None else Question(number=number)
        without_it = self._beside(found, npc, question)
        if without_it is None:
            return None, moment
        whole = self._beside(found, None, question)
        if whole is None or any(differ(action, whole.of(each)) for each, action in enumerate(trace.actions)):
            return None, None
        numbers, since = counted(trace, *window(found, expect))
        answers = Answers(
            npc=npc,
            since=round(since, 3),
            decisions=len(numbers),
            depending=sum(differ(whole.of(each), without_it.of(each)) for each in numbers),
            unseen=bool(whole.seen) and whole.seen[: numbers.stop] == without_it.seen[: numbers.stop],
        )
        if not answers.depending:
            # Another vehicle may mask it: without that one the policy brakes harder, without this one hardest of all.
            braked = max(braking_of(whole.of(each)) for each in numbers)
            for other in [each for each in range(len(found.scenario.npcs)) if each != npc]:
                told = self._beside(found, other, None)
                hardest = max((braking_of(told.of(each)) for each in numbers), default=0.0) if told else 0.0
                if hardest >= braked + HARDER and hardest > answers.masked:
                    answers = replace(answers, masking=other, masked=round(hardest, 3))
        if number is not None:
            decided, begun = number, None if trace.drew else whole.ads

            def ask(instead: Any) -> Aside | None:
                return self._beside(found, None, Question(number=decided, instead=instead, ads=begun))

            sight = sight_of(harness.ads)
            moment = moment_of(trace, npc, number, whole, without_it, ask, sight)
            if moment.hidden == "" and expect.check is None and found.attribution.fault != "entered-lane":
                others = {
                    other: aside
                    for other in range(len(found.scenario.npcs))
                    if other != npc and (aside := self._beside(found, other, question)) is not None
                }
                is_needless = found.attribution.fault in NEEDLESS
                about = braked_for(number, whole, others, ask, is_needless=is_needless)
                if about is not None:
                    moment = moment_of(trace, about, number, whole, others[about], ask, sight)
        return answers, moment

    def _with_conditions(self, found: Run, moment: Moment | None) -> Moment | None:
        """Return a moment with the conditions that a fresh policy evaluates in it, if it decides as the run's did."""
        harness, trace = self.workers.harness, found.trace
        conditions = None if moment is None else Conditions(source_files(harness.ads), harness.root)
        if moment is None or not conditions:
            return moment
        times = [round(tick / trace.physics_hz, 3) for tick in trace.decision_ticks]
        number = times.index(moment.time)
        aside = self._beside(found, None, Question(number=number, conditions=conditions))
        if aside is None or any(differ(each, aside.of(at)) for at, each in enumerate(trace.actions[: number + 1])):
            return moment
        return replace(moment, conditions=tuple(aside.conditions))

    def _first_difference(self, trace: Trace) -> Moment | None:
        """Return the first decision that differs from the one of the reference in the same scenario."""
        workers = self.workers
        harness, record, isolate = workers.harness, workers.record, workers.harness.request.settings.isolate
        self._check_time()
        self.neighbour_runs += 1
        with harness.reference_runner(harness.job(), record, isolate=isolate) or nullcontext() as runner:
            run = None if runner is None else harness.run_reference(runner, trace.scenario)[0]
        record.clear()
        for number, actions in enumerate(zip(trace.actions, () if run is None else run.trace.actions, strict=False)):
            if differ(*actions):
                time = round(trace.decision_ticks[number] / trace.physics_hz, 3)
                own, other = text_of(*actions), text_of(*actions[::-1])
                return Moment(time=time, npc=None, action=own, reference=other)
        return None

    def _beside(self, found: Run, npc: int | None, question: Question | None) -> Aside | None:
        """Drive a finding by its recorded actions, with an NPC hidden from a policy that decides beside the run.

        Returns:
            What the policy decided; None if nothing can be hidden in an observation, such as a picture.
        """
        self._check_time()
        self.tell(f"asking the policy of {found.scenario.id} again")
        self.neighbour_runs += 1
        from pytest_pafot.world.driving.policy import checked_action  # noqa: PLC0415  (it needs highway-env, helps do not)

        harness, record = self.workers.harness, self.workers.record
        space = harness.world.action_space
        check = partial(checked_si_action, lanes=MANY) if space is None else partial(checked_action, space=space)
        # A planner with perfect sight sees everybody.
        aside = Aside(is_noted=space is not None or sight_of(harness.ads) is not None)
        job = replace(harness.job(), ads=beside(harness.ads, found.trace.actions, check, aside, question))
        job = job if npc is None else replace(job, ads=without(job.ads, npc))
        isolate = harness.request.settings.isolate
        try:
            with refusals():
                if isolate:  # the other process notes what is decided in a copy, and no ADS leaves it
                    aside = call_apart(
                        job, found.scenario, lambda *run: (rollout_of(job.world)(*run), replace(aside, ads=None))[1]
                    )
                    return aside
                with runner_for(job, record, isolate=False) as runner:
                    runner.run(found.scenario, afresh=True)
                    return aside
        except RequestError:
            return None
        finally:
            self.workers.counted_decisions += aside.asked  # not by the runner of the search
            record.clear()

    def _have_turn(self, find_id: str, sharing: int) -> None:
        """Simplify a finding in its share of the remaining time; ``sharing`` is the number of equal shares."""
        __tracebackhide__ = True
        now, kept = self.state.clock(), self.store.findings[find_id]
        if now >= self.until:
            return
        try:
            with runs_end_in(self.until - now):
                is_done = self._refine(kept, _Turn(until=now + (self.until - now) / sharing))
        except OutOfTime:  # The finding stays as it was. What is known of shrinking it is among the answers.
            is_done = False
        except ProcessLostError as error:
            self.store.call_flaky(kept, f"the process that ran it again {error.how}")
            self.send(lose(error, self.state, self.workers, self.store))
            is_done = True
        if is_done:
            self.done.add(find_id)

    def _refine(self, kept: FindTold, turn: _Turn) -> bool:
        """Shrink a finding, run the result again, try reference drivers, and report; return True if nothing is left."""
        __tracebackhide__ = True
        found = kept.finding.original or kept.finding.scenario
        # Another thread of this process may have drawn in one run, but hardly in two.
        is_new = kept.is_random and kept.finding.rate is None
        if is_new and (kept.find.is_flaky or self.workers.rerun(kept.finding.scenario).trace.drew):
            first = self._rate(kept, kept.finding.scenario)
            kept = self.store.rewritten(kept, replace(kept.finding, rate=first))
            kept = replace(kept, find=replace(kept.find, rate=kept.finding.on_rate), is_new=False)
            self._report(kept)
        if kept.find.is_flaky and not (kept.finding.rate and kept.finding.rate.failing):
            return True
        turn.runs_to_compare = RUNS_TO_COMPARE if kept.finding.rate else 0
        scenario, shrunk = self._shrunk(kept, found, turn)
        self.runs += turn.attempts
        if turn.is_over and scenario == kept.finding.scenario:
            return False
        run, verdict, differs = self._run_again(scenario, kept)
        before = rate = kept.finding.rate
        if self._known is not None and not differs and scenario not in (found, kept.finding.scenario):
            simplest = self._failing_as_often(kept, self._known, scenario)
            if simplest is None and turn.is_over:
                return False  # Further attempts may lead to a scenario that does; the answers so far are kept.
            if simplest is None:
                differs = f"what is simpler does not fail as often as in {self._known} runs"
            else:
                if simplest != scenario:
                    shrunk = replace(shrunk, is_minimal=False, speeds=())
                    run, verdict, differs = self._run_again(simplest, kept)
                scenario, rate = simplest, self._rate(kept, simplest)
        if differs and len(self.state.answers[kept.find.id]) > turn.attempts:
            self.state.answers[kept.find.id].clear()  # Some are from earlier sessions: the ADS may have changed since.
            return self._refine(kept, _Turn(until=turn.until))
        if differs and scenario != found:
            # The simplified scenario does not repeat, so fall back to the scenario as found, which may be flaky, too.
            scenario, shrunk, turn.is_over = found, Shrunk(rollouts=shrunk.rollouts, is_minimal=False), False
            run, verdict, differs = self._run_again(scenario, kept)
            rate = before
        if differs and not kept.find.is_flaky:
            kept = replace(self.store.call_flaky(kept, differs), is_new=False)
            self._report(kept)
            if kept.is_random:  # the runs that confirmed it were the same by chance
                self.state.answers[kept.find.id].clear()
                return self._refine(kept, _Turn(until=turn.until))
        elif not differs:
            if before is not None and scenario == found != kept.finding.scenario:
                rate = self._rate(kept, found)  # the file's is that of a simpler scenario
            self._conclude(replace(kept, finding=replace(kept.finding, rate=rate)), scenario, shrunk, run, verdict)
        return bool(differs) or not turn.is_over

    def _shrunk(self, kept: FindTold, found: Scenario, turn: _Turn) -> tuple[Scenario, Shrunk]:
        __tracebackhide__ = True
        harness, space = self.workers.harness, self.state.space
        answers = self.state.answers.setdefault(kept.find.id, [])
        rollouts, top_speed = rollouts_for(harness), harness.world.speed_limit
        starts: dict[Scenario, tuple[Start, ...]] = {}
        asked, best = 0, found
        self._actions = {} if kept.run is None else {driven(kept.run): kept.run.trace.actions}

        def answer(ids: tuple[str, ...], doing: str, work: Callable[[], Answer]) -> Answer:
            nonlocal asked
            # Shrinking asks the same questions in the same order, so an earlier session's answers serve as a prefix.
            if asked < len(answers) and answers[asked][0] not in ids:
                del answers[asked:]  # They are from a session with other settings, which made other attempts.
            if asked == len(answers):
                began = self.state.clock()
                turn.check(began)
                self.tell(doing)
                try:
                    with runs_end_in(turn.until - turn.to_conclude - began):
                        _, shown = given = work()
                except OutOfTime:
                    turn.is_over = True
                    raise OutOfBudget from None
                answers.append(given)
                turn.took(self.state.clock() - began, None if shown is None else self._confirming(shown[0]))
                self.after_attempt()
            asked += 1
            return answers[asked - 1]

        def fails(number: int) -> bool:
            other = found if kept.find.is_flaky else with_other_seed(found, number)
            ids = f"{other.id} passes", f"{other.id} fails"
            doing = f"measuring how often {kept.find.id} fails"
            return answer(ids, doing, lambda: (ids[self._fails(other)], None))[0] == ids[True]

        def attempt(candidate: Scenario, *, is_limited: bool = True) -> Scenario | None:
            nonlocal best

            def work() -> Answer:
                most = self._most(kept, best) if is_limited else None
                return candidate.id, self._shown(kept, candidate, top_speed, asked, most)

            number = asked + 1 - (0 if self._known is None else KNOWN_RUNS)
            _, shown = answer((candidate.id,), f"shrinking {kept.find.id}, run {number} of {rollouts}", work)
            if shown is None:
                return None
            scenario, starts[scenario] = shown
            best = min(best, scenario, key=sort_key)
            return scenario

        def expect(candidates: Sequence[Scenario], more: bool) -> None:
            if asked == len(answers):  # What an earlier session has answered is not run again.
                self._expect(candidates, more)

        self._known = None
        try:
            if rollouts and kept.finding.rate is not None:  # As found: else many small losses would add up.
                self._known = FailureRate(failing=sum(map(fails, range(1, KNOWN_RUNS + 1))), runs=KNOWN_RUNS)
                if kept.find.is_flaky and not self._known.failing:
                    rollouts = 0  # Simpler scenarios cannot be compared with it, and none need fail at its seed.
        except OutOfBudget:
            rollouts = 0
        if rollouts == 0:
            return found, Shrunk(rollouts=0, is_minimal=False)
        return shrink(
            found,
            attempt,
            rollouts=rollouts,
            top_speed=top_speed,
            starts=lambda scenario: starts.get(scenario, ()),
            plain=None if space is None else (space.ego_lane, space.ego_speed),  # the default start
            plain_seconds=None if space is None else space.gene_seconds,
            ahead=self._ahead,
            expect=expect,
            likely=self._likely(kept, turn),
            measure=partial(attempt, is_limited=False) if self._ends_in_collision(kept) else None,
        )

    def _did(self, scenario: Scenario) -> tuple[Any, ...]:
        """Return the ego's actions in a failing scenario. If an earlier session has driven it, it is driven again."""
        if scenario not in self._actions:
            self._actions[scenario] = self.workers.rerun(scenario).trace.actions
        return self._actions[scenario]

    def _ends_in_collision(self, kept: FindTold) -> bool:
        """Return whether a finding is a collision that another run with the same decisions of the ADS repeats here."""
        is_sure = not kept.find.is_flaky and kept.finding.rate is None
        is_here = is_sure and codec.is_built_in(self.workers.harness.world)
        trace = None if kept.run is None else kept.run.trace
        return is_here and trace is not None and trace.collision is not None and bool(trace.actions)

    def _most(self, kept: FindTold, best: Scenario) -> int | None:
        """Return the number of decisions before which a simpler candidate must fail; None if it may take any number."""
        if kept.run is None or not self._ends_in_collision(kept):
            return None
        return len(self._did(best)) + round(LATER * kept.run.trace.ads_hz)

    def _likely(self, kept: FindTold, turn: _Turn) -> Likely | None:
        """Return a function that says whether a small scenario is likely to fail, without a decision of the ADS.

        It is likely if an ego that repeats its decisions in a failing scenario collides in the same way. That was so in
        27 of 35 small scenarios that failed, and in 225 of 4,333 that did not. Return None if all small scenarios must
        be run: the finding is no such collision, or the world's ``rollout`` does not accept decisions.
        """
        harness, found = self.workers.harness, self._signature(kept.find.id)
        if not harness.world.is_resumable or not self._ends_in_collision(kept):
            return None
        failure = Failure(kind=found.failure, assertion=found.assertion)
        rollout: Callable[..., Trace] = harness.world.rollout  # which accepts decisions: the world is resumable

        @cache
        def likely(candidate: Scenario, best: Scenario) -> bool:
            try:
                did = self._did(best)
            except OutOfTime:
                turn.is_over = True
                raise OutOfBudget from None
            try:
                trace = rollout(candidate, repeating(did[-1]), decisions=did)
            except ScenarioError:
                return False
            return trace.collision is not None and is_same(of_failure(harness.seen(trace), failure), found)

        return likely

    @property
    def _neighbours(self) -> int:
        """The number of neighbours of each finding to run."""
        return self.workers.harness.request.settings.neighbours

    @property
    def _ahead(self) -> int:
        """The number of runs that are made at the same time: in other processes, or in one batch."""
        workers = self.workers
        return BATCH if workers.runner.decides_for_many else workers.harness.request.settings.workers

    def _expect(self, scenarios: Sequence[Scenario], more: bool) -> None:
        """Let scenarios be run in advance, if they can be run at all, and if more than one is run at the same time."""
        if self._ahead < 2:
            return

        def fits(scenario: Scenario) -> bool:
            with suppress(ScenarioError):
                self.workers.harness.world.check_fits(scenario)
                return scenario not in self.state.fatal
            return False

        self.workers.runner.announce(filter(fits, scenarios), more=more)

    def _confirming(self, scenario: Scenario) -> float:
        """Return the estimated time to confirm a scenario [s], from the slowest confirmation so far."""
        longest_run = self.workers.harness.world.longest_run
        return self.workers.pace * min(scenario.seconds, longest_run)

    def _shown(self, kept: FindTold, candidate: Scenario, top_speed: float, attempt: int, most: int | None) -> Shown:
        """Run a simpler candidate for a finding; return the scenario as driven, with the ego's state at each gene.

        Return None if the candidate does not show the finding's failure. If the policy draws random numbers, it must
        show it about as often, and stays as long as it is, because other runs of it may fail later.
        """
        __tracebackhide__ = True
        known, shows = self._known, partial(self._showing, kept.find.id, candidate, most)
        if known is None or not kept.find.is_flaky:
            run = shows()
            if run is None:
                return None
            shown = driven(run) if known is None else candidate
            self._actions[shown] = run.trace.actions
            if known is None:
                return shown, starts_of(run, top_speed)
            # With other seeds in each attempt: simple scenarios would else be fitted to a few seeds.
            others = self._outcomes(kept, candidate, KNOWN_RUNS + 1 + attempt * FEW_RUNS)
            return (candidate, starts_of(run, top_speed)) if known.is_as_often(others) else None
        failing: list[Run] = []

        def outcomes() -> Iterator[bool]:
            while True:
                run = shows()
                failing.extend([] if run is None else [run])
                yield run is not None

        return (candidate, starts_of(failing[0], top_speed)) if known.is_as_often(outcomes()) else None

    def _outcomes(self, kept: FindTold, scenario: Scenario, first: int = 1) -> Iterator[bool]:
        """Run a scenario with one other seed after another, or again and again, and yield whether each run fails."""
        for number in count(first):
            self.runs += 1
            yield self._fails(scenario if kept.find.is_flaky else with_other_seed(scenario, number))

    def _fails(self, scenario: Scenario) -> bool:
        self._check_time()
        return self.workers.judge(self.workers.run(scenario, afresh=True)).failed

    def _failing_as_often(self, kept: FindTold, known: FailureRate, simplest: Scenario) -> Scenario | None:
        """Return the simplest scenario found on the way to ``simplest`` that fails about as often as the finding.

        Return None if there is none. ``known`` is how often the finding fails.

        Each step of shrinking was chosen by few runs, so among many candidates some were only lucky. The result is
        therefore compared again, in more runs with seeds by which nothing was chosen. If it fails more rarely, steps
        before it are tried at growing distances, and the last distance is bisected.
        """
        answers, steps = self.state.answers[kept.find.id], list[Scenario]()
        for _, shown in answers:
            if shown is not None and (not steps or sort_key(shown[0]) < sort_key(steps[-1])):
                steps.append(shown[0])
        steps = steps[: steps.index(simplest) + 1]  # Later answers are from measuring the speeds at which it fails.
        unused = count(KNOWN_RUNS + 1 + len(answers) * FEW_RUNS, KNOWN_RUNS)  # the first seeds of each
        good, bad, back = -1, len(steps), 1  # -1 is the finding itself
        while good < bad - 1:
            self.tell(f"comparing how often {kept.find.id} fails")
            middle = max(bad - back, 0) if good < 0 else (good + bad) // 2
            try:
                outcomes = self._outcomes(kept, steps[middle], next(unused))
                is_as_often = known.is_as_often(outcomes, KNOWN_RUNS, SURE_ODDS)
            except OutOfTime:
                if good < 0:
                    raise
                break  # What was good so far is simpler than the finding.
            good, bad = (middle, bad) if is_as_often else (good, middle)
            back *= 2
        return None if good < 0 else steps[good]

    def _rate(self, kept: FindTold, scenario: Scenario) -> FailureRate:
        """Return how often a policy that draws random numbers fails in a scenario."""
        self.tell(f"measuring how often {kept.find.id} fails")
        outcomes = self._outcomes(kept, scenario)
        failing, runs = sum(islice(outcomes, FEW_RUNS)), FEW_RUNS
        if failing < ENOUGH:
            failing, runs = failing + sum(islice(outcomes, MANY_RUNS - FEW_RUNS)), MANY_RUNS
        return FailureRate(failing=failing, runs=runs)

    def _showing(self, find_id: str, candidate: Scenario, most: int | None = None) -> Run | None:
        """Run a scenario; return the run if it shows the failure of a finding in fewer than ``most`` decisions."""
        __tracebackhide__ = True
        if candidate in self.state.fatal:
            return None
        try:
            self.workers.harness.world.check_fits(candidate)
            for afresh in (False, True):
                run = self.workers.run(candidate, afresh=afresh, most=most)
                if most is not None and len(run.trace.actions) >= most:  # what ended it is no failure of the ADS
                    self.workers.record.clear()
                    return None
                if not self._shows(find_id, run, self.workers.judge(run, driven(run))):
                    return None
                if self.workers.runner.is_alone:  # A batch may mix up its rows, and a replay runs it alone.
                    break
        except ScenarioError:  # For example, it begins in an outer lane, next to which there are too few cells.
            return None
        except ProcessLostError as error:
            self.send(lose(error, self.state, self.workers, self.store))
            return None
        return run

    def _signature(self, find_id: str) -> Signature:
        return next(signature for signature, id_ in self.state.finds.items() if id_ == find_id)

    def _shows(self, find_id: str, run: Run, verdict: Verdict) -> bool:
        """Return whether a run shows the failure of a finding, and by the same fault, so its name still fits."""
        shown = of_failure(run, verdict.failure) if verdict.failed and verdict.failure is not None else None
        return shown is not None and is_same(shown, self._signature(find_id))

    def _run_again(self, scenario: Scenario, kept: FindTold) -> tuple[Run, Verdict, str]:
        """Run a scenario from scratch; return the run, its verdict, and its difference from the finding, if any."""
        __tracebackhide__ = True
        for _ in range(MANY_RUNS if kept.find.is_flaky else 1):
            run = self.workers.run(scenario, afresh=True)
            verdict = self.workers.judge(run)
            if self._shows(kept.find.id, run, verdict):
                break
        if not self._shows(kept.find.id, run, verdict):
            otherwise = f"{ENDED_OTHERWISE}: {ending(run)}"
            return run, verdict, "the reference failed when it ran again" if verdict.kind == "common" else otherwise
        is_confirmed = kept.find.is_flaky or (scenario == kept.finding.scenario and not kept.find.unshrunk)
        return run, verdict, "" if is_confirmed else self.workers.difference(run)

    def _conclude(self, kept: FindTold, scenario: Scenario, shrunk: Shrunk, run: Run, verdict: Verdict) -> None:
        if verdict.failure is None or verdict.exception is None:
            return
        before, harness = kept.finding, self.workers.harness
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
        find = replace(find, rate=finding.on_rate)
        self._report(
            replace(self.store.rewritten(kept, finding), find=find, exception=exception, run=known, is_new=False)
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
        before, workers = kept.finding.perception, self.workers
        harness, ads = workers.harness, workers.harness.ads
        if before is None or not isinstance(ads, Perception):
            return None
        self.tell(f"trying perfect sight in saved-{kept.find.id}")

        def fails(sight: Sight) -> bool:
            return harness.fails_with(ads.seeing(sight), scenario, workers.record)

        return replace(before, needed=needed_imperfections(before.sight, fails))


def rollouts_for(harness: Harness) -> int:
    """Return the largest number of runs to shrink one finding: as the user set it, or by how fast the ADS is."""
    given = harness.request.settings.shrink_rollouts
    if given is not None:
        return given
    return ROLLOUTS_IN_KERNEL if harness.world.runs_in_kernel(harness.ads) else ROLLOUTS


def is_same(shown: Signature, found: Signature) -> bool:
    """Return whether two failures are the same, by the same fault."""
    return (shown, shown.fault) == (found, found.fault)


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
