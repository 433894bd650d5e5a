"""The paper's own network and loss for assignment (section 3, "Goal Assignment"), to set ours beside.

One state of 32 numbers an agent, handed to both neighbours in each of 5 rounds (128 bytes); costs to 10 goals
in, chances of 10 goals out; fewer goals are filled up with ghosts of high cost; trained on 5 agents and 10
goals. Where the paper is silent (widths, rates, batch) the choice is ours and stands in `PaperSettings`.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from tools.train.assigner.data import instances, solved
from tools.train.assigner.export import LOOK_SEED

__all__ = ["PaperNetwork", "PaperSettings", "command", "paper_loss"]

AGENTS, GOALS, ROUNDS, STATE = 5, 10, 5, 32
GHOST_COST = 2.0  # above the square's diagonal
EPSILON = 1e-6
APART = 41_000  # neither the benchmark's cases nor those of our own training


@dataclass(frozen=True)
class PaperSettings:
    """What the paper does not say."""

    seed: int = 0
    steps: int = 4000  # the loss has been flat for half of them
    batch: int = 256  # the paper's 50,000 graphs are seen 20 times over
    rate: float = 1e-3
    alpha: float = 0.5  # the paper's weight of validity and diversity


class PaperNetwork(nn.Module):
    """Costs (B, n, 10) -> chances (B, n, 10)."""

    def __init__(self) -> None:
        super().__init__()
        self.encode = nn.Sequential(nn.Linear(GOALS, 64), nn.ReLU(), nn.Linear(64, STATE))
        rounds = [
            nn.Sequential(nn.Linear(3 * STATE, 64), nn.ReLU(), nn.Linear(64, STATE)) for _ in range(ROUNDS)
        ]
        self.rounds = nn.ModuleList(rounds)
        self.decode = nn.Sequential(nn.Linear(STATE, 64), nn.ReLU(), nn.Linear(64, GOALS))

    def forward(self, costs: Tensor) -> Tensor:
        state = self.encode(costs)  # (B, n, 32)
        for one in self.rounds:
            heard = torch.cat([state, state.roll(1, dims=1), state.roll(-1, dims=1)], dim=-1)  # (B, n, 96)
            state = state + one(heard)
        chances: Tensor = self.decode(state).softmax(dim=-1)
        return chances


def paper_loss(chances: Tensor, labels: Tensor, alpha: float) -> Tensor:
    """The paper's L_total: chances (B, n, g), labels (B, n) goal of the optimum."""
    hard = functional.one_hot(chances.argmax(dim=-1), chances.shape[-1]).float()
    # As printed: made of the hard assignment alone, so it has no gradient.
    validity = torch.linalg.norm(1 - hard.sum(dim=1), dim=-1) + torch.linalg.norm(
        1 - torch.linalg.norm(hard, dim=-1), dim=-1
    )
    directions = chances / torch.linalg.norm(chances, dim=-1, keepdim=True).clamp(min=EPSILON)
    alike = directions @ directions.transpose(1, 2)  # (B, n, n)
    diversity = alike.triu(diagonal=1).sum(dim=(1, 2))
    truth = functional.one_hot(labels, chances.shape[-1]).float()
    positive = -0.9 * (truth * torch.log(chances + EPSILON)).mean()
    negative = -0.1 * ((1 - truth) * torch.log(1 - chances + EPSILON)).mean()
    whole: Tensor = alpha * (validity.mean() + diversity.mean()) + (1 - alpha) * (positive + negative)
    return whole


def train_paper(settings: PaperSettings) -> PaperNetwork:
    """Train the paper's network with the paper's loss."""
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    network = PaperNetwork()
    optimiser = torch.optim.Adam(network.parameters(), lr=settings.rate)
    begun = time.process_time()
    for step in range(settings.steps):
        costs = instances(np.random.default_rng([settings.seed, APART, step]), settings.batch, AGENTS, GOALS)
        chances = network(torch.from_numpy(costs.astype(np.float32)))
        loss = paper_loss(chances, torch.from_numpy(solved(costs)), settings.alpha)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        if (step + 1) % 500 == 0:
            print(
                f"step {step + 1} loss {loss.item():.4f} seconds {time.process_time() - begun:.0f}",
                flush=True,
            )
    return network


def measure_paper(network: PaperNetwork, count: int, seed: int = LOOK_SEED) -> None:
    """Print D and O1 for 5 agents and 5 to 10 goals, ghosts for the goals that lack."""
    for n_goals in range(AGENTS, GOALS + 1):
        costs = instances(np.random.default_rng([seed, AGENTS, n_goals]), count, AGENTS, n_goals)
        full = np.concatenate([costs, np.full((count, AGENTS, GOALS - n_goals), GHOST_COST)], axis=2)
        with torch.no_grad():
            chosen = network(torch.from_numpy(full.astype(np.float32))).argmax(dim=-1).numpy()
        ordered = np.sort(chosen, axis=1)
        distinct = (np.diff(ordered, axis=1) != 0).all(axis=1) & (chosen < n_goals).all(axis=1)
        agreeing = (chosen == solved(costs)).mean()
        print(f"{n_goals:3d} goals distinct {distinct.mean():.4f} agreeing {agreeing:.4f}", flush=True)


def command(out: Path, seed: int, steps: int | None, smoke: bool) -> None:
    """What `podwatch train assigner --loss paper` does."""
    settings = PaperSettings(seed=seed, steps=20 if smoke else steps or PaperSettings.steps)
    network = train_paper(settings)
    out.mkdir(parents=True, exist_ok=True)
    torch.save(network.state_dict(), out / f"paper_{seed}.pt")
    measure_paper(network, count=50 if smoke else 5000)
