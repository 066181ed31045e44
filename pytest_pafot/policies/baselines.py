"""Models of Stable-Baselines3 and sb3-contrib, with the wrappers of their training."""

from __future__ import annotations

import functools
import json
import os
import pickle
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pytest_pafot.support import import_late
from pytest_pafot.support.errors import AdsFactoryError, install, plain_whole
from pytest_pafot.support.errors import refused_policy as refused

Array = npt.NDArray[Any]

# A zip does not name its algorithm, so the first of these marks in it decides. A mark is the name of a parameter, or a
# part of the module name of the policy class. DDPG is loaded as TD3, from which it derives.
ALGORITHM_MARKS = {
    "_last_lstm_states": "RecurrentPPO",
    "maskable": "MaskablePPO",
    "cg_max_steps": "TRPO",
    "delta_std_schedule": "ARS",
    "top_quantiles_to_drop_per_net": "TQC",
    "n_quantiles": "QRDQN",
    "crossq": "CrossQ",
    "exploration_fraction": "DQN",
    "target_policy_noise": "TD3",
    "clip_range": "PPO",
    "target_entropy": "SAC",
    "gae_lambda": "A2C",
}

# Replacements for parameters that only training needs. They can be functions of another Python version, or very large.
TRAINING_PARAMETERS = {
    "learning_rate": 0.0,
    "lr_schedule": 0.0,
    "clip_range": 0.0,
    "exploration_schedule": 0.0,
    "buffer_size": 1,
}


# models that stay loaded in a process, so that each run gets its ADS without a delay
MOST_LOADED_MODELS = 8


@dataclass(frozen=True, kw_only=True)
class Sb3Policy:
    """The factory that :func:`pytest_pafot.policies.sb3` makes."""

    file: Path
    vecnormalize: Path | None = None
    frame_stack: int = 1
    algorithm: str | type[Any] | None = None
    deterministic: bool = True

    def __post_init__(self) -> None:
        stacked = plain_whole(self.frame_stack)
        if stacked is None or stacked < 1:
            raise refused(
                "a frame_stack of 1 or more",
                repr(self.frame_stack),
                "use the same number as in training",
            )

    @functools.cached_property
    def loading_hint(self) -> str:
        """A sentence that explains why VecNormalize statistics seem to be missing, or an empty string."""
        if self.vecnormalize is None:
            with suppress(OSError, AdsFactoryError):  # a missing hint must not prevent the run
                return _missing_statistics(self.file)
        return ""

    def preload(self) -> None:
        # forked processes inherit the model and its libraries, which take seconds to load
        _ = self.loaded

    @functools.cached_property
    def loaded(self) -> BaselineModel:
        """The loaded model, which equal factories share."""
        files = [path for path in (self.file, self.vecnormalize) if path is not None]
        return _loaded(self, tuple(map(_changed_at, files)))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "loaded"}

    def load(self) -> BaselineModel:
        _library("torch").set_num_threads(1)
        zipped = _parameters(self.file)
        given = {name: value for name, value in TRAINING_PARAMETERS.items() if name in zipped}
        model = self._class(zipped).load(self.file, device="cpu", custom_objects=given)
        statistics = None
        if self.vecnormalize is not None:
            with self.vecnormalize.open("rb") as file:
                statistics = pickle.load(file)  # noqa: S301  (the user's own file, named in the user's own test)
        return BaselineModel(model, statistics, self.frame_stack, self.deterministic)

    def _class(self, zipped: dict[str, Any]) -> Any:
        name = self.algorithm
        if not name:
            module = str(dict(zipped.get("policy_class", {})).get("__module__", ""))
            marks = {*zipped, *module.split(".")}
            name = next((name for mark, name in ALGORITHM_MARKS.items() if mark in marks), None)
        if name is None:
            raise refused(
                "a zip of a known algorithm",
                str(self.file),
                'name the algorithm, as in algorithm="PPO"',
            )
        if not isinstance(name, str):
            return name
        for library in ("stable_baselines3", "sb3_contrib"):
            found = getattr(_library(library), name, None)
            if found:
                return found
        raise refused(
            "an algorithm of stable_baselines3 or sb3_contrib",
            repr(name),
            "pass the class instead",
        )

    def __call__(self) -> BaselineAds:
        """Return a new ADS that has not received any observations."""
        return BaselineAds(self.loaded)

    def check_world(self, world: Any) -> None:
        """Check that the world's actions and stacked observations fit the model.

        The observations of a user's own simulator are unknown before a run. The run fails if they do not fit.
        """
        model = self.loaded
        if getattr(world, "is_native", False):
            return
        if not model.fits(world.observation_space, world.action_space):
            expected = f"a pafot.World with observations {model.observation_space} and actions {model.action_space}"
            if self.frame_stack > 1:
                expected += f", {self.frame_stack} observations at once"
            raise refused(
                f"{expected}, as in the training of {self.file.name}",
                _describe_world(world),
                "use the env_id, config= and wrappers= of the training, and frame_stack= if frames were stacked",
            )


@functools.lru_cache(maxsize=MOST_LOADED_MODELS)
def _loaded(policy: Sb3Policy, changed_at: tuple[int, ...]) -> BaselineModel:
    return policy.load()  # again if a file has changed, as happens in a notebook


def _changed_at(file: Path) -> int:
    try:
        with file.open("rb") as opened:
            # opening it also shows whether it can be read
            return os.fstat(opened.fileno()).st_mtime_ns
    except OSError as error:
        received = f"{file} ({error.strerror})"
        raise refused("a file that can be read", received, "correct the path") from None


@dataclass(eq=False, repr=False)
class BaselineModel:
    """A loaded model, with the changes that the wrappers of its training made to observations."""

    model: Any
    statistics: Any  # a `VecNormalize` without its environments, or None
    frame_stack: int
    deterministic: bool

    def __post_init__(self) -> None:
        self.observation_space = self.model.observation_space
        self.action_space = self.model.action_space
        # Whether the statistics are for stacked observations.
        self._is_of_stack = (
            self.frame_stack > 1
            and self.statistics is not None
            and self.statistics.observation_space.shape == self.observation_space.shape
        )

    def fits(self, observation_space: Any, action_space: Any) -> bool:
        """Return whether an environment's observations and actions suit the model."""
        own, other = self.observation_space, observation_space
        if type(own) is not type(other) or self.action_space != action_space:
            return False
        if own.shape is None or other.shape is None:  # a space with several parts
            return bool(own == other)
        is_stacked = stacking_axis(other.shape, own.shape, self.frame_stack) is not None
        return is_stacked and (own.dtype == other.dtype or self.statistics is not None)

    def stack(self, frames: Array | None, observation: Any) -> tuple[Array | None, Any]:
        """Return the stacked observations, with a new one added, and the model's input.

        ``frames`` is the previous stack, or None for the first observation.
        """
        if isinstance(observation, dict):
            return None, self._normalised(observation)
        own = np.asarray(observation, dtype=self.observation_space.dtype)
        if not self._is_of_stack:
            own = self._normalised(own)
        if self.frame_stack == 1:
            return None, own
        frames = push_observation(frames, own, self.frame_stack, self.observation_space.shape)
        if self._is_of_stack:
            return frames, self._normalised(frames)
        return frames, frames

    def _normalised(self, observation: Any) -> Any:
        if self.statistics is None:
            return observation
        return self.statistics.normalize_obs(observation)

    def predict(self, seen: Any, state: Any = None, *, is_first: bool = False) -> tuple[Any, Any]:
        """Return the action for an input, and the state of a recurrent model."""
        action, state = self.model.predict(
            seen,
            state=state,
            episode_start=np.array([is_first]),
            deterministic=self.deterministic,
        )
        return action, state


@dataclass(eq=False, repr=False)
class BaselineAds:
    """An ADS that drives one run with a model."""

    _model: BaselineModel
    _frames: Array | None = None
    _state: Any = None
    _is_first: bool = True

    def __call__(self, observation: Any) -> Any:
        """Return the action for the environment."""
        self._frames, seen = self._model.stack(self._frames, observation)
        action, self._state = self._model.predict(seen, self._state, is_first=self._is_first)
        self._is_first = False
        return action


def stacking_axis(one: Sequence[int], stacked: Sequence[int], count: int) -> int | None:
    """Return the axis along which ``count`` arrays of the shape ``one`` form the shape ``stacked``, or None."""
    for axis in range(len(one)):
        shape = [*one]
        shape[axis] *= count
        if shape == [*stacked]:
            return axis
    return None


def push_observation(
    frames: Array | None, observation: Array, count: int, shape: Sequence[int]
) -> Array:
    """Return the last ``count`` observations, stacked to an array of the given shape, with the newest last.

    Raises:
        AdsFactoryError: if ``count`` observations do not fit this shape.
    """
    # `VecFrameStack` of Stable-Baselines3 stacks in this way. Zeros replace missing observations.
    axis = stacking_axis(observation.shape, shape, count)
    if axis is None:
        raise refused(
            f"{count} observations that stack to the shape {shape}",
            f"observations {observation.shape}",
            "use the frame_stack= of the training",
        )
    if frames is None:
        frames = np.zeros(shape, observation.dtype)
    _, older = np.split(frames, [observation.shape[axis]], axis)
    return np.concatenate([older, observation], axis)


def _parameters(file: Path) -> dict[str, Any]:
    # The JSON description of the model in a zip. Nothing is unpickled.
    try:
        with zipfile.ZipFile(file) as zipped:
            parameters: dict[str, Any] = json.loads(zipped.read("data"))
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise refused(
            "a zip that a Stable-Baselines3 model has saved",
            f"{file} ({type(error).__name__}: {error})",
            "save the model again",
        ) from None
    return parameters


def _missing_statistics(file: Path) -> str:
    # No file names the wrappers that were used in training. But `learn` stores in the zip the last observations from
    # before VecNormalize, or None without VecNormalize. Algorithms with a replay buffer always store observations, so
    # for them this is no evidence.
    beside = sorted(file.parent.glob("*.pkl"))
    beside += sorted(file.with_suffix("").glob("*.pkl"))
    found = next(filter(_is_statistics, beside), None)
    zipped = _parameters(file)
    name = "statistics.pkl"
    given = f"vecnormalize={name!r}"
    if found is not None:
        name = found.relative_to(file.parent).as_posix()
        given = f"vecnormalize={str(found)!r}"
    if "buffer_size" not in zipped and zipped.get("_last_original_obs") is not None:
        return (
            f"{file.name} was trained with VecNormalize, as its content shows, but no statistics are given. Unless "
            "only rewards were normalised, the model now receives other numbers than in training. "
            f"Use sb3(..., {given})."
        )
    if found is None:
        return ""
    return (
        f"no statistics of VecNormalize are given for {file.name}, but the file {name} contains some. If the model was "
        f"trained with them, it now receives other numbers than in training. Use sb3(..., {given})."
    )


def _is_statistics(file: Path) -> bool:
    with file.open("rb") as opened:
        # the class name at the start; nothing is unpickled
        return b"vec_normalize" in opened.read(200)


def _library(name: str) -> Any:
    try:
        return import_late(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise
        raise refused(
            f"the package {name}",
            "a Python environment without it",
            f"run `{install('sb3')}`",
        ) from None


def _describe_world(world: Any) -> str:
    name = getattr(world, "env_id", type(world).__name__)
    if world.observation_space is None:
        return f"{name}, whose observations are pafot.Observation and whose actions are in SI units"
    return f"{name} with observations {world.observation_space} and actions {world.action_space}"
