"""Where a flight leaves what it wrote."""

from datetime import UTC, datetime
from pathlib import Path

__all__ = ["new_folder"]


def new_folder(parent: Path) -> Path:
    """A fresh folder for one run or flight, named by the time; never one that exists."""
    stamp = datetime.now(tz=UTC).astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    for attempt in range(1000):
        folder = parent / (stamp if attempt == 0 else f"{stamp}_{attempt}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{parent / stamp}: a thousand runs began in this second")
