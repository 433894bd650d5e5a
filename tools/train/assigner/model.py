"""The assigner's network in torch, for whole rings at once; procs/assigner/learned.py runs the same in numpy,
one agent at a time.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from procs.assigner.learned import SLOTS, STATE, block_of
from procs.assigner.window import FEATURES, hops_relayed

__all__ = ["RingNetwork"]

HIDDEN = 64
ROUNDS = 5
HEARD = 2 * SLOTS + 2  # from both sides, and whether they came
HIGH = 1e4


class Round(nn.Module):
    """What one agent does with its features and with what it heard, in one round."""

    def __init__(self, heard: int) -> None:
        super().__init__()
        self.read = nn.Linear(STATE + FEATURES + heard, HIDDEN)
        self.pooled = nn.Linear(2 * HIDDEN, HIDDEN)
        self.mix = nn.Linear(HIDDEN, HIDDEN)
        self.write = nn.Linear(HIDDEN, STATE)
        self.norm = nn.LayerNorm(STATE)
        self.say = nn.Linear(STATE, 2 * SLOTS)

    def forward(self, state: Tensor, given: Tensor) -> Tensor:
        read = functional.relu(self.read(torch.cat([state, given], dim=-1)))  # (B, n, g, hidden)
        pools = torch.cat([read.amax(dim=2), read.mean(dim=2)], dim=-1)  # (B, n, 2 hidden)
        mixed = functional.relu(self.mix(read) + self.pooled(pools)[:, :, None])
        result: Tensor = self.norm(state + self.write(mixed))
        return result


class RingNetwork(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.start = nn.Linear(FEATURES, STATE)
        self.start_say = nn.Linear(STATE, 2 * SLOTS)
        blocks = [Round(HEARD) for _ in range(ROUNDS)]
        self.rounds = nn.ModuleList(blocks)
        self._blocks = tuple(blocks)
        self.goal = nn.Linear(STATE + FEATURES, 1)

    def forward(self, seen: Tensor, allowed: Tensor, delivered: Tensor) -> list[Tensor]:
        """Logits (B, n, g) after each round: seen (rounds + 1, B, n, g, FEATURES), allowed (B, n, g),
        delivered (rounds, 2, B, n).
        """
        n_rounds, (_, batch, n, g, _) = len(delivered), seen.shape
        state = torch.relu(self.start(seen[0]))
        said = self.start_say(state)
        outs = [self._logits(state, seen[0], allowed)]
        for number in range(1, n_rounds + 1):
            left, right = said[..., SLOTS:].roll(1, 1), said[..., :SLOTS].roll(-1, 1)
            if n == 2:
                right = left  # the one neighbour stands on both sides and is told once
            arrived = delivered[number - 1]
            if number <= hops_relayed(n):  # the first slot carries a row of costs
                left, right = (functional.pad(side[..., 1:], (1, 0)) for side in (left, right))
            heard = [side * came[..., None, None] for side, came in zip((left, right), arrived, strict=True)]
            came = arrived.permute(1, 2, 0)[:, :, None].expand(batch, n, g, 2)
            block = self._blocks[block_of(number, n_rounds)]
            state = block(state, torch.cat([seen[number], *heard, came], dim=-1))
            said = block.say(state)
            outs.append(self._logits(state, seen[number], allowed))
        return outs

    def _logits(self, state: Tensor, seen: Tensor, allowed: Tensor) -> Tensor:
        wanted: Tensor = self.goal(torch.cat([state, seen], dim=-1))[..., 0]
        return wanted.masked_fill(~allowed, -HIGH)
