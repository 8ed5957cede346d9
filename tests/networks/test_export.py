"""`bodyseg export`, as its users call it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
import torch

from bodyseg_model.commands import main
from bodyseg_model.networks import build, load_network, save_network


@pytest.fixture
def run(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    network = build("compact", {"patch": 16, "widths": [16], "blocks": [1]}).eval()
    (tmp_path / "run").mkdir()
    save_network(tmp_path / "run" / "network.safetensors", network, "compact", {"variant": "all", "seed": 7})
    return tmp_path / "run"


def test_an_exported_network_is_smaller_and_says_what_it_is(run: Path, tmp_path: Path) -> None:
    scores = tmp_path / "scores.json"
    of = {"weights_sha256": load_network(run).card["weights_sha256"]}
    scores.write_text(json.dumps({"card": of, "accuracy": 0.5, "confusion": [[3, 1], [0, 2]]}))
    out = tmp_path / "given.safetensors"
    assert main(["export", "--run", str(run), "--out", str(out), "--scores", str(scores)]) == 0
    given, kept = load_network(out), load_network(run)
    digest = hashlib.sha256(out.read_bytes()).hexdigest()
    assert given.card == {**kept.card, "scores": {"card": of, "accuracy": 0.5}, "weights_sha256": digest}
    assert json.loads((tmp_path / "given.confusion.json").read_text()) == {"confusion": [[3, 1], [0, 2]]}
    assert out.stat().st_size < 0.7 * (run / "network.safetensors").stat().st_size
    with torch.no_grad():
        range_m = torch.full((1, 1, 40, 40), 2.0)
        torch.testing.assert_close(given.network(range_m), kept.network(range_m), atol=5e-3, rtol=5e-3)
    assert main(["export", "--run", str(out), "--out", str(out)]) == 0
    assert (tmp_path / "given.confusion.json").exists(), "of the same network"
    assert main(["export", "--run", str(run), "--out", str(out)]) == 0
    assert not (tmp_path / "given.confusion.json").exists(), "of another network, without scores"


def test_bad_targets_get_one_line(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.json").write_text("[]")
    (run / "run.json").write_text("{}")
    weights = (run / "network.safetensors").read_bytes()
    (tmp_path / "other.json").write_text('{"card": {"weights_sha256": "of another network"}}')
    for words, message in (
        (["--out", str(tmp_path / "x.pth")], "--out must be a .safetensors file"),
        (
            ["--onnx", str(tmp_path / "x.onnx"), "--out", str(tmp_path / "absent" / "x.safetensors")],
            "--out needs a file in a folder that is there",
        ),
        (["--out", str(tmp_path / "x.safetensors"), "--scores", str(tmp_path / "bad.json")], "must hold a JSON object"),
        (["--out", str(tmp_path / "x.safetensors"), "--scores", str(tmp_path / "other.json")], "--scores must be what"),
        (["--out", str(run / "network.safetensors")], "--out must not replace the weights of a training"),
        (
            ["--out", str(tmp_path / "x.safetensors"), "--run", str(tmp_path / "no")],
            "a network is compact, large, finder, a run's folder or a .safetensors file, found",
        ),
    ):
        assert main(["export", "--run", str(run), *words]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
        assert not list(tmp_path.glob("x.*"))
    assert not json.loads((run / "network.json").read_text()).get("scores")
    assert (run / "network.safetensors").read_bytes() == weights


def test_scores_and_the_card_do_not_replace_each_other(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scores, card = tmp_path / "mine.json", (run / "network.json").read_bytes()
    scores.write_text(text := json.dumps({"card": json.loads(card), "accuracy": 0.5}))
    words = ["export", "--run", str(run), "--scores", str(scores), "--out", str(scores.with_suffix(".safetensors"))]
    assert main(words) == 2
    assert f"mine.safetensors has its card beside it: {scores}: the format must be" in capsys.readouterr().err
    assert scores.read_text() == text and not scores.with_suffix(".safetensors").exists()
    assert main(["evaluate", "--run", str(run), "--data", "absent", "--json", str(run / "network.json")]) == 2
    found = f"--json may replace earlier scores alone: found another file, {run / 'network.json'}"
    assert found in capsys.readouterr().err
    assert (run / "network.json").read_bytes() == card
    for other, found in ((text, f"found another file, {scores}"), ("# notes", f"{scores} is not JSON: ")):
        scores.write_text(other)  # as a manifest.json
        assert main(["evaluate", "--run", str(run), "--data", "absent", "--json", str(scores)]) == 2
        assert f"--json may replace earlier scores alone: {found}" in capsys.readouterr().err
        assert scores.read_text() == other
