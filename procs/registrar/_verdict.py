"""What makes an episode's map the ring's word: closure, every edge's confidence, every animal's
confirmation."""

from collections.abc import Sequence

from procs.registrar.map import MapAnimal

__all__ = ["CONSENSUS_CONFIDENCE", "is_doubted", "is_settled"]

CONSENSUS_CONFIDENCE = 0.9
MOST_DOUBTED_PER_VIEW = 0.1  # false alarms a view, as a share of the confirmed animals
LEAST_CONFIRMED = 0.25  # share of the views that should see an animal
MOST_MISSED = 0.34  # share of an animal's views that may miss it; one miss always may


def is_doubted(animal: MapAnimal) -> bool:
    """One view says it is there, and at least one that should see it does not; or a few say so against many,
    whose false alarms happened to fall on one place."""
    few = LEAST_CONFIRMED * (animal.hits + animal.misses)
    return animal.misses > 0 and 0 < animal.hits <= max(1.0, few)


def is_settled(animals: Sequence[MapAnimal], n_views: int) -> bool:
    """Whether the views agree about every animal that any of them saw.

    One view against one is a draw and settles nothing. One against several is a false alarm, which a
    detector has now and then; more of them than it should have means that a view lies wrong on the map.
    """
    counted = [one for one in animals if one.hits > 0]
    doubted = [one for one in counted if is_doubted(one)]
    allowed = MOST_DOUBTED_PER_VIEW * n_views * (len(counted) - len(doubted))
    if any(one.misses < 2 for one in doubted) or len(doubted) > allowed:
        return False
    return all(one.misses <= max(1, MOST_MISSED * (one.hits + one.misses)) for one in counted if one.hits > 1)
