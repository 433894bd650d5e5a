"""Trains the assigner's network on points in a unit square, exports it for numpy, and measures it.

    podwatch train assigner --out runs/assigner --seed 0   trains (goes on where it was stopped), exports
    podwatch train assigner --smoke                         a few steps, an export and its check
    podwatch train assigner --loss paper                    the paper's own network and loss

Needs the `train` extra (torch). Every batch depends on (seed, step) alone, so a resumed run sees what an
uninterrupted one would have seen.
"""

import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from procs.assigner.learned import load
from procs.assigner.ring_rows import seen_by_round
from tools.train.assigner.data import Batch, mixed_batch
from tools.train.assigner.export import check_export, export, measure
from tools.train.assigner.model import RingNetwork

__all__ = ["Settings", "command", "train"]

APART = 40_000  # the benchmark draws from (seed, agents, goals): no fleet has this many


@dataclass(frozen=True)
class Settings:
    """What shapes a training, each with its reason."""

    seed: int = 0
    steps: int = 8000  # 7 minutes on one idle core; more steps still help
    rate: float = 3e-3  # the highest that never diverged with AdamW on this network
    cosine_steps: int = 10_000  # the rate follows a cosine to its end here ...
    cooldown_steps: int = 2000  # ... and falls to zero over the last of `steps`, which settles near ties
    polish_steps: int = 1200  # then mostly five agents with few goals to spare, the hardest for its size,
    polish_rate: float = 1e-3  # from this rate down to zero
    polish_third: float = 0.5  # and the third round, whose lists gnn+resolve floods, weighs this
    warmup_steps: int = 100
    weight_decay: float = 1e-4
    average_decay: float = 0.998  # the exported weights are a running mean over about 500 steps
    clash_weight: float = 0.3  # of expected clashing pairs: without it agents are confident alone
    round_weights: tuple[float, ...] = (0.0, 0.05, 0.05, 0.2, 0.05)  # cross-entropy after fewer rounds
    save_every_steps: int = 100  # a kill loses seconds


def batch_tensors(batch: Batch, random: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(seen, allowed, delivered, labels) as the network and the loss take them; label -100: none to learn."""
    count, n, _ = batch.costs.shape
    delivered = random.random((batch.rounds, 2, count, n)) >= batch.loss
    seen = list(seen_by_round(batch.costs, delivered))
    allowed = torch.from_numpy(seen[0].allowed)
    labels = torch.from_numpy(batch.labels).clone()
    labels[
        labels >= allowed.shape[2]
    ] = -100  # all its goals are forbidden or taken, and going without is no choice
    features = torch.from_numpy(np.stack([one.features for one in seen]).astype(np.float32))
    return features, allowed, torch.from_numpy(delivered.astype(np.float32)), labels


def assignment_loss(
    outs: list[Tensor], labels: Tensor, n_goals: int, settings: Settings, polishing: bool = False
) -> Tensor:
    """Cross-entropy after the last round and, weighed less, earlier ones, and expected clashing pairs."""
    n = labels.shape[1]
    loss = functional.cross_entropy(outs[-1].flatten(0, 1), labels.flatten())
    for number, (logits, share) in enumerate(zip(outs[:-1], settings.round_weights, strict=False)):
        weight = settings.polish_third if polishing and number == 3 else share
        if weight > 0:
            loss = loss + weight * functional.cross_entropy(logits.flatten(0, 1), labels.flatten())
    chances = outs[-1].softmax(dim=-1)[..., :n_goals]  # (B, n, g)
    pairs = (chances.sum(dim=1) ** 2).sum(dim=-1) - (chances**2).sum(dim=(1, 2))
    # Per five agents, so that long rings weigh no more than short ones.
    return loss + settings.clash_weight * pairs.mean() / 2 * 5 / n


def _rate(settings: Settings, step: int) -> float:
    warm = min(1.0, (step + 1) / settings.warmup_steps)
    slope = 0.01 + 0.99 * 0.5 * (1 + float(np.cos(np.pi * step / settings.cosine_steps)))
    if step >= settings.steps:
        return settings.polish_rate * (1 - (step - settings.steps) / settings.polish_steps)
    return settings.rate * warm * slope * min(1.0, (settings.steps - step) / settings.cooldown_steps)


@dataclass
class _Run:
    """All that a checkpoint holds."""

    network: RingNetwork
    average: dict[str, Tensor]
    optimiser: torch.optim.AdamW
    step: int = 0
    seconds: float = 0.0  # of processor time

    def save(self, path: Path, settings: Settings) -> None:
        part = path.with_suffix(".part")
        torch.save(
            {
                "network": self.network.state_dict(),
                "average": self.average,
                "optimiser": self.optimiser.state_dict(),
                "step": self.step,
                "seconds": self.seconds,
                "settings": asdict(settings),
            },
            part,
        )
        part.replace(path)  # whole or not at all: a kill while writing keeps the last one

    def load(self, path: Path, settings: Settings) -> None:
        """Take up a checkpoint; ValueError where it was made with other settings."""
        state = torch.load(path, weights_only=True)
        before = state["settings"]
        changed = [name for name, now in asdict(settings).items() if before.get(name) != now]
        if changed:
            raise ValueError(
                f"{path}: made with other settings ({', '.join(changed)}); give another --out to start anew"
            )
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.average, self.step, self.seconds = state["average"], state["step"], state["seconds"]

    def follow(self, decay: float) -> None:
        """Move the running mean of the weights a step towards them; faster while they are young."""
        decay = min(decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, value in self.network.state_dict().items():
                self.average[name].lerp_(value, 1 - decay)


def _start(settings: Settings) -> _Run:
    torch.manual_seed(settings.seed)
    network = RingNetwork()
    average = {name: value.clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), lr=settings.rate, weight_decay=settings.weight_decay)
    return _Run(network, average, optimiser)


def _step(run: _Run, settings: Settings) -> float:
    """One step of the optimiser; returns the loss."""
    random = np.random.default_rng([settings.seed, APART, run.step])
    polishing = run.step >= settings.steps
    batch = mixed_batch(random, polishing)
    seen, allowed, delivered, labels = batch_tensors(batch, random)
    for group in run.optimiser.param_groups:
        group["lr"] = _rate(settings, run.step)
    outs = run.network(seen, allowed, delivered)
    loss = assignment_loss(outs, labels, batch.costs.shape[2], settings, polishing)
    if not torch.isfinite(loss):
        raise FloatingPointError(
            f"the loss is {loss.item()} at step {run.step}: lower Settings.rate ({settings.rate})"
        )
    run.optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(run.network.parameters(), 1.0)
    run.optimiser.step()
    run.step += 1
    run.follow(settings.average_decay)
    return float(loss.item())


def train(out: Path, settings: Settings, stop_after: int | None = None) -> Path:
    """Train into the folder `out`, from its checkpoint if there is one, and export; returns the weights.

    `stop_after` ends the run at that step, as a kill would; the next call goes on from the last checkpoint.
    Raises ValueError where the folder holds a run of other settings.
    """
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    run, checkpoint = _start(settings), out / "checkpoint.pt"
    if checkpoint.is_file():
        run.load(checkpoint, settings)
        print(f"goes on at step {run.step} of {settings.steps + settings.polish_steps}", flush=True)
    begun, losses = time.process_time() - run.seconds, []
    last = settings.steps + settings.polish_steps
    while run.step < min(last, stop_after or last):
        losses.append(_step(run, settings))
        run.seconds = time.process_time() - begun
        if run.step % 100 == 0:
            print(f"step {run.step} loss {np.mean(losses):.4f} seconds {run.seconds:.0f}", flush=True)
            losses = []
        if run.step % settings.save_every_steps == 0:
            run.save(checkpoint, settings)
    run.save(checkpoint, settings)
    return export(run.average, out / f"assigner_{settings.seed}.npz")


def command(out: Path, seed: int, steps: int | None, smoke: bool) -> None:
    """What `podwatch train assigner` does: train, export, check the export, measure it."""
    if smoke:
        settings = Settings(seed=seed, steps=20, warmup_steps=5, cooldown_steps=5, polish_steps=5)
        out = out / "smoke"
    else:
        settings = Settings(seed=seed, steps=steps or Settings.steps)
    weights = train(out, settings)
    print(check_export(_start(settings).network, weights))
    measure(load(weights), count=50 if smoke else 2000)
