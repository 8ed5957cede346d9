"""The check of arrays while tests run sees a wrong type, a wrong shape and lengths that disagree."""

from __future__ import annotations

import types
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from checked_arrays import BrokenPromise, Promise, check_module, checked, promises
from numpy.typing import NDArray

from bodyseg_data.artifacts.noise import add_noise
from bodyseg_data.labels import colour_labels
from bodyseg_data.rendering import Surface


def scaled(image: NDArray[np.uint16], lines: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """The lines as often as asked for, float32 [count, W].

    image: uint16 [H, W]. lines: float32 [W].
    """
    return np.repeat(lines[None], count if image.flat[0] else count + 1, axis=0)


IMAGE, LINES = np.ones((2, 3), np.uint16), np.ones(3, np.float32)


def test_promises_are_read_from_docstrings() -> None:
    named, returned = promises(scaled.__doc__)
    assert named == {"image": Promise(("uint16",), ("H", "W")), "lines": Promise(("float32",), ("W",))}
    assert returned == Promise(("float32",), ("count", "W"))
    assert promises("Draw labels: uint8 [H, W] -> sRGB uint8 [H, W, 3].")[1] == Promise(("uint8",), ("H", "W", "3"))
    assert promises("x, y: bool [N]; z: int64 [2 N]")[0] == {name: Promise(("bool",), ("N",)) for name in "xy"}
    assert promises("One, bool [N], of many, uint16 [N].")[1] is None
    assert promises(None) == ({}, None)


def test_what_is_promised_passes() -> None:
    assert checked(scaled, "f")(IMAGE, LINES, 4).shape == (4, 3)
    assert checked(test_what_is_promised_passes, "f") is test_what_is_promised_passes


@pytest.mark.parametrize(
    ("image", "lines", "message"),
    [
        (IMAGE.astype(np.int32), LINES, r"f: image must be uint16 \[H, W\], found int32 \(2, 3\)"),
        (IMAGE[None] + 0, LINES, r"f: image must be uint16 \[H, W\], found uint16 \(1, 2, 3\)"),
        (IMAGE, LINES[:2], r"f: lines must be float32 \[W\], found float32 \(2,\) where count = 4, H = 2, W = 3"),
        (IMAGE, LINES.astype(np.float64), r"f: lines must be float32 \[W\], found float64 \(3,\)"),
        (IMAGE * 0, LINES, r"f returns what must be float32 \[count, W\], found float32 \(5, 3\)"),
    ],
)
def test_a_broken_promise_is_seen(image: NDArray[np.uint16], lines: NDArray[np.float32], message: str) -> None:
    with pytest.raises(BrokenPromise, match=message):
        checked(scaled, "f")(image, lines, 4)


def test_fields_of_dataclasses_and_methods_are_checked() -> None:
    """Only of objects that the project makes: `make` stands for a function of it."""

    @dataclass(frozen=True)
    class Seen:
        """labels: uint8 [H, W]."""

        labels: Any

        def doubled(self) -> Any:
            """Twice the labels, uint8 [H, W]."""
            return np.zeros((1, 1), np.uint16)

    module = types.ModuleType(Seen.__module__)
    module.__dict__["Seen"] = Seen
    check_module(module)
    project: dict[str, Any] = {"Seen": Seen, "replace": replace, "__name__": "bodyseg_data.made_up"}
    exec("make = lambda labels: Seen(labels)\nchange = lambda seen, labels: replace(seen, labels=labels)", project)
    good, wrong = torch.zeros(2, 3, dtype=torch.uint8), torch.zeros(1, dtype=torch.int64)
    assert project["make"](None).labels is None and project["make"](good).labels is good
    assert Seen(wrong).labels is wrong
    for made in (lambda: project["make"](wrong), lambda: project["change"](Seen(good), wrong)):
        with pytest.raises(BrokenPromise, match=r"Seen: labels must be uint8 \[H, W\], found int64 \(1,\)"):
            made()
    with pytest.raises(BrokenPromise, match=r"Seen\.doubled returns .* uint8 \[H, W\], found uint16"):
        Seen(good).doubled()


def test_the_projects_own_promises_are_checked() -> None:
    """What tests import is checked already."""
    with pytest.raises(BrokenPromise, match=r"colour_labels returns .* \[H, W, 3\], found uint8 \(1, 2, 3, 3\)"):
        colour_labels(np.zeros((1, 2, 3), np.uint8))
    with pytest.raises(BrokenPromise, match=r"add_noise: draws must be uint32 \[N\], found uint64 \(3,\)"):
        add_noise(np.ones(3, np.uint16), np.float32(1), np.ones(3, np.uint64))  # type: ignore[arg-type]
    project: dict[str, Any] = {"Surface": Surface, "__name__": "bodyseg_data.rendering.made_up"}
    exec("def see(range, face): return Surface(range, face)", project)
    ranges = np.zeros((2, 3), np.float32)
    assert project["see"](ranges, np.zeros((2, 3), np.int32)).range is ranges
    for face in (np.zeros((2, 3), np.int64), np.zeros((3, 2), np.int32)):
        with pytest.raises(BrokenPromise, match=rf"Surface: face must be int32 \[H, W\], found {face.dtype}"):
            project["see"](ranges, face)
