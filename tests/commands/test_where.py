"""`--where` and `--split val` on the commands that read a set."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fakes import Figures
from small_rig import SMALL

from bodyseg_data import RangeImages
from bodyseg_data.bodies import SOURCES
from bodyseg_model.commands import main
from bodyseg_model.networks import build, save_network

SETTINGS = {"patch": 16, "widths": (8,), "blocks": (0,)}
WHERE = ["subset=A", "azimuth_deg=-100..90"]


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "tiny"
    folder.mkdir()
    facts = {"variant": "all", "rig": SMALL.to_json()}
    save_network(folder / "network.safetensors", build("compact", SETTINGS, 0), "compact", facts)
    return folder


def test_inspect_counts_a_part_of_a_set(figures_set: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(figures_set), "--json", "--where", *WHERE]) == 0
    counts = json.loads(capsys.readouterr().out)
    assert (counts["samples"], counts["subsets"], counts["splits"]) == (9, {"A": 9}, {"train": 6, "test": 3})
    words = ["inspect", str(figures_set), "--json", "--val-share", "0.3"]
    found = []
    for split in ("val", "train"):
        assert main([*words, "--split", split]) == 0
        found.append(json.loads(capsys.readouterr().out)["samples"])
    assert sum(found) == 16
    assert found[0] == len(RangeImages(figures_set, split="val", val_share=0.3))


def test_evaluation_on_val(
    figures_set: Path, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scores.json"
    words = ["evaluate", "--data", str(figures_set), "--run", str(run_folder), "--json", str(out), "--frames", "0"]
    words += ["--num-workers", "0", "--split", "val"]
    assert main([*words, "--val-share", "0.3", "--where", "azimuth_deg=0,80"]) == 0
    tree = json.loads(out.read_text())
    chosen = RangeImages(figures_set, split="val", val_share=0.3, where="azimuth_deg=0,80")
    assert tree["images"] == len(chosen) == 2
    assert (tree["split"], tree["val_share"], tree["where"]) == ("val", 0.3, ["azimuth_deg=0,80"])
    assert tree["data"][0]["digest"] == chosen.identity()["set"]
    assert tree["command"].endswith("--split val --val-share 0.3 --where azimuth_deg=0,80 --frames 0 --num-workers 0")
    out.unlink()
    capsys.readouterr()
    assert main(words) == 2
    assert (
        capsys.readouterr().err == "bodyseg evaluate: the split 'val' is a share of train: give val_share, like 0.1\n"
    )
    assert not out.exists()


def test_training_on_a_part_of_a_set_says_so_in_the_card(figures_set: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["train", "--data", str(figures_set), "--out", str(out), "--settings", json.dumps(SETTINGS), "--steps", "1"]
    words += ["--batch-size", "2", "--num-workers", "0", "--log-every", "1", "--device", "cpu"]
    assert main([*words, "--where", *WHERE]) == 0
    card = json.loads((out / "network.json").read_text())
    assert card["data"] == RangeImages(figures_set, split="train", where=WHERE).identity()


def test_stability_on_a_part_of_a_set(
    figures_set: Path, run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SOURCES, "open", Figures)
    out = tmp_path / "stability"
    words = ["stability", "--run", str(run_folder), "--data", str(figures_set), "--out", str(out)]
    words += ["--sweeps", "farther", "--images", "1", "--device", "cpu"]
    assert main([*words, "--where", "subset=people"]) == 0
    data = json.loads((out / "stability.json").read_text())["data"]
    chosen = RangeImages(figures_set, split="test", where="subset=people")
    assert (data["samples_of_split"], data["digest"]) == (4, chosen.identity()["set"])
