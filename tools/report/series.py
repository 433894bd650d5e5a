"""Figures over time for the charts: battery, tracker rate, delay, radio loss and bytes by kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcmtypes import channels
from tools.report.flights import Flight
from tools.report.words import KIND_WORDS
from tools.sights import inside, monitor_spans

__all__ = ["Chart", "Curve", "make_charts"]

Array = NDArray[np.float64]

MOST_BINS = 150
LEAST_BIN_S = 2.0


@dataclass(frozen=True)
class Curve:
    """One line of a chart. drone_id: whose colour it has, None for the k-th of others."""

    name: str
    drone_id: int | None
    values: tuple[float | None, ...]  # one a bin


@dataclass(frozen=True)
class Chart:
    """What is drawn over time; `mark`: (a level worth a line, its words)."""

    key: str
    title: str
    unit: str
    note: str
    bin_s: float
    curves: tuple[Curve, ...]
    mark: tuple[float, str] | None = None
    top: float | None = None  # of the axis, where it is fixed


def make_charts(flight: Flight) -> list[Chart]:
    """The charts for which there is something to draw."""
    bin_s = max(LEAST_BIN_S, flight.end_s / MOST_BINS)
    n_bins = int(flight.end_s / bin_s) + 1
    bins = _Bins(bin_s, n_bins)
    charts = [
        _battery(flight, bins),
        _loss(flight, bins),
        _traffic(flight, bins),
        _tracker(flight, bins),
        _delay(flight, bins),
    ]
    return [chart for chart in charts if chart.curves]


class _Bins:
    def __init__(self, bin_s: float, n_bins: int) -> None:
        self.bin_s = bin_s
        self._n_bins = n_bins

    def means(self, samples: Sequence[tuple[float, float]]) -> tuple[float | None, ...]:
        """Mean of (instant, value) in each bin, None where there is none."""
        total, n_in = np.zeros(self._n_bins), np.zeros(self._n_bins)
        for t_s, value in samples:
            if np.isfinite(value):
                k = min(max(int(t_s / self.bin_s), 0), self._n_bins - 1)
                total[k] += value
                n_in[k] += 1
        return tuple(round(float(a / b), 2) if b else None for a, b in zip(total, n_in, strict=True))

    def rates(self, instants: Array, within: Array) -> tuple[float | None, ...]:
        """Events a second in each bin; None in one that lies whole in no row (from, to) of `within`."""
        edges = np.arange(self._n_bins + 1) * self.bin_s
        counts, _ = np.histogram(instants, edges)
        return tuple(
            round(float(n / self.bin_s), 2) if any(a <= from_s and to_s <= b for a, b in within) else None
            for n, from_s, to_s in zip(counts, edges[:-1], edges[1:], strict=True)
        )


def _battery(flight: Flight, bins: _Bins) -> Chart:
    curves = []
    for log in flight.run.drones:
        states = flight.run.messages[log.id][channels.VEHICLE_STATE]
        values = bins.means([(t_s, 100 * state.battery) for t_s, state in states if state.battery >= 0])
        curves.append(Curve(f"drone {log.id}", log.id, values))
    limits = flight.run.mission.get("limits")
    share = limits.get("battery_return") if isinstance(limits, dict) else None
    level = 100 * share if isinstance(share, int | float) else None
    return Chart(
        "battery",
        "Battery left",
        "%",
        "How much charge each drone's autopilot said it had left.",
        bins.bin_s,
        _drawn(curves),
        (level, "flies home") if level is not None else None,
        100.0,
    )


def _loss(flight: Flight, bins: _Bins) -> Chart:
    curves = []
    for log in flight.run.drones:
        rows = flight.run.messages[log.id][channels.LINK_STATE]
        samples = [
            (t_s, 100 * max(link.loss for link in links))
            for t_s, state in rows
            if (links := [link for link in state.links if link.up and link.peer_id > 0])
        ]
        curves.append(Curve(f"drone {log.id}", log.id, bins.means(samples)))
    return Chart(
        "loss",
        "Radio messages lost",
        "%",
        "Of what a drone's neighbours sent, the share that did not arrive, on its worst link.",
        bins.bin_s,
        _drawn(curves),
    )


def _traffic(flight: Flight, bins: _Bins) -> Chart:
    by_kind: dict[str, list[tuple[float, float]]] = {}
    for log in flight.run.drones:
        for t_s, state in flight.run.messages[log.id][channels.LINK_STATE]:
            sent: dict[str, float] = dict.fromkeys(KIND_WORDS, 0.0)
            n_links = 0
            for link in state.links:
                n_links += link.up
                for kind, n_bytes in zip(link.kinds, link.bytes_out, strict=False):
                    sent[kind] = sent.get(kind, 0.0) + n_bytes
            if n_links:
                for kind, n_bytes in sent.items():
                    by_kind.setdefault(kind, []).append((t_s, n_bytes / n_links))
    curves = [
        Curve(KIND_WORDS.get(kind, kind), None, bins.means(samples))
        for kind, samples in sorted(by_kind.items())
        if any(value for _, value in samples)
    ]
    return Chart(
        "traffic",
        "What the drones said by radio",
        "bytes a second",
        "Of each kind, over one link in the mean. A small picture would be 10,000 bytes; none is ever sent.",
        bins.bin_s,
        _drawn(curves),
    )


def _tracker(flight: Flight, bins: _Bins) -> Chart:
    curves = []
    for log in flight.run.drones:
        spans = monitor_spans(log)
        seen = inside(log.track_t_s, spans) & np.isfinite(log.track_px).all(axis=1)
        values = bins.rates(log.track_t_s[seen], np.array(spans).reshape(-1, 2))
        curves.append(Curve(f"drone {log.id}", log.id, values))
    return Chart(
        "tracker",
        "Looks at its animal",
        "a second",
        "How often a second each drone found its animal in its picture while it watched.",
        bins.bin_s,
        _drawn(curves),
    )


def _delay(flight: Flight, bins: _Bins) -> Chart:
    curves = []
    for log in flight.run.drones:
        first: dict[int, tuple[float, float]] = {}
        for t_s, setpoint in flight.run.messages[log.id][channels.SETPOINT]:
            if setpoint.cause_utime:
                first.setdefault(setpoint.cause_utime, (t_s, (setpoint.utime - setpoint.cause_utime) / 1000))
        curves.append(Curve(f"drone {log.id}", log.id, bins.means(list(first.values()))))
    return Chart(
        "delay",
        "From picture to steering",
        "ms",
        "Time from the instant of a picture to the first steering command that rests on it.",
        bins.bin_s,
        _drawn(curves),
    )


def _drawn(curves: Sequence[Curve]) -> tuple[Curve, ...]:
    return tuple(curve for curve in curves if any(value is not None for value in curve.values))
