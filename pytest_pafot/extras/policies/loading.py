"""The common part of all loaders: a policy is loaded once per process, and a hash of its files names it."""

from __future__ import annotations

import functools
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from pytest_pafot.support.errors import AdsFactoryError, install, sentence

KEPT = 8
"""The largest number of policies that stay loaded in a process, so that each run gets its ADS without a delay."""


@dataclass(frozen=True, kw_only=True)
class PolicyLoader(ABC):
    """An ADS factory whose policy is loaded once in a process; forked processes inherit the loaded policy."""

    @property
    @abstractmethod
    def weights_digest(self) -> str:
        """The text ``sha256:`` with a hash of the policy, for findings; empty if there is nothing to hash."""

    @abstractmethod
    def load(self) -> Any:
        """Load the policy, which the ADSs of all runs share."""

    @abstractmethod
    def __call__(self) -> Any:
        """Return a new ADS."""

    @abstractmethod
    def check_world(self, world: Any) -> None:
        """Check that the policy fits a world's ``observation_space`` and ``action_space``, which may be None.

        Raises:
            AdsFactoryError: if they differ; the message names the spaces of both.
        """

    def preload(self) -> None:
        """Load the policy now, so that processes forked later inherit it and its libraries, which take seconds."""
        _ = self.loaded

    @functools.cached_property
    def loaded(self) -> Any:
        """The result of :meth:`load`, which equal factories share."""
        return _loaded(self, self.weights_digest)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "loaded"}


@functools.lru_cache(maxsize=KEPT)
def _loaded(loader: PolicyLoader, digest: str) -> Any:
    """Load a policy, or return the loaded one; if its files have changed, as happens in a notebook, load it again."""
    return loader.load()


def digest_of(files: Iterable[Path]) -> str:
    """Return one hash over all files, in the given order.

    Raises:
        AdsFactoryError: if a file cannot be read.
    """
    hashed = hashlib.sha256()
    for path in files:
        try:
            with path.open("rb") as file:
                hashed.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise refused("a file that can be read", f"{path} ({error.strerror})", "correct the path") from None
    return f"sha256:{hashed.hexdigest()}"


def library(name: str) -> Any:
    """Import a library that the user may not have installed.

    Raises:
        AdsFactoryError: if the library is not installed; the message has the command that installs it.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise
        raise refused(f"{name} for this policy", "a Python without it", install("sb3")) from None


def refused(expected: str, received: str, fix: str) -> AdsFactoryError:
    """Return the error for a policy that cannot drive; its message has all three arguments."""
    return AdsFactoryError(sentence("ads", expected, received, fix))


def named(world: Any) -> str:
    """Describe a world with its observations and actions, for an error message."""
    name = getattr(world, "env_id", type(world).__name__)
    if world.observation_space is None:
        return f"{name}, whose observations are pafot.Observation and whose actions are in SI units"
    return f"{name} with observations {world.observation_space} and actions {world.action_space}"
