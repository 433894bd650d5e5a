"""Which files of a drone's log belong together: those of one boot of its computer.

The drone's clock begins anew at each boot, so what was logged before and after has no common time: it is two
logs, although the logger numbers its files on. A log says of which boot it is. Where files do not say it
(simulated ones, those of older versions), one that begins before the last one's end is of another.
"""

import glob
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from logs.exceptions import LogError
from logs.scan import Scan
from logs.writer import BOOT, METADATA, picture_path

__all__ = ["boots", "numbered", "other_boots", "pictures", "segments", "stray_pictures", "whose"]

PathLike = str | os.PathLike[str]


@dataclass
class _Boot:
    """Files of one boot in their order; id: "" where none of them says it."""

    id: str
    files: list[Path]

    def goes_on_in(self, path: Path) -> bool:
        """Whether the next file, or this boot, does not say whose it is, and the clock runs on in it."""
        span = _span_ns(path)
        ends_ns = [known[1] for file in self.files if (known := _span_ns(file)) is not None]
        return span is None or span[0] >= max(ends_ns, default=0)


def numbered(path: PathLike) -> list[Path]:
    """Every file of the log at `path` in the order of their numbers, of whatever boot: `path`, name.1.mcap,
    name.2.mcap, ...

    A logger that was restarted, or that begins a new file now and then, numbers them on; the oldest may have
    been dropped for room. `path` alone where there are none.
    """
    first = Path(path)
    found = {0: first} if first.exists() else {}
    for other in first.parent.glob(f"{glob.escape(first.stem)}.*{first.suffix}"):
        number = other.stem.removeprefix(f"{first.stem}.")
        if number.isdigit():
            found[int(number)] = other
    return [found[number] for number in sorted(found)] or [first]


def boots(path: PathLike) -> list[list[Path]]:
    """The files of the log at `path`, one list a boot, in the order of their numbers."""
    return [boot.files for boot in _boots(numbered(path))]


def segments(path: PathLike) -> list[Path]:
    """The files of one log in their order: `path` and what goes on behind it in the same boot.

    A numbered file with which another boot begins stands for that boot, any other numbered file for itself.
    """
    first = Path(path)
    base = _base(first)
    if base == first:
        return boots(first)[0]
    later = [files for files in boots(base)[1:] if files[0] == first]
    return later[0] if later else boots(first)[0]


def other_boots(path: PathLike) -> list[list[Path]]:
    """The files of the other boots that lie beside the log at `path`, one list a boot."""
    own = segments(path)
    return [files for files in boots(_base(Path(path))) if own[0] not in files]


def pictures(path: PathLike) -> list[Path]:
    """The files beside a log that hold its drone's pictures, where its logger kept them apart.

    Where several boots lie beside each other, only those that say that they are of this one.
    """
    first = Path(path)
    begins_boot = any(files[0] == first for files in boots(_base(first))[1:])
    found = [file for file in numbered(picture_path(_base(first) if begins_boot else first)) if file.exists()]
    known = next((boot for file in segments(first) if (boot := _boot_id(file))), "")
    is_alone = not other_boots(first)
    said = ((file, _boot_id(file)) for file in found)
    return [file for file, boot in said if (boot == known if boot and known else is_alone)]


def stray_pictures(path: PathLike) -> list[Path]:
    """The pictures beside the log at `path` of which nobody knows that they are of one of its boots; none for
    a numbered file.
    """
    base = Path(path)
    if _base(base) != base:
        return []
    later = [files[0] for files in boots(base)[1:]]
    known = [file for log in (base, *later) for file in pictures(log)]
    return [file for file in numbered(picture_path(base)) if file.exists() and file not in known]


def whose(path: PathLike) -> str:
    """The drone's id as the log says it, "" where it does not. Raises LogError: no log."""
    return _metadata(Path(path)).get("drone_id", "")


def _boots(files: Sequence[Path]) -> list[_Boot]:
    found: list[_Boot] = []
    for path in files:
        boot_id = _boot_id(path) if len(files) > 1 else ""
        known = next((boot for boot in found if boot_id and boot.id == boot_id), None)
        if known is None and found and not (boot_id and found[-1].id) and found[-1].goes_on_in(path):
            known = found[-1]
        if known is None:
            found.append(_Boot(boot_id, [path]))
        else:
            known.files.append(path)
            known.id = known.id or boot_id
    return found


def _base(path: Path) -> Path:
    """The log of which `path` is a numbered file: name.mcap of name.3.mcap; else `path`."""
    name, _, number = path.stem.rpartition(".")
    return path.with_name(f"{name}{path.suffix}") if name and number.isdigit() else path


def _boot_id(path: Path) -> str:
    """What a file says of its boot, "" where it says nothing or is no log."""
    try:
        return _metadata(path).get(BOOT, "")
    except LogError:
        return ""


def _metadata(path: Path) -> dict[str, str]:
    try:
        state = path.stat()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); give the path of a .mcap log") from error
    return _metadata_of(path, state.st_size, state.st_mtime_ns)


def _span_ns(path: Path) -> tuple[int, int] | None:
    """Earliest and latest log time of a file, None where it holds no message."""
    try:
        state = path.stat()
        return _span_of(path, state.st_size, state.st_mtime_ns)
    except (LogError, OSError):
        return None


# Asked for the same files again and again; a file that is written meanwhile has another size or time.
@lru_cache(maxsize=256)
def _metadata_of(path: Path, _n_bytes: int, _changed_ns: int) -> dict[str, str]:
    scan = Scan(path, _ignore)
    next(scan.messages(), None)  # it stands before the first message
    return scan.metadata.get(METADATA, {})


@lru_cache(maxsize=256)
def _span_of(path: Path, _n_bytes: int, _changed_ns: int) -> tuple[int, int] | None:
    times_ns = [raw.log_time_ns for raw in Scan(path, _ignore).messages()]
    return (min(times_ns), max(times_ns)) if times_ns else None


def _ignore(_text: str) -> None:
    """What is damaged is told when it is read."""
