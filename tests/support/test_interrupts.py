"""Signals that end a process as Ctrl-C does."""

import os
import signal
import sys
import time

import pytest

from pytest_pafot.support import process
from pytest_pafot.support.process import ENDS, Ended, interrupted_by_signals, postponed, undisturbed

pytestmark = pytest.mark.skipif(os.name == "nt", reason="processes have no signals there")


@pytest.mark.parametrize("number", ENDS)
def test_first_signal_is_an_interrupt_and_others_have_no_effect(number):
    def receive():
        try:
            os.kill(os.getpid(), number)
        finally:
            for each in ENDS:
                os.kill(os.getpid(), each)

    before = [signal.getsignal(each) for each in ENDS]
    with pytest.raises(Ended) as ended, interrupted_by_signals():
        receive()
    assert ended.value.code == 128 + number
    assert isinstance(ended.value, KeyboardInterrupt)
    assert [signal.getsignal(each) for each in ENDS] == before


class Final:
    def __init__(self, number):
        self.number = number

    def __del__(self):
        os.kill(os.getpid(), self.number)


@pytest.mark.parametrize("number", [signal.SIGINT, *ENDS])
def test_interrupt_that_a_finalizer_swallows_comes_again(number):
    def finalize():
        Final(number)
        time.sleep(60)

    hook = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt), interrupted_by_signals():
        finalize()
    assert sys.unraisablehook is hook


def test_what_else_a_finalizer_raises_is_told_as_before(monkeypatch):
    told, final = [], Final(10**6)
    monkeypatch.setattr(sys, "unraisablehook", lambda lost: told.append(lost.exc_type))
    with interrupted_by_signals():
        del final
    assert told == [OSError]


def test_signal_that_is_ignored_or_handled_stays_so():
    received = []
    before = {
        signal.SIGHUP: signal.SIG_IGN,
        signal.SIGTERM: lambda *given: received.append(given[0]),
    }
    first = {number: signal.signal(number, handler) for number, handler in before.items()}
    try:
        with postponed():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        with interrupted_by_signals():
            os.kill(os.getpid(), signal.SIGHUP)
            os.kill(os.getpid(), signal.SIGTERM)
    finally:
        for number, handler in first.items():
            signal.signal(number, handler)
    assert received == [signal.SIGTERM]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_forked_process_ends_by_the_signal_itself():
    with interrupted_by_signals():
        pid = os.fork()
        if not pid:
            try:
                os.kill(os.getpid(), signal.SIGTERM)
            finally:
                os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert status == -signal.SIGTERM


def test_clean_up_is_disturbed_by_no_signal():
    with interrupted_by_signals():
        with undisturbed():
            for number in (signal.SIGINT, *ENDS):
                os.kill(os.getpid(), number)
        with pytest.raises(Ended):
            os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize("number", [signal.SIGINT, *ENDS])
def test_a_postponed_interrupt_comes_at_the_end(number):
    done = []

    def work():
        with postponed():
            os.kill(os.getpid(), number)
            done.append("all")
        done.append("more")

    before = [signal.getsignal(each) for each in (signal.SIGINT, *ENDS)]
    with pytest.raises(KeyboardInterrupt), interrupted_by_signals():
        work()
    assert done == ["all"]
    assert [signal.getsignal(each) for each in (signal.SIGINT, *ENDS)] == before


def test_a_later_interrupt_ends_what_waits_for_ever(monkeypatch):
    monkeypatch.setattr(process, "PATIENCE", 0.0)

    def work():
        with postponed():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        work()


def test_a_signal_ends_a_process_however_soon_it_comes_after_the_fork():
    with interrupted_by_signals():
        for _ in range(30):
            child = os.fork()
            if child == 0:
                time.sleep(5)
                os._exit(0)
            os.kill(child, signal.SIGTERM)
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGTERM
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()).isdisjoint(ENDS)
