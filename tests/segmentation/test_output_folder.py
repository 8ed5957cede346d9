"""Folder of the results of `bodyseg segment`: nothing of anybody else is replaced, mixed or lost."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from pngs import png

from bodyseg_data.core import BadConfig
from bodyseg_data.files import part_beside, write_result
from bodyseg_model.commands import main
from bodyseg_model.recordings import find_frames
from bodyseg_model.segmentation import OutputFolder
from bodyseg_model.segmentation.output_folder import ImageKind

USUAL = ImageKind.LABELS, ImageKind.OVERLAY


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return recorded(tmp_path / "recording", "1", "2")


def recorded(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True)
    for name in names:
        (folder / f"{name}.png").write_bytes(png())
    return folder


def opened(out: Path, *inputs: Path, kinds: tuple[ImageKind, ...] = USUAL) -> OutputFolder:
    return OutputFolder(out, inputs, find_frames(inputs), kinds)


def filled(out: Path, *inputs: Path, kinds: tuple[ImageKind, ...] = USUAL, done: bool = True) -> None:
    """Results as the command leaves them, or as a call that ends after its first frame does."""
    place = opened(out, *inputs, kinds=kinds)
    place.begin()
    frames = find_frames(inputs)
    for frame in frames if done else frames[:1]:
        for kind in kinds:
            place.image(kind, frame.name).write_text(frame.where)
    if done:
        place.finish({"each": [{"name": frame.name, "file": frame.where} for frame in frames]})


def write_images(place: OutputFolder) -> None:
    for kind in place.kinds:
        for name in ("1", "2"):
            write_result(place.image(kind, name), f"{kind} {name}".encode(), flushed=False)


def files(out: Path) -> list[str]:
    return sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())


def refusal(out: Path, *inputs: Path) -> str:
    before = files(out) if out.is_dir() else []
    with pytest.raises(BadConfig) as caught:
        opened(out, *inputs)
    assert (files(out) if out.is_dir() else []) == before
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_nothing_is_made_before_it_begins(recording: Path, tmp_path: Path) -> None:
    out = opened(tmp_path / "new" / "out", recording)
    assert not (tmp_path / "new").exists()
    out.begin()
    assert sorted(path.name for path in out.path.iterdir()) == ["labels", "overlay", "unfinished.json"]
    write_images(out)
    out.finish({"each": [{"people": 1}, {"people": 0}]})
    each = json.loads((out.path / "summary.json").read_text())["each"]
    assert [(frame["name"], frame["people"]) for frame in each] == [("1", 1), ("2", 0)]
    assert sorted(path.name for path in out.path.iterdir()) == ["labels", "overlay", "summary.json"]


def test_two_calls_at_once_do_not_mix(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    first, second = opened(out, recording), opened(out, recorded(tmp_path / "other", "1", "2"))
    with first.claimed():
        first.begin()
        before = files(out)
        held = pytest.raises(BadConfig, match=f"^another segment is at work in {out}: wait for its end")
        with held, second.claimed():
            pass
        assert main(["segment", str(recording), "--out", str(out), "--focal", "90"]) == 2
        assert f"another segment is at work in {out}: wait for its end" in capsys.readouterr().err
        assert files(out) == before
        write_images(first)
        first.finish({"each": [{}, {}]})
    with pytest.raises(BadConfig, match="must not hold results of other frames"), second.claimed():
        pass  # it looked at the folder before the first one wrote
    assert [name for name in files(out) if name.startswith(".")] == []


def test_results_of_the_same_frames_are_replaced(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    filled(out, recording, kinds=tuple(ImageKind))
    place = opened(out, recording)
    place.begin()
    left = ["labels/1.png", "labels/2.png", "overlay/1.png", "overlay/2.png", "unfinished.json"]
    assert files(out) == left, "what this call does not write is gone, and so is the old summary"
    place.finish({"each": [{}, {}]})
    (out / "overlay" / "mine.txt").touch()
    part_beside(out / "overlay" / "1.png").touch()  # as a killed call leaves it
    opened(out, recording, kinds=USUAL[:1]).begin()
    assert files(out) == ["labels/1.png", "labels/2.png", "overlay/mine.txt", "unfinished.json"]
    assert {path.name for path in out.iterdir() if path.is_dir()} == {"labels", "overlay"}, "no empty folder is left"


def test_results_of_an_hour_of_frames_are_replaced(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    filled(out, recording)
    with (out / "summary.json").open("a") as file:
        file.write(" " * (1 << 26))  # as long as that of 60 000 frames
    opened(out, recording).begin()


def test_frames_are_the_same_from_any_folder_and_others_of_their_path_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    for day in ("monday", "tuesday"):
        recorded(tmp_path / day / "recording", "1")
    monkeypatch.chdir(tmp_path / "monday")
    filled(out, Path("recording"))
    filled(out, tmp_path / "monday" / "recording")
    filled(out, Path("recording"))
    monkeypatch.chdir(tmp_path / "tuesday")
    assert "must not hold results of other frames, found those of recording/1.png in" in refusal(out, Path("recording"))
    filled(out, Path("..") / "monday" / "recording")


def test_more_frames_may_come_and_names_may_change(recording: Path, tmp_path: Path) -> None:
    out, other = tmp_path / "out", recorded(tmp_path / "other", "2")
    filled(out, recording)
    filled(out, recording, other)
    images = [f"{folder}/{name}.png" for folder in USUAL for name in ("other/2", "recording/1", "recording/2")]
    assert files(out) == [*images, "summary.json"]


def test_results_of_other_frames_are_kept(recording: Path, tmp_path: Path) -> None:
    out, other = tmp_path / "out", recorded(tmp_path / "other", "1", "2")
    filled(out, other)
    kept = f"--out must not hold results of other frames, found those of {other / '1.png'} in {out}"
    assert refusal(out, recording) == f"{kept}: give a new folder, or delete this one"
    filled(out, recording, other)
    assert "must not hold results of other frames" in refusal(out, other)


def test_a_call_that_was_cut_short_is_carried_on_without_its_bad_frame(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    filled(out, recording, done=False)
    (recording / "2.png").unlink()
    filled(out, recording)
    assert files(out) == ["labels/1.png", "overlay/1.png", "summary.json"]
    filled(tmp_path / "again", recorded(tmp_path / "more", "1", "2"), done=False)
    (tmp_path / "more" / "1.png").unlink()
    assert "must not hold results of other frames" in refusal(tmp_path / "again", tmp_path / "more")


def test_the_call_after_one_that_was_killed_goes_on_and_leaves_nothing_of_it(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(path: Path, content: object) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "out"
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("bodyseg_model.segmentation.output_folder.write_json", kill)
        opened(out, recording).begin()
    filled(out, recording, done=False)
    for name in ("labels/2.png", "preview.gif"):
        part_beside(out / name).write_text("cut short")
    filled(out, recording)
    assert files(out) == ["labels/1.png", "labels/2.png", "overlay/1.png", "overlay/2.png", "summary.json"]


@pytest.mark.parametrize(
    ("make", "held"),
    [
        (lambda out: (out / "notes.txt").write_text("mine"), "holds notes.txt"),
        (lambda out: (out / "labels").mkdir(), "holds labels"),
        (
            lambda out: (out / "summary.json").write_text('{"format": "bodyseg train 1", "each": []}'),
            "is not of format",
        ),
        (lambda out: (out / "summary.json").write_text('{"format": "bodyseg segment 2"}'), "is not of format"),
        (
            lambda out: (out / "summary.json").write_text('{"format": "bodyseg segment 2", "each": [{"name": "x"}]}'),
            "is not of format",
        ),
        (
            lambda out: (out / "summary.json").write_text(
                json.dumps({"format": "bodyseg segment 2", "each": [{"name": "../../x", "file": "x", "path_id": "x"}]})
            ),
            "is not of format",
        ),
        (lambda out: (out / "summary.json").write_text("{"), "is not JSON"),
        (lambda out: (out / "run.json").write_text("{}"), "holds run.json"),
    ],
)
def test_a_folder_of_anything_else_is_refused(
    make: Callable[[Path], object], held: str, recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    make(out)
    assert held in refusal(out, recording)


def test_hidden_files_do_not_matter(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".DS_Store").write_text("")
    filled(tmp_path / "out", recording)
    assert (tmp_path / "out" / ".DS_Store").exists()


def test_an_out_among_the_frames_is_refused(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(recording)
    rule = "--out must lie outside the frames' folders and hold no frames, found"
    for out, frames in (
        (recording, recording),
        (recording / "labelled", recording),
        (tmp_path, recording),
        (recording, tmp_path / "link"),
        (tmp_path / "link", recording),
        (recording, recording / "1.png"),
    ):
        assert refusal(out, frames) == f"{rule} {out} and {frames}"
    opened(recording / "labelled", recording / "1.png")  # beside single frames it may lie


def test_an_out_that_cannot_be_made_is_named(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    assert refusal(tmp_path / "file", recording) == f"cannot write {tmp_path / 'file'}: Not a directory"
    assert refusal(tmp_path / "file" / "out", recording) == f"cannot write {tmp_path / 'file' / 'out'}: Not a directory"
    filled(tmp_path / "old", recording)
    shutil.rmtree(tmp_path / "old" / "labels")
    (tmp_path / "old" / "labels").write_text("")
    with pytest.raises(BadConfig, match=r"^cannot write .*old: File exists$"):
        opened(tmp_path / "old", recording).begin()
    place = opened(tmp_path / "out", recording)
    place.begin()
    write_images(place)

    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, os.strerror(13), str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(BadConfig, match=r"cannot write .*out: Permission denied"):
        place.finish({"each": [{}, {}]})


def test_the_summary_is_written_after_the_disk_holds_all_images(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, flushed = tmp_path / "out", []
    real = os.fsync

    def recorded_fsync(handle: int) -> None:
        flushed.append(Path(f"/proc/self/fd/{handle}").readlink())
        real(handle)

    place = opened(out, recording)
    place.begin()
    monkeypatch.setattr(os, "fsync", recorded_fsync)
    write_images(place)
    assert not flushed, "nobody waits for the disk at every frame"
    place.finish({"each": [{"name": name} for name in ("1", "2")]})
    images = {out / folder / f"{name}.png" for folder in USUAL for name in ("1", "2")}
    before = next(at for at, path in enumerate(flushed) if path.name.startswith(".summary.json."))
    assert images | {path.parent for path in images} <= set(flushed[:before])
    assert {path.read_text() for path in images} == {f"{folder} {name}" for folder in USUAL for name in ("1", "2")}


def test_an_image_that_vanished_leaves_no_summary(recording: Path, tmp_path: Path) -> None:
    place = opened(tmp_path / "out", recording)
    place.begin()
    write_images(place)
    place.image("labels", "2").unlink()
    with pytest.raises(BadConfig, match=r"^cannot write .*out: No such file or directory$"):
        place.finish({"each": [{"name": name} for name in ("1", "2")]})
    assert not (tmp_path / "out" / "summary.json").exists()
