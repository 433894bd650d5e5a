"""Your own pictures: a YOLO data set in any of the shapes in which people have them."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from tools.errors import UnusableError
from tools.train.detector.labels import text_of
from tools.train.detector.reduction import useful
from tools.train.detector.samples import Sample, read_yolo

__all__ = ["learnt_as_well", "own_pictures", "validation_pictures"]

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")


def own_pictures(data_yaml: Path, classes: Sequence[str] = (), side: int = 320) -> list[Sample]:
    """The pictures that `train` of a YOLO data.yaml names, as far as pictures of `side` px can show them.

    The entry is a folder, searched with all below it, a text file that lists pictures, or a list of either;
    labels lie in labels/ beside images/. classes: names or numbers of those that count as whales; needed
    where the data set has several, what is of another class is then water. Raises UnusableError naming what
    is wrong.
    """
    samples: list[Sample] = []
    count = 0
    for picture in _pictures(data_yaml, classes, "train"):
        samples += useful(picture, side)
        count += 1
    if len(samples) > count:
        print(f"{data_yaml}: {count} pictures kept as {len(samples)}, the large ones cut round their animals")
    return samples


def validation_pictures(data_yaml: Path, classes: Sequence[str] = ()) -> Iterator[Sample]:
    """The same of its entry `val`, one by one and as they are; none where nothing lies there."""
    return _pictures(data_yaml, classes, "val", optional=True)


def learnt_as_well(data_yaml: Path, classes: Sequence[str] = ()) -> int:
    """How many of the pictures of `val` are pictures of `train` too."""
    learnt, kept_back = (_files(data_yaml, classes, part, optional=True)[0] for part in ("train", "val"))
    return sum(path in learnt for path in kept_back)


def _pictures(data_yaml: Path, classes: Sequence[str], part: str, optional: bool = False) -> Iterator[Sample]:
    files, counted = _files(data_yaml, classes, part, optional)
    for path, labels in files.items():
        yield from read_yolo([path], labels, counted)


def _files(
    data_yaml: Path, classes: Sequence[str], part: str, optional: bool
) -> tuple[dict[Path, Path], dict[int, bool]]:
    """Of each picture of an entry the folder of its labels, and of each class whether it counts."""
    if not data_yaml.is_file():
        raise UnusableError(f"{data_yaml}: no such file; give the data.yaml of a YOLO data set")
    try:
        entries = _read(data_yaml)
        counted = _counted(entries, classes)
        if not entries.get(part):
            if optional:
                return {}, counted
            raise ValueError(f"has no entry {part!r}; it must name the folder of its pictures")
    except ValueError as error:
        raise UnusableError(f"{data_yaml}: {error}") from None
    root = data_yaml.parent / str(entries.get("path") or ".")
    named = [str(name) for name in (entries[part] if isinstance(entries[part], list) else [entries[part]])]
    found = list(dict.fromkeys(path for name in named for path in _listed(_place(root, name), root)))
    if not found:
        if optional:  # Roboflow names folders that it leaves out
            return {}, counted
        raise UnusableError(f"{data_yaml}: no pictures ({', '.join(PICTURES)}) in {_place(root, named[0])}")
    folders = {folder: _labels_beside(folder) for folder in sorted({path.parent for path in found})}
    if not any((folders[path.parent] / f"{path.stem}.txt").is_file() for path in found):
        raise UnusableError(
            f"{data_yaml}: none of its {len(found)} pictures has a label file in {folders[found[0].parent]}; "
            "one without animals has an empty one"
        )
    in_folders = sorted(found, key=lambda path: path.parent)
    return {path: folders[path.parent] for path in in_folders}, counted


def _read(data_yaml: Path) -> dict[str, Any]:
    """The entries of a data.yaml. Raises ValueError where it is no YAML, or no mapping."""
    try:
        entries = yaml.safe_load(text_of(data_yaml))
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ValueError(f"is no YAML at line {line}: {error.problem}") from None
    except yaml.YAMLError as error:  # such as control characters
        raise ValueError(f"is no YAML: {' '.join(str(error).split())}") from None
    if not isinstance(entries, dict):
        raise ValueError("is no mapping of keys to values, such as 'train: images/train'")
    return entries


def _counted(entries: dict[str, Any], classes: Sequence[str]) -> dict[int, bool]:
    """Of each class number whether it counts. Raises ValueError where that is not known."""
    many = entries.get("nc", 0)
    if not isinstance(many, int):
        raise ValueError(f"nc is {many!r}, which is no number of classes")
    given = entries.get("names") or [str(number) for number in range(many)]
    names = (
        given if isinstance(given, dict) else dict(enumerate(given if isinstance(given, list) else [given]))
    )
    if not names or not all(isinstance(number, int) for number in names):
        raise ValueError("has no entry 'names' that gives each class number a name: names: [whale]")
    told = ", ".join(f"{number} {name}" for number, name in names.items())
    known = {str(word) for pair in names.items() for word in pair}
    for asked in classes:
        if asked not in known:
            raise ValueError(f"has no class {asked!r}; there are: {told}")
    if not classes and len(names) > 1:
        raise ValueError(
            f"has {len(names)} classes, and the network knows whales alone; say which count: "
            f"--classes {next(iter(names.values()))} (there are: {told})"
        )
    return {
        number: not classes or str(name) in classes or str(number) in classes
        for number, name in names.items()
    }


def _place(root: Path, name: str) -> Path:
    """Where an entry points; `../train/images` may lie beside the data.yaml, as Roboflow writes it."""
    place = Path(os.path.abspath(root / name))  # links stay: labels lie beside the link
    beside = Path(os.path.abspath(root / name.removeprefix("../")))
    return place if place.exists() or not beside.exists() else beside


def _listed(place: Path, root: Path) -> Sequence[Path]:
    """The pictures of a folder and all below it, or of a text file with one picture a line."""
    if place.suffix == ".txt" and place.is_file():
        lines = [line.strip() for line in text_of(place).splitlines()]
        return [_place(root, line) for line in lines if line]
    return sorted(p for p in place.rglob("*") if p.suffix.lower() in PICTURES and p.name[0] != ".")


def _labels_beside(images: Path) -> Path:
    """labels/ in the place of the last images/ of a path; the same folder where it has none."""
    parts = list(images.parts)
    where = max((index for index, part in enumerate(parts) if part == "images"), default=-1)
    return Path(*parts[:where], "labels", *parts[where + 1 :]) if where >= 0 else images
