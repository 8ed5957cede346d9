"""Backends of networks by name: torch, and the runtimes of ONNX graphs."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import torch

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.networks.checkpoints import CheckpointName, Trained, load_network, shipped_network
from bodyseg_model.networks.network import Network, check_label_map
from bodyseg_model.runtimes.onnx_files import SUFFIX, Precision, read_onnx, to_onnx
from bodyseg_model.runtimes.runtime import Runtime, RuntimeNetwork
from bodyseg_model.runtimes.torch_bfloat16 import Bfloat16
from bodyseg_model.training.distributed import find_device

TORCH: Final = "torch"
OF_FILES: Final = "onnxruntime"
"""The backend of an ONNX file for which none is named."""

RUNTIMES: Final[dict[str, str]] = {
    "onnxruntime": "onnx_runtime.OnnxRuntime",
    "openvino": "openvino_runtime.OpenVino",
}
"""Name -> "module.Class" of this folder, imported when it is used."""

BACKEND_HELP: Final = "what computes the network (default: torch; of an .onnx file, onnxruntime)"
PRECISION_HELP: Final = "arithmetic of the network (default: float32; of an .onnx file, its own)"

if TYPE_CHECKING:
    BackendName = str
else:
    BackendName = Literal[(TORCH, *RUNTIMES)]


def on_backend(network: Network, backend: BackendName = TORCH, precision: Precision = "float32") -> Network:
    """A network, in evaluation mode, whose scores a backend computes in a precision; as it is for torch in float32.

    A `RuntimeNetwork` is given to another runtime with its graph. Raises BadConfig for an unknown backend, a precision
    that it does not have, a network that cannot be written as ONNX; MissingLibrary, naming the extra.
    """
    if backend == TORCH:
        if isinstance(network, RuntimeNetwork):
            raise BadConfig(f"an ONNX file is computed by {' or '.join(RUNTIMES)}, found the backend {backend}")
        if precision == "int8":
            raise BadConfig("torch computes in float32 or bfloat16, found int8")
        return Bfloat16(network) if precision == "bfloat16" else network
    runtime = _runtime(backend)
    if precision not in runtime.precisions:  # before the graph is made
        raise BadConfig(f"{backend} computes in {' or '.join(runtime.precisions)}, found {precision}")
    runtime.version()
    model = network.model if isinstance(network, RuntimeNetwork) else to_onnx(network)
    return RuntimeNetwork(model, backend, runtime, precision)


def load_on_backend(
    run: Path | None,
    backend: BackendName | None = None,
    precision: Precision | None = None,
    checkpoint: CheckpointName | None = None,
) -> Trained:
    """Load a run's folder, a .safetensors or an .onnx file, or for None the network that ships, onto a backend.

    backend: by default torch, for an .onnx file `OF_FILES`. precision: by default float32, for an .onnx file its own.
    checkpoint: as for `load_network`. Raises BadConfig and MissingLibrary as `load_network`, `read_onnx`, `on_backend`.
    """
    if run is None or run.suffix != SUFFIX or run.is_dir():
        trained = shipped_network() if run is None else load_network(run, checkpoint)
        return Trained(on_backend(trained.network, backend or TORCH, precision or "float32"), trained.card)
    if checkpoint is not None:
        raise BadConfig(f"checkpoint {checkpoint!r} is one of a run's folder, found {run}")
    if backend == TORCH:
        raise BadConfig(f"an ONNX file is computed by {' or '.join(RUNTIMES)}, found the backend {backend}: {run}")
    model, name = read_onnx(run), backend or OF_FILES
    network = RuntimeNetwork(model, name, _runtime(name), precision or model.facts.precision)
    trained = Trained(network, model.card)
    try:  # here, where the file is known
        check_label_map(network, trained.label_map)
        _ = trained.rig
    except BadConfig as error:
        raise BadConfig(f"{run}: {error}") from error
    return trained


def backend_of(network: Network) -> dict[str, Any]:
    """Name and version of the backend that computes a network, and its precision, as plain JSON."""
    if isinstance(network, RuntimeNetwork):
        return dict(network.identity)
    precision = "bfloat16" if isinstance(network, Bfloat16) else "float32"
    return {"backend": TORCH, "version": torch.__version__, "precision": precision}


def to_device(network: Network, device: str | None) -> None:
    """Move a network to a device, by default a GPU if there is one; the runtimes' networks stay on the processor.

    Raises BadConfig for a device that is not there, or another one than the processor for a runtime.
    """
    if isinstance(network, RuntimeNetwork):
        if device not in (None, "cpu"):
            raise BadConfig(f"{network.identity['backend']} computes on the processor, found the device {device}")
        return
    network.to(find_device(device))


def _runtime(backend: str) -> type[Runtime]:
    """The class of a runtime. Raises BadConfig for an unknown name."""
    if backend not in RUNTIMES:
        raise BadConfig(f"the backend must be one of {', '.join([TORCH, *RUNTIMES])}, found {backend!r}")
    module, kind = RUNTIMES[backend].split(".")
    found: type[Runtime] = getattr(import_module(f"{__package__}.{module}"), kind)
    return found
