"""Neural networks that are no complete agents: torch modules and ONNX files."""

from __future__ import annotations

import copy
import functools
import hashlib
import math
import zipfile
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pytest_pafot.extras.policies.loading import PolicyLoader, argmax, digest_of, library, named, refused
from pytest_pafot.support.errors import BadAction

Array = npt.NDArray[Any]
Network = Callable[[Array], Array]
"""A function that maps observations of shape [runs, ...] to outputs of shape [runs, ...]."""

ONNX_TYPES = {"tensor(double)": np.float64, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
"""The numpy types for types of ONNX inputs; inputs of all other types receive float32."""


@dataclass(frozen=True, kw_only=True)
class NetworkLoader(PolicyLoader):
    """A factory of ADSs that call a network and convert its output to an action.

    Attributes:
        to_action: converts the output for one observation to an action.
    """

    to_action: Callable[[Array], Any]

    @abstractmethod
    def load(self) -> Network:
        """Load the network on the CPU."""

    @abstractmethod
    def described(self) -> str:
        """Describe the file, module or input of the network, for an error message."""

    def __call__(self) -> NetworkAds:
        """Return a new ADS."""
        # The last bits of real-valued outputs depend on how many observations go through a network at once.
        ads = BatchingNetworkAds if self.to_action is argmax else NetworkAds
        return ads(self.loaded, self.to_action)

    def check_world(self, world: Any) -> None:
        """Try a decision on an observation of zeros, in the shape of the environment's observations.

        Nothing is tried in a world without such a shape, because there the number of NPCs decides the shape.
        """
        if world.observation_space is None:
            return
        from pytest_pafot.extending import checked_action  # noqa: PLC0415

        space = world.observation_space
        try:
            checked_action(self()(np.zeros(space.shape, space.dtype)), world.action_space)
        except BadAction as error:
            received = f"{error} by {self.described()} in {named(world)}"
            raise refused(f"actions in {world.action_space}", received, "give to_action=") from None
        except Exception as error:
            received = f"{named(world)}: {type(error).__name__}: {error!s:.300}"
            fix = "give the world the config= and wrappers= of the training"
            raise refused(f"a world for {self.described()}", received, fix) from error


class NetworkAds:
    """An ADS that drives one run with a network.

    Attributes:
        pure: True, because the ADS decides only from the current observation.
    """

    pure = True

    def __init__(self, network: Network, to_action: Callable[[Array], Any]) -> None:
        self._network = network
        self._to_action = to_action

    def __call__(self, observation: Any) -> Any:
        """Return the action for an array, or for the ``array`` of a :class:`pytest_pafot.Observation`."""
        return self._to_action(self._network(np.asarray(getattr(observation, "array", observation))[None])[0])


class BatchingNetworkAds(NetworkAds):
    """An ADS that drives one run with a network, or many runs in lock step."""

    def batch(self, observations: Any) -> list[Any]:
        """Return the action for each observation."""
        return [self._to_action(row) for row in self._network(observations.array)]


@dataclass(frozen=True, kw_only=True)
class TorchPolicy(NetworkLoader):
    """The factory that :func:`pytest_pafot.extras.policies.torch` makes."""

    module: Any

    @functools.cached_property
    def weights_digest(self) -> str:
        """A hash of the file, or of the names and values in the module's ``state_dict``."""
        if isinstance(self.module, Path):
            return digest_of([self.module])
        hashed, as_bytes = hashlib.sha256(), library("torch", "").uint8
        for name, value in self.module.state_dict().items():
            hashed.update(name.encode())
            hashed.update(value.detach().cpu().contiguous().flatten().view(as_bytes).numpy())
        return f"sha256:{hashed.hexdigest()}"

    def load(self) -> Network:
        """Load a copy of the module on the CPU, in evaluation mode."""
        torch = library("torch", "")
        torch.set_num_threads(1)
        module = self._read(torch) if isinstance(self.module, Path) else copy.deepcopy(self.module)
        if not isinstance(module, torch.nn.Module):
            fix = "make the module, load the weights into it, and give the module itself"
            name = type(module).__name__
            article = "an" if name[0].lower() in "aeiou" else "a"  # such as an OrderedDict of weights
            raise refused("a torch.nn.Module", f"{self.described()}, which contains {article} {name}", fix)
        module = module.to("cpu").eval()
        first = next(module.parameters(), None)
        dtype = torch.float32 if first is None else first.dtype

        def network(observations: Array) -> Array:
            with torch.inference_mode():
                put_out = module(torch.from_numpy(np.ascontiguousarray(observations)).to(dtype))
            values: Array = (put_out[0] if isinstance(put_out, (tuple, list)) else put_out).numpy()
            return values

        return network

    def _read(self, torch: Any) -> Any:
        digest_of([self.module])  # raises a clear error for a file that cannot be read
        if zipfile.is_zipfile(self.module):
            with zipfile.ZipFile(self.module) as zipped:
                if any("/code/" in name for name in zipped.namelist()):  # TorchScript, which is not a pickle
                    return torch.jit.load(self.module, map_location="cpu")
        return torch.load(self.module, map_location="cpu", weights_only=False)

    def described(self) -> str:
        """Return the path of the file, or the name of the module's class, for an error message."""
        return str(self.module) if isinstance(self.module, Path) else f"the module {type(self.module).__name__}"


@dataclass(frozen=True, kw_only=True)
class OnnxPolicy(NetworkLoader):
    """The factory that :func:`pytest_pafot.extras.policies.onnx` makes."""

    file: Path

    @functools.cached_property
    def weights_digest(self) -> str:
        """A hash of the file."""
        return digest_of([self.file])

    def load(self) -> OnnxNetwork:
        """Load the file into an onnxruntime session with one thread on the CPU."""
        digest_of([self.file])  # raises a clear error for a file that cannot be read
        onnxruntime = library("onnxruntime", "onnx")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            return OnnxNetwork(onnxruntime.InferenceSession(self.file, options, providers=["CPUExecutionProvider"]))
        except Exception as error:
            received = f"{self.file} ({type(error).__name__}: {error!s:.200})"
            raise refused("an ONNX file that onnxruntime can run", received, "export it again") from error

    def described(self) -> str:
        """Return the path of the file with the shape of its input, for an error message."""
        return f"{self.file} with inputs of shape {self.loaded.shape}"


class OnnxNetwork:
    """An onnxruntime session as a function of observations.

    Attributes:
        shape: shape of the network's first input; a text stands for a variable size.
    """

    def __init__(self, session: Any) -> None:
        first, *_ = session.get_inputs()
        self.shape: list[int | str] = first.shape
        self._session, self._input = session, first.name
        self._dtype = ONNX_TYPES.get(first.type, np.float32)

    def __call__(self, observations: Array) -> Array:
        """Return the first output for each observation; a file exported for single observations runs once for each."""
        if self.shape[:1] == [1] and len(observations) > 1:
            return np.concatenate([self(each[None]) for each in observations])
        sizes = [size for size in self.shape[1:] if isinstance(size, int)]
        if len(sizes) == len(self.shape) - 1 and math.prod(sizes) == observations[0].size:
            observations = observations.reshape(-1, *sizes)  # many networks are exported for flat observations
        values: Array = self._session.run(None, {self._input: observations.astype(self._dtype)})[0]
        return values
