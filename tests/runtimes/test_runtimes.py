"""Networks as ONNX files and on other runtimes: the labels of torch, and one line for what cannot be."""

from __future__ import annotations

import copy
import ctypes
import gc
import json
import os
import pickle
import signal
import sys
import warnings
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from onnx_answers import ask, check_answer, frames
from torch import nn
from toy_network import Toy

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.machine import computes_bfloat16
from bodyseg_data.rigs import Camera
from bodyseg_model.commands import main
from bodyseg_model.networks import Network, build, load_network, predict, save_network, wrapped
from bodyseg_model.runtimes import (
    OPSET,
    backend_of,
    backends,
    on_backend,
    quick_precision,
    to_device,
    write_onnx,
)
from bodyseg_model.runtimes.backends import RuntimeNetwork, folded
from bodyseg_model.runtimes.libraries import OnnxRuntime
from bodyseg_model.runtimes.onnx_files import (
    GraphFacts,
    OnnxModel,
    answer_graph,
    export_trained,
    import_onnx,
    read_onnx,
    scores_part,
    to_onnx,
)
from bodyseg_model.segmentation import Background, Segmenter

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

SETTINGS: dict[str, dict[str, Any]] = {
    "fcn_alexnet": {"width": 1 / 16},
    "compact": {"patch": 8, "widths": [6, 8], "blocks": [0, 1], "shrink": 2},
}
TINY = {"patch": 16, "widths": [8, 12], "blocks": [1, 1]}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    save_network(folder / "network.safetensors", build("compact", TINY, seed=0), "compact", {"variant": "all"})
    return folder


@pytest.mark.parametrize("name", SETTINGS)  # the baselines' tests have the others, where their package is loaded
def test_the_graph_of_a_network_answers_as_torch(name: str) -> None:
    network = build(name, SETTINGS[name], seed=3).eval()
    model = to_onnx(network)
    check_answer(network, model, frames())
    check_answer(network, model, torch.zeros(1, 1, 70, 45))
    assert not network.training


def test_the_graph_of_the_network_that_ships() -> None:
    trained = load_network()
    check_answer(trained.network, export_trained(trained), frames(1))


def test_a_graph_that_is_traced_with_gradients_spreads_scores_by_one_operation(tmp_path: Path) -> None:
    network = build("compact", TINY, seed=0).eval()
    network.forward = network.scores  # type: ignore[method-assign]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(network, (frames(1),), tmp_path / "scores.onnx", opset_version=OPSET, dynamo=False)
    kinds = [node.op_type for node in onnx.load(tmp_path / "scores.onnx").graph.node]
    assert kinds.count("DepthToSpace") == 1


@pytest.mark.parametrize(("backend", "precision"), [("onnxruntime", "float32"), ("openvino", "float32")])
def test_runtimes_give_torchs_labels(backend: str, precision: Any) -> None:
    pytest.importorskip(backend)
    network, range_m = build("compact", TINY, seed=3).eval(), frames()
    expected, found = predict(network, range_m), predict(on_backend(network, backend, precision), range_m)
    assert (found.labels != expected.labels).float().mean() < 1e-4
    torch.testing.assert_close(found.confidence, expected.confidence, atol=2e-4, rtol=0)


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_threads_that_share_a_network_get_their_own_scores(backend: str) -> None:
    pytest.importorskip(backend)
    network = on_backend(build("compact", TINY, seed=3).eval(), backend)
    images = [1 + torch.rand(1, 1, 64, 64) for _ in range(4)]
    expected = list(map(network.scores, images))
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(network.scores, 10 * images))
    assert all(torch.equal(scores, expected[number % 4]) for number, scores in enumerate(found))


class _Stack(ctypes.Structure):
    """`stack_t` of Linux."""

    _fields_ = (("begin", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t))


def _has_stack_for_signals() -> bool:
    """Whether the stack on which this thread handles signals, if it has one of its own, is memory of the process."""
    stack = _Stack()
    assert ctypes.CDLL(None).sigaltstack(None, ctypes.byref(stack)) == 0
    maps = [line.partition(" ")[0].split("-") for line in Path("/proc/self/maps").read_text().splitlines()]
    return not stack.begin or any(int(begin, 16) <= stack.begin < int(end, 16) for begin, end in maps)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")
@pytest.mark.parametrize("elsewhere", [False, True])
def test_signals_have_a_stack_after_networks_are_gone(elsewhere: bool) -> None:
    """The first of two goes first, or both in another thread."""
    pytest.importorskip("openvino")
    assert _has_stack_for_signals()
    networks, image = [on_backend(Toy().eval(), "openvino") for _ in range(2)], torch.ones(1, 1, 64, 64)
    for network in networks:
        network.scores(image)
    del network
    with ThreadPoolExecutor(1) as thread:
        for _ in range(2):
            thread.submit(networks.pop, 0).result() if elsewhere else networks.pop(0)
            gc.collect()
    assert _has_stack_for_signals()


@pytest.mark.usefixtures("one_thread")
def test_a_fork_computes_though_a_thread_of_its_parent_was_about_to() -> None:
    pytest.importorskip("openvino")
    network, image = on_backend(build("compact", TINY, seed=3).eval(), "openvino"), torch.ones(1, 1, 64, 64)
    expected = network.scores(image)
    assert isinstance(network, RuntimeNetwork)
    (session,) = network._sessions.values()
    with session._one_at_a_time:  # type: ignore[attr-defined]
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(30)  # ends a hang
            os._exit(int(torch.equal(network.scores(image), expected)))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1


def test_batch_normalisation_is_folded_into_convolutions() -> None:
    network, range_m = load_network().network, frames(1)
    quick = on_backend(network)
    kinds = [{type(module) for module in each.modules()} for each in (network, quick)]
    assert torch.nn.BatchNorm2d in kinds[0] - kinds[1] and torch.nn.BatchNorm2d not in kinds[1]
    expected, found = predict(network, range_m), predict(quick, range_m)
    assert (found.labels != expected.labels).float().mean() < 1e-4
    torch.testing.assert_close(found.confidence, expected.confidence, atol=2e-4, rtol=0)
    again = load_network().network.state_dict()
    assert all(torch.equal(weight, again[name]) for name, weight in network.state_dict().items()), "it stays as it is"
    assert on_backend(quick) is quick, "nothing is left to fold"
    toy = Toy().eval()
    assert on_backend(toy) is toy
    network.train()
    assert on_backend(network) is network


class _Rectified(nn.Sequential):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        between = self[0](image)
        return between.relu() + self[1](between)


class _Standardised(nn.Conv2d):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self._conv_forward(image, self.weight / self.weight.std(), self.bias)


class _Between(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(33, 33, 1), nn.BatchNorm2d(33))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        between = self.layers[0](image)
        return between.relu() + self.layers[1](between)


class _Twice(_Between):
    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.layers(image) + self.layers[0](image)


def _hooked(block: nn.Sequential) -> nn.Sequential:
    block[1].register_forward_hook(lambda module, given, scores: scores.abs())
    return block


@pytest.mark.parametrize(
    "block",
    [
        _Between(),
        _Twice(),
        _hooked(nn.Sequential(nn.Conv2d(33, 33, 1), nn.BatchNorm2d(33))),
        nn.Sequential(OrderedDict(convolution=nn.Conv2d(33, 33, 3, padding=1), normalisation=nn.BatchNorm2d(33))),
        _Rectified(nn.Conv2d(33, 33, 1), nn.BatchNorm2d(33)),
        nn.Sequential(_Standardised(33, 33, 1), nn.BatchNorm2d(33)),
        nn.Sequential(nn.Conv2d(33, 33, 1), nn.BatchNorm2d(33, track_running_stats=False)),
        nn.Sequential(nn.utils.parametrizations.weight_norm(nn.Conv2d(33, 33, 1)), nn.BatchNorm2d(33)),
    ],
    ids=["between", "twice", "hook", "names", "own forward", "own convolution", "no statistics", "weight norm"],
)
def test_blocks_of_any_kind_keep_their_scores(block: nn.Module) -> None:
    for normalisation in block.modules():
        if isinstance(normalisation, nn.BatchNorm2d):
            nn.init.uniform_(normalisation.weight, 1, 2)
    network = wrapped(nn.Sequential(nn.Conv2d(1, 33, 1), block)).network
    range_m = frames(1)
    with torch.no_grad():
        torch.testing.assert_close(on_backend(network).scores(range_m), network.scores(range_m), atol=1e-4, rtol=1e-4)


def test_a_network_that_has_no_copy_is_computed_as_it_is() -> None:
    module = nn.Sequential(nn.Conv2d(1, 33, 1), nn.BatchNorm2d(33))
    module.last = module(frames(1))  # type: ignore[assignment]  # of a step of a training
    network = wrapped(module).network
    assert on_backend(network) is network
    with pytest.raises(BadConfig, match="bfloat16 needs a copy of the network: Only Tensors created explicitly"):
        on_backend(network, precision="bfloat16")


def test_bfloat16_is_near() -> None:
    network, range_m = load_network().network, frames(1)
    expected = predict(network, range_m)
    kinds = ["torch", *(["openvino"] if _installed("openvino") else [])]
    for backend in kinds:
        moved = on_backend(network, backend, "bfloat16")
        assert backend_of(moved)["precision"] == "bfloat16"
        differ = (predict(moved, range_m).labels != expected.labels).sum() / (expected.labels != 255).sum()
        # A runtime computes in float32 where the processor has no instructions for bfloat16.
        assert differ < 0.1 and (differ > 0 or not computes_bfloat16())


def test_the_quick_precision_is_one_that_the_backend_has(monkeypatch: pytest.MonkeyPatch) -> None:
    network = build("compact", TINY, seed=3).eval()
    monkeypatch.setattr(backends, "computes_bfloat16", lambda: True)
    assert [quick_precision(network, backend, "cpu") for backend in (None, "torch", "openvino", "onnxruntime")] == [
        *["bfloat16"] * 3,
        None,
    ]
    assert quick_precision(on_backend(network, "onnxruntime"), None, "cpu") is None, "as an .onnx file is"
    with pytest.raises(BadConfig, match=r"^the backend must be one of torch, onnxruntime, openvino, found 'caffe'$"):
        quick_precision(network, "caffe", "cpu")
    monkeypatch.setattr(backends, "computes_bfloat16", lambda: False)
    assert quick_precision(network, None, "cpu") is None


@pytest.mark.parametrize(("name", "settings"), [("compact", TINY), ("fcn_alexnet", {"width": 1 / 16})])
def test_weights_that_are_rounded_once_give_autocasts_bits(name: str, settings: dict[str, Any]) -> None:
    network, range_m = build(name, settings, seed=3).eval(), frames(1)
    found = on_backend(network, "torch", "bfloat16")
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        expected = folded(network).scores(range_m)
    with torch.inference_mode():
        assert torch.equal(found.scores(range_m), expected)
    assert all(weight.dtype == torch.float32 for weight in network.parameters())


def _installed(name: str) -> bool:
    try:
        __import__(name)
    except ImportError:
        return False
    return True


def test_a_segmenter_takes_a_backend() -> None:
    network, camera = build("compact", TINY, seed=3).eval(), Camera(60, 80, 60.0, (40, 30), (0, 0, 0), (0, 0, 1))
    frame = np.zeros((60, 80), np.float32)
    frame[10:50, 30:42] = 2.0
    labels = [
        Segmenter(on_backend(network, backend), camera, Background("keep"))(frame).labels
        for backend in ("torch", "onnxruntime")
    ]
    assert np.array_equal(*labels) and (labels[0] != 255).any()


def test_a_network_on_a_backend_keeps_its_precision_where_none_is_asked_for() -> None:
    """A segmenter asks for none: a network put on a backend before computes in what it was put on."""
    pytest.importorskip("openvino")
    network = on_backend(build("compact", TINY, seed=3).eval(), "openvino", "bfloat16")
    assert on_backend(network) is network
    assert backend_of(on_backend(network, "openvino"))["precision"] == "bfloat16"
    assert backend_of(on_backend(network, "openvino", "float32"))["precision"] == "float32"


@pytest.mark.parametrize(
    "again", [copy.deepcopy, lambda network: pickle.loads(pickle.dumps(network))], ids=["copied", "pickled"]
)
@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_a_network_that_has_answered_can_be_sent_to_a_worker(backend: str, again: Callable[[Network], Network]) -> None:
    pytest.importorskip(backend)
    network = on_backend(build("compact", TINY, seed=3).eval(), backend)
    before = predict(network, frames(1)).labels
    assert torch.equal(predict(again(network), frames(1)).labels, before)


def test_sessions_compute_in_as_many_threads_as_torch() -> None:
    network = on_backend(build("compact", TINY, seed=3).eval(), "onnxruntime")
    before = torch.get_num_threads()
    try:
        answers = []
        for threads in (1, 2, 1):
            torch.set_num_threads(threads)
            answers.append(predict(network, frames(1)).labels)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(answers[0], answers[2]) and (answers[0] != answers[1]).float().mean() < 1e-3


def test_the_command_writes_a_file_that_segment_and_evaluate_take(
    run: Path, small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tiny.onnx"
    assert main(["export", "--run", str(run), "--onnx", str(out)]) == 0
    assert "opset 18\n" in capsys.readouterr().err
    card, texts = load_network(run).card, {entry.key: entry.value for entry in onnx.load(out).metadata_props}
    assert texts["weights_sha256"] == card["weights_sha256"]
    assert {name: json.loads(texts["card"])[name] for name in card} == card
    assert {"labels", "rig"} <= json.loads(texts["card"]).keys()

    words = ["--data", str(small_set), "--images", "4", "--frames", "0", "--num-workers", "0", "--other-rig", "--json"]
    found = {}
    for name, options in {
        "torch": ["--run", str(run)],
        "file": ["--run", str(out)],
        "runtime": ["--run", str(run), "--backend", "onnxruntime"],
        "both": ["--run", str(run), "--flip-average"],
    }.items():
        assert main(["evaluate", *options, *words, str(tmp_path / f"{name}.json")]) == 0
        found[name] = json.loads((tmp_path / f"{name}.json").read_text())
    assert {name: (each["runtime"]["backend"], each["runtime"]["precision"]) for name, each in found.items()} == {
        "torch": ("torch", "float32"),
        "file": ("onnxruntime", "float32"),
        "runtime": ("onnxruntime", "float32"),
        "both": ("torch", "float32"),
    }
    assert [name for name, each in found.items() if each["runtime"].get("flip_average")] == ["both"]
    assert found["both"]["pixel_accuracy"] != found["torch"]["pixel_accuracy"]
    accuracies = {name: each["pixel_accuracy"] for name, each in found.items()}
    assert accuracies["torch"] == pytest.approx(accuracies["file"], abs=1e-3)
    assert accuracies["runtime"] == accuracies["file"]


def test_one_line_says_what_is_wrong(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.onnx").write_bytes(b"no graph")
    model = to_onnx(Toy().eval())
    write_onnx(tmp_path / "toy.onnx", OnnxModel(model.graph, model.facts, {"rig": 3}))
    bare = onnx.ModelProto()
    bare.CopyFrom(model.graph)
    (tmp_path / "bare.onnx").write_bytes(bare.SerializeToString())
    onnx.helper.set_model_props(bare, {"format": "bodyseg onnx 1", "graph": "{}", "card": "{}"})
    (tmp_path / "odd.onnx").write_bytes(bare.SerializeToString())
    to = ["--json", str(tmp_path / "x.json"), "--data", str(tmp_path)]
    for words, message in (
        (["export"], "give the file to write"),
        (["export", "--onnx", "x.pb"], "--onnx must be a .onnx file"),
        (["export", "--run", str(run), "--onnx", str(tmp_path / "absent" / "x.onnx")], "--onnx needs a file in"),
        (["evaluate", "--run", str(tmp_path / "bad.onnx"), *to], "is not a whole ONNX file"),
        (["evaluate", "--run", str(tmp_path / "bare.onnx"), *to], "the format must be 'bodyseg onnx 1', found None"),
        (["evaluate", "--run", str(tmp_path / "odd.onnx"), *to], "its metadata must describe the graph"),
        (["evaluate", "--run", str(tmp_path / "toy.onnx"), *to], "toy.onnx: "),
        (["evaluate", "--run", str(run), "--backend", "tvm", *to], "--backend"),
        (["evaluate", "--run", str(run), "--backend", "onnxruntime", "--precision", "bfloat16", *to], "one of float32"),
        (["evaluate", "--run", str(run), "--backend", "onnxruntime", "--device", "cuda", *to], "found the device cuda"),
    ):
        assert main(words) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1


class _Branching(Toy):
    """Traced with one image, a network whose scores take another way for others."""

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        found = super().scores(range_m)
        return -found if len(range_m) == 2 else found


class _Permuted(Toy):
    """A network that writes into a permuted view, which the exporter loses without a word."""

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        found = super().scores(range_m)
        found.permute(0, 2, 3, 1)[F.avg_pool2d(range_m[:, 0], 8, ceil_mode=True) > 2.0] = -5.0
        return found


@pytest.mark.parametrize("kind", [_Branching, _Permuted])
def test_a_network_that_no_trace_holds_is_not_written(kind: type[Toy]) -> None:
    with pytest.raises(BadConfig, match=f"{kind.__name__} cannot be written as ONNX: traced with one image"):
        to_onnx(kind().eval())


class _Half(Toy):
    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.ones((), dtype=torch.half))

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        return super().scores(range_m) * self.factor


def test_what_python_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadConfig, match="in evaluation mode"):
        answer_graph(Toy().train())
    with pytest.raises(BadConfig, match="a network in bfloat16 cannot be written as ONNX"):
        answer_graph(on_backend(Toy().eval(), precision="bfloat16"))
    with pytest.raises(BadConfig, match="the backend must be one of torch, onnxruntime, openvino, found 'tvm'"):
        on_backend(Toy().eval(), "tvm")
    with pytest.raises(BadConfig, match="the precision of torch must be one of float32, bfloat16, found 'int8'"):
        on_backend(Toy().eval(), "torch", "int8")  # type: ignore[arg-type]

    class Odd(Toy):
        def scores(self, range_m: torch.Tensor) -> torch.Tensor:
            return torch.linalg.pinv(super().scores(range_m))

    with pytest.raises(BadConfig, match="Odd cannot be written as ONNX: "):
        answer_graph(Odd().eval())
    assert answer_graph(_Half().eval())
    graph = answer_graph(Toy().eval())
    with pytest.raises(BadConfig, match="must compute 'scores' from 'range_m'"):
        scores_part(onnx.helper.make_model(onnx.helper.make_graph([], "none", [], [])))
    moved = RuntimeNetwork(OnnxModel(graph, GraphFacts(33, 1)), "onnxruntime", OnnxRuntime, "float32")
    with pytest.raises(BadConfig, match="an ONNX file is computed by onnxruntime or openvino, found the backend torch"):
        on_backend(moved, "torch")
    with pytest.raises(BadConfig, match="its graph is there already, as its attribute `model`"):
        answer_graph(moved)
    to_device(moved, "cpu")
    for package, needs in (("onnx", import_onnx), ("onnxruntime", lambda: on_backend(Toy().eval(), "onnxruntime"))):
        with monkeypatch.context() as patch:
            patch.setitem(__import__("sys").modules, package, None)
            with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[onnx\]'"):
                needs()
    with monkeypatch.context() as patch:
        patch.setitem(__import__("sys").modules, "openvino", None)
        with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[openvino\]'"):
            on_backend(Toy().eval(), "openvino")


def test_a_file_is_what_was_written(tmp_path: Path) -> None:
    model = to_onnx(Toy().eval(), {"seed": 4})
    write_onnx(tmp_path / "toy.onnx", model)
    read = read_onnx(tmp_path / "toy.onnx")
    assert read.facts == model.facts and read.card == {"seed": 4}
    assert [*map(np.sum, ask(read, frames()))] == [*map(np.sum, ask(model, frames()))]
    with pytest.raises(BadConfig, match=r"the file must end in \.onnx, found .*toy$"):
        write_onnx(tmp_path / "toy", model)


def graph_of(*nodes: Any, inputs: Any = (), opset: int = 18, facts: Any = None) -> bytes:
    """A file of a graph that nobody exported, whose last node gives the scores."""
    helper, real = onnx.helper, onnx.TensorProto.FLOAT
    named = [helper.make_node("Identity", ["scores"], [name]) for name in ("labels", "confidence")]
    sides = {"range_m": ["n", 1, "r", "c"], "labels": ["a", "b", "c"], "confidence": ["a", "b", "c"]}
    values = [helper.make_tensor_value_info(name, real, shape) for name, shape in sides.items()]
    graph = helper.make_graph([*nodes, *named], "g", values[:1], values[1:], inputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=9)
    texts = facts or json.dumps({"classes": 33, "output_stride": 4})
    helper.set_model_props(model, {"format": "bodyseg onnx 1", "graph": texts, "card": "{}"})
    data: bytes = model.SerializeToString()
    return data


def test_graphs_that_lie_are_one_line(tmp_path: Path) -> None:
    make, tensor, whole = onnx.helper.make_node, onnx.helper.make_tensor, onnx.TensorProto.INT64
    plain, huge = make("Identity", ["range_m"], ["scores"]), make("ConstantOfShape", ["s"], ["scores"])
    sizes = [tensor("s", whole, [1], [1 << 40])]
    squared = [make("Shape", ["range_m"], ["h"]), make("Mul", ["h", "h"], ["q"]), make("Mul", ["q", "q"], ["s"]), huge]
    value, real, flag = onnx.helper.make_tensor_value_info, onnx.TensorProto.FLOAT, onnx.TensorProto.BOOL
    kept = [[value(f"go{end}", flag, []), value(f"x{end}", real, ["n", 1, "r", "c"])] for end in ("", "_on")]
    steps = [make("Identity", [name], [f"{name}_on"]) for name in ("go", "x")]
    body = onnx.helper.make_graph(steps, "body", [value("i", whole, []), *kept[0]], kept[1])
    loop = make("Loop", ["", "on", "range_m"], ["scores"], body=body)
    on = [tensor("on", flag, [], [True])]
    elsewhere = tensor("w", real, [1], [1.0])
    elsewhere.external_data.add(key="location", value="weights.bin")
    listed = [make("SequenceConstruct", ["range_m"], ["all"]), make("SequenceAt", ["all", "at"], ["scores"])]
    for data, message in (
        (graph_of(huge, inputs=sizes), "it asks for more than 4294967296 bytes"),
        (graph_of(*squared), "it asks for more than 4294967296 bytes"),
        (graph_of(plain), r"scores must be \[1, 50, 34, 33\], found \[1, 1, 200, 136\]"),
        (graph_of(loop, inputs=on), "plain operators, no loops, branches or functions, found some"),
        (
            graph_of(*listed, inputs=[tensor("at", whole, [], [0])]),
            r"a graph must have plain operators, .*, found \['SequenceAt', 'SequenceConstruct'\]",
        ),
        (
            graph_of(make("Add", ["range_m", "w"], ["scores"]), inputs=[elsewhere]),
            "a graph must hold its weights itself, found the name of another file",
        ),
        (graph_of(plain, opset=19), "opset must be at most 18, found 19"),
        (
            graph_of(plain, facts=json.dumps({"classes": 33, "output_stride": 10**9})),
            "output_stride must be from 1 to 64",
        ),
        (graph_of(plain, facts="[" * 100_000), "its metadata must describe the graph"),
    ):
        (tmp_path / "a.onnx").write_bytes(data)
        with pytest.raises(BadConfig, match=message) as caught:
            predict(backends.load_network(tmp_path / "a.onnx").network, torch.ones(1, 1, 200, 136))
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
