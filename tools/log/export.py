"""`podwatch log export`: a fleet's logs for maps, tables, Foxglove and Rerun."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from logs.exceptions import LogError
from tools.errors import plain_errors, wanted_extra
from tools.log.shared import app, clear_errors, warn

if TYPE_CHECKING:
    from tools.export.scenes import Recording

__all__ = ["export_logs"]

Target = Annotated[Path | None, typer.Option(help="The file to write.", show_default=False)]


@app.command("export")
def export_logs(
    logs: Annotated[
        list[Path],
        typer.Argument(help="Logs, or a run's folder for all of its drones.", show_default=False),
    ],
    geojson: Target = None,
    csv: Target = None,
    gpx: Target = None,
    foxglove: Target = None,
    rerun: Target = None,
    every: Annotated[float, typer.Option(help="s between two points of a track.")] = 1.0,
    began: Annotated[
        str | None,
        typer.Option(
            help="Wall time of the logs' first message, 2026-05-01T09:30:00Z.", show_default="by GPS"
        ),
    ] = None,
) -> None:
    """Write the tracks of drones and animals (--geojson, --csv, --gpx), or all that was seen (--foxglove,
    --rerun).
    """
    from tools.export.scenes import Recording

    with clear_errors(), plain_errors():
        targets = [path for path in (geojson, csv, gpx, foxglove, rerun) if path is not None]
        if not targets:
            raise LogError(
                "nothing to write; give --geojson, --csv, --gpx, --foxglove or --rerun with a file"
            )
        for path in targets:
            if path.exists():
                raise LogError(f"{path}: exists already and is not overwritten; give a path that is free")
        if not every > 0:
            raise LogError(f"--every {every:g}: it must be above 0 s")
        recording = Recording(logs, warn, _moment(began))
        _write_tracks(recording, every, geojson, csv, gpx)
    if foxglove is not None:
        with wanted_extra("foxglove"):
            from tools.export.foxglove import write_foxglove
        with clear_errors(), plain_errors():
            typer.echo(f"{foxglove}: {write_foxglove(foxglove, recording)} messages; open it in Foxglove")
    if rerun is not None:
        with wanted_extra("rerun"):
            from tools.export.rerun import write_rerun
        with clear_errors(), plain_errors():
            typer.echo(f"{rerun}: {write_rerun(rerun, recording)} entries; open it with: rerun {rerun}")


def _write_tracks(
    recording: "Recording", every_s: float, geojson: Path | None, csv: Path | None, gpx: Path | None
) -> None:
    from tools.export.geo import write_csv, write_geojson, write_gpx
    from tools.export.tracks import make_tracks

    wanted: list[tuple[Path | None, Callable[..., None]]] = [
        (geojson, write_geojson),
        (csv, write_csv),
        (gpx, write_gpx),
    ]
    if all(path is None for path, _ in wanted):
        return
    tracks = make_tracks(recording, every_s)
    n_points = sum(len(track.points) for track in tracks)
    for path, write in wanted:
        if path is not None:
            write(path, tracks, is_utc=recording.began is not None)
            typer.echo(f"{path}: {len(tracks)} tracks, {n_points} points")


def _moment(text: str | None) -> datetime | None:
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise LogError(f"--began {text}: write a date and a time, as 2026-05-01T09:30:00Z") from None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
