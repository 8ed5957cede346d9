"""The paper's network: AlexNet made fully convolutional (section 3.4, Fig. 4; Long, Shelhamer and Darrell, CVPR 2015).

Widths, groups and rounding are those of the AlexNet that was published with Caffe, whose weights the paper starts from:
conv2, conv4 and conv5 have two groups, and pooling counts a last window that is not full.

Fig. 4 leaves two things open. It gives upfeat a stride of 16, but the strides before it multiply to 4 * 2 * 2 * 2 = 32
and a bilinear kernel of 63 = 2 * 32 - 1 belongs to 32: upfeat has a stride of 32 here. And it does not state the
padding: as in Caffe's FCN-AlexNet, conv1 is padded by 100, so that images of any size get scores, which are cropped.

Training may start from AlexNet's published weights, in a file that the user has: `import_alexnet` reads
`bvlc_alexnet.caffemodel` (either of Caffe's layer formats) or `bvlcalexnet-12.onnx` of the ONNX model zoo. Both are
Protocol Buffers, of which a few fields are read; nothing in the file is run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import ClassVar, Final

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from numpy.typing import NDArray
from torch import nn

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PART_COUNT
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
Field = tuple[int, int | memoryview]

STRIDE: Final = 32
_PADDING: Final = 100
_KERNEL: Final = 2 * STRIDE - 1

# Pixel m of conv7 sees the image around 32 m + 13: in the image's pixels, conv1 puts it at 4 m + 5 - 100, each of the
# three poolings doubles it and adds one of its own pixels, conv6 adds two and a half. Upfeat puts it at 32 m + 31.
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
        if not 1 / 16 <= width <= 4:
            raise BadConfig(f"width must be from 1/16 to 4, found {width!r}")
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
        """Compute scores of every pixel; see `Network.scores`."""
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
        """Fill conv1 to conv7 from a file of AlexNet's weights; see `import_alexnet`. Raises BadConfig."""
        import_alexnet(self, path)

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


def import_alexnet(network: nn.Module, path: Path) -> None:
    """Fill conv1 to conv7 of `network`, a `FcnAlexnet`, from the AlexNet in the file `path` (.onnx or .caffemodel).

    conv1 becomes the mean of its three channels, for a range image has one; fc6 becomes the 6 x 6 convolution and fc7
    the 1 x 1 convolution that give the same numbers (section 3.5). Raises BadConfig, naming file and layer; then the
    network is as it was.
    """
    arrays = read_alexnet(path)
    with torch.no_grad():
        for name, (weight, bias) in arrays.items():
            layer = network.get_submodule(_LAYER.get(name, name))
            kept = weight.mean(axis=1, keepdims=True, dtype=np.float64) if name == "conv1" else weight
            target = layer.get_parameter("weight")
            target.copy_(torch.from_numpy(kept.astype(np.float32)).reshape(target.shape))
            layer.get_parameter("bias").copy_(torch.from_numpy(bias.astype(np.float32)))


def read_alexnet(path: Path) -> Arrays:
    """Weight and bias of each layer in `SHAPES`, float32. Raises BadConfig, naming file and layer."""
    readers = {".onnx": _onnx_tensors, ".caffemodel": _caffe_tensors}
    if path.suffix not in readers:
        raise BadConfig(f"AlexNet's weights come as .onnx or .caffemodel, found {path}")
    try:
        found = dict(readers[path.suffix](memoryview(read_bytes(path))))
    except _NotProtobufError as error:
        raise BadConfig(f"{path} is not a whole {path.suffix} file: {error}") from error
    arrays: Arrays = {}
    for name, shape in SHAPES.items():
        pair = []
        for kind, expected in (("weight", shape), ("bias", shape[:1])):
            array = found.get(f"{name}.{kind}")
            if array is None:
                raise BadConfig(f"{path} has no {kind} of AlexNet's layer {name}")
            # Caffe's old files fill shapes up with ones: (1, 1, 4096, 9216).
            if array.size != prod(expected) or [n for n in array.shape if n != 1] != [n for n in expected if n != 1]:
                raise BadConfig(f"{path}: the {kind} of {name} must be {expected}, found {array.shape}")
            if not np.isfinite(array).all():
                raise BadConfig(f"{path}: the {kind} of {name} must be finite")
            pair.append(array.reshape(expected))
        arrays[name] = pair[0], pair[1]
    return arrays


class _NotProtobufError(ValueError):
    """Bytes that are not Protocol Buffers."""


def _onnx_tensors(data: memoryview) -> Iterator[tuple[str, NDArray[np.float32]]]:
    """The initialisers of a model: ModelProto.graph = 7, GraphProto.initializer = 5, both of ONNX's onnx.proto."""
    for graph in _inside(data, 7):
        for tensor in _inside(graph, 5):
            shape: list[int] = []
            kind, name, values = 0, "", np.empty(0, np.float32)
            for number, value in _fields(tensor):
                if number == 1:  # dims
                    shape.extend(_whole_numbers(value))
                elif number == 2 and isinstance(value, int):  # data_type
                    kind = value
                elif number == 8 and isinstance(value, memoryview):  # name
                    name = bytes(value).decode(errors="replace")
                elif number in (4, 9) and isinstance(value, memoryview):  # float_data, raw_data
                    values = _floats(value)
            match = re.fullmatch(r"(conv[1-5]|fc[67])_([wb])(?:_0)?", name)
            if match and kind == 1 and prod(shape) == values.size:  # kind 1: 32-bit floats
                yield f"{match[1]}.{'weight' if match[2] == 'w' else 'bias'}", values.reshape(shape)


def _caffe_tensors(data: memoryview) -> Iterator[tuple[str, NDArray[np.float32]]]:
    """The blobs of a network, from caffe.proto: NetParameter.layer = 100 (name 1, blobs 7), or in files of before 2015
    NetParameter.layers = 2 (name 4, blobs 6).
    """
    for layers, name_field, blobs_field in ((100, 1, 7), (2, 4, 6)):
        for layer in _inside(data, layers):
            names = [bytes(name).decode(errors="replace") for name in _inside(layer, name_field)]
            if len(names) != 1 or names[0] not in SHAPES:
                continue
            for kind, blob in zip(("weight", "bias"), _inside(layer, blobs_field), strict=False):
                yield f"{names[0]}.{kind}", _blob(blob)


def _blob(data: memoryview) -> NDArray[np.float32]:
    """BlobProto: data = 5; shape = 7 with dim = 1, or the old num, channels, height, width = 1 to 4."""
    values = np.empty(0, np.float32)
    old, shape = {1: 1, 2: 1, 3: 1, 4: 1}, []
    for number, value in _fields(data):
        if number == 5 and isinstance(value, memoryview):
            values = _floats(value)
        elif number == 7 and isinstance(value, memoryview):
            shape = [size for field, sizes in _fields(value) if field == 1 for size in _whole_numbers(sizes)]
        elif number in old and isinstance(value, int):
            old[number] = value
    shape = shape or list(old.values())
    if prod(shape) != values.size:
        raise _NotProtobufError(f"a blob of shape {shape} holds {values.size} numbers")
    return values.reshape(shape)


def _inside(message: memoryview, number: int) -> list[memoryview]:
    """The messages or texts in field `number` of a message."""
    return [value for field, value in _fields(message) if field == number and isinstance(value, memoryview)]


def _fields(message: memoryview) -> Iterator[Field]:
    """Fields of a message (protobuf.dev, "Encoding"): number, and an int or the bytes inside.

    Raises _NotProtobufError.
    """
    offset = 0
    while offset < len(message):
        tag, offset = _varint(message, offset)
        number, wire = tag >> 3, tag & 7
        if wire == 0:
            value, offset = _varint(message, offset)
            yield number, value
            continue
        if wire not in (1, 2, 5) or not number:
            raise _NotProtobufError(f"a field of wire type {wire} at byte {offset}")
        size, offset = _varint(message, offset) if wire == 2 else (8 if wire == 1 else 4, offset)
        if size > len(message) - offset:
            raise _NotProtobufError(f"a field of {size} bytes, {len(message) - offset} are left")
        yield number, message[offset : offset + size]
        offset += size


def _varint(message: memoryview, offset: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if offset >= len(message):
            raise _NotProtobufError("it ends within a number")
        byte = message[offset]
        offset += 1
        value |= (byte & 0x7F) << shift
        if not byte & 0x80:
            return value, offset
    raise _NotProtobufError(f"a number of more than 10 bytes before byte {offset}")


def _whole_numbers(value: int | memoryview) -> list[int]:
    """Values of a repeated whole number: one a field, or packed."""
    if isinstance(value, int):
        return [value]
    numbers, offset = [], 0
    while offset < len(value):
        number, offset = _varint(value, offset)
        numbers.append(number)
    return numbers


def _floats(value: memoryview) -> NDArray[np.float32]:
    if len(value) % 4:
        raise _NotProtobufError(f"32-bit numbers in {len(value)} bytes")
    return np.frombuffer(value, "<f4")
