"""AlexNet's published weights, read from a file that the user has, for the paper's network.

Reads the AlexNet that was published with Caffe, as `bvlc_alexnet.caffemodel` (either of Caffe's layer formats) or as
`bvlcalexnet-12.onnx` of the ONNX model zoo. Both are Protocol Buffers, of which a few fields are read; nothing in the
file is run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from bodyseg_data.core.errors import BadConfig

_LARGEST_FILE: Final = 1 << 31

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
        size = path.stat().st_size
        if not path.is_file() or not 0 < size <= _LARGEST_FILE:
            raise BadConfig(f"{path} must be a file of 1 to {_LARGEST_FILE} bytes")
        found = dict(readers[path.suffix](memoryview(path.read_bytes())))
    except OSError as error:
        raise BadConfig(f"cannot read {path}: {error.strerror or error}") from error
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
