"""An ONNX detection network on onnxruntime: loaded, checked by what its file says, warmed up and run."""

import ast
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from procs.detector.decode import Layout, ModelError, layout_of

__all__ = ["PROVIDERS", "Names", "Network", "open_session"]

# What a setting calls them, and what onnxruntime does.
PROVIDERS = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
}
# OpenVINO on a processor takes its own number, not the session's; without it, eight threads or all.
OPTIONS = {PROVIDERS["openvino"]: {"num_of_threads": "1"}}
INPUT_TYPES: dict[str, type[np.floating[Any]]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
TASKS = ("detect", "obb")
WARM_UPS = 2  # one that allocates and, on an accelerator, compiles; one like all later ones
SHOWN_METADATA = 400  # characters of it in a message: the names alone may be thousands


class Names(dict[int, str]):
    """Class names by number; a number that the model does not name is called by itself."""

    def __missing__(self, number: int) -> str:
        return str(number)


class Network:
    """One network with one input picture and one output, loaded once.

    names: class names. input_size: (width, height) px. dtype: of its input. layout: of its output. warning:
    why it does not run where it was asked to, empty where it does.

    Raises ModelError when the file is missing, empty, broken, for another task or of another layout.
    """

    def __init__(self, path: Path, provider: str = "cpu") -> None:
        self.path = path
        self.warning = ""
        self.session = self._open(provider)
        self._metadata = dict(self.session.get_modelmeta().custom_metadata_map)
        self._task = self._metadata.get("task")
        if self._task not in (None, *TASKS):
            raise ModelError(
                f"{path}: the model's task is {self._task!r}; export one with task 'detect' or 'obb'"
            )
        self.names = self._read_names()
        self.input_size = self._read_input()
        self._read_output()
        self.layout = self._warm_up()

    def run(self, tensor: NDArray[np.generic]) -> NDArray[np.float32]:
        """The output for a (1, 3, height, width) input. Raises ModelError."""
        try:
            output = self.session.run(self._outputs, {self._input: tensor})[0]
        except (
            Exception
        ) as error:  # onnxruntime raises a dozen types of its own, all of them the model's fault
            raise ModelError(f"{self.path}: the model does not run: {error}; export it again") from error
        return np.asarray(output, np.float32)

    def _open(self, provider: str) -> Any:
        """A session where it was asked for, or on the processor with a warning."""
        wanted = PROVIDERS[provider]
        if provider == "cpu":
            return open_session(self.path)
        have = onnxruntime.get_available_providers()
        if wanted not in have:
            why = f"this onnxruntime has no {wanted} (it has {', '.join(have)})"
        else:
            try:
                session = open_session(self.path, wanted)
                if wanted in session.get_providers():
                    return session
                why = f"{wanted} does not start on this machine"
            except ModelError as error:
                why = f"{wanted} does not take the model ({error})"
        self.warning = (
            f"provider {provider!r}: {why}; the processor is used; install what it needs, or set cpu"
        )
        warnings.warn(self.warning, RuntimeWarning, stacklevel=2)
        return open_session(self.path)

    def _warm_up(self) -> Layout:
        """Run it on nothing: the layout of a dynamic export shows only now, and no picture waits for it."""
        blank = np.zeros((1, 3, self.input_size[1], self.input_size[0]), self.dtype)
        for _ in range(WARM_UPS):
            shape = self.run(blank).shape
        try:
            layout = layout_of(shape, len(self.names) or None, self._task, self._head())
        except ValueError as error:
            said = str(self._metadata or "none")[:SHOWN_METADATA]
            raise ModelError(f"{self.path}: {error}; metadata: {said}; export it for detection") from error
        if not self.names and layout.kind == "raw":
            self.names.update((number, str(number)) for number in range(shape[1] - 4 - layout.oriented))
        return layout

    def _head(self) -> str:
        """The class of the network's head; exports before `head` was written name RT-DETR where they say what
        they are.
        """
        described = "RTDETR" if "rtdetr" in self._metadata.get("description", "").lower() else ""
        return str(self._metadata.get("head", described))

    def _literal(self, key: str) -> Any:
        """A value of the metadata, which is Python as text; None where it is none."""
        try:
            return ast.literal_eval(self._metadata[key])
        except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
            return None

    def _read_names(self) -> Names:
        """Class names from the metadata: a dict, or a list, as text."""
        if "names" not in self._metadata:
            return Names()
        names = self._literal("names")
        try:
            pairs = names.items() if isinstance(names, Mapping) else enumerate(names)
            return Names((int(number), str(name)) for number, name in pairs)
        except (ValueError, TypeError) as error:
            raise ModelError(
                f"{self.path}: metadata names is {self._metadata['names'][:SHOWN_METADATA]!r}, not a Python "
                "dict of numbers and names as text; export the model again"
            ) from error

    def _read_input(self) -> tuple[int, int]:
        """(width, height) that the network takes; also notes its input's name and type."""
        inputs = self.session.get_inputs()
        described = ", ".join(f"{item.name} {item.type} {item.shape}" for item in inputs)
        problem = ""
        shape = list(inputs[0].shape) if inputs else []
        if len(inputs) != 1 or len(shape) != 4:
            problem = "one input (1, 3, height, width) is needed; export it for detection"
        elif inputs[0].type not in INPUT_TYPES:
            problem = "float or float16 is needed, from 0 to 1; export it again without integer inputs"
        elif isinstance(shape[1], int) and shape[1] != 3:
            problem = f"3 channels (RGB) are needed before height and width, not {shape[1]}"
        elif isinstance(shape[0], int) and shape[0] != 1:
            problem = f"it takes {shape[0]} pictures at once; export it with batch=1"
        if problem:
            raise ModelError(f"{self.path}: the model's input is {described}; {problem}")
        self._input = inputs[0].name
        self.dtype = INPUT_TYPES[inputs[0].type]
        height, width = shape[2:]
        if not (isinstance(height, int) and isinstance(width, int)):
            height, width = self._said_size()
        return int(width), int(height)

    def _said_size(self) -> tuple[int, int]:
        """(height, width) of a dynamic export, as the metadata says."""
        said = self._literal("imgsz") if "imgsz" in self._metadata else 640
        sides = list(said) if isinstance(said, list | tuple) else [said, said]
        if len(sides) != 2 or not all(isinstance(side, int) and 32 <= side <= 8192 for side in sides):
            raise ModelError(
                f"{self.path}: metadata imgsz {self._metadata['imgsz'][:SHOWN_METADATA]!r} is not [height, "
                "width] of 32 to 8192 px; export the model again"
            )
        return sides[0], sides[1]

    def _read_output(self) -> None:
        outputs = self.session.get_outputs()
        if len(outputs) != 1 and self._task is None:
            described = ", ".join(f"{item.name} {item.shape}" for item in outputs)
            raise ModelError(
                f"{self.path}: the model has {len(outputs)} outputs ({described}) and no metadata that says "
                "its task; export it for detection, with metadata"
            )
        self._outputs = [outputs[0].name]


def open_session(path: Path, provider: str = PROVIDERS["cpu"]) -> onnxruntime.InferenceSession:
    """A model file, to run on one thread of the processor, or on an accelerator. Raises ModelError."""
    if path.stat().st_size == 0:
        raise ModelError(f"{path}: the model file is empty; copy or export it again")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # the other cores belong to the other processes
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 4  # errors come as exceptions; the library would print them as well
    wanted = (provider, OPTIONS.get(provider, {}))
    providers = [wanted] if provider == PROVIDERS["cpu"] else [wanted, PROVIDERS["cpu"]]
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # see Network.run
        raise ModelError(
            f"{path}: not a model that onnxruntime loads ({error}); export it as ONNX again"
        ) from error
