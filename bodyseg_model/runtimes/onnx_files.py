"""ONNX files of networks: the graph with its answer, and in its metadata the card and what a runtime must know."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from bodyseg_data.core.errors import BadConfig, check_fields
from bodyseg_data.core.files import write_result
from bodyseg_model.networks.checkpoints import Trained, read_bytes
from bodyseg_model.networks.network import Network
from bodyseg_model.runtimes.graphs import OPSET, answer_graph, import_onnx, scores_part

FORMAT: Final = "bodyseg onnx 1"
SUFFIX: Final = ".onnx"

Precision = Literal["float32", "bfloat16", "int8"]


@dataclass(frozen=True)
class GraphFacts:
    """Properties of a graph's network; see `Network`. precision: float32, or int8 for a quantised graph.

    calibration: set, images and method that quantised it; empty for float32.
    """

    classes: int
    output_stride: int
    precision: Precision = "float32"
    calibration: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def of(cls, network: Network) -> GraphFacts:
        """Properties of a network."""
        return cls(network.classes, network.output_stride)


@dataclass(frozen=True)
class OnnxModel:
    """A network as an ONNX graph (`graphs.answer_graph`, an onnx.ModelProto), with its card."""

    graph: Any = field(repr=False)
    facts: GraphFacts
    card: dict[str, Any] = field(default_factory=dict, repr=False)

    def scores_bytes(self) -> bytes:
        """The part that computes scores (`graphs.scores_part`), as the bytes of an ONNX file."""
        data: bytes = scores_part(self.graph).SerializeToString()
        return data


def to_onnx(network: Network, card: dict[str, Any] | None = None) -> OnnxModel:
    """A network, in evaluation mode, as an ONNX graph. Raises BadConfig and MissingLibrary as `answer_graph`."""
    return OnnxModel(answer_graph(network), GraphFacts.of(network), card or {})


def export_trained(trained: Trained) -> OnnxModel:
    """A trained network as an ONNX graph with its card, whose entries name its labels and its rig in any case."""
    label_map, rig = trained.label_map, trained.rig
    card = {**trained.card, "labels": label_map.to_json(), "rig": rig.to_json()}
    return to_onnx(trained.network, card)


def write_onnx(path: Path, model: OnnxModel) -> int:
    """Write a model with its metadata, at once or not at all; returns the file's size, bytes. Raises BadConfig."""
    onnx = import_onnx()
    graph = onnx.ModelProto()
    graph.CopyFrom(model.graph)
    graph.producer_name = "bodyseg"
    texts = {
        "format": FORMAT,
        "graph": json.dumps(asdict(model.facts)),
        "card": json.dumps(model.card),
        "weights_sha256": str(model.card.get("weights_sha256", "")),
        "opset": str(OPSET),
        "input": "range_m: float32 [images, 1, rows, columns], metres along the optical axis, 0 = nothing measured",
        "output": "labels: uint8 [images, rows, columns], 255 = nothing measured; confidence: float32, 0 to 1",
    }
    onnx.helper.set_model_props(graph, texts)
    data: bytes = graph.SerializeToString()
    write_result(path, data)
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
    texts = {entry.key: entry.value for entry in graph.metadata_props}
    if texts.get("format") != FORMAT:
        raise BadConfig(f"{path}: the format must be {FORMAT!r}, found {texts.get('format')!r}")
    try:
        facts, card = json.loads(texts["graph"]), json.loads(texts["card"])
        return OnnxModel(graph, GraphFacts(**facts), dict(card))
    except (KeyError, TypeError, ValueError, BadConfig) as error:
        raise BadConfig(f"{path}: its metadata must describe the graph and its network ({error})") from error
