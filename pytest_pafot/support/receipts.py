"""The receipt of a process that drives: an exit code that says that its command came to its end, and with which code.

A policy may end its process, also with the exit code 0, which must not be the verdict on it.
"""

from __future__ import annotations

import signal

RECEIPT = 93
"""The exit code in place of 0. In place of 1 it is 94, and so on. By convention no other program ends with 93."""


def with_receipt(code: int) -> int:
    """Return the exit code of a process whose command has ended with a code, negative for a signal."""
    return RECEIPT + min(code if code >= 0 else 128 - code, 255 - RECEIPT)


def received_code(code: int) -> int | None:
    """Return the code with which the command of a process has ended, or None if the process left no receipt."""
    return code - RECEIPT if RECEIPT <= code <= 255 else None


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
