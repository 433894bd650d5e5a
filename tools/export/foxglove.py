"""A fleet's logs as a file that Foxglove opens: pictures with boxes, masks and identities, positions on a
map, a scene in metres, and what there is to read.

Topics: /drone_<id>/camera, /drone_<id>/marks, /drone_<id>/fix, /animal_<id>/fix, /scene, /log.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import foxglove
from foxglove import channels as topics
from foxglove import messages as fg

from tools.export.scenes import AnimalSight, DronePose, Marks, Note, Outline, Picture, Recording, colour_of

__all__ = ["write_foxglove"]

FRAME = "fleet"  # x east, y north, z up, m, from the fleet's origin
LIFE_S = 2.0  # what nobody says again goes from the scene
DRONE_SIZE_M = 1.5
SHADE = 0.5
LEVELS = {"info": fg.LogLevel.Info, "warning": fg.LogLevel.Warning, "error": fg.LogLevel.Error}


def write_foxglove(path: Path, recording: Recording) -> int:
    """Write the file -> its messages. Raises FileExistsError."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        writer = _Writer(recording, context)
        for item in recording.items():
            writer.write(item)
    return writer.n_messages


class _Writer:
    def __init__(self, recording: Recording, context: Any) -> None:
        self._recording, self._context = recording, context
        self._topics: dict[str, Any] = {}
        self._scales: dict[int, float] = {}
        self.n_messages = 0

    def write(self, item: Any) -> None:
        writers: dict[type, Callable[[Any, int], None]] = {
            Picture: self._picture,
            Marks: self._marks,
            DronePose: self._pose,
            AnimalSight: self._animal,
            Note: self._note,
        }
        writers[type(item)](item, self._recording.time_ns(item.at_us))

    def _say(self, kind: Any, topic: str, message: Any, time_ns: int) -> None:
        if topic not in self._topics:
            self._topics[topic] = kind(topic, context=self._context)
        self._topics[topic].log(message, log_time=time_ns)
        self.n_messages += 1

    def _picture(self, item: Picture, time_ns: int) -> None:
        self._scales[item.drone_id] = item.scale
        message = fg.CompressedImage(
            timestamp=_stamp(time_ns), frame_id=f"drone_{item.drone_id}", data=item.jpeg, format="jpeg"
        )
        self._say(topics.CompressedImageChannel, f"/drone_{item.drone_id}/camera", message, time_ns)

    def _marks(self, item: Marks, time_ns: int) -> None:
        scale = self._scales.get(item.drone_id)
        if scale is None:  # no picture yet, so nothing to draw on
            return
        lines = [(box, 2.0, 0.0) for box in item.boxes] + [(mask, 3.0, 0.25) for mask in item.masks]
        points = [_line(outline, scale, thickness, fill) for outline, thickness, fill in lines]
        texts = [_label(outline, scale) for outline, _, _ in lines]
        message = fg.ImageAnnotations(timestamp=_stamp(time_ns), points=points, texts=texts)
        self._say(topics.ImageAnnotationsChannel, f"/drone_{item.drone_id}/marks", message, time_ns)

    def _pose(self, item: DronePose, time_ns: int) -> None:
        fix = fg.LocationFix(
            timestamp=_stamp(time_ns),
            frame_id=FRAME,
            latitude=item.latitude_deg,
            longitude=item.longitude_deg,
            altitude=item.height_m,
            heading=item.yaw_rad,
        )
        self._say(topics.LocationFixChannel, f"/drone_{item.drone_id}/fix", fix, time_ns)
        cube = fg.CubePrimitive(
            pose=_place(item.ned_m), size=_cube_size(DRONE_SIZE_M), color=_colour(item.animal, 1.0)
        )
        name = f"drone {item.drone_id} {item.state}"
        self._entity(f"drone_{item.drone_id}", time_ns, name, item.ned_m, item.animal, cubes=[cube])

    def _animal(self, item: AnimalSight, time_ns: int) -> None:
        variance = item.uncertainty_m**2
        fix = fg.LocationFix(
            timestamp=_stamp(time_ns),
            frame_id=FRAME,
            latitude=item.latitude_deg,
            longitude=item.longitude_deg,
            position_covariance=[variance, 0, 0, 0, variance, 0, 0, 0, 0],
            position_covariance_type=fg.LocationFixPositionCovarianceType.Approximated,
            color=_colour(item.animal, 1.0),
        )
        self._say(topics.LocationFixChannel, f"/animal_{item.animal}/fix", fix, time_ns)
        sphere = fg.SpherePrimitive(
            pose=_place(item.ned_m), size=_cube_size(item.size_m / 2), color=_colour(item.animal, SHADE)
        )
        name = f"animal {item.animal}"
        self._entity(f"animal_{item.animal}", time_ns, name, item.ned_m, item.animal, spheres=[sphere])

    def _entity(
        self, key: str, time_ns: int, name: str, ned_m: tuple[float, float, float], animal: int, **shapes: Any
    ) -> None:
        above = (ned_m[0], ned_m[1], ned_m[2] - 2 * DRONE_SIZE_M)
        text = fg.TextPrimitive(
            pose=_place(above), billboard=True, font_size=14, scale_invariant=True, text=name,
            color=_colour(animal, 1.0),
        )  # fmt: skip
        entity = fg.SceneEntity(
            timestamp=_stamp(time_ns),
            frame_id=FRAME,
            id=key,
            lifetime=fg.Duration(sec=int(LIFE_S), nsec=0),
            texts=[text],
            **shapes,
        )
        self._say(topics.SceneUpdateChannel, "/scene", fg.SceneUpdate(entities=[entity]), time_ns)

    def _note(self, item: Note, time_ns: int) -> None:
        message = fg.Log(
            timestamp=_stamp(time_ns),
            level=LEVELS[item.level],
            message=item.text,
            name=f"drone {item.drone_id} {item.source}",
        )
        self._say(topics.LogChannel, "/log", message, time_ns)


def _line(outline: Outline, scale: float, thickness: float, fill: float) -> Any:
    return fg.PointsAnnotation(
        type=fg.PointsAnnotationType.LineLoop,
        points=[fg.Point2(x=u * scale, y=v * scale) for u, v in outline.points],
        outline_color=_colour(outline.animal, 1.0),
        fill_color=_colour(outline.animal, fill),
        thickness=thickness,
    )


def _label(outline: Outline, scale: float) -> Any:
    left = min(u for u, _ in outline.points) * scale
    top = min(v for _, v in outline.points) * scale
    return fg.TextAnnotation(
        position=fg.Point2(x=left, y=top),
        text=outline.label,
        font_size=12,
        text_color=fg.Color(r=1, g=1, b=1, a=1),
        background_color=_colour(outline.animal, 0.7),
    )


def _colour(animal: int, opacity: float) -> Any:
    red, green, blue = colour_of(animal)
    return fg.Color(r=red / 255, g=green / 255, b=blue / 255, a=opacity)


def _place(ned_m: tuple[float, float, float]) -> Any:
    return fg.Pose(
        position=fg.Vector3(x=ned_m[1], y=ned_m[0], z=-ned_m[2]),
        orientation=fg.Quaternion(x=0, y=0, z=0, w=1),
    )


def _cube_size(edge_m: float) -> Any:
    return fg.Vector3(x=edge_m, y=edge_m, z=edge_m)


def _stamp(time_ns: int) -> Any:
    return fg.Timestamp(sec=time_ns // 1_000_000_000, nsec=time_ns % 1_000_000_000)
