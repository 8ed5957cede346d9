"""The whole of the paper: 2329 names in three folders, counted without reading one; small trees through packing."""

from __future__ import annotations

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from people_on_disk import PERSON, VERTICES, turn, write_by_vertex, write_lnd, write_mesh

from bodyseg_data.bodies import BodyRef, open_source
from bodyseg_data.bodies.sources.paper import MIT_MESHES, SCAPE_MESHES, PaperBodies
from bodyseg_data.commands import cli
from bodyseg_data.core import BadConfig, BadLandmarks
from bodyseg_data.packing import Packing, pack, plan
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import read_manifest


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every file of the paper's three sources, with nothing in it. Tests must not change it."""
    root = tmp_path_factory.mktemp("paper")
    names = [f"SCAPE/{name}" for name in SCAPE_MESHES] + [f"mit/{name}" for name in MIT_MESHES]
    names += [f"Caesar/csr{number:04d}a.{kind}" for number in range(1, 584) for kind in ("ply", "lnd")]
    names += ["SCAPE/landmarks.json", "mit/landmarks_C.json"]
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


def small(root: Path) -> Path:
    """One body of each subset, each held by its file in another way."""
    write_mesh(root / "scape" / "mesh000.ply", PERSON.vertices @ turn("x", "z"))
    write_by_vertex(root / "scape" / "landmarks.json")
    for sequence in ("I_jumping", "D_march"):
        write_mesh(root / "mit" / sequence / "meshes" / "mesh_0000.obj", PERSON.vertices @ turn("z", "y"))
    for subject in "BC":
        write_by_vertex(root / "mit" / f"landmarks_{subject}.json")
    write_mesh(root / "caesar" / "csr0001a.ply", PERSON.vertices @ turn("-x", "z") * 1000)
    write_lnd(root / "caesar" / "csr0001a.lnd", PERSON.vertices[list(VERTICES)] @ turn("-x", "z"))
    return root


def test_the_papers_counts_come_out_exactly(complete: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["shard", "--source", "paper", "--path", str(complete), "--plan"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert json.loads(captured.out) == {
        "source": "paper",
        "meshes": 2329,
        "views": 125766,
        "train": 97146,
        "test": 28620,
        "views_per_mesh": 54,
        "subsets": {
            "A": {"meshes": 71, "views": 71 * 54, "train": 57 * 54, "test": 14 * 54},
            "B": {"meshes": 825, "views": 825 * 54, "train": 675 * 54, "test": 150 * 54},
            "C": {"meshes": 850, "views": 850 * 54, "train": 600 * 54, "test": 250 * 54},
            "people": {"meshes": 583, "views": 583 * 54, "train": 467 * 54, "test": 116 * 54},
        },
    }
    source = open_source("paper", complete)
    assert source.missing() == () and len({body.mesh for body in source.bodies()}) == 2329


@pytest.mark.parametrize(("source", "meshes", "train"), [("SCAPE", 71, 57), ("mit", 1675, 1275), ("Caesar", 583, 467)])
def test_each_part_counts_alone(complete: Path, source: str, meshes: int, train: int) -> None:
    counts = plan(Packing(source.lower(), complete / source))
    assert (counts["meshes"], counts["train"]) == (meshes, train * 54) and "missing" not in counts


def test_what_is_missing_is_named_in_plan_and_warning(
    complete: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "part"
    shutil.copytree(complete / "mit", root / "MIT")
    shutil.copytree(complete / "Caesar", root / "caesar")
    for number in (7, 8, 9, 30):
        (root / "MIT" / "D_squat" / "meshes" / f"mesh_{number:04d}.obj").unlink()
    (root / "MIT" / "landmarks_C.json").unlink()
    (root / "caesar" / "csr0583a.ply").unlink()
    told = (
        r"^the source paper is not complete, 77 missing: scape/mesh000.ply to mesh050.ply, scape/mesh052.ply to "
        r"mesh071.ply, mit/landmarks_C.json \(for D_bouncing, D_handstand, D_march, D_squat\), and 3 more such "
        r"\(--plan lists all\)$"
    )
    with pytest.warns(UserWarning, match=told):
        assert cli.main(["shard", "--source", "paper", "--path", str(root), "--plan"]) == 0
    captured = capsys.readouterr()
    assert not captured.err
    counts = json.loads(captured.out)
    assert counts["meshes"] == 2329 - 71 - 4 - 1
    assert counts["missing"] == [
        "scape/mesh000.ply to mesh050.ply",
        "scape/mesh052.ply to mesh071.ply",
        "mit/landmarks_C.json (for D_bouncing, D_handstand, D_march, D_squat)",
        "mit/D_squat/meshes/mesh_0007.obj to mesh_0009.obj",
        "mit/D_squat/meshes/mesh_0030.obj",
        "caesar/subject 583",
    ]


def test_every_part_is_read_as_its_own_source_reads_it(tmp_path: Path) -> None:
    source = PaperBodies(small(tmp_path))
    assert [body.mesh for body in source.bodies()] == ["mesh000", "I_jumping_0000", "D_march_0000", "csr0001a"]
    for ref in source.bodies():
        body = source.build(ref)
        np.testing.assert_allclose(body.mesh.vertices, PERSON.vertices, atol=1e-9)
        assert body.landmarks.tolist() == list(VERTICES)
    prints = {source.fingerprint([body]) for body in source.bodies()} | {source.fingerprint(source.bodies())}
    assert len(prints) == 4, "the frames of B and C hold the same bytes; a packing's plan has their names too"
    with pytest.raises(BadConfig, match="'paper' has no body 'mesh001'"):
        source.build(BodyRef("A", "A", "mesh001", "posture", "train"))


def test_landmarks_may_lie_in_a_folder_like_the_papers(tmp_path: Path) -> None:
    root, marks = small(tmp_path / "paper"), tmp_path / "marks"
    (root / "scape" / "landmarks.json").unlink()
    with pytest.raises(BadLandmarks, match=r"put landmarks\.json there"):
        PaperBodies(root).fingerprint(PaperBodies(root).bodies())
    others = [VERTICES[2], VERTICES[1], VERTICES[0], *VERTICES[3:]]  # chin for nose
    write_by_vertex(marks / "SCAPE" / "landmarks.json", others)
    source = PaperBodies(root, marks)
    assert source.build(source.bodies()[0]).landmarks.tolist() == others
    assert source.build(source.bodies()[3]).landmarks.tolist() == list(VERTICES)
    with pytest.raises(BadConfig, match="landmarks of the source 'paper' are a folder like its own"):
        PaperBodies(root, root / "mit" / "landmarks_B.json")
    with pytest.raises(BadConfig, match="--landmarks must hold .* scape, mit, caesar: found none"):
        PaperBodies(root, marks / "SCAPE")


def test_a_folder_that_holds_none_of_it_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match="'paper' needs .* scape, mit, caesar: found none in"):
        PaperBodies(tmp_path)
    (tmp_path / "scape").mkdir()
    with pytest.raises(BadConfig, match="'scape' needs mesh000"):
        PaperBodies(tmp_path)
    (tmp_path / "SCAPE").mkdir()
    with pytest.raises(BadConfig, match="must hold one folder scape, found SCAPE and scape"):
        PaperBodies(tmp_path)


def test_meshes_called_alike_are_refused(tmp_path: Path) -> None:
    small(tmp_path)
    (tmp_path / "caesar" / "mesh000.ply").touch()
    with pytest.raises(BadConfig, match="meshes must have different names"):
        PaperBodies(tmp_path)


@pytest.mark.usefixtures("pymeshlab")
def test_a_part_packs_and_notes_what_was_mended(tmp_path: Path) -> None:
    root = small(tmp_path / "paper")
    faces = PERSON.faces.copy()
    faces[::7] = faces[::7, ::-1]
    write_mesh(root / "caesar" / "csr0001a.ply", PERSON.vertices @ turn("-x", "z") * 1000, faces)
    out = tmp_path / "shards"
    with ThreadPoolExecutor(1) as executor:
        pack(Packing("paper", root, views=ViewGrid(count=2), pymeshlab=True), out, executor, 1)
    manifest = read_manifest(out)
    assert manifest.samples() == 8 and manifest.source == "paper"
    assert any(note.startswith("csr0001a: repaired: ") for shard in manifest.shards for note in shard.notes)
    keys = [key for shard in manifest.shards for key in shard.keys]
    assert len(set(keys)) == 8 and keys[0].startswith("paper-A-mesh000-d")
