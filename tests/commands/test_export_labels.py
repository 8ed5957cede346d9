"""`bodyseg export-labels`: what other programs read is what was labelled."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_networks import Places
from numpy.typing import NDArray
from PIL import Image
from small_rig import SMALL

from bodyseg_data import ColumnWriter, RangeImages, ShardWriter
from bodyseg_data.files import part_beside
from bodyseg_data.labels import BACKGROUND, PARTS, PARTS33, LabelClass, load_label_map
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import split_key
from bodyseg_model import runtimes
from bodyseg_model.commands import cli
from bodyseg_model.commands.export_labels import DENSE_POSE, LabelImage, compressed, segments
from bodyseg_model.networks import Trained
from bodyseg_model.runtimes import backends

Labels = NDArray[np.uint8]


def export(out: Path, source: Path, kind: str, *words: str) -> Path:
    given = [str(source), "--out", str(out), "--format", kind]
    assert cli.main(["export-labels", *given, *words]) == 0
    return out


def tree(file: Path) -> Any:
    return json.loads(file.read_text())


def pixels(file: Path) -> NDArray[Any]:
    with Image.open(file) as image:
        return np.asarray(image)


def decoded(segmentation: dict[str, Any]) -> NDArray[np.bool_]:
    """COCO's run lengths as a mask, written from the format's description alone."""
    counts, text = segmentation["counts"], segmentation["counts"]
    if isinstance(text, str):
        counts, value, shift = [], 0, 0
        for character in text.encode():
            value |= (character - 48 & 31) << shift
            shift += 5
            if not character - 48 & 32:
                value -= (1 << shift) * (value >> (shift - 1) & 1)
                counts.append(value + (counts[-2] if len(counts) > 2 else 0))
                value = shift = 0
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    return flat.reshape(segmentation["size"][::-1]).T


@pytest.fixture
def coco(figures_set: Path, tmp_path: Path) -> Path:
    return export(tmp_path / "coco", figures_set, "coco", "--variant", "all", "--split", "test")


def test_coco_holds_labels_areas_boxes_and_ranges(coco: Path, figures_set: Path) -> None:
    found, images = tree(coco / "annotations.json"), RangeImages(figures_set, "all", "test")
    everywhere = RangeImages(figures_set).keys
    assert [each["name"] for each in found["categories"]] == list(PARTS33.names)
    assert {each["supercategory"] for each in found["categories"]} == {"person"}
    assert len(found["images"]) == len(images) and len({each["id"] for each in found["annotations"]}) > 30
    for index, image in enumerate(found["images"]):
        assert image["split"] == "test"
        assert image["id"] == everywhere.index(images.keys[index]) + 1, "of the whole set, not of the split"
        again, clean = np.full((image["height"], image["width"]), BACKGROUND), images.clean(index).labels
        np.testing.assert_array_equal(pixels(coco / image["file_name"]), images.image(index).range)
        for each in found["annotations"]:
            if each["image_id"] == image["id"]:
                assert isinstance(each["segmentation"]["counts"], str), "COCO's text, which its own tools read"
                mask = decoded(each["segmentation"])
                rows, columns = mask.nonzero()
                left, top, width, height = each["bbox"]
                assert (left, top) == (columns.min(), rows.min()) and each["area"] == len(rows)
                assert (left + width, top + height) == (columns.max() + 1, rows.max() + 1)
                assert (each["iscrowd"], each["instance"]) == (0, 1)
                again[mask] = each["category_id"] - 1
        np.testing.assert_array_equal(again, clean)


def test_coco_may_be_one_file(figures_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = tree(export(tmp_path / "coco", figures_set, "coco") / "annotations.json")
    (tmp_path / "runs.json").write_text("{}")
    for _ in range(2):  # into a new file, and in place of the earlier one
        assert cli.main(["export-labels", str(figures_set), "--coco", str(tmp_path / "one.json")]) == 0
        alone = tree(tmp_path / "one.json")
        assert alone["annotations"] == whole["annotations"]
        names = [each["file_name"] for each in whole["images"]]
        assert [f"range/{each['file_name']}" for each in alone["images"]] == names
    assert [each.name for each in sorted(tmp_path.iterdir())] == ["coco", "one.json", "runs.json"]
    assert "--coco must be a new file, or one of an" in refused(capsys, figures_set, "--coco", tmp_path / "runs.json")
    for wrong in (["--coco", tmp_path / "a.json", "--format", "png"], ["--out", tmp_path / "a"]):
        assert "give --out and --format, or --coco alone" in refused(capsys, figures_set, *wrong)


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_coco_comes_back_from_its_own_tools(coco: Path) -> None:
    reader = pytest.importorskip("pycocotools.coco", reason="pycocotools is not installed: pip install pycocotools")
    tools = pytest.importorskip("pycocotools.mask")
    opened = reader.COCO(coco / "annotations.json")
    for each in opened.anns.values():
        mask = opened.annToMask(each)
        np.testing.assert_array_equal(mask, decoded(each["segmentation"]))
        assert tools.encode(np.asfortranarray(mask))["counts"].decode() == each["segmentation"]["counts"]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (40, 30), (3, 2)])
def test_segments_of_any_images_come_back(shape: tuple[int, int]) -> None:
    draws = np.random.default_rng(sum(shape))
    for share in (0.0, 0.3, 1.0):
        labels = draws.choice([0, 7, 253, BACKGROUND], shape, p=[share / 2, share / 4, share / 4, 1 - share])
        image = LabelImage("a", 1, labels.astype(np.uint8), draws.integers(0, 3, shape).astype(np.uint16))
        assert image.instances is not None
        again = np.full(shape, -1)
        for facts, counts in segments(image):
            assert counts.sum() == labels.size and facts["area"] == counts[1::2].sum()
            mask = decoded({"size": list(shape), "counts": compressed(counts)})
            np.testing.assert_array_equal(mask, decoded({"size": list(shape), "counts": counts.tolist()}))
            again[mask] = facts["id"]
        expected = np.where(labels == BACKGROUND, -1, labels.astype(int) + 1 + 256 * image.instances)
        np.testing.assert_array_equal(again, expected)


def test_panoptic_ids_are_red_green_and_blue(figures_set: Path, tmp_path: Path) -> None:
    out = export(tmp_path / "out", figures_set, "panoptic")
    found, images = tree(out / "panoptic.json"), RangeImages(figures_set, "none")
    assert all(each["isthing"] == 1 for each in found["categories"]) and len(found["annotations"]) == len(images)
    for index, each in enumerate(found["annotations"]):
        ids = pixels(out / "panoptic" / each["file_name"]).astype(int) @ [1, 256, 256**2]
        labels = images.clean(index).labels
        np.testing.assert_array_equal(ids, np.where(labels == BACKGROUND, 0, labels.astype(int) + 1 + 256))
        assert {segment["id"] for segment in each["segments_info"]} == set(np.unique(ids).tolist()) - {0}
        assert sum(segment["area"] for segment in each["segments_info"]) == (ids > 0).sum()


def test_instances_and_wider_classes_are_the_sets_own(tmp_path: Path) -> None:
    labels = np.zeros((SMALL.camera.rows, SMALL.camera.columns), np.uint8)
    labels[20:], labels[40:] = 1, BACKGROUND
    instances = np.where(labels == 1, 300, 0).astype(np.uint16)
    classes = [LabelClass("floor", within="room", colour="#102030"), LabelClass("a:b")]
    planes = {"instances": "uint16"}
    with ShardWriter(tmp_path / "set", rig=SMALL, classes=classes, planes=planes, projector="none") as out:
        range_m = np.where(labels == BACKGROUND, 0.0, 2.0)
        out.write(key="scene", range_m=range_m, labels=labels, split="train", planes={"instances": instances})
    found = tree(export(tmp_path / "out", tmp_path / "set", "panoptic") / "panoptic.json")
    assert [each["supercategory"] for each in found["categories"]] == ["room", "classes"]
    assert [each["isthing"] for each in found["categories"]] == [0, 1], "no instance is a floor"
    assert [each["id"] for each in found["annotations"][0]["segments_info"]] == [1, 2 + 256 * 300]
    assert tree(tmp_path / "out" / "classes.json")[0] == {"name": "floor", "color": "#102030", "attributes": []}


def test_instances_may_be_a_column(tmp_path: Path) -> None:
    labels = np.zeros((SMALL.camera.rows, SMALL.camera.columns), np.uint8)
    with ShardWriter(tmp_path / "set", rig=SMALL, classes=["box"], projector="none") as out:
        out.write(key="scene", range_m=np.full(labels.shape, 2.0), labels=labels)
    with ColumnWriter(tmp_path / "set", "instances", "uint16") as column:
        column.write("scene", np.full(labels.shape, 7))
    found = tree(export(tmp_path / "out", tmp_path / "set", "panoptic") / "panoptic.json")
    assert [each["id"] for each in found["annotations"][0]["segments_info"]] == [1 + 256 * 7]


def test_dense_pose_has_its_charts(figures_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = export(tmp_path / "out", figures_set, "dense-pose-parts")
    images = RangeImages(figures_set, "none")
    for index, key in enumerate(images.keys):
        np.testing.assert_array_equal(
            pixels(out / "dense_pose" / f"{key}.png"), DENSE_POSE[images.clean(index).labels], strict=True
        )
    # detectron2's coarse segmentation of the charts, against limbs14's classes
    limbs = load_label_map("limbs14")
    coarse = [0, 1, 1, 2, 3, 4, 5, 6, 7, 6, 7, 8, 9, 8, 9, 10, 11, 10, 11, 12, 13, 12, 13, 14, 14]
    order = ["trunk", "right_hand", "left_hand", "left_foot", "right_foot", "right_thigh", "left_thigh", "right_shank"]
    order += ["left_shank", "left_upper_arm", "right_upper_arm", "left_forearm", "right_forearm", "head"]
    names = [limbs.names[limbs.table[part.label]] for part in PARTS]
    assert [order[coarse[chart] - 1] for chart in DENSE_POSE[:33]] == names and not DENSE_POSE[33:].any()
    words = ["export-labels", str(figures_set), "--out", str(tmp_path / "b"), "--format", "dense-pose-parts"]
    assert cli.main([*words, "--labels", "limbs14"]) == 2
    assert "DensePose's parts are made of the 33 parts, found the labels" in capsys.readouterr().err
    assert not (tmp_path / "b").exists() and not list(tmp_path.glob(".*"))


def test_indexed_pngs_have_numbers_and_colours(figures_set: Path, tmp_path: Path) -> None:
    out = export(tmp_path / "out", figures_set, "png", "--labels", "limbs14")
    limbs, images = load_label_map("limbs14"), RangeImages(figures_set, "none", labels="limbs14")
    with Image.open(out / "labels" / f"{images.keys[0]}.png") as image:
        labels, colours = np.asarray(image), np.asarray(image.convert("RGB"))
    np.testing.assert_array_equal(labels, images.image(0).labels)
    np.testing.assert_array_equal(colours[labels < 14], limbs.colours[labels[labels < 14]])
    assert [each["name"] for each in tree(out / "classes.json")] == list(limbs.names)


def test_lerobot_gets_lossless_ranges_by_its_written_format(figures_set: Path, tmp_path: Path) -> None:
    """As the reader of lerobot 0.4 goes through it: pandas for tasks, `datasets` for frames and episodes."""
    datasets, pandas = pytest.importorskip("datasets"), pytest.importorskip("pandas")
    out = export(tmp_path / "out", figures_set, "lerobot", "--variant", "all", "--fps", "5")
    info, images = tree(out / "meta" / "info.json"), RangeImages(figures_set, "all")
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 5, len(images))
    assert pandas.read_parquet(out / "meta/tasks.parquet").iloc[0].name == "label what the camera sees"

    def rows(pattern: str, features: Any = None) -> Any:
        files = sorted(map(str, out.glob(pattern)))
        return datasets.Dataset.from_parquet(files, features=features, cache_dir=str(tmp_path / "cache"))

    kinds = {
        name: datasets.Image() if each["dtype"] == "image" else datasets.Value(each["dtype"])
        for name, each in info["features"].items()
    }
    episodes = rows("meta/episodes/*/*.parquet")
    frames = rows("data/*/*.parquet", datasets.Features(kinds))
    assert len(frames) == len(images) and len(episodes) == info["total_episodes"] > 1
    assert info["features"]["observation.images.depth"]["info"]["range_step_m"] == images.step_m
    subjects = [split_key(key)[0] for key in images.keys]
    ends = [len({*subjects[:end]}) for end in (len(RangeImages(figures_set, "all", "train")), len(images))]
    assert info["splits"] == {"train": f"0:{ends[0]}", "test": f"{ends[0]}:{ends[1]}"} and 0 < ends[0] < ends[1]
    for index, row in enumerate(frames):
        np.testing.assert_array_equal(np.asarray(row["observation.images.depth"]), images.image(index).range)
        np.testing.assert_array_equal(np.asarray(row["observation.images.labels"]), images.clean(index).labels)
        episode = episodes[row["episode_index"]]
        assert row["index"] == index == episode["dataset_from_index"] + row["frame_index"] < episode["dataset_to_index"]
        assert row["timestamp"] == pytest.approx(row["frame_index"] / 5)


def standing(*at: tuple[int, int, int, int]) -> NDArray[np.uint16]:
    """A wall, and before it blocks: first row, first column, rows, columns."""
    frame = np.full((60, 80), 4000, np.uint16)
    for top, left, rows, columns in at:
        frame[top : top + rows, left : left + columns] = 2000 + left
    return frame


@pytest.fixture
def labelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, near_is_person: None, prepared: list[Rig]
) -> Iterator[tuple[Path, Path]]:
    """Frames, and the folder that `bodyseg segment` wrote of them: two people, and nobody."""
    monkeypatch.setattr(backends, "computes_bfloat16", lambda: False)
    trained = Trained(Places(axis=0, step=5), {"network": "places", "rig": SMALL.to_json()})
    monkeypatch.setattr(runtimes, "load_network", lambda run, dense=False: trained)
    frames = tmp_path / "frames"
    frames.mkdir()
    Image.fromarray(standing((10, 5, 40, 12), (10, 50, 40, 12))).save(frames / "1.png")
    Image.fromarray(standing()).save(frames / "2.png")
    words = ["segment", str(frames), "--focal", "100", "--out", str(tmp_path / "labelled"), "--keep-things"]
    assert cli.main(words) == 0
    return frames, tmp_path / "labelled"


def test_a_folder_of_segment_is_exported_with_its_people(labelled: tuple[Path, Path], tmp_path: Path) -> None:
    frames, folder = labelled
    found = tree(export(tmp_path / "coco", folder, "coco") / "annotations.json")
    assert [(each["id"], each["file_name"]) for each in found["images"]] == [(1, "1.png"), (2, "2.png")]
    assert {(each["image_id"], each["instance"]) for each in found["annotations"]} == {(1, 1), (1, 2)}
    assert not (tmp_path / "coco" / "range").exists()
    again = np.full((60, 80), BACKGROUND)
    for each in found["annotations"]:
        again[decoded(each["segmentation"])] = each["category_id"] - 1
    np.testing.assert_array_equal(again, pixels(folder / "labels" / "1.png"))
    out = export(tmp_path / "lerobot", folder, "lerobot", "--frames", str(frames))
    assert tree(out / "meta" / "info.json")["total_episodes"] == 1
    out = export(tmp_path / "coco", folder, "png", "--frames", str(frames))
    np.testing.assert_array_equal(pixels(out / "range" / "1.png"), pixels(frames / "1.png"))
    assert not (out / "annotations.json").exists(), "the earlier export is gone"


def test_the_results_of_an_hour_of_frames_are_exported(labelled: tuple[Path, Path], tmp_path: Path) -> None:
    _, folder = labelled
    with (folder / "summary.json").open("a") as file:
        file.write(" " * (1 << 26))  # as long as that of 60 000 frames
    assert tree(export(tmp_path / "out", folder, "coco") / "annotations.json")["annotations"]


def test_people_whose_boxes_overlap_are_told_apart(labelled: tuple[Path, Path], tmp_path: Path) -> None:
    bent = standing((5, 5, 8, 60), (5, 5, 50, 10), (30, 40, 25, 12))
    np.save(tmp_path / "a.npy", bent)
    words = ["segment", str(tmp_path / "a.npy"), "--focal", "100", "--out", str(tmp_path / "b"), "--keep-things"]
    assert cli.main(words) == 0
    shown = pixels(tmp_path / "b" / "persons" / "a.png")
    np.testing.assert_array_equal(shown, np.select([bent == 2005, bent == 2040], [1, 2]))
    found = tree(export(tmp_path / "coco", tmp_path / "b", "coco") / "annotations.json")["annotations"]
    for number, pixels_of in ((1, 60 * 8 + 42 * 10), (2, 25 * 12)):
        assert sum(each["area"] for each in found if each["instance"] == number) == pixels_of
    assert not any(each["iscrowd"] for each in found)


def test_times_of_frames_and_numbers_of_people_in_a_video_are_exported(
    labelled: tuple[Path, Path], tmp_path: Path
) -> None:
    stack = np.stack([standing((10, 5, 40, 12)), standing((10, 7, 40, 12), (8, 50, 44, 14))])
    np.savez(tmp_path / "a.npz", depth=stack, timestamps=np.array([0.5, 0.6]))
    words = ["segment", str(tmp_path / "a.npz"), "--focal", "100", "--video", "--out", str(tmp_path / "b")]
    assert cli.main([*words, "--keep-things"]) == 0
    found = tree(export(tmp_path / "coco", tmp_path / "b", "coco") / "annotations.json")
    times = [each["time_s"] for each in json.loads((tmp_path / "b" / "summary.json").read_text())["each"]]
    assert [image["time_s"] for image in found["images"]] == times == [0.5, 0.6]
    told = {(each["image_id"], each["instance"], each["track_id"]) for each in found["annotations"]}
    assert told == {(1, 1, 1), (2, 1, 2), (2, 2, 1)}, "the newcomer is the larger body"
    assert "track_id" not in tree(export(tmp_path / "coco", labelled[1], "coco") / "annotations.json")["annotations"][0]


@pytest.mark.parametrize(("scale", "kind", "units"), [(10, np.uint16, "0.1mm"), (1, np.float32, "mm")])
def test_ranges_are_exported_in_the_units_that_were_given_to_segment(
    labelled: tuple[Path, Path], tmp_path: Path, scale: int, kind: type, units: str
) -> None:
    stack: np.ndarray[Any, Any] = scale * standing((10, 5, 40, 12)).astype(kind)
    np.save(tmp_path / "a.npy", stack)
    words = ["segment", str(tmp_path / "a.npy"), "--units", units, "--focal", "100", "--out", str(tmp_path / "b")]
    assert cli.main([*words, "--keep-things"]) == 0
    out = export(tmp_path / "coco", tmp_path / "b", "coco", "--frames", str(tmp_path / "a.npy"))
    step_m = tree(out / "annotations.json")["images"][0]["range_step_m"]
    np.testing.assert_allclose(pixels(out / "range" / "a.png") * step_m, stack / scale / 1000, atol=2e-4)


def refused(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    assert cli.main(["export-labels", *map(str, words)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert "Traceback" not in "".join(lines)
    return lines[-1].removeprefix("bodyseg export-labels: ")


def test_bad_input_is_one_line_and_leaves_nothing(
    labelled: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, folder = labelled
    out, words = tmp_path / "out", (folder, "--format", "lerobot", "--out", tmp_path / "out")
    assert "needs ranges: give --frames" in refused(capsys, *words)
    for flag, value in (("--variant", "all"), ("--sensor", "kinect_v1"), ("--seed", "1"), ("--split", "test")):
        assert f"{flag} is for sets, not for {folder}" in refused(capsys, *words, flag, value)
    assert "--topic is of --frames, which are missing" in refused(capsys, *words, "--topic", "depth")
    assert 'Invalid value "val" for --split' in refused(capsys, *words, "--split", "val")  # of no share that it takes
    shutil.copytree(frames, tmp_path / "others")
    assert "those labelled, where they lay: 1 is not" in refused(capsys, *words, "--frames", tmp_path / "others")
    assert "--fps must be a whole number of at least 1" in refused(capsys, *words, "--fps", "0")
    assert f"--out must be a new folder, or one of an earlier export: {frames} holds 1.png" in refused(
        capsys, *words[:4], frames
    )
    Image.fromarray(np.zeros((60, 81), np.uint16)).save(folder / "persons" / "2.png")
    said = refused(capsys, folder, "--format", "coco", "--out", out)
    assert said == "persons must be uint16 (60, 80), as their labels, found uint16 (60, 81): 2"
    Image.fromarray(np.full((60, 80), 33, np.uint8)).save(folder / "labels" / "2.png")
    said = refused(capsys, folder, "--format", "coco", "--out", out)
    assert said == "labels must be below 33, or 255, found 33: 2"
    (folder / "labels" / "2.png").write_bytes(b"none")
    assert "2.png: cannot be read as an image" in refused(capsys, folder, "--format", "coco", "--out", out)
    summary = tree(folder / "summary.json")
    for name in ("../labels/1", str(folder / "labels" / "1")):
        summary["each"][0]["name"] = name
        (folder / "summary.json").write_text(json.dumps(summary))
        assert "must stay in its folder" in refused(capsys, folder, "--format", "png", "--out", out)
    summary["each"][0] |= {"name": "1", "path_id": []}
    (folder / "summary.json").write_text(json.dumps(summary))
    assert "must be those labelled, where they lay: 1 is not" in refused(capsys, *words, "--frames", frames)
    summary["each"][0]["bodies"] = [1]
    (folder / "summary.json").write_text(json.dumps(summary))
    assert "summary.json is none of `bodyseg segment`: TypeError(" in refused(capsys, *words)
    summary["labels"] = []
    (folder / "summary.json").write_text(json.dumps(summary))
    assert "summary.json, labels must be an object, found list" in refused(capsys, *words)
    (folder / "summary.json").write_text("{}")
    assert "summary.json is none of `bodyseg segment`: KeyError('labels')" in refused(capsys, *words)
    (folder / "summary.json").rename(folder / "unfinished.json")
    assert "`bodyseg segment` has not ended in" in refused(capsys, *words)
    assert not out.exists() and not list(tmp_path.glob(".*"))


def test_a_link_to_a_folder_elsewhere_stays_one(figures_set: Path, tmp_path: Path) -> None:
    disk, link = tmp_path / "disk", tmp_path / "out"
    disk.mkdir()
    link.symlink_to(disk)
    part_beside(disk).mkdir()  # as a killed export leaves it
    for number in range(2):  # into an empty folder, and in place of an earlier export
        (disk / ".DS_Store").touch()  # as macOS leaves where somebody looks, and on other disks beside each file
        (disk / f"._{number}").touch()
        export(link, figures_set, "png")
        assert link.is_symlink() and (disk / "labels").is_dir()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["disk", "out"]


def test_what_the_user_put_beside_an_export_stays(
    figures_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = export(tmp_path / "out", figures_set, "png")
    (out / "labels" / "runs").mkdir()
    (out / "labels" / "runs" / "model.pt").write_bytes(b"of a day")
    said = refused(capsys, figures_set, "--out", out, "--format", "png")
    assert said == f"--out must hold an earlier export alone, found other files, too, in {out}: move them"
    assert (out / "labels" / "runs" / "model.pt").read_bytes() == b"of a day"
    shutil.rmtree(out / "labels")
    export(out, figures_set, "coco")
    monkeypatch.chdir(out)
    for word in (".", ".."):
        assert "--out must not hold the folder in which the command runs" in refused(
            capsys, figures_set, "--out", word, "--format", "png"
        )


def test_a_full_disk_is_one_line_and_leaves_the_earlier_export(
    figures_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = export(tmp_path / "out", figures_set, "png")
    before, write = sorted(out.rglob("*")), Path.write_bytes

    def full(self: Path, data: bytes) -> int:
        if len(list(self.parent.iterdir())) > 3:
            raise OSError(28, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    said = refused(capsys, figures_set, "--out", out, "--format", "dense-pose-parts")
    assert said == f"cannot write {out}: No space left on device"
    assert sorted(out.rglob("*")) == before and [each.name for each in tmp_path.iterdir()] == ["out"]
