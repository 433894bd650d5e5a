"""Whether a person ended a flight, and when: the boat's order to return or land, as the drones obeyed it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from procs.navigator.states import Event, State

__all__ = ["Order", "call_words", "fleet_order", "order_of"]

ORDERS = {Event.ORDER_RETURN.value: "return", Event.ORDER_LAND.value: "land"}
AT_REST = (State.IDLE, State.HOLD, State.RETURN, State.LAND, State.LANDED)
HEARD_S = 10.0  # an order is on its way to the last drone for no longer

States = Sequence[tuple[float, Any]]  # (time, mission_state_t) of one drone, in order


@dataclass(frozen=True)
class Order:
    """`return` or `land`, and when it was obeyed."""

    word: str
    at_s: float


def order_of(states: States) -> Order | None:
    """The first order to come home or down that a drone obeyed, None where nobody gave it one."""
    return next(
        (Order(ORDERS[row.reason], t_s) for t_s, row in states if row.reason in ORDERS),
        None,
    )


def fleet_order(states: Mapping[int, States]) -> Order | None:
    """The order that ended the whole flight: behind it no drone, told or not, was at work any more."""
    orders = [order for rows in states.values() if (order := order_of(rows)) is not None]
    last = max(orders, key=lambda order: order.at_s, default=None)
    if last is None or any(_goes_on(rows, last.at_s) for rows in states.values()):
        return None
    return last


def call_words(summary: Mapping[str, Any]) -> str:
    """A summary's orders as a sentence without its full stop; empty where there were none."""
    if summary["ordered"]:
        who = "the fleet" if len(summary["drones"]) > 1 else "the drone"
        return f"A person {_call(who, summary['ordered'])}"
    calls = [
        _call(f"drone {drone['id']}", drone["ordered"]) for drone in summary["drones"] if drone["ordered"]
    ]
    return f"A person {', '.join(calls)}" if calls else ""


def _call(who: str, order: Mapping[str, Any]) -> str:
    verb = f"called {who} home" if order["order"] == "return" else f"made {who} land"
    return f"{verb} at {order['at_s']:.0f} s"


def _goes_on(states: States, ordered_s: float) -> bool:
    """Whether a drone worked on behind an order, or ended its work then for a reason of its own."""
    behind = [row for t_s, row in states if t_s > ordered_s]
    late = [row for t_s, row in states if t_s > ordered_s + HEARD_S]
    heard = any(row.reason in (*ORDERS, Event.FLEET_RETURNS.value) for row in behind)
    return any(row.state not in AT_REST for row in (late if heard else behind))
