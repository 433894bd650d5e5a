"""Agents of the exchange talk: packets are lost, repeated and late."""

import numpy as np

from procs.assigner.gossip import Agent


def ring_of(n: int) -> list[tuple[int, int]]:
    """Directed links of a ring; a pair for 2, none for 1."""
    both = [(k, (k + 1) % n) for k in range(n)] + [((k + 1) % n, k) for k in range(n)]
    return sorted({link for link in both if link[0] != link[1]})


def talk(
    agents: list[Agent],
    links: list[tuple[int, int]],
    random: np.random.Generator,
    loss: float = 0.0,
    steps: int = 60,
    dead: tuple[int, ...] = (),
) -> list[int]:
    """Step all agents; packets are lost, repeated and late -> sizes of all that was sent. Checks safety at
    each step.
    """
    inboxes: list[list[bytes]] = [[] for _ in agents]
    late: list[tuple[int, int, bytes]] = []
    sizes = []
    for number in range(steps):
        arriving = [item for item in late if item[0] <= number]
        late = [item for item in late if item[0] > number]
        for _, to, data in arriving:
            inboxes[to].append(data)
        for k, agent in enumerate(agents):
            if k in dead:
                continue
            inbox = [inboxes[k][i] for i in random.permutation(len(inboxes[k]))]
            inboxes[k] = []
            for data in agent.step(inbox, number * 0.2):
                sizes.append(len(data))
                for to in [b for a, b in links if a == k]:
                    for _ in range(1 + int(random.random() < 0.2)):
                        if random.random() >= loss:
                            late.append((number + 1 + int(random.integers(0, 3)), to, data))
        held = [agent.animal for k, agent in enumerate(agents) if k not in dead and agent.animal >= 0]
        assert len(held) == len(set(held)), f"two on one animal at step {number}: {held}"
    return sizes
