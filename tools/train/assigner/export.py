"""Writes the assigner's trained weights for numpy, checks that numpy computes what torch does, and measures
them.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from procs.assigner.learned import Network, load
from procs.assigner.many import gnn_rings, resolve_rings
from procs.assigner.ring_rows import seen_by_round
from tools.train.assigner.data import instances, solved
from tools.train.assigner.model import RingNetwork

__all__ = ["check_export", "export", "measure"]

# Cases to look at while a training is set up; the benchmark draws its own from other seeds.
LOOK_SEED = 50_000
LEAST_AGREEMENT = 0.995  # of goals: rounding messages to float16 changes a choice between near equals


def export(weights: dict[str, Tensor], path: Path) -> Path:
    """Write the weights by name, float32, every matrix as (in, out)."""
    arrays = {
        name: (value.numpy().T if value.ndim == 2 else value.numpy()).astype(np.float32)
        for name, value in weights.items()
    }
    part = path.with_suffix(".part.npz")
    np.savez(part, **arrays)  # type: ignore[arg-type]
    part.replace(path)
    return path


def check_export(network: RingNetwork, path: Path) -> str:
    """One line on how well numpy, with messages as they travel, and torch agree; `network` only lends its
    shape. ValueError when they do not.
    """
    weights = load(path)
    network.load_state_dict(
        {
            name: torch.from_numpy((value.T if value.ndim == 2 else value).astype(np.float32))
            for name, value in weights.weights.items()
        }
    )
    random = np.random.default_rng([LOOK_SEED, 0])
    agreeing = []
    for n_agents, n_goals in ((5, 7), (2, 3), (4, 3), (12, 14)):
        costs = instances(random, 50, n_agents, n_goals)
        seen = list(seen_by_round(costs, np.ones((5, 2, 50, n_agents), dtype=bool)))
        with torch.no_grad():
            logits = network(
                torch.from_numpy(np.stack([one.features for one in seen]).astype(np.float32)),
                torch.from_numpy(seen[0].allowed),
                torch.ones(5, 2, 50, n_agents),
            )[-1]
        chosen = logits.argmax(dim=-1).numpy()
        expected = np.where(chosen < n_goals, chosen, -1)
        agreeing.append((gnn_rings(costs, 5, 0.0, random, weights).goals == expected).mean())
    least = float(min(agreeing))
    if least < LEAST_AGREEMENT:
        raise ValueError(
            f"{path}: numpy and torch agree on {least:.4f} of the goals, not {LEAST_AGREEMENT}; export anew"
        )
    return f"{path}: numpy and torch agree on {least:.4f} of the goals, {path.stat().st_size / 1e3:.0f} kB"


def measure(weights: Network, count: int = 2000, seed: int = LOOK_SEED) -> None:
    """Print D and O1 of both learned methods on cases that are neither trained on nor the benchmark's."""
    for n_agents, n_goals in [(5, n_goals) for n_goals in range(5, 11)] + [(3, 3), (8, 8), (8, 12), (20, 30)]:
        random = np.random.default_rng([seed, n_agents, n_goals])
        costs = instances(random, count if n_agents <= 8 else count // 10, n_agents, n_goals)
        labels = solved(costs)
        for name, rings in (("gnn", gnn_rings), ("gnn+resolve", resolve_rings)):
            found = rings(costs, 5, 0.0, random, weights)
            whole = (found.goals == labels).all(axis=1).mean()
            print(
                f"{n_agents:3d} agents {n_goals:3d} goals {name:12s} distinct {found.is_distinct.mean():.4f} "
                f"agreeing {(found.goals == labels).mean():.4f} exact {whole:.4f}",
                flush=True,
            )
