"""A time limit covers the search and the work on its findings; the test's clock advances only with evaluated runs."""

import math
from collections import Counter
from contextlib import contextmanager
from functools import partial
from itertools import cycle
from types import SimpleNamespace

import pytest

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.algorithms.evaluation import Evaluated
from pytest_pafot.execution import runner
from pytest_pafot.execution.pool import Done
from pytest_pafot.execution.runner import CapturedOutput, Timed
from pytest_pafot.findings.shrink import OutOfBudget
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.report import terminal
from pytest_pafot.searches import bench, explore, search, search_session
from pytest_pafot.searches.events import Progress
from pytest_pafot.searches.refine.simplest import Turn
from pytest_pafot.support.errors import OutOfTime, RequestError
from pytest_pafot.world.guard.chance import GENERATORS

NODE_ID = "test_it.py::test_it"
SHORT = {"genes": 2, "gene_seconds": 2, "npcs": 2, "node_id": NODE_ID, "shrink_runs": 15}


@pytest.fixture
def clock(tmp_path, monkeypatch):
    """Return the only clock of searches, which run in a new folder; it advances by a second with each evaluated run."""
    monkeypatch.chdir(tmp_path)
    clock = SimpleNamespace(now=0.0, step=lambda: 1.0)
    for module in (explore, search_session):
        monkeypatch.setattr(module, "monotonic", lambda: clock.now)
    return clock


def searched(clock, holds, corpus="corpus", **options):
    def judged(run):
        clock.now += clock.step()
        holds(run)

    return pafot.explore(constant_speed.make, holds=judged, corpus=corpus, **SHORT | options)


def never_collides(run):
    pafot.check(run.npcs[0].gap, name="keeps off", at_least=0.2)
    assert not run.collision


def fails_in_three_ways(run):
    speed = run.scenario.npcs[0][0].speed
    if speed >= 15:
        assert run.duration < 0
    if speed >= 7:
        assert run.hardest_brake < 0
    assert run.scenario.id == ""


def files(folder):
    return {path.name: path.read_text() for path in sorted(folder.rglob("*.pafot.yaml"))}


def unshrunk(exploration):
    return [find.unshrunk for find in exploration.summary.finds]


def attempts(exploration):
    """Return how many runs were made to simplify each finding; progress is reported before each run."""
    phases = [event.phase.split() for event in exploration.events if isinstance(event, Progress)]
    return Counter(phase[1] for phase in phases if phase[:1] == ["simplifying"])


def test_a_finding_of_a_slow_policy_is_told_before_it_is_confirmed(clock, monkeypatch):
    def confirming(*given):
        confirmed.append(clock.now)
        clock.now += 30
        return bench.Same()

    confirmed = []
    clock.step = lambda: 20.0
    monkeypatch.setattr(bench.Bench, "confirm", confirming)
    result = searched(clock, fails_in_three_ways, runs=4, shrink_runs=0)
    told = {event.id: event for event in result.events if isinstance(event, Seen)}.values()
    phases = {event.phase: event.seconds for event in result.events if isinstance(event, Progress)}
    assert [phases[f"found {each.id}, running it again"] for each in told] == confirmed != []


def test_search_without_findings_leaves_time_to_confirm_one(clock):
    result = searched(clock, lambda run: None, runs=1000, max_time=30)
    assert (result.summary.runs, result.summary.reason) == (26, "--pafot-max-time")


@pytest.mark.parametrize("workers", [1, 4])
def test_time_left_is_true_within_a_factor_of_two_or_not_told(clock, monkeypatch, workers):
    """Also in the beginning, when most failures are new and confirmed, and other processes are hardly in use."""

    class Pool:
        """Processes that run scenarios in the order in which they were announced, on the test's clock."""

        failure = ""

        def __init__(self, job, size):
            self.job, self.size, self.recovered, self.ends, self.free = (
                job,
                size,
                [],
                {},
                [clock.now] * size,
            )

        def add_all(self, scenarios):
            for each in scenarios:
                self.free.sort()
                self.free[0] = self.ends[each] = max(self.free[0], clock.now) + 10

        expect = add_all

        def arrived(self, scenario):
            return None

        def fetch(self, scenario):
            clock.now = max(clock.now, self.ends.pop(scenario))
            trace = GENERATORS.run(self.job.world.rollout, scenario, self.job.policy.factory)
            return Done(Timed(trace, CapturedOutput(), 10.0))

        def close(self, *, at_once=False):
            pass

    def run_here(self, scenario, *given, **options):
        clock.now += 10 if ended else 15  # the first run loads libraries
        return run(self, scenario, *given, **options)

    def confirming(self, *given):
        clock.now += 30
        self.confirm_seconds += 30
        return bench.Same()

    def judged(run):
        ended.append(clock.now)
        fails_in_three_ways(run)

    ended = []
    monkeypatch.setattr(runner, "pool_for", Pool)
    run = runner.Here._run
    monkeypatch.setattr(runner.Here, "_run", run_here)
    monkeypatch.setattr(bench.Bench, "confirm", confirming)
    monkeypatch.setattr(
        search_session, "runner_for", partial(runner.runner_for, clock=lambda: clock.now)
    )
    given = {"runs": 120, "workers": workers, "fitness": lambda trace: 0.0, "shrink_runs": 0}
    result = pafot.explore(constant_speed.make, holds=judged, corpus="corpus", **SHORT | given)
    told = [
        (event.left, ended[-1] - event.seconds)
        for event in result.events
        if isinstance(event, Progress)
    ]
    told = [(left, truth) for left, truth in told if left >= terminal.MINUTE]  # less is not told
    assert len(told) > 5
    assert [pair for pair in told if not pair[1] / 2 <= pair[0] <= pair[1] * 2] == []


def test_search_with_finding_leaves_third_for_shrinking(clock):
    result = searched(clock, fails_in_three_ways, runs=1000, max_time=36)
    assert result.summary.reason == "--pafot-max-time"
    assert result.summary.runs == 21
    assert 0 < result.summary.more_runs["shrink"] < 10
    assert clock.now <= 36


def test_search_with_findings_goes_on_until_these_need_the_rest_of_its_time(clock):
    result = searched(clock, fails_in_three_ways, runs=1000, max_time=600)
    assert len(result.findings) == 3
    to_simplify = 3 * (15 + search.RUNS_TO_CONFIRM + search.RUNS_FOR_MOMENT)  # a run takes a second
    confirming = 3  # each finding is judged a second time
    assert 600 - to_simplify - 3 <= result.summary.runs + confirming <= 600 - to_simplify
    assert not any(unshrunk(result))


def test_finding_in_the_last_third_ends_the_search(clock):
    def fails_late(run):
        assert clock.now < 25

    result = searched(clock, fails_late, runs=1000, max_time=30)
    assert result.summary.runs in (25, 26)


@pytest.mark.parametrize("limit", [5, 30, 65])
def test_several_findings_share_the_remaining_time(clock, limit):
    result = searched(clock, fails_in_three_ways, runs=1000, max_time=limit, shrink_runs=300)
    assert limit - 7 <= clock.now <= limit + 1
    assert all(unshrunk(result)[:2])  # the simplest scenario of the last one is found in seven runs
    shares = attempts(result)
    if limit >= 60:
        assert len(shares) == len(result.findings) == 3
        assert max(shares.values()) - min(shares.values()) <= 5


def test_unused_share_of_time_goes_to_other_findings(clock):
    given = {"runs": 20, "max_time": 110, "shrink_runs": 40, "seed": 1}
    result = searched(clock, fails_in_three_ways, **given)
    assert unshrunk(result) == ["", "", ""]
    # the limit without the search, divided by the findings
    assert max(attempts(result).values()) > 70 / 3
    assert clock.now < 110


def test_unshrunk_finding_says_how_to_continue(clock):
    result = searched(clock, fails_in_three_ways, runs=1000, max_time=3)
    assert set(unshrunk(result)) == {"it was not simplified, because the time ran out"}
    assert any(
        "ended the search before" in note and note.endswith(" and more time")
        for note in result.summary.notes
    )


def test_finding_with_time_limit_is_saved_partly_shrunk(clock, tmp_path):
    result = searched(clock, fails_in_three_ways, runs=1000, max_time=50, shrink_runs=300)
    assert set(unshrunk(result)) == {"it was only partly simplified, because the time ran out"}
    assert all(finding.shrunk.before for finding in result.findings)
    assert len(files(tmp_path / "corpus")) == 3
    last_told = {event.id: event for event in result.events if isinstance(event, Seen)}
    assert all(find.unshrunk and "the time ran out" in find.remark for find in last_told.values())


def test_without_a_limit_no_clock_decides_anything(clock, tmp_path):
    searched(clock, never_collides, "usual", runs=12, gene_seconds=5)
    clock.step = lambda: 1e9 * math.cos(clock.now)  # this clock also runs backwards
    searched(clock, never_collides, "strange", runs=12, gene_seconds=5)
    assert files(tmp_path / "usual") == files(tmp_path / "strange") != {}


def out_of_time(run):
    raise OutOfTime


def test_run_that_is_cut_counts_nowhere(clock):
    def judged(run):
        if clock.now > 5:
            raise OutOfTime

    cut = searched(clock, judged, runs=1000, max_time=1e6)
    assert cut.summary.reason == "--pafot-max-time"
    assert (
        cut.summary.runs
        == len(cut.runs)
        == sum(isinstance(event, Evaluated) for event in cut.events)
        == 5
    )
    clock.now = 0.0
    whole = searched(clock, lambda run: None, runs=5)
    assert [row["scenario"] for row in cut.runs] == [row["scenario"] for row in whole.runs]
    assert cut.summary.reached == whole.summary.reached


@pytest.fixture
def confirming(monkeypatch):
    """Return the confirming runs so far; there is no time for the first three."""
    calls, confirmed = [], bench.Bench._confirmed

    def confirming(*given):
        calls.append(given)
        return bench.NoTime() if len(calls) <= 3 else confirmed(*given)

    monkeypatch.setattr(bench.Bench, "_confirmed", confirming)
    return calls


def test_finding_without_time_to_confirm_is_saved_and_says_so(clock, tmp_path, confirming):
    result = searched(clock, fails_in_three_ways, runs=1000, max_time=2)
    assert set(unshrunk(result)) == {"it was not confirmed, because the time ran out"}
    assert len(files(tmp_path / "corpus")) == len(result.findings) == len(confirming) > 0


def test_unconfirmed_finding_is_confirmed_when_it_is_simplified(clock, confirming):
    result = searched(clock, fails_in_three_ways, runs=12, shrink_runs=0)
    assert unshrunk(result) == ["", "", ""]
    assert len(confirming) == 6


def test_what_was_shrunk_before_a_run_is_cut_is_saved(clock, monkeypatch):
    """Each fourth run takes ten times as long as the others, so that no mean foretells when there is time for it."""
    ends, seconds_of_decisions = [math.inf], cycle((0.2, 0.2, 0.2, 2.0))

    @contextmanager
    def runs_end_in(seconds):
        ends.append(clock.now + seconds)
        yield
        ends.pop()

    def slow():
        seconds = next(seconds_of_decisions)

        def decide(observation):
            clock.now += seconds
            if clock.now > ends[-1]:
                raise OutOfTime
            return 0.0, 0.0

        return decide

    for module in ("search", "bench", "refine.steps", "refine.simplest"):
        monkeypatch.setattr(f"pytest_pafot.searches.{module}.runs_end_in", runs_end_in)
    options = SHORT | {"runs": 1000, "stop_after": 1, "max_time": 174, "shrink_runs": 300}
    result = pafot.explore(slow, holds=fails_in_three_ways, corpus="corpus", **options)
    assert unshrunk(result) == ["it was only partly simplified, because the time ran out"]
    assert result.findings[0].shrunk.before
    assert clock.now <= 176


def test_time_is_kept_for_a_run_that_another_process_made_in_advance():
    turn, desk = (
        Turn(end=100.0, most=math.inf, to_confirm=0),
        SimpleNamespace(budget=bench.Budget()),
    )
    turn.took(0.0, confirming=10.0)
    turn.check(74.0, desk)
    with pytest.raises(OutOfBudget):
        turn.check(75.0, desk)


def test_shrinking_that_is_cut_leaves_the_finding_as_it_was(clock, tmp_path):
    def cut_later(run):
        if clock.now > 40:
            raise OutOfTime
        fails_in_three_ways(run)

    whole = searched(clock, fails_in_three_ways, "whole", runs=20, shrink_runs=300)
    clock.now = 0.0
    result = searched(clock, cut_later, runs=20, max_time=1e6, shrink_runs=300)
    assert [finding.id for finding in result.findings] == [finding.id for finding in whole.findings]
    assert all(find.unshrunk.endswith("the time ran out") for find in result.summary.finds[1:])
    assert len(files(tmp_path / "corpus")) == 3


def test_replays_at_the_beginning_end_with_the_time(clock):
    searched(clock, fails_in_three_ways, runs=20)
    with pytest.raises(
        RequestError, match="expected runs that test the policy, but no scenario was simulated"
    ):
        searched(clock, out_of_time, runs=20, max_time=1e6)
