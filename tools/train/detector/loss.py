"""Which cells answer for which animal, and what their errors cost."""

import torch
from torch import Tensor
from torch.nn import functional

__all__ = ["assign", "detection_loss", "pair_iou"]

CELLS_AN_ANIMAL = 9  # enough to learn from, few enough that they agree
SCORE_POWER, IOU_POWER = 0.5, 4.0  # a cell is good when its box is; its score decides between equals
REACH = 0.75  # an animal smaller than a cell still reaches this far from its middle, in strides
BOX_WEIGHT = 5.0  # against the scores' loss, which is larger by about this at the start


def pair_iou(first: Tensor, second: Tensor) -> Tensor:
    """IoU of (N, 4) with (M, 4) boxes xyxy -> (N, M)."""
    low = torch.maximum(first[:, None, :2], second[None, :, :2])
    high = torch.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    areas = [(boxes[:, 2:] - boxes[:, :2]).clamp(min=0).prod(-1) for boxes in (first, second)]
    return shared / (areas[0][:, None] + areas[1][None] - shared + 1e-7)


def _reached(centres: Tensor, strides: Tensor, animals: Tensor) -> Tensor:
    """(N, A): cells whose centre lies inside the box of an animal (N, 4)."""
    middle, half = (animals[:, :2] + animals[:, 2:]) / 2, (animals[:, 2:] - animals[:, :2]) / 2
    reach = torch.maximum(half[:, None], REACH * strides[None, :, None])  # (N, A, 2)
    return ((centres[None] - middle[:, None]).abs() < reach).all(-1)


def assign(
    scores: Tensor, boxes: Tensor, centres: Tensor, strides: Tensor, animals: Tensor
) -> tuple[Tensor, Tensor]:
    """For one image: the animal of each cell (A,), -1 for none, and the score that the cell should give (A,).

    scores (A,) in 0-1 and boxes (A, 4) px as predicted, animals (N, 4) px. The cells inside an animal whose
    own boxes fit it best answer for it (task-aligned assignment, Feng et al. 2021); the best of them should
    say its own IoU.
    """
    owner = torch.full(scores.shape, -1, dtype=torch.long, device=scores.device)
    target = torch.zeros_like(scores)
    if len(animals) == 0:
        return owner, target
    iou = pair_iou(animals, boxes)  # (N, A)
    # A grid is right for an animal a few cells wide: a nudge that decides while the boxes still mean nothing.
    widest = (animals[:, 2:] - animals[:, :2]).max(-1).values
    fit = torch.exp(-0.3 * torch.log2(widest[:, None] / (strides[None] * 5)).abs())
    quality = (scores[None] ** SCORE_POWER * (iou + 1e-3) ** IOU_POWER * fit) * _reached(
        centres, strides, animals
    )
    best, cells = quality.topk(min(CELLS_AN_ANIMAL, quality.shape[1]), dim=1)  # (N, 9)
    chosen = torch.zeros_like(quality, dtype=torch.bool).scatter_(1, cells, best > 0)
    # A cell that several animals want goes to the one that its box fits best.
    contest = torch.where(chosen, iou + 1e-6, torch.zeros_like(iou))
    claim, animal = contest.max(0)
    taken = claim > 0
    owner[taken] = animal[taken]
    mine = torch.zeros_like(chosen)
    mine[animal[taken], taken.nonzero()[:, 0]] = True
    quality, iou = quality * mine, iou * mine
    scaled = quality / quality.amax(1, keepdim=True).clamp(min=1e-12) * iou.amax(1, keepdim=True)  # (N, A)
    target[taken] = scaled.amax(0)[taken]
    return owner, target


def _generalised_iou(first: Tensor, second: Tensor) -> Tensor:
    """GIoU of boxes (K, 4) with their partners (K, 4) -> (K,) (Rezatofighi et al. 2019)."""
    low, high = torch.maximum(first[:, :2], second[:, :2]), torch.minimum(first[:, 2:], second[:, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    union = (first[:, 2:] - first[:, :2]).prod(-1) + (second[:, 2:] - second[:, :2]).prod(-1) - shared + 1e-7
    hull = torch.maximum(first[:, 2:], second[:, 2:]) - torch.minimum(first[:, :2], second[:, :2])
    around = hull.prod(-1) + 1e-7
    return shared / union - (around - union) / around


def detection_loss(
    logits: Tensor, boxes: Tensor, centres: Tensor, strides: Tensor, animals: list[Tensor]
) -> tuple[Tensor, Tensor]:
    """(score loss, box loss), each per animal-like unit of target score.

    logits (B, 1, A), boxes (B, A, 4) px, animals: a tensor (N, 5) an image, xyxy px and 1 or 0 for "counts".
    """
    score_loss, box_loss, total = logits.new_zeros(()), logits.new_zeros(()), logits.new_zeros(())
    for logit, box, known in zip(logits[:, 0], boxes, animals, strict=True):
        counted, faint = known[known[:, 4] > 0, :4], known[known[:, 4] == 0, :4]
        with torch.no_grad():
            owner, target = assign(logit.sigmoid(), box, centres, strides, counted)
            weight = torch.ones_like(target)
            if len(faint):  # neither whale nor water: not learnt from
                weight[_reached(centres, strides, faint).any(0) & (owner < 0)] = 0
        loss = functional.binary_cross_entropy_with_logits(logit, target, reduction="none")
        score_loss = score_loss + (loss * weight).sum()
        mine = owner >= 0
        if mine.any():
            errors = 1 - _generalised_iou(box[mine], counted[owner[mine]])
            box_loss = box_loss + (errors * target[mine].clamp(min=0.05)).sum()
        total = total + target.sum()
    total = total.clamp(min=4.0)  # a batch of empty seas must not blow its few errors up
    return score_loss / total, BOX_WEIGHT * box_loss / total
