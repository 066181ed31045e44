"""The common part of all loaders: a policy is loaded once per process, and identified by a hash of what is loaded."""

from __future__ import annotations

import functools
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from pytest_pafot.support.errors import AdsFactoryError, sentence

KEPT = 8
"""The number of policies that stay loaded in a process, so that each run gets its ADS without a delay."""


@dataclass(frozen=True, kw_only=True)
class PolicyLoader(ABC):
    """An ADS factory whose policy is loaded once in a process; forked processes inherit it."""

    @property
    @abstractmethod
    def weights_digest(self) -> str:
        """``sha256:`` and a hash of what is loaded, for findings; empty if there is nothing to hash."""

    @abstractmethod
    def load(self) -> Any:
        """Load what the ADSs of all runs share."""

    @abstractmethod
    def __call__(self) -> Any:
        """Return a new ADS."""

    @abstractmethod
    def check_world(self, world: Any) -> None:
        """Compare the policy with a world's ``observation_space`` and ``action_space``, which are None if it has none.

        Raises:
            AdsFactoryError: if they differ; the message names both.
        """

    def preload(self) -> None:
        """Load it now; libraries take seconds to import, and processes forked after that have them, too."""
        _ = self.loaded

    @functools.cached_property
    def loaded(self) -> Any:
        """The result of :meth:`load`, which equal factories share."""
        return _loaded(self, self.weights_digest)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "loaded"}


@functools.lru_cache(maxsize=KEPT)
def _loaded(loader: PolicyLoader, digest: str) -> Any:
    """Load a policy, again if a file has changed, for example in a notebook."""
    return loader.load()


def digest_of(files: Iterable[Path]) -> str:
    """Return one hash of all files, in their order.

    Raises:
        AdsFactoryError: for a file that cannot be read.
    """
    hashed = hashlib.sha256()
    for path in files:
        try:
            with path.open("rb") as file:
                hashed.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise refused("a file that can be read", f"{path} ({error.strerror})", "correct the path") from None
    return f"sha256:{hashed.hexdigest()}"


def library(name: str, extra: str) -> Any:
    """Import a library that the user may not have installed.

    Raises:
        AdsFactoryError: if it is not installed, with the command that installs it.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise
        fix = f'pip install "pytest-pafot[{extra}]"' if extra else f"pip install {name}"
        raise refused(f"{name} for this policy", "a Python without it", fix) from None


def argmax(values: Any) -> int:
    """Return the index of the largest value, the first of equal ones: the action of most networks."""
    return int(values.argmax())


def refused(expected: str, received: str, fix: str) -> AdsFactoryError:
    """Return the error for a policy that cannot drive."""
    return AdsFactoryError(sentence("ads", expected, received, fix))


def named(world: Any) -> str:
    """Describe a world with its observations and actions, for an error."""
    name = getattr(world, "env_id", type(world).__name__)
    if world.observation_space is None:
        return f"{name}, whose observations are pafot.Observation and whose actions are in SI units"
    return f"{name} with observations {world.observation_space} and actions {world.action_space}"
