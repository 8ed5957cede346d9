from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from small_rig import SMALL

from bodyseg_data import Mixture, RangeImages, ShardWriter
from bodyseg_data.artifacts import sensor_model_names
from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import EMPTY
from bodyseg_data.labels import BACKGROUND, PART_COUNT, PARTS33, colour_labels
from bodyseg_model import runtimes
from bodyseg_model.commands import cli
from bodyseg_model.evaluation import (
    Evaluation,
    SamplePicture,
    Scores,
    evaluate,
    evaluation,
    open_images,
    report,
    time_frames,
)
from bodyseg_model.evaluation.evaluation import PredictedImage
from bodyseg_model.evaluation.figures import (
    _DROPPED,
    _RIGHT,
    _SWAPPED,
    _caption,
    _panels,
    draw_confidence,
    draw_confusion,
    draw_parts,
)
from bodyseg_model.evaluation.scores import KINDS, kinds_of
from bodyseg_model.networks import Network, build, load_network, predict, save_network
from bodyseg_model.networks.registry import Prediction


class ByRange(Network):
    """Takes every pixel by itself: its range in centimetres says which part it is called, and how surely."""

    def __init__(self, classes: int = PART_COUNT) -> None:
        super().__init__()
        self.classes = classes

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        place = range_m * 100 % self.classes
        scores = torch.zeros(len(range_m), self.classes, *range_m.shape[2:])
        return scores.scatter(1, place.long(), 10 * (place % 1))


def at_once(network: Network, range_m: torch.Tensor) -> Prediction:
    """Predicts as `ByRange`, more or less, in no time: where little depends on the network."""
    place = range_m[:, 0] * 100 % PART_COUNT
    return Prediction(torch.where(range_m[:, 0] > 0, place.to(torch.uint8), BACKGROUND), place % 1)


class Undecided(Network):
    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        return range_m.expand(-1, PART_COUNT, -1, -1) * torch.nan


@pytest.fixture(scope="module")
def network() -> ByRange:
    return ByRange().eval()


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(1)
    small = build("compact", {"patch": 16, "widths": [8], "blocks": [0], "context": False})
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    folder.mkdir()
    facts = {"variant": "all", "seed": 3, "rig": SMALL.to_json()}
    save_network(folder / "network.safetensors", small, "compact", facts)
    return folder


def plainly(network: Network, images: RangeImages) -> dict[str, Any]:
    """The counts of every subset, image by image and without anything of `evaluation`."""
    found: dict[str, Any] = {}
    for index in range(len(images)):
        sample, shown = images.clean(index), images[index]
        answer = predict(network, shown["range"][None])
        body = shown["labels"].numpy() != BACKGROUND
        truth, predicted = shown["labels"].numpy()[body], answer.labels[0].numpy()[body]
        counts = np.zeros((PART_COUNT, PART_COUNT), np.int64)
        np.add.at(counts, (truth, predicted), 1)
        total = found.setdefault(sample.info.subset, {"images": 0, "counts": 0, "sure": 0, "confidence": 0.0})
        confidence = answer.confidence[0].numpy()[body]
        total["images"] += 1
        total["counts"] = total["counts"] + counts
        total["sure"] += int((confidence > np.float32(0.5)).sum())
        total["confidence"] += float(confidence.sum(dtype=np.float64))
    return found


def test_subsets_are_told_without_reading_samples(
    small_set: Path, network: ByRange, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = open_images(str(small_set), "none")
    monkeypatch.setattr(RangeImages, "clean", lambda *_: pytest.fail("a sample was read twice"))
    assert set(evaluate(network, images, confidences=False).subsets) == {"A", "people"}


@pytest.mark.parametrize(("variant", "batch_size", "workers"), [("all", 3, 0), ("all", 16, 1), ("none", 5, 0)])
def test_scores_are_those_of_single_images(
    small_set: Path, network: ByRange, variant: str, batch_size: int, workers: int
) -> None:
    images = open_images(str(small_set), variant)
    steps: list[tuple[int, int]] = []
    found = evaluate(
        network, images, batch_size=batch_size, num_workers=workers, progress=lambda *step: steps.append(step)
    )
    expected = plainly(network, images)
    assert set(found.subsets) == {"A", "people"}
    for name, scores in found.subsets.items():
        plain = expected[name]
        assert scores.images == plain["images"]
        assert np.array_equal(scores.confusion.counts, plain["counts"])
        assert scores.confidences is not None
        assert scores.confidences.above(0.5).share_of_pixels == pytest.approx(plain["sure"] / plain["counts"].sum())
        assert scores.confidences.mean() == pytest.approx(plain["confidence"] / plain["counts"].sum())
    total = found.total()
    assert np.array_equal(total.confusion.counts, sum(plain["counts"] for plain in expected.values()))
    assert total.images == len(images) == 8
    assert steps[-1] == (8, 8)
    assert set(found.milliseconds) == {"network", "scores", "loading"} and min(found.milliseconds.values()) > 0


def test_every_sample_of_an_own_set_has_its_own_subset(tmp_path: Path) -> None:
    """Keys like those of a body's views say nothing there; images of no subset are not called all images."""
    seen = np.full((SMALL.camera.rows, SMALL.camera.columns), 2.0)
    with ShardWriter(tmp_path / "own", rig=SMALL, classes=["body"], projector="none", workers=0) as out:
        for number in range(4):
            fields = {"subset": "AB"[number % 2]} if number < 3 else {}
            key, labels = f"room-d{100 + number}-a000", np.zeros(seen.shape, np.uint8)
            out.write(key=key, range_m=seen, labels=labels, split="test", fields=fields)
    images = RangeImages(tmp_path / "own", "none", "test")
    found = evaluate(ByRange(1).eval(), images, num_workers=0)
    assert {name: scores.images for name, scores in found.subsets.items()} == {"A": 2, "B": 1, "all": 1}
    named = draw_parts(report(found)).axes[0].get_yticklabels()
    assert [text.get_text() for text in named] == ["all  (images: 4)", "A  (images: 2)", "B  (images: 1)"]


def keys_seen(network: Network, images: RangeImages, count: int | None, batch_size: int) -> list[str]:
    seen: list[str] = []
    evaluate(
        network, images, count, batch_size=batch_size, confidences=False, watch=lambda one, _: seen.append(one.key)
    )
    return seen


def test_a_number_of_images_means_the_same_bodies_whatever_else_is_asked(
    small_set: Path, network: ByRange, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "predict", at_once)
    images = open_images(str(small_set))
    chosen = [images.keys[index] for index in images.order(0)[:5]]
    assert keys_seen(network, images, 5, 2) == chosen
    assert keys_seen(network, open_images(str(small_set), "noise", noise_mm=40), 5, 16) == chosen
    assert sorted(keys_seen(network, images, 99, 3)) == sorted(images.keys)
    assert keys_seen(network, open_images(str(small_set), seed=1), 5, 2) != chosen
    with pytest.raises(BadConfig, match="number of images .*found 0"):
        evaluate(network, images, 0)


def test_the_order_is_that_of_this_process_under_torchrun(
    small_set: Path, network: ByRange, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "predict", at_once)
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert len(keys_seen(network, open_images(str(small_set)), None, 4)) == 8


def test_sets_merge_into_what_one_set_of_both_gives(
    small_set: Path, network: ByRange, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "predict", at_once)

    def judged(split: Any) -> Evaluation:
        return evaluate(network, RangeImages(small_set, "all", split))

    whole, merged = judged(None), judged("train")
    merged.merge(judged("test"))
    assert json.dumps(report(merged)) == json.dumps(report(whole))
    assert len(whole.worst) == 10
    assert [accuracy for accuracy, _ in whole.worst] == sorted(accuracy for accuracy, _ in whole.worst)
    assert merged.total(["people"]).images == 12
    with pytest.raises(BadConfig, match="the subset must be one of A, people, found 'hard'"):
        merged.total(["people", "hard"])


def test_fewer_scores_can_be_counted(small_set: Path, network: ByRange, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "predict", at_once)

    images = open_images(str(small_set))
    whole, fewer = evaluate(network, images), evaluate(network, images, confidences=False)
    assert np.array_equal(whole.total().confusion.counts, fewer.total().confusion.counts)
    assert fewer.total().confidences is None
    assert "reliability" not in report(fewer)
    with pytest.raises(BadConfig, match="scores to merge must both have confidences, or neither"):
        whole.merge(fewer)


def test_strengths_of_artifacts_can_be_fixed(small_set: Path) -> None:
    images = open_images(str(small_set), "all", noise_mm=40, missing=0.25)
    assert {images.image(index).drawn["sigma_mm"] for index in range(8)} == {40}
    assert {images.image(index).drawn["missing_rate"] for index in range(8)} == {0.25}
    drawn = open_images(str(small_set), "all")
    assert len({drawn.image(index).drawn["sigma_mm"] for index in range(8)}) == 8
    for variant, strengths in (("md", {"noise_mm": 1.0}), ("none", {"noise_mm": 0.0}), ("noise", {"missing": 0.5})):
        with pytest.raises(BadConfig, match=f"has (noise|missing_data), found variant '{variant}'"):
            open_images(str(small_set), variant, **strengths)  # type: ignore[arg-type]
    with pytest.raises(BadConfig, match="rates must be from 0 to 1, found"):
        open_images(str(small_set), missing=1.5)
    with pytest.raises(BadConfig, match="low_mm must be from 0 to 1000, found nan"):
        open_images(str(small_set), noise_mm=float("nan"))


@pytest.mark.parametrize("sensor", sensor_model_names())
def test_images_of_every_sensor_are_evaluated_whole(small_set: Path, network: ByRange, sensor: str) -> None:
    images = open_images(str(small_set), "all", "test", sensor=sensor)
    found = evaluate(network, images, 6)
    pixels = sum(np.count_nonzero(images.image(index).range) for index in images.order(0)[:6].tolist())
    assert found.total().confusion.counts.sum() == pixels


def test_answers_that_are_none_are_refused(small_set: Path) -> None:
    images = open_images(str(small_set))
    with pytest.raises(BadConfig, match="must have the 33 classes of labels 'parts33', found 40"):
        evaluate(ByRange(40).eval(), images)
    with pytest.raises(BadConfig, match="confidences must be 0 to 1, found nan"):
        evaluate(Undecided().eval(), images)
    mixed: Any = Mixture([(images, 1)])
    with pytest.raises(BadConfig, match="^images must be RangeImages, each set of a mixture by itself, found Mixture$"):
        evaluate(ByRange(33).eval(), mixed)


def seen_image(subset: str, labels: list[int], predicted: list[int]) -> PredictedImage:
    truth, guess = (np.array([row], np.uint8) for row in (labels, predicted))
    body = truth != BACKGROUND
    return PredictedImage(
        f"{subset}-{labels[0]}", subset, body.astype(np.float32) * 2, truth, guess, body.astype(np.float32)
    )


def test_an_empty_image_counts_as_an_image_and_as_nothing_else() -> None:
    empty = seen_image("A", [BACKGROUND] * 3, [BACKGROUND] * 3)
    found = Evaluation()
    found.add(empty)
    tree = report(found)
    json.dumps(tree, allow_nan=False)
    assert (tree["images"], tree["pixels"], tree["average_per_class_accuracy"]) == (1, 0, None)
    assert tree["worst_images"] == []
    picture = SamplePicture()
    picture.watch(empty, float("nan"))
    assert picture.draw() is None


def by_hand() -> Evaluation:
    found = Evaluation()
    for subset, labels, predicted in (
        ("people", [0, 0, 4, 4, BACKGROUND, 3], [0, 1, 5, 4, BACKGROUND, 3]),
        ("hard", [7, 7, 7, 7], [7, 7, 12, 3]),
        ("C", [31, 31], [31, 31]),
    ):
        found.add(seen_image(subset, labels, predicted))
    return found


def test_the_report_by_hand() -> None:
    tree = report(by_hand())
    json.dumps(tree, allow_nan=False)
    assert list(tree["subsets"]) == ["C", "people", "hard"], "the paper's first"
    assert (tree["images"], tree["pixels"]) == (3, 11)
    assert tree["average_per_class_accuracy"] == pytest.approx(np.mean([0.5, 0.5, 1, 0.5, 1]))
    assert tree["pixel_accuracy"] == round(7 / 11, 5)
    assert tree["swaps"] == {"left_right": round(1 / 11, 5), "front_back": round(1 / 11, 5), "both": round(1 / 11, 5)}
    assert tree["over_images"] == {
        "mean": round(np.mean([2 / 3, 0.5, 1]), 5),
        "sd": round(np.std([2 / 3, 0.5, 1], ddof=1), 5),
    }
    assert tree["classes"][7]["accuracy"] == 0.5 and tree["classes"][7]["sd_over_images"] is None
    assert tree["classes"][20]["accuracy"] is None
    assert tree["worst_images"][0] == {"key": "hard-7", "average_per_class_accuracy": 0.5}
    assert tree["risk_coverage"]["risk"][-1] == round(4 / 11, 5)
    assert tree["confidence"]["ece"] == round(4 / 11, 5), "sure of everything"
    assert tree["thresholds"][0]["share_of_pixels"] == 1
    assert np.array(tree["confusion"]).sum() == 11


def test_charts_show_the_numbers_of_the_report() -> None:
    tree = report(by_hand())
    groups, classes = [tree, *tree["subsets"].values()], tree["classes"]
    upper, lower = draw_parts(tree).axes
    for axis, bars, dots in (
        (upper, groups, [(row["over_images"]["mean"], row["over_images"]["sd"]) for row in groups]),
        (lower, classes, [(row["mean_over_images"], row["sd_over_images"]) for row in classes]),
    ):
        name = "average_per_class_accuracy" if axis is upper else "accuracy"
        assert [bar.get_width() for bar in axis.patches] == [row[name] or 0 for row in bars]
        known = [(y, mean, sd or 0) for y, (mean, sd) in enumerate(dots) if mean is not None]
        (spreads,), middles = axis.collections, axis.lines[0]
        assert list(zip(middles.get_ydata(), middles.get_xdata(), strict=True)) == [(y, mean) for y, mean, _ in known]
        expected = [[(max(mean - sd, 0), y), (min(mean + sd, 1), y)] for y, mean, sd in known]
        np.testing.assert_allclose(spreads.get_segments(), expected)
        assert axis.yaxis.get_inverted()
    confusion = draw_confusion(tree).axes[0]
    shares = np.array(tree["confusion"]) / np.maximum(np.sum(tree["confusion"], axis=1, keepdims=True), 1)
    np.testing.assert_array_equal(confusion.images[0].get_array(), shares)
    texts = {(text.get_position()[::-1], text.get_text()) for text in confusion.texts}
    assert texts == {((row, column), f"{100 * shares[row, column]:.0f}") for row, column in np.argwhere(shares)}
    sides = np.isin(kinds_of(PARTS33), KINDS.index("left/right"))
    borders = [((r + r2) / 2, (c + c2) / 2) for r, c, r2, c2 in _between(sides)]
    middles = np.mean(confusion.collections[1].get_segments(), axis=1)[:, ::-1]
    assert sorted(map(tuple, middles.tolist())) == sorted(borders)
    curve, reliability = draw_confidence(tree).axes
    np.testing.assert_array_equal(curve.lines[0].get_ydata(), tree["risk_coverage"]["risk"])
    kept = tree["confidence"]["above_70_percent"]
    assert (curve.lines[1].get_xdata()[0], curve.lines[1].get_ydata()[0]) == (1, 1 - kept["pixel_accuracy"])
    assert [line.get_ydata()[0] for line in reliability.lines if len(line.get_xdata()) == 1] == [round(7 / 11, 5)]


def _between(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int, int, int]]:
    """Neighbours of which one is in the mask: rows and columns of both."""
    around = np.pad(mask, 1)
    for row, column in np.ndindex(around.shape):
        for end in ((row + 1, column), (row, column + 1)):
            if max(end) < len(around) and around[row, column] != around[end]:
                yield row - 1, column - 1, end[0] - 1, end[1] - 1


def test_a_picture_tells_mistakes_and_what_is_dropped() -> None:
    image = seen_image("A", [0, 0, 4, 4, BACKGROUND, 3], [0, 1, 5, 4, BACKGROUND, 3])
    image = image._replace(confidence=np.array([[0.9, 0.8, 0.7, 0.2, 0.0, 0.9]], np.float32))
    assert _caption(0.5, image, PARTS33) == (
        "A-0. Average per-class accuracy 50.0 %; 75.0 % among the 60 % of pixels above 70 %"
    )
    mistakes, _, confident = _panels(image, PARTS33)[3:]
    assert mistakes[0].tolist() == [list(each) for each in (_RIGHT, _SWAPPED, _SWAPPED, _RIGHT, EMPTY, _RIGHT)]
    shown = [colour_labels(np.array([[label]], np.uint8))[0, 0].tolist() for label in (0, 1, 3)]
    assert confident[0].tolist() == [shown[0], shown[1], list(_DROPPED), list(_DROPPED), list(EMPTY), shown[2]]


def test_scores_stay_small() -> None:
    """As many bytes after many pixels as before."""
    scores = Scores()

    def size() -> int:
        assert scores.confidences is not None
        counts = scores.confidences
        return sum(array.nbytes for array in (scores.confusion.counts, counts.counts, counts.sums, counts.by_class))

    before = size()
    scores.add(seen_image("A", [0, 1] * 50_000, [0, 2] * 50_000))
    assert scores.confusion.pixels == 100_000
    assert size() == before < 200_000


def test_the_picture_keeps_the_first_of_each_subset_and_the_worst(
    small_set: Path, network: ByRange, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "predict", at_once)
    picture = SamplePicture()
    seen: list[tuple[float, str, str]] = []

    def watch(one: PredictedImage, accuracy: float) -> None:
        picture.watch(one, accuracy)
        seen.append((accuracy, one.subset, one.key))

    evaluate(network, open_images(str(small_set)), watch=watch, confidences=False)
    first = {subset: key for _, subset, key in reversed(seen)}
    assert {name: one.key for name, (_, one) in picture._first.items()} == first
    assert picture._worst is not None and picture._worst[1].key == min(seen)[2]
    drawn = picture.draw()
    assert drawn is not None and drawn.width > 900
    assert len(set(drawn.convert("P").resize((300, 300)).tobytes())) > 100


def test_frames_are_timed_one_by_one(network: ByRange, monkeypatch: pytest.MonkeyPatch) -> None:
    # Three frames untimed, then 10, 20 and 60 ms.
    ticks = iter([0, 9, 0, 9, 0, 9, 0, 0.010, 0, 0.020, 0, 0.060])
    monkeypatch.setattr(evaluation.time, "perf_counter", lambda: next(ticks))
    asked: list[tuple[int, ...]] = []
    monkeypatch.setattr(
        evaluation, "predict", lambda _, frame: (asked.append(tuple(frame.shape)), predict(network, frame))[1]
    )
    frames = [torch.full((1, 1, 4, size), 2.0) for size in (5, 6, 7)]
    times = time_frames(network, frames)
    deviation = pytest.approx(np.std([10, 20, 60], ddof=1), abs=0.005)
    expected = {"mean": 30, "deviation": deviation, "median": 20, "frames": 3, "threads": torch.get_num_threads()}
    assert times == {**expected, "device": "processor"}
    assert asked == [(1, 1, 4, 5), (1, 1, 4, 6), (1, 1, 4, 7)] * 2
    with pytest.raises(BadConfig, match="at least one frame"):
        time_frames(network, [])


def call(*words: object) -> int:
    return cli.main(["evaluate", *map(str, words)])


def test_the_command_writes_scores(
    figures_set: Path, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scores.json"
    words = ["--run", run_folder, "--data", figures_set, "--json", out, "--frames", 2, "--num-workers", 0]
    assert call(*words) == 0
    assert "8 images: average per-class accuracy " in capsys.readouterr().err
    tree = json.loads(out.read_text())
    assert tree["card"]["seed"] == 3 and tree["run"] == "tiny"
    assert tree["command"].startswith("bodyseg evaluate --data shards --json scores.json --run tiny")
    assert str(tmp_path) not in out.read_text(), "no path of this machine is written"
    assert (tree["images"], tree["data"][0]["evaluated"], tree["data"][0]["name"]) == (8, 8, "shards")
    assert tree["milliseconds_per_frame"]["frames"] == 2
    assert {"A", "people"} == set(tree["subsets"])

    again = tmp_path / "again.json"
    assert call(*words[:4], "--json", again, "--frames", 0, "--num-workers", 0, "--batch-size", 3) == 0
    other = json.loads(again.read_text())
    assert other["milliseconds_per_frame"] is None
    assert {name: other[name] for name in ("classes", "confusion", "thresholds")} == {
        name: tree[name] for name in ("classes", "confusion", "thresholds")
    }


def test_several_sets_are_one_evaluation_unless_they_share_samples(
    figures_set: Path, run_folder: Path, tmp_path: Path, capsys: Any
) -> None:
    out = tmp_path / "scores.json"
    common = ("--run", run_folder, "--json", out, "--frames", 0, "--num-workers", 0, "--images", 3)
    halves = [figures_set / "test-00000.tar", figures_set / "test-00001.tar"]
    assert call(*common, "--data", *halves) == 0
    tree = json.loads(out.read_text())
    assert [described["evaluated"] for described in tree["data"]] == [3, 3]
    assert tree["images"] == 6
    out.unlink()
    copy = shutil.copytree(figures_set, tmp_path / "copy")
    assert call(*common, "--data", figures_set, copy) == 2
    assert "a sample counts once: open-A-A-2-d215-a000" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--run", "nowhere"], "found nowhere"),
        (["--run", "nowhere.safetensors"], "found nowhere.safetensors, which is not there"),
        (["--images", "0"], "--images must be at least 1, found 0"),
        (["--frames", "-1"], "--frames must be at least 0, found -1"),
        (["--threads", "0"], "--threads must be a whole number from 1 to 1024, found 0"),
        (["--threads", "100000"], "--threads must be a whole number from 1 to 1024, found 100000"),
        (["--batch-size", "0"], "batch_size must be a whole number of at least 1, found 0"),
        (["--device", "abacus"], "cannot compute on the device 'abacus'"),
        (["--variant", "none", "--noise-mm", "5"], "a strength of noise is for a variant that has noise"),
        (["--missing", "2"], "MissingData: rates must be from 0 to 1"),
        (["--artifacts", "{"], "--artifacts must be JSON, found '{'"),
        (["--variant", "noise", "--artifacts", '{"losses": {"most": 0.5}}'], "for a variant that has missing_data"),
        (["--seed", "-1"], "a seed must be a whole number from 0"),
        (["--json", "no/folder/x.json"], "--json needs a file in a folder that is there"),
        (["--figures", "file"], "--figures needs a file in a folder that is there, found file"),
        (["--json", "name", "--figures", "name"], "--json needs another name than the folder --figures, found name"),
    ],
)
def test_one_line_says_what_is_wrong(
    figures_set: Path,
    run_folder: Path,
    tmp_path: Path,
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    usual = {"--run": run_folder, "--data": figures_set, "--json": "x.json", "--num-workers": 0}
    usual |= {"--figures": "drawn"} if words[0] == "--batch-size" else {}
    usual |= dict(zip(words[::2], words[1::2], strict=True))
    assert call(*(word for pair in usual.items() for word in pair)) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not Path("x.json").exists() and not Path("drawn").exists()


def test_a_set_without_the_split_is_refused(
    figures_set: Path, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    only_train = f"{figures_set}/train-*.tar"
    assert call("--run", run_folder, "--data", only_train, "--json", tmp_path / "x.json") == 2
    assert "has no sample of split 'test'" in capsys.readouterr().err


def test_an_interrupted_evaluation_leaves_no_file(
    figures_set: Path, run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def interrupt(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return at_once(*arguments)

    monkeypatch.setattr(evaluation, "predict", interrupt)
    words = ("--run", run_folder, "--data", figures_set, "--json", tmp_path / "x.json")
    assert call(*words, "--num-workers", 0, "--batch-size", 2) == 130
    assert list(tmp_path.iterdir()) == []


def test_without_a_run_the_network_that_ships_is_judged(
    figures_set: Path, run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtimes, "load_network", lambda run: load_network(run or run_folder))
    assert call("--data", figures_set, "--json", tmp_path / "x.json", "--frames", 0, "--num-workers", 0) == 0
    assert json.loads((tmp_path / "x.json").read_text())["run"] is None
