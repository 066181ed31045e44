"""A clock for hang limits that advances only on a test's request, so that no healthy decision is ever too slow."""

import threading

from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import HangGuard


class StoppedClock:
    """The clock of every guard that is made while the patch lasts.

    It stands still for the thread that watches the guards: that thread would interrupt a second time, at any moment.
    """

    def __init__(self, monkeypatch):
        self.now = 0.0
        watching = hang_guard._WATCHDOG
        clock = lambda: 0.0 if threading.current_thread() is watching._thread else self.now  # noqa: E731
        monkeypatch.setattr(HangGuard.__init__, "__defaults__", (clock,))

    def sleep(self, seconds):
        """Advance the clock and let the guards look: an overdue decision is interrupted."""
        self.now += seconds
        for guard in list(hang_guard._WATCHDOG._guards):
            guard.look()
