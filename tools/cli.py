"""The command line: `podwatch COMMAND`. Heavy imports wait until their command is called."""

import os
from pathlib import Path
from typing import Annotated

import typer

from tools import fleet, log
from tools.bench.commands import bench
from tools.boat.command import boat
from tools.doctor.command import doctor
from tools.errors import UnusableError, plain_errors, wanted_extra
from tools.fly import fly
from tools.play import play
from tools.replay import replay_command
from tools.report.command import report
from tools.sim.command import sim
from tools.spy.command import spy

# What a video reader cannot open, we tell in words of our own.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

app = typer.Typer(
    help="A fleet of small drones that finds a pod of whales, agrees which is which, and keeps each in view.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
train = typer.Typer(help="Train the models that ship (needs the `train` extra).", no_args_is_help=True)
app.command("sim")(sim)
app.command("fly")(fly)
app.command("boat")(boat)
app.command("play")(play)
app.command("replay")(replay_command)
app.command("report")(report)
app.command("spy")(spy)
app.command("doctor")(doctor)
app.add_typer(log.app, name="log")
app.add_typer(fleet.app, name="fleet")
app.add_typer(train, name="train")
app.add_typer(bench, name="bench")


@app.command("views")
def views(
    pictures: Annotated[
        list[Path], typer.Argument(help="Pictures or videos of one scene from several viewpoints.")
    ],
    out: Annotated[Path, typer.Option(help="The figure to write.")] = Path("views.png"),
    confidence: Annotated[
        float,
        typer.Option(min=0.01, max=1, help="Least score of a find: lower finds more, and more wrongly."),
    ] = 0.25,
    model: Annotated[
        Path | None, typer.Option(help="An ONNX file of your own in place of the one that ships.")
    ] = None,
) -> None:
    """Detect, register round the ring and assign, on pictures that stand for several drones' views."""
    from tools.views import command

    with plain_errors():
        command(pictures, out, confidence, model)


@app.command("render")
def render(
    out: Annotated[Path, typer.Argument(help="Folder to write, in the YOLO layout.")],
    n: Annotated[int, typer.Option("-n", "--n", min=1, help="How many scenes.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same pictures.")] = 0,
    split: Annotated[str, typer.Option(help="train, tune, val, val_sperm or empty")] = "train",
    width: Annotated[int, typer.Option(min=64, help="Of a picture, px.")] = 640,
    height: Annotated[int, typer.Option(min=64, help="Of a picture, px.")] = 480,
    views: Annotated[int, typer.Option(min=1, help="Of each scene: the same animals, other places.")] = 1,
) -> None:
    """Render labelled scenes for training and validation."""
    from tools.render import command

    with plain_errors():
        command(out, n, seed, split, width, height, views)


@train.command("detector")
def train_detector(
    out: Annotated[Path, typer.Option(help="Folder for checkpoints, log and export.")] = Path(
        "runs/detector"
    ),
    data: Annotated[
        Path | None, typer.Option(help="A data.yaml in the YOLO layout to train on as well.")
    ] = None,
    classes: Annotated[
        list[str] | None,
        typer.Option(help="Name or number of a class of --data that counts as a whale; again for another."),
    ] = None,
    begin_from: Annotated[
        Path | None,
        typer.Option("--from", help="Begin with these weights: a detector.onnx or checkpoint.pt."),
    ] = None,
    width: Annotated[float, typer.Option(help="Of the network: channels times this.")] = 1.0,
    steps: Annotated[int | None, typer.Option(min=1)] = None,
    minutes: Annotated[float | None, typer.Option(min=0.1, help="As many steps as fit.")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    threads: Annotated[int, typer.Option(min=1, help="More than one: for an idle machine.")] = 1,
    workers: Annotated[
        int | None,
        typer.Option(min=0, help="Processes that make pictures; usually 1, with CUDA all but one processor."),
    ] = None,
    int8: Annotated[bool, typer.Option("--int8", help="Export in 8 bits as well.")] = False,
    smoke: Annotated[bool, typer.Option("--smoke", help="A few steps, export and check only.")] = False,
) -> None:
    """Train the detector and export it to ONNX."""
    with wanted_extra("train"):
        from tools.train.detector.training import command, settings_of
    with plain_errors():
        settings = settings_of(width, steps, minutes, seed, threads, workers)
        command(out, settings, data, begin_from, smoke, int8, classes or ())


@train.command("assigner")
def train_assigner(
    out: Annotated[Path, typer.Option(help="Folder for checkpoints and weights.")] = Path("runs/assigner"),
    loss: Annotated[str, typer.Option(help="ours, or paper: the paper's own network and loss.")] = "ours",
    steps: Annotated[int | None, typer.Option(min=1)] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    smoke: Annotated[bool, typer.Option("--smoke", help="A few steps, export and check only.")] = False,
) -> None:
    """Train the assigner's network, export it for numpy and measure it."""
    with wanted_extra("train"):
        from tools.train.assigner import paper, training
    with plain_errors():
        if loss not in ("ours", "paper"):
            raise UnusableError(f"loss {loss!r} is not known; there are: ours, paper")
        trainer = training if loss == "ours" else paper
        trainer.command(out, seed, steps, smoke)


def main() -> None:
    """The entry point of the `podwatch` script."""
    app()
