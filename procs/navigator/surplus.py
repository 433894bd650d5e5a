"""A surplus drone in place of one that was lost: it asks for an episode when an animal has nobody.

It takes an animal by the certificate of an episode and in no other way, so that two that wait never take the
same, and nobody takes one that another still watches. Those that watch go on; the episode runs beside that.
"""

from procs.navigator.situation import Memory, Situation, episode_key
from procs.navigator.states import GATHERED

__all__ = ["FREE_FOR_S", "MOST_ASKED", "asks"]

FREE_FOR_S = 5.0  # beside the 3 s after which a drone counts as lost: it may only have been silent
SEEN_WITHIN_S = 10.0  # an animal that nobody saw for longer may have dived
MOST_ASKED = 3  # episodes over the same animals: views that do not agree cost the ring its bytes


def asks(now: Situation, memory: Memory) -> bool:
    """Whether a surplus drone asks for an episode now: for FREE_FOR_S the map has held an animal that is
    seen, that no living drone watches and that none was ordered to leave, and nobody gathers, which would
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
    gathering = any(row.state in GATHERED for row in now.others)
    if not free or gathering or identities.episode_running:
        memory.free_since_us = 0
        return False
    memory.free_since_us = memory.free_since_us or now.utime
    return now.seconds_since(memory.free_since_us) > FREE_FOR_S and memory.n_asked < MOST_ASKED
