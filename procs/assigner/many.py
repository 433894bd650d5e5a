"""Many rings of one size at once, for evaluation: the same goals and bytes as the agents of each method find
one by one, in a thousandth of the time.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from procs.assigner.costs import NONE, cost_codes, solve_table
from procs.assigner.flood import COPIES, rounds_needed
from procs.assigner.gnn import code_costs
from procs.assigner.learned import SLOTS, Network
from procs.assigner.resolve import Lists, choose, left_over, split_rounds, wanted_goals
from procs.assigner.ring_rows import Seen, seen_by_round
from procs.assigner.window import hops_relayed

__all__ = ["Assignments", "exact_rings", "gnn_rings", "resolve_rings"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Codes = NDArray[np.uint16]

CELLS = 20_000  # (agent, goal) pairs at a time: what fits a processor's cache


@dataclass(frozen=True)
class Assignments:
    """What B rings of one size decided, and what it took."""

    goals: Ints  # (B, n_agents) goal column, -1 holds
    is_distinct: Bools  # (B,) as many different goals are taken as can be, and none twice
    rounds: int
    bytes_sent: Ints  # (B, n_agents) of encoded messages, both sides


def exact_rings(costs: Floats, loss: float, random: np.random.Generator) -> Assignments:
    """The exact method on costs (B, n, n_goals)."""
    count, n, n_goals = costs.shape
    codes, rounds = cost_codes(costs), rounds_needed(n, loss > 0)
    goals = np.array([solve_table(table) for table in codes], dtype=np.int64).reshape(count, n)
    if loss == 0:
        sent = np.full((count, n), (n - 1) * (1 + 2 * n_goals), dtype=np.int64)
        return _answer(goals, n_goals, rounds, sent)
    arrived = random.random((count, rounds, COPIES, 2, n)) >= loss
    held, sent = _flood_tables(np.asarray(arrived.any(axis=2)), n, n_goals)
    return _answer(np.where(held.all(axis=2), goals, NONE), n_goals, rounds, sent)


def _flood_tables(arrived: Bools, n: int, n_goals: int) -> tuple[Bools, Ints]:
    """Whole tables for as many rounds as arrived (B, rounds, 2, n) has -> (B, n, n) the rows held by each
    agent, (B, n) the bytes that it sent.
    """
    count = len(arrived)
    held = np.broadcast_to(np.eye(n, dtype=bool), (count, n, n)).copy()
    known = [np.zeros_like(held), np.zeros_like(held)]  # what the left, the right neighbour said it holds
    sent = np.zeros((count, n), dtype=np.int64)
    for number in range(arrived.shape[1]):
        lacking = [held & ~bitmap for bitmap in known]
        for rows in lacking[: 1 if n == 2 else 2]:
            sent += COPIES * (1 + 2 * ((n + 7) // 8) + rows.sum(axis=2) * 2 * n_goals)
        before = held.copy()
        for side, shift in enumerate((1, -1)):
            came = arrived[:, number, 0 if n == 2 else side][..., None]
            known[side] |= np.roll(before, shift, axis=1) & came
            held |= np.roll(lacking[1 - side], shift, axis=1) & came
    return held, sent


def gnn_rings(
    costs: Floats, rounds: int, loss: float, random: np.random.Generator, weights: Network
) -> Assignments:
    """The learned method on costs (B, n, n_goals)."""
    count, n, n_goals = costs.shape
    rounds = rounds if n > 1 else 0
    if n_goals == 0:
        return _answer(np.full((count, n), NONE), 0, rounds, np.zeros((count, n), dtype=np.int64))
    delivered = _delivered(random, count, rounds, n, loss)
    logits, sent = _learn(code_costs(cost_codes(costs)), rounds, delivered, weights)
    best = logits.argmax(axis=2)
    takes = (best < n_goals) & np.isfinite(logits.max(axis=2))
    return _answer(np.where(takes, best, NONE), n_goals, rounds, sent)


def _delivered(random: np.random.Generator, count: int, rounds: int, n: int, loss: float) -> Bools:
    """(rounds, 2, B, n) whether what came from the left (0) and from the right (1) arrived."""
    arrived = random.random((count, rounds, COPIES, 2, n))[:, :, 0] >= loss
    if n == 2:
        arrived[:, :, 1] = arrived[:, :, 0]
    return np.asarray(arrived.transpose(1, 2, 0, 3))


def _learn(rows: Floats, rounds: int, delivered: Bools, weights: Network) -> tuple[Floats, Ints]:
    """(logits (B, n, g) after the learned rounds, bytes sent (B, n)) from rows (B, n, n_goals)."""
    step = max(CELLS // (rows.shape[1] * rows.shape[2]), 1)
    parts = [
        _learn_some(rows[k : k + step], rounds, delivered[:, :, k : k + step], weights)
        for k in range(0, len(rows), step)
    ]
    return np.concatenate([logits for logits, _ in parts]), np.concatenate([sent for _, sent in parts])


def _learn_some(rows: Floats, rounds: int, delivered: Bools, weights: Network) -> tuple[Floats, Ints]:
    count, n, n_goals = rows.shape
    sent = np.zeros((count, n), dtype=np.int64)
    said = np.zeros((count, n, n_goals + (n > n_goals), 2 * SLOTS), dtype=np.float16)
    logits = state = np.zeros(0)
    for number, seen in enumerate(seen_by_round(rows, delivered[:rounds])):
        if number == 0:
            state = weights.start(seen.features)
        else:
            heard = _heard(said, delivered[number - 1], relaying=number <= hops_relayed(n))
            state = weights.round(number, rounds, state, np.concatenate([seen.features, heard], axis=-1))
        if number < rounds:
            said = weights.say(number, rounds, state)
            sent += _bytes_said(number + 1, seen, n_goals)
        else:
            logits = weights.logits(state, seen.features, seen.allowed)
    return logits, sent


def _bytes_said(number: int, seen: Seen, n_goals: int) -> Ints:
    """(B, n) bytes that each agent sends in round `number`, to both sides."""
    n, g = seen.allowed.shape[1:]
    relaying = number <= hops_relayed(n)
    numbers = 2 + 2 * (SLOTS - relaying) * g
    to_right = numbers + 2 * n_goals * (seen.to_hand_on[0] & relaying)
    if n == 2:
        return np.asarray(to_right)
    return np.asarray(to_right + numbers + 2 * n_goals * (seen.to_hand_on[1] & relaying & (2 * number != n)))


def _heard(said: NDArray[np.float16], arrived: Bools, relaying: bool) -> Floats:
    """(B, n, g, 2 SLOTS + 2) what each agent hears of what all said (B, n, g, 2 SLOTS)."""
    n = said.shape[1]
    heard = np.zeros((*said.shape[:3], 2 * SLOTS + 2))
    for side, shift in enumerate((1, -1)):
        to_right = side == 0 or n == 2  # a pair's messages all go to the right
        spoken = said[..., SLOTS * to_right : SLOTS * (1 + to_right)]
        came = arrived[side][..., None]
        heard[..., side * SLOTS : (side + 1) * SLOTS] = np.roll(spoken, shift, axis=1) * came[..., None]
        if relaying:
            heard[..., side * SLOTS] = 0.0
        heard[..., 2 * SLOTS + side] = came
    return heard


def resolve_rings(
    costs: Floats, rounds: int, loss: float, random: np.random.Generator, weights: Network
) -> Assignments:
    """The learned method with flooded lists on costs (B, n, n_goals)."""
    count, n, n_goals = costs.shape
    learned, flooding = split_rounds(rounds, n)
    if n_goals == 0:
        return _answer(np.full((count, n), NONE), 0, learned + flooding, np.zeros((count, n), dtype=np.int64))
    delivered = _delivered(random, count, learned + flooding, n, loss)
    codes = cost_codes(costs)
    logits, sent = _learn(code_costs(codes), learned, delivered[:learned], weights)
    lists = Lists(n, n_goals, flooding)
    named = lists.make(logits, codes)
    held, flood_bytes = _flood_lists(delivered[learned:], n, lists.n_bytes, loss > 0)
    wanted = wanted_goals(lists, logits[..., :n_goals], codes)
    goals = np.array(
        [_choose_ring(lists, named[0][k], named[1][k], held[k], wanted[k]) for k in range(count)],
        dtype=np.int64,
    ).reshape(count, n)
    return _answer(goals, n_goals, learned + flooding, sent + flood_bytes)


def _flood_lists(delivered: Bools, n: int, n_bytes: int, lossy: bool) -> tuple[Bools, Ints]:
    """(B, n, n) the lists held by each agent after as many rounds as delivered has, (B, n) bytes sent."""
    flooding, _, count, _ = delivered.shape
    held = np.broadcast_to(np.eye(n, dtype=bool), (count, n, n)).copy()
    sent = np.zeros((count, n), dtype=np.int64)
    for number in range(flooding):
        if lossy:
            sent += (1 if n == 2 else 2) * (2 + held.sum(axis=2) * n_bytes)
        elif number + 1 <= n // 2:
            sent += (1 if 2 * (number + 1) == n else 2) * (2 + n_bytes)
        before = held.copy()
        for side, shift in enumerate((1, -1)):
            held |= np.roll(before, shift, axis=1) & delivered[number, side][..., None]
    return held, sent


def _choose_ring(lists: Lists, goals: Ints, worth: Codes, held: Bools, wanted: Floats) -> Ints:
    """(n,) what each agent of one ring takes: goals, worth (n, length), held (n, n), wanted (n, n_goals)."""
    n = len(goals)
    answer = np.full(n, NONE, dtype=np.int64)
    solved: tuple[Ints, list[int]] | None = None
    for agent in range(n):
        members = np.flatnonzero(held[agent])
        if solved is None or len(members) < n:
            solved = choose(lists, goals[members], worth[members])
        chosen, free = solved
        place = int(np.searchsorted(members, agent))
        if chosen[place] == NONE:
            answer[agent] = left_over(chosen, place, free, wanted[agent])
        elif chosen[place] < lists.n_goals:
            answer[agent] = chosen[place]
        if len(members) < n:
            solved = None
    return answer


def _answer(goals: Ints, n_goals: int, rounds: int, sent: Ints) -> Assignments:
    ordered = np.sort(goals, axis=1)
    twice = ((ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] != NONE)).any(axis=1)
    enough = (goals != NONE).sum(axis=1) == min(goals.shape[1], n_goals)
    return Assignments(goals.astype(np.int64), np.asarray(~twice & enough), rounds, sent)
