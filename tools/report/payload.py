"""What the page's script draws, as compact JSON: whole decimetres and degrees on one grid of time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.report.flights import Flight
from tools.report.series import Chart
from tools.report.stills import Still
from tools.report.ways import Ways
from tools.report.words import state_words
from tools.sights import Span

__all__ = ["payload_of"]

Array = NDArray[np.float64]
DEFAULT_LENGTH_M = 10.0


def payload_of(
    flight: Flight,
    ways: Ways,
    states: dict[int, list[Span]],
    watched: dict[int, list[Span]],
    stills: Sequence[Still],
    charts: Sequence[Chart],
) -> dict[str, Any]:
    """One mission for the script; docs/report.md names every member."""
    width_px, height_px = flight.run.truth.camera.image_size
    focal_px = flight.run.truth.camera.focal_px
    return {
        "end": round(flight.end_s, 1),
        "step": ways.step_s,
        "view": [round(width_px / 2 / focal_px, 4), round(height_px / 2 / focal_px, 4)],
        "drones": [
            {
                "id": drone_id,
                "n": _whole(way[:, 0] * 10),
                "e": _whole(way[:, 1] * 10),
                "h": _whole(way[:, 2] * 10),
                "yaw": _whole(np.degrees(way[:, 3])),
                "states": [_span(s, state_words(str(s.what))) for s in states.get(drone_id, [])],
                "watched": [_span(s, s.what) for s in watched.get(drone_id, [])],
            }
            for drone_id, way in sorted(ways.drones.items())
        ],
        "animals": [
            {
                "id": number,
                "n": _whole(way[:, 0] * 10),
                "e": _whole(way[:, 1] * 10),
                "length": round(ways.lengths_m.get(number, DEFAULT_LENGTH_M), 1),
            }
            for number, way in sorted(ways.animals.items())
        ],
        "pictures": [_picture(still) for still in sorted(stills, key=lambda s: (s.drone_id, s.t_s))],
        "charts": [_chart(chart) for chart in charts],
    }


def _whole(values: Array) -> list[int | None]:
    return [round(value) if np.isfinite(value) else None for value in values.tolist()]


def _span(span: Span, what: str | int) -> list[Any]:
    return [round(span.from_s, 1), round(span.to_s, 1), what]


def _picture(still: Still) -> dict[str, Any]:
    return {
        "t": round(still.t_s, 1),
        "drone": still.drone_id,
        "size": [still.width, still.height],
        "src": still.uri,
        "marks": [
            [*(round(edge) for edge in (m.x, m.y, m.width, m.height)), m.number, int(m.is_own)]
            for m in still.marks
        ],
    }


def _chart(chart: Chart) -> dict[str, Any]:
    return {
        "key": chart.key,
        "title": chart.title,
        "unit": chart.unit,
        "bin": round(chart.bin_s, 3),
        "mark": list(chart.mark) if chart.mark else None,
        "top": chart.top,
        "curves": [
            {"name": curve.name, "drone": curve.drone_id, "values": list(curve.values)}
            for curve in chart.curves
        ],
    }
