"""A pool of processes for any task: its answers, and its report about processes that do not come back."""

import contextlib
import faulthandler
import gc
import multiprocessing
import os
import pickle
import select
import signal
import stat
import struct
import subprocess
import sys
import time
import warnings
from contextlib import suppress
from pathlib import Path

import pytest

from pytest_pafot.execution import pool as execution_pool
from pytest_pafot.execution.pool import Done, Lost, ProcessLostError, RunItHere, WorkerPool
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="processes are forked on Linux alone"
)

TASKS = list(range(6))


@pytest.fixture
def pool_of():
    """Return a function that makes pools that square numbers after some action; end their processes afterwards."""
    # other tests' idle processes end by themselves
    pools, before = [], multiprocessing.active_children()

    def make(do, size=2, patience=30.0, method="fork", **options):
        def work(number, tell):
            do(number)
            return number * number

        pools.append(WorkerPool(work, size, method=method, patience=patience, **options))
        return pools[-1]

    yield make
    for pool in pools:
        pool.close(at_once=True)
    assert {*multiprocessing.active_children()} <= {*before}


def fetched(pool, tasks=TASKS):
    return [content(pool.fetch(task)) for task in tasks]


def content(answer):
    """Return the result, the death or the error in an answer."""
    match answer:
        case Done(value):
            return value
        case Lost(death):
            return death
        case RunItHere(error):
            return error


@pytest.mark.processes
def test_pool_processes_skip_garbage_collection_of_inherited_objects(pool_of):
    def frozen(number):
        assert gc.get_freeze_count() >= before + len(young)

    before, young = gc.get_freeze_count(), [[] for _ in range(10_000)]
    assert fetched(pool_of(frozen, 1), [3]) == [9]
    assert gc.get_freeze_count() <= before  # some of them are gone by now


@pytest.mark.parametrize(
    "size",
    [pytest.param(1, marks=pytest.mark.processes), 2, pytest.param(5, marks=pytest.mark.processes)],
)
def test_answers_are_fetched_in_any_order(pool_of, tmp_path, size):
    def work(number):
        (tmp_path / f"{os.getpid()}").touch()
        time.sleep(0.01 * (5 - number))

    pool = pool_of(work, size)
    pool.expect(TASKS)
    assert fetched(pool, TASKS[::-1]) == [25, 16, 9, 4, 1, 0]
    pids = {path.name for path in tmp_path.iterdir()}
    assert 1 <= len(pids) <= size
    assert str(os.getpid()) not in pids


@pytest.mark.processes
def test_idle_process_ends_and_is_replaced_on_demand(pool_of):
    pool = pool_of(lambda number: None, 1, idle=0.05)
    assert pool.fetch(2) == Done(4)
    (worker,) = pool._workers
    worker.process.join()
    assert pool.fetch(3) == Done(9)
    assert pool.recovered == []


def test_processes_run_at_the_same_time(pool_of, tmp_path):
    def meet(number):
        (tmp_path / f"{number}").touch()
        while not (tmp_path / f"{1 - number}").exists():
            time.sleep(0.001)

    pool = pool_of(meet)
    pool.expect(TASKS[:2])
    assert fetched(pool, TASKS[:2]) == [0, 1]


@pytest.mark.parametrize("is_stuck", [pytest.param(False, marks=pytest.mark.processes), True])
def test_what_a_process_has_started_ends_with_it(pool_of, is_stuck):
    read, write = os.pipe()

    def start(number):
        subprocess.Popen(["sh", "-c", "sleep 600; :"], pass_fds=[write])
        os.write(write, b".")
        with HangGuard(0.01 if is_stuck else 60.0) as guard:
            guard.decision_starts()
            while True:
                with suppress(AdsHang):
                    time.sleep(0.01)

    pool = pool_of(start, 1, grace=0.01)
    pool.expect([0])
    os.close(write)
    assert os.read(read, 1) == b"."
    if is_stuck:
        assert "ignored the interrupt" in pool.fetch(0).death.end
    pool.close(at_once=True)
    assert select.select([read], [], [], 30.0)[0], "the program holds its end"
    assert os.read(read, 1) == b""
    os.close(read)


class Unreadable:
    """An object that can be pickled, but not unpickled."""

    def __reduce__(self):
        return int, ("four",)


class Unportable(Exception):  # noqa: N818
    """An exception that cannot be unpickled: by default it gets one argument instead of two, and a part fails."""

    def __init__(self, number, noun):
        super().__init__(f"{number} {noun}")
        self.part = Unreadable()


def test_exceptions_and_unsendable_results_are_clear_answers():
    def work(number, tell):
        if number == 1:
            raise LookupError("no such planner")
        if number == 2:
            raise Unportable("four", "arguments")
        if number == 3:
            raise SystemExit("enough")
        if number == 4:
            # as from the keyboard, which reaches only the session
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
        return (lambda: number) if number == 5 else number

    with WorkerPool(work, 1, method="fork", patience=30.0) as pool:
        pool.expect(TASKS)
        first, raised, unportable, leaves, interrupted, unsendable = fetched(pool)
    assert (first, interrupted) == (0, 4)
    assert isinstance(raised, LookupError)
    assert str(raised) == "no such planner"
    assert 'raise LookupError("no such planner")' in raised.__notes__[0]
    assert type(unportable) is type(leaves) is RuntimeError
    assert "Unportable: four arguments" in str(unportable)
    assert "SystemExit: enough" in str(leaves)
    assert "a result that can be sent to the session, received one that cannot be pickled" in str(
        unsendable
    )


def squared(number, tell):
    return number * number


@pytest.mark.processes
def test_an_interrupt_while_a_process_starts_is_for_the_session_alone_too():
    with WorkerPool(squared, 1, method="spawn", patience=60.0) as pool:
        pool.expect([3])
        (process,) = multiprocessing.active_children()
        os.kill(process.pid, signal.SIGINT)
        assert pool.fetch(3) == Done(9)


def test_unfetched_answers_are_forgotten_with_the_next_tasks(pool_of):
    pool = pool_of(lambda number: time.sleep(0.05))
    pool.expect(TASKS[:4])
    pool.expect(TASKS[4:])
    assert fetched(pool, TASKS[4:]) == [16, 25]
    assert list(pool.completed()) == []


def test_a_task_that_is_expected_twice_runs_once(pool_of, tmp_path):
    pool = pool_of(lambda number: (tmp_path / f"{number}-{time.monotonic_ns()}").touch())
    pool.expect([3, 4, 3, 5])
    assert fetched(pool, [3, 4, 5]) == [9, 16, 25]
    pool.close()
    assert len(list(tmp_path.iterdir())) == 3


def test_unexpected_task_runs_before_expected_ones(pool_of, tmp_path):
    def note(number):
        time.sleep(0.05)
        with (tmp_path / "order").open("a") as order:
            order.write(f"{number} ")

    pool = pool_of(note, size=1)
    pool.expect([0, 1])
    assert fetched(pool, [9, 0, 1, 0]) == [81, 0, 1, 0]
    assert (tmp_path / "order").read_text() == "0 9 1 0 "


def test_dying_process_names_its_task_and_others_continue(pool_of):
    def work(number):
        if number == 1:
            faulthandler.disable()
            os.abort()
        if number == 2:
            os._exit(9)
        if number == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.01)

    pool = pool_of(work)
    pool.expect(TASKS)
    answers = fetched(pool)
    assert [(lost.task, lost.end, lost.is_hang) for lost in (answers[1], answers[2], answers[4])] == [
        (1, "was ended by SIGABRT", False), (2, "ended with exit code 9", False), (4, "was ended by SIGKILL", False)
    ]  # fmt: skip
    assert [answers[0], answers[3], answers[5]] == [0, 9, 25]
    assert pool.recovered == []


@pytest.mark.processes
def test_process_that_writes_into_the_pipe_is_ended(pool_of):
    def scribble(number):
        for descriptor in range(3, 256) if number == 3 else ():
            with contextlib.suppress(OSError):
                if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                    os.write(descriptor, b"see here\n")

    pool = pool_of(scribble)
    pool.expect(TASKS)
    answers = fetched(pool)
    assert isinstance(answers[3], ProcessLostError)
    assert answers[3].end.startswith(
        "wrote into the pipe to the session, by a descriptor that it did not open"
    )
    assert [*answers[:3], *answers[4:]] == [0, 1, 4, 16, 25]


def test_an_object_of_others_in_the_pipe_is_no_answer(pool_of):
    def scribble(number):
        said = pickle.dumps(5)
        for descriptor in range(3, 256) if number == 3 else ():
            with contextlib.suppress(OSError):
                if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                    os.write(descriptor, struct.pack("!i", len(said)) + said)

    answer = pool_of(scribble).fetch(3)
    assert isinstance(answer, RunItHere)
    assert isinstance(answer.error, RuntimeError)


@pytest.mark.parametrize("is_killed", [True, False])
def test_task_of_a_dead_process_is_retried_and_alone_if_it_was_killed(pool_of, tmp_path, is_killed):
    """A process that ends by itself does not lack the memory that others use, so these need not wait."""

    def work(number):
        running = tmp_path / f"running-{number}"
        if number == 0 and running.exists():
            (tmp_path / "meanwhile").write_text(
                " ".join(path.name for path in tmp_path.glob("running-*"))
            )
            return
        running.touch()
        if number == 0 and is_killed:
            os.kill(os.getpid(), signal.SIGKILL)
        if number == 0:
            os._exit(1)
        time.sleep(0.3)
        running.unlink()

    pool = pool_of(work)
    pool.expect(TASKS[:4])
    assert pool.fetch(0) == Done(0)
    assert ((tmp_path / "meanwhile").read_text() == "running-0") == is_killed
    assert [lost.task for lost in pool.recovered] == [0]
    assert fetched(pool, TASKS[1:4]) == [1, 4, 9]


@pytest.mark.processes
def test_process_that_dies_between_tasks_is_replaced(pool_of):
    pool = pool_of(lambda number: None, size=1)
    for task in TASKS[:2]:
        pool.expect([task])
        assert pool.fetch(task) == Done(task)
        (process,) = multiprocessing.active_children()
        process.kill()
        process.join()
    assert pool.recovered == []


def test_silent_process_is_killed_as_a_hang(pool_of):
    def work(number):
        if number == 1:  # No signal reaches Python code in this thread.
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR2])
            time.sleep(60)

    pool = pool_of(work)
    pool.expect(TASKS[:3])
    answers = [pool.fetch(0), pool.fetch(2)]
    pool.patience = 0.3  # only now, since a busy machine may delay any answer that long
    lost = pool.fetch(1).death
    assert (lost.is_hang, lost.end) == (True, "did not answer for 0.3 s and was killed")
    assert answers == [Done(0), Done(4)]


def answering(then):
    """Make the process answer signals from now on, and act after each answer."""
    answer = signal.getsignal(signal.SIGUSR2)
    signal.signal(signal.SIGUSR2, lambda *signalled: (answer(*signalled), then()))


@pytest.mark.processes
def test_slow_process_that_answers_signals_is_not_killed(pool_of):
    # advances with each answer, however long that takes on a busy machine
    now = multiprocessing.RawValue("d", 0.0)

    def later():
        now.value += 0.2

    def work(number):
        answering(later)
        while now.value < 1.0:
            time.sleep(0.001)

    pool = pool_of(work, patience=0.3, clock=lambda: now.value)
    pool.expect([3])
    assert pool.fetch(3) == Done(9)


def test_process_is_not_silent_while_nobody_looks(pool_of, tmp_path):
    now, answers = [0.0], []

    def work(number):
        answering(lambda: answers.append(1))
        (tmp_path / "begun").touch()
        while not answers:
            time.sleep(0.001)

    pool = pool_of(work, patience=0.3, clock=lambda: now[0])
    pool.expect([3])
    while not (tmp_path / "begun").exists():
        time.sleep(0.001)
    now[0] = 0.6
    assert pool.fetch(3) == Done(9)


def test_an_exception_kills_those_at_work_at_once(pool_of):
    pool = pool_of(lambda number: time.sleep(600))
    pool.expect(TASKS)
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), pool:
        raise KeyboardInterrupt
    assert time.monotonic() - started < 300
    assert multiprocessing.active_children() == []


def test_closing_pool_does_not_wait_for_unfetched_answers(pool_of):
    with pool_of(lambda number: time.sleep(600), farewell=600.0) as pool:
        pool.expect(TASKS[:2])
        started = time.monotonic()
    assert time.monotonic() - started < 300


@pytest.mark.processes
@pytest.mark.parametrize("at_once", [False, True])
def test_each_process_does_what_it_has_to_before_it_ends(pool_of, at_once):
    """One is in a task that does not return, and the other waits for one."""
    left = []
    pool = pool_of(
        lambda number: time.sleep(600 * number), leave=os.getpid, left=left.append, farewell=600.0
    )
    pool.expect([1, 0])
    pool.fetch(0)
    pids = {worker.pid for worker in pool._workers}
    pool.close(at_once=at_once)
    assert (len(pids), {*left}, len(left)) == (2, pids, 2)


def test_process_that_does_not_end_in_time_is_killed(pool_of):
    pool = pool_of(lambda number: None, leave=lambda: time.sleep(600), farewell=0.2)
    pool.expect([0])
    pool.fetch(0)
    started = time.monotonic()
    pool.close()
    assert time.monotonic() - started < 300


def ignores_exceptions(number):
    while number:
        with suppress(BaseException):
            time.sleep(600)


def test_idle_process_that_is_terminated_does_what_it_has_to(pool_of, tmp_path):
    """Python terminates the processes of a pool that nobody has closed, and waits for their end."""
    pool = pool_of(ignores_exceptions, leave=(tmp_path / "left").touch)
    pool.fetch(0)
    (worker,) = pool._workers
    worker.process.terminate()
    worker.process.join(20.0)
    assert worker.process.exitcode == 0
    assert (tmp_path / "left").exists()


def test_process_whose_task_ignores_exceptions_ends_when_it_is_terminated_again(pool_of):
    pool = pool_of(ignores_exceptions, leave=lambda: None)
    pool.expect([1])
    (worker,) = pool._workers
    while not worker.has_begun:
        time.sleep(0.01)
    for _ in range(2):
        time.sleep(0.2)
        worker.process.terminate()
    worker.process.join(20.0)
    assert worker.process.exitcode == -signal.SIGTERM


def test_process_that_is_terminated_while_it_leaves_ends(pool_of, tmp_path):
    def leave():
        (tmp_path / "leaves").touch()
        time.sleep(600)

    pool = pool_of(ignores_exceptions, leave=leave)
    pool.fetch(0)
    (worker,) = pool._workers
    worker.send(None)
    while not (tmp_path / "leaves").exists():
        time.sleep(0.01)
    worker.process.terminate()
    worker.process.join(20.0)
    assert worker.process.exitcode == -signal.SIGTERM


@pytest.mark.parametrize("is_followed", [False, True])
def test_task_in_which_its_process_is_terminated_is_lost(pool_of, tmp_path, is_followed):
    def work(number):
        (tmp_path / "works").touch()
        time.sleep(600)

    left = []
    pool = pool_of(work, leave=os.getpid, left=left.append)
    (pool.follow if is_followed else lambda task: pool.expect([task]))(1)
    (worker,) = pool._workers
    while not (tmp_path / "works").exists():
        time.sleep(0.01)
    worker.process.terminate()
    task, lost = (pool.messages(waits=True) if is_followed else list(pool.completed()))[0]
    assert (task, lost.death.end, lost.death.pid) == (1, "was ended by SIGTERM", worker.pid)
    assert left == [worker.pid]


@pytest.mark.parametrize("is_followed", [False, True])
def test_task_that_is_sent_to_a_process_that_leaves_is_run_by_another(
    pool_of, tmp_path, is_followed
):
    def leave():
        (tmp_path / "leaves").touch()
        while not (tmp_path / "sent").exists():
            time.sleep(0.01)

    pool = pool_of(lambda number: None, leave=leave)
    pool.fetch(0)
    (worker,) = pool._workers
    worker.process.terminate()
    while not (tmp_path / "leaves").exists():
        time.sleep(0.01)
    (pool.follow if is_followed else lambda task: pool.expect([task]))(3)
    assert worker.task == 3
    (tmp_path / "sent").touch()
    assert (pool.messages(waits=True) if is_followed else [(3, pool.fetch(3))]) == [(3, Done(9))]
    assert pool.recovered == []


def test_interrupt_while_a_pool_is_closed_ends_its_other_processes(pool_of):
    def interrupt(said):
        raise KeyboardInterrupt

    pool = pool_of(ignores_exceptions, leave=os.getpid, left=interrupt)
    pool.expect([0, 1])
    pool.fetch(0)
    workers = [*pool._workers]
    with pytest.raises(KeyboardInterrupt):
        pool.close()
    assert [worker.process.is_alive() for worker in workers] == [False, False]


def test_unneeded_process_ends_by_itself(pool_of, tmp_path):
    def work(number):
        multiprocessing.util.Finalize(None, (tmp_path / "ended").touch, exitpriority=1)

    with pool_of(work) as pool:
        pool.expect([0])
        pool.fetch(0)
    assert (tmp_path / "ended").exists()


def test_pool_tells_which_processes_of_its_processes_have_ended_with_them(pool_of, tmp_path):
    """A process that drives a block has a pool of its own, whose crash records the session must forget."""
    ended, started = [], tmp_path / "started"

    def work(number):
        child = subprocess.Popen(["sleep", "60"])
        started.with_suffix(".new").write_text(str(child.pid))
        started.with_suffix(".new").rename(started)
        child.wait()

    with pool_of(work, ended=ended.append) as pool:
        pool.expect([1])
        while not started.exists():
            time.sleep(0.01)
        pool.close(at_once=True)
    child = int(started.read_text())
    assert child in ended
    assert not Path(f"/proc/{child}/exe").exists()


def test_the_end_of_each_process_is_told(pool_of):
    ended = []
    with pool_of(lambda number: os._exit(1) if number == 1 else None, ended=ended.append) as pool:
        pool.expect([0, 1])
        lost = fetched(pool, [0, 1])[1]
        assert lost.pid in ended
    assert len(ended) == len(set(ended)) == 2


@pytest.mark.processes
def test_processes_end_when_the_session_is_killed(tmp_path):
    def session():
        pool = WorkerPool(write, 2, method="fork", patience=30.0)
        pool.expect([0, 1])
        fetched(pool, [0, 1])
        os.kill(os.getpid(), signal.SIGKILL)

    def write(number, tell):
        (tmp_path / f"{os.getpid()}").touch()
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.001)

    process = multiprocessing.get_context("fork").Process(target=session)
    process.start()
    process.join()
    pids = [int(path.name) for path in tmp_path.iterdir()]
    deadline = time.monotonic() + 60
    while any(is_alive(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert [pid for pid in pids if is_alive(pid)] == []
    assert len(pids) == 2


def is_alive(pid):
    """Return whether a process runs; one whose exit code is not read yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_every_answer_explains_that_no_process_could_start(pool_of, monkeypatch):
    pool = pool_of(lambda number: None)

    def refuse():
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refuse)
    pool.expect(TASKS)
    assert all("temporarily unavailable" in str(answer) for answer in fetched(pool))
    assert "temporarily unavailable" in pool.failure
    monkeypatch.undo()
    assert isinstance(pool.fetch(7), RunItHere), "what was told once should hold"


def test_tasks_complete_as_they_finish(tmp_path):
    def work(task, tell):
        while task == "long" and not (tmp_path / "others are done").exists():
            time.sleep(0.001)
        return task

    done = []
    with WorkerPool(work, 2, method="fork", patience=30.0) as pool:
        pool.expect(["long", "first", "second"])
        for task, answer in pool.completed():
            done.append((task, content(answer)))
            if task == "second":
                (tmp_path / "others are done").touch()
    assert done == [(task, task) for task in ("first", "second", "long")]


def test_completed_does_not_retry_a_task_that_died(pool_of):
    pool = pool_of(lambda number: os._exit(5) if number == 1 else None)
    pool.expect([0, 1, 2])
    answers = dict(pool.completed())
    assert isinstance(answers.pop(1), Lost)
    assert answers == {0: Done(0), 2: Done(4)}


@pytest.mark.processes
def test_starting_processes_next_to_threads_emits_no_warning(pool_of):
    pool = pool_of(lambda number: None, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pool.expect([0])
        assert pool.fetch(0) == Done(0)


@pytest.mark.processes
def test_process_out_of_memory_is_named_others_continue(pool_of):
    def greedy(number):
        if number == 1:
            raise MemoryError
        return number**2

    pool = pool_of(greedy)
    pool.expect(TASKS[:4])
    answers = fetched(pool, TASKS[:4])
    assert isinstance(answers[1], ProcessLostError)
    assert answers[1].end == execution_pool.OUT_OF_MEMORY
    assert [answers[0], *answers[2:]] == [0, 4, 9]
    assert pool.recovered == []
