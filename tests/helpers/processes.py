"""Processes that a test starts, and that end with it even if it fails."""

import os
import signal
import subprocess
from contextlib import contextmanager


@contextmanager
def begun(command, **given):
    """Start a process in a session of its own. If it still runs at the end of the context, its group is killed.

    ``subprocess.Popen`` alone would wait for it, without a limit, when a check in the context fails.
    """
    with subprocess.Popen(command, start_new_session=True, **given) as process:
        try:
            yield process
        except BaseException:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            raise
