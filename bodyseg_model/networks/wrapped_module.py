"""Networks of users: any torch module from range images to scores of classes, for all that takes a `Network`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core import BadConfig, check_int
from bodyseg_data.labels import PARTS33, LabelClass, LabelMap, classes_of, load_label_map, whole_map
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_model.networks.checkpoints import CardWords, Trained
from bodyseg_model.networks.network import Network, check_range_images
from bodyseg_model.networks.registry import device_of

Prepare = Callable[[torch.Tensor], torch.Tensor]

_TRIED: Final = (97, 71)  # rows and columns, of which no small number is a divisor


class WrappedModule(Network):
    """A torch module as a network; see `wrapped`."""

    def __init__(self, module: nn.Module, classes: int, prepare: Prepare | None, multiple: int, stride: int) -> None:
        super().__init__({}, classes)
        self.module, self.prepare, self.multiple, self.output_stride = module, prepare, multiple, stride

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores; see `Network.scores`. Raises BadConfig where the module gives others."""
        check_range_images(range_m)
        rows, columns = range_m.shape[2:]
        image = F.pad(range_m, (0, -columns % self.multiple, 0, -rows % self.multiple))
        scores = self.module(image if self.prepare is None else self.prepare(image))
        whole = [len(image), self.classes, *(-(-side // self.output_stride) for side in image.shape[2:])]
        found = list(scores.shape) if isinstance(scores, torch.Tensor) else type(scores).__name__
        if found != whole:
            raise BadConfig(
                f"{type(self.module).__name__} must give scores {whole}, [images, classes, rows, columns], for range "
                f"images {list(image.shape)}, found {found}"
            )
        seen: torch.Tensor = scores[:, :, : -(-rows // self.output_stride), : -(-columns // self.output_stride)]
        return seen


def wrapped(
    module: nn.Module,
    labels: str | Path | LabelMap | Iterable[str | LabelClass] = PARTS33,
    *,
    rig: str | Path | Rig = "paper",
    prepare: Prepare | None = None,
    multiple: int = 1,
    output_stride: int = 1,
) -> Trained:
    """Wrap a torch module for everything that takes a network of this package: `Segmenter` and `evaluate` take
    `wrapped(module).network`, `FrameLabeller` and `export_onnx` the whole, which has a card.

    module: takes range images, float32 [B, 1, H, W], metres along the optical axis, 0 = nothing measured, of any size;
    gives scores (logits), float [B, C, H, W]. It is put into evaluation mode, and stays on its device. labels: its C
    classes in their order: names, a label map, or the name or TOML file of one of the 33 parts. rig: camera and
    stand-off of the images that it was trained on, by default the paper's: `FrameLabeller` resamples bodies to it.
    prepare: makes the module's input of the range images, where it takes others: other units, normalised ones, more
    channels. multiple: range images are padded at their right and bottom, by 0, until both sides are multiples of it.
    output_stride: pixels along each side between two scores (`Network.output_stride`).

    The module is tried on an image of 97 x 71 pixels. Raises BadConfig if it fails, or gives other scores than these.
    """
    if not isinstance(module, nn.Module) or isinstance(module, Network):
        raise BadConfig(f"what is wrapped must be a torch module and no Network, found {type(module).__name__}")
    if isinstance(labels, str | Path):
        label_map = load_label_map(labels)
    else:
        label_map = labels if isinstance(labels, LabelMap) else whole_map(classes_of(labels))
    sides = check_int("multiple", multiple, 1), check_int("output_stride", output_stride, 1)
    network = WrappedModule(module, len(label_map), prepare, *sides).eval()
    name = type(module).__name__
    try:
        with torch.inference_mode():
            network.scores(torch.full((1, 1, *_TRIED), 2.0, device=device_of(module)))
    except BadConfig:
        raise
    except Exception as error:  # of any kind, as modules are anybody's
        first = str(error).strip().splitlines()[:1] or [type(error).__name__]
        padded = f"padded to multiples of {multiple}" if multiple > 1 else "multiple= pads them, prepare= changes them"
        raise BadConfig(
            f"{name} fails for range images [1, 1, {_TRIED[0]}, {_TRIED[1]}] ({padded}): {first[0]}"
        ) from error
    card = {"format": CardWords.FORMAT, "network": name, "settings": {}, "labels": label_map.to_json()}
    return Trained(network, {**card, "rig": (rig if isinstance(rig, Rig) else load_rig(rig)).to_json()})
