"""`bodyseg view`: sets and recordings, options, hosts and Ctrl-C."""

from __future__ import annotations

import threading
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from pngs import png

from bodyseg_data.core import BadConfig
from bodyseg_model.commands import main, view
from bodyseg_model.commands.view import Options, check_options, is_set, welcome


def test_sets_are_told_from_recordings(tmp_path: Path, small_set: Path) -> None:
    assert is_set([str(small_set)]) and is_set([str(small_set / "train-*.tar")]) and is_set(["s3://bucket/shards"])
    assert is_set([str(next(small_set.glob("*.tar")))]) and is_set([str(small_set / "manifest.json")])
    assert not is_set([str(tmp_path)]) and not is_set([str(tmp_path / "frames.tar"), str(tmp_path)])
    with pytest.raises(BadConfig, match="view shows one set, or one or several recordings, found"):
        is_set([str(small_set), str(tmp_path)])


def test_a_folder_without_frames_may_be_a_set_whose_packing_has_not_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(tmp_path)]) == 2
    assert "a set of shards has manifest.json, which is written last\n" in capsys.readouterr().err
    assert main(["view", str(tmp_path / "walk.png")]) == 2
    assert "manifest.json" not in capsys.readouterr().err


def test_options_of_the_other_kind_are_refused() -> None:
    with pytest.raises(BadConfig, match="--keep-things is for frames, found it with a set"):
        check_options(Options(("x",), keep_things=True), "set")
    with pytest.raises(BadConfig, match="--where is for sets, found it with a recording"):
        check_options(Options(("x",), where=("subject=A",)), "recording")
    check_options(Options(("x",), where=("subject=A",), port=1), "set")


def test_another_host_is_warned_of_in_one_line() -> None:
    assert welcome("http://127.0.0.1:1", "127.0.0.1", 1) == "open http://127.0.0.1:1 in a browser; Ctrl-C ends"
    line = welcome("http://127.0.0.1:80", "0.0.0.0", 80)
    assert "whoever has this address and reaches port 80" in line and "\n" not in line


@pytest.mark.parametrize("kind", ["set", "recording"])
def test_ctrl_c_ends_in_one_line(
    kind: str, tmp_path: Path, small_set: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    served = []

    def interrupted(address: str, host: str, port: int) -> str:
        with urllib.request.urlopen(address, timeout=60) as reply:
            served.append(reply.status)
        raise KeyboardInterrupt

    monkeypatch.setattr(view, "welcome", interrupted)
    source, options = str(small_set), ["--variant", "occ"]
    if kind == "recording":
        image = np.zeros((60, 80), np.uint16)
        image[10:50, 20:40] = 1500
        (tmp_path / "1.png").write_bytes(png(image))
        source, options = str(tmp_path), ["--focal", "90", "--background", "keep"]
    assert main(["view", source, "--port", "0", *options]) == 130
    assert served == [200]
    assert capfd.readouterr() == ("", "bodyseg view: interrupted\n")
    assert not [each for each in threading.enumerate() if each.name.startswith(("redrawing", "player"))]


def test_pictures_need_a_folder(small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(small_set), "--save", str(tmp_path / "none")]) == 2
    assert "--save must be a folder that is there, found" in capsys.readouterr().err
