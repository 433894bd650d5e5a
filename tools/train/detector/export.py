"""Writes the trained network as ONNX in the Ultralytics layout, reads such files back, and checks that
onnxruntime agrees with torch.
"""

import re
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch

from procs.detector.yolo import open_session
from tools.errors import UnusableError
from tools.train.detector.model import STRIDES, Exported, WhaleDetector

__all__ = ["check_export", "describe", "export", "load_weights"]

OPSET = 17
NAMES = {0: "whale"}
LARGEST_DIFFERENCE = 0.05  # px and score: float32 sums in another order differ by far less


def export(network: WhaleDetector, path: Path, side: int) -> Path:
    """Write `network`: input `images` (1, 3, side, side) RGB 0-1, output `output0` (1, 5, A)."""
    part = path.with_suffix(".part.onnx")
    with warnings.catch_warnings():
        # The exporter without extra packages is the older one, which says on every call that it is older.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Exported(network.eval(), side).eval(),
            (torch.zeros(1, 3, side, side),),
            str(part),
            input_names=["images"],
            output_names=["output0"],
            opset_version=OPSET,
            # Normalisations stay by themselves, so that `load_weights` finds every weight under its name;
            # onnxruntime folds them into the convolutions when it loads the file.
            training=torch.onnx.TrainingMode.PRESERVE,
            do_constant_folding=False,
            dynamo=False,
        )
    model = onnx.load(str(part))
    describe(model, side)
    onnx.checker.check_model(model)
    onnx.save(model, str(part))
    part.replace(path)
    return path


def load_weights(network: WhaleDetector, path: Path) -> None:
    """Put the weights of `path` into `network`: an ONNX file that `export` wrote, or a trainer's checkpoint.

    Raises UnusableError where they are not those of this network.
    """
    if not path.is_file():
        raise UnusableError(f"{path}: no such file; give a detector.onnx or checkpoint.pt of this trainer")
    try:
        if path.suffix == ".onnx":
            model = onnx.load(str(path))
            arrays = {item.name: onnx.numpy_helper.to_array(item) for item in model.graph.initializer}
            state = {
                name.removeprefix("network."): torch.from_numpy(array.copy())
                for name, array in arrays.items()
                if name.startswith("network.")
            }
        else:
            state = torch.load(path, weights_only=True, map_location="cpu")["average"]
        fresh = network.state_dict()
        if "heads.3.1.bias" not in state:  # of before the grid of 4 px: its grids are our coarser three
            state = {
                re.sub(r"^heads\.(\d)", lambda m: f"heads.{int(m[1]) + 1}", name): value
                for name, value in state.items()
            }
            state = {n: fresh[n] for n in fresh if n.startswith(("heads.0.", "side4.", "narrow."))} | state
        counters = {name: value for name, value in fresh.items() if value.ndim == 0}
        network.load_state_dict({**counters, **state})
    except Exception as error:  # onnx, pickle, torch: each has errors of its own
        raise UnusableError(
            f"{path}: no weights of this network (is --width the same?): {str(error)[:300]}"
        ) from error


def describe(model: onnx.ModelProto, side: int) -> None:
    """Put the metadata that Ultralytics puts into its exports."""
    metadata = {
        "description": "podwatch whale detector",
        "author": "podwatch",
        "license": "Apache-2.0",
        "task": "detect",
        "names": str(NAMES),
        "imgsz": str([side, side]),
        "stride": str(STRIDES[-1]),
        "batch": "1",
    }
    del model.metadata_props[:]
    for key, value in metadata.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value


def check_export(network: WhaleDetector, path: Path, side: int) -> str:
    """One line on how well onnxruntime and torch agree; ValueError when they do not."""
    session = open_session(path)
    images = np.random.default_rng(0).random((1, 3, side, side), np.float32)
    (found,) = session.run(None, {"images": images})
    with torch.no_grad():
        expected = Exported(network.eval(), side).eval()(torch.from_numpy(images)).numpy()
    if found.shape != expected.shape:
        raise ValueError(f"{path}: onnxruntime gives {found.shape}, torch {expected.shape}; export it again")
    difference = float(np.abs(found - expected).max())
    if not difference < LARGEST_DIFFERENCE:
        raise ValueError(
            f"{path}: onnxruntime differs from torch by {difference:.3g}, limit {LARGEST_DIFFERENCE}"
        )
    return f"output {found.shape}, at most {difference:.1e} from torch, {path.stat().st_size / 1e6:.2f} MB"
