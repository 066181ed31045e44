"""A PPO policy that chooses meta-actions (idle, lane left, lane right, faster, slower) and is computed with numpy.

It drives in ``pafot.World("highway-v0")``, with that environment's default observation (Kinematics, five vehicles) and
action (DiscreteMetaAction, one decision per second). ``train.py`` in this folder trained its network with
stable-baselines3. Only the actor is stored, as numpy arrays in ``actor.npz``, so driving requires neither torch nor
stable-baselines3.

The policy is not intentionally flawed. In the environment's own traffic, it crashed in 1 of 30 episodes. However, it
decides only once per second, cannot choose a speed below 20 m/s, does not see vehicles two lengths or more behind, and
prefers slowing down to changing lanes. It therefore hits a vehicle ahead that brakes hard on an otherwise empty road.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

Shaped = TypeVar("Shaped", np.float32, np.float64)
Layers = tuple[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]], ...]

ACTOR = Path(__file__).with_name("actor.npz")


class PpoPolicy:
    """A policy that takes the most probable action of a feed-forward actor with ReLU units.

    Args:
        layers: weights [inputs, outputs] and biases [outputs] of each layer, float32.
    """

    def __init__(self, layers: Layers) -> None:
        self._layers = layers

    def __call__(self, observation: npt.NDArray[Shaped]) -> int:
        """Return the meta-action, from 0 to 4, for a Kinematics observation of shape [vehicles, features]."""
        return int(np.argmax(self.logits(observation)))

    def logits(self, observation: npt.NDArray[Shaped]) -> npt.NDArray[np.float32]:
        """Return the unnormalised log-probability of each action, shape [actions]."""
        return self._outputs(observation.ravel())

    def _outputs(self, inputs: npt.NDArray[Shaped]) -> npt.NDArray[np.float32]:
        """Return the network's outputs for one flat observation, or for each row of observations."""
        *hidden, (last_weights, last_biases) = self._layers
        units = inputs.astype(np.float32)
        for weights, biases in hidden:
            units = np.maximum(units @ weights + biases, np.float32(0))
        return units @ last_weights + last_biases


def read_actor(path: Path = ACTOR) -> Layers:
    """Read the layers that ``train.py`` has written as ``weights_0``, ``biases_0``, ``weights_1`` and so on."""
    with np.load(path, allow_pickle=False) as arrays:
        return tuple(
            (arrays[f"weights_{n}"], arrays[f"biases_{n}"]) for n in range(len(arrays.files) // 2)
        )


def make() -> PpoPolicy:
    """Return a new policy with the weights in this package."""
    return PpoPolicy(read_actor())
