"""The learned method: an agent that tells both neighbours a few numbers a goal in each of a few rounds, and
then takes the goal that its network wants most (the paper's DGNN-GA, section 3, in our design).

A message: sender (1 byte); round, and 128 where a row of costs follows (1 byte); the row, 2 bytes a goal
(costs.py); then learned float16 numbers a goal. The row is that of the agent `round` hops away from the
receiver, handed on until every agent holds the whole ring, or as much of it as there are rounds. While rows
travel two learned numbers a goal go with them, afterwards three: never over 6 bytes a goal to each side.
"""

import numpy as np
from numpy.typing import NDArray

from procs.assigner.costs import FORBIDDEN, NONE, UNIT, code_values, cost_codes
from procs.assigner.learned import SLOTS, Network, network
from procs.assigner.window import bid, features, hops_relayed, observe, temperature

__all__ = ["MOST_ROUNDS", "GnnAgent", "code_costs"]

Floats = NDArray[np.float64]
Codes = NDArray[np.uint16]

HAS_ROW = 128
MOST_ROUNDS = 127


def code_costs(codes: Codes) -> Floats:
    """The costs that codes stand for, inf where forbidden."""
    return np.where(codes == FORBIDDEN, np.inf, code_values(codes) * UNIT)


class GnnAgent:
    """One agent of a ring of n: own_costs (n_goals,) >= 0, inf forbids; it is `index` in ring order.

    `step` is called rounds + 1 times: the first takes nothing, the last says nothing. What comes from no
    neighbour, from another round, twice, or of another size counts as not come. Raises ValueError for a
    NaN or negative cost, or rounds outside 1 to 127.
    """

    def __init__(
        self, own_costs: Floats, index: int, n_agents: int, rounds: int = 5, weights: Network | None = None
    ) -> None:
        if not 1 <= rounds <= MOST_ROUNDS:
            raise ValueError(f"rounds {rounds}: the learned methods take 1 to {MOST_ROUNDS}")
        self.index, self.n_agents, self.rounds = index, n_agents, rounds if n_agents > 1 else 0
        self._codes: list[Codes] = []  # the window's rows as they travel,
        self._costs: list[Floats] = []  # and the costs that they stand for
        self._held: list[bool] = []
        self._keep(cost_codes(np.asarray(own_costs, dtype=np.float64)))
        self.n_goals = len(self._codes[0])
        self._network = weights or network()
        self._number = 0
        self._last = ({0: 0}, {0: 0})  # hops -> place of the row in the window, to the left and to the right
        self._prices = np.zeros(self.n_goals + (n_agents > self.n_goals))
        self._state = self._seen = np.zeros(0)
        self._allowed = np.zeros(0, dtype=bool)
        self._started = False

    @property
    def logits(self) -> Floats:
        """(g,) how much it wants each goal by now, -inf what it must not take; the last may be for none."""
        return self._network.logits(self._state, self._seen, self._allowed)

    @property
    def goal(self) -> int:
        """The column that it wants most once all rounds are over, -1 for none, and before that."""
        if self._number < self.rounds or not self._started or not self._allowed.any():
            return NONE
        best = int(self.logits.argmax())
        return best if best < self.n_goals else NONE

    def step(self, inbox: list[bytes]) -> list[bytes]:
        """One round: take what the neighbours sent -> messages to the left and to the right neighbour (to
        the one neighbour of a pair).
        """
        if self.n_goals == 0:
            return []
        if not self._started:
            self._started = True
            seen = self._look()
            self._state = self._network.start(seen)
        elif self._number < self.rounds:
            self._number += 1
            self._listen(inbox)
        return self._say() if self._number < self.rounds else []

    def _look(self) -> Floats:
        """What the network sees of the rows held by now."""
        window = observe(np.array(self._costs), np.array(self._held), self.n_agents)
        self._prices, bids = bid(window, self._prices, temperature(self._number))
        self._allowed = window.allowed[0]
        self._seen = features(window, self._prices, bids, self.n_agents)
        return self._seen

    def _keep(self, row: Codes | None) -> None:
        """Add a row to the window, or None for one that did not come."""
        codes = row if row is not None else np.zeros(self.n_goals, dtype=np.uint16)
        self._codes.append(codes)
        self._costs.append(code_costs(codes))
        self._held.append(row is not None)

    def _listen(self, inbox: list[bytes]) -> None:
        relaying = self._number <= hops_relayed(self.n_agents)
        size = len(self._prices)
        heard = np.zeros((size, 2 * SLOTS + 2))
        for side in range(2):
            row, said = self._message(inbox, side, relaying)
            if said is not None:
                heard[:, side * SLOTS + (SLOTS - said.shape[1]) : (side + 1) * SLOTS] = said
                heard[:, 2 * SLOTS + side] = 1.0
            if relaying and not (side == 1 and 2 * self._number == self.n_agents):
                self._last[side][self._number] = len(self._codes)
                self._keep(row)
        given = np.concatenate([self._look(), heard], axis=-1)
        self._state = self._network.round(self._number, self.rounds, self._state, given)

    def _message(
        self, inbox: list[bytes], side: int, relaying: bool
    ) -> tuple[Codes | None, NDArray[np.float16] | None]:
        """The row and the numbers (g, 2 or 3) that came from the left (0) or right (1), None where none."""
        neighbour = (self.index + (1 if side else -1)) % self.n_agents
        slots = SLOTS - relaying
        for data in inbox:
            if len(data) < 2 or data[0] != neighbour or data[1] % HAS_ROW != self._number:
                continue
            row_bytes = 2 * self.n_goals if data[1] >= HAS_ROW else 0
            if len(data) != 2 + row_bytes + 2 * slots * len(self._prices):
                continue
            row = np.frombuffer(data, dtype="<u2", count=row_bytes // 2, offset=2) if row_bytes else None
            said = np.frombuffer(data, dtype="<f2", offset=2 + row_bytes)
            return row, said.reshape(len(self._prices), slots)
        return None, None

    def _say(self) -> list[bytes]:
        number = self._number + 1
        relaying = number <= hops_relayed(self.n_agents)
        said = self._network.say(self._number, self.rounds, self._state)
        messages = []
        for side in range(2):  # to the left, to the right
            # To the left goes what lies on the right, and the other way round.
            place = self._last[1 - side].get(self._number)
            row = b""
            if relaying and place is not None and self._held[place]:
                if not (side == 0 and 2 * number == self.n_agents):
                    row = self._codes[place].astype("<u2").tobytes()
            numbers = said[:, side * SLOTS + relaying : (side + 1) * SLOTS]
            header = bytes([self.index, number | (HAS_ROW if row else 0)])
            messages.append(header + row + numbers.astype("<f2").tobytes())
        return messages[1:] if self.n_agents == 2 else messages
