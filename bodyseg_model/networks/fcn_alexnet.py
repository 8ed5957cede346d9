"""The paper's network: AlexNet made fully convolutional (section 3.4, Fig. 4; Long, Shelhamer and Darrell, CVPR 2015).

Widths, groups and rounding are those of the AlexNet that was published with Caffe, whose weights the paper starts from:
conv2, conv4 and conv5 have two groups, and pooling counts a last window that is not full.

Fig. 4 leaves two things open. It gives upfeat a stride of 16, but the strides before it multiply to 4 * 2 * 2 * 2 = 32
and a bilinear kernel of 63 = 2 * 32 - 1 belongs to 32: upfeat has a stride of 32 here. And it does not state the
padding: as in Caffe's FCN-AlexNet, conv1 is padded by 100, so that images of any size get scores, which are cropped.

Training may start from AlexNet's published weights, in a file that the user has: `load_pretrained` reads the weights of
`bvlcalexnet-12.onnx` of the ONNX model zoo; its graph is not run.
"""

import re
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from numpy.typing import NDArray
from torch import nn

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.machine import required
from bodyseg_model.networks.checkpoints import read_bytes
from bodyseg_model.networks.network import Network, check_range_images

SHAPES: Final[dict[str, tuple[int, ...]]] = {
    "conv1": (96, 3, 11, 11),
    "conv2": (256, 48, 5, 5),
    "conv3": (384, 256, 3, 3),
    "conv4": (384, 192, 3, 3),
    "conv5": (256, 192, 3, 3),
    "fc6": (4096, 9216),
    "fc7": (4096, 4096),
}
"""AlexNet's layers that the network keeps: shapes of their weights. conv2, conv4 and conv5 have two groups."""

_LAYER: Final = {"fc6": "conv6", "fc7": "conv7"}

Arrays = dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]

_TENSOR: Final = re.compile(r"(conv[1-5]|fc[67])_([wb])(?:_0)?")  # names of AlexNet's tensors in the file

STRIDE: Final = 32
_PADDING: Final = 100
_KERNEL: Final = 2 * STRIDE - 1

# Pixel m of conv7 sees the image around 32 m + 13. Pixel m of conv1 is at 4 m + 5 - 100 of the image; each of the three
# poolings doubles the factor and adds one of its input's pixels; conv6 adds 2.5 of its own. Upfeat puts m at 32 m + 31.
_CROP: Final = 18

RANGE_SCALE: Final = 50.0
"""Factor on ranges in metres: a person at 2.5 m is then as bright as the images AlexNet was trained on."""


class FcnAlexnet(Network):
    """Range images -> scores of the classes, one for every pixel, for images of any size.

    normalise: AlexNet's local response normalisation after conv1 and conv2. It has no parameters; Fig. 4 does not list
    it, but weights imported from AlexNet were learned with it. width: a share of all channel counts up to conv7, for
    measuring what width is worth; the paper's network is 1. classes: see `Network`.

    New layers are drawn from a Gaussian of standard deviation 0.01, those of AlexNet as in `nn.Conv2d` until
    `load_pretrained` fills them. Upfeat is bilinear and frozen; its filters are stored between all 16 x 16 channels, as
    Caffe stores them, which makes 57.9 million parameters in all. Raises BadConfig for a width out of range.
    """

    default_recipe: ClassVar[str] = "fcn_alexnet"

    def __init__(self, normalise: bool = False, width: float = 1.0, classes: int = PART_COUNT) -> None:
        super().__init__({"normalise": normalise, "width": width}, classes)
        if normalise not in (True, False) or not 1 / 16 <= width <= 4:
            raise BadConfig(f"normalise must be true or false, width from 1/16 to 4, found {normalise!r} and {width!r}")
        c1, c2, c3, c4, c5, c6 = (2 * round(count * width / 2) for count in (96, 256, 384, 384, 256, 4096))
        self.conv1 = nn.Conv2d(1, c1, 11, stride=4, padding=_PADDING)
        self.conv2 = nn.Conv2d(c1, c2, 5, padding=2, groups=2)
        self.conv3 = nn.Conv2d(c2, c3, 3, padding=1)
        self.conv4 = nn.Conv2d(c3, c4, 3, padding=1, groups=2)
        self.conv5 = nn.Conv2d(c4, c5, 3, padding=1, groups=2)
        self.conv6 = nn.Conv2d(c5, c6, 6)
        self.conv7 = nn.Conv2d(c6, c6, 1)
        self.conv8 = nn.Conv2d(c6, 16, 1)
        self.upfeat = nn.ConvTranspose2d(16, 16, _KERNEL, stride=STRIDE, bias=False)
        self.score = nn.Conv2d(16, self.classes, 1)
        for layer in (self.conv8, self.score):
            nn.init.normal_(layer.weight, std=0.01)
            nn.init.zeros_(layer.get_parameter("bias"))
        self.upfeat.weight = nn.Parameter(bilinear_filters(16, STRIDE), requires_grad=False)
        self._pool = nn.MaxPool2d(3, stride=2, ceil_mode=True)
        self._norm = nn.LocalResponseNorm(5, alpha=1e-4, beta=0.75) if normalise else nn.Identity()
        self._drop = nn.Dropout(0.5)

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        check_range_images(range_m)
        rows, columns = (torch.arange(side, device=range_m.device) for side in range_m.shape[2:])
        return self.scores_at(range_m, rows, columns)

    def scores_at(self, range_m: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Compute scores at some rows and columns; see `Network.scores_at`.

        The last layer computes every pixel by itself, so training, which needs one in sixteen, does without the others.
        """
        check_range_images(range_m)
        x = self._pool(self._norm(self.conv1(range_m * RANGE_SCALE).relu()))
        x = self._pool(self._norm(self.conv2(x).relu()))
        x = self.conv4(self.conv3(x).relu()).relu()
        x = self._pool(self.conv5(x).relu())
        x = self._drop(self.conv6(x).relu())
        x = self._drop(self.conv7(x).relu())
        scores: torch.Tensor = self.score(self._upsampled(self.conv8(x).relu(), rows, columns))
        return scores

    def load_pretrained(self, path: Path) -> None:
        """Fill conv1 to conv7 from the AlexNet in the .onnx file `path`.

        conv1 becomes the mean of its three channels, for a range image has one; fc6 becomes the 6 x 6 convolution and
        fc7 the 1 x 1 convolution that give the same numbers (section 3.5). Raises BadConfig, naming file and layer, or
        for a network of another width, and MissingLibrary without onnx; then the network is as it was.
        """
        arrays = read_alexnet(path)
        if self.conv7.out_channels != SHAPES["fc7"][0]:
            raise BadConfig(f"{path} is for a network of width 1, found width {self.settings['width']}")
        with torch.no_grad():
            for name, (weight, bias) in arrays.items():
                layer = self.get_submodule(_LAYER.get(name, name))
                kept = weight.mean(axis=1, keepdims=True, dtype=np.float64) if name == "conv1" else weight
                target = layer.get_parameter("weight")
                target.copy_(torch.from_numpy(kept.astype(np.float32)).reshape(target.shape))
                layer.get_parameter("bias").copy_(torch.from_numpy(bias.astype(np.float32)))

    def _upsampled(self, x: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Output of upfeat for x at some rows and columns of the image, [B, 16, h, w].

        Upfeat is frozen, the same for all channels, and a product of a filter down and one across: so two small
        matrices replace it, and gradients need not pass through 256 filters of 63 x 63.
        """
        filter_down = self.upfeat.weight[0, 0, :, STRIDE - 1]
        down, across = (
            F.conv_transpose1d(torch.eye(count).to(filter_down)[:, None], filter_down[None, None], stride=STRIDE)[:, 0]
            for count in x.shape[2:]
        )
        return down[:, _CROP + rows].transpose(0, 1) @ x @ across[:, _CROP + columns]


def bilinear_filters(channels: int, stride: int) -> torch.Tensor:
    """Transposed-convolution filters that interpolate between pixels `stride` apart, each channel by itself.

    float32 [channels, channels, 2 * stride - 1, 2 * stride - 1].
    """
    slope = 1 - (torch.arange(2 * stride - 1) - (stride - 1)).abs() / stride
    filters = torch.zeros(channels, channels, len(slope), len(slope))
    filters[range(channels), range(channels)] = slope[:, None] * slope
    return filters


def read_alexnet(path: Path) -> Arrays:
    """Weight and bias of each layer in `SHAPES`, float32. Raises BadConfig, naming file and layer, MissingLibrary."""
    if path.suffix != ".onnx":
        raise BadConfig(f"AlexNet's weights come as .onnx, found {path}")
    onnx, numbers = (required(module, "reading AlexNet's weights", "onnx") for module in ("onnx", "onnx.numpy_helper"))
    data = read_bytes(path)
    found: dict[str, NDArray[np.float32]] = {}
    with reported(f"{path} is not a whole .onnx file", BadConfig, Exception):  # of protobuf, onnx and NumPy
        for tensor in onnx.load_from_string(data).graph.initializer:
            match = _TENSOR.fullmatch(tensor.name)
            if match and tensor.data_type == onnx.TensorProto.FLOAT and not tensor.external_data:
                found[f"{match[1]}.{'weight' if match[2] == 'w' else 'bias'}"] = numbers.to_array(tensor)
    arrays: Arrays = {}
    for name, shape in SHAPES.items():
        pair = []
        for kind, expected in (("weight", shape), ("bias", shape[:1])):
            array = found.get(f"{name}.{kind}")
            if array is None:
                raise BadConfig(f"{path} has no {kind} of AlexNet's layer {name}")
            if array.shape != expected:
                raise BadConfig(f"{path}: the {kind} of {name} must be {expected}, found {array.shape}")
            if not np.isfinite(array).all():
                raise BadConfig(f"{path}: the {kind} of {name} must be finite")
            pair.append(array)
        arrays[name] = pair[0], pair[1]
    return arrays
