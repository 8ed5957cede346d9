"""Images in files as arrays: PNG, TIFF, NPY, NPZ and OpenEXR; and stored numbers as metres along the optical axis."""

import io
import math
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadSample, MissingLibrary
from bodyseg_data.files import refuse_special
from bodyseg_data.machine import opened_picture, required
from bodyseg_data.rigs import Camera

SUFFIXES: Final = (".png", ".tif", ".tiff", ".npy", ".npz", ".exr")
"""Endings of image files that are read."""

MOST_NUMBERS: Final = 1 << 26
"""Numbers of an array beyond which no file is read: 8192 x 8192 pixels."""

NOTHING: Final = 1e9
"""Floats from here on mean that nothing was measured: Blender writes 1e10."""

_SENTINELS: Final = (65504.0, 65535.0)  # the largest number of 16-bit floats, and of 16-bit integers stored as floats
_MOST_STEPS: Final = 65535
_LEAST_M: Final = 0.01
_NEAR_M: Final = 0.3  # a farthest surface nearer than this speaks against a unit that is guessed
_TILE_SIDES: Final = (322, 323)  # tags of TIFF 6.0
_DEPTH: Final = {"Z": "X", "V": "U", "Y": "X", "R": "G"}
"""Names of the channel of a depth image, each with another that must not be beside it: that would make it a vector."""

_UNITS: Final = (("millimetres", 1e-3), ("centimetres", 1e-2))


def read_array(path: Path, palette: bool = False, labels: bool = False) -> NDArray[Any]:
    """Read an image: [H, W], or [H, W, C] for colours and vectors; booleans, integers or floats.

    palette: return the colours of a picture that has a palette; else its numbers of them. labels: of an OpenEXR file
    with depth beside colours, return the colours; else the depth.

    Raises BadSample, naming the file, for one that cannot be read; MissingLibrary for OpenEXR without its package.
    """
    read_exr = partial(_read_exr, labels=labels)
    readers: dict[str, Callable[[Path], NDArray[Any]]] = {".npy": _read_numpy, ".npz": _read_numpy, ".exr": read_exr}
    # Decoders raise almost anything for damaged files.
    with BadSample.named(f"{path}: cannot be read as an image", passes=MissingLibrary):
        refuse_special(path)
        read = readers.get(path.suffix.lower())
        array = _read_picture(path, palette) if read is None else read(path)
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):  # [1, H, W] and [1, 1, H, W], too
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim not in (2, 3) or not array.size or array.dtype.kind not in "buif":
        raise BadSample(f"{path}: an image must be [H, W] or [H, W, C] of numbers, found {array.dtype} {array.shape}")
    return array


def _read_numpy(path: Path) -> NDArray[Any]:
    found = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
    if isinstance(found, np.ndarray):
        return found
    with found:
        if len(found.files) != 1:
            raise ValueError(f"a file holds one array, found {', '.join(found.files) or 'none'}")
        if found.zip.infolist()[0].file_size > MOST_NUMBERS * 8:
            raise ValueError("it holds more than an image can")
        array: NDArray[Any] = found[found.files[0]]
        return array


def _read_picture(path: Path, palette: bool) -> NDArray[Any]:
    from PIL import Image, UnidentifiedImageError

    data = path.read_bytes()
    try:
        with opened_picture(io.BytesIO(data), ("PNG", "TIFF")) as picture:
            tags = getattr(picture, "tag_v2", {})
            if max(math.prod(picture.size), math.prod(int(tags.get(tag, 1)) for tag in _TILE_SIDES)) > MOST_NUMBERS:
                raise ValueError("it has more pixels than an image can")
            deep = picture.mode[:3] == "RGB" and ";16" in str(picture.tile)  # Pillow drops the lower 8 bits
            if deep or picture.mode in ("LA", "CMYK", "YCbCr", "LAB"):
                found = picture.mode + " of 16 bits" * deep
                raise ValueError(f"a picture must be of integers, floats or RGB colours of 8 bits, found mode {found}")
            return np.asarray(picture.convert("RGB") if palette and picture.mode == "P" else picture)
    except (UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ValueError("it is no PNG or TIFF file of a sensible size") from error


def _read_exr(path: Path, labels: bool) -> NDArray[Any]:
    open_exr = required("OpenEXR", "reading OpenEXR files", "renders").File
    with open_exr(str(path), header_only=True) as file:
        for part in file.parts:
            (left, top), (right, bottom) = part.header["dataWindow"]
            if (int(right) - int(left) + 1) * (int(bottom) - int(top) + 1) > MOST_NUMBERS:
                raise ValueError("it has more pixels than an image can")
    with open_exr(str(path), separate_channels=True) as file:
        held = [(f"{part.name()}.{name}", each.pixels) for part in file.parts for name, each in part.channels.items()]
    channels = {name.strip("."): pixels for name, pixels in held}
    layers: dict[str, dict[str, str]] = {}
    for name in channels:
        layer, _, letter = name.rpartition(".")
        layers.setdefault(layer, {})[letter.upper()] = name  # "ViewLayer.Depth.Z" is Z
    depth = [[of[each]] for of in layers.values() for each, beside in _DEPTH.items() if each in of and beside not in of]
    vectors, colours = (
        [[of[each] for each in letters] for of in layers.values() if set(letters) <= of.keys()]
        for letters in ("XYZ", "RGB")
    )
    found = (labels and colours) or depth or vectors or colours
    if len(found) != 1 and len(channels) > 1:
        raise ValueError(f"an image has one channel of depth, or one a colour, found {', '.join(sorted(channels))}")
    stacked = np.stack([channels[name] for name in (found or [list(channels)])[0]], axis=-1)
    return stacked[..., 0] if (stacked == stacked[..., :1]).all() else stacked


@lru_cache(maxsize=8)
def ray_lengths(camera: Camera) -> NDArray[np.float64]:
    """Length of the ray through each pixel's centre to depth 1 along the axis, float64 [rows, columns]."""
    lengths: NDArray[np.float64] = np.linalg.norm(camera.pixel_rays(), axis=2)
    return lengths


def as_metres(
    image: NDArray[Any],
    unit_m: float | None,
    step_m: float,
    where: str,
    lengths: NDArray[np.float64] | None = None,
    no_range: tuple[float, ...] | None = None,
) -> NDArray[np.floating[Any]]:
    """Ranges of an image in metres along the axis, 0 where nothing was measured; float32 of floats, else float64.

    unit_m: metres of the number 1; None: floats are metres, and integers are refused. step_m: of the rig's stored
    ranges. lengths: of the rays, for distances along them (`ray_lengths`). no_range: numbers that mean that nothing was
    measured, besides 0, infinity, NaN, 65535, 65504, and 1e9 and more; (): a largest number of 1 is no background.

    Raises BadSample for numbers that cannot be ranges in that unit.
    """
    if image.ndim != 2:
        raise BadSample(f"{where}: a range image has one channel, found {image.shape[2]}: is it a picture in colours?")
    floats = image.dtype.kind == "f"
    if image.dtype == np.float16:
        raise BadSample(f"{where}: 16-bit floats hold ranges beyond 2 m in steps of 2 mm or more: write 32-bit floats")
    if image.dtype.kind == "b" or image.dtype.itemsize == 1:
        raise BadSample(f"{where}: {image.dtype} holds at most 256 ranges: write 16-bit integers or 32-bit floats")
    if not floats and unit_m is None:
        raise BadSample(f"{where}: an image of integers needs 'unit_m' in set.toml, the metres of one step, like 0.001")
    nothing = image == 0
    if floats:
        nothing |= ~np.isfinite(image) | (image >= NOTHING)
    for number in _SENTINELS if floats else _SENTINELS[1:]:
        nothing |= image == number
    for number in no_range or ():
        nothing |= np.isclose(image, number, rtol=1e-5, atol=0)  # to as many digits as messages show
    numbers: NDArray[np.floating[Any]] = image.astype(np.float32 if floats else np.float64)
    numbers[nothing] = 0
    if numbers.min() < 0:
        raise BadSample(f"{where}: a range must not be negative, as OpenGL's z is, found {numbers.min():.6g}")
    if floats and no_range != () and numbers.max() == 1 and np.count_nonzero(numbers == 1) > image.size / 20:
        raise BadSample(
            f"{where}: the largest number is 1, of {np.count_nonzero(numbers == 1)} pixels: a depth buffer, or depth "
            "scaled to 0..1, holds no metres; of metres, 'no_range' must list 1 if it is the background, else be empty"
        )
    numbers *= 1.0 if unit_m is None else unit_m
    if lengths is not None:
        numbers /= lengths
    _check_unit(float(numbers.max()), step_m, where)
    numbers[numbers < step_m / 2] = 0  # nearer than half a step
    return numbers


def _check_unit(largest_m: float, step_m: float, where: str) -> None:
    """Raise BadSample for a largest range that no steps hold, or that is smaller than any scene's."""
    reach = _MOST_STEPS * step_m
    if largest_m > reach:
        fits = [f"{word} (unit_m = {size:g})" for word, size in _UNITS if _NEAR_M <= largest_m * size <= reach]
        unit = f": these look like {' or '.join(fits)}" if fits else ""
        raise BadSample(
            f"{where}: a range must be at most {reach:.5g} m, {_MOST_STEPS} steps of {1e3 * step_m:g} mm, found "
            f"{largest_m:.6g} m{unit}; if it is metres, a larger range_step_mm of the rig reaches farther"
        )
    if 0 < largest_m < _LEAST_M:
        raise BadSample(f"{where}: the farthest surface is {1e3 * largest_m:.3g} mm away: is 'unit_m' right?")
