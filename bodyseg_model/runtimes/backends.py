"""Backends of networks by name: torch, and the runtimes that compute ONNX graphs on the processor.

Networks that are not trained any more are computed as torch does it quickest: folded, and in bfloat16.
"""

import copy
import itertools
import os
from pathlib import Path
from typing import Any, get_args

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from bodyseg_data.core import BadConfig, check_choice, reported
from bodyseg_data.machine import computes_bfloat16
from bodyseg_model.networks import (
    FlipAverage,
    Network,
    Trained,
    check_network,
    check_range_images,
    check_trained,
    device_of,
    find_device,
    trained_network,
)
from bodyseg_model.networks import load_network as load_weights
from bodyseg_model.runtimes.libraries import MOST_BYTES, OF_FILES, RUNTIMES, TORCH, BackendName, Precision, Runtime
from bodyseg_model.runtimes.onnx_files import SUFFIX, OnnxModel, read_onnx, scores_part, to_onnx


class RuntimeNetwork(Network):
    """A network whose scores a runtime computes; all else that takes a `Network` takes it, but it cannot be trained.

    identity: name and version of the runtime, and precision, as plain JSON. Threads are as many as torch may use when
    scores are asked for; a process keeps a session for each number. Raises BadConfig for a precision that the runtime
    does not have, MissingLibrary if the runtime is not installed.
    """

    together = False  # a runtime prepares for every shape of its input that it has not met

    def __init__(self, model: OnnxModel, name: str, runtime: type[Runtime], precision: Precision) -> None:
        settings = model.card.get("settings")
        focal_px = settings.get("focal_px") if isinstance(settings, dict) else None  # what a finder of people needs
        super().__init__({"focal_px": focal_px} if focal_px else {}, model.facts.classes)
        check_choice(f"the precision of {name}", precision, runtime.precisions)
        self.output_stride = model.facts.output_stride
        self.model = model
        self._runtime, self._graph = runtime, scores_part(model.graph).SerializeToString()
        self._sessions: dict[tuple[int, int], Runtime] = {}  # by process and number of threads
        self.identity: dict[str, Any] = {
            "backend": name,
            "version": str(runtime.loaded().__version__),
            "precision": precision,
        }
        self.eval()

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_sessions": {}}  # another process, or a copy, makes its own

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores; see `Network.scores`. Raises BadConfig for a graph that cannot, or gives others."""
        check_range_images(range_m)
        if torch.onnx.is_in_onnx_export():  # the trace would hold the example's scores
            raise BadConfig("its graph is there already, as its attribute `model`, which write_onnx takes")
        own = os.getpid(), torch.get_num_threads()  # a fork has none of its parent's threads, and may have its locks
        try:
            if own not in self._sessions:
                self._sessions[own] = self._runtime(self._graph, self.identity["precision"], threads=own[1])
            found = self._sessions[own].scores(range_m.detach().cpu().float().contiguous().numpy())
        except Exception as error:  # of the runtime's own kinds
            text = " ".join(str(error).split())
            why = f"it asks for more than {MOST_BYTES} bytes" if "vailable memory" in text else text[:300]
            raise BadConfig(f"{self.identity['backend']} cannot compute the network: {why}") from error
        wanted = [len(range_m), *(-(-side // self.output_stride) for side in range_m.shape[2:]), self.classes]
        if list(found.shape) != wanted:
            raise BadConfig(f"by its stride and classes, scores must be {wanted}, found {list(found.shape)}")
        return torch.from_numpy(found).permute(0, 3, 1, 2)


def on_backend(network: Network, backend: BackendName | None = None, precision: Precision | None = None) -> Network:
    """A network, in evaluation mode, as a backend computes it in a precision; with torch `folded`.

    backend, precision: by default torch and float32; for a `RuntimeNetwork`, its own. Raises BadConfig for an unknown
    backend, a precision that it lacks, and a network that cannot be written as ONNX; MissingLibrary, naming the extra.
    """
    check_network(network)
    if isinstance(network, FlipAverage):
        return FlipAverage(on_backend(network.network, backend, precision), network.label_map)
    if isinstance(network, RuntimeNetwork):
        name: str = backend or network.identity["backend"]
        if name == TORCH:
            raise BadConfig(f"an ONNX file is computed by {' or '.join(RUNTIMES)}, found the backend {name}")
        asked: Precision = precision or network.identity["precision"]
        if (name, asked) == (network.identity["backend"], network.identity["precision"]):
            return network
        return RuntimeNetwork(network.model, name, _runtime(name), asked)
    name, chosen = backend or TORCH, precision or "float32"
    if name == TORCH:
        check_choice(f"the precision of {name}", chosen, get_args(Precision))
        quick = folded(network)
        return Bfloat16(quick) if chosen == "bfloat16" else quick
    runtime = _runtime(name)
    check_choice(f"the precision of {name}", chosen, runtime.precisions)  # before the graph is made
    runtime.loaded()
    return RuntimeNetwork(to_onnx(network, {"settings": network.settings}), name, runtime, chosen)


def quick_precision(network: Network, backend: BackendName | None, device: str | None) -> Precision | None:
    """The precision for those who ask for none and want speed: bfloat16, as accurate in 0.6 to 0.8 of the time
    (docs/how-to/runtimes.md), where a processor with instructions for it computes; else None: `on_backend` chooses.

    device: as of `to_device`. Raises as that and `on_backend` for an unknown backend or device.
    """
    if isinstance(network, RuntimeNetwork) or not computes_bfloat16() or find_device(device).type != "cpu":
        return None
    has_it = backend in (None, TORCH) or "bfloat16" in _runtime(str(backend)).precisions
    return "bfloat16" if has_it else None


def put_on_backend(
    trained: Trained, backend: BackendName | None, precision: Precision | None, flip_average: bool = False
) -> Trained:
    """A trained network with its card on a backend; see `on_backend`. flip_average: as `FlipAverage`."""
    check_trained(trained)
    network = on_backend(trained.network, backend, precision)
    return Trained(FlipAverage(network, trained.label_map) if flip_average else network, trained.card)


def load_network(path: Path | str | None = None, *, dense: bool = False) -> Trained:
    """Load a trained network with its card, onto the processor.

    path: a run's folder, for the network that the training ended with, or the last checkpoint of one that has not; a
    .safetensors file, with its .json beside it, such as a run's best.safetensors; an .onnx file, for onnxruntime; or,
    where there is no such path, "compact", "large" or "finder", which ship with the package. None for `compact`.
    dense: with the head of places on the template, which the `compact` that ships has in a file of its own; others have
    it if they were trained with one.

    The card's `step` says which step the weights are of, its `weights_sha256` which file they were read from. A card
    without rig, sensor or SHA-256 is valid. Raises BadConfig, naming the file, for what is missing, damaged or does not
    fit the card: with weights of another SHA-256, or a rig that is none; MissingLibrary for an .onnx file.
    """
    if path is None or Path(path).suffix != SUFFIX or Path(path).is_dir():
        return load_weights(path, dense=dense)
    model = read_onnx(Path(path))
    network = RuntimeNetwork(model, OF_FILES, _runtime(OF_FILES), "float32")
    return trained_network(network, model.card, Path(path))


def backend_of(network: Network) -> dict[str, Any]:
    """Name, version and precision of a network's backend, plain JSON; `flip_average`, true, for a `FlipAverage`."""
    if isinstance(network, FlipAverage):
        return {**backend_of(network.network), "flip_average": True}
    if isinstance(network, RuntimeNetwork):
        return dict(network.identity)
    precision = "bfloat16" if isinstance(network, Bfloat16) else "float32"
    return {"backend": TORCH, "version": torch.__version__, "precision": precision}


def to_device(network: Network, device: str | None) -> None:
    """Move a network to a device, by default a GPU if there is one; the runtimes' networks stay on the processor.

    Raises BadConfig for a device that is not there, or another one than the processor for a runtime.
    """
    computed = network.network if isinstance(network, FlipAverage) else network
    if isinstance(computed, RuntimeNetwork):
        if device not in (None, "cpu"):
            raise BadConfig(f"{computed.identity['backend']} computes on the processor, found the device {device}")
        return
    network.to(find_device(device))


def _runtime(backend: str) -> type[Runtime]:
    """The class of a runtime. Raises BadConfig for an unknown name."""
    return RUNTIMES[check_choice("the backend", backend, (TORCH, *RUNTIMES))]


def folded(network: Network) -> Network:
    """A copy of a network in evaluation mode that computes each convolution and the batch normalisation after it as one
    convolution; the network itself where none follow each other in an `nn.Sequential`, where it has no copy with its
    scores, as with blocks of which it takes what is between, or while it is trained.

    Scores differ by the rounding of float32. The copy cannot be trained.
    """
    if network.training or not any(_normalised_convolutions(module) for module in network.modules()):
        return network
    example = torch.linspace(1, 4, 64 * 64, dtype=torch.float32, device=device_of(network)).reshape(1, 1, 64, 64)
    try:
        with torch.no_grad(), torch.autocast(example.device.type, enabled=False):
            found = copy.deepcopy(network)
            for module in list[Any](found.modules()):
                for first, convolution, normalisation in _normalised_convolutions(module):
                    module[first], module[first + 1] = fuse_conv_bn_eval(convolution, normalisation), nn.Identity()
            scores, expected = found.scores(example), network.scores(example)
    except Exception:  # of any kind: a network may be the user's
        return network
    return found if (scores - expected).abs().max() <= 0.01 * expected.abs().max() else network


def _normalised_convolutions(module: nn.Module) -> list[tuple[int, Any, Any]]:
    """The convolutions of a Sequential that a batch normalisation follows, both of torch's own classes, so none has
    weights or a `forward` of its own: number, convolution, normalisation.
    """
    children: Any = module if isinstance(module, nn.Sequential) else ()
    return [
        (number, child, following)
        for number, (child, following) in enumerate(itertools.pairwise(children))
        if (type(child), type(following)) == (nn.Conv2d, nn.BatchNorm2d)
    ]


class Bfloat16(Network):
    """A copy of a network in evaluation mode, computed in bfloat16 on its device.

    Convolutions are in 16 bits, sums in 32, as torch's autocast divides them.
    """

    def __init__(self, network: Network) -> None:
        super().__init__(network.settings, network.classes)
        self.output_stride, self.on_template = network.output_stride, network.on_template
        with reported("bfloat16 needs a copy of the network", BadConfig, RuntimeError, TypeError):
            self.network = copy.deepcopy(network)
        for module in self.network.modules():
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                module.to(torch.bfloat16)  # autocast would round the weights in every call, to the same bits
        self.train(network.training)

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        with torch.autocast(device_of(self.network).type, torch.bfloat16):
            return self.network.scores(range_m)

    def scores_and_places(self, range_m: torch.Tensor) -> torch.Tensor:
        with torch.autocast(device_of(self.network).type, torch.bfloat16):
            return self.network.scores_and_places(range_m)
