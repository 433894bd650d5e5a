"""The detector process and its core."""

import os

# From 1.29 on onnxruntime keeps a device's number in the home folder and calls its maker, as soon as it is
# imported, unless this is set. A drone tells nobody but its neighbours.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
