"""Policies from files, frameworks and programs, each as an ADS factory in one line.

A factory is a frozen value that can be pickled. It loads its policy once, when a search begins or a run needs it, on
the CPU and with one thread, and tells ``weights_digest``, a hash of what it loads, which findings keep. In a
:class:`pytest_pafot.World` it compares observations and actions with those of the policy before the first run. Nothing
is imported before that.

Models of Stable-Baselines3, statistics of VecNormalize and modules of torch that were saved whole are pickles: loading
one runs what it says. They are files of your own that your own test names; no corpus file can name one.
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
    """A model of Stable-Baselines3 or sb3-contrib, as its ``save`` wrote it. Needs ``pytest-pafot[sb3]``.

    Drives in a :class:`pytest_pafot.World` with the observations and actions of its training, and decides there as
    ``model.predict`` does, to the last bit. It decides for many runs at once where its actions are whole numbers and it
    is not recurrent.

    Args:
        file: the zip.
        vecnormalize: the statistics that ``VecNormalize.save`` wrote, where the model was trained behind them; whether
            they are of single observations or of stacked ones is told by their shape.
        frame_stack: observations that it was trained to see at once, as ``VecFrameStack`` stacks them.
        algorithm: such as ``"PPO"``, ``"QRDQN"``, or a class; by default what the zip says.
        deterministic: False for actions drawn at random, with which no run is like the one before.
    """
    from pytest_pafot.policies.baselines import Sb3Policy  # noqa: PLC0415  (numpy, and what a test may never use)

    statistics = None if vecnormalize is None else Path(vecnormalize).absolute()
    return Sb3Policy(
        file=Path(file).absolute(),
        vecnormalize=statistics,
        frame_stack=frame_stack,
        algorithm=algorithm,
        deterministic=deterministic,
    )


def torch(module_or_file: Any, *, to_action: Callable[[Any], Any] | None = None) -> TorchPolicy:
    """A module of torch, given itself or as a file. Needs torch.

    It is called with observations as a tensor of shape [runs, ...] in the type of its parameters, without gradients and
    in its mode for evaluation; of several outputs the first counts. In :class:`pytest_pafot.Highway` an observation is
    its ``array``, of shape [vehicles, 7].

    Args:
        module_or_file: a ``torch.nn.Module``, of which each process drives with a copy, or what ``torch.jit.save`` or
            ``torch.save`` wrote of one.
        to_action: from the output for one observation, an array, to an action; by default the number of the largest,
            and only with that it decides for many runs at once.
    """
    from pytest_pafot.policies.loading import argmax  # noqa: PLC0415  (for those alone who use it)
    from pytest_pafot.policies.networks import TorchPolicy  # noqa: PLC0415

    is_file = isinstance(module_or_file, (str, os.PathLike))
    module = Path(module_or_file).absolute() if is_file else module_or_file
    return TorchPolicy(module=module, to_action=to_action or argmax)


def onnx(file: StrPath, *, to_action: Callable[[Any], Any] | None = None) -> OnnxPolicy:
    """A network in an ONNX file. Needs ``pytest-pafot[onnx]``.

    Its first input gets observations of shape [runs, ...], flat where the file says so, and its first output counts. In
    :class:`pytest_pafot.Highway` an observation is its ``array``, of shape [vehicles, 7].

    Args:
        file: the file.
        to_action: as for :func:`torch`.
    """
    from pytest_pafot.policies.loading import argmax  # noqa: PLC0415  (for those alone who use it)
    from pytest_pafot.policies.networks import OnnxPolicy  # noqa: PLC0415

    return OnnxPolicy(file=Path(file).absolute(), to_action=to_action or argmax)


def process(command: Sequence[str], *, keep: bool = True, timeout: float | None = None) -> ProgramLoader:
    """A planner that is a program: a line of JSON for each observation in, a line with its decision out.

    Each process that simulates has a program of its own. What it writes to its stderr is said by the session at the end
    of the run. Not on Windows.

    Args:
        command: the program and its arguments, as for ``subprocess``, found from the folder that pytest runs in.
        keep: whether it goes on to the next scenario, whose first line has ``reset`` true; False for a program that is
            started for each one. One that ended, failed or hung is started anew in either case.
        timeout: longest wait for an answer [s], after which it is killed; by default only the world's ``hang_limit``
            ends a wait.
    """
    from pytest_pafot.policies.loading import refused  # noqa: PLC0415  (for those alone who use it)
    from pytest_pafot.policies.programs import ProgramLoader  # noqa: PLC0415

    if isinstance(command, (str, bytes, os.PathLike)) or not command:
        example = f"write process([{command!r}])" if command else 'name it, as in process(["./planner"])'
        raise refused("a program and its arguments in a list", repr(command), example)
    return ProgramLoader(command=tuple(command), keep=keep, timeout=timeout)
