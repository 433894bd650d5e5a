"""The trained network in numpy: what one agent computes in a round. No torch is needed to fly.

All arithmetic is float64, so that one agent and thousands at once round their messages alike. Any number of
leading axes: an agent passes (g, STATE), the evaluator (B, n, g, STATE).
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import models
from procs.assigner.window import FEATURES

__all__ = ["SLOTS", "STATE", "TRAINING_SEEDS", "Network", "block_of", "load", "network"]

Floats = NDArray[np.float64]

TRAINING_SEEDS = (0, 1, 2)  # a network of each ships; 0 is the default
STATE = 32  # features an (agent, goal)
SLOTS = 3  # numbers a goal to each side and round
NORM_EPSILON = 1e-5  # torch's
LARGEST = 60_000.0  # of a float16


@dataclass(frozen=True)
class Network:
    """Weights by name, as tools/train/assigner/training.py writes them; every matrix is (in, out)."""

    weights: dict[str, Floats]

    def start(self, seen: Floats) -> Floats:
        """The state before any message: seen (..., g, FEATURES) -> (..., g, STATE)."""
        return np.asarray(np.maximum(self._linear("start", seen), 0.0))

    def round(self, number: int, n_rounds: int, state: Floats, given: Floats) -> Floats:
        """The state after round `number` (1 first) of n_rounds: given (..., g, FEATURES + what was heard)."""
        block = f"rounds.{block_of(number, n_rounds)}"
        read = np.maximum(self._linear(f"{block}.read", np.concatenate([state, given], axis=-1)), 0.0)
        pools = np.concatenate([read.max(axis=-2), read.sum(axis=-2) / read.shape[-2]], axis=-1)
        pooled = self._linear(f"{block}.pooled", pools)
        mixed = np.maximum(self._linear(f"{block}.mix", read) + pooled[..., None, :], 0.0)
        new = state + self._linear(f"{block}.write", mixed)
        new = new - new.sum(axis=-1, keepdims=True) / STATE
        variance = (new * new).sum(axis=-1, keepdims=True) / STATE
        scale, shift = self.weights[f"{block}.norm.weight"], self.weights[f"{block}.norm.bias"]
        return np.asarray(new / np.sqrt(variance + NORM_EPSILON) * scale + shift)

    def say(self, number: int, n_rounds: int, state: Floats) -> NDArray[np.float16]:
        """What goes to the left (first SLOTS) and to the right after round `number` (0 the start)."""
        name = f"rounds.{block_of(number, n_rounds)}.say" if number else "start_say"
        said = self._linear(name, state)
        return np.clip(said, -LARGEST, LARGEST).astype(np.float16)

    def logits(self, state: Floats, seen: Floats, allowed: NDArray[np.bool_]) -> Floats:
        """(..., g) how much each goal is wanted, -inf where it is not allowed."""
        found = self._linear("goal", np.concatenate([state, seen], axis=-1))[..., 0]
        return np.asarray(np.where(allowed, found, -np.inf))

    def _linear(self, name: str, values: Floats) -> Floats:
        return np.asarray(values @ self.weights[f"{name}.weight"] + self.weights[f"{name}.bias"])


def block_of(number: int, n_rounds: int) -> int:
    """Which of the five rounds' weights serve round `number` (1 first) of n_rounds: the fourth again and
    again where there are more, the fifth last of five or more.
    """
    if number <= 3:
        return number - 1
    return 4 if number == n_rounds >= 5 else 3


def load(path: Path) -> Network:
    """The network that tools/train/assigner/training.py wrote to this file.

    Raises ValueError for a file that holds anything else.
    """
    with np.load(path) as file:
        found = Network({name: np.asarray(file[name], dtype=np.float64) for name in file.files})
    shape = found.weights.get("start.weight", np.zeros(0)).shape
    if shape != (FEATURES, STATE):
        raise ValueError(f"{path}: start.weight has shape {shape}, not {(FEATURES, STATE)}; train it again")
    return found


@lru_cache(maxsize=8)
def network(training_seed: int = 0) -> Network:
    """The network that ships for this training seed (0, 1 or 2; 0 is the default).

    Raises ValueError where none ships.
    """
    if training_seed not in TRAINING_SEEDS:
        raise ValueError(f"training seed {training_seed}: networks ship for {TRAINING_SEEDS}")
    return load(models.path(f"assigner_{training_seed}.npz"))
