"""Copies from sources that change meanwhile or claim too much, and into folders in which somebody has planted links."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bodyseg_data import ColumnWriter, RangeImages
from bodyseg_data.core import BadConfig
from bodyseg_data.shards import MANIFEST_NAME, LocalFolder, Store, read_manifest
from bodyseg_data.transfer import LocalTarget, SharedFile, set_bundle, transfer
from bodyseg_model.commands import main


class Replaced(LocalFolder):
    """A set whose manifest is another one's from the second read on."""

    def __init__(self, path: Path, other: Path) -> None:
        super().__init__(path)
        self._other, self._reads = other, 0

    def read_file(self, name: str, limit: int) -> bytes | None:
        if name == MANIFEST_NAME:
            self._reads += 1
        if name == MANIFEST_NAME and self._reads > 1:
            return (self._other / name).read_bytes()
        return super().read_file(name, limit)


def copy(source: Store, folder: Path, replace: bool = False) -> None:
    transfer(set_bundle(source), LocalTarget(folder, source), lambda done: None, replace)


def test_a_set_that_is_replaced_meanwhile_is_copied_as_it_was_read(
    small_set: Path, pack_figures: Callable[..., Path], tmp_path: Path
) -> None:
    other = pack_figures(tmp_path / "other")
    copy(Replaced(small_set, other), tmp_path / "back")
    assert (tmp_path / "back" / MANIFEST_NAME).read_bytes() == (small_set / MANIFEST_NAME).read_bytes()
    assert main(["verify", str(tmp_path / "back")]) == 0


def test_the_manifest_of_a_column_is_copied_as_it_was_checked(small_set: Path, tmp_path: Path) -> None:
    class CutOnTheWay(LocalFolder):
        """Gives the manifest of a column whole once, and cut from the second read on."""

        reads = 0

        def read_file(self, name: str, limit: int) -> bytes | None:
            data = super().read_file(name, limit)
            if data is None or name != "quality.column.json":
                return data
            self.reads += 1
            return data if self.reads == 1 else data[:-99]

    mine, back = tmp_path / "mine", tmp_path / "back"
    shutil.copytree(small_set, mine, ignore=shutil.ignore_patterns(".*"))
    with ColumnWriter(mine, "quality", "text") as column:
        for key in RangeImages(mine).keys:
            column.write(key, "good")
    copy(CutOnTheWay(mine), back)
    for path in mine.glob("*column*"):
        assert (back / path.name).read_bytes() == path.read_bytes()
    assert main(["verify", str(back)]) == 0


def test_a_planted_link_is_not_written_through(small_set: Path, tmp_path: Path) -> None:
    back, victim = tmp_path / "back", tmp_path / "victim"
    back.mkdir()
    victim.write_bytes(b"precious")
    names = [shard.name for shard in read_manifest(small_set).shards]
    for name in (*names, MANIFEST_NAME):
        (back / f".{name}.part").symlink_to(victim)
    (back / names[0]).symlink_to(victim)
    copy(LocalFolder(small_set), back, replace=True)
    assert victim.read_bytes() == b"precious"
    assert not any((back / name).is_symlink() for name in (*names, MANIFEST_NAME))
    assert main(["verify", str(back)]) == 0


def test_what_a_server_claims_is_asked_of_the_disk_first(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage, target = namedtuple("usage", "total used free"), LocalTarget(tmp_path, LocalFolder(small_set))
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage(10**9, 0, 10**6))
    with pytest.raises(BadConfig, match=rf"^{tmp_path}: no space left: 1000000000\.0 MB are needed, 1\.0 MB free$"):
        target.check_room([SharedFile("a.tar", 10**15, "")])
    (tmp_path / ".a.tar.part").write_bytes(bytes(1000))
    target.check_room([SharedFile("a.tar", 10**6 + 1000, "")])
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage(10**9, 0, 1))
    with pytest.raises(BadConfig, match="no space left"):
        copy(LocalFolder(small_set), tmp_path / "back")
    assert not list((tmp_path / "back").iterdir())


def test_a_page_of_any_length_is_not_read(small_set: Path, tmp_path: Path) -> None:
    mine = shutil.copytree(small_set, tmp_path / "mine", ignore=shutil.ignore_patterns(".*"))
    (mine / "README.md").write_bytes(bytes((1 << 24) + 1))
    with pytest.raises(OSError, match="at most 16777216 bytes are read, found more"):
        set_bundle(LocalFolder(mine))


def test_a_disk_that_fills_is_named(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert main(["pull", str(small_set), str(tmp_path / "back")]) == 2
    said = capsys.readouterr().err.splitlines(keepends=True)[-1]
    assert said.startswith(f"bodyseg pull: {tmp_path / 'back'}/.") and said.endswith(": No space left on device\n")


def test_a_part_that_another_transfer_has_just_finished_is_left_alone(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(handle: Any, flags: int) -> None:
        for part in tmp_path.glob("back/.*.part"):
            part.rename(part.with_name("finished.tar"))

    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(BadConfig, match=r"\.part: another transfer writes this file"):
        copy(LocalFolder(small_set), tmp_path / "back")
