"""The paper's network: its layers, where its answers lie, and AlexNet's weights in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.helper
import onnx.numpy_helper
import pytest
import torch
from numpy.typing import NDArray
from numpy_alexnet import figure_4

from bodyseg_data.core import BadConfig
from bodyseg_model.networks.fcn_alexnet import SHAPES, FcnAlexnet, bilinear_filters

LAYERS = {
    "conv1.weight": (96, 1, 11, 11),
    "conv1.bias": (96,),
    "conv2.weight": (256, 48, 5, 5),
    "conv2.bias": (256,),
    "conv3.weight": (384, 256, 3, 3),
    "conv3.bias": (384,),
    "conv4.weight": (384, 192, 3, 3),
    "conv4.bias": (384,),
    "conv5.weight": (256, 192, 3, 3),
    "conv5.bias": (256,),
    "conv6.weight": (4096, 256, 6, 6),
    "conv6.bias": (4096,),
    "conv7.weight": (4096, 4096, 1, 1),
    "conv7.bias": (4096,),
    "conv8.weight": (16, 4096, 1, 1),
    "conv8.bias": (16,),
    "upfeat.weight": (16, 16, 63, 63),
    "score.weight": (33, 16, 1, 1),
    "score.bias": (33,),
}


@pytest.fixture(scope="module")
def network() -> FcnAlexnet:
    torch.manual_seed(0)
    return FcnAlexnet().eval()


def test_every_layer_has_the_shape_of_figure_4(network: FcnAlexnet) -> None:
    assert {name: tuple(value.shape) for name, value in network.state_dict().items()} == LAYERS
    assert round(sum(value.numel() for value in network.parameters()) / 1e6) == 58


def test_new_layers_are_gaussian_and_upfeat_is_frozen(network: FcnAlexnet) -> None:
    for layer in (network.conv8, network.score):
        assert layer.weight.std().item() == pytest.approx(0.01, rel=0.15)
        assert abs(layer.weight.mean().item()) < 0.002 and not layer.get_parameter("bias").any()
    assert [name for name, value in network.named_parameters() if not value.requires_grad] == ["upfeat.weight"]


@pytest.mark.parametrize("settings", [{"normalise": "false"}, {"normalise": None}, {"width": 5}])
def test_settings_out_of_range_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(BadConfig, match=r"^normalise must be true or false, width from 1/16 to 4, found .* and "):
        FcnAlexnet.from_settings(settings)


@pytest.mark.parametrize("size", [(1, 1), (640, 329), (31, 33), (64, 200)])
def test_the_answer_has_the_size_of_the_image(size: tuple[int, int]) -> None:
    with torch.no_grad():
        assert FcnAlexnet(width=1 / 16)(torch.zeros(2, 1, *size)).shape == (2, 33, *size)


@pytest.mark.parametrize("shape", [(1, 3, 8, 8), (1, 8, 8), (0, 1, 8, 8)])
def test_other_shapes_are_refused(network: FcnAlexnet, shape: tuple[int, ...]) -> None:
    with pytest.raises(BadConfig, match=r"range images must be \[B, 1, H, W\], found"):
        network(torch.zeros(shape))


def test_bilinear_filters_interpolate() -> None:
    coarse = torch.tensor([[[[0.0, 1.0, 3.0]], [[5.0, 5.0, 5.0]]]])
    fine = torch.nn.functional.conv_transpose2d(coarse, bilinear_filters(2, 4), stride=4)[0, :, 3]
    assert fine[0, 3:12].tolist() == [0, 0.25, 0.5, 0.75, 1, 1.5, 2, 2.5, 3]
    assert (fine[1, 3:12] == 5).all()


def test_an_answer_lies_where_it_looked() -> None:
    """Let everything see everything, and see around which pixel the answer of one pixel is centred."""
    network = FcnAlexnet(width=1 / 16).eval()  # what is seen is the same at any width
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name != "upfeat.weight":
                value.fill_(0 if name.endswith("bias") else 1 / value[0].numel())
    image = torch.zeros(1, 1, 481, 481, requires_grad=True)
    with torch.no_grad():
        image += 1
    pixel = 32 * 7 + 13
    # Max pooling passes gradients to one pixel of several equal ones; a mean has no favourite.
    network._pool = torch.nn.AvgPool2d(3, stride=2, ceil_mode=True)  # type: ignore[assignment]
    network(image)[0, 0, pixel, pixel].backward()
    assert image.grad is not None
    seen = image.grad[0, 0].double()
    rows = torch.arange(481.0, dtype=torch.float64)
    centre = (seen.sum(dim=1) * rows).sum() / seen.sum(), (seen.sum(dim=0) * rows).sum() / seen.sum()
    assert centre == pytest.approx((pixel, pixel), abs=0.01)


@pytest.fixture(scope="module")
def lively() -> FcnAlexnet:
    """A narrow network whose weights are so large that every ReLU and the normalisation change its answer."""
    torch.manual_seed(4)
    network = FcnAlexnet(normalise=True, width=1 / 16).eval()
    with torch.no_grad():
        for name, value in network.named_parameters():
            if name.endswith("weight") and name != "upfeat.weight":
                value.normal_(std=(2 / value[0].numel()) ** 0.5)
            elif name.endswith("bias"):
                value.normal_()
    return network


@pytest.mark.parametrize("normalise", [False, True])
def test_the_forward_pass_is_figure_4_in_plain_numpy(lively: FcnAlexnet, normalise: bool) -> None:
    network = FcnAlexnet(normalise, 1 / 16).eval()
    network.load_state_dict(lively.state_dict())
    range_m = 2 + np.random.default_rng(0).random((90, 41))
    range_m[:30, :20] = 0  # nothing measured
    weights = {name: value.double().numpy() for name, value in network.state_dict().items()}
    expected = figure_4(weights, range_m, normalise)
    with torch.no_grad():
        found = network(torch.from_numpy(range_m)[None, None].float())[0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    other = figure_4(weights, range_m, not normalise)
    assert np.abs(other - expected).max() > 0.05 * np.abs(expected).max()


def test_half_of_what_conv6_and_conv7_give_is_dropped_while_learning_and_nothing_else(lively: FcnAlexnet) -> None:
    """As in AlexNet: what is kept counts twice, and what is asked for later is all there."""
    seen: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
    layers = {name: layer for name, layer in lively.named_children() if name.startswith(("conv", "score"))}
    hooks = [
        layer.register_forward_hook(lambda _, x, y, name=name: seen.update({name: (x[0], y)}))
        for name, layer in layers.items()
    ]
    range_m = 2 + torch.rand(8, 1, 60, 40, generator=torch.Generator().manual_seed(1))
    try:
        with torch.no_grad():
            lively(range_m)
            whole = dict(seen)
            torch.manual_seed(0)
            lively.train()(range_m)
    finally:
        lively.eval()
        for hook in hooks:
            hook.remove()
    for name in ("conv1", "conv2", "conv3", "conv4", "conv5", "conv6"):
        assert torch.equal(seen[name][0], whole[name][0]), "no dropout before conv6"
    for name, after in (("conv6", "conv7"), ("conv7", "conv8")):
        given, taken = seen[name][1].relu(), seen[after][0]
        kept = taken != 0
        assert torch.equal(taken[kept], 2 * given[kept])
        assert float(kept[given > 0].float().mean()) == pytest.approx(0.5, abs=0.03)
        assert torch.equal(whole[after][0], whole[name][1].relu())
    every = torch.arange(60), torch.arange(40)
    assert torch.equal(seen["score"][0], lively._upsampled(seen["conv8"][1].relu(), *every)), "nor after conv8"


# AlexNet's own file, made small in number of fields and in width: the same messages and names.

KEPT = {"fc6": "conv6", "fc7": "conv7"}
"""Layers of AlexNet that have another name in the network."""

Layers = list[tuple[str, NDArray[np.float32], NDArray[np.float32]]]


def drawn(shapes: Mapping[str, tuple[int, ...]]) -> Layers:
    """Name, weight and bias of each layer, drawn at random."""
    draw = np.random.default_rng(5)
    return [
        (name, draw.random(shape, np.float32) - 0.5, draw.random(shape[0], np.float32))
        for name, shape in shapes.items()
    ]


def onnx_file(alexnet: Layers) -> bytes:
    tensors = [
        onnx.numpy_helper.from_array(array, f"{name}_{kind}_0")
        for name, weight, bias in alexnet
        for array, kind in ((weight, "w"), (bias, "b"))
    ]
    graph = onnx.helper.make_graph([], "graph", [], [], tensors)
    found: bytes = onnx.helper.make_model(graph).SerializeToString()
    return found


def test_the_files_layers_are_those_of_the_network() -> None:
    """conv1 has three channels there, and fc6 and fc7 are matrices."""
    for name, shape in SHAPES.items():
        kept = LAYERS[f"{KEPT.get(name, name)}.weight"]
        assert shape == {"conv1": (96, 3, 11, 11), "fc6": (4096, 256 * 6 * 6), "fc7": (4096, 4096)}.get(name, kept)
        assert shape[0] == kept[0] and math.prod(shape) == (3 if name == "conv1" else 1) * math.prod(kept)


def test_alexnet_is_imported_weight_by_weight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At a sixteenth of its width: 60 million weights take five seconds of processor."""
    network = FcnAlexnet(normalise=True, width=1 / 16)
    for name, shape in SHAPES.items():
        inputs = shape[1] if name == "conv1" else shape[1] // 16
        monkeypatch.setitem(SHAPES, name, (shape[0] // 16, inputs, *shape[2:]))
    alexnet = drawn(SHAPES)
    path = tmp_path / "a.onnx"
    path.write_bytes(onnx_file(alexnet))
    state = network.state_dict()
    new = {key: value.clone() for key, value in state.items() if key[:5] in ("conv8", "upfea", "score")}
    network.load_pretrained(path)
    got = {key: value.numpy() for key, value in network.state_dict().items()}
    for layer, weight, bias in alexnet:
        kept = KEPT.get(layer, layer)
        if layer == "conv1":
            np.testing.assert_allclose(got["conv1.weight"][:, 0], weight.mean(axis=1), atol=1e-7)
        elif layer == "fc6":  # its inputs are counted channel by channel, row by row
            assert got["conv6.weight"][7, 3, 2, 5] == weight[7, 3 * 36 + 2 * 6 + 5]
            assert np.array_equal(got["conv6.weight"].reshape(len(weight), -1), weight)
        else:
            assert np.array_equal(got[f"{kept}.weight"].reshape(weight.shape), weight), layer
        np.testing.assert_array_equal(got[f"{kept}.bias"], bias)
    for key, value in new.items():
        assert torch.equal(network.state_dict()[key], value), "layers that AlexNet has not are left alone"
    with pytest.raises(BadConfig, match=r"a\.onnx is for a network of width 1, found width 0\.125$"):
        FcnAlexnet(width=1 / 8).load_pretrained(path)


def small(name: str = "conv1_b_0", count: int = 96, value: float = 0.0) -> bytes:
    tensor = onnx.numpy_helper.from_array(np.full(count, value, np.float32), name)
    return onnx.helper.make_model(onnx.helper.make_graph([], "g", [], [], [tensor])).SerializeToString()  # type: ignore[no-any-return]


def cut_tensor() -> bytes:
    tensor = onnx.TensorProto(name="conv1_w_0", data_type=onnx.TensorProto.FLOAT, dims=[96], raw_data=bytes(383))
    return onnx.helper.make_model(onnx.helper.make_graph([], "g", [], [], [tensor])).SerializeToString()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.pth", b"x", "come as .onnx, found"),
        ("a.onnx", b"", "has no weight of AlexNet's layer conv1"),
        ("a.onnx", b"hello, world", "is not a whole .onnx file"),
        ("a.onnx", small()[:-9], "is not a whole .onnx file"),
        ("a.onnx", small(), "has no weight of AlexNet's layer conv1"),
        ("a.onnx", small("conv1_w_0"), r"the weight of conv1 must be \(96, 3, 11, 11\), found \(96,\)"),
        ("a.onnx", cut_tensor(), "is not a whole .onnx file"),
        ("a.onnx", b"\xff" * 30, "is not a whole .onnx file"),
    ],
)
def test_what_is_not_alexnet_is_refused(network: FcnAlexnet, tmp_path: Path, name: str, data: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(data)
    before = network.conv1.weight.clone()
    with pytest.raises(BadConfig, match=said):
        network.load_pretrained(tmp_path / name)
    assert torch.equal(network.conv1.weight, before)


def test_a_file_that_is_not_there_is_named(network: FcnAlexnet, tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match=r"cannot read .*a\.onnx: No such file"):
        network.load_pretrained(tmp_path / "a.onnx")


def test_two_small_matrices_are_upfeat(network: FcnAlexnet) -> None:
    x = torch.randn(2, 16, 9, 7, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = network.upfeat(x)[:, :, 18 : 18 + 200, 18 : 18 + 150]
        answer = network._upsampled(x, torch.arange(200), torch.arange(150))
        torch.testing.assert_close(answer, expected, atol=2e-6, rtol=1e-6)


def test_asked_for_some_pixels_it_answers_and_learns_as_if_asked_for_all() -> None:
    torch.manual_seed(0)
    network = FcnAlexnet(width=1 / 16).eval()
    range_m, rows, columns = 2 + torch.rand(2, 1, 70, 50), torch.arange(3, 70, 4), torch.tensor([0, 7, 49])
    answers = [network(range_m)[:, :, rows][..., columns], network.scores_at(range_m, rows, columns)]
    torch.testing.assert_close(answers[1], answers[0], atol=1e-6, rtol=1e-5)
    learned = []
    for scores in answers:
        network.zero_grad()
        scores.square().sum().backward()
        learned.append([weight.grad.clone() for weight in network.parameters() if weight.grad is not None])
    assert len(learned[0]) == 18
    for of_all, of_some in zip(*learned, strict=True):
        assert of_all.any()
        torch.testing.assert_close(of_some, of_all, atol=1e-4 * float(of_all.abs().max()), rtol=1e-4)
