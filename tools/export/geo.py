"""Tracks as GeoJSON (RFC 7946), CSV and GPX 1.1, for maps and tables.

Where no drone's GPS told the time and nobody gives it, times count from 1970-01-01T00:00:00Z at the logs'
first message, and each file says so.
"""

import csv
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tools.export.tracks import Point, Track

__all__ = ["CSV_COLUMNS", "write_csv", "write_geojson", "write_gpx"]

CSV_COLUMNS = (
    "kind", "number", "time_s", "time_utc", "latitude_deg", "longitude_deg", "height_m", "north_m", "east_m",
    "uncertainty_m", "note",
)  # fmt: skip
GPX = "http://www.topografix.com/GPX/1/1"
OURS = "urn:podwatch:gpx:1"  # namespace of what GPX has no element for
ABOUT = (
    "Positions in WGS 84. Heights in m above the surface at the fleet's origin. uncertainty_m of an animal: "
    "m between one drone's sight of it and the fleet's map; a drone's is not logged. "
)
TIMES = {
    True: "Times are UTC.",
    False: "Times count from the logs' first message, not from 1970: no drone's GPS told the time; "
    "--began gives it.",
}


def write_csv(path: Path, tracks: Sequence[Track], *, is_utc: bool) -> None:
    """One point a row; the units are in the columns' names. time_utc is empty where it is not known."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(CSV_COLUMNS)
        for track in tracks:
            for point in track.points:
                writer.writerow([track.kind, track.number, *_row(point, is_utc), point.note])


def write_geojson(path: Path, tracks: Sequence[Track], *, is_utc: bool) -> None:
    """One line a track, a point where it has only one; times and uncertainties lie beside its coordinates."""
    document = {
        "type": "FeatureCollection",
        "description": ABOUT + TIMES[is_utc],
        "features": [_feature(track, is_utc) for track in tracks if track.points],
    }
    path.write_text(json.dumps(document, separators=(",", ":")) + "\n")


def write_gpx(path: Path, tracks: Sequence[Track], *, is_utc: bool) -> None:
    """One <trk> a drone or animal; the uncertainty is an extension of its points."""
    ElementTree.register_namespace("", GPX)
    ElementTree.register_namespace("podwatch", OURS)
    root = ElementTree.Element(f"{{{GPX}}}gpx", {"version": "1.1", "creator": "podwatch"})
    metadata = ElementTree.SubElement(root, f"{{{GPX}}}metadata")
    ElementTree.SubElement(metadata, f"{{{GPX}}}desc").text = ABOUT + TIMES[is_utc]
    for track in tracks:
        element = ElementTree.SubElement(root, f"{{{GPX}}}trk")
        ElementTree.SubElement(element, f"{{{GPX}}}name").text = track.name
        ElementTree.SubElement(element, f"{{{GPX}}}type").text = track.kind
        segment = ElementTree.SubElement(element, f"{{{GPX}}}trkseg")
        for point in track.points:
            _gpx_point(segment, point)
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _gpx_point(segment: ElementTree.Element, point: Point) -> None:
    place = {"lat": f"{point.latitude_deg:.8f}", "lon": f"{point.longitude_deg:.8f}"}
    element = ElementTree.SubElement(segment, f"{{{GPX}}}trkpt", place)
    ElementTree.SubElement(element, f"{{{GPX}}}ele").text = f"{round(point.height_m, 2) + 0.0:.2f}"
    ElementTree.SubElement(element, f"{{{GPX}}}time").text = _utc(point)
    ElementTree.SubElement(element, f"{{{GPX}}}desc").text = _described(point)
    if point.uncertainty_m is not None:
        extensions = ElementTree.SubElement(element, f"{{{GPX}}}extensions")
        ElementTree.SubElement(extensions, f"{{{OURS}}}uncertainty_m").text = f"{point.uncertainty_m:.2f}"


def _feature(track: Track, is_utc: bool) -> dict[str, Any]:
    places = [
        [round(point.longitude_deg, 8), round(point.latitude_deg, 8), round(point.height_m, 2) + 0.0]
        for point in track.points
    ]
    properties: dict[str, Any] = {
        "name": track.name,
        "kind": track.kind,
        "number": track.number,
        "times_s": [round(point.time_s, 3) for point in track.points],
        "notes": [point.note for point in track.points],
    }
    if is_utc:
        properties["coordTimes"] = [_utc(point) for point in track.points]
    if track.kind == "animal":
        properties["uncertainties_m"] = [_rounded(point.uncertainty_m) for point in track.points]
    geometry = (
        {"type": "Point", "coordinates": places[0]}
        if len(places) == 1
        else {"type": "LineString", "coordinates": places}
    )
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _row(point: Point, is_utc: bool) -> list[str]:
    return [
        f"{point.time_s:.3f}",
        _utc(point) if is_utc else "",
        f"{point.latitude_deg:.8f}",
        f"{point.longitude_deg:.8f}",
        f"{round(point.height_m, 2) + 0.0:.2f}",
        f"{point.n_m:.2f}",
        f"{point.e_m:.2f}",
        "" if point.uncertainty_m is None else f"{point.uncertainty_m:.2f}",
    ]


def _described(point: Point) -> str:
    """For readers that show no extension."""
    return point.note if point.uncertainty_m is None else f"{point.note}, within {point.uncertainty_m:.2f} m"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _utc(point: Point) -> str:
    moment = datetime.fromtimestamp(point.time_ns / 1e9, tz=UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
