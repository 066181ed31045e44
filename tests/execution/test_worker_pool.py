"""Processes that run scenarios: what they answer, and what is told of those that do not."""

import faulthandler
import logging
import multiprocessing
import os
import signal
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from pytest_pafot.execution.crash_records import leftovers
from pytest_pafot.execution.prefetch import hired
from pytest_pafot.execution.worker_pool import FAREWELL, Answer, Crew, Errand, Lost
from tests.support.toy_world import Toy, idle, scenario

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

SCENARIOS = [scenario(number) for number in range(6)]


@pytest.fixture
def crew_of(tmp_path):
    """Makes crews whose ADS is a function of the number of the scenario; none of their processes remains."""
    crews = []

    def make(drive, size=2, patience=30.0, method="fork"):
        errand = Errand(world=Toy(), ads=lambda: drive, folder=tmp_path / "flights", owner="test_it.py::test_it")
        crew = Crew(errand, size, method=method, patience=patience)
        crews.append(crew)
        return crew

    yield make
    for crew in crews:
        crew.close(at_once=True)
    assert multiprocessing.active_children() == []
    assert leftovers(tmp_path / "flights") == ()


def numbers(crew, scenarios=SCENARIOS):
    """What each answer is the trace of."""
    return [crew.fetch(each).trace.states[0, 0, 0] for each in scenarios]


@pytest.mark.parametrize("size", [1, 2, 5])
def test_answers_are_fetched_in_any_order_whatever_the_number_of_processes(crew_of, size):
    crew = crew_of(lambda number: time.sleep(0.01 * (5 - number)), size)
    crew.expect(SCENARIOS)
    assert numbers(crew, SCENARIOS[::-1]) == [5, 4, 3, 2, 1, 0]


def test_there_are_no_more_processes_than_asked_for_and_they_are_not_this_one(crew_of, tmp_path):
    crew = crew_of(lambda number: (tmp_path / f"{os.getpid()}").touch())
    crew.expect(SCENARIOS)
    numbers(crew)
    pids = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert 1 <= len(pids) <= 2
    assert str(os.getpid()) not in pids


def test_processes_run_at_the_same_time(crew_of, tmp_path):
    def meet(number):
        (tmp_path / f"{number}").touch()
        while not (tmp_path / f"{1 - number}").exists():
            time.sleep(0.001)

    crew = crew_of(meet)
    crew.expect(SCENARIOS[:2])
    assert numbers(crew, SCENARIOS[:2]) == [0, 1]


def test_traces_come_back_read_only(crew_of):
    crew = crew_of(lambda number: None)
    crew.expect(SCENARIOS)
    states = crew.fetch(SCENARIOS[3]).trace.states
    assert np.array_equal(states, np.full((2, 2, 7), 3.0))
    assert not states.flags.writeable


def test_what_raises_is_left_to_this_process(crew_of):
    def fail(number):
        if number == 1:
            raise SystemExit("no such planner")

    crew = crew_of(fail)
    crew.expect(SCENARIOS)
    assert [crew.fetch(each).trace is None for each in SCENARIOS] == [False, True, False, False, False, False]


def test_what_cannot_be_sent_is_left_to_this_process(crew_of):
    class Local(UserWarning):
        """Of no module, so that it cannot be pickled."""

    crew = crew_of(lambda number: warnings.warn("a warning", Local, stacklevel=1))
    crew.expect(SCENARIOS[:1])
    assert crew.fetch(SCENARIOS[0]).trace is None


def test_an_answer_is_fetched_once_and_only_if_it_was_expected(crew_of):
    crew = crew_of(lambda number: None)
    crew.expect(SCENARIOS[:1])
    assert crew.expects(SCENARIOS[0])
    assert not crew.expects(SCENARIOS[1])
    crew.fetch(SCENARIOS[0])
    with pytest.raises(ValueError, match="expected one that is expected"):
        crew.fetch(SCENARIOS[0])


def test_what_is_not_fetched_is_forgotten_with_the_next_generation(crew_of):
    crew = crew_of(lambda number: time.sleep(0.05))
    crew.expect(SCENARIOS[:4])
    crew.expect(SCENARIOS[4:])
    assert numbers(crew, SCENARIOS[4:]) == [4, 5]
    assert not crew.expects(SCENARIOS[0])


@pytest.mark.parametrize(
    ("die", "how"),
    [
        (lambda: os._exit(9), "ended with exit code 9"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "was ended by SIGKILL"),
        (lambda: (faulthandler.disable(), os.abort()), "was ended by SIGABRT"),
    ],
    ids=["exit", "kill", "abort"],
)
def test_a_process_that_dies_names_its_scenario_and_the_others_are_answered(crew_of, die, how):
    crew = crew_of(lambda number: die() if number == 2 else time.sleep(0.01))
    crew.expect(SCENARIOS)
    answers = [crew.fetch(each) for each in SCENARIOS]
    lost = answers.pop(2)
    assert (lost.scenario, lost.how, lost.is_hang) == (SCENARIOS[2], how, False)
    assert [answer.trace.states[0, 0, 0] for answer in answers] == [0, 1, 3, 4, 5]
    assert crew.recovered == []


def test_a_scenario_in_which_a_process_died_is_tried_once_more_alone(crew_of, tmp_path):
    def work(number):
        running = tmp_path / f"running-{number}"
        if number == 0 and running.exists():
            (tmp_path / "meanwhile").write_text(" ".join(path.name for path in tmp_path.glob("running-*")))
            return
        running.touch()
        if number == 0:
            os._exit(1)
        time.sleep(0.1)
        running.unlink()

    crew = crew_of(work)
    crew.expect(SCENARIOS[:4])
    assert isinstance(crew.fetch(SCENARIOS[0]), Answer)
    assert (tmp_path / "meanwhile").read_text() == "running-0"
    assert [lost.scenario for lost in crew.recovered] == [SCENARIOS[0]]
    assert numbers(crew, SCENARIOS[1:4]) == [1, 2, 3]


def test_every_scenario_that_kills_its_process_is_named(crew_of):
    crew = crew_of(os._exit)
    crew.expect(SCENARIOS)
    assert [crew.fetch(each).how for each in SCENARIOS] == [f"ended with exit code {number}" for number in range(6)]


def test_a_process_that_dies_between_two_scenarios_is_replaced_and_blames_nobody(crew_of):
    crew = crew_of(lambda number: None, size=1)
    for each in SCENARIOS[:2]:
        crew.expect([each])
        assert isinstance(crew.fetch(each), Answer)
        (process,) = multiprocessing.active_children()
        process.kill()
        process.join()
    assert crew.recovered == []


def test_a_process_that_falls_silent_is_killed_and_its_scenario_is_a_hang(crew_of):
    def work(number):
        if number == 1:  # Not a signal in the world reaches Python code in this thread.
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR2])
            time.sleep(60)

    crew = crew_of(work, patience=0.3)
    crew.expect(SCENARIOS[:3])
    answers = [crew.fetch(each) for each in SCENARIOS[:3]]
    assert isinstance(answers[1], Lost)
    assert answers[1].is_hang
    assert answers[1].how == "did not answer for 0.3 s and was killed"
    assert [answers[0].trace is None, answers[2].trace is None] == [False, False]


def test_a_process_that_is_slow_and_answers_signals_lives(crew_of):
    crew = crew_of(lambda number: time.sleep(1.0), patience=0.3)
    crew.expect(SCENARIOS[:1])
    assert crew.fetch(SCENARIOS[0]).trace is not None


def test_a_process_that_is_not_looked_at_for_long_is_not_silent(crew_of):
    crew = crew_of(lambda number: time.sleep(0.7), patience=0.3)
    crew.expect(SCENARIOS[:1])
    time.sleep(0.6)
    assert crew.fetch(SCENARIOS[0]).trace is not None


@pytest.mark.filterwarnings("always")
def test_what_the_ads_says_is_said_again_here(crew_of, capsys, caplog):
    def chat(number):
        print("driving", number)
        print("careful", file=sys.stderr)
        sys.stdout.buffer.write(b"bytes\n")
        logging.getLogger("planner").warning("gap of %d m", number)
        warnings.warn("old interface", DeprecationWarning, stacklevel=1)

    crew = crew_of(chat)
    crew.expect(SCENARIOS[:1])
    echo = crew.fetch(SCENARIOS[0]).echo
    assert capsys.readouterr() == ("", "")
    with pytest.warns(DeprecationWarning, match="old interface") as warned:
        echo.repeat()
    assert warned[0].filename == __file__
    assert capsys.readouterr() == ("driving 0\nbytes\n", "careful\n")
    assert caplog.record_tuples == [("planner", logging.WARNING, "gap of 0 m")]


def test_an_ads_that_closes_a_standard_stream_closes_that_of_nobody_else(crew_of, capsys):
    def close(number):
        print("last words")
        sys.stdout.close()

    crew = crew_of(close)
    crew.expect(SCENARIOS[:1])
    answer = crew.fetch(SCENARIOS[0])
    assert answer.trace is not None
    answer.echo.repeat()
    assert capsys.readouterr().out == "last words\n"


def test_filters_of_warnings_act_in_the_process_that_runs_the_scenario(crew_of):
    def chat(number):
        warnings.warn("old interface", DeprecationWarning, stacklevel=1)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        crew = crew_of(chat)
        crew.expect(SCENARIOS[:1])
        assert crew.fetch(SCENARIOS[0]).echo.warned == []


def test_an_interrupt_from_the_keyboard_is_for_the_session_alone(crew_of):
    def work(number):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)

    crew = crew_of(work)
    crew.expect(SCENARIOS[:2])
    assert numbers(crew, SCENARIOS[:2]) == [0, 1]


def test_closing_kills_those_at_work_at_once_and_leaves_no_record_of_them(crew_of):
    crew = crew_of(lambda number: time.sleep(60))
    crew.expect(SCENARIOS)
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), crew:
        raise KeyboardInterrupt
    assert time.monotonic() - started < 5
    assert multiprocessing.active_children() == []


def test_the_end_of_a_search_does_not_wait_for_runs_that_nobody_asks_for_any_more(crew_of):
    with crew_of(lambda number: time.sleep(60)) as crew:
        crew.expect(SCENARIOS[:2])
        started = time.monotonic()
    assert time.monotonic() - started < FAREWELL


def test_a_process_that_is_not_needed_any_more_ends_by_itself(crew_of, tmp_path):
    def work(number):
        multiprocessing.util.Finalize(None, (tmp_path / "ended").touch, exitpriority=1)

    with crew_of(work) as crew:
        crew.expect(SCENARIOS[:1])
        crew.fetch(SCENARIOS[0])
    assert (tmp_path / "ended").exists()


def test_processes_end_when_the_session_is_killed(tmp_path):
    def session():
        errand = Errand(world=Toy(), ads=lambda: write, folder=tmp_path / "flights", owner="test_it.py::test_it")
        crew = Crew(errand, 2, method="fork", patience=30.0)
        crew.expect(SCENARIOS[:2])
        for each in SCENARIOS[:2]:
            crew.fetch(each)
        os.kill(os.getpid(), signal.SIGKILL)

    def write(number):
        (tmp_path / f"{os.getpid()}").touch()
        while len([path for path in tmp_path.iterdir() if path.is_file()]) < 2:
            time.sleep(0.001)

    process = multiprocessing.get_context("fork").Process(target=session)
    process.start()
    process.join()
    pids = [int(path.name) for path in tmp_path.iterdir() if path.is_file()]
    deadline = time.monotonic() + 5
    while any(is_alive(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert [pid for pid in pids if is_alive(pid)] == []
    assert len(pids) == 2


def is_alive(pid):
    """Whether a process runs: one that nobody has waited for yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_where_no_process_can_be_started_everything_is_left_to_this_one(crew_of, monkeypatch):
    crew = crew_of(lambda number: None)

    def refuse():
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refuse)
    crew.expect(SCENARIOS)
    assert [crew.fetch(each).trace for each in SCENARIOS] == [None] * 6
    assert "temporarily unavailable" in crew.failure
    crew.expect(SCENARIOS)
    assert not crew.expects(SCENARIOS[0])


def test_processes_that_are_not_forked_run_a_factory_that_can_be_pickled(tmp_path):
    errand = Errand(world=Toy(), ads=idle, folder=tmp_path, owner="test_it.py::test_it")
    with hired(errand, 1, "spawn", []) as crew:
        crew.expect(SCENARIOS[:2])
        assert numbers(crew, SCENARIOS[:2]) == [0, 1]
    assert crew.failure == ""


def test_a_factory_that_cannot_be_pickled_where_processes_are_not_forked_is_told(tmp_path):
    notes = []
    errand = Errand(world=Toy(), ads=lambda: print, folder=tmp_path, owner="test_it.py::test_it")
    assert hired(errand, 2, "spawn", notes) is None
    assert "such as a class of a module that can be imported" in notes[0]
