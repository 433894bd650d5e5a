"""Rings of views: is every box right, does consensus tell the truth, do identities last over episodes."""

import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drivers.cameras.pinhole import apply_homography
from procs.registrar.map import Memory
from procs.registrar.ring import RingRegistration, register_ring
from tools.bench.registration_scenes import (
    CAMERA,
    IMAGE_SIZE,
    MEAN_LENGTH_M,
    Cell,
    View,
    draw_pod,
    draw_views,
    trial_rng,
    views_of_pod,
)

__all__ = ["episode_counts", "is_ring_right", "ring_counts", "ring_success"]

Array = NDArray[np.float64]

EPISODES = 10
EPISODE_EVERY_S = 60.0
AWAY_FOR = 3
EPISODE_STEP = 0.5  # lengths that every animal moves between two episodes


def _is_in_another_view(row: int, view: View, others: list[View]) -> bool:
    """Whether the ground under a box lies a body inside another camera's image."""
    box = view.boxes[row]
    ground = apply_homography(CAMERA.image_to_ground(view.pose), ((box[:2] + box[2:]) / 2)[None])
    for other in others:
        place = apply_homography(CAMERA.ground_to_image(other.pose), ground)[0]
        depth = min(*place, *(IMAGE_SIZE - place))
        if depth > float(np.linalg.norm(box[2:] - box[:2])) * view.pose.height_m / other.pose.height_m:
            return True
    return False


def is_ring_right(views: list[View], registration: RingRegistration) -> bool:
    """Every animal that two views hold has one id in all of them, no two share one, and no false alarm has
    an id but one of its own, where no other view could deny it.
    """
    holders = Counter(animal for view in views for animal in view.animals.tolist())
    id_of: dict[int, int] = {}
    false_ids: list[int] = []
    for index, (view, identities) in enumerate(zip(views, registration.identities, strict=True)):
        others = views[:index] + views[index + 1 :]
        for row, (animal, identity) in enumerate(
            zip(view.animals.tolist(), identities.tolist(), strict=True)
        ):
            if animal < 0 and identity >= 0:
                if _is_in_another_view(row, view, others):
                    return False
                false_ids.append(identity)
            elif animal >= 0 and holders[animal] >= 2:
                is_same_id = identity >= 0 and id_of.setdefault(animal, identity) == identity
                if not is_same_id:
                    return False
    owners = [*id_of.values(), *false_ids]
    return len(dict.fromkeys(owners)) == len(owners)


def ring_counts(cell: Cell, seed: int, trials: Iterable[int]) -> Counter[str]:
    """Over these trials: rings `n`, every box `right`, `proved` of those; `called` consensus and
    `wrongly_called` of those; `repaired`; `microseconds`.
    """
    counts: Counter[str] = Counter()
    for trial in trials:
        views = draw_views(cell, trial_rng(seed, cell.name, trial))
        began = time.process_time()
        answer = register_ring([view.boxes for view in views], image_size=IMAGE_SIZE)
        counts["microseconds"] += round(1e6 * (time.process_time() - began))
        is_right = is_ring_right(views, answer)
        counts.update(
            n=1,
            right=is_right,
            proved=is_right and answer.consensus,
            called=answer.consensus,
            wrongly_called=answer.consensus and not is_right,
            repaired=answer.repaired,
        )
    return counts


def ring_success(cell: Cell, trials: int, seed: int) -> dict[str, float]:
    """Shares over `trials` rings: every box right, proved among those, wrong among those called consensus."""
    counts = ring_counts(cell, seed, range(trials))
    return {
        "right": counts["right"] / trials,
        "proved": counts["proved"] / max(counts["right"], 1),
        "wrongly_called": counts["wrongly_called"] / max(counts["called"], 1),
        "ms": counts["microseconds"] / trials / 1e3,
    }


def episode_counts(cell: Cell, seed: int, trials: Iterable[int]) -> Counter[str]:
    """Over these trials of EPISODES episodes each: animals in sight `sightings`, one an animal and episode;
    `switches`, those in which any view gave the animal another id than its last; `unnamed`, those in which
    no view gave it any. Before every episode but the first each animal moves EPISODE_STEP lengths its own
    way; one is away for AWAY_FOR episodes and moves on meanwhile. Every drone flies anew each time.
    """
    counts: Counter[str] = Counter()
    for trial in trials:
        rng = trial_rng(seed, cell.name, trial)
        centres, outlines = draw_pod(cell.n_animals, rng)
        diver, dives_at = int(rng.integers(cell.n_animals)), int(rng.integers(2, EPISODES - AWAY_FOR))
        memory: Memory | None = None
        last_id: dict[int, int] = {}
        for episode in range(EPISODES):
            if episode:
                ways = rng.uniform(0, 2 * np.pi, cell.n_animals)
                step = np.column_stack([np.cos(ways), np.sin(ways)])
                centres = centres + EPISODE_STEP * MEAN_LENGTH_M * step
            is_up = np.arange(cell.n_animals) != diver
            if not dives_at <= episode < dives_at + AWAY_FOR:
                is_up[diver] = True
            animals = np.flatnonzero(is_up)
            views = [
                replace(view, animals=np.where(view.animals >= 0, animals[view.animals], -1))
                for view in views_of_pod(cell, centres[is_up], outlines[is_up], rng)
            ]
            answer = register_ring(
                [view.boxes for view in views],
                image_size=IMAGE_SIZE,
                memory=memory,
                now_s=episode * EPISODE_EVERY_S,
            )
            memory = answer.memory
            counts.update(_switches(views, answer, last_id))
        counts["n"] += 1
    return counts


def _switches(views: list[View], answer: RingRegistration, last_id: dict[int, int]) -> Counter[str]:
    """Counts of one episode; `last_id` is brought up to date."""
    given: dict[int, list[int]] = {}
    for view, identities in zip(views, answer.identities, strict=True):
        for animal, identity in zip(view.animals.tolist(), identities.tolist(), strict=True):
            if animal >= 0:
                given.setdefault(animal, [])
                if identity >= 0:
                    given[animal].append(identity)
    counts: Counter[str] = Counter()
    for animal, ids in given.items():
        counts["sightings"] += 1
        if not ids:
            counts["unnamed"] += 1
            continue
        wanted = last_id.get(animal, ids[0])
        counts["switches"] += any(one != wanted for one in ids)
        last_id[animal] = Counter(ids).most_common(1)[0][0]
    return counts
