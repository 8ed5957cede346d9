"""Damaged files on which libraries of C would print lines of their own: what is wrong is in the message alone."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from kinect_mkv import calibration
from PIL import Image

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings.formats.matroska import depth_camera
from bodyseg_model.recordings.formats.tiff import open_tiff


@pytest.mark.parametrize("packing", ["tiff_lzw", "tiff_adobe_deflate"])
def test_libtiff_prints_nothing(packing: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.tif"
    image = np.arange(60 * 80, dtype=np.uint16).reshape(60, 80) % 1717
    Image.fromarray(image).save(path, compression=packing)
    assert np.array_equal(open_tiff(path, None, None)[0].read(), image)
    data = bytearray(path.read_bytes())
    middle = slice(200, len(data) - 200) if packing == "tiff_lzw" else slice(60, 90)
    data[middle] = b"\xff" * len(data[middle])
    path.write_bytes(data)
    with pytest.raises(BadConfig, match="cannot be read"):
        open_tiff(path, None, None)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("focal", [1e-3, 1e-200])
def test_lapack_prints_nothing(focal: float, capfd: pytest.CaptureFixture[str]) -> None:
    lens = [0.5, 0.5, focal, focal, 1e308, 1e308, -1e308, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert depth_camera(calibration(lens), (576, 640), "x") is None
    assert capfd.readouterr() == ("", "")


def test_threads_that_read_pictures_leave_the_filters_of_warnings_as_they_were(tmp_path: Path) -> None:
    """Filters are the process's: two threads that each put them back in turn left all warnings errors."""
    image = np.full((60, 80), 1717, np.uint16)
    for name in "ab":
        Image.fromarray(image).save(tmp_path / f"{name}.tif")
    (one,), (other,) = (open_tiff(tmp_path / f"{name}.tif", None, None) for name in "ab")
    before = list(warnings.filters)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda frame: frame.read(), [one, other] * 100))
    assert warnings.filters == before and all(np.array_equal(each, image) for each in found)
