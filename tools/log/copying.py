"""`podwatch log recover|split|merge|to-lcm|from-lcm`: logs made from logs."""

from pathlib import Path
from typing import Annotated

import typer

from tools.log.shared import LogPath, app, clear_errors, warn

Out = Annotated[Path | None, typer.Option(help="The file to write.", show_default="beside the log")]


@app.command("recover")
def recover_log(path: LogPath, out: Out = None) -> None:
    """Write every whole message of a damaged or unfinished log into a new, closed one."""
    from logs.copying import recover

    with clear_errors():
        copied = recover(path, out or path.with_name(f"{path.stem}.recovered{path.suffix}"), warn)
    typer.echo(f"{copied.path}: {copied.n_messages} messages of {copied.span_s:.3f} s")


@app.command("split")
def split_log(
    path: LogPath,
    every: Annotated[float, typer.Option(help="Length of a part, s of log time.")],
    out: Annotated[Path | None, typer.Option(help="Folder for the parts.", show_default="NAME.parts")] = None,
) -> None:
    """Cut a log into parts; what reads a restarted logger's files reads them as one."""
    from logs.copying import split

    with clear_errors():
        for part in split(path, out or path.with_name(f"{path.stem}.parts"), every, warn):
            typer.echo(f"{part.path}: {part.n_messages} messages of {part.span_s:.3f} s")


@app.command("merge")
def merge_logs(
    paths: Annotated[list[Path], typer.Argument(help="Logs of one drone.", show_default=False)],
    out: Annotated[Path, typer.Option(help="The file to write.")],
) -> None:
    """Join a drone's logs into one, by log time."""
    from logs.copying import merge

    with clear_errors():
        copied = merge(paths, out, warn)
    typer.echo(f"{copied.path}: {copied.n_messages} messages of {copied.span_s:.3f} s")


@app.command("to-lcm")
def to_event_log(path: LogPath, out: Out = None) -> None:
    """Write an LCM event log, which lcm-logplayer plays."""
    from logs.event_log import to_lcm

    with clear_errors():
        copied = to_lcm(path, out or path.with_suffix(".lcmlog"), warn)
    typer.echo(
        f"{copied.path}: {copied.n_messages} messages of {copied.span_s:.3f} s; play it: "
        f"lcm-logplayer {copied.path}"
    )


@app.command("from-lcm")
def from_event_log(
    path: Annotated[Path, typer.Argument(help="An LCM event log, as lcm-logger writes.", show_default=False)],
    out: Out = None,
    drone: Annotated[
        int | None, typer.Option(min=0, max=99, help="Whose bus it was.", show_default="as its messages say")
    ] = None,
) -> None:
    """Turn an LCM event log into a drone's log."""
    from logs.event_log import from_lcm

    with clear_errors():
        copied = from_lcm(path, out or path.with_name(f"{path.name}.mcap"), drone)
    typer.echo(f"{copied.path}: {copied.n_messages} messages of {copied.span_s:.3f} s")
