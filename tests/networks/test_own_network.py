"""Any torch module as a network: labelled frames, scores, ONNX; and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_rig import SMALL
from torch import nn

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PARTS33, load_label_map
from bodyseg_data.rigs import Camera
from bodyseg_model import (
    FrameLabeller,
    Segmenter,
    Trained,
    evaluate,
    load_network,
    on_backend,
    open_images,
    predict,
    wrapped,
    write_onnx,
)
from bodyseg_model.networks import FlipAverage, Network
from bodyseg_model.networks.registry import predict_dense

CAMERA = Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


class UNet(nn.Module):
    """A plain U-Net that shrinks images once, by 4."""

    def __init__(self, classes: int, channels: int = 1) -> None:
        super().__init__()
        self.fine = nn.Sequential(nn.Conv2d(channels, 4, 3, padding=1), nn.BatchNorm2d(4), nn.ReLU())
        self.coarse = nn.Sequential(nn.MaxPool2d(4), nn.Conv2d(4, 4, 3, padding=1), nn.Upsample(scale_factor=4))
        self.last = nn.Conv2d(8, classes, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        fine = self.fine(image)
        scores: torch.Tensor = self.last(torch.cat([fine, self.coarse(fine)], 1))
        return scores


@pytest.fixture
def unet() -> UNet:
    torch.manual_seed(3)
    return UNet(33)


def normalised(metres: torch.Tensor) -> torch.Tensor:
    return (metres - 2.5) * (metres > 0)


def test_a_wrapped_module_is_asked_as_it_was_trained(unet: UNet) -> None:
    mine = wrapped(unet, multiple=4, prepare=normalised)
    assert not unet.training and mine.network.classes == 33 and mine.label_map == PARTS33
    image = torch.rand(2, 1, 10, 7) + 2
    image[:, :, :3] = 0
    padded = torch.zeros(2, 1, 12, 8)
    padded[:, :, :10, :7] = image
    with torch.no_grad():
        expected = unet(normalised(padded))[:, :, :10, :7]
        torch.testing.assert_close(mine.network(image), expected)
    found = predict(mine.network, image)
    np.testing.assert_array_equal(found.labels[:, 3:], expected.argmax(1)[:, 3:])
    assert (found.labels[:, :3] == 255).all()


def test_a_compiled_network_takes_images_of_any_size(unet: UNet) -> None:
    network = wrapped(unet, multiple=4).network
    compiled = torch.compile(network, backend="eager", dynamic=True, fullgraph=True)
    image = torch.rand(1, 1, 61, 47, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(compiled(image), network(image))


def test_a_module_that_was_trained_meanwhile_is_refused_until_it_is_in_evaluation_mode(unet: UNet) -> None:
    network = wrapped(unet, multiple=4).network
    for each in (network, FlipAverage(network)):
        unet.train()
        with pytest.raises(BadConfig, match="^a wrapped module must be in evaluation mode, as its network is"):
            predict(each, FRAME + 2)
        predict(each.eval(), FRAME + 2)
    unet.fine.train()  # of single layers, such as dropout that tells how unsure a network is, users decide themselves
    predict(network, FRAME + 2)
    with pytest.raises(BadConfig, match="^predict needs a network in evaluation mode"):
        predict(network.train(), FRAME + 2)


@pytest.mark.usefixtures("near_is_person")
def test_frames_are_labelled_and_scores_counted(unet: UNet, figures_set: Path) -> None:
    mine = wrapped(unet, rig=SMALL, multiple=4)
    frame = np.full((60, 80), 4, np.float32)
    frame[10:50, 20:32] = 2
    one = Segmenter(mine, CAMERA)(frame)
    other = FrameLabeller(mine, device="cpu")(frame, CAMERA)
    assert (one.labels[10:50, 20:32] < 33).all() and len(one.bodies) == len(other.bodies) == 1
    np.testing.assert_array_equal(one.labels, other.labels)
    assert evaluate(mine.network, open_images(str(figures_set)), 2).total().images == 2


def test_an_onnx_file_has_answer_and_card(unet: UNet, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    limbs = load_label_map("limbs14")
    mine = wrapped(UNet(14, 2), limbs, rig=SMALL, multiple=4, prepare=lambda m: torch.cat([m, (m > 0).float()], 1))
    write_onnx(str(tmp_path / "mine.onnx"), mine)
    again = load_network(str(tmp_path / "mine.onnx"))
    assert again.card == json.loads(json.dumps(mine.card)) and (again.label_map, again.rig) == (limbs, SMALL)
    for shape in ((1, 1, 12, 20), (2, 1, 33, 21)):
        image = torch.rand(shape) * 3
        first, second = predict(mine.network, image), predict(again.network, image)
        assert (first.labels == second.labels).float().mean() > 0.99
        torch.testing.assert_close(first.confidence, second.confidence, atol=1e-5, rtol=0)


def test_classes_may_be_names() -> None:
    mine = wrapped(nn.Conv2d(1, 2, 1), ["floor", "arm"])
    assert mine.label_map.names == ("floor", "arm") and FrameLabeller(mine, device="cpu").background.mode == "frame"
    assert (Segmenter(mine, CAMERA)(np.full((60, 80), 2, np.float32)).labels < 2).all()


class TooFew(Network):
    """Scores of fewer points than its stride promises."""

    output_stride = 4

    def __init__(self) -> None:
        super().__init__()
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(range_m), 33, 1, 1)

    def scores_and_places(self, range_m: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(range_m), 36, 1, 1)


FRAME = torch.zeros(1, 1, 8, 8)
UNWRAPPED = "^a network must be a bodyseg_model.Network: `bodyseg_model.wrapped.* is one, found Conv2d$"
CARDLESS = r"^a network with its card is needed, as load_network\(.*\) and wrapped\(module\) give it, found Conv2d$"
NO_BACKGROUND: Any = "keep"
PLAIN: Any = nn.Conv2d(1, 33, 1)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (
            lambda: predict(wrapped(nn.Conv2d(1, 5, 1)).network, FRAME + 2),
            r"Conv2d must .*, \[1, 33, 8, 8\], found \[1, 5",
        ),
        (lambda: wrapped(nn.Conv2d(1, 33, 3)).network(FRAME), r"\[1, 33, 8, 8\], found \[1, 33, 6, 6\]"),
        (lambda: wrapped(nn.LSTM(8, 33)).network(FRAME[0]), r"^range images must be \[B, 1, H, W\]"),
        (lambda: wrapped(PLAIN, multiple=0), "^multiple must be a whole number of at least 1"),
        (lambda: wrapped(PLAIN, "limbs14"), "^classes must be a list of names, found 'limbs14'"),
        (
            lambda: wrapped(wrapped(PLAIN).network),
            "^what is wrapped must be a torch module and no Network, found Wrapped",
        ),
        (lambda: Segmenter(PLAIN, CAMERA), UNWRAPPED),
        (lambda: FrameLabeller(PLAIN), CARDLESS),
        (lambda: FrameLabeller(wrapped(PLAIN).network), CARDLESS.replace("Conv2d", "WrappedModule")),
        (
            lambda: FrameLabeller(wrapped(PLAIN), NO_BACKGROUND),
            r"^background must be of class Background, found 'keep'$",
        ),
        (lambda: predict(PLAIN, FRAME), UNWRAPPED),
        (lambda: predict(TooFew(), FRAME + 2), r"^TooFew must give scores \[1, 33, 2, 2\], found \[1, 33, 1, 1\]$"),
        (lambda: predict_dense(TooFew(), FRAME + 2, False), r"^TooFew .* \[1, 36, 2, 2\], found \[1, 36, 1, 1\]$"),
        (lambda: on_backend(PLAIN), UNWRAPPED),
        (lambda: write_onnx("x.onnx", PLAIN), CARDLESS),
        (
            lambda: write_onnx("x.onnx", Trained(wrapped(nn.Conv2d(1, 2, 1), ["floor", "arm"]).network, {})),
            "^the network must have the 33 classes of labels 'parts33', found 2",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(ask: Callable[[], Any], said: str) -> None:
    with pytest.raises(BadConfig, match=said):
        ask()


def test_an_evaluation_asks_for_a_network(figures_set: Path) -> None:
    with pytest.raises(BadConfig, match=UNWRAPPED):
        evaluate(PLAIN, open_images(str(figures_set)))
