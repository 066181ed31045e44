"""Neural networks without an agent around them: modules of torch and ONNX files."""

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

from pytest_pafot.policies.loading import PolicyLoader, argmax, digest_of, library, named, refused
from pytest_pafot.support.errors import BadAction

Array = npt.NDArray[Any]
Network = Callable[[Array], Array]
"""From observations, of shape [runs, ...], to what is put out for each, of shape [runs, ...]."""

ONNX_TYPES = {"tensor(double)": np.float64, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
"""Of inputs; all others get float32."""


@dataclass(frozen=True, kw_only=True)
class NetworkLoader(PolicyLoader):
    """A factory of ADSs that ask a network, and make an action of what it puts out.

    Attributes:
        to_action: from the output for one observation to an action.
    """

    to_action: Callable[[Array], Any]

    @abstractmethod
    def load(self) -> Network:
        """The network on the CPU."""

    @abstractmethod
    def told(self) -> str:
        """What the network takes and puts out, for an error."""

    def __call__(self) -> NetworkAds:
        """A fresh ADS."""
        # Of real numbers the last bits depend on how many observations go through a network at once.
        ads = BatchingNetworkAds if self.to_action is argmax else NetworkAds
        return ads(self.loaded, self.to_action)

    def check_world(self, world: Any) -> None:
        """Have it decide on zeros of the shape that an environment shows; a number of NPCs is no fixed shape."""
        if world.observation_space is None:
            return
        from pytest_pafot.world.driving.policy import checked_action  # noqa: PLC0415  (imports highway-env)

        space = world.observation_space
        try:
            checked_action(self()(np.zeros(space.shape, space.dtype)), world.action_space)
        except BadAction as error:
            received = f"{error} by {self.told()} in {named(world)}"
            raise refused(f"actions in {world.action_space}", received, "give to_action=") from None
        except Exception as error:
            received = f"{named(world)}: {type(error).__name__}: {error!s:.300}"
            fix = "give the world the config= and wrappers= of the training"
            raise refused(f"a world for {self.told()}", received, fix) from error


class NetworkAds:
    """Drives one run.

    Attributes:
        pure: that it decides from its observation alone.
    """

    pure = True

    def __init__(self, network: Network, to_action: Callable[[Array], Any]) -> None:
        self._network = network
        self._to_action = to_action

    def __call__(self, observation: Any) -> Any:
        """The action for an observation: an array, or a :class:`pytest_pafot.Observation`, whose ``array`` counts."""
        return self._to_action(self._network(np.asarray(getattr(observation, "array", observation))[None])[0])


class BatchingNetworkAds(NetworkAds):
    """Drives one run, or many in lock step."""

    def batch(self, observations: Any) -> list[Any]:
        """The action for each."""
        return [self._to_action(row) for row in self._network(observations.array)]


@dataclass(frozen=True, kw_only=True)
class TorchPolicy(NetworkLoader):
    """See :func:`pytest_pafot.policies.torch`."""

    module: Any

    @functools.cached_property
    def weights_digest(self) -> str:
        """Of the file; of a module, of the names and values that its ``state_dict`` has."""
        if isinstance(self.module, Path):
            return digest_of([self.module])
        hashed, as_bytes = hashlib.sha256(), library("torch", "").uint8
        for name, value in self.module.state_dict().items():
            hashed.update(name.encode())
            hashed.update(value.detach().cpu().contiguous().flatten().view(as_bytes).numpy())
        return f"sha256:{hashed.hexdigest()}"

    def load(self) -> Network:
        """A copy of the module on the CPU, in its mode for evaluation."""
        torch = library("torch", "")
        torch.set_num_threads(1)
        module = self._read(torch) if isinstance(self.module, Path) else copy.deepcopy(self.module)
        if not isinstance(module, torch.nn.Module):
            fix = "make the module, load the weights into it, and give the module itself"
            raise refused("a torch.nn.Module", f"{self.told()}, which holds a {type(module).__name__}", fix)
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
        digest_of([self.module])  # says what is wrong with a file that cannot be read
        if zipfile.is_zipfile(self.module):
            with zipfile.ZipFile(self.module) as zipped:
                if any("/code/" in name for name in zipped.namelist()):  # of TorchScript, which is no pickle
                    return torch.jit.load(self.module, map_location="cpu")
        return torch.load(self.module, map_location="cpu", weights_only=False)

    def told(self) -> str:
        """The file, or the class of the module."""
        return str(self.module) if isinstance(self.module, Path) else f"the module {type(self.module).__name__}"


@dataclass(frozen=True, kw_only=True)
class OnnxPolicy(NetworkLoader):
    """See :func:`pytest_pafot.policies.onnx`."""

    file: Path

    @functools.cached_property
    def weights_digest(self) -> str:
        """Of the file."""
        return digest_of([self.file])

    def load(self) -> OnnxNetwork:
        """The file in a session of one thread on the CPU."""
        digest_of([self.file])  # says what is wrong with a file that cannot be read
        onnxruntime = library("onnxruntime", "onnx")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            return OnnxNetwork(onnxruntime.InferenceSession(self.file, options, providers=["CPUExecutionProvider"]))
        except Exception as error:
            received = f"{self.file} ({type(error).__name__}: {error!s:.200})"
            raise refused("an ONNX file that onnxruntime can run", received, "export it again") from error

    def told(self) -> str:
        """The file, and the shape that it takes."""
        return f"{self.file} with inputs of shape {self.loaded.shape}"


class OnnxNetwork:
    """A session that is called with observations.

    Attributes:
        shape: of its first input; text for a size that may be any.
    """

    def __init__(self, session: Any) -> None:
        first, *_ = session.get_inputs()
        self.shape: list[int | str] = first.shape
        self._session, self._input = session, first.name
        self._dtype = ONNX_TYPES.get(first.type, np.float32)

    def __call__(self, observations: Array) -> Array:
        """The first output for each; one by one where the file was exported for one at a time."""
        if self.shape[:1] == [1] and len(observations) > 1:
            return np.concatenate([self(each[None]) for each in observations])
        sizes = [size for size in self.shape[1:] if isinstance(size, int)]
        if len(sizes) == len(self.shape) - 1 and math.prod(sizes) == observations[0].size:
            observations = observations.reshape(-1, *sizes)  # such as a flat one, which much is exported for
        values: Array = self._session.run(None, {self._input: observations.astype(self._dtype)})[0]
        return values
