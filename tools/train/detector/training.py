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

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tools.errors import UnusableError
from tools.train.detector.export import check_export, export
from tools.train.detector.loss import detection_loss
from tools.train.detector.model import cell_centres, decode
from tools.train.detector.own import own_pictures
from tools.train.detector.pictures import Batches, Mixture
from tools.train.detector.quantise import quantise
from tools.train.detector.run import Given, Run, Settings, averaged
from tools.train.detector.validation import count_validation, measure

__all__ = ["Settings", "averaged", "command", "settings_of", "train"]

LOG_COLUMNS = "step,score_loss,box_loss,rate,seconds,progress"


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
    given, checkpoint = Given(data, classes, begin_from), out / "checkpoint.pt"
    run = _begun(checkpoint, settings, given)
    if run.progress(settings) >= 1:
        print(
            f"already trained to the end, {run.step} steps: it is exported again; to train further choose "
            f"another --out, and --from {checkpoint}",
            flush=True,
        )
        return export(averaged(out), out / "detector.onnx", settings.pictures.side)
    # What was given is read before minutes are spent on rendering.
    own = own_pictures(data, classes, settings.pictures.side) if data is not None else []
    out.mkdir(parents=True, exist_ok=True)
    batches = Batches(settings.pictures, out.parent / "detector_scenes", own)
    print(
        f"{len(batches.rendered)} rendered scenes ({len(batches.empty)} empty), "
        f"{len(batches.photographs)} photographs, {len(own)} pictures of your own "
        f"with {sum(len(sample.boxes) for sample in own)} animals",
        flush=True,
    )
    _cut_log(out / "log.csv", run.step)
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
            run.save(checkpoint, settings, given)
    run.save(checkpoint, settings, given)
    return export(averaged(out), out / "detector.onnx", settings.pictures.side)


def _begun(checkpoint: Path, settings: Settings, given: Given) -> Run:
    """A run as its checkpoint left it, or with the weights that are given, or new."""
    run = Run(settings)
    if checkpoint.is_file():
        run.load(checkpoint, settings, given)
        if run.progress(settings) < 1:
            print(f"goes on at step {run.step}, {run.progress(settings):.0%} of the training", flush=True)
    elif given.begin_from is not None:
        run.begin_from(given.begin_from, settings.rate_from)
        print(f"begins from {given.begin_from}", flush=True)
    return run


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


def _step(run: Run, settings: Settings, images: Tensor, boxes: list[Tensor]) -> NDArray[np.float64]:
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
        raise UnusableError(
            f"the loss is {loss.item()} at step {run.step}: the training has come apart; give the same "
            "command with another --seed, which goes on from the last checkpoint with other pictures; where "
            "that comes apart too, choose another --out as well"
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


def _report(run: Run, settings: Settings, losses: NDArray[np.float64], log: Path) -> None:
    progress = run.progress(settings)
    rate = _rate(settings, run.highest_rate, run.step, progress)
    line = f"{run.step},{losses[0]:.4f},{losses[1]:.4f},{rate:.6f},{run.seconds:.0f},{progress:.4f}"
    print(f"{LOG_COLUMNS} {line}", flush=True)
    with log.open("a") as file:
        file.write(line + "\n")


def _cut_log(log: Path, step: int) -> None:
    """Begin the log, or end it at the step from which the run goes on: a killed run was further."""
    rows = {}
    for line in log.read_text().splitlines() if log.is_file() else []:
        number = line.partition(",")[0]
        if number.isdecimal() and line.count(",") == LOG_COLUMNS.count(",") and int(number) <= step:
            rows[int(number)] = line
    part = log.with_suffix(".part")
    part.write_text("\n".join([LOG_COLUMNS, *rows.values()]) + "\n")
    part.replace(log)


def settings_of(
    width: float,
    steps: int | None,
    minutes: float | None,
    seed: int,
    threads: int = 1,
    workers: int | None = None,
) -> Settings:
    """The usual settings but for what the command line names. Raises UnusableError for a width of no use.

    workers: None for one beside a processor, which it keeps busy, and all but one processor beside CUDA.
    """
    if not 0.25 <= width <= 2.0:
        raise UnusableError(f"width {width}: must lie between 0.25 and 2; 1 is the network that ships")
    if workers is None:
        workers = max((os.cpu_count() or 1) - 1, 1) if torch.cuda.is_available() else 1
    pictures = Mixture(seed=seed)
    chosen = Settings(pictures, width=width, minutes=minutes, threads=threads, workers=workers)
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
    kept_back = count_validation(data, classes) if data is not None else 0
    model = train(out, settings, data, begin_from, classes=classes)
    print(f"{model}: {check_export(averaged(out), model, settings.pictures.side)}")
    if data is not None and kept_back:
        print(measure(model, data, classes))
    if int8:
        cache = out.parent / "detector_scenes"
        print(quantise(model, model.with_name("detector_int8.onnx"), settings.pictures, cache))
    print(f"{time.monotonic() - begun:.0f} s in all")
