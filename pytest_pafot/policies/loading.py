"""What all loaders share: a policy is loaded once in a process, and known by a hash of what is loaded."""

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
"""Policies that a process keeps loaded, so that each run has its ADS at once."""


@dataclass(frozen=True, kw_only=True)
class PolicyLoader(ABC):
    """An ADS factory whose policy is loaded once in a process; forked ones have it from the process before them."""

    @property
    @abstractmethod
    def weights_digest(self) -> str:
        """``sha256:`` and a hash of what is loaded, for findings; empty where there is nothing to tell it of."""

    @abstractmethod
    def load(self) -> Any:
        """What the ADSs of all runs share."""

    @abstractmethod
    def __call__(self) -> Any:
        """A fresh ADS."""

    @abstractmethod
    def check_world(self, world: Any) -> None:
        """Compare the policy with a world's ``observation_space`` and ``action_space``; Nones where it has none.

        Raises:
            AdsFactoryError: naming both, where they differ.
        """

    def preload(self) -> None:
        """Load it now; libraries take seconds, and processes that are forked from then on have them, too."""
        _ = self.loaded

    @functools.cached_property
    def loaded(self) -> Any:
        """What :meth:`load` gives, also where an equal factory has loaded it."""
        return _loaded(self, self.weights_digest)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "loaded"}


@functools.lru_cache(maxsize=KEPT)
def _loaded(loader: PolicyLoader, digest: str) -> Any:
    """Loaded again where a file has changed, as in a notebook."""
    return loader.load()


def digest_of(files: Iterable[Path]) -> str:
    """One of all files, in their order.

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
    """A module of a library that the user may lack.

    Raises:
        AdsFactoryError: when it is not installed, with the command that installs it.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name.partition(".")[0]:
            raise
        fix = f'pip install "pytest-pafot[{extra}]"' if extra else f"pip install {name}"
        raise refused(f"{name} for this policy", "a Python without it", fix) from None


def argmax(values: Any) -> int:
    """The number of the largest value, the first of equal ones: the action of most networks with whole numbers."""
    return int(values.argmax())


def refused(expected: str, received: str, fix: str) -> AdsFactoryError:
    """The error of a policy that cannot drive."""
    return AdsFactoryError(sentence("ads", expected, received, fix))


def named(world: Any) -> str:
    """A world with its observations and actions, for an error."""
    name = getattr(world, "env_id", type(world).__name__)
    if world.observation_space is None:
        return f"{name}, whose observations are pafot.Observation and whose actions are in SI units"
    return f"{name} with observations {world.observation_space} and actions {world.action_space}"
