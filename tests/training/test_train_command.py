"""`bodyseg train` with images held out: what it logs, and that a killed one resumes."""

from __future__ import annotations

import hashlib
import json
import time
from multiprocessing import get_context
from pathlib import Path

import pytest
import torch
from small_training import TINY, log, written

from bodyseg_model.commands import main
from bodyseg_model.commands.train import reporting
from bodyseg_model.networks import CardWords, Trained, load_network
from bodyseg_model.networks.compact import Compact
from bodyseg_model.training import Metrics

VALIDATED = ["--val-share", "0.5", "--val-every", "2", "--val-images", "3"]


def command(data: Path, out: Path, *more: str) -> list[str]:
    words = ["train", "--data", str(data), "--out", str(out), "--batch-size", "2"]
    if "--settings" not in more:
        words += ["--settings", json.dumps(TINY)]
    return [*words, "--num-workers", "0", "--log-every", "1", "--threads", "1", "--device", "cpu", *more]


def test_a_killed_training_carries_on(small_set: Path, tmp_path: Path) -> None:
    """With images held out and averages, so that all that a training may keep is kept, and a worker that loads."""
    more = [*VALIDATED, "--ema", "0.9", "--steps", "6", "--checkpoint-every", "1"]
    more += ["--num-workers", "1"]
    assert main(command(small_set, tmp_path / "whole", *more)) == 0
    process = get_context("fork").Process(target=main, args=(command(small_set, tmp_path / "cut", *more),))
    process.start()
    deadline = time.monotonic() + 100
    while not (tmp_path / "cut" / "best.json").exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    process.kill()
    process.join()
    assert main(command(small_set, tmp_path / "cut", *more, "--resume")) == 0
    whole, cut = written(tmp_path / "whole"), written(tmp_path / "cut")
    assert whole.keys() == cut.keys() == {"best.json", "best.safetensors", "network.json", "network.safetensors"}
    for name in ("best.safetensors", "network.safetensors"):
        assert whole[name] == cut[name]


def test_scores_reach_the_log_the_progress_line_and_tensorboard(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    assert main(command(small_set, tmp_path, *VALIDATED, "--steps", "3")) == 0
    lines = log(tmp_path)
    assert ["val_accuracy" in line for line in lines] == [False, True, True]
    shown = f"validation per class {lines[2]['val_accuracy']:.1%} (best in step {lines[2]['val_best_step']})"
    said = capsys.readouterr().err
    assert shown in said
    best = max(lines[1:], key=lambda line: float(line["val_accuracy"]))
    assert said.endswith(
        f"the network has the weights of step {best['step']} of 3: validation per class {best['val_accuracy']:.1%}\n"
    )
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    for name in ("val_accuracy", "val_pixel_accuracy"):
        found = [(event.step, event.value) for event in events.Scalars(name)]
        assert found == [(line["step"], pytest.approx(line[name])) for line in lines[1:]]
    plan = json.loads((tmp_path / "run.json").read_text())
    assert plan["data"]["val_share"] == plan["validation"]["data"][0]["val_share"] == 0.5
    assert (plan["data"]["split"], plan["validation"]["data"][0]["split"]) == ("train", "val")
    assert plan["sensor"]["artifacts"] == plan["data"]["artifacts"]


def test_a_variant_that_a_sensor_has_nothing_for_is_said(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = "sensor kinect_v2 has no artifact of variant occ: images stay clean\n"
    for sensors, variant, count in (
        (["paper", "kinect_v2"], "occ", 1),
        (["paper"], "occ", 0),
        (["kinect_v2"], "none", 0),
    ):
        words = ["--steps", "1", "--sensor", *sensors, "--variant", variant]
        assert main(command(small_set, tmp_path / f"{len(sensors)}{variant}", *words)) == 0
        assert capsys.readouterr().err.count(line) == count


def test_each_set_may_have_a_variant_of_its_own(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*VALIDATED, "--steps", "1", "--data", str(small_set), "--noise-mm", "20"]
    assert main(command(small_set, tmp_path / "run", *words, "--variant", "all", "none")) == 0
    plan = json.loads((tmp_path / "run" / "run.json").read_text())
    assert plan["variant"] == "all, none"
    noisy, clean = plan["data"]["mixture"]
    assert (noisy["variant"], noisy["artifacts"][1]["high_mm"]) == ("all", 20)
    assert (clean["variant"], clean["artifacts"][1]["high_mm"]) == ("none", 100)
    for variants, message in (
        (["all", "none", "md"], "--variant needs one for all sets or one for each, 2, found 3"),
        (["md", "none"], "a strength of noise is for a variant that has noise, found variant 'md'"),
    ):
        capsys.readouterr()
        assert main(command(small_set, tmp_path / "bad", *words, "--variant", *variants)) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--val-every", "5"], "--val-every is for a training with images to validate on: give --val-share, like 0.1"),
        (["--val-images", "5"], "--val-images is for a training with images to validate on"),
        (["--keep", "best"], "--keep is for a training with images to validate on"),
        (["--val-share", "0.5", "--val-every", "0"], "Validation: every must be at least 1, found 0"),
        (["--remnants", "-0.1"], "Remnants: share must be from 0 to 1, found -0.1"),
        (["--ema", "1"], "ema must be from 0 to 0.999999, found 1.0"),
    ],
)
def test_bad_options_get_one_line(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert main(command(small_set, tmp_path / "run", *words)) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_remnants_are_of_training_images_alone(small_set: Path, tmp_path: Path) -> None:
    assert main(command(small_set, tmp_path, *VALIDATED, "--steps", "2", "--remnants", "0.5")) == 0
    plan = json.loads((tmp_path / "run.json").read_text())
    (transform,) = plan["data"]["transforms"]
    assert (transform["name"], transform["share"]) == ("remnants", 0.5)
    assert "remnants" not in json.dumps(plan["validation"])


def parameters(trained: Trained) -> dict[str, torch.Tensor]:
    return dict(trained.network.named_parameters())


@pytest.fixture
def earlier(small_set: Path, tmp_path: Path) -> Path:
    """A run of one step."""
    assert main(command(small_set, tmp_path / "earlier", "--steps", "1", "--seed", "5")) == 0
    return tmp_path / "earlier"


@pytest.mark.parametrize("ended", [True, False])
def test_a_training_starts_from_the_weights_of_another(
    small_set: Path, tmp_path: Path, earlier: Path, ended: bool
) -> None:
    """With a learning rate near 0, a network keeps the parameters that it starts from."""
    if not ended:
        (earlier / "network.safetensors").unlink()
        (earlier / "network.json").unlink()
    file = earlier / ("network.safetensors" if ended else "checkpoint-00000001.safetensors")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    before = parameters(load_network(earlier))
    for path in [earlier, *([file] if ended else [])]:
        out = tmp_path / "later" / path.name
        more = ["--steps", "1", "--lr", "1e-9", "--seed", "6", "--pretrained", str(path)]
        assert main(command(small_set, out, *more)) == 0
        trained = load_network(out)
        assert trained.card["pretrained"] == {"file": path.name, CardWords.WEIGHTS_SHA256: digest}
        for name, weight in parameters(trained).items():
            torch.testing.assert_close(weight, before[name], atol=1e-7, rtol=0)
    assert main(command(small_set, tmp_path / "other", *more[:-2])) == 0
    other = load_network(tmp_path / "other")
    assert other.card["pretrained"] is None
    assert (parameters(other)["head.weight"] - before["head.weight"]).abs().max() > 0.01


def test_published_weights_are_named_with_their_digest(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []
    monkeypatch.setattr(Compact, "load_pretrained", lambda network, path: read.append(path))
    file = tmp_path / "weights.onnx"
    file.write_bytes(b"published")
    assert main(command(small_set, tmp_path / "run", "--steps", "1", "--pretrained", str(file))) == 0
    assert read == [file]
    digest = hashlib.sha256(b"published").hexdigest()
    assert load_network(tmp_path / "run").card["pretrained"] == {
        "file": "weights.onnx",
        CardWords.WEIGHTS_SHA256: digest,
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--network", "fcn_alexnet", "--settings", "{}"],
            "the network 'fcn_alexnet' of this training, found 'compact'",
        ),
        (
            ["--settings", '{"patch": 8, "widths": [8], "blocks": [1]}'],
            "the setting patch 8 of this training, found 16",
        ),
    ],
)
def test_weights_of_another_network_are_refused(
    small_set: Path, tmp_path: Path, earlier: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    capsys.readouterr()
    assert main(command(small_set, tmp_path / "run", *words, "--pretrained", str(earlier))) == 2
    assert capsys.readouterr().err == f"bodyseg train: --pretrained {earlier} must have {message}\n"
    assert not (tmp_path / "run").exists()


def test_a_training_of_other_classes_keeps_all_but_the_last_layer(
    small_set: Path, tmp_path: Path, earlier: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = tmp_path / "few.toml"
    few.write_text('format = "bodyseg labels 1"\nname = "parts33"\n[classes]\nhead = ["Sellion"]\n')
    for labels, last in ((str(few), 1), ("limbs14", 14)):
        capsys.readouterr()
        out = tmp_path / f"of{last}"
        more = ["--steps", "1", "--lr", "1e-9", "--seed", "6", "--labels", labels, "--pretrained", str(earlier)]
        assert main(command(small_set, out, *more)) == 0
        told = f"{earlier} has other classes, 'parts33': head.weight, head.bias begin at random\n"
        assert told in capsys.readouterr().err
        assert load_network(out).network.classes == last
        before, after = (parameters(load_network(run)) for run in (earlier, out))
        for name in after.keys() - {"head.weight", "head.bias"}:
            torch.testing.assert_close(after[name], before[name], atol=1e-7, rtol=0)


@pytest.mark.parametrize(("wait", "advised"), [(0.15, False), (0.25, True)])
def test_advice_is_for_a_fifth_of_waiting_however_often_lines_come(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wait: float, advised: bool
) -> None:
    with reporting(tmp_path, 40, 20) as report:
        for step in range(5, 45, 5):  # each validated
            report(Metrics(step, 1.0, 0.5, 0.5, 1e-3, 10.0, wait, "decode"))
    said = capsys.readouterr().err
    assert f", waited {wait:.0%} for data (decode), 0 s left" in said
    assert ("waited for data, mostly for decode" in said) is advised


def test_settings_are_those_of_the_network_that_a_training_starts_from(small_set: Path, tmp_path: Path) -> None:
    wider = '{"patch": 8, "widths": [6, 8], "blocks": [1, 1]}'
    assert main(command(small_set, tmp_path / "wide", "--steps", "1", "--settings", wider)) == 0
    again = [word for word in command(small_set, tmp_path / "again", "--steps", "1") if word != "--settings"]
    again.remove(json.dumps(TINY))
    assert main([*again, "--pretrained", str(tmp_path / "wide")]) == 0
    assert load_network(tmp_path / "again").network.settings == load_network(tmp_path / "wide").network.settings


def test_a_resumed_training_says_that_it_begins_anew(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(small_set, tmp_path / "mistyped", "--steps", "1", "--resume")) == 0
    begins = f"{tmp_path / 'mistyped'} has no checkpoint to resume: the training begins at its first step\n"
    assert begins in capsys.readouterr().err


def test_a_resumed_training_keeps_the_name_of_the_weights_that_it_started_from(
    small_set: Path, tmp_path: Path, earlier: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "later"
    assert main(command(small_set, out, "--steps", "1", "--pretrained", str(earlier))) == 0
    entry = load_network(out).card["pretrained"]
    assert entry["file"] == "earlier"
    more = ["--steps", "2", "--resume"]
    assert main(command(small_set, out, *more)) == 0
    assert "no checkpoint" not in capsys.readouterr().err
    assert load_network(out).card["pretrained"] == entry
    another = earlier.rename(tmp_path / "another")
    capsys.readouterr()
    assert main(command(small_set, out, *more, "--pretrained", str(another))) == 2
    assert 'pretrained.file was "earlier", now "another"' in capsys.readouterr().err
