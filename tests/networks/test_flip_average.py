"""The mean of a network's answers to an image and to its mirror image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from toy_network import Toy

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PART_CLASSES, PARTS33, LabelMap, load_label_map
from bodyseg_model.networks import FlipAverage, Network, Trained, build, load_network, predict
from bodyseg_model.runtimes import backend_of, on_backend, put_on_backend, to_device

TINY = {"patch": 16, "widths": [8, 12], "blocks": [1, 1]}


def toy(label_map: LabelMap = PARTS33) -> Network:
    torch.manual_seed(4)
    return Toy(classes=len(label_map)).eval()


def image(rows: int, columns: int) -> NDArray[np.float32]:
    draws = np.random.default_rng(columns).random((rows, columns))
    return np.where(draws < 0.8, 2 + draws, 0).astype(np.float32)


def batch(*images: NDArray[np.float32]) -> torch.Tensor:
    return torch.from_numpy(np.stack([each.copy() for each in images])[:, None])


@pytest.mark.parametrize("columns", [40, 45, 47])
@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("label_map", [PARTS33, load_label_map("limbs14")])
def test_scores_are_the_mean_of_both(columns: int, together: bool, label_map: LabelMap) -> None:
    network = toy(label_map)
    network.together = together
    frame = image(24, columns)
    wide = np.zeros((24, -(-columns // 8) * 8), np.float32)  # whole strides
    wide[:, :columns] = frame
    with torch.inference_mode():
        own = network.scores(batch(wide))[0].numpy()
        of_mirror = network.scores(batch(wide[:, ::-1]))[0].numpy()
        found = FlipAverage(network, label_map).scores(batch(frame))[0].numpy()
    assert found.shape == (len(label_map), 3, wide.shape[1] // 8)
    for label in range(len(label_map)):
        opposite = int(label_map.mirrored[label])
        expected = (own[label] + of_mirror[opposite, :, ::-1]) / 2
        np.testing.assert_allclose(found[label], expected, rtol=0, atol=1e-5)


def test_a_mirror_image_gets_the_mirrored_labels() -> None:
    network = FlipAverage(load_network().network)
    frame = np.zeros((640, 332), np.float32)
    frame[100:560, 90:250] = 2.5 + np.random.default_rng(0).normal(0, 0.1, (460, 160)).cumsum(0).cumsum(1) / 3000
    labels, mirrored = (predict(network, batch(each)).labels[0].numpy() for each in (frame, frame[:, ::-1]))
    assert len(np.unique(labels)) > 5
    assert (PART_CLASSES.mirrored[labels[:, ::-1]] == mirrored).mean() > 0.9999  # sums are rounded in another order
    plain = predict(load_network().network, batch(frame)).labels[0].numpy()
    assert (plain != labels).any()


@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_a_runtime_computes_both(backend: str) -> None:
    pytest.importorskip(backend)
    network = build("compact", TINY, seed=0).eval()
    frames = batch(image(64, 45), image(64, 45)[::-1])
    by_torch = FlipAverage(network)
    other = on_backend(by_torch, backend)
    assert isinstance(other, FlipAverage) and not other.together
    with torch.inference_mode():
        np.testing.assert_allclose(other.scores(frames), by_torch.scores(frames), rtol=0, atol=1e-4)
    assert backend_of(other) == {**backend_of(other.network), "flip_average": True}
    with pytest.raises(BadConfig, match=f"^{backend} computes on the processor, found the device cuda$"):
        to_device(other, "cuda")
    to_device(other, "cpu")


def test_a_trained_network_keeps_its_card() -> None:
    trained = Trained(build("compact", TINY, seed=0).eval(), {"network": "compact"})
    averaged = put_on_backend(trained, None, "bfloat16", flip_average=True)
    assert averaged.card is trained.card and isinstance(averaged.network, FlipAverage)
    assert backend_of(averaged.network)["precision"] == "bfloat16" and backend_of(averaged.network)["flip_average"]
    assert "flip_average" not in backend_of(put_on_backend(trained, None, None).network)


def test_other_classes_than_the_networks_are_refused() -> None:
    with pytest.raises(BadConfig, match="the network must have the 14 classes of labels 'limbs14', found 33"):
        FlipAverage(toy(), load_label_map("limbs14"))
