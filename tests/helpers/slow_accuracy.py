"""Average per-class accuracy without batches, workers or crops: what benches and evaluation are compared with."""

from __future__ import annotations

from torch import nn

from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation import ConfusionMatrix
from bodyseg_model.networks import predict


def slow_accuracy(network: nn.Module, images: RangeImages, count: int) -> float:
    """Label the first `count` images of epoch 0, one after the other."""
    matrix = ConfusionMatrix()
    for index in images.order(0)[:count].tolist():
        sample = images[index]
        matrix.add(sample["labels"].numpy(), predict(network, sample["range"][None]).labels[0].numpy())
    return round(matrix.average_per_class_accuracy(), 5)
