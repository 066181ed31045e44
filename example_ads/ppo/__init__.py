"""A PPO policy on meta-actions (idle, lane left, lane right, faster, slower), run by numpy.

Kind (b): it drives in ``pafot.World("highway-v0")`` with that environment's default observation (Kinematics, five
vehicles) and action (DiscreteMetaAction, one decision a second). ``train.py`` in this folder trained its network with
stable-baselines3. Only the actor is stored, as plain arrays in ``actor.npz``, so driving needs neither torch nor
stable-baselines3.

It is not intentionally flawed: in that environment's own traffic it crashed in 1 of 30 episodes. But highway-env's
meta-actions have no speed below 20 m/s, it decides once a second, it does not see a vehicle two lengths or more behind,
and it prefers slowing down to changing lanes. So it hits a vehicle that brakes hard ahead on an otherwise empty road.
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
        """Return the meta-action, 0 to 4, for a Kinematics observation of shape [vehicles, features]."""
        return int(np.argmax(self.logits(observation)))

    def logits(self, observation: npt.NDArray[Shaped]) -> npt.NDArray[np.float32]:
        """Return the unnormalised log-probability of each action, shape [actions]."""
        return self._outputs(observation.ravel())

    def _outputs(self, inputs: npt.NDArray[Shaped]) -> npt.NDArray[np.float32]:
        """Return the network's outputs for one flat observation, or for a row each."""
        *hidden, (last_weights, last_biases) = self._layers
        units = inputs.astype(np.float32)
        for weights, biases in hidden:
            units = np.maximum(units @ weights + biases, np.float32(0))
        return units @ last_weights + last_biases


def read_actor(path: Path = ACTOR) -> Layers:
    """Read the layers from ``train.py``: arrays ``weights_0``, ``biases_0``, ``weights_1`` ... from the input on."""
    with np.load(path, allow_pickle=False) as arrays:
        return tuple((arrays[f"weights_{n}"], arrays[f"biases_{n}"]) for n in range(len(arrays.files) // 2))


def make() -> PpoPolicy:
    """Return a fresh policy with the weights of this package."""
    return PpoPolicy(read_actor())
