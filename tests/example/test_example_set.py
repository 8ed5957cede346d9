"""The set that ships with the package: its size, its bytes, and the commands that make it."""

from __future__ import annotations

import re
import shlex
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches import __main__ as tools
from folders import ROOT

from bodyseg_data import RangeImages, example_set
from bodyseg_data.commands import shard
from bodyseg_data.commands.options import parse
from bodyseg_data.commands.verify import Options, run
from bodyseg_data.packing import Packing, pack
from bodyseg_data.packing.packer import render_run
from bodyseg_data.shards.sample_codec import decode_sample

MOST_BYTES = 1_600_000


def command_of(name: str) -> list[str]:
    """The words after the name of a command that makes the set, as docs/reference/open_bodies.md has it."""
    text = (ROOT / "docs" / "reference" / "open_bodies.md").read_text()
    (line,) = re.findall(rf"^    (?:bodyseg |tools/){name} (.* ?bodyseg_data/example/shards.*)$", text, re.MULTILINE)
    return shlex.split(line)


@pytest.fixture(scope="module")
def packing() -> Packing:
    options: Any = parse(shard.Options, command_of("shard"), "shard", "", "")
    packing: Packing = options.packing()
    return packing


def test_every_byte_is_that_of_the_manifest_and_there_are_few(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Options(str(example_set()))) == 0, capsys.readouterr()
    assert sum(file.stat().st_size for file in example_set().iterdir()) <= MOST_BYTES


def test_bodies_sides_and_splits_differ() -> None:
    images = RangeImages(example_set())
    infos = [images.clean(index).info for index in range(len(images))]
    assert len(infos) == 48
    assert len({info.mesh for info in infos}) == 16
    assert len({info.pose for info in infos}) > 8
    assert {info.view.azimuth_deg for info in infos} == {0, 120, 240}
    assert [sum(info.split == split for info in infos) for split in ("train", "test")] == [36, 12]


def test_its_command_has_nothing_to_do(packing: Packing, tmp_path: Path) -> None:
    """The plan of the command, with persons, poses, rig and landmarks, is that of the stored set."""
    copy = tmp_path / "shards"
    shutil.copytree(example_set(), copy)
    with ThreadPoolExecutor(1) as executor:
        manifest = pack(packing, copy, executor, 1)
    assert manifest == RangeImages(example_set()).manifest
    assert {file.name: file.read_bytes() for file in copy.iterdir()} == {
        file.name: file.read_bytes() for file in example_set().iterdir()
    }


def test_a_body_packed_anew_gives_the_stored_samples(packing: Packing) -> None:
    """Within one step of range at few pixels: another processor may round a last bit otherwise."""
    images = RangeImages(example_set())
    body = packing.bodies()[-1]
    rendered = render_run(packing, body, tuple(packing.views_of(body)))
    assert len(rendered.samples) == 3
    for key, members in rendered.samples:
        anew, stored = decode_sample(key, members), images.clean(images.keys.index(key))
        assert anew.info == stored.info
        assert np.mean(anew.labels != stored.labels) < 1e-3
        differs = anew.range != stored.range
        assert np.mean(differs) < 1e-3
        both = (anew.range > 0) & (stored.range > 0)
        assert np.ptp((anew.range.astype(int) - stored.range)[both]) <= 1


def test_its_cards_are_made_by_their_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "shards"
    shutil.copytree(example_set(), copy, ignore=shutil.ignore_patterns("README.md", "croissant.json"))
    assert tools.main(["card", str(copy), *command_of("card")[1:]]) == 0, capsys.readouterr()
    for name in ("README.md", "croissant.json"):
        assert (copy / name).read_bytes() == (example_set() / name).read_bytes()
