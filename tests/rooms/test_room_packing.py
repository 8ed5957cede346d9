"""Sets of made rooms: the same bytes however they are packed, people built once a block, mistakes told."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from people_on_disk import PERSON, VERTICES, person
from small_rig import SMALL

from bodyseg_data import RangeImages
from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.bodies.sources.labelled import LabelledScenes
from bodyseg_data.commands.cli import main
from bodyseg_data.core import BadConfig, BadMesh
from bodyseg_data.meshes import cuboid, partition
from bodyseg_data.packing.jobs import Engine
from bodyseg_data.rooms import OwnThings, chosen_kinds, pack_rooms, room_packing
from bodyseg_data.rooms.furnishings import FURNISHINGS
from bodyseg_data.rooms.scenes import RoomPerson
from bodyseg_data.samples import Split


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Plain people in blocks of three samples, two in turns, threads for processes; the blocks that were built."""
    found: list[tuple[str, int]] = []
    somebody = RoomPerson(PERSON, partition(PERSON, np.array(VERTICES), "edges"), "standing")

    def draw(split: Split, block: int, poses: tuple[str, ...] = ()) -> list[RoomPerson]:
        found.append((split, block))
        return [somebody]

    @contextmanager
    def threads(workers: int | None) -> Iterator[Engine]:
        with ThreadPoolExecutor(workers) as executor:
            yield Engine(executor, workers or 1)

    for name, value in {"draw_people": draw, "processes": threads, "_BLOCK": 3, "_AT_ONCE": 2}.items():
        monkeypatch.setattr(room_packing, name, value)
    room_packing._shared_people.cache_clear()
    return found


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_set_has_the_same_bytes_for_any_number_of_workers_and_after_a_stop(
    tmp_path: Path, built: list[tuple[str, int]]
) -> None:
    for workers in (1, 3):
        pack_rooms(tmp_path / str(workers), SMALL, 8, "test", shard_samples=3, workers=workers)
        assert sorted(built) == [("test", block) for block in range(3)]  # once each
        built.clear()

    def stop(done: int, total: int) -> None:
        if done >= 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pack_rooms(tmp_path / "cut", SMALL, 8, "test", shard_samples=3, workers=2, progress=stop)
    for samples, split in ((8, "train"), (3, "test")):
        with pytest.raises(BadConfig, match=f"{tmp_path / 'cut'} holds rooms of another number or split"):
            pack_rooms(tmp_path / "cut", SMALL, samples, split, shard_samples=3, workers=1)
    people = next((tmp_path / "cut" / ".packing").glob("people-test-000?"))
    whole = people.read_bytes()
    people.write_bytes(whole[: len(whole) // 2])
    room_packing._shared_people.cache_clear()
    with pytest.raises(BadConfig, match=f"^{people} cannot be read: delete it: "):
        pack_rooms(tmp_path / "cut", SMALL, 8, "test", shard_samples=3, workers=1)
    people.write_bytes(whole)
    pack_rooms(tmp_path / "cut", SMALL, 8, "test", shard_samples=3, workers=1)
    assert len(built) == 3  # people of the first run serve the second
    assert files(tmp_path / "1") == files(tmp_path / "3") == files(tmp_path / "cut")
    images = RangeImages(str(tmp_path / "1"), variant="none", split="test", planes=("person",))
    assert [images[number]["key"][-1] for number in range(8)] == list("03142567")  # two blocks in turns


def test_kinds_are_chosen_by_name_and_a_set_says_what_it_lacks(tmp_path: Path, built: list[tuple[str, int]]) -> None:
    assert chosen_kinds((), ("sofa",)) == tuple(kind for kind in FURNISHINGS if kind != "sofa")
    assert chosen_kinds(("bed", "chair"), ("bed",)) == ("chair",)
    for only, without, wrong in (((), ("soffa",), "'soffa'"), (("x",), (), "'x'"), (("bed",), ("bed",), "found none")):
        with pytest.raises(BadConfig, match=wrong):
            chosen_kinds(only, without)
    manifest = pack_rooms(tmp_path / "set", SMALL, 1, "train", chosen_kinds((), ("sofa", "bed")), workers=1)
    assert manifest.source == "rooms without sofa, bed"


def box_file(path: Path, size: tuple[float, float, float] = (40, 80, 60)) -> Path:
    """A cuboid in a file, by default in cm, off its origin, as machines' files have them."""
    solid = cuboid(size, (300.0, -20.0, 5.0))
    rows = [*solid.vertices.tolist(), *([3, *face] for face in solid.faces.tolist())]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(["OFF", f"{len(solid.vertices)} 12 0", *(" ".join(map(str, row)) for row in rows)]))
    return path


def test_own_meshes_stand_in_rooms_as_no_body_with_the_same_bytes(
    tmp_path: Path, built: list[tuple[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    box_file(tmp_path / "own/press.off")
    own = OwnThings(tmp_path / "own", "cm")
    ((name, solid),) = own.surfaces()
    assert name == "press"
    np.testing.assert_allclose(solid.vertices.min(axis=0), (-0.2, 0.0, -0.3), atol=1e-12)
    np.testing.assert_allclose(solid.vertices.max(axis=0), (0.2, 0.8, 0.3), atol=1e-12)
    read, surface = list[str](), LabelledScenes.surface
    noted = lambda source, body: (read.append(body.mesh), surface(source, body))[1]  # noqa: E731
    monkeypatch.setattr(LabelledScenes, "surface", noted)
    for workers in (1, 3):
        pack_rooms(tmp_path / str(workers), SMALL, 4, "test", ("stool",), own, shard_samples=3, workers=workers)
    assert read == ["press"], "a process reads a mesh once"
    pack_rooms(tmp_path / "without", SMALL, 4, "test", ("stool",), shard_samples=3, workers=1)
    assert files(tmp_path / "1") == files(tmp_path / "3")
    shard = next(tmp_path.glob("1/*.tar")).name
    assert files(tmp_path / "1")[shard] != files(tmp_path / "without")[shard]
    box_file(tmp_path / "own/press.off", (41, 80, 60))  # other things are another set
    assert own.digest() not in (tmp_path / "1/manifest.json").read_text()


def test_own_meshes_that_cannot_stand_in_rooms_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["shard", "--source", "rooms", "--samples", "1", "--out", str(tmp_path / "set"), "--scene"]
    good, damaged = box_file(tmp_path / "good/press.off"), tmp_path / "damaged/arm.off"
    damaged.parent.mkdir()
    damaged.write_text("OFF\n3 1 0\n0 0 0\n")
    (tmp_path / "empty").mkdir()
    cases = {
        "--scene: the source 'labelled' reads a folder, found none at": [tmp_path / "none"],
        "--scene: the source 'labelled' needs meshes": [tmp_path / "empty"],
        f"{damaged}: the header announces": [damaged.parent],
        f"{good}: a thing of rooms must be 0.05 to 4 m large, found 80 m; --units gives": [good.parent],
    }
    for said, options in cases.items():
        assert main([*words, *map(str, options)]) == 2
        shown = capsys.readouterr().err
        assert said in shown and shown.count("\n") == 1
    assert main([*words, str(good.parent), "--units", "mm", "--plan"]) == 0
    assert json.loads(capsys.readouterr().out)["scene"] == ["press"]
    assert main([*words[:-1], "--up", "z"]) == 2
    assert "--units and --up are those of the meshes of --scene" in capsys.readouterr().err
    assert main(["shard", "--source", "rooms", "--samples", "0", "--plan"]) == 2
    assert "--samples must be a whole number of at least 1, found 0" in capsys.readouterr().err
    assert main(["shard", "--source", "open", "--scene", "x", "--plan"]) == 2
    assert "--scene does not go with --source open: it is of rooms" in capsys.readouterr().err
    monkeypatch.setattr(room_packing, "_OWN_FACES", 11)
    assert main([*words, str(good.parent), "--units", "cm"]) == 2
    assert f"{good}: a thing of rooms may have 11 triangles, found 12" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


def test_the_command_plans_packs_and_refuses(
    tmp_path: Path, built: list[tuple[str, int]], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["shard", "--source", "rooms", "--rig", "kinect_v1", "--out", str(tmp_path / "set")]
    assert main([*words, "--samples", "2", "--kinds", "stool", "--workers", "1"]) == 0
    assert "2 samples" in capsys.readouterr().out
    assert main([*words, "--samples", "3", "--split", "test", "--plan"]) == 0
    planned = json.loads(capsys.readouterr().out)
    assert planned.pop("people") == sum(
        body.split == "test" for name in ("open", "hard") for body in open_source(name).bodies()
    )
    assert planned == {"source": "rooms", "views": 3, "test": 3, "kinds": list(FURNISHINGS)}
    wrong = {
        "needs --samples": [],
        "everyday or candidates has a pose like flying": ["--samples", "1", "--poses", "flying", "--plan"],
        "samples must be": ["--samples", "0"],
        "found 'sofas'": ["--samples", "1", "--without", "sofas"],
        "--views does not go with --source rooms": ["--samples", "1", "--views", "2"],
        "--path does not go with --source rooms": ["--samples", "1", "--path", "x"],
    }
    for said, options in wrong.items():
        assert main([*words, *options]) == 2
        assert said in capsys.readouterr().err
    assert main(["shard", "--source", "open", "--samples", "1", "--plan"]) == 2
    assert "--samples does not go with --source open: it is of rooms" in capsys.readouterr().err


class Listed:
    """Five plain people of the train split; the third cannot be built."""

    def bodies(self) -> list[BodyRef]:
        return [BodyRef("A", "one", f"mesh{number}", "standing", "train") for number in range(5)]

    def build(self, body: BodyRef) -> Body:
        if body.mesh == "mesh2":
            raise BadMesh("it has a hole")
        return Body(person(body.mesh), np.array(VERTICES))


def test_people_are_drawn_by_their_block_and_split(monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    monkeypatch.setattr(room_packing, "open_source", lambda name: names.append(name) or Listed())
    monkeypatch.setattr(room_packing, "reduced_body", lambda body, *_: body)
    monkeypatch.setattr(room_packing, "_PEOPLE", 4)
    one, again, other = ([each.mesh.name for each in room_packing.draw_people("train", block)] for block in (2, 2, 3))
    assert (len(one), names) == (4, ["wide", "everyday", "candidates"] * 3)
    assert one == again != other
    assert "mesh2" not in {*one, *other}


class Sitters(Listed):
    """Plain people, of whom two sit."""

    def bodies(self) -> list[BodyRef]:
        poses = "standing", "sitting", "on_a_chair", "standing", "walking"
        return [BodyRef("B", "one", f"mesh{number + 9}", pose, "train") for number, pose in enumerate(poses)]


class Walkers(Listed):
    """Somebody who walks."""

    def bodies(self) -> list[BodyRef]:
        return [BodyRef("C", "one", "mesh23", "walking", "train")]


def test_people_are_in_the_poses_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sources = {"wide": Listed(), "everyday": Sitters(), "candidates": Walkers()}
    monkeypatch.setattr(room_packing, "open_source", sources.get)
    monkeypatch.setattr(room_packing, "reduced_body", lambda body, *_: body)
    drawn = room_packing.draw_people("train", 0, ("sit*", "on_*"))  # only one source has such
    assert {person.pose for person in drawn} == {"sitting", "on_a_chair"} and len(drawn) == 20
    assert "standing" in {person.pose for person in room_packing.draw_people("train", 0)}
    assert {person.mesh.name for person in room_packing.draw_people("train", 0, ("w*",))} >= {"mesh13", "mesh23"}
    assert "mesh23" not in {person.mesh.name for person in room_packing.draw_people("train", 0)}
    words = ["shard", "--source", "rooms", "--samples", "1", "--workers", "1", "--out", str(tmp_path / "set")]
    assert main([*words, "--poses", "swims"]) == 2
    told = "has a pose like swims; its poses: on_a_chair, sitting, standing, walking"
    assert capsys.readouterr().err.endswith(f"no body of wide or everyday or candidates {told}\n")
    assert not (tmp_path / "set").exists()


def test_a_set_says_in_which_poses_its_people_are(tmp_path: Path, built: list[tuple[str, int]]) -> None:
    pack_rooms(tmp_path / "set", SMALL, 1, "test", poses=("lying*", "on_the_*"), workers=1)
    assert RangeImages(tmp_path / "set").manifest.source == "rooms, people in poses lying* on_the_*"
    with pytest.raises(BadConfig, match="packed with other options"):
        pack_rooms(tmp_path / "set", SMALL, 1, "test", poses=("lying*",), workers=1)
