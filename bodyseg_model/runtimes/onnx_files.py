"""Networks as ONNX files: the graph from range images to labels and confidences, and in its metadata the card.

torch's exporter by tracing writes graphs. The one by torch.export takes 15 s of processor time for `compact` instead of
0.3, and rounds divisions of negative sizes towards zero, as ONNX's own division does.
"""

import io
import json
import warnings
from contextlib import redirect_stdout
from dataclasses import MISSING, asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core import BadConfig, Checked, bounded
from bodyseg_data.files import read_bytes, write_result
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import required
from bodyseg_model.networks import Network, Trained, check_label_map, check_trained
from bodyseg_model.runtimes.libraries import RANGE, SCORES, OnnxRuntime

FORMAT: Final = "bodyseg onnx 1"
SUFFIX: Final = ".onnx"

OPSET: Final = 18
"""Version of ONNX's operators that graphs use."""

LABELS: Final = "labels"
CONFIDENCE: Final = "confidence"
"""Names of values beside `RANGE` and `SCORES`: labels uint8 and confidences float32, [B, H, W]."""

_REFUSED: Final = ("String", "Regex", "Sequence", "Optional", "ConcatFrom")  # no runtime bounds their memory
_EXAMPLE: Final = (1, 1, 200, 136)
_AXES: Final = {RANGE: {0: "images", 2: "rows", 3: "columns"}} | {
    name: {0: "images", 1: "rows", 2: "columns"} for name in (LABELS, CONFIDENCE)
}


class _Answer(nn.Module):
    """All of `registry.predict`, in operations that can be traced for images of any size."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, range_m: torch.Tensor) -> tuple[torch.Tensor, ...]:
        network = self.network
        measured = range_m[:, 0] > 0
        scores = network.scores(range_m).permute(0, 2, 3, 1).contiguous()
        full = scores.permute(0, 3, 1, 2)
        if network.output_stride > 1:
            full = F.interpolate(full, scale_factor=network.output_stride, mode="bilinear", align_corners=False)
        full = full[:, :, : range_m.shape[2], : range_m.shape[3]]
        best, label = full.max(1)
        share = 1 / (full - best[:, None]).exp().sum(1)
        labels = torch.where(measured, label.float(), torch.tensor(float(BACKGROUND))).to(torch.uint8)
        return labels, torch.where(measured, share, torch.tensor(0.0)), scores


def answer_graph(network: Network) -> Any:
    """A network as an onnx.ModelProto: `RANGE` -> `LABELS` and `CONFIDENCE`, for any number of images of any size.

    The value `SCORES` is in it by this name. network: in evaluation mode. Raises BadConfig for a
    network that cannot be traced, MissingLibrary without onnx.
    """
    onnx = import_onnx()
    if network.training:
        raise BadConfig("a network is written as ONNX in evaluation mode: call network.eval() first")
    if any(weights.dtype == torch.bfloat16 for weights in network.parameters()):
        raise BadConfig("a network in bfloat16 cannot be written as ONNX, as ONNX Runtime does not compute it")
    example = torch.zeros(_EXAMPLE)
    example[:, :, 20:-20, 20:-20] = 2.5
    buffer, names = io.BytesIO(), [LABELS, CONFIDENCE, SCORES]
    try:
        # Layers check their input by comparing sizes. The tracer warns that it fixes these checks, which is wanted,
        # and prints of graphs that it cannot write what is of no use to users.
        with torch.no_grad(), warnings.catch_warnings(), redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            torch.onnx.export(
                _Answer(network).eval(),
                (example,),
                buffer,  # type: ignore[arg-type]  # the exporter by tracing writes into it
                input_names=[RANGE],
                output_names=names,
                dynamic_axes=_AXES,
                opset_version=OPSET,
                dynamo=False,
            )
    except Exception as error:  # of any kind: a network may be the user's
        first = str(error).strip().splitlines()[:1] or [""]
        raise BadConfig(f"{type(network).__name__} cannot be written as ONNX: {first[0]}") from error
    _check_trace(network, buffer.getvalue())
    model = onnx.load_from_string(buffer.getvalue())
    del model.graph.output[2:]
    return model


def _check_trace(network: Network, graph: bytes) -> None:
    """Raise BadConfig if a graph gives other scores than its network for images of another size and number.

    A trace holds what happened with its example: the branch that was taken, a size that was a plain number. The check
    is by ONNX Runtime, where it is installed and has the network's arithmetic.
    """
    other = torch.linspace(0.5, 4, 2 * 104 * 168).reshape(2, 1, 104, 168).flip(2).contiguous()
    other[:, :, :24, 40:] = 0
    try:
        runtime = OnnxRuntime(graph, "float32", threads=1)
    except Exception:  # of the runtime's own kinds
        return
    with torch.no_grad():
        expected = network.scores(other).float().permute(0, 2, 3, 1).numpy()
    try:
        found = runtime.scores(other.numpy())
        same = found.shape == expected.shape and abs(found - expected).max() <= 0.1 * abs(expected).max()
    except Exception:  # of the runtime's own kinds
        same = False
    if not same:
        raise BadConfig(
            f"{type(network).__name__} cannot be written as ONNX: traced with one image, it gives other scores for "
            "images of another size or number, as with branches that depend on the image"
        )


def scores_part(model: Any) -> Any:
    """The part of an `answer_graph` from `RANGE` to `SCORES`, an onnx.ModelProto. Raises BadConfig for one without."""
    onnx = import_onnx()
    whole = onnx.ModelProto()
    whole.CopyFrom(model)
    sides = ["images", "score_rows", "score_columns", None]
    whole.graph.output.append(onnx.helper.make_tensor_value_info(SCORES, onnx.TensorProto.FLOAT, sides))
    try:
        return onnx.utils.Extractor(whole).extract_model([RANGE], [SCORES])
    except ValueError as error:
        raise BadConfig(
            f"an ONNX file must compute {SCORES!r} from {RANGE!r}, as `bodyseg export --onnx` writes it"
        ) from error


import_onnx = partial(required, "onnx", "the format ONNX", "onnx")


@dataclass(frozen=True)
class GraphFacts(Checked):
    """Properties of a graph's network; see `Network`."""

    classes: int
    output_stride: int = bounded(MISSING, 1, 64)


@dataclass(frozen=True)
class OnnxModel:
    """A network as an ONNX graph (`answer_graph`, an onnx.ModelProto), with its card."""

    graph: Any = field(repr=False)
    facts: GraphFacts
    card: dict[str, Any] = field(default_factory=dict, repr=False)


def to_onnx(network: Network, card: dict[str, Any] | None = None) -> OnnxModel:
    """A network, in evaluation mode, as an ONNX graph. Raises BadConfig and MissingLibrary as `answer_graph`."""
    return OnnxModel(answer_graph(network), GraphFacts(network.classes, network.output_stride), card or {})


def export_trained(trained: Trained) -> OnnxModel:
    """A trained network as an ONNX graph with its card, whose entries name its labels and its rig in any case."""
    check_trained(trained)
    check_label_map(trained.network, trained.label_map)  # or the file could not be read again
    card = {**trained.card, "labels": trained.label_map.to_json(), "rig": trained.rig.to_json()}
    return to_onnx(trained.network, card)


def write_onnx(path: Path | str, trained: Trained | OnnxModel) -> int:
    """Write a network with its card as an ONNX file, whole or not at all; returns its bytes. Raises BadConfig."""
    if Path(path).suffix != SUFFIX:  # `load_network` tells the kind of a file by it
        raise BadConfig(f"the file must end in {SUFFIX}, found {path}")
    model = trained if isinstance(trained, OnnxModel) else export_trained(trained)
    onnx = import_onnx()
    graph = onnx.ModelProto()
    graph.CopyFrom(model.graph)
    graph.producer_name = "bodyseg"
    texts = {
        "format": FORMAT,
        "graph": json.dumps(asdict(model.facts)),
        "card": json.dumps(model.card),
        "weights_sha256": str(model.card.get("weights_sha256", "")),
        "input": "range_m: float32 [images, 1, rows, columns], metres along the optical axis, 0 = nothing measured",
        "output": "labels: uint8 [images, rows, columns], 255 = nothing measured; confidence: float32, 0 to 1",
    }
    onnx.helper.set_model_props(graph, texts)
    data: bytes = graph.SerializeToString()
    write_result(Path(path), data)
    return len(data)


def read_onnx(path: Path) -> OnnxModel:
    """Read a file that `write_onnx` wrote. Raises BadConfig, naming it, for any other, and MissingLibrary."""
    onnx = import_onnx()
    data = read_bytes(path)
    try:
        graph = onnx.load_from_string(data)
        onnx.checker.check_model(graph)
    except Exception as error:  # protobuf's and onnx's errors share no class
        first = str(error).strip().splitlines()[:1] or [""]
        raise BadConfig(f"{path} is not a whole ONNX file: {first[0]}") from error
    if fault := _fault_of(graph):
        raise BadConfig(f"{path}: {fault}")
    texts = {entry.key: entry.value for entry in graph.metadata_props}
    if texts.get("format") != FORMAT:
        raise BadConfig(f"{path}: the format must be {FORMAT!r}, found {texts.get('format')!r}")
    try:
        facts, card = json.loads(texts["graph"]), json.loads(texts["card"])
        return OnnxModel(graph, GraphFacts(**facts), dict(card))
    except (KeyError, TypeError, ValueError, RecursionError, BadConfig) as error:
        raise BadConfig(f"{path}: its metadata must describe the graph and its network ({error})") from error


def _fault_of(model: Any) -> str | None:
    """Find what may make a graph compute without end, or read other files; None for nothing."""
    nodes = model.graph.node
    parts = [attribute for node in nodes for attribute in node.attribute]
    strange = sorted({node.op_type for node in nodes if node.domain or node.op_type.startswith(_REFUSED)})
    if strange or model.functions or any(part.HasField("g") or part.graphs for part in parts):
        return f"a graph must have plain operators, no loops, branches or functions, found {strange or 'some'}"
    if any(each.external_data for each in (*model.graph.initializer, *(part.t for part in parts))):
        return "a graph must hold its weights itself, found the name of another file"
    newest = max((each.version for each in model.opset_import), default=0)
    return f"a graph's opset must be at most {OPSET}, found {newest}" if newest > OPSET else None
