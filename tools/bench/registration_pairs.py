"""Two views: how often all matches are right, how many are, and whether confidence tells the truth."""

import time
from collections import Counter
from collections.abc import Iterable

import numpy as np

from procs.registrar.box_icp import BoxAlignment, box_icp
from tools.bench.registration_scenes import IMAGE_SIZE, Cell, View, draw_views, trial_rng, true_matches

__all__ = ["pair_counts", "pair_success"]

PRIOR_STD_RAD = float(np.deg2rad(8.0))
SURE = 0.9


def _aligned(cell: Cell, source: View, target: View, rng: np.random.Generator) -> BoxAlignment:
    prior = None
    if cell.heading_prior:
        turned = target.pose.yaw_rad - source.pose.yaw_rad
        prior = (turned + rng.normal(0.0, PRIOR_STD_RAD), PRIOR_STD_RAD)
    return box_icp(
        source.boxes,
        target.boxes,
        image_size=IMAGE_SIZE,
        heading_prior_rad=prior,
        mode="literal" if cell.literal else "robust",
    )


def pair_counts(cell: Cell, seed: int, trials: Iterable[int]) -> Counter[str]:
    """Over these trials: pairs `n`, all matches `right`, `sure` at a confidence of 0.9 and `sure_wrong` of
    those; matches `true_found`, `found` and `true_total`; `microseconds` of the registration alone.
    """
    counts: Counter[str] = Counter()
    for trial in trials:
        rng = trial_rng(seed, cell.name, trial)
        source, target = draw_views(cell, rng)
        began = time.process_time()
        answer = _aligned(cell, source, target, rng)
        counts["microseconds"] += round(1e6 * (time.process_time() - began))
        wanted = set(true_matches(source, target))
        got = {(int(a), int(b)) for a, b in answer.matches}
        is_sure = answer.confidence >= SURE
        counts.update(
            n=1,
            right=got == wanted,
            sure=is_sure,
            sure_wrong=is_sure and got != wanted,
            true_found=len(got & wanted),
            found=len(got),
            true_total=len(wanted),
        )
    return counts


def pair_success(cell: Cell, trials: int, seed: int) -> dict[str, float]:
    """Shares over `trials` pairs: strictly right, precision, recall, wrong among those that are sure; and ms
    a call.
    """
    counts = pair_counts(cell, seed, range(trials))
    return {
        "right": counts["right"] / trials,
        "precision": counts["true_found"] / max(counts["found"], 1),
        "recall": counts["true_found"] / max(counts["true_total"], 1),
        "sure_wrong": counts["sure_wrong"] / max(counts["sure"], 1),
        "ms": counts["microseconds"] / trials / 1e3,
    }
