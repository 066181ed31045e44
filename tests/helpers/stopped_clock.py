"""A clock for hang limits that advances only on a test's request, so that no healthy decision is ever too slow."""

import threading

from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import HangGuard


class StoppedClock:
    """The clock of every guard that is made while the patch lasts."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        self.slept = 0.0
        monkeypatch.setattr(HangGuard.__init__, "__defaults__", (self.read,))

    def read(self):
        """Return the time. A sleep is none for the thread that watches, which would interrupt it a second time."""
        is_watching = threading.current_thread() is hang_guard._WATCHDOG._thread
        return self.now if is_watching else self.now + self.slept

    def sleep(self, seconds):
        """Advance the clock and let the guards look: an overdue decision is interrupted."""
        self.slept += seconds
        for guard in list(hang_guard._WATCHDOG.guards):
            guard.look()
