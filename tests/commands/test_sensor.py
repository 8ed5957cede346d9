"""`bodyseg sensor fit` and `show`, as their users call them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bodyseg_data.artifacts import Noise, load_sensor_model, sensor_model_names
from bodyseg_model.commands import main


def run(*words: str | Path) -> int:
    return main(["sensor", *map(str, words)])


def refused(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    assert run(*words) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("bodyseg sensor")]
    return line


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Three frames in millimetres: a ball of 40 cm, 1 m away, before a wall, its shadow on the right."""
    folder = tmp_path / "frames"
    folder.mkdir()
    v, u = np.mgrid[:208, :224] - np.array([104, 112])[:, None, None] + 0.5
    generator = np.random.default_rng(0)
    ball = u**2 + v**2 < 90**2
    depth = 1.2 - 0.2 * np.sqrt(np.clip(1 - (u**2 + v**2) / 90**2, 0, 1))
    shadow = ~ball & ((u - 12) ** 2 + v**2 < 90**2) & (u > 0)
    for number in range(3):
        range_m = np.where(ball, depth, 2.5) + 0.004 * generator.standard_normal(u.shape)
        stored = np.where(shadow, 0, np.rint(1000 * range_m)).astype(np.uint16)
        Image.fromarray(stored).save(folder / f"{number}.png")
    return folder


def test_frames_become_a_sensor_file_and_a_picture(
    frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, picture = tmp_path / "sensor.toml", tmp_path / "sensor.png"
    words = ("--focal", "450", "--nearer-than", "1.5", "--name", "mine", "--out", out, "--picture", picture)
    assert run("fit", frames, *words) == 0
    said = capsys.readouterr()
    verdicts = {line.split()[0]: line.split(maxsplit=1)[1] for line in said.out.splitlines()}
    assert verdicts["noise"].startswith("needed") and verdicts["mixed_pixels"].startswith("not seen")
    assert len(verdicts) == 6 and f"wrote {out}" in said.err and f"wrote {picture}" in said.err
    model = load_sensor_model(out)
    assert model.name == "mine" and {"occlusion", "noise"} <= {artifact.name for artifact in model}
    (noise,) = (artifact for artifact in model if isinstance(artifact, Noise))
    assert noise.low_mm == noise.high_mm == pytest.approx(4, rel=0.1)
    with Image.open(picture) as drawn:
        assert drawn.width > 800


def test_a_fit_takes_no_more_processors_than_its_container_has(frames: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    monkeypatch.setattr("bodyseg_model.training.distributed.processors", lambda: 1)
    try:
        assert run("fit", frames, "--near", "5", "--far", "1") == 2
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)


def test_figures_as_json(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("fit", frames, "--focal", "450", "--nearer-than", "1.5", "--json") == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree["frames"] == 3 and tree["still"] and tree["mirrored"] is None
    found = {finding["artifact"]: finding for finding in tree["findings"]}
    assert found["noise"]["verdict"] == "needed" and found["noise"]["estimates"]["sigma_mm"]["error"] > 0
    assert tree["sensor"]["format"] == "bodyseg sensor 1" and tree["sensor"]["name"] == "measured"


def test_a_model_without_an_artifact_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(2):
        Image.fromarray(np.full((208, 224), 1000, np.uint16)).save(tmp_path / f"{number}.png")
    assert run("fit", tmp_path, "--focal", "450", "--nearer-than", "1.5", "--out", tmp_path / "none.toml") == 0
    said = capsys.readouterr()
    unknown = said.out.count("cannot be told")
    assert f"the model has no artifact and leaves images clean; {unknown} of 6 cannot be told" in said.err
    assert not load_sensor_model(tmp_path / "none.toml").artifacts


def test_a_mirrored_recording_is_told(tmp_path: Path, frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / "rig.toml"
    camera = "rows = 208\ncolumns = 224\nfocal_px = 450.0\n"
    rig.write_text(
        f'format = "bodyseg rig 1"\nname = "mine"\nstand_off_m = 1.0\n[camera]\n{camera}'
        f"[projector]\n{camera}position_m = [0.05, 0.0, 0.0]\naims_at_m = [0.05, 0.0, 1.0]\n"
    )
    assert run("fit", frames, "--rig", rig, "--nearer-than", "1.5", "--json") == 0
    assert json.loads(capsys.readouterr().out)["mirrored"] is True


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--focal", "450", "--nearer-than", "1.5", "--far", "2"), "--nearer-than finds bodies alone"),
        (("--focal", "450", "--nearer-than", "-1"), "--nearer-than must be above 0 m, found -1"),
        (("--focal", "450", "--background", "keep", "--far", "2"), "--near and --far limit what is kept"),
        (("--focal", "450", "--background", "frame", "--near", "1"), "they contradict --background frame"),
        (("--focal", "450", "--nearer-than", "0.3"), "no frame shows a body"),
        (("--nearer-than", "1.5"), "no sensor is assumed for frames of 208 rows of 224 pixels"),
        (("--focal", "450", "--picture", "x.jpg"), "--picture must be a .png file, found x.jpg"),
        (("--focal", "450", "--out", "absent/x.toml"), "--out needs a file in a folder that is there"),
        (("--focal", "450", "--out", "recording.mcap"), "--out must be a .toml file, found recording.mcap"),
        (("--focal", "450", "--name", "two words"), "a sensor's name must be one plain word"),
    ],
)
def test_bad_input_is_one_line(
    frames: Path, words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(capsys, "fit", frames, *words)


def test_a_picture_never_replaces_a_frame(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As in `--picture frames/*.png`, where the option gets the first of the files."""
    first, *others = sorted(frames.iterdir())
    before = first.read_bytes()
    said = refused(capsys, "fit", "--focal", "450", "--nearer-than", "1.5", "--picture", first, *others)
    assert f"--picture must not replace a frame, found {first}" in said
    assert first.read_bytes() == before


def test_the_models_that_ship_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("show", "--help") == 0
    words = capsys.readouterr().out.replace(",", " ").split()
    assert {*sensor_model_names()} <= {*words}
    assert run("show", "paper") == 0
    assert capsys.readouterr().out == load_sensor_model("paper").to_toml()
    assert "no sensor is called 'none'" in refused(capsys, "show", "none")


def test_the_group_lists_its_commands(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ((), ("--help",)):
        assert run(*words) == 0
        text = capsys.readouterr().out
        assert "Usage: bodyseg sensor COMMAND" in text and "  sensor fit " in text and "segment" not in text
    assert refused(capsys, "measure").endswith("no such command; there are sensor fit, sensor show")
