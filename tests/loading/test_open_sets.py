"""Sets of classes of their own as the loader gives them: planes, several rigs, shadows of what the camera sees."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from open_sets import CELL_CLASSES, CELL_RIGS, PLANES, write_open_set
from torch.utils.data import DataLoader

from bodyseg_data import (
    BodyCrop,
    CameraImage,
    ColumnWriter,
    Crop,
    Flip,
    Mixture,
    RangeImages,
    Roll,
    ShardWriter,
    Zoom,
    loader,
)
from bodyseg_data.artifacts import lit_pixels, seen_by_projectors
from bodyseg_data.core import BadConfig, BadShard
from bodyseg_data.labels import UNLABELLED, LabelMap, classes_of
from bodyseg_data.loading import BadTransform

NAMES = tuple(PLANES)


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cells")
    write_open_set(folder)
    return folder


@pytest.fixture(scope="module")
def dark_cells(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same cells without the projector's range."""
    folder = tmp_path_factory.mktemp("dark")
    write_open_set(folder, projector="none")
    return folder


def test_batches_hold_the_classes_of_the_set(cells: Path) -> None:
    images = RangeImages(cells, "none")
    assert images.label_map.names == CELL_CLASSES.names
    seen = np.unique(np.concatenate([batch["labels"].numpy().ravel() for batch in loader(images, 4)]))
    assert seen[-1] == 255 and seen[-2] < len(CELL_CLASSES)
    assert "planes" not in next(iter(loader(images, 4))) and "planes" not in images[0]


@pytest.mark.parametrize(("workers", "method"), [(0, "thread"), (2, "thread"), (2, "process")])
def test_batches_hold_the_planes_that_are_asked_for(cells: Path, workers: int, method: Any) -> None:
    images = RangeImages(cells, "all", planes=NAMES, split="train")
    plain = RangeImages(cells, "all", split="train")
    batches = loader(images, 4, num_workers=workers, worker_method=method)
    for batch, other in zip(batches, loader(plain, 4), strict=True):
        assert torch.equal(batch["range"], other["range"]) and torch.equal(batch["labels"], other["labels"])
        assert {name: plane.dtype for name, plane in batch["planes"].items()} == {
            "instances": torch.uint16,
            "material": torch.uint8,
        }
        for row, key in enumerate(batch["key"]):
            stored = images.clean(images.keys.index(key)).planes
            for name in NAMES:  # as stored, also where artifacts lose pixels
                assert np.array_equal(batch["planes"][name][row].numpy(), stored[name])


@pytest.mark.parametrize("options", [{"unlabelled": True}, {"planes": NAMES[:1]}, {"planes": NAMES[::-1]}])
def test_a_state_is_of_batches_with_the_same_planes_and_labels(cells: Path, options: dict[str, Any]) -> None:
    (name,) = options
    batches, state = (
        loader(RangeImages(cells, "none", **options), 4),
        loader(RangeImages(cells, "none"), 4).state_dict(),
    )
    batches.load_state_dict(batches.state_dict())
    with pytest.raises(BadConfig, match=f"^the state belongs to another run: {name} None, here "):
        batches.load_state_dict(state)


def test_torchs_own_loader_and_webdataset_give_planes(cells: Path) -> None:
    images = RangeImages(cells, "none", planes="instances", split="train")
    (batch,) = DataLoader(images, batch_size=8, num_workers=1)
    wanted = np.stack([images.clean(index).planes["instances"] for index in range(8)])
    assert np.array_equal(batch["planes"]["instances"].numpy(), wanted)
    webdataset = pytest.importorskip("webdataset")
    items = list(webdataset.WebLoader(images.webdataset(), batch_size=None))
    assert np.array_equal(np.stack([item["planes"]["instances"].numpy() for item in items]), wanted)


@pytest.mark.parametrize(
    "transform", [Roll(40.0), Crop(10, 30), Crop(8, 8, "anywhere"), Crop(8, 8), BodyCrop(24, 20), Zoom(2.0)]
)
def test_transforms_move_planes_with_their_pixels(cells: Path, transform: Any) -> None:
    images = RangeImages(cells, "none", transform=transform, planes=NAMES, unlabelled=True)
    for index in range(4):
        image = images.image(index)
        measured = image.range > 0
        assert np.array_equal(image.planes["material"][measured], image.labels[measured] % 4)
        assert (image.planes["instances"] >= 1000)[measured].all()
        assert not image.planes["instances"][~measured].any()
        for plane in image.planes.values():
            assert plane.shape == images.shape and plane.flags.c_contiguous


def test_a_flipped_image_has_flipped_planes_and_exchanged_fingers(cells: Path) -> None:
    plain, flipped = (RangeImages(cells, "none", transform=each, planes=NAMES) for each in ((), Flip(1.0)))
    opposite = CELL_CLASSES.mirrored
    assert opposite[7] == 8 and opposite[0] == 0
    for index in range(len(plain)):
        before, after = plain.image(index), flipped.image(index)
        assert np.array_equal(after.labels, opposite[before.labels[:, ::-1]])
        assert np.array_equal(after.planes["instances"], before.planes["instances"][:, ::-1])


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_an_own_plane_called_template_is_no_map_of_the_body(cells: Path, tmp_path: Path, kind: str) -> None:
    folder = Path(shutil.copytree(cells, tmp_path / "cells"))
    with ColumnWriter(folder, "template", kind) as column:
        for index, key in enumerate(RangeImages(folder, "none").keys):
            column.write(key, np.arange(index, index + 320).reshape(16, 20) % 256)
    plain, flipped, cut = (
        RangeImages(folder, "none", transform=each, planes=("template",)) for each in ((), Flip(1.0), Crop(18, 22))
    )
    before = plain.image(0).planes["template"]
    assert np.array_equal(flipped.image(0).planes["template"], before[:, ::-1])
    assert np.array_equal(cut.image(0).planes["template"], np.pad(before, 1))


def halved(image: CameraImage, random: np.random.Generator) -> CameraImage:
    """A transform that forgets a plane."""
    return CameraImage(**{**vars(image), "planes": {}})


def listed(image: CameraImage, random: np.random.Generator) -> CameraImage:
    """A transform that makes a list of a plane."""
    return replace(image, planes={name: plane.tolist() for name, plane in image.planes.items()})


def test_a_transform_that_loses_a_plane_is_named(cells: Path) -> None:
    images = RangeImages(cells, "none", transform=halved, planes=NAMES)
    with pytest.raises(BadTransform, match=r"halved' must return the planes instances, material, found $"):
        images.image(0)
    images = RangeImages(cells, "none", transform=listed, planes=NAMES)
    with pytest.raises(BadTransform, match=r"listed' must return the plane 'instances' as uint16 .*, found list$"):
        images.image(0)


def test_planes_that_a_set_does_not_hold_are_refused(cells: Path, tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match=r"^planes: the set holds instances, material, found 'depth'$"):
        RangeImages(cells, "none", planes=("depth",))
    write_open_set(tmp_path, 2, 0, planes=False)
    with pytest.raises(BadConfig, match=r"^planes: the set holds no planes, found 'instances'$"):
        RangeImages(tmp_path, "none", planes=("instances",))


def test_each_sample_is_seen_by_its_own_rig(cells: Path) -> None:
    images = RangeImages(cells, "occ")
    assert "rig='2 rigs'" in repr(images)
    for index in range(len(images)):
        clean = images.clean(index)
        rig = CELL_RIGS[clean.info.rig]
        assert images.augmentation_of(clean).rig == rig
        assert np.array_equal(images.image(index).range > 0, lit_pixels(rig, clean))
    seen: list[float] = []

    focals = RangeImages(cells, "none", transform=Crop(8, 8))
    for index in range(2):
        made = focals.image(index)
        assert isinstance(made, CameraImage)
        seen.append(made.focal_px)
    assert seen == [18.0, 24.0]


def test_a_rig_that_the_set_does_not_have_is_a_fault_of_the_sample(
    cells: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = RangeImages(cells, "none")
    monkeypatch.setattr("bodyseg_data.shards.manifest.RIG_FIELD", "lamps_of_another_set")
    with pytest.raises(BadShard, match="scene-000: 'lamps_of_another_set' must be 0 to 1, found None"):
        images.image(0)


def test_a_set_without_projector_gives_shadows_only_when_asked(cells: Path, dark_cells: Path) -> None:
    for variant in ("occ", "all"):
        with pytest.raises(BadConfig, match="holds no projector range, .* or occluder='camera', which makes"):
            RangeImages(dark_cells, variant)
    with pytest.raises(BadConfig, match=r"^occluder must be one of stored, camera, found 'sun'$"):
        RangeImages(dark_cells, "none", occluder="sun")  # type: ignore[arg-type]
    assert RangeImages(dark_cells, "none").clean(0).projector_range is None
    made, rendered = RangeImages(dark_cells, "occ", occluder="camera"), RangeImages(cells, "occ")
    assert "occluder='camera'" in repr(made) and made.identity()["occluder"] == "camera"
    assert "occluder" not in rendered.identity()
    lost = different = 0
    for index in range(len(made)):
        ours, theirs = made.image(index).range > 0, rendered.image(index).range > 0
        lost += int((rendered.clean(index).range > 0).sum() - theirs.sum())
        different += int((ours != theirs).sum())
    assert lost > 100 and different < 0.15 * lost
    clean = made.clean(1)
    assert np.array_equal(clean.occluder_range(), seen_by_projectors(clean.range, CELL_RIGS[1]))
    for batch in loader(RangeImages(dark_cells, "all", occluder="camera"), 4, num_workers=2):
        assert batch["range"].any()


def test_sets_of_other_classes_mix_by_label_maps_alone(cells: Path, tmp_path: Path) -> None:
    write_open_set(tmp_path, 4, 0, classes=classes_of(["ground", "metal", "else"], "coarse"))
    other = RangeImages(tmp_path, "none")
    with pytest.raises(BadConfig, match=r"one label map: .* 'robot cell' and 'coarse': 0 is 'floor' and 'ground'$"):
        Mixture([(RangeImages(cells, "none"), 1.0), (other, 1.0)])
    joined = LabelMap(
        "ours", (("ground", ("floor",)), ("metal", ("base", "gripper")), ("else", ("bin",))), CELL_CLASSES
    )
    both = Mixture([(RangeImages(cells, "none", labels=joined), 1.0), (other, 1.0)])
    assert {label for batch in loader(both, 4) for label in np.unique(batch["labels"].numpy()).tolist()} == {
        0,
        1,
        2,
        255,
    }
    with pytest.raises(BadConfig, match="a mixture needs the same planes"):
        Mixture([(RangeImages(cells, "none", labels=joined, planes="material"), 1.0), (other, 1.0)])
    with pytest.raises(
        BadConfig, match="labels 'ours' are of other classes than the set's: found .* 'robot cell' and 'coarse': 0 is"
    ):
        RangeImages(tmp_path, "none", labels=joined)


def test_a_mixture_gives_planes_by_their_names_whatever_their_order_in_its_sets(cells: Path) -> None:
    sets = [RangeImages(cells, "none", planes=names) for names in (NAMES, NAMES[::-1])]
    for batch in loader(Mixture([(images, 1) for images in sets]), 4, shuffle=False):
        for row, key in enumerate(batch["key"]):
            stored = sets[0].clean(sets[0].keys.index(key)).planes
            for name in NAMES:
                assert np.array_equal(batch["planes"][name][row].numpy(), stored[name])


def test_the_rest_has_its_class_where_all_others_are_those_of_the_set(cells: Path) -> None:
    """As of a set of people and floor of which the floor is to be one class with what has none."""
    named = tuple((name, (name,)) for name in CELL_CLASSES.names[:-1])
    label_map = LabelMap("all but one", (*named, ("rest", ("*",))), CELL_CLASSES)
    assert not label_map.is_whole
    images, stored = RangeImages(cells, "none", labels=label_map), RangeImages(cells, "none", unlabelled=True)
    for index in range(len(images)):
        labels = stored[index]["labels"].numpy()
        assert (labels == UNLABELLED).any()
        expected = np.where(labels == UNLABELLED, len(CELL_CLASSES) - 1, labels)
        assert np.array_equal(images[index]["labels"].numpy(), expected)


def test_val_is_the_same_whether_a_column_of_subjects_is_open_or_not(tmp_path: Path) -> None:
    write_open_set(tmp_path)
    subject = {key: f"s{number % 3}" for number, key in enumerate(RangeImages(tmp_path, "none").keys)}
    with ColumnWriter(tmp_path, "subject", "text") as column:
        for key, name in subject.items():
            column.write(key, name)
    train, val = (RangeImages(tmp_path, "none", split, val_share=0.4) for split in ("train", "val"))
    assert val.keys == RangeImages(tmp_path, "none", "val", val_share=0.4, where="subject=*").keys
    assert not {subject[key] for key in train.keys} & {subject[key] for key in val.keys}
    assert len(train) + len(val) == 8


def test_val_takes_samples_without_a_subject_one_by_one(tmp_path: Path) -> None:
    images = {"range_m": np.full((16, 20), 2.0), "labels": np.zeros((16, 20), np.uint8)}
    with ShardWriter(tmp_path, rig=CELL_RIGS[0], classes=["wall"], projector="none", fields={"subject": "text"}) as out:
        for number in range(12):
            out.write(key=f"s-{number:02d}", **images, fields={"subject": "None"} if number < 2 else {})
    train, val = (RangeImages(tmp_path, "none", split, val_share=0.25) for split in ("train", "val"))
    assert (len(train), len(val)) == (9, 3)
    assert {"s-00", "s-01"} <= {*train.keys} or {"s-00", "s-01"} <= {*val.keys}
