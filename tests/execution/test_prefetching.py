"""Runs made in advance, in other processes: when that happens, and that the results stay the same."""

import pytest

from pytest_pafot.execution import runner as execution_runner
from pytest_pafot.execution.pool import Done, Lost, ProcessLostError, RunItHere
from pytest_pafot.execution.runner import CapturedOutput, ExecutionError, Job, Timed, runner_for
from pytest_pafot.world.driving.policy import Policy
from tests.helpers.toy_world import scenario, trace_of

SCENARIOS = [scenario(number) for number in range(8)]


class Pool:
    """A pool that answers at once, and remembers its requests."""

    def __init__(self, answers=None, seconds=0.02):
        self.answers, self.seconds = answers or {}, seconds
        self.expected, self.fetched, self.closed = [], [], None
        self.failure, self.recovered = "", []

    def expect(self, scenarios):
        self.expected = list(scenarios)

    def add_all(self, scenarios):
        self.expected += scenarios

    def fetch(self, scenario):
        self.fetched.append(scenario.seed)
        self.expected.remove(scenario)
        made = Timed(trace_of(scenario), CapturedOutput(), self.seconds)
        return self.answers.get(scenario.seed, Done(made))

    def close(self, *, at_once):
        self.expected, self.closed = [], at_once


class World:
    """A world that runs scenarios in this process, each for a given time."""

    def __init__(self, seconds=0.0):
        self.now, self.seconds, self.ran = 0.0, seconds, []

    def clock(self):
        return self.now

    def rollout(self, scenario, ads_factory):
        ads_factory()
        self.now += self.seconds
        self.ran.append(scenario.seed)
        return trace_of(scenario)


@pytest.fixture
def runner_of(tmp_path, monkeypatch):
    """Return a function that makes runners of a world and a pool; without a pool, starting one fails the test."""
    records = []

    def make(world, pool=None, workers=2, ads=object, **options):
        monkeypatch.setattr(
            execution_runner, "pool_for", lambda job, size: pool or pytest.fail("started processes")
        )
        job = Job(world=world, policy=Policy(ads), records=tmp_path, owner="test_it.py::test_it")
        records.append(job.crash_record())
        return runner_for(job, records[-1], workers=workers, clock=world.clock, **options)

    yield make
    for record in records:
        record.close()


def asked(runner, scenarios=SCENARIOS):
    """Return the numbers of the runs, in order."""
    return [made.value.scenario.seed for made in runner.results(scenarios, lambda scenario: False)]


class TestProcesses:
    def test_processes_make_the_generation_after_an_expensive_run(self, runner_of):
        world, pool = World(0.02), Pool()
        assert asked(runner_of(world, pool)) == list(range(8))
        assert world.ran == [0]
        assert pool.fetched == [1, 2, 3, 4, 5, 6, 7]

    def test_processes_make_the_next_generation_from_its_start(self, runner_of):
        world, pool = World(0.02), Pool()
        runner = runner_of(world, pool)
        asked(runner, SCENARIOS[:4])
        asked(runner, SCENARIOS[4:])
        assert pool.fetched == [1, 2, 3, 4, 5, 6, 7]

    def test_cheap_runs_stay_in_process_with_a_note(self, runner_of):
        world = World(0.005)
        with runner_of(world) as runner:
            asked(runner)
        assert world.ran == list(range(8))
        assert runner.notes == [
            "--pafot-workers=2 was not used, because runs took only 5.0 ms. Workers help from 10 ms per run"
        ]

    def test_processes_end_if_only_first_run_was_expensive(self, runner_of):
        world, pool = World(1.5), Pool(seconds=0.005)
        with runner_of(world, pool) as runner:
            made = runner.results(SCENARIOS, lambda scenario: False)
            next(made)
            world.seconds = 0.005
            assert [each.value.scenario for each in made] == SCENARIOS[1:]
        assert (pool.fetched, pool.closed) == ([1, 2], True)
        assert world.ran == [0, 3, 4, 5, 6, 7]
        assert runner.notes == [
            "--pafot-workers=2 was not used, because runs took only 5.0 ms. Workers help from 10 ms per run"
        ]

    def test_processes_start_later_if_runs_become_expensive(self, runner_of):
        world, pool = World(0.005), Pool()
        runner = runner_of(world, pool)
        made = runner.results(SCENARIOS, lambda scenario: False)
        next(made)
        world.seconds = 0.02
        assert [each.value.scenario for each in made] == SCENARIOS[1:]
        assert world.ran == [0, 1]

    def test_one_worker_is_this_process_and_says_nothing(self, runner_of):
        world = World(1.0)
        with runner_of(world, workers=1) as runner:
            asked(runner)
        assert world.ran == list(range(8))
        assert runner.notes == []

    def test_runs_that_nobody_expects_stay_in_this_process_unmeasured(self, runner_of):
        world = World(1.0)
        runner = runner_of(world)
        for each in SCENARIOS:
            runner.once(each)
        assert world.ran == list(range(8))

    def test_another_run_of_a_scenario_is_made_in_this_process(self, runner_of):
        world, pool = World(0.02), Pool()
        runner = runner_of(world, pool)
        asked(runner)
        next(runner.results(SCENARIOS, lambda scenario: False))
        runner.once(SCENARIOS[5])
        assert world.ran == [0, 5]

    @pytest.mark.parametrize("workers", [1, 2])
    def test_scenario_that_turns_out_to_be_needless_is_left_out(self, runner_of, workers):
        world, needless = World(0.02), set()
        made = []
        for each in runner_of(world, Pool(), workers).results(SCENARIOS, needless.__contains__):
            made.append(each.value.scenario.seed)
            needless |= {SCENARIOS[3], SCENARIOS[4]}
        assert made == [0, 1, 2, 5, 6, 7]

    def test_run_impossible_in_other_processes_is_made_here(self, runner_of):
        world, pool = World(0.02), Pool({4: RunItHere(ValueError())})
        assert asked(runner_of(world, pool)) == list(range(8))
        assert world.ran == [0, 4]

    def test_output_of_processes_is_replayed_in_scenario_order(self, runner_of, capsys):
        answers = {
            n: Done(Timed(trace_of(scenario(n)), CapturedOutput(out=f"run {n}\n"), 0.02))
            for n in range(1, 8)
        }
        asked(runner_of(World(0.02), Pool(answers)))
        assert capsys.readouterr().out == "run 1\nrun 2\nrun 3\nrun 4\nrun 5\nrun 6\nrun 7\n"

    def test_lost_process_takes_the_place_of_its_result(self, runner_of):
        lost = ProcessLostError(SCENARIOS[3], pid=7, how="ended with exit code 9")
        made = list(
            runner_of(World(0.02), Pool({3: Lost(lost)})).results(SCENARIOS, lambda scenario: False)
        )
        assert made[3] == Lost(lost)
        assert [each.value.scenario for each in made if each != Lost(lost)] == [
            *SCENARIOS[:3],
            *SCENARIOS[4:],
        ]

    def test_unpicklable_factory_keeps_all_runs_in_process(self, runner_of, monkeypatch):
        def refuse(job, size):
            raise ExecutionError("the factory cannot be pickled")

        world = World(0.02)
        with runner_of(world) as runner:
            monkeypatch.setattr(execution_runner, "pool_for", refuse)
            assert asked(runner) == list(range(8))
        assert world.ran == list(range(8))
        assert runner.notes == ["--pafot-workers is 1: the factory cannot be pickled"]

    def test_they_end_with_the_search(self, runner_of):
        pool = Pool()
        with runner_of(World(0.02), pool) as runner:
            asked(runner)
        assert pool.closed is False

    def test_at_an_interrupt_they_end_at_once(self, runner_of):
        pool = Pool()
        runner = runner_of(World(0.02), pool)
        asked(runner)
        with pytest.raises(KeyboardInterrupt), runner:
            raise KeyboardInterrupt
        assert pool.closed is True

    def test_runs_after_closing_are_made_in_this_process(self, runner_of):
        world = World(0.02)
        with runner_of(world, Pool()) as runner:
            asked(runner)
            runner.expect(SCENARIOS)
        runner.once(SCENARIOS[7])
        assert world.ran == [0, 7]

    def test_notes_mention_used_processes_and_recovered_runs(self, runner_of):
        pool = Pool()
        pool.recovered = [ProcessLostError(SCENARIOS[3], pid=7, how="was ended by SIGKILL")]
        with runner_of(World(0.02), pool) as runner:
            asked(runner)
        used, recovered = runner.notes
        assert used == "--pafot-workers=2: after 1 run in this process, the rest ran in workers"
        assert recovered.startswith(
            "a process (pid 7) was ended by SIGKILL while it ran <Scenario "
        )
        assert "too little memory for so many workers" in recovered
