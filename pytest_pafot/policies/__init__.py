"""Policies from files, frameworks and programs, each as an ADS factory in one line.

A factory is a frozen value that can be pickled. It loads its policy once, when a search begins or a run needs it, on
the CPU and with one thread. It also has a ``weights_digest``, a hash of what it loads, which findings store. In a
:class:`pytest_pafot.World` it compares observations and actions with those of the policy before the first run. Nothing
is imported before that.

Models of Stable-Baselines3, statistics of VecNormalize and modules of torch that were saved whole are pickles: loading
them runs the code in them. They are your own files, named in your own test; no corpus file can name one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_pafot.policies.baselines import Sb3Policy
    from pytest_pafot.policies.networks import OnnxPolicy, TorchPolicy
    from pytest_pafot.policies.programs import ProgramLoader

__all__ = ["onnx", "process", "sb3", "torch"]

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

    The ADS drives in a :class:`pytest_pafot.World` with the observations and actions of its training, and decides there
    exactly as ``model.predict`` does. It decides for many runs at once if its actions are integers and it is not
    recurrent.

    Args:
        file: the zip that ``save`` wrote.
        vecnormalize: the statistics that ``VecNormalize.save`` wrote, if the model was trained behind them; their shape
            shows whether they are for single observations or for stacked ones.
        frame_stack: number of observations that it was trained to see at once, as stacked by ``VecFrameStack``.
        algorithm: such as ``"PPO"``, ``"QRDQN"``, or a class; by default derived from the zip.
        deterministic: False for randomly sampled actions, with which no run can be repeated.
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


def torch(module_or_file: Any, *, to_action: Callable[[Any], Any] | None = None) -> TorchPolicy:
    """Make an ADS factory from a torch module or from a file with one. Needs torch.

    The module is called with observations as a tensor of shape [runs, ...] in the type of its parameters, without
    gradients and in evaluation mode; if it has several outputs, the first counts. In :class:`pytest_pafot.Highway` an
    observation is its ``array``, of shape [vehicles, 7].

    Args:
        module_or_file: a ``torch.nn.Module``, of which each process uses a copy, or a file from ``torch.jit.save`` or
            ``torch.save``.
        to_action: converts the output for one observation, an array, to an action; by default the index of the largest
            value, and only then it decides for many runs at once.
    """
    from pytest_pafot.policies.loading import argmax  # noqa: PLC0415  (imported only if used)
    from pytest_pafot.policies.networks import TorchPolicy  # noqa: PLC0415

    is_file = isinstance(module_or_file, (str, os.PathLike))
    module = Path(module_or_file).absolute() if is_file else module_or_file
    return TorchPolicy(module=module, to_action=to_action or argmax)


def onnx(file: StrPath, *, to_action: Callable[[Any], Any] | None = None) -> OnnxPolicy:
    """Make an ADS factory from a network in an ONNX file. Needs ``pytest-pafot[onnx]``.

    Its first input receives observations of shape [runs, ...], flattened if the file requires that, and its first
    output counts. In :class:`pytest_pafot.Highway` an observation is its ``array``, of shape [vehicles, 7].

    Args:
        file: the file.
        to_action: as for :func:`torch`.
    """
    from pytest_pafot.policies.loading import argmax  # noqa: PLC0415  (imported only if used)
    from pytest_pafot.policies.networks import OnnxPolicy  # noqa: PLC0415

    return OnnxPolicy(file=Path(file).absolute(), to_action=to_action or argmax)


def process(command: Sequence[str], *, keep: bool = True, timeout: float | None = None) -> ProgramLoader:
    """Make an ADS factory from a program, which reads a line of JSON per observation and writes one per decision.

    Each process that simulates starts a separate program. At the end of a run, the session prints what the program
    wrote to stderr. Not available on Windows.

    Args:
        command: the program and its arguments, as for ``subprocess``, relative to the folder that pytest runs in.
        keep: whether it continues with the next scenario, whose first line has ``reset`` true; False starts a new
            program for each one. A program that ended, failed or hung is started again in either case.
        timeout: longest wait for an answer [s], after which the program is killed; by default only the world's
            ``hang_limit`` ends a wait.
    """
    from pytest_pafot.policies.loading import refused  # noqa: PLC0415  (imported only if used)
    from pytest_pafot.policies.programs import ProgramLoader  # noqa: PLC0415

    if isinstance(command, (str, bytes, os.PathLike)) or not command:
        example = f"write process([{command!r}])" if command else 'name it, as in process(["./planner"])'
        raise refused("a program and its arguments in a list", repr(command), example)
    return ProgramLoader(command=tuple(command), keep=keep, timeout=timeout)
