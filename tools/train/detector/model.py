"""The detector's network: a small fully convolutional, anchor-free, one-stage detector.

Our own design, for one thread of a small computer: 572,340 parameters, 320x320 in some milliseconds.
Every cell of four grids (4, 8, 16 and 32 px apart) says how likely a whale is there and how far the four
sides of its box lie from the cell's centre, in units of the grid (FCOS, Tian et al. 2019). Written on plain
torch; nothing is taken from an AGPL package.
"""

from dataclasses import astuple, dataclass

import torch
from torch import Tensor, nn

__all__ = ["STRIDES", "WhaleDetector", "cell_centres", "decode"]

STRIDES = (4, 8, 16, 32)
SMALLEST_PRIOR = (
    0.01  # share of cells taken for whales at the start, so that the first steps do not shout everywhere
)


@dataclass(frozen=True)
class Sizes:
    """Channels at strides 2, 4, 8, 16 and 32 and in the heads.

    Halves of them are multiples of 16: the processor works on 16 channels at once, and 12 cost as much as 16.
    """

    stem: int = 16
    s4: int = 32
    s8: int = 64
    s16: int = 64
    s32: int = 128
    head: int = 64
    finest_head: int = 16  # of the finest grid, which has three cells in four

    def scaled(self, width: float) -> "Sizes":
        """All of them times `width`, rounded to multiples of 8, at least 8."""
        return Sizes(*(max(8 * round(value * width / 8), 8) for value in astuple(self)))


class ConvUnit(nn.Sequential):
    """Convolution, batch normalisation, ReLU: ReLU costs nothing in fixed point, should anyone want it."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


class SplitBlock(nn.Module):
    """Half of the channels pass through two 3x3 convolutions, half pass by: a quarter of the cost of a full
    block.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.split = channels // 2
        self.deep = nn.Sequential(ConvUnit(self.split, self.split), ConvUnit(self.split, self.split))
        self.mix = ConvUnit(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        kept, worked = x.chunk(2, 1)  # (B, C/2, H, W) each; slices would cost a sixth of a step going back
        mixed: Tensor = self.mix(torch.cat([kept, worked + self.deep(worked)], 1))  # (B, C, H, W)
        return mixed + x


class Pooling(nn.Module):
    """Sees nearly the whole image: three 5x5 maxima in a row beside the input, mixed."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.reduce = ConvUnit(channels, channels // 2, 1)
        self.mix = ConvUnit(channels * 2, channels, 1)
        self.pool = nn.MaxPool2d(5, 1, 2)

    def forward(self, x: Tensor) -> Tensor:
        first = self.reduce(x)  # (B, C/2, H, W)
        second = self.pool(first)
        third = self.pool(second)
        mixed: Tensor = self.mix(torch.cat([first, second, third, self.pool(third)], 1))  # (B, C, H, W)
        return mixed


class WhaleDetector(nn.Module):
    """(B, 3, H, W) RGB in 0-1, H and W multiples of 32 -> logits (B, 1, A) and side distances (B, 4, A)."""

    def __init__(self, sizes: Sizes | None = None) -> None:
        super().__init__()
        c = sizes or Sizes()
        self.to_s4 = nn.Sequential(ConvUnit(3, c.stem, 3, 2), ConvUnit(c.stem, c.s4, 3, 2), SplitBlock(c.s4))
        self.to_s8 = nn.Sequential(ConvUnit(c.s4, c.s8, 3, 2), SplitBlock(c.s8), SplitBlock(c.s8))
        self.to_s16 = nn.Sequential(ConvUnit(c.s8, c.s16, 3, 2), SplitBlock(c.s16), SplitBlock(c.s16))
        self.to_s32 = nn.Sequential(ConvUnit(c.s16, c.s32, 3, 2), SplitBlock(c.s32), Pooling(c.s32))
        self.side4, self.narrow = ConvUnit(c.s4, c.finest_head, 1), ConvUnit(c.head, c.finest_head, 1)
        self.side8, self.side16, self.side32 = (ConvUnit(n, c.head, 1) for n in (c.s8, c.s16, c.s32))
        self.smooth16, self.smooth8 = SplitBlock(c.head), SplitBlock(c.head)
        self.down16, self.down32 = ConvUnit(c.head, c.head, 3, 2), ConvUnit(c.head, c.head, 3, 2)
        self.heads = nn.ModuleList(
            nn.Sequential(SplitBlock(n), nn.Conv2d(n, 5, 1)) for n in (c.finest_head, c.head, c.head, c.head)
        )
        for head in self.heads:
            bias = head.get_parameter("1.bias")
            nn.init.constant_(bias[:4], 1.0)
            nn.init.constant_(bias[4:], float(torch.logit(torch.tensor(SMALLEST_PRIOR))))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        s4 = self.to_s4(images)  # (B, 32, H/4, W/4)
        s8 = self.to_s8(s4)  # (B, 64, H/8, W/8)
        s16 = self.to_s16(s8)  # (B, 64, H/16, W/16)
        top = self.side32(self.to_s32(s16))  # (B, 64, H/32, W/32)
        up = nn.functional.interpolate
        middle = self.smooth16(
            self.side16(s16) + up(top, scale_factor=2.0, mode="nearest")
        )  # (B, 64, H/16, W/16)
        fine = self.smooth8(
            self.side8(s8) + up(middle, scale_factor=2.0, mode="nearest")
        )  # (B, 64, H/8, W/8)
        coarser = up(self.narrow(fine), scale_factor=2.0, mode="nearest")
        finest = self.side4(s4) + coarser  # (B, 16, H/4, W/4)
        middle = middle + self.down16(fine)
        top = top + self.down32(middle)
        levels = (finest, fine, middle, top)
        grids = [head(level).flatten(2) for head, level in zip(self.heads, levels, strict=True)]
        out = torch.cat(grids, 2)  # (B, 5, A), A = HW (1/16 + 1/64 + 1/256 + 1/1024)
        return out[:, 4:], nn.functional.softplus(out[:, :4])


def cell_centres(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Centres (A, 2) in px and strides (A,) of all cells, in the order of the network's output."""
    centres, strides = [], []
    for stride in STRIDES:
        rows, columns = torch.meshgrid(
            torch.arange(height // stride), torch.arange(width // stride), indexing="ij"
        )
        centre = (torch.stack([columns, rows], -1).reshape(-1, 2).float() + 0.5) * stride  # (HW/stride^2, 2)
        centres.append(centre)
        strides.append(torch.full((len(centre),), float(stride)))
    return torch.cat(centres), torch.cat(strides)


def decode(distances: Tensor, centres: Tensor, strides: Tensor) -> Tensor:
    """Side distances (B, 4, A) in grid units, left top right bottom -> boxes (B, A, 4) xyxy px."""
    sides = distances.transpose(1, 2) * strides[:, None]  # (B, A, 4)
    return torch.cat([centres - sides[..., :2], centres + sides[..., 2:]], -1)  # (B, A, 4)


class Exported(nn.Module):
    """The network in the Ultralytics raw layout: (B, 5, A) of cx, cy, w, h px, then the score 0-1."""

    def __init__(self, network: WhaleDetector, side: int) -> None:
        super().__init__()
        self.network = network
        centres, strides = cell_centres(side, side)
        self.register_buffer("centres", centres.T[None].contiguous())  # (1, 2, A)
        self.register_buffer("strides", strides[None, None].contiguous())  # (1, 1, A)

    def forward(self, images: Tensor) -> Tensor:
        logits, distances = self.network(images)
        sides = distances * self.strides  # (B, 4, A)
        low, high = self.centres - sides[:, :2], self.centres + sides[:, 2:]  # (B, 2, A)
        return torch.cat([(low + high) / 2, high - low, logits.sigmoid()], 1)  # (B, 5, A)
