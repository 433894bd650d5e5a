"""Your own pictures: a YOLO data set in any of the shapes in which people have them."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from tools.errors import UnusableError
from tools.train.detector.labels import text_of
from tools.train.detector.samples import Sample, read_yolo

__all__ = ["own_pictures"]

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")
# What commas divide: quoted text, lists and mappings are whole.
PART = re.compile(r"""(?:[^,\[\]{}'"]|'[^']*'|"[^"]*"|\[[^\]]*\]|\{[^}]*\})+""")


def own_pictures(data_yaml: Path, classes: Sequence[str] = (), part: str = "train") -> list[Sample]:
    """The pictures that `part` of a YOLO data.yaml names, whose labels lie in labels/ beside images/.

    The entry is a folder, searched with all below it, a text file that lists pictures, or a list of either.
    classes: names or numbers of those that count as whales; needed where the data set has several, what is
    of another class is then water. Raises UnusableError naming what is wrong.
    """
    if not data_yaml.is_file():
        raise UnusableError(f"{data_yaml}: no such file; give the data.yaml of a YOLO data set")
    try:
        entries = _entries(text_of(data_yaml), ("path", "nc", "names", part))
        counted = _counted(entries, classes)
        if not entries.get(part):
            raise ValueError(f"has no entry {part!r}; it must name the folder of its pictures")
    except ValueError as error:
        raise UnusableError(f"{data_yaml}: {error}") from None
    root = data_yaml.parent / entries.get("path", {}).get("0", ".")
    named = list(entries[part].values())
    found = list(dict.fromkeys(path for name in named for path in _listed(_place(root, name), root)))
    if not found:
        raise UnusableError(f"{data_yaml}: no pictures ({', '.join(PICTURES)}) in {_place(root, named[0])}")
    folders = {folder: _labels_beside(folder) for folder in sorted({path.parent for path in found})}
    if not any((folders[path.parent] / f"{path.stem}.txt").is_file() for path in found):
        raise UnusableError(
            f"{data_yaml}: none of its {len(found)} pictures has a label file in {folders[found[0].parent]}; "
            "one without animals has an empty one"
        )
    samples: list[Sample] = []
    for folder, labels in folders.items():
        samples += read_yolo([path for path in found if path.parent == folder], labels, counted)
    return samples


def _counted(entries: dict[str, dict[str, str]], classes: Sequence[str]) -> dict[int, bool]:
    """Of each class number whether it counts. Raises ValueError where that is not known."""
    many = entries.get("nc", {}).get("0", "0")
    if not many.isdecimal():
        raise ValueError(f"nc is {many!r}, which is no number of classes")
    names = entries.get("names") or {str(number): str(number) for number in range(int(many))}
    if not names or not all(number.isdecimal() for number in names):
        raise ValueError("has no entry 'names' that gives each class number a name: names: [whale]")
    told = ", ".join(f"{number} {name}" for number, name in names.items())
    for asked in classes:
        if asked not in names and asked not in names.values():
            raise ValueError(f"has no class {asked!r}; there are: {told}")
    if not classes and len(names) > 1:
        raise ValueError(
            f"has {len(names)} classes, and the network knows whales alone; say which count: "
            f"--classes {next(iter(names.values()))} (there are: {told})"
        )
    return {
        int(number): not classes or name in classes or number in classes for number, name in names.items()
    }


def _entries(text: str, wanted: Sequence[str]) -> dict[str, dict[str, str]]:
    """What stands under the wanted keys of a data.yaml: the items of a mapping, or of a list by "0",
    "1", ...; one text alone is item "0". Raises ValueError for a line that is none of these.
    """
    lines = [re.sub(r"(^|\s)#.*", "", line).rstrip() for line in text.splitlines()]
    lines = [line for line in lines if line and line not in ("---", "...")]
    whole = " ".join(lines).strip()
    if whole.startswith("{"):
        return {key: _items(value) for key, value in map(_pair, _parts(whole)) if key in wanted}
    blocks: dict[str, list[str]] = {}
    for line in lines:
        if not blocks or (line[0] not in " \t-" and ":" in line):
            key, value = _pair(line)
            blocks[key] = [value] if value else []
        else:
            blocks[key].append(line.strip())
    return {key: _block(block) for key, block in blocks.items() if key in wanted}


def _block(lines: list[str]) -> dict[str, str]:
    if all(line.startswith("- ") for line in lines):
        return {str(index): _plain(line[2:]) for index, line in enumerate(lines)}
    return (
        dict(map(_pair, lines))
        if ": " in lines[0] and lines[0][0] not in "[{'\""
        else _items(" ".join(lines))
    )


def _items(value: str) -> dict[str, str]:
    """Of a value in one line: [a, b], {0: a, 1: b}, or a text."""
    if value.startswith("{"):
        return dict(map(_pair, _parts(value)))
    parts = _parts(value) if value.startswith("[") else [value]
    return {str(index): _plain(part) for index, part in enumerate(parts) if part}


def _parts(value: str) -> list[str]:
    if value[-1] != {"[": "]", "{": "}"}[value[0]]:
        raise ValueError(f"{value!r} has no end")
    return [part.strip() for part in PART.findall(value[1:-1]) if part.strip()]


def _pair(line: str) -> tuple[str, str]:
    key, colon, value = line.partition(":")
    if not colon:
        raise ValueError(f"{line.strip()!r} is not 'key: value'")
    return _plain(key), value.strip() if value.strip()[:1] in ("[", "{") else _plain(value)


def _plain(text: str) -> str:
    return text.strip().strip("'\"")


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
