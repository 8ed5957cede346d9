"""Training: what it learns, that it carries on with the same bits, and what it says when it cannot."""

from __future__ import annotations

import dataclasses
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BadConfig, Draws
from bodyseg_model.commands import main
from bodyseg_model.evaluation import ConfusionMatrix
from bodyseg_model.networks import build, load_network, predict, read_checkpoint
from bodyseg_model.training import GeometricAugmentation, Metrics, Recipe, RunFolder, RunOptions, Training, recipe_for
from bodyseg_model.training.distributed import ProcessGroup
from bodyseg_model.training.loop import Diverged
from bodyseg_model.training.loss import NetworkWithLoss, class_pixels

ONE = ProcessGroup(0, 1, torch.device("cpu"))
TINY = {"patch": 16, "widths": [12, 16], "blocks": [1, 1]}
SGD = Recipe(
    steps=5,
    batch_size=2,
    accumulate=2,
    optimiser="sgd",
    learning_rate=1e-2,
    layer_decay=0.01,
    momentum=0.9,
    weight_decay=5e-4,
    warmup=0.2,
    cosine=True,
    clip=1.0,
    mirror=True,
    balance=0.5,
    bf16=False,
    loss_stride=1,
    geometric_augmentation=GeometricAugmentation(roll_deg=20, zoom=0.2, stretch=0.1, cut=0.5),
)


def train(
    data: Path,
    out: Path,
    recipe: Recipe = SGD,
    resume: bool = False,
    run_options: RunOptions | None = None,
    report: Callable[[Metrics], None] | None = None,
    **options: Any,
) -> list[Metrics]:
    torch.manual_seed(3)
    network = options.pop("network", None) or build("compact", options.pop("settings", TINY))
    images = RangeImages(data, options.pop("variant", "all"), "train", seed=options.get("seed", 0))
    said: list[Metrics] = []
    made = Training(
        network,
        "compact",
        images,
        recipe,
        RunFolder(out),
        ONE,
        run_options=run_options or RunOptions(2, 2, 0),
        **options,
    )
    made.run(resume, report or said.append, {"commit": "none"})
    return said


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name.startswith("network")}


def test_a_steps_gradient_is_no_larger_than_clip(small_set: Path, tmp_path: Path) -> None:
    before = build("compact", TINY, 0)
    changes = {"steps": 1, "warmup": 0.0, "weight_decay": 0.0, "layer_decay": 1.0}
    for clip in (0.0, 1e-2):
        recipe = dataclasses.replace(SGD, clip=clip, **changes)  # type: ignore[arg-type]  # of several types
        train(small_set, tmp_path / str(clip), recipe, network=build("compact", TINY, 0))
        after = dict(load_network(tmp_path / str(clip)).network.named_parameters())
        moved = [(after[name] - weight).detach().square().sum() for name, weight in before.named_parameters()]
        size = float(sum(moved)) ** 0.5 / 1e-2  # over the learning rate
        assert size == pytest.approx(clip, rel=0.01) if clip else size > 0.1


def test_bodies_are_learned(small_set: Path, tmp_path: Path) -> None:
    changes = {
        "steps": 40,
        "batch_size": 4,
        "learning_rate": 3e-2,
        "mirror": False,
        "bf16": False,  # several times slower on processors without instructions for it
        "geometric_augmentation": GeometricAugmentation(),
    }
    torch.manual_seed(3)
    network = build("compact", {"patch": 8, "widths": [32], "blocks": [1]})
    images = RangeImages(small_set, "occ", "train")
    run_options = RunOptions(100, 1000, 0)
    Training(
        network,
        "compact",
        images,
        recipe_for("compact", **changes),
        RunFolder(tmp_path / "run"),
        ONE,
        run_options=run_options,
    ).run(False, lambda figures: None, {})
    trained = load_network(tmp_path / "run")
    matrix = ConfusionMatrix()
    for index in range(len(images)):
        image = images.image(index)
        range_m = torch.from_numpy(image.range.astype("float32") * images.step_m)[None, None]
        matrix.add(image.labels, predict(trained.network, range_m).labels[0].numpy())
    assert matrix.average_per_class_accuracy() > 0.65  # of 33 classes: 0.03 without learning
    assert trained.card["variant"] == "occ"


def test_steps_are_those_of_plain_sgd_on_mean_gradients(small_set: Path, tmp_path: Path) -> None:
    """Gradients of the batches of a step are averaged, not summed; momentum and weight decay are Caffe's."""
    rate, momentum, decay, steps = 0.05, 0.9, 0.01, 3
    recipe = Recipe(
        steps=steps, batch_size=2, accumulate=3, optimiser="sgd", learning_rate=rate, layer_decay=1.0,
        momentum=momentum, weight_decay=decay, warmup=0.0, cosine=False, clip=0.0, mirror=False, balance=0.0,
        bf16=False, loss_stride=1,
    )  # fmt: skip
    train(small_set, tmp_path / "run", recipe)
    torch.manual_seed(3)
    network = build("compact", TINY).train()
    weights = list(network.parameters())
    velocities = [torch.zeros_like(weight) for weight in weights]
    objective = NetworkWithLoss(network, torch.ones(33))
    data = loader(RangeImages(small_set, "all", "train"), 2, drop_last=True)
    batches = (batch for _ in range(9) for batch in data)
    for step in range(steps):
        losses = []
        for number in range(3):
            batch = next(batches)
            pixels = torch.from_numpy(Draws(0, step, "").generator(f"pixels {number}").random(2, np.float32))
            losses.append(objective(batch["range"], batch["labels"], pixels).loss)
        gradients = torch.autograd.grad(torch.stack(losses).mean(), weights)
        with torch.no_grad():
            for weight, velocity, gradient in zip(weights, velocities, gradients, strict=True):
                velocity.copy_(momentum * velocity + gradient + decay * weight)
                weight -= rate * velocity
    found = dict(load_network(tmp_path / "run").network.named_parameters())
    for name, weight in network.named_parameters():
        torch.testing.assert_close(found[name], weight, atol=2e-5, rtol=1e-3, msg=lambda text, name=name: name + text)


@pytest.mark.parametrize(("optimiser", "shuffle"), [("sgd", "global"), ("adamw", "blocks"), ("muon", "global")])
def test_a_training_carries_on_with_the_same_bits(
    small_set: Path, tmp_path: Path, optimiser: Any, shuffle: Any
) -> None:
    recipe = dataclasses.replace(SGD, optimiser=optimiser, bf16=optimiser != "sgd", shuffle=shuffle)
    train(small_set, tmp_path / "whole", recipe)
    cut = tmp_path / "cut"

    class CutError(Exception):
        pass

    def stop(figures: Metrics) -> None:
        if figures.step == 4:
            raise CutError  # after the checkpoint of step 2, before that of step 4

    torch.manual_seed(3)
    images = RangeImages(small_set, "all", "train")
    made = Training(
        build("compact", TINY), "compact", images, recipe, RunFolder(cut), ONE, run_options=RunOptions(2, 2, 0)
    )
    with pytest.raises(CutError):
        made.run(False, stop, {})
    assert json.loads((cut / "checkpoint.json").read_text())["step"] == 2
    train(small_set, cut, recipe, resume=True, network=build("compact", TINY))
    assert files(cut) == files(tmp_path / "whole")
    steps = [json.loads(line)["step"] for line in (cut / "log.jsonl").read_text().splitlines()]
    assert steps == [2, 4, 5]


@pytest.mark.parametrize(("signals", "kept"), [((signal.SIGINT,), 3), ((signal.SIGTERM, signal.SIGINT), 2)])
def test_a_signal_ends_a_training_after_the_step_with_a_checkpoint_and_a_second_one_at_once(
    small_set: Path, tmp_path: Path, signals: tuple[signal.Signals, ...], kept: int
) -> None:
    """A stopped training loses no step, and carries on to the same bits."""

    def stop(figures: Metrics) -> None:
        if figures.step == 3:
            for number in signals:
                signal.raise_signal(number)

    def cut() -> None:
        before = {number: signal.signal(number, signal.default_int_handler) for number in signals}
        try:
            train(small_set, tmp_path / "cut", report=stop, run_options=RunOptions(1, 2, 0))
        finally:
            for number, action in before.items():
                signal.signal(number, action)

    train(small_set, tmp_path / "whole", run_options=RunOptions(1, 2, 0))
    with pytest.raises(KeyboardInterrupt):
        cut()
    assert json.loads((tmp_path / "cut" / "checkpoint.json").read_text())["step"] == kept
    train(small_set, tmp_path / "cut", resume=True, run_options=RunOptions(1, 2, 0))
    assert files(tmp_path / "cut") == files(tmp_path / "whole")


def test_dropout_carries_on_too(small_set: Path, tmp_path: Path) -> None:
    """The paper's network draws while it learns; what was drawn elsewhere must not matter."""
    recipe = dataclasses.replace(SGD, steps=2, batch_size=1, accumulate=1)

    def go(name: str, resume: bool, until: int) -> None:
        torch.manual_seed(1)
        network = build("fcn_alexnet", {"width": 1 / 16})
        torch.manual_seed(until)
        images = RangeImages(small_set, "all", "train")
        folder = RunFolder(tmp_path / name)
        made = Training(network, "fcn_alexnet", images, recipe, folder, ONE, run_options=RunOptions(1, 1, 0))

        def stop(figures: Metrics) -> None:
            if figures.step > until:
                raise KeyboardInterrupt

        made.run(resume, stop, {})

    go("whole", False, 2)
    with pytest.raises(KeyboardInterrupt):
        go("cut", False, 1)
    go("cut", True, 3)
    assert files(tmp_path / "cut") == files(tmp_path / "whole")


def test_what_does_not_shape_the_result_may_change(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path / "a", run_options=RunOptions(1, 1, 0))
    train(small_set, tmp_path / "b", run_options=RunOptions(5, 100, 2))
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_a_loss_that_is_no_number_stops_with_step_and_samples(small_set: Path, tmp_path: Path) -> None:
    network = build("compact", TINY)
    with torch.no_grad():
        network.get_parameter("head.bias")[4] = float("nan")
    with pytest.raises(Diverged, match=r"the loss is nan in step 1, with the samples \S+, \S+"):
        train(small_set, tmp_path / "run", network=network)
    assert not (tmp_path / "run" / "network.safetensors").exists()
    assert not (tmp_path / "run" / "checkpoint.json").exists()


def test_another_training_is_not_overwritten(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path / "run")
    before = files(tmp_path / "run")
    with pytest.raises(BadConfig, match="holds this training already: --resume carries it on"):
        train(small_set, tmp_path / "run")
    with pytest.raises(BadConfig, match="holds another training: seed was 0, now 1"):
        train(small_set, tmp_path / "run", resume=True, seed=1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    with pytest.raises(BadConfig, match="holds files but no training"):
        train(small_set, tmp_path / "full")
    (tmp_path / "full" / "letter.txt").unlink()
    (tmp_path / "full" / "run.json").write_text('{"of": "another program"}')
    with pytest.raises(BadConfig, match="holds files but no training"):
        train(small_set, tmp_path / "full")
    assert (tmp_path / "full" / "run.json").read_text() == '{"of": "another program"}'
    assert files(tmp_path / "run") == before


def test_the_order_of_samples_belongs_to_the_plan(small_set: Path, tmp_path: Path) -> None:
    words = ["train", "--data", str(small_set), "--settings", json.dumps(TINY), "--num-workers", "0", "--threads", "1"]
    words += ["--batch-size", "2", "--steps", "1", "--precision", "float32"]
    plans, orders = {}, []
    for shuffle in ("blocks", "global"):
        folder = RunFolder(tmp_path / shuffle)
        assert main([*words, "--out", str(folder.path), "--shuffle", shuffle]) == 0
        plans[shuffle] = folder.plan()
        (state,) = read_checkpoint(folder.path).loader_state["loaders"]  # type: ignore[union-attr]
        orders.append(state["shuffle"])
    assert orders == ["blocks", True]
    with pytest.raises(BadConfig, match='holds another training: recipe.shuffle was not given, now "blocks"$'):
        RunFolder(tmp_path / "global").begin(plans["blocks"], True)
    assert plans["blocks"]["recipe"].pop("shuffle") == "blocks"
    assert plans["blocks"] == plans["global"], "a plan from before there was a choice stays one of today's"
    with pytest.raises(BadConfig, match="shuffle must be 'global' or 'blocks', found 'block'"):
        recipe_for("compact", shuffle="block")


@pytest.mark.parametrize(
    ("has_it", "precision", "bf16"),
    [(True, "recipe", True), (False, "recipe", False), (False, "bfloat16", True), (True, "float32", False)],
)
def test_a_processor_that_must_emulate_bfloat16_trains_in_float32(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_it: bool, precision: str, bf16: bool
) -> None:
    monkeypatch.setattr("bodyseg_model.training.recipes.computes_bfloat16", lambda: has_it)
    assert recipe_for("compact", device="cpu").bf16 is has_it and recipe_for("compact", device="cpu", bf16=True).bf16
    words = ["train", "--data", str(small_set), "--settings", json.dumps(TINY), "--num-workers", "0", "--threads", "1"]
    words += ["--batch-size", "1", "--steps", "1", "--precision", precision, "--device", "cpu"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    assert RunFolder(tmp_path / "run").plan()["recipe"]["bf16"] is bf16


def test_a_damaged_checkpoint_is_refused(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path / "run")
    (file,) = (tmp_path / "run").glob("checkpoint-*.safetensors")
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    with pytest.raises(BadConfig, match="is damaged: SHA-256"):
        train(small_set, tmp_path / "run", resume=True)


def test_a_finished_training_stays_as_it_is(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path / "run")
    before = files(tmp_path / "run")
    assert train(small_set, tmp_path / "run", resume=True) == []
    assert files(tmp_path / "run") == before


def test_batches_must_be_shared_out_evenly(small_set: Path, tmp_path: Path) -> None:
    images = RangeImages(small_set, "all", "train")
    with pytest.raises(BadConfig, match="batch_size must be a multiple of the 3 processes, found 2"):
        Training(
            build("compact", TINY), "compact", images, SGD, RunFolder(tmp_path), ProcessGroup(0, 3, torch.device("cpu"))
        )


def test_a_batch_larger_than_the_set_is_refused(small_set: Path, tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match="they do not fill one batch of 64"):
        train(small_set, tmp_path / "run", dataclasses.replace(SGD, batch_size=64))


def test_weights_of_parts_come_from_clean_samples(small_set: Path) -> None:
    images = RangeImages(small_set, "all", "train")
    means = class_pixels(images)
    pixels = sum((images.clean(index).labels < 33).sum() for index in range(len(images)))
    np.testing.assert_allclose(means.sum() * len(images), pixels, rtol=1e-12)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--steps", "0"], "steps must be at least 1, found 0"),
        (["--lr", "nan"], "learning_rate must be from 1e-09 to 10, found nan"),
        (["--settings", "{"], "--settings is not JSON"),
        (["--settings", "[]"], "--settings must hold a JSON object"),
        (["--artifacts", "[]"], "--artifacts must be strengths by artifact"),
        (["--variant", "md", "--noise-mm", "5"], "a strength of noise is for a variant that has noise, found variant"),
        (["--losses", "0.2", "--artifacts", '{"losses": {}}'], "an artifact may be given once, found losses twice"),
        (["--threads", "0"], "--threads must be a whole number from 1 to 1024, found 0"),
        (["--device", "cuda:77"], "cannot compute on the device 'cuda:77'"),
        (["--pretrained", "x.onnx"], "Compact starts from a run's folder or a .safetensors file, found x.onnx"),
        (["--log-every", "0"], "log_every must be at least 1, found 0"),
        (["--network", "unet"], "--network"),
    ],
)
def test_bad_arguments_get_one_line(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert main(["train", "--data", str(small_set), "--out", str(tmp_path / "run"), *words]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_tensorboard_gets_the_figures(small_set: Path, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    words = ["--data", str(small_set), "--out", str(tmp_path), "--settings", json.dumps(TINY), "--steps", "2"]
    assert main(["train", *words, "--batch-size", "2", "--num-workers", "0", "--log-every", "1"]) == 0
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    logged = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    for name in ("loss", "accuracy", "images_per_second", "data_wait"):
        assert [event.value for event in events.Scalars(name)] == pytest.approx([line[name] for line in logged])
