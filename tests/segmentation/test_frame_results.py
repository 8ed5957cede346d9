"""Writing beside computing, and the pictures that are written."""

from __future__ import annotations

import io
import threading
import zlib
from typing import Any

import numpy as np
import pytest
from isal import isal_zlib
from PIL import Image

from bodyseg_data.core import BadConfig
from bodyseg_data.machine import libraries as deflate
from bodyseg_model.segmentation.output_folder import WriteBehind
from bodyseg_model.segmentation.pictures import encode_picture


def fails(message: str) -> None:
    raise BadConfig(message)


def test_jobs_are_done_in_order_in_another_thread() -> None:
    done: list[tuple[int, bool]] = []
    with WriteBehind() as behind:
        for number in range(9):
            behind.then(
                lambda number=number: done.append((number, threading.current_thread() is threading.main_thread()))
            )
    assert done == [(number, False) for number in range(9)]


def test_an_error_ends_the_jobs_and_is_raised_by_the_next_call() -> None:
    done: list[int] = []
    reached = threading.Event()
    with pytest.raises(BadConfig, match="^disk full$"), WriteBehind() as behind:
        behind.then(lambda: fails("disk full"))
        behind.then(reached.set)  # dropped
        behind.then(lambda: done.append(1))
    assert not done and not reached.is_set()
    with WriteBehind() as behind:
        behind.then(reached.set)
        assert reached.wait(10)
    with pytest.raises(BadConfig, match="^disk full$"), WriteBehind() as behind:
        for _ in range(10_000):
            behind.then(lambda: fails("disk full"))
        pytest.fail("ten thousand jobs were taken after one had failed")


@pytest.mark.parametrize("kind", [KeyboardInterrupt, BadConfig])
def test_an_interruption_or_a_bad_frame_leaves_the_jobs_before_it_done(kind: type[BaseException]) -> None:
    done: list[int] = []
    with pytest.raises(kind), WriteBehind() as behind:
        for number in range(3):
            behind.then(lambda number=number: done.append(number))
        raise kind
    assert done == [0, 1, 2]
    # Of two errors the first counts, the one of an earlier frame's files; an interruption comes before both.
    with (
        pytest.raises(KeyboardInterrupt if kind is KeyboardInterrupt else BadConfig) as raised,
        WriteBehind() as behind,
    ):
        behind.then(lambda: fails("disk full"))
        raise kind("a later frame")
    assert str(raised.value) == ("a later frame" if kind is KeyboardInterrupt else "disk full")


@pytest.mark.parametrize(
    "image",
    [
        np.arange(60, dtype=np.uint8).reshape(6, 10),
        np.arange(60, dtype=np.uint16).reshape(6, 10) * 1000,
        np.arange(180, dtype=np.uint8).reshape(6, 10, 3),
        np.asfortranarray(np.arange(60, dtype=np.uint8).reshape(6, 10)),
        np.zeros((1, 1), np.uint8),
    ],
    ids=["labels", "frame", "overlay", "columns first", "one pixel"],
)
@pytest.mark.parametrize("library", ["isal", "zlib"])
def test_pictures_are_read_as_they_were(image: Any, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if library == "zlib":
        monkeypatch.setattr(deflate, "deflate_library", lambda: zlib)
    else:
        assert deflate.deflate_library() is isal_zlib, "isal is there in tests"
    with Image.open(io.BytesIO(encode_picture(image))) as picture:
        picture.verify()  # checksums, too
    with Image.open(io.BytesIO(encode_picture(image))) as picture:
        assert picture.mode == {1: "L", 2: "I;16"}[image.dtype.itemsize] if image.ndim == 2 else "RGB"
        np.testing.assert_array_equal(np.asarray(picture), image)
