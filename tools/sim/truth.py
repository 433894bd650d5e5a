"""The judge's files of a run: truth.csv and truth.mcap, written from the world, read by nobody that flies."""

import csv
from pathlib import Path

import cv2

from lcmtypes import channels, make
from lcmtypes.podwatch import world_animal_t, world_state_t
from logs.writer import LogWriter

__all__ = ["TruthWriter", "labelled_animals"]

CSV_PERIOD_US = 200_000


class TruthWriter:
    """Writes what really happened; `animals` replaces the world's own where a picture is the surface."""

    def __init__(self, folder: Path, animals: list[world_animal_t] | None = None) -> None:
        self._animals = animals
        self._log = LogWriter(folder / "truth.mcap", drone_id=0, metadata={"what": "the simulator's truth"})
        self._file = (folder / "truth.csv").open("w", newline="")
        self._rows = csv.writer(self._file)
        self._rows.writerow(["t_s", "kind", "id", "n_m", "e_m"])
        self._next_row_us = 0

    def write(self, state: world_state_t) -> None:
        """Keep one state of the world."""
        if self._animals is not None:
            state.animals, state.n_animals = self._animals, len(self._animals)
        self._log.write(channels.WORLD_STATE, state.encode(), state.utime)
        if state.utime < self._next_row_us:
            return
        self._next_row_us += CSV_PERIOD_US
        t_s = f"{state.utime / 1e6:.1f}"
        for drone in state.drones:
            if drone.alive:
                self._rows.writerow([t_s, "drone", drone.id, f"{drone.n_m:.3f}", f"{drone.e_m:.3f}"])
        for animal in state.animals:
            self._rows.writerow([t_s, "animal", animal.id, f"{animal.n_m:.3f}", f"{animal.e_m:.3f}"])

    def close(self) -> None:
        """Finish both files."""
        self._log.close()
        self._file.close()


def labelled_animals(
    scene: Path, width_m: float, centre_ne: tuple[float, float]
) -> list[world_animal_t] | None:
    """The animals of a picture's YOLO labels (same name, .txt, beside it or in ../labels); None without such
    a file.
    """
    places = (scene.with_suffix(".txt"), scene.parent.parent / "labels" / f"{scene.stem}.txt")
    labels = next((place for place in places if place.exists()), None)
    image = cv2.imread(str(scene)) if labels else None
    if labels is None or image is None:
        return None
    metres_per_px = width_m / image.shape[1]
    height_m = image.shape[0] * metres_per_px
    animals = []
    for row, line in enumerate(line for line in labels.read_text().splitlines() if line.strip()):
        _, u, v, width, height = (float(part) for part in line.split()[:5])
        animals.append(
            make(
                world_animal_t,
                id=row + 1,
                n_m=centre_ne[0] + (0.5 - v) * height_m,
                e_m=centre_ne[1] + (u - 0.5) * width_m,
                length_m=max(width * width_m, height * height_m),
                species="labelled",
            )
        )
    return animals
