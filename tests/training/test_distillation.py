"""Learning from a teacher: its probabilities at the pixels of a step, the loss, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from small_training import TINY, written

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.labels.label_map import PARTS33, load_label_map
from bodyseg_model.commands.cli import main
from bodyseg_model.networks.checkpoints import WEIGHTS_SHA256, load_network
from bodyseg_model.networks.compact import Compact, CompactSettings
from bodyseg_model.networks.network import Network
from bodyseg_model.training.objective.distillation import Teacher
from bodyseg_model.training.objective.loss import TEMPERATURE, NetworkWithLoss, divergence
from bodyseg_model.training.objective.selected_pixels import SelectedPixels


def small(seed: int) -> Compact:
    torch.manual_seed(seed)
    return Compact(CompactSettings(patch=8, widths=(4,), blocks=(0,))).eval()


def frames() -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(1)
    labels = torch.randint(0, 33, (2, 30, 21), generator=draw).to(torch.uint8)
    labels[torch.rand(labels.shape, generator=draw) < 0.4] = 255
    return torch.where(labels == 255, 0.0, 2.0 + labels / 100)[:, None], labels


class PixelTeacher(Network):
    """A teacher with scores of its own for every pixel."""

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        draw = torch.Generator().manual_seed(5)
        return torch.randn(len(range_m), 33, *range_m.shape[2:], generator=draw)


@pytest.mark.parametrize("network", [small(3), PixelTeacher()])
@pytest.mark.parametrize("stride", [1, 4, 8])
def test_a_teacher_is_asked_at_the_pixels_of_the_step(network: Network, stride: int) -> None:
    range_m, labels = frames()
    pixels = SelectedPixels.of(labels, min(2, stride - 1), stride - 1, stride)
    expected = (network(range_m)[pixels.image, :, pixels.row, pixels.column] / TEMPERATURE).log_softmax(1)
    found = Teacher(network, PARTS33, {})(range_m, pixels)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    assert not network.training and not found.requires_grad


def test_the_divergence_is_torchs() -> None:
    scores, other = torch.randn(20, 3), torch.randn(20, 3)
    taught = (other / TEMPERATURE).log_softmax(1)
    expected = F.kl_div((scores / TEMPERATURE).log_softmax(1), taught, reduction="none", log_target=True).sum(1)
    torch.testing.assert_close(divergence(scores, taught), TEMPERATURE**2 * expected)
    assert divergence(other, taught).abs().max() < 1e-5


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_the_loss_is_divided_between_labels_and_teacher(share: float) -> None:
    (range_m, labels), network, teacher = frames(), small(4), small(3)
    weights, offset = torch.rand(33) + 0.5, torch.tensor([0.6, 0.3])
    row, column = 2, 1
    found = NetworkWithLoss(network, weights, 4, teacher=Teacher(teacher, PARTS33, {}, share))(range_m, labels, offset)
    alone = NetworkWithLoss(network, weights, 4)(range_m, labels, offset)
    with torch.no_grad():
        ours, theirs = (each(range_m)[:, :, row::4, column::4] for each in (network, teacher))
    truth = labels[:, row::4, column::4].long()
    weight = torch.where(truth < 33, weights[truth.clamp(max=32)], 0.0)
    each = (
        weight
        * TEMPERATURE**2
        * F.kl_div(
            (ours / TEMPERATURE).log_softmax(1),
            (theirs / TEMPERATURE).log_softmax(1),
            reduction="none",
            log_target=True,
        ).sum(1)
    )
    taught = (each.sum((1, 2)) / weight.sum((1, 2))).mean()
    assert float(found.loss.detach()) == pytest.approx(
        (1 - share) * float(alone.loss.detach()) + share * float(taught), rel=1e-4
    )
    assert torch.equal(found.counts, alone.counts)
    found.loss.backward()
    assert all(weight.grad is None for weight in teacher.parameters())


def test_a_teacher_of_other_labels_or_without_a_share_is_refused() -> None:
    limbs = load_label_map("limbs14")
    with pytest.raises(BadConfig, match="the teacher must have the labels 'limbs14' of this training, found 'parts33'"):
        Teacher(small(1), PARTS33, {}).for_training(limbs, torch.device("cpu"))
    for share in (0.0, 1.5, float("nan")):
        with pytest.raises(BadConfig, match="share of the loss must be above 0 and at most 1"):
            Teacher(small(1), PARTS33, {}, share)


def test_the_command_learns_from_a_run(small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def command(out: str, *more: str) -> list[str]:
        words = ["train", "--data", str(small_set), "--out", str(tmp_path / out), "--settings", json.dumps(TINY)]
        return [*words, "--batch-size", "2", "--num-workers", "0", "--threads", "1", "--device", "cpu", *more]

    teacher = ["--teacher", str(tmp_path / "teacher")]
    assert main(command("teacher", "--steps", "1", "--seed", "3")) == 0
    assert main(command("taught", "--steps", "2", *teacher)) == 0
    assert main(command("alone", "--steps", "2")) == 0
    network, alone = "network.safetensors", written(tmp_path / "alone")
    assert written(tmp_path / "taught")[network] != alone[network]
    digest = load_network(tmp_path / "teacher").card[WEIGHTS_SHA256]
    entry = {"file": "teacher", WEIGHTS_SHA256: digest, "share": 0.5}
    assert load_network(tmp_path / "taught").card["teacher"] == entry
    assert "teacher" not in load_network(tmp_path / "alone").card

    assert main(command("taught", "--steps", "3", *teacher, "--resume")) == 0
    capsys.readouterr()
    for words, message in (
        (["--steps", "3", *teacher, "--teacher-share", "0.3", "--resume"], "--teacher-share was 0.5, now 0.3"),
        (["--steps", "3", "--resume"], "--teacher was given, now not given"),
        (["--teacher-share", "0.3"], "--teacher-share is for a training with --teacher"),
        ([*teacher, "--labels", "limbs14"], "the teacher must have the labels 'limbs14' of this training"),
        (["--teacher", str(tmp_path / "nobody")], "nobody"),
    ):
        assert main(command("taught", *words)) == 2
        said = capsys.readouterr().err
        assert message in said and said.count("\n") == 1
