"""What shapes a training, and its state between two steps: what a checkpoint holds, who may go on from it."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from tools.errors import UnusableError
from tools.train.detector.export import load_weights
from tools.train.detector.model import Sizes, WhaleDetector
from tools.train.detector.pictures import Mixture

__all__ = ["Given", "Run", "Settings", "averaged"]

KEPT = ("network", "average", "optimiser", "step", "seconds", "highest_rate", "width", "settings")
HOW_LONG_AND_HOW_FAST = ("steps", "minutes", "workers", "threads")  # the rest shapes what is learnt


@dataclass(frozen=True)
class Settings:
    """What shapes a training, each with its reason."""

    pictures: Mixture = field(default_factory=Mixture)
    steps: int = 20000  # two hours on one idle core; more steps still help
    minutes: float | None = None  # of running time, in place of steps: the rate then follows the clock
    width: float = 1.0  # of the network: its channels times this
    rate: float = 2e-3  # the highest that never diverged with AdamW on this network
    rate_from: float = 1e-3  # with weights that know something already
    last_rate_share: float = 0.01  # a cosine down to this settles the boxes
    warmup_steps: int = 300  # assignment is random before the boxes mean anything
    weight_decay: float = 0.03  # the photographs are few
    average_decay: float = 0.9985  # the exported weights are a running mean over about 700 steps
    early_share: float = (
        0.5  # of the training at smaller pictures first: half again as many steps for the time
    )
    early_side: int = 256
    save_every_steps: int = 100  # a kill loses a minute
    workers: int = 1  # processes that make pictures; 0: none, this one does
    threads: int = 1  # of the network; on a busy machine two wait for each other


@dataclass(frozen=True)
class Given:
    """What the command line gives a training to learn from and to begin with."""

    data: Path | None = None
    classes: Sequence[str] = ()
    begin_from: Path | None = None

    def options(self) -> dict[str, str]:
        """By the name of the option, as a checkpoint keeps it; empty where it was not given."""
        return {
            "--data": str(self.data or ""),
            "--classes": ", ".join(sorted(set(self.classes))),
            "--from": str(self.begin_from or ""),
        }


class Run:
    """All that a checkpoint holds, and what it takes to make a step."""

    def __init__(self, settings: Settings) -> None:
        torch.manual_seed(settings.pictures.seed)
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.network = WhaleDetector(sizes=Sizes().scaled(settings.width)).to(
            self.device, memory_format=torch.channels_last
        )  # type: ignore[call-overload]
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        rest = [
            p for p in self.network.parameters() if p.ndim <= 1
        ]  # norms and biases are not pulled to zero
        groups = [
            {"params": decayed, "weight_decay": settings.weight_decay},
            {"params": rest, "weight_decay": 0.0},
        ]
        self.optimiser = torch.optim.AdamW(groups, lr=settings.rate)
        self.average = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.step, self.seconds, self.highest_rate = 0, 0.0, settings.rate

    def save(self, path: Path, settings: Settings, given: Given) -> None:
        """Whole or not at all: a kill while writing keeps the last one."""
        state = {
            "network": self.network.state_dict(),
            "average": self.average,
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
            "seconds": self.seconds,
            "highest_rate": self.highest_rate,
            "width": settings.width,
            "settings": {name: str(value) for name, value in asdict(settings).items()},
            "given": given.options(),
        }
        part = path.with_suffix(".part")
        torch.save(state, part)
        part.replace(path)

    def load(self, path: Path, settings: Settings, given: Given) -> None:
        """Take up a checkpoint; says where its settings were others: the run cannot be repeated then.

        Raises UnusableError where it is none of this network, where it learnt from other pictures or weights,
        and where it is trained to the end with other settings: none of them would be heeded.
        """
        state = _read(path, self.device)
        if state["width"] != settings.width:
            raise UnusableError(
                f"{path}: of width {state['width']}, not {settings.width}; choose another --out"
            )
        try:
            for weights in (state["average"], state["network"]):  # what stays is the last
                self.network.load_state_dict(weights)
            self.optimiser.load_state_dict(state["optimiser"])
        except Exception as error:  # torch raises whatever it comes upon
            raise UnusableError(
                f"{path}: of another network than this one; choose another --out, and --from {path} "
                "where its weights are to be taken up"
            ) from error
        self.average, self.step, self.seconds = state["average"], state["step"], state["seconds"]
        self.highest_rate = state["highest_rate"]
        finished = self.progress(settings) >= 1
        _compare_given(path, state.get("given"), given, finished)
        _compare_settings(path, state, settings, finished)

    def begin_from(self, weights: Path, rate: float) -> None:
        """Take the weights of an exported model or of a checkpoint's running mean, and begin at step 0."""
        load_weights(self.network, weights)
        self.highest_rate = rate
        self.average = {name: value.clone() for name, value in self.network.state_dict().items()}

    def progress(self, settings: Settings) -> float:
        """0 at the beginning, 1 at the end."""
        if settings.minutes is not None:
            return min(self.seconds / (60 * settings.minutes), 1.0)
        return self.step / settings.steps

    def follow(self, decay: float) -> None:
        """Move the running mean of the weights a step towards them; faster while they are young."""
        decay = min(decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, value in self.network.state_dict().items():
                if value.dtype.is_floating_point:
                    self.average[name].lerp_(value, 1 - decay)
                else:
                    self.average[name].copy_(value)


def averaged(run_folder: Path) -> WhaleDetector:
    """The running mean of the weights of the newest checkpoint, ready to export."""
    state = torch.load(run_folder / "checkpoint.pt", weights_only=True, map_location="cpu")
    network = WhaleDetector(sizes=Sizes().scaled(state["width"]))
    network.load_state_dict(state["average"])
    return network.eval()


def _read(path: Path, device: torch.device) -> dict[str, Any]:
    """A checkpoint with all that it must hold. Raises UnusableError naming the file and what is wrong."""
    try:
        state = torch.load(path, weights_only=True, map_location=device)
    except OSError:
        raise
    except Exception as error:  # pickle, zip and torch: each has errors of its own
        raise UnusableError(
            f"{path}: no checkpoint of this trainer, or cut off; choose another --out, or remove it"
        ) from error
    missing = [name for name in KEPT if not isinstance(state, dict) or name not in state]
    if missing:
        raise UnusableError(
            f"{path}: of an older or of another trainer, without {', '.join(missing)}; choose another --out, "
            f"and --from {path} where its weights are to be taken up"
        )
    return dict(state)


def _compare_given(path: Path, kept: dict[str, str] | None, given: Given, finished: bool) -> None:
    """Refuse what a run that goes on would leave unheeded; kept: None in a checkpoint that says nothing."""
    if kept is None:
        if given.begin_from is not None:
            print(f"{path}: goes on from here; --from {given.begin_from} is not read again", flush=True)
        return
    for option, now in given.options().items():
        before = kept[option]
        if before == now or (option != "--classes" and _same_file(before, now)):
            continue
        if option == "--from" and not now:  # it has done its part
            print(f"{path}: began from {before}", flush=True)
            continue
        words = [f"with {option} {each}" if each else f"without {option}" for each in (before, now)]
        remedy = "it is trained to the end; " if finished else "to go on give the same again; else "
        raise UnusableError(
            f"{path}: was trained {words[0]}, not {words[1]}; {remedy}choose another --out, "
            f"and --from {path} to begin from it"
        )


def _same_file(before: str, now: str) -> bool:
    return bool(before and now) and Path(before).resolve() == Path(now).resolve()


def _compare_settings(path: Path, state: dict[str, Any], settings: Settings, finished: bool) -> None:
    for name, now in asdict(settings).items():
        before = state["settings"].get(name)
        if before == str(now) or name == "workers":  # on which nothing depends but the time
            continue
        told = f"{path}: {name} was {before} up to step {state['step']}, now {now}"
        if finished and before is not None and name not in HOW_LONG_AND_HOW_FAST:
            raise UnusableError(
                f"{told}, which changes nothing: it is trained to the end; choose another --out, "
                f"and --from {path} to begin from it"
            )
        print(told, flush=True)
