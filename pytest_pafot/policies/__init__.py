"""ADS factories for policies that are files or programs.

A factory is a frozen value that can be pickled. Models of Stable-Baselines3 and statistics of VecNormalize are pickles,
so loading a file runs the code that it contains. A corpus file cannot name a pickle.
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
    """Make an ADS factory from a saved model of Stable-Baselines3 or sb3-contrib. Requires ``pytest-pafot[sb3]``.

    The world must have the same observations and actions as the training environment. Decisions are exactly those of
    ``model.predict``.

    Args:
        file: zip file that ``model.save`` wrote.
        vecnormalize: file that ``VecNormalize.save`` wrote, if the model was trained with VecNormalize. Its statistics
            can be for single or stacked observations.
        frame_stack: number of observations that the model receives together, as stacked by ``VecFrameStack``.
        algorithm: name of the algorithm, such as ``"PPO"``, or its class. By default, the zip file determines it.
        deterministic: True for the action that the model prefers, False for a random action from its distribution.
    """
    # The model is loaded on the CPU, with one thread, when a search starts or a run needs it.
    from pytest_pafot.policies.baselines import Sb3Policy  # noqa: PLC0415  (imports numpy, and a test may never use it)

    if vecnormalize is not None:
        vecnormalize = Path(vecnormalize).absolute()
    return Sb3Policy(
        file=Path(file).absolute(),
        vecnormalize=vecnormalize,
        frame_stack=frame_stack,
        algorithm=algorithm,
        deterministic=deterministic,
    )


def process(
    command: Sequence[str], *, keep: bool = True, timeout: float | None = None
) -> ProgramLoader:
    """Make an ADS factory from a program, which reads a line of JSON per observation and writes one per decision.

    Each process that simulates starts its own program. Programs are not available on Windows.

    Args:
        command: program and arguments in a list, as for ``subprocess``, relative to the folder in which pytest runs.
        keep: True to continue with the same program in the next scenario, False to restart it for each one. A program
            that ended, hung or wrote a malformed line is always restarted.
        timeout: time [s] to wait for a line, after which the program is killed. By default, only the world's
            ``hang_limit`` ends the wait.
    """
    from pytest_pafot.policies.programs import ProgramLoader  # noqa: PLC0415  (imported only if used)
    from pytest_pafot.support.errors import refused_policy  # noqa: PLC0415

    if isinstance(command, (str, bytes, os.PathLike)) or not command:
        example = 'name the program, as in process(["./planner"])'
        if command:
            words = command.split() if isinstance(command, str) else [command]
            example = f"write process({words!r})"
        raise refused_policy("a program and its arguments in a list", repr(command), example)
    return ProgramLoader(command=tuple(command), keep=keep, timeout=timeout)
