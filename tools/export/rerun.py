"""A fleet's logs as a Rerun recording: pictures with boxes, masks and identities, a scene in metres, a map,
and what there is to read.

Entities: drone_<id>/camera with marks on it, scene/drone_<id>, scene/animal_<id>, map/..., log. The timeline
is `time`: seconds since the logs' first message, or the wall time where that is known.
"""

from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from tools.export.scenes import AnimalSight, DronePose, Marks, Note, Outline, Picture, Recording, colour_of

__all__ = ["write_rerun"]

APPLICATION = "podwatch"
TIMELINE = "time"
LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


def write_rerun(path: Path, recording: Recording) -> int:
    """Write the recording -> what was logged. Raises FileExistsError."""
    if path.exists():
        raise FileExistsError(f"{path}: exists already and is not overwritten")
    stream = rr.RecordingStream(APPLICATION, recording_id=path.stem)
    stream.save(path, default_blueprint=_layout(recording))
    stream.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    writer = _Writer(recording, stream)
    for item in recording.items():
        writer.write(item)
    stream.flush()
    stream.disconnect()
    return writer.n_logged


def _layout(recording: Recording) -> Any:
    """Every camera, below them the scene, the map and the words."""
    cameras = [
        rrb.Spatial2DView(origin=f"drone_{drone_id}/camera", name=f"drone {drone_id}")
        for drone_id in recording.fleet.drone_ids
    ]
    around = (
        rrb.Spatial3DView(origin="scene", name="scene, m"),
        rrb.MapView(origin="map", name="map"),
        rrb.TextLogView(origin="log", name="log"),
    )
    return rrb.Blueprint(
        rrb.Vertical(rrb.Grid(*cameras), rrb.Horizontal(*around), row_shares=[3, 2]), collapse_panels=True
    )


class _Writer:
    def __init__(self, recording: Recording, stream: Any) -> None:
        self._recording, self._stream = recording, stream
        self._scales: dict[int, float] = {}
        self.n_logged = 0

    def write(self, item: Any) -> None:
        if self._recording.began is None:
            self._stream.set_time(TIMELINE, duration=self._recording.time_s(item.at_us))
        else:
            self._stream.set_time(
                TIMELINE, timestamp=np.datetime64(self._recording.time_ns(item.at_us), "ns")
            )
        if isinstance(item, Picture):
            self._scales[item.drone_id] = item.scale
            self._log(
                f"drone_{item.drone_id}/camera", rr.EncodedImage(contents=item.jpeg, media_type="image/jpeg")
            )
        elif isinstance(item, Marks):
            self._marks(item)
        elif isinstance(item, DronePose):
            name, label = f"drone_{item.drone_id}", f"drone {item.drone_id} {item.state}"
            self._place(name, label, item.ned_m, 0.8, item.animal, item.latitude_deg, item.longitude_deg)
        elif isinstance(item, AnimalSight):
            name, label = f"animal_{item.animal}", f"animal {item.animal}"
            self._place(
                name, label, item.ned_m, item.size_m / 4, item.animal, item.latitude_deg, item.longitude_deg
            )
        elif isinstance(item, Note):
            text = f"drone {item.drone_id} {item.source}: {item.text}"
            self._log("log", rr.TextLog(text, level=LEVELS[item.level]))

    def _log(self, entity: str, what: Any) -> None:
        self._stream.log(entity, what)
        self.n_logged += 1

    def _marks(self, item: Marks) -> None:
        scale = self._scales.get(item.drone_id)
        if scale is None:  # no picture yet, so nothing to draw on
            return
        corners = [np.asarray(box.points) * scale for box in item.boxes]
        self._log(
            f"drone_{item.drone_id}/camera/boxes",
            rr.Boxes2D(
                mins=[corner.min(axis=0) for corner in corners],
                sizes=[np.ptp(corner, axis=0) for corner in corners],
                labels=[box.label for box in item.boxes],
                colors=[colour_of(box.animal) for box in item.boxes],
            ),
        )
        self._log(
            f"drone_{item.drone_id}/camera/mask",
            rr.LineStrips2D(
                [_closed(mask) * scale for mask in item.masks],
                labels=[mask.label for mask in item.masks],
                colors=[colour_of(mask.animal) for mask in item.masks],
                radii=[1.0] * len(item.masks),
            ),
        )

    def _place(
        self,
        name: str,
        label: str,
        ned_m: tuple[float, float, float],
        radius_m: float,
        animal: int,
        latitude_deg: float,
        longitude_deg: float,
    ) -> None:
        n_m, e_m, d_m = ned_m
        colours = [colour_of(animal)]
        self._log(
            f"scene/{name}", rr.Points3D([[e_m, n_m, -d_m]], radii=[radius_m], colors=colours, labels=[label])
        )
        self._log(f"map/{name}", rr.GeoPoints(lat_lon=[[latitude_deg, longitude_deg]], colors=colours))


def _closed(outline: Outline) -> Any:
    return np.asarray([*outline.points, outline.points[0]], np.float32)
