"""Policies from files and programs, each as an ADS factory in one line.

A factory is a frozen value that can be pickled. A factory of a file loads its policy once, when a search begins or a
run needs it, on the CPU and with one thread. The library that it needs is imported only then. Before the first run in a
:class:`pytest_pafot.World` it compares the world's observations and actions with those of the policy. A factory of a
program starts it in each process and compares nothing.

Models of Stable-Baselines3 and statistics of VecNormalize are pickles: loading them runs the code that they contain.
They are your own files, named in your own test; no corpus file can name a pickle.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_pafot.policies.baselines import Sb3Policy
    from pytest_pafot.policies.programs import ProgramLoader

__all__ = ["process", "sb3"]

StrPath = str | os.PathLike[str]


def sb3(
    file: StrPath,
    *,
    vecnormalize: StrPath | None = None,
    frame_stack: int = 1,
    algorithm: str | type[Any] | None = None,
    deterministic: bool = True,
) -> Sb3Policy:
    """Make an ADS factory from a saved model of Stable-Baselines3 or sb3-contrib. Needs ``pytest-pafot[sb3]``.

    The ADS drives in a :class:`pytest_pafot.World` that has the observations and actions of the model's training. Its
    decisions are exactly those of ``model.predict``.

    Args:
        file: the zip file of the model's ``save``.
        vecnormalize: the file of ``VecNormalize.save``, if it was trained with VecNormalize, for single or for stacked
            observations.
        frame_stack: number of observations that it sees at once, as stacked by ``VecFrameStack``.
        algorithm: its name, such as ``"PPO"`` or ``"QRDQN"``, or its class; by default derived from the zip file.
        deterministic: True for the action that the model prefers; False for one that it draws at random.
    """
    from pytest_pafot.policies.baselines import Sb3Policy  # noqa: PLC0415  (imports numpy, and a test may never use it)

    statistics = None if vecnormalize is None else Path(vecnormalize).absolute()
    return Sb3Policy(
        file=Path(file).absolute(),
        vecnormalize=statistics,
        frame_stack=frame_stack,
        algorithm=algorithm,
        deterministic=deterministic,
    )


def process(command: Sequence[str], *, keep: bool = True, timeout: float | None = None) -> ProgramLoader:
    """Make an ADS factory from a program, which reads a line of JSON per observation and writes one per decision.

    Each process that simulates starts the program for itself. At the end of a run, the session prints what the program
    wrote to stderr. Programs are not available on Windows.

    Args:
        command: program and arguments, as for ``subprocess``, relative to the folder that pytest runs in.
        keep: True if it continues with the next scenario; False to start it again for each. One that ended, hung or
            gave no readable answer is started again in either case.
        timeout: time to wait for an answer [s], after which it is killed; by default only the world's ``hang_limit``
            ends the wait.
    """
    from pytest_pafot.policies.programs import ProgramLoader  # noqa: PLC0415  (imported only if used)
    from pytest_pafot.support.errors import refused_policy  # noqa: PLC0415

    if isinstance(command, (str, bytes, os.PathLike)) or not command:
        words = command.split() if isinstance(command, str) else [command]
        example = f"write process({words!r})" if command else 'name it, as in process(["./planner"])'
        raise refused_policy("a program and its arguments in a list", repr(command), example)
    return ProgramLoader(command=tuple(command), keep=keep, timeout=timeout)
