"""Scores of `bench variants` on recordings that are made, by networks whose answers are known."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")

from benches import result_cache  # noqa: E402
from benches.measuring import Figures  # noqa: E402
from benches.model.variants import real  # noqa: E402
from benches.model.variants.figure import _real_frames  # noqa: E402
from benches.model.variants.real import ARMS, LABELLED, POSED, RECORDINGS, ROOM, RealFrames  # noqa: E402
from label_networks import Places  # noqa: E402
from PIL import Image  # noqa: E402
from pngs import png  # noqa: E402
from same_code import names_alone  # noqa: E402

from bodyseg_data.core import BadConfig  # noqa: E402
from bodyseg_data.labels import BACKGROUND, LANDMARKS  # noqa: E402
from bodyseg_data.rigs import load_rig  # noqa: E402

SELLION, RIGHT_HIP, LEFT_FOOT = (LANDMARKS.index(name) for name in ("Sellion", "Rt. ASIS", "Lt. Digit II"))
SMALL, WHOLE = (60, 80), (480, 640)


class One(Places):
    """Names every pixel one part."""

    def __init__(self, part: int) -> None:
        super().__init__(0, 1)
        self.part = part

    def scores(self, range_m: Any) -> Any:
        found = torch.zeros(len(range_m), 33, *range_m.shape[2:])
        found[:, self.part] = 20
        return found


def person(shape: tuple[int, int], millimetres: int = 900) -> Any:
    image = np.zeros(shape, np.uint16)
    image[5:55, 10:60] = millimetres  # 8 cm wide
    return image


@pytest.fixture(autouse=True)
def same_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code stays as it is: to find all modules takes seconds."""
    for module in (result_cache, real):
        monkeypatch.setattr(module, "code_digest", names_alone)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("real")
    for name in RECORDINGS:
        (home / name).mkdir()
    for name in ("00000", "00001", "00007"):
        (home / POSED / f"{name}.png").write_bytes(png(person(SMALL)))
    poses = {name: {"R": np.eye(3).tolist(), "t": [0, 0, 0]} for name in ("00000", "00001")}
    (home / POSED / "cameras.json").write_text(json.dumps({"frames": poses}))
    for name in "12":
        (home / ARMS / f"{name}_depth.png").write_bytes(png(person(SMALL)))
    room = np.full(WHOLE, 3000, np.uint16)
    room[5:55, 10:60] = 2000
    (home / ROOM / "001_depth.png").write_bytes(png(room))
    (home / ROOM / "001_person.png").write_bytes(png((room == 2000).astype(np.uint8)))
    for name in "01":
        (home / LABELLED / f"{name}_depth.png").write_bytes(png(person(SMALL)))
        matrices = {"intrinsic": "525 0 40 0 525 30 0 0 1", "R": "1 0 0 0 1 0 0 0 1", "t": "0 0 0"}
        entries = [f"<{key}><data>{data}</data></{key}>" for key, data in matrices.items()]
        (home / LABELLED / f"{name}_camera.xml").write_text(f"<opencv_storage>{''.join(entries)}</opencv_storage>")
    return home


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run's folder whose network is `One` of the part in the name of its weights."""
    (tmp_path / "network.json").write_text(json.dumps({"network": "one", "rig": load_rig().to_json()}))
    monkeypatch.setattr(real, "_made_labels", halves)
    return tmp_path


def named(monkeypatch: pytest.MonkeyPatch, run: Path, part: int) -> None:
    (run / "network.safetensors").write_text(str(part))
    monkeypatch.setattr(real, "load_network", lambda _: SimpleNamespace(network=One(part), rig=load_rig()))


def halves(folder: Path, stored: Any) -> dict[str, Any]:
    """True labels: the left half is Sellion, the right one the left foot; by the second placement all is Sellion."""
    truth = np.full((len(stored), *SMALL), BACKGROUND, np.uint8)
    truth[:, 5:55, 10:60] = SELLION
    other = truth.copy()
    other[:, 5:55, 35:60] = LEFT_FOOT
    points = stored[0].points(np.flatnonzero(other[0].ravel() != BACKGROUND))
    surface = {"vertices": points, "vertex_labels": other[0][other[0] != BACKGROUND]}
    cameras = surface | {"axes": np.stack([np.eye(3)] * len(stored)), "positions": np.zeros((len(stored), 3))}
    return {"mirrored": np.array(False), **cameras, "mean": other, "first": other, "second": truth}


def test_every_recording_is_scored(folder: Path, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named(monkeypatch, run, SELLION)
    found = RealFrames(folder, run / "kept.npz").scores(run)
    assert list(found) == list(RECORDINGS)
    labelled = found[LABELLED]
    assert (labelled["accuracy"], labelled["accuracy_first"], labelled["accuracy_second"]) == (0.5, 0.5, 1)
    assert labelled["pixels"] == 0.5 and labelled["same"] == 1
    # Of 25 wrong columns, 1.71 mm each, the first 17 are within 30 mm of what is Sellion's.
    assert labelled["beyond_30_mm"] == pytest.approx(8 / 50, abs=0.001) and labelled["beyond_60_mm"] == 0
    assert 5 < labelled["mean_mm"] < 15
    assert found[POSED]["same"] == 1
    assert found[ARMS]["mirror"] == 1 and found[ARMS]["feet"] == 0 and found[ROOM]["mirror"] == 1


def test_sides_that_a_mirror_does_not_exchange_are_counted(
    folder: Path, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named(monkeypatch, run, RIGHT_HIP)
    found = RealFrames(folder, run / "kept.npz").scores(run)
    assert found[ARMS]["mirror"] == 0 == found[ROOM]["mirror"]
    assert found[ARMS]["mirror_beyond_60_mm"] == 1  # the left hip is nowhere
    named(monkeypatch, run, LEFT_FOOT)
    assert RealFrames(folder, run / "kept.npz").scores(run)[ARMS]["feet"] == 1


def test_scores_and_true_labels_are_kept(folder: Path, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named(monkeypatch, run, SELLION)
    first = RealFrames(folder, run / "kept.npz").scores(run)

    def refuse(*_: Any) -> Any:
        raise AssertionError("kept before")

    monkeypatch.setattr(real, "_made_labels", refuse)
    assert RealFrames(folder, run / "kept.npz").recordings[LABELLED].truth["second"][0].max() == BACKGROUND
    monkeypatch.setattr(real, "load_network", refuse)
    assert RealFrames(folder, run / "kept.npz").scores(run) == first
    (run / "network.safetensors").write_text("another")
    with pytest.raises(AssertionError, match="kept before"):
        RealFrames(folder, run / "kept.npz").scores(run)


def test_frames_are_drawn_with_the_labels_of_every_network(
    folder: Path, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    named(monkeypatch, run, SELLION)
    shown = RealFrames(folder, run / "kept.npz").shown({"none": run, "all": run})
    assert [each.title for each in shown] == [
        RECORDINGS[name] for name in (LABELLED, LABELLED, POSED, ARMS, ARMS, ROOM)
    ]
    assert list(shown[0].labels) == ["true labels", "none", "all"] and list(shown[-1].labels) == ["none", "all"]
    picture = np.asarray(_real_frames(Figures({}, shown).shown))
    colours = [np.unique(picture[:400, left : left + 170].reshape(-1, 3), axis=0) for left in (6, 182, 358)]
    assert len(colours[0]) != len(colours[1])  # two parts, one part
    np.testing.assert_array_equal(picture[60:150, 182:352], picture[60:150, 358:528])
    assert Image.fromarray(picture).width > 500


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match="--real must hold folders of frames, kinect_v1, .*, found none in"):
        RealFrames(tmp_path, tmp_path / "kept.npz")
