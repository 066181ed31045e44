"""When runs take place in other processes, and that nobody can tell."""

import numpy as np
import pytest

from pytest_pafot.execution.captured_output import Echo
from pytest_pafot.execution.prefetch import Ahead
from pytest_pafot.execution.worker_pool import Answer, Lost, ProcessLostError
from tests.support.toy_world import scenario, trace_of

SCENARIOS = [scenario(number) for number in range(8)]


class Crew:
    """Answers at once, and remembers what was asked for."""

    def __init__(self, answers=None):
        self.answers = answers or {}
        self.expected, self.fetched, self.closed = [], [], None
        self.failure, self.recovered = "", []

    def expect(self, scenarios):
        self.expected = list(scenarios)

    def expects(self, scenario):
        return scenario in self.expected

    def fetch(self, scenario):
        self.fetched.append(scenario.seed)
        self.expected.remove(scenario)
        return self.answers.get(scenario.seed) or Answer(trace=trace_of(scenario), echo=Echo())

    def close(self, *, at_once):
        self.closed = at_once


class Session:
    """Runs scenarios itself, each of which takes a given time."""

    def __init__(self, seconds):
        self.now, self.seconds, self.ran = 0.0, seconds, []

    def clock(self):
        return self.now

    def run(self, scenario):
        self.now += self.seconds
        self.ran.append(scenario.seed)
        return trace_of(scenario)


def ahead_of(session, crew, size=2, dear=0.01):
    return Ahead(size=size, hire=lambda: crew, dear=dear, clock=session.clock)


def asked(ahead, session, scenarios=SCENARIOS):
    """The numbers of the runs that were given, in order."""
    ahead.foresee(scenarios)
    return [ahead.run(each, session.run).scenario.seed for each in scenarios]


def test_after_some_dear_runs_the_rest_of_the_generation_is_made_elsewhere():
    session, crew = Session(0.02), Crew()
    assert asked(ahead_of(session, crew), session) == list(range(8))
    assert session.ran == [0, 1, 2]
    assert crew.fetched == [3, 4, 5, 6, 7]


def test_the_next_generation_is_made_elsewhere_from_its_beginning():
    session, crew = Session(0.02), Crew()
    ahead = ahead_of(session, crew)
    asked(ahead, session, SCENARIOS[:4])
    asked(ahead, session, SCENARIOS[4:])
    assert crew.fetched == [3, 4, 5, 6, 7]


def test_cheap_runs_stay_here_and_the_note_says_what_a_run_took():
    session = Session(0.005)
    with ahead_of(session, None) as ahead:
        asked(ahead, session)
    assert session.ran == list(range(8))
    assert ahead.notes == ["--pafot-workers=2: not in use, since a run took 5.0 ms, and it pays from 10 ms on"]


def test_the_first_run_does_not_count_since_it_loads_what_the_others_use():
    session, crew = Session(0.005), Crew()
    session.seconds = 1.5
    ahead = ahead_of(session, crew)
    ahead.foresee(SCENARIOS)
    ahead.run(SCENARIOS[0], session.run)
    session.seconds = 0.005
    for each in SCENARIOS[1:]:
        ahead.run(each, session.run)
    assert crew.fetched == []


@pytest.mark.parametrize("dear", [0.0, 0.01, 1.0])
@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_runs_are_the_same_wherever_they_are_made(size, dear):
    session = Session(0.02)
    ahead = ahead_of(session, Crew(), size, dear)
    ahead.foresee(SCENARIOS)
    for each in SCENARIOS:
        assert np.array_equal(ahead.run(each, session.run).states, trace_of(each).states)


def test_one_worker_is_this_process_and_says_nothing():
    session = Session(1.0)
    with Ahead(size=1, hire=lambda: pytest.fail("hired"), clock=session.clock) as ahead:
        asked(ahead, session)
    assert session.ran == list(range(8))
    assert ahead.notes == []


def test_what_was_not_foreseen_runs_here_and_is_not_measured():
    session = Session(1.0)
    ahead = ahead_of(session, None)
    ahead.foresee([])
    for each in SCENARIOS:
        ahead.run(each, session.run)
    assert session.ran == list(range(8))


def test_a_run_that_nobody_else_can_make_is_made_here():
    session, crew = Session(0.02), Crew({4: Answer()})
    assert asked(ahead_of(session, crew), session) == list(range(8))
    assert session.ran == [0, 1, 2, 4]


def test_what_was_said_elsewhere_is_said_here_in_the_order_of_the_scenarios(capsys):
    answers = {n: Answer(trace=trace_of(scenario(n)), echo=Echo(out=f"run {n}\n")) for n in range(3, 8)}
    session = Session(0.02)
    asked(ahead_of(session, Crew(answers)), session)
    assert capsys.readouterr().out == "run 3\nrun 4\nrun 5\nrun 6\nrun 7\n"


def test_a_scenario_whose_process_did_not_come_back_raises():
    lost = Lost(scenario=SCENARIOS[3], pid=7, how="ended with exit code 9")
    session = Session(0.02)
    ahead = ahead_of(session, Crew({3: lost}))
    with pytest.raises(ProcessLostError, match=r"pid 7\) that ran .* ended with exit code 9") as raised:
        asked(ahead, session)
    assert raised.value.lost is lost


def test_where_nobody_can_be_hired_all_runs_are_made_here():
    session = Session(0.02)
    assert asked(ahead_of(session, None), session) == list(range(8))
    assert session.ran == list(range(8))


def test_at_the_end_the_processes_end():
    session, crew = Session(0.02), Crew()
    with ahead_of(session, crew) as ahead:
        asked(ahead, session)
    assert crew.closed is False


def test_at_an_interrupt_the_processes_end_at_once():
    session, crew = Session(0.02), Crew()
    ahead = ahead_of(session, crew)
    asked(ahead, session)
    with pytest.raises(KeyboardInterrupt), ahead:
        raise KeyboardInterrupt
    assert crew.closed is True


def test_after_the_end_runs_are_made_here():
    session, crew = Session(0.02), Crew()
    with ahead_of(session, crew) as ahead:
        asked(ahead, session)
    ahead.run(SCENARIOS[7], session.run)
    assert session.ran == [0, 1, 2, 7]


def test_the_notes_say_what_was_used_and_what_came_back_at_the_second_try():
    session, crew = Session(0.02), Crew()
    crew.recovered = [Lost(scenario=SCENARIOS[3], pid=7, how="was ended by SIGKILL")]
    with ahead_of(session, crew) as ahead:
        asked(ahead, session)
    used, recovered = ahead.notes
    assert used == "--pafot-workers=2: in use after 3 runs of this process"
    assert recovered.startswith("a process (pid 7) was ended by SIGKILL while it ran <Scenario ")
    assert "too little memory for so many workers" in recovered
