"""Writes the trained network as ONNX in the Ultralytics layout, and checks that onnxruntime agrees with
torch.
"""

import warnings
from pathlib import Path

import numpy as np
import onnx
import torch

from procs.detector.yolo import open_session
from tools.train.detector.model import STRIDES, Exported, WhaleDetector

__all__ = ["check_export", "export"]

OPSET = 17
NAMES = {0: "whale"}
LARGEST_DIFFERENCE = 0.05  # px and score: float32 sums in another order differ by far less


def export(network: WhaleDetector, path: Path, side: int) -> Path:
    """Write `network`: input `images` (1, 3, side, side) RGB 0-1, output `output0` (1, 4 + nc, A)."""
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
            dynamo=False,
        )
    model = onnx.load(str(part))
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
    for key, value in metadata.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    onnx.checker.check_model(model)
    onnx.save(model, str(part))
    part.replace(path)
    return path


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
