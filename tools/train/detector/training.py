"""Trains the whale detector on rendered scenes and photographs, and exports it to ONNX.

    podwatch train detector                        runs/detector: checkpoint.pt, log.csv, detector.onnx
    podwatch train detector --minutes 180          as many steps as fit
    podwatch train detector --smoke                a few steps, an export and its check: seconds
    podwatch train detector --width 0.5            half the channels
    podwatch train detector --data my/data.yaml --from models/detector.onnx     your own pictures, our weights

A killed run goes on from its last checkpoint. Every batch depends on (seed, step) alone, so that with a given
number of steps it ends as it would have without the kill. Needs the `train` extra (torch, onnx); a CUDA
device is used where there is one.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tools.errors import UnusableError
from tools.train.detector.export import check_export, export, load_weights, quantise
from tools.train.detector.loss import detection_loss
from tools.train.detector.model import Sizes, WhaleDetector, cell_centres, decode
from tools.train.detector.own import own_pictures
from tools.train.detector.pictures import Batches, Mixture

__all__ = ["Settings", "averaged", "command", "settings_of", "train"]


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


class _Run:
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

    def save(self, path: Path, settings: Settings) -> None:
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
        }
        part = path.with_suffix(".part")
        torch.save(state, part)
        part.replace(path)

    def load(self, path: Path, settings: Settings) -> None:
        """Take up a checkpoint; says where its settings were others: the run cannot be repeated then."""
        state = torch.load(path, weights_only=True, map_location=self.device)
        if state["width"] != settings.width:
            raise UnusableError(
                f"{path}: of width {state['width']}, not {settings.width}; choose another --out"
            )
        for name, now in asdict(settings).items():
            before = state["settings"].get(name)
            if before != str(now):
                print(f"{path}: {name} was {before} up to step {state['step']}, now {now}", flush=True)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.average, self.step, self.seconds = state["average"], state["step"], state["seconds"]
        self.highest_rate = state["highest_rate"]

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


def train(
    out: Path,
    settings: Settings,
    data: Path | None = None,
    begin_from: Path | None = None,
    stop_after: int | None = None,
    classes: Sequence[str] = (),
) -> Path:
    """Train into the folder `out`, from its checkpoint if there is one, export, return the ONNX file's path.

    data: the data.yaml of your own pictures, `classes` those of its classes that count. `stop_after` ends the
    run at that step, as a kill would; the next call goes on from the last checkpoint.
    """
    cv2.setNumThreads(1)
    torch.set_num_threads(settings.threads)
    # What was given is read before minutes are spent on rendering.
    own = own_pictures(data, classes) if data is not None else []
    run, checkpoint = _Run(settings), out / "checkpoint.pt"
    if checkpoint.is_file():
        run.load(checkpoint, settings)
        print(f"goes on at step {run.step}, {run.progress(settings):.0%} of the training", flush=True)
    elif begin_from is not None:
        run.begin_from(begin_from, settings.rate_from)
        print(f"begins from {begin_from}", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    batches = Batches(settings.pictures, out.parent / "detector_scenes", own)
    print(
        f"{len(batches.rendered)} rendered scenes ({len(batches.empty)} empty), "
        f"{len(batches.photographs)} photographs, {len(own)} pictures of your own "
        f"with {sum(len(sample.boxes) for sample in own)} animals",
        flush=True,
    )
    run.network.train()
    sums, begun = np.zeros(2), time.monotonic() - run.seconds
    for images, boxes in _from(batches, run.step, settings.workers):
        if run.progress(settings) >= 1 or run.step == stop_after:
            break
        sums += _step(run, settings, images, boxes)
        run.step, run.seconds = run.step + 1, time.monotonic() - begun
        if run.step % 50 == 0:
            _report(run, settings, sums / 50, out / "log.csv")
            sums[:] = 0
        if run.step % settings.save_every_steps == 0:
            run.save(checkpoint, settings)
    run.save(checkpoint, settings)
    return export(averaged(out), out / "detector.onnx", settings.pictures.side)


def _from(batches: Batches, step: int, workers: int) -> Iterator[tuple[Tensor, list[Tensor]]]:
    """Batches from number `step` on, made ahead of time by `workers` processes."""
    loader = torch.utils.data.DataLoader(
        batches,
        batch_size=None,
        sampler=range(step, len(batches)),
        num_workers=workers,
        prefetch_factor=4 if workers else None,
    )
    yield from loader


def _rate(settings: Settings, rate: float, step: int, progress: float) -> float:
    low = settings.last_rate_share
    cosine = rate * (low + (1 - low) * 0.5 * (1 + float(np.cos(np.pi * progress))))
    return cosine * min((step + 1) / settings.warmup_steps, 1.0)


def _step(run: _Run, settings: Settings, images: Tensor, boxes: list[Tensor]) -> NDArray[np.float64]:
    """One step of the optimiser on images (B, side, side, 3) uint8; returns (score loss, box loss)."""
    progress = run.progress(settings)
    for group in run.optimiser.param_groups:
        group["lr"] = _rate(settings, run.highest_rate, run.step, progress)
    side = settings.early_side if progress < settings.early_share else settings.pictures.side
    pixels = images.to(run.device).permute(0, 3, 1, 2).float().div(255)  # (B, 3, H, W), channels last
    if side != pixels.shape[-1]:
        boxes = [each * each.new_tensor([side / pixels.shape[-1]] * 4 + [1.0]) for each in boxes]
        pixels = torch.nn.functional.interpolate(pixels, (side, side), mode="bilinear", antialias=True)
    centres, strides = (each.to(run.device) for each in cell_centres(side, side))
    with torch.autocast(run.device.type, torch.bfloat16, enabled=_short_floats_are_fast(run.device)):
        logits, distances = run.network(pixels)  # (B, 1, A), (B, 4, A)
    known = [each.to(run.device) for each in boxes]
    logits, sides = logits.float(), distances.float()
    decoded = decode(sides, centres, strides)  # (B, A, 4)
    score_loss, box_loss = detection_loss(logits, decoded, centres, strides, known)
    loss = score_loss + box_loss
    if not torch.isfinite(loss):
        raise FloatingPointError(
            f"the loss is {loss.item()} at step {run.step}: lower Settings.rate ({settings.rate})"
        )
    run.optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(run.network.parameters(), 10.0)
    run.optimiser.step()
    run.follow(settings.average_decay)
    return np.array([score_loss.item(), box_loss.item()])


def _short_floats_are_fast(device: torch.device) -> bool:
    """bfloat16 in hardware: a third less time for a step, and no worse for it."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.cpu._is_avx512_bf16_supported())


def _report(run: _Run, settings: Settings, losses: NDArray[np.float64], log: Path) -> None:
    progress = run.progress(settings)
    rate = _rate(settings, run.highest_rate, run.step, progress)
    line = f"{run.step},{losses[0]:.4f},{losses[1]:.4f},{rate:.6f},{run.seconds:.0f},{progress:.4f}"
    print(f"step,score_loss,box_loss,rate,seconds,progress {line}", flush=True)
    with log.open("a") as file:
        file.write(line + "\n")


def settings_of(
    width: float, steps: int | None, minutes: float | None, seed: int, threads: int = 1
) -> Settings:
    """The usual settings but for what the command line names. Raises UnusableError for a width of no use."""
    if not 0.25 <= width <= 2.0:
        raise UnusableError(f"width {width}: must lie between 0.25 and 2; 1 is the network that ships")
    chosen = Settings(pictures=Mixture(seed=seed), width=width, minutes=minutes, threads=threads)
    return chosen if steps is None else replace(chosen, steps=steps)


def command(
    out: Path,
    settings: Settings,
    data: Path | None = None,
    begin_from: Path | None = None,
    smoke: bool = False,
    int8: bool = False,
    classes: Sequence[str] = (),
) -> None:
    """Train into OUT and export OUT/detector.onnx; smoke: a few steps and the check of the export."""
    if classes and data is None:
        raise UnusableError("--classes says which classes of --data count; give --data as well")
    if smoke:
        out = out / "smoke"
        (out / "checkpoint.pt").unlink(missing_ok=True)  # always from the beginning
        few = replace(settings.pictures, batch=4, scenes=12, scenes_on_photographs=12)
        settings = replace(
            settings,
            pictures=few,
            steps=6,
            minutes=None,
            early_side=128,
            warmup_steps=2,
            save_every_steps=3,
            workers=0,
        )
    begun = time.monotonic()
    model = train(out, settings, data, begin_from, classes=classes)
    print(f"{model}: {check_export(averaged(out), model, settings.pictures.side)}")
    if int8:
        cache = out.parent / "detector_scenes"
        print(quantise(model, model.with_name("detector_int8.onnx"), settings.pictures, cache))
    print(f"{time.monotonic() - begun:.0f} s in all")
