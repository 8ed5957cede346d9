"""Every key of summary.json and of an evaluation's file is in docs/reference/json_keys.md, and no other."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from folders import ROOT
from label_networks import Places
from PIL import Image
from small_rig import SMALL

from bodyseg_model import runtimes
from bodyseg_model.commands import cli
from bodyseg_model.networks import Trained, build
from bodyseg_model.runtimes import backends

PAGE = (ROOT / "docs" / "reference" / "json_keys.md").read_text()


def documented(title: str) -> list[str]:
    """Patterns of the keys in the tables of one section: a word in capitals stands for any name, … for all below."""
    (section,) = re.findall(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S)
    cells = re.findall(r"^\| (`.*?) \|", section, re.M)
    return [key for cell in cells for key in re.findall(r"`(.*?)`", cell)]


def matches(pattern: str, key: str) -> bool:
    text = re.escape(pattern).replace(re.escape(".…"), r"(\..*|\[\].*)?")
    return re.fullmatch(re.sub(r"(?<![a-z_])[A-Z]{2,}(?![a-z_])", r"[^.]+", text), key) is not None


def written(tree: Any, above: str = "") -> Iterator[tuple[str, bool]]:
    """Keys of all values that hold no other, "each[].bodies[].box", and whether the value is something."""
    if isinstance(tree, dict) and tree:
        for name, value in tree.items():
            yield from written(value, f"{above}.{name}" if above else name)
    elif isinstance(tree, list) and any(isinstance(each, dict) for each in tree):
        for each in tree:
            yield from written(each, f"{above}[]")
    else:
        yield above, tree is not None and tree != [] and tree != {}


def check(title: str, trees: list[Any]) -> None:
    """Nothing, like null in place of an object, need not be documented; but it is documented that a key may be so."""
    known, keys = documented(title), {each for tree in trees for each in written(tree)}
    assert known, title
    assert not {key for key, something in keys if something and not any(matches(pattern, key) for pattern in known)}
    assert not {pattern for pattern in known if not any(matches(pattern, key) for key, _ in keys)}, "never written"


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch, near_is_person: None) -> None:
    card = {"network": "places", "settings": {}, "seed": 3, "variant": "all", "steps": 1, "rig": SMALL.to_json()}
    trained = Trained(Places(axis=0, step=5), {**card, "data": {}, "sensor": {}, "weights_sha256": "0"})
    scored = Trained(trained.network, card)  # by evaluate, which chooses a checkpoint
    monkeypatch.setattr(runtimes, "load_network", lambda run, *chosen, dense=False: scored if chosen else trained)
    monkeypatch.setattr(backends, "computes_bfloat16", lambda: False)


@pytest.mark.usefixtures("prepared")
def test_the_keys_of_a_summary_are_those_documented(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stack = np.full((3, 60, 80), 4000, np.uint16)
    stack[:, 10:50, 20:32] = 2000
    np.savez(tmp_path / "a.npz", depth=stack, times=np.arange(3.0))
    folder = tmp_path / "pngs"
    folder.mkdir()
    for number in range(2):  # of the size that the network's camera has
        Image.fromarray(np.pad(stack[0], ((50, 50), (1, 1)), mode="edge")).save(folder / f"{number}.png")
    (folder / "2.png").write_bytes(b"none")
    lens = {"fx": 100, "fy": 100, "cx": 40.5, "cy": 79.5, "distortion": [0.01, 0, 0, 0, 0]}
    (folder / "1.json").write_text(json.dumps(lens))
    given = ["--focal", "100", "--units", "mm"]
    runs = (
        (tmp_path / "a.npz", *given, "--keep-things", "--video", "--turned", "180", "--flip-average"),
        (folder, "--skip-unreadable", "1", "--no-overlay"),
        (folder, "--skip-unreadable", "1", "--no-overlay"),
        (folder, "--skip-unreadable", "1", "--no-overlay", "--dense"),
    )
    trees: list[Any] = []
    rig = {"rig": SMALL.to_json()}
    unsure = Trained(Places(0, 5, sure_m=0.1), {**rig, "least_confidence_of_people": 0.9})  # a person is a thing
    dense = Trained(build("compact", {"widths": [8], "blocks": [1], "template": True}, 0).eval(), rig)
    for number, words in enumerate(runs):
        if number >= 2:
            network = (unsure, dense)[number - 2]
            monkeypatch.setattr(runtimes, "load_network", lambda run, dense=False, network=network: network)
        out = tmp_path / str(number)
        assert cli.main(["segment", *map(str, words), "--out", str(out)]) == 0
        trees.append(json.loads((out / "summary.json").read_text()))
    check("summary.json", trees)


def test_the_keys_of_an_evaluation_are_those_documented(figures_set: Path, tmp_path: Path) -> None:
    trees = []
    for words in (["--labels", "limbs14", "--frames", "0"], ["--frames", "1", "--flip-average"]):
        out = tmp_path / "scores.json"
        assert cli.main(["evaluate", "--data", str(figures_set), "--json", str(out), "--images", "2", *words]) == 0
        trees.append(json.loads(out.read_text()))
    check("An evaluation", trees)
