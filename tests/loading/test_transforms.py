"""Transforms in the workers: what they get, what they may return, their draws, their names in states."""

from __future__ import annotations

import json
import re
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from folders import ROOT
from torch.utils.data import DataLoader

from bodyseg_data import Batch, RangeImages, loader
from bodyseg_data.artifacts import VARIANTS
from bodyseg_data.core import BadConfig, BadSample, BadShard
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, load_label_map
from bodyseg_data.loading import BadTransform, BodyCrop, CameraImage, Crop, Flip, Roll, Transform, Zoom

FORKED: dict[str, Any] = {"num_workers": 1, "worker_method": "process", "start_method": "fork"}
ALL = (Zoom(1.2), Roll(10), Flip(), Crop(400, 200, "anywhere"))


@dataclass(frozen=True)
class Constant(Transform):
    """Writes a drawn number into every measured pixel."""

    name = "constant"
    most: int = 60_000

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        image.range[image.range > 0] = random.integers(1, self.most)
        return image


def nearer(image: CameraImage, random: np.random.Generator) -> CameraImage:
    """Lose what lies farther than 2.2 m, and leave the labels to the caller."""
    image.range[image.metres > 2.2] = 0
    return image


def mirrored(image: CameraImage, random: np.random.Generator) -> CameraImage:
    """Return views of the arrays that no tensor can be made of."""
    return replace(image, range=image.range[:, ::-1], labels=image.labels[:, ::-1])


def failing(image: CameraImage, random: np.random.Generator) -> CameraImage:
    raise ValueError("two\nlines")


def refusing(image: CameraImage, random: np.random.Generator) -> CameraImage:
    if image.info.azimuth_deg == 80:
        raise BadSample("it is seen from the side")
    return image


def bits(batches: Any) -> list[tuple[tuple[str, ...], bytes, bytes]]:
    return [(tuple(b["key"]), b["range"].numpy().tobytes(), b["labels"].numpy().tobytes()) for b in batches]


def test_bits_depend_on_no_worker(figures_set: Path) -> None:
    images = RangeImages(figures_set, "all", transform=ALL)
    assert images.shape == (400, 200)
    alone = bits(loader(images, 5))
    assert alone == bits(loader(images, 5, 2))
    assert alone == bits(loader(images, 5, 2, worker_method="process"))
    assert alone == bits(DataLoader(images, 5))
    assert alone == bits(DataLoader(images, 5, num_workers=2))
    one = images[3]
    assert one["range"].shape == (1, 400, 200)
    images.set_epoch(1)
    assert not torch.equal(one["range"], images[3]["range"]), "every epoch has draws of its own"


def test_a_function_of_the_program_draws_alike_in_processes_that_are_not_forked(
    figures_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drawn(image: CameraImage, random: np.random.Generator) -> CameraImage:
        return Constant()(image, random)

    found = []
    for module in ("__main__", "__mp_main__"):  # as the program and a process that it spawns call the same one
        monkeypatch.setattr(drawn, "__module__", module)
        found.append(bits(loader(RangeImages(figures_set, transform=drawn), 5)))
    assert found[0] == found[1]


def test_variants_of_a_sample_share_their_draws(figures_set: Path) -> None:
    seen = {name: RangeImages(figures_set, name, transform=ALL).image(2) for name in VARIANTS}
    for other in ("noise", "occ", "md", "all"):
        kept = seen[other].range > 0
        assert kept.any() and np.array_equal(seen[other].labels[kept], seen["none"].labels[kept])
    both = (seen["occ"].range > 0) & (seen["md"].range > 0)
    assert np.array_equal(both, seen["all"].range > 0)
    assert np.array_equal(seen["all"].range[both], seen["noise"].range[both])


def test_a_transform_receives_the_camera_and_the_origin(figures_set: Path) -> None:
    received: list[CameraImage] = []

    def look(image: CameraImage, random: np.random.Generator) -> CameraImage:
        received.append(image)
        return image

    images = RangeImages(figures_set, "none", transform=look)
    images[4]
    (image,), camera = received, images.manifest.rig.camera
    assert (image.focal_px, image.centre_px, image.step_m) == (camera.focal_px, camera.centre_px, images.step_m)
    assert image.info == images.clean(4).info and image.key == images.keys[4]
    assert torch.equal(torch.from_numpy(image.metres[None]), images[4]["range"])


def test_lost_pixels_become_background(figures_set: Path) -> None:
    images = RangeImages(figures_set, "none", transform=nearer)
    before, found = RangeImages(figures_set, "none").image(0), images.image(0)
    kept = (before.range > 0) & (before.range * np.float32(images.step_m) <= 2.2)
    assert 0 < np.count_nonzero(kept) < np.count_nonzero(before.range)
    assert np.array_equal(found.range > 0, kept) and np.array_equal(found.labels != BACKGROUND, kept)


def test_arrays_of_any_strides_may_be_returned(figures_set: Path) -> None:
    found, before = (RangeImages(figures_set, transform=each)[0] for each in (mirrored, ()))
    assert torch.equal(found["range"], before["range"].flip(-1)) and found["range"].is_contiguous()


def test_parts_are_mirrored_before_they_are_joined(figures_set: Path) -> None:
    labels = load_label_map("limbs14")
    parts = RangeImages(figures_set).image(1).labels
    found = RangeImages(figures_set, transform=Flip(1.0), labels=labels).image(1).labels
    assert np.array_equal(found, labels.table[PART_CLASSES.mirrored[parts[:, ::-1]]])
    assert np.array_equal(found, labels.mirrored[labels.table[parts[:, ::-1]]])


def test_transforms_of_one_name_draw_apart(figures_set: Path) -> None:
    once = RangeImages(figures_set, "none", transform=Constant()).image(0).range.max()
    twice = RangeImages(figures_set, "none", transform=(Constant(), Constant())).image(0).range.max()
    assert once != twice


def test_names_versions_and_parameters_are_in_the_identity(figures_set: Path) -> None:
    images = RangeImages(figures_set, transform=[Crop(400, 200), nearer, Constant(7)])
    assert images.identity()["transforms"] == [
        {"name": "crop", "version": 2, "rows": 400, "columns": 200, "at": "axis"},
        {"name": f"{__name__}.nearer", "version": 1},
        {"name": "constant", "version": 1, "most": 7},
    ]
    assert "transforms" not in RangeImages(figures_set).identity()


def test_a_state_of_other_transforms_is_refused(figures_set: Path) -> None:
    def batches(*transforms: Any) -> Any:
        return loader(RangeImages(figures_set, transform=transforms), 4)

    state = json.loads(json.dumps(batches(Flip(), BodyCrop(64, 32, 0.2)).state_dict()))
    batches(Flip(), BodyCrop(64, 32, 0.2)).load_state_dict(state)
    for others in ((), (Flip(0.4), BodyCrop(64, 32, 0.2)), (BodyCrop(64, 32, 0.2), Flip())):
        with pytest.raises(BadConfig, match=r"^the state belongs to another run: transforms( |\[)"):
            batches(*others).load_state_dict(state)


RETURNS: list[tuple[Callable[[CameraImage], Any], str]] = [
    (lambda image: None, "must return a CameraImage, found NoneType"),
    (lambda image: replace(image, key="other"), "must keep the key, found 'other'"),
    (lambda image: replace(image, range=image.range // 2, step_m=0.002), "must keep the step_m, found 0.002"),
    (
        lambda image: replace(image, range=image.metres),
        "must return range as uint16 (160, 82), found float32 (160, 82)",
    ),
    (
        lambda image: replace(image, labels=image.labels[1:]),
        "must return labels as uint8 (160, 82), found uint8 (159, 82)",
    ),
    (
        lambda image: replace(image, range=torch.zeros(160, 82)),
        "must return range as uint16 (160, 82), found Tensor",
    ),
    (
        lambda image: replace(image, range=np.ma.masked_greater(image.range, 10)),
        "must return range as uint16 (160, 82), found MaskedArray",
    ),
    (
        lambda image: replace(image, labels=np.full_like(image.labels, 33)),
        "must return labels 0 to 32 or 255, found 33",
    ),
    (
        lambda image: replace(image, labels=np.full_like(image.labels, 254)),
        "must return labels 0 to 32 or 255, found 254",
    ),
]


@pytest.mark.parametrize(("alter", "message"), RETURNS)
def test_what_is_no_sample_is_refused_in_one_line(
    figures_set: Path, alter: Callable[[CameraImage], Any], message: str
) -> None:
    def wrong(image: CameraImage, random: np.random.Generator) -> Any:
        return alter(image)

    images = RangeImages(figures_set, transform=wrong)
    name = f"{__name__}.test_what_is_no_sample_is_refused_in_one_line.<locals>.wrong"
    for access in (lambda: images[0], lambda: next(iter(loader(images, 4)))):
        with pytest.raises(BadTransform) as caught:
            access()
        assert str(caught.value) == f"{images.location(0)[0]}: {images.keys[0]}: transform {name!r} {message}"


@pytest.mark.parametrize("options", [{}, {"num_workers": 2}, FORKED])
@pytest.mark.parametrize("on_error", [{}, {"on_error": "skip", "skip_budget": 24}])
def test_an_error_in_a_transform_ends_the_run_in_one_line(
    figures_set: Path, options: dict[str, Any], on_error: dict[str, Any]
) -> None:
    images = RangeImages(figures_set, transform=failing)
    with pytest.raises(BadTransform) as caught:
        list(loader(images, 4, **options, **on_error))
    where = f"{images.location(0)[0]}: {images.keys[0]}: transform '{__name__}.failing'"
    assert str(caught.value) == f"{where}: ValueError: two lines"
    assert 'raise ValueError("two\\nlines")' in "".join(caught.value.__notes__), "the traceback is kept"


def test_an_error_without_words_in_a_transform_keeps_its_place(figures_set: Path) -> None:
    class Wordless(Exception):
        def __str__(self) -> str:
            raise AttributeError("no text")

    def wordless(image: CameraImage, random: np.random.Generator) -> Any:
        raise Wordless

    images = RangeImages(figures_set, transform=wordless)
    for options in ({}, {"num_workers": 1}):
        with pytest.raises(BadTransform, match=rf"{images.keys[0]}: transform '.*wordless': Wordless\b"):
            list(loader(images, 4, **options))


def test_samples_that_a_transform_refuses_can_be_skipped(figures_set: Path) -> None:
    images = RangeImages(figures_set, transform=refusing)
    batches = loader(images, 4, on_error="skip", skip_budget=24)
    delivered: list[Batch] = list(batches)
    wanted = [key for key in images.keys if not key.endswith("-a080")]
    assert [key for batch in delivered for key in batch["key"]] == wanted and len(wanted) == 18
    assert len(batches.skipped) == 6
    why = f"{batches.skipped[0].key}: transform '{__name__}.refusing': it is seen from the side"
    assert batches.skipped[0].why.endswith(why)
    with pytest.raises(BadShard, match="it is seen from the side"):
        images[images.keys.index(batches.skipped[0].key)]


def nearer_than(most_m: float) -> Callable[[CameraImage, np.random.Generator], CameraImage]:
    """A function whose identity would not tell its limit."""

    def near(image: CameraImage, random: np.random.Generator) -> CameraImage:
        image.range[image.metres > most_m] = 0
        return image

    return near


@dataclass
class Thawed(Transform):
    name = "thawed"


class Plain:
    name = "plain"

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        return image


@dataclass(frozen=True)
class Table(Transform):
    name = "table"
    rows: Any


@dataclass(frozen=True)
class Flat(Transform):
    name = "flat"

    def shape(self, rows: int, columns: int) -> tuple[int, int]:
        return 0, columns


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda image, random: image, "a transform must have a name: use a function of a module, found "),
        ("flip", "a transform must be a function, or a dataclass derived from Transform, found 'f'"),
        (Flip, "a transform must be a function, or a dataclass derived from Transform, found <class"),
        (partial(nearer), "a transform must be a function, or a dataclass derived from Transform, found functools"),
        (nearer_than(2.5), "a transform with parameters must be a class, found the function .*nearer_than"),
        (Thawed(), "a transform must be a frozen dataclass, found Thawed"),
        (Plain(), "a transform must be a frozen dataclass, found Plain"),
        (Table(np.zeros(3)), "transform 'table': a parameter must be plain JSON: Object of type ndarray"),
        (Table(float("nan")), "transform 'table': a parameter must be plain JSON: Out of range float values"),
        (Flat(), r"transform 'flat': 'shape' must give two whole numbers above 0, found \(0, 82\)"),
    ],
)
def test_what_is_no_transform_is_refused(figures_set: Path, given: Any, message: str) -> None:
    with pytest.raises(BadConfig, match=f"^{message}"):
        RangeImages(figures_set, transform=given)


def test_a_function_may_name_what_its_function_defines_later(figures_set: Path) -> None:
    def same(image: CameraImage, random: np.random.Generator) -> CameraImage:
        return later(image)

    images = RangeImages(figures_set, transform=same)

    def later(image: CameraImage) -> CameraImage:
        return image

    assert images.image(0).range.any()


def test_the_examples_of_the_documentation_run(figures_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "docs" / "how-to" / "transforms.md").read_text().replace('"shards"', repr(str(figures_set)))
    use, function, whole_class = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    module = types.ModuleType("examples")
    monkeypatch.setitem(sys.modules, "examples", module)  # dataclasses look their module up
    for example in (use, function, whole_class):
        exec(compile("from __future__ import annotations\n" + example, "transforms.md", "exec"), module.__dict__)
        if example is use:
            assert module.images.shape == (512, 256) and next(iter(module.batches))["range"].shape[2:] == (512, 256)
        if example is function:
            assert len({float(module.images[index]["range"].max()) for index in range(6)}) == 6
    smaller = RangeImages(figures_set, "none", transform=module.EveryOther()).image(0)
    assert np.array_equal(smaller.range, RangeImages(figures_set, "none").image(0).range[::2, ::2])
