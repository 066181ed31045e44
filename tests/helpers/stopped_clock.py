"""Time for hang limits that passes only where a test lets it, so that no healthy decision is ever too slow."""

from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import HangGuard


class StoppedClock:
    """The clock of every guard that is made while the patch lasts."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(HangGuard.__init__, "__defaults__", (lambda: self.now,))

    def sleep(self, seconds):
        """So much time passes, and the decisions under way are looked at: this one is interrupted if it is overdue."""
        self.now += seconds
        for guard in list(hang_guard._WATCHDOG._guards):
            guard.look()
