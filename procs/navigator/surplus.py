"""A surplus drone in place of one that was lost: it asks for an episode when an animal has nobody, or when it
sees one that the map does not know. Who watches asks too when it sees such a one and somebody has none.

It takes an animal by the certificate of an episode and in no other way, so that two that wait never take the
same, and nobody takes one that another still watches. Those that watch go on; the episode runs beside that.
"""

from procs.navigator.situation import Memory, Situation, episode_key
from procs.navigator.states import GATHERED, State

__all__ = ["FREE_FOR_S", "MOST_ASKED", "asks", "asks_for_another"]

FREE_FOR_S = 5.0  # beside the 3 s after which a drone counts as lost: it may only have been silent
SEEN_WITHIN_S = 10.0  # an animal that nobody saw for longer may have dived
STRANGER_FOR_S = 8.0  # longer than the map takes to name a box again
EDGE_PX = 3.0  # a box this near to the picture's edge is cut by it and may have a name elsewhere
MOST_ASKED = 3  # episodes over the same animals: views that do not agree cost the ring its bytes


def asks(now: Situation, memory: Memory) -> bool:
    """Whether a surplus drone asks for an episode now: for FREE_FOR_S the map has held an animal that is
    seen, that no living drone watches and that none was ordered to leave, or for STRANGER_FOR_S there has
    been one in view without a name (two that touched were taken for one); and nobody gathers, which would
    bring an episode anyway.
    """
    identities = now.inputs.identities
    if identities is None:
        return False
    watched = [row.animal for row in now.others]
    free = [
        entry.id
        for entry in identities.map
        if entry.id not in (*watched, *now.left) and now.map_position(entry.id, SEEN_WITHIN_S) is not None
    ]
    known = [animal for animal in memory.free_animals if animal not in watched]
    key = episode_key(identities)
    if not set(free) <= set(known):
        memory.n_asked = 0
    elif key > memory.free_key:
        memory.n_asked += 1  # an episode has ended, and they still have nobody
    memory.free_animals, memory.free_key = tuple(sorted({*known, *free})), key
    if _comes_anyway(now):
        memory.free_since_us = memory.stranger_since_us = 0
        return False
    if _sees_stranger(now, memory):
        return True
    if not free:
        memory.free_since_us = 0
        return False
    memory.free_since_us = memory.free_since_us or now.utime
    return now.seconds_since(memory.free_since_us) > FREE_FOR_S and memory.n_asked < MOST_ASKED


def asks_for_another(now: Situation, memory: Memory, is_unsure: bool) -> bool:
    """Whether a drone that watches asks for an episode now: for STRANGER_FOR_S there has been an animal in
    view without a name, and somebody has none: one that stands by, or, where `is_unsure`, this one, whose own
    it has not seen for a while.
    """
    if _comes_anyway(now) or not (is_unsure or any(row.state == State.STANDBY for row in now.others)):
        memory.stranger_since_us = 0
        return False
    return _sees_stranger(now, memory)


def _comes_anyway(now: Situation) -> bool:
    """Whether an episode runs, or somebody gathers for one."""
    identities = now.inputs.identities
    gathers = any(row.state in GATHERED for row in now.others)
    return gathers or (identities is not None and identities.episode_running)


def _sees_stranger(now: Situation, memory: Memory) -> bool:
    """Whether whole boxes without a name have been in view for long, and it has not asked too often for
    that.
    """
    identities = now.inputs.identities
    if identities is None:
        return False
    inside = [
        min(box.left_px, box.top_px) > EDGE_PX
        and box.right_px < identities.width - EDGE_PX
        and box.bottom_px < identities.height - EDGE_PX
        for box in identities.boxes
    ]
    if not any(animal < 0 and whole for animal, whole in zip(identities.ids, inside, strict=True)):
        memory.stranger_since_us = 0
        return False
    memory.stranger_since_us = memory.stranger_since_us or now.utime
    if now.seconds_since(memory.stranger_since_us) <= STRANGER_FOR_S:
        return False
    key = episode_key(identities)
    if key != memory.stranger_key:
        memory.stranger_key = key
        memory.n_for_strangers += 1
    return memory.n_for_strangers <= MOST_ASKED
