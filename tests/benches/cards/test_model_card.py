"""The page of a network for people."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path

import pytest
from benches.__main__ import main
from benches.cards.facts import Publication
from benches.cards.model_cards import model_card

from bodyseg_data.core import BadConfig
from bodyseg_model.networks import SHIPPED, confusion_file

PUBLICATION = Publication("Parts of people", date(2026, 1, 31), "Apache-2.0", "A. Author")


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """The shipped network's card beside a file that stands for its weights: the page needs no more."""
    path = tmp_path / "mine.safetensors"
    path.write_bytes(bytes(20_000))
    path.with_suffix(".json").write_bytes(SHIPPED.with_suffix(".json").read_bytes())
    return path


def test_a_page_tells_what_the_card_holds(weights: Path) -> None:
    card = json.loads(weights.with_suffix(".json").read_text())
    text = model_card(weights, PUBLICATION)
    assert text.startswith("---\nlicense: apache-2.0\nlibrary_name: bodyseg\n")
    for line in (
        "# Parts of people",
        "| architecture | `compact`, patch 16, widths [96, 128, 144], blocks [2, 2, 1], context yes, shrink 1 |",
        "| file | `mine.safetensors`, 0.02 MB |",
        f"| SHA-256 | `{card['weights_sha256']}` |",
        "| classes | the 33 parts |",
        f"| average per-class accuracy | {100 * card['scores']['average_per_class_accuracy']:.1f} % |",
        f"| subset B | {100 * card['scores']['subsets']['B']:.1f} % |",
        "Apache-2.0, published by A. Author, 2026-01-31.",
    ):
        assert f"{line}\n" in text
    second = card["data"]["mixture"][1]
    assert f"| set 2 | weight {second['weight']}, set {second['set']}, split train" in text
    assert "confusion" not in text
    assert max(map(len, text.splitlines())) < 700


def test_a_page_names_the_confusion_matrix_and_what_is_missing(weights: Path) -> None:
    file = weights.with_suffix(".json")
    card = json.loads(file.read_text())
    confusion_file(weights).write_text("{}")
    assert "pixels: `mine.confusion.json`." in model_card(weights, PUBLICATION)
    subset = {"average_per_class_accuracy": None}
    changes = {
        "scores": {"pixel_accuracy": 0.5, "subsets": {"A": subset}},
        "labels": {"name": "six"},
        "data": {"set": "x"},
    }
    file.write_text(json.dumps({**card, **changes}))
    text = model_card(weights, Publication("Mine", date(2026, 1, 31)))
    for line in ("| classes | six |", "| pixels right | 50.0 % |", "| subset A | undefined |", "| set | set x |"):
        assert line in text
    assert text.endswith("Not stated, 2026-01-31.\n")
    turns = {"turns": [{"weight": 2, "mixture": [{"set": "x"}, {"set": "y"}]}, {"weight": 1, "set": "z"}]}
    file.write_text(json.dumps({**card, "data": turns}))
    text = model_card(weights, PUBLICATION)
    assert "| set 2 | set y |\n| set 3 | weight 1, set z |\n" in text
    file.write_text(json.dumps({"format": card["format"], "network": "compact"}))
    assert "The card has none: " in model_card(weights, PUBLICATION)


def test_the_command_writes_a_page_beside_a_network(weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["card", str(weights), "--date", "2026-01-31"]) == 0
    assert weights.with_suffix(".md").read_text().count("# mine\n") == 1
    folder = weights.parent / "run"
    folder.mkdir()
    for suffix in (".safetensors", ".json"):
        weights.with_suffix(suffix).rename(folder / f"network{suffix}")
    assert main(["card", str(folder)]) == 0
    assert "# run\n" in (folder / "README.md").read_text()
    assert capsys.readouterr().out == f"wrote {weights.with_suffix('.md')}\nwrote {folder / 'README.md'}\n"
    assert main(["card", str(folder), "--url", "https://example.org/run"]) == 2
    assert "--url is where a set will be" in capsys.readouterr().err


def test_a_card_of_another_format_is_refused(weights: Path) -> None:
    weights.with_suffix(".json").write_text('{"format": "bodyseg network 0"}')
    with pytest.raises(BadConfig, match="the format must be 'bodyseg network 1', found 'bodyseg network 0'"):
        model_card(weights, PUBLICATION)
