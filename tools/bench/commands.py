"""The commands `podwatch bench ...`. Heavy imports wait until their command is called."""

from pathlib import Path
from typing import Annotated

import typer

from tools.errors import FAILED, plain_errors, wanted_extra

__all__ = ["bench"]

bench = typer.Typer(help="Measure, and print every figure with its bar.", no_args_is_help=True)


@bench.command("fleet")
def bench_fleet(
    seeds: Annotated[int, typer.Option(min=1, help="Default missions in lockstep.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Of the first of them, and of all else.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the runs and the table.")] = Path("runs/bench"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Boxes in place of pixels, no processes mode.")
    ] = False,
) -> None:
    """Fly many missions and print every figure of the fleet."""
    from tools.bench.fleet import command

    with plain_errors():
        command(range(seed, seed + seeds), out, quick=quick)


@bench.command("detection")
def bench_detection(
    seed: Annotated[int, typer.Option(min=0, help="Of the rendered scenes.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the table and the figures.")] = Path("runs/bench"),
    model: Annotated[Path | None, typer.Option(help="Another ONNX file than the one that ships.")] = None,
    scenes: Annotated[int | None, typer.Option(min=1, help="At most so many a set.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few scenes a set.")] = False,
) -> None:
    """Recall, precision, counts, false alarms and time on rendered scenes and held-out photographs."""
    from tools.bench.detection import FRAMES, QUICK, command

    with plain_errors():
        command(seed, out, most=scenes or (QUICK if quick else FRAMES), model=model)


@bench.command("registration")
def bench_registration(
    pairs: Annotated[int, typer.Option(min=1, help="Pairs of views a cell.")] = 1000,
    rings: Annotated[int, typer.Option(min=1, help="Rings of views a cell.")] = 200,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    only: Annotated[str, typer.Option(help="Only rows with this in their name, or a part.")] = "",
    out: Annotated[Path, typer.Option(help="Folder for the tables and figures.")] = Path("runs/bench"),
) -> None:
    """Synthetic pairs, rings and episodes, peers, speed, and the paper's experiment on real pixels."""
    with wanted_extra("bench"):
        import pycpd  # noqa: F401

        from tools.bench.registration import command
    with plain_errors():
        command(pairs, rings, seed, only, out)


@bench.command("assignment")
def bench_assignment(
    seed: Annotated[int, typer.Option(min=0, help="Of the cases.")] = 0,
    cases: Annotated[int, typer.Option(min=1, help="Of each size up to 12 agents.")] = 5000,
    out: Annotated[Path, typer.Option(help="Folder for the table and the figures.")] = Path("runs/bench"),
    quick: Annotated[bool, typer.Option("--quick", help="Few cases a size, small rings.")] = False,
) -> None:
    """The three methods against their bars, the paper's Table 2 and other ways; what flies, and why."""
    from tools.bench.assignment import command

    with plain_errors():
        command(seed, cases, out, quick=quick)


@bench.command("bus")
def bench_bus(
    out: Annotated[Path, typer.Option(help="Folder for the table.")] = Path("runs/bench"),
    seconds: Annotated[float, typer.Option(min=1, help="Length of each measurement.")] = 10.0,
) -> None:
    """What it costs to spy on a busy bus, beside lcm's own handler."""
    from tools.bench.bus import command

    with plain_errors():
        command(out, seconds)


@bench.command("logs")
def bench_logs(
    out: Annotated[Path, typer.Option(help="Folder for the table.")] = Path("runs/bench"),
    seconds: Annotated[float, typer.Option(min=1, help="Length of each flood.")] = 10.0,
    real_time: Annotated[
        bool, typer.Option("--real-time", help="Measure before all else that the machine does (root).")
    ] = False,
) -> None:
    """What the logger keeps of a flood beside lcm-logger, how fast logs are written, how late they play."""
    from tools.bench.logs import command

    with plain_errors():
        command(out, seconds, real_time=real_time)


@bench.command("faults")
def bench_faults(
    only: Annotated[str, typer.Option(help="Only faults with this in their name.")] = "",
    workers: Annotated[int, typer.Option(min=1, help="Copies of the checkout, side by side.")] = 2,
    out: Annotated[Path, typer.Option(help="Folder for the table.")] = Path("runs/bench"),
) -> None:
    """Put faults of one line into a copy of the checkout; exit 1 if one does not turn its test red."""
    with wanted_extra("dev"):
        from tools.bench.faults import command
    with plain_errors():
        if not command(only, workers, out):
            raise typer.Exit(FAILED)
