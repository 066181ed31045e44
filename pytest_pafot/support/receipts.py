"""The receipt of a process that drives: a file that says that its command came to its end, and with which exit code.

A policy may end its process, also with the exit code 0, which must not be the verdict on it.
"""

from __future__ import annotations

import signal
from pathlib import Path

NAME = "receipt"
"""The name of the file, in a temporary folder of the process that waits for it."""


def leave_receipt(folder: str, code: int) -> None:
    """Say that the command of this process has ended with an exit code."""
    (Path(folder) / NAME).write_text(str(code), encoding="ascii")


def taken_receipt(folder: str, left: int) -> int | None:
    """Return the exit code of the command of a process, and remove its receipt; None if it left none.

    ``left`` is the exit code of the process. It counts if the command ended well, and the process then did not.
    """
    file = Path(folder) / NAME
    try:
        code = int(file.read_text(encoding="ascii"))
        file.unlink()
    except (OSError, ValueError):
        return None
    return code or ended_with(left)


def ended_with(left: int) -> int:
    """Return the exit code that a shell reports for a process, which is negative for a signal."""
    return left if left >= 0 else 128 - left


def unfinished(code: int) -> str:
    """Return the message about a process that has ended without a receipt."""
    received = f"exit code {code} before that"
    likely = "unless an error above says why, the policy, its factory or its module ends the process, as sys.exit and "
    likely += "os._exit do: let it raise an error"
    if code < 0:
        names = {int(number): number.name for number in signal.Signals}
        received = f"an end by {names.get(-code, f'signal {-code}')}"
        likely = "likely compiled code of the policy crashed: `python -X faulthandler -m pytest_pafot ...` says where"
    if code == -getattr(signal, "SIGKILL", 0):
        likely = "likely the memory ran out, or somebody ended it: free memory, and run the command again"
    return f"expected the process that drives to finish the command, received {received}; {likely}"
