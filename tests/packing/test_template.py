"""The map of the body: where on the template pixels lie, how the column is packed, and what label maps make of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from packings import Interrupted, Renders, contents
from scipy.spatial import cKDTree
from shapes import evenly_drawn, figure
from small_rig import SMALL
from spheres import icosphere

from bodyseg_data import RangeImages, SensorModel, ShardWriter, load_sensor_model, load_template, loader
from bodyseg_data.artifacts import artifact_class
from bodyseg_data.bodies import Body, BodyRef, region_labels
from bodyseg_data.commands import main
from bodyseg_data.core import BadConfig, BadSample, BadShard
from bodyseg_data.labels import BACKGROUND, NOWHERE, PARTS33, UNLABELLED, label_map_from_json, load_label_map
from bodyseg_data.loading import CameraImage, Flip, Transform
from bodyseg_data.meshes import Mesh, SurfacePiece
from bodyseg_data.packing import Packing, Sampler, plan
from bodyseg_data.packing.writing import STATE_NAME
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.samples import View
from bodyseg_model.commands import cli

Pack = Callable[..., Path]
POINTS = load_template().points
PART_SETS = {"template33": 33, "joints24": 24, "densepose24": 24, "human3d15": 15}


def clothed() -> Body:
    """The figure with a ball of cloth about its head, and a thing before its trunk."""
    bare = figure()
    cloth, thing = (icosphere(2, 1.0)[0] * size + at for size, at in ((0.15, (0, 1.58, 0)), (0.05, (-0.1, 1.2, 0.2))))
    faces = icosphere(2, 1.0)[1]
    starts = len(bare.vertices), len(bare.vertices) + len(cloth)
    vertices = np.concatenate([bare.vertices, cloth, thing])
    mesh = Mesh("clothed", vertices, np.concatenate([bare.faces, faces + starts[0], faces + starts[1]]))
    pieces = SurfacePiece(starts[0], tuple(range(33))), SurfacePiece(starts[1])
    return Body(mesh, evenly_drawn(bare), pieces=pieces, template=lambda: bare.vertices * (1.0, 1.05, 1.0))


def first_hits(mesh: Mesh, origin: Any, ways: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The nearest triangle that each ray from `origin` [3] along `ways` [N, 3] hits, its corners' weights, and how far.

    Moeller and Trumbore, Fast minimum storage ray/triangle intersection, 1997.
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    ab, ac, away = b - a, c - a, origin - a
    across = np.cross(ways[:, None], ac[None])
    scale = np.einsum("fi,nfi->nf", ab, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("fi,nfi->nf", away, across) / scale
        turned = np.cross(away, ab)
        v = ways @ turned.T / scale
        far = np.einsum("fi,fi->f", ac, turned) / scale
    far[~((u >= 0) & (v >= 0) & (u + v <= 1) & (far > 0))] = np.inf
    face, rays = far.argmin(axis=1), np.arange(len(ways))
    u, v = u[rays, face], v[rays, face]
    return face, np.stack([1 - u - v, u, v], axis=1), far[rays, face]


def test_a_pixel_has_the_point_nearest_to_where_its_ray_hits(quick_geodesics: None) -> None:
    body, view = clothed(), View(215, 0)
    mesh, parts, ref = body.mesh, body.partition(), BodyRef("A", "A", "A-0", "standing", "train")
    assert body.template is not None and parts.below is not None
    template = body.template()
    sample = Sampler(RasterRenderer(mesh), SMALL, mesh, parts, "open", ref, template=template).take(view)
    plane = sample.planes["template"]
    assert plane.dtype == np.uint16 and (plane[sample.range == 0] == NOWHERE).all()

    camera, _ = SMALL.placed(mesh.centre, view)
    rows, columns = (each[::6] for each in np.nonzero(sample.range))
    rays = np.ones((len(rows), 3))
    rays[:, 0] = (columns + 0.5 - SMALL.camera.centre_px[0]) / SMALL.camera.focal_px
    rays[:, 1] = (rows + 0.5 - SMALL.camera.centre_px[1]) / SMALL.camera.focal_px
    face, weights, far = first_hits(mesh, camera.position, camera.to_body(rays) - camera.position)
    seen = np.abs(far - sample.range[rows, columns] * SMALL.range_step_m) < SMALL.range_step_m
    assert seen.mean() > 0.98, "all but some at outlines"
    wanted, kinds = np.full((len(rows), 3), np.nan), set()
    for at in np.flatnonzero(seen):
        corners = mesh.faces[face[at]]
        if corners[0] < len(template):
            wanted[at] = weights[at] @ template[corners]
            kinds.add("body")
        elif corners[0] < len(template) + len(icosphere(2, 1.0)[0]):
            corner = mesh.vertices[corners[weights[at].argmax()]]
            wanted[at] = template[np.linalg.norm(mesh.vertices[: len(template)] - corner, axis=1).argmin()]
            kinds.add("cloth")
        else:
            kinds.add("thing")
            assert sample.labels[rows[at], columns[at]] == UNLABELLED and plane[rows[at], columns[at]] == NOWHERE
    assert kinds == {"body", "cloth", "thing"}
    placed = np.flatnonzero(seen & np.isfinite(wanted[:, 0]))
    chosen = POINTS[plane[rows[placed], columns[placed]]]
    off = np.linalg.norm(chosen - wanted[placed], axis=1)
    least = cKDTree(POINTS).query(wanted[placed])[0]
    assert np.median(np.abs(off - least)) < 1e-5 and (np.abs(off - least) < 1e-3).mean() > 0.97


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory, pack_figures: Pack) -> Path:
    """The figures with the map of the body."""
    return pack_figures(tmp_path_factory.mktemp("mapped") / "set", shard_samples=5, template=True)


def test_the_bytes_are_the_same_however_they_are_packed(mapped: Path, tmp_path: Path, pack_figures: Pack) -> None:
    wanted = contents(mapped)
    own = {name: digest for name, digest in wanted.items() if "template" not in name and name != "columns.json"}
    rendered: dict[Any, Any] = {}
    with pytest.raises(Interrupted):
        pack_figures(tmp_path / "cut", Renders(rendered, 4), shard_samples=5, template=True)
    with ThreadPoolExecutor(2) as two:
        pack_figures(tmp_path / "cut", two, shard_samples=5, template=True)
    assert contents(tmp_path / "cut") == wanted
    pack_figures(tmp_path / "later", Renders(rendered), shard_samples=5)
    assert contents(tmp_path / "later") == own, "a column changes nothing of the set"
    with pytest.raises(Interrupted):
        pack_figures(tmp_path / "later", Renders(rendered, 2), shard_samples=5, template=True)
    assert len(RangeImages(tmp_path / "later", "none")) == 24, "the set stays whole while it gets a column"
    pack_figures(tmp_path / "later", Renders(rendered), shard_samples=5, template=True)
    assert contents(tmp_path / "later") == wanted and not (tmp_path / "later" / STATE_NAME).exists()
    damaged = tmp_path / "later" / "train-00001.template.tar"
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    pack_figures(tmp_path / "later", Renders(rendered), shard_samples=5, template=True)
    assert contents(tmp_path / "later") == wanted


def test_bodies_of_another_topology_have_no_map(tmp_path: Path, pack_figures: Pack) -> None:
    with pytest.raises(BadConfig, match="the map of the body needs whole meshes, found a tolerance of 1 mm"):
        Packing("open", template=True, tolerance_mm=1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fakes.Figures.on_template", False)
        with pytest.raises(BadConfig, match="needs bodies that are made, found the source 'open'"):
            pack_figures(tmp_path / "set", template=True)
        patch.setattr("bodyseg_data.bodies.sources.open_bodies.OpenBodies.on_template", False)
        with pytest.raises(BadConfig, match="needs bodies that are made, found the source 'open'"):
            plan(Packing("open", template=True))
    assert not (tmp_path / "set").exists()


@dataclass(frozen=True)
class Upside(Transform):
    """Turns images upside down, and fails unless its labels are regions of the template."""

    name = "upside"

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        assert "spine03" in image.classes.names
        return replace(image, range=image.range[::-1].copy(), labels=image.labels[::-1].copy())


@pytest.mark.parametrize("variant", ["none", "all"])
def test_part_sets_follow_from_the_map(mapped: Path, variant: str) -> None:
    plain = RangeImages(mapped, variant, planes=["template"])
    for name, count in PART_SETS.items():
        images = RangeImages(mapped, variant, labels=name)
        assert len(images.label_map) == count and images.label_map.has_mirror_image
        regions = region_labels(images.label_map)
        for index in (0, 9):
            one, item = plain[index], images[index]
            assert "planes" not in item and torch.equal(one["range"], item["range"])
            kept = one["range"].numpy()[0] > 0
            places = one["planes"]["template"].numpy()
            wanted = images.label_map.table[regions[places]]
            np.testing.assert_array_equal(item["labels"].numpy(), np.where(kept, wanted, BACKGROUND))
            if name == "template33":
                np.testing.assert_array_equal(wanted[kept], load_template().parts[places[kept]])
            stored = images.clean(index)
            assert ((stored.labels == BACKGROUND) == (stored.range == 0)).all(), "no figure holds a thing"
    upside = RangeImages(mapped, variant, labels="joints24", transform=Upside())
    straight = RangeImages(mapped, variant, labels="joints24")
    assert torch.equal(upside[3]["labels"], straight[3]["labels"].flip(0))


def test_artifacts_are_of_the_sets_own_parts_whatever_the_labels(mapped: Path) -> None:
    head = SensorModel("head", (artifact_class("patch_loss")(low=1.0, high=1.0, parts=("Sellion", "Nuchale")),))
    for sensor in (head, load_sensor_model("paper_phase_shift")):
        plain, regions, clean = (
            RangeImages(mapped, variant, sensor=sensor, labels=labels)
            for variant, labels in (("all", None), ("all", "densepose24"), ("none", "densepose24"))
        )
        for index in (0, 9):
            one, other = plain.image(index), regions.image(index)
            assert (one.range == 0).sum() > (clean.image(index).range == 0).sum()
            np.testing.assert_array_equal(one.range, other.range)
            wanted = np.where(one.range > 0, clean.image(index).labels, BACKGROUND)
            np.testing.assert_array_equal(other.labels, wanted)


def test_a_mirrored_body_shows_the_points_of_its_other_side(mapped: Path) -> None:
    straight, flipped = (RangeImages(mapped, "none", transform=each, planes=["template"]) for each in ((), Flip(1.0)))
    for index in (0, 9):
        before, after = (images[index]["planes"]["template"].numpy() for images in (straight, flipped))
        before = before[:, ::-1]
        np.testing.assert_array_equal(after == NOWHERE, before == NOWHERE)
        seen = after != NOWHERE
        off = np.linalg.norm(POINTS[after[seen]] - POINTS[before[seen]] * (-1, 1, 1), axis=1)
        assert 0 < off.max() < 0.012 and np.ptp(POINTS[after[seen], 0]) > 0.1


def test_a_map_stays_one_after_a_transform_that_makes_a_new_image(mapped: Path) -> None:
    def made_anew(image: CameraImage, random: np.random.Generator) -> CameraImage:
        facts = image.drawn, image.step_m, image.focal_px, image.centre_px, image.sample
        return CameraImage(image.key, image.range, image.labels, *facts, planes=image.planes)

    planes = [
        RangeImages(mapped, "none", transform=each, planes=["template"]).image(0).planes["template"]
        for each in (Flip(1.0), (made_anew, Flip(1.0)))
    ]
    np.testing.assert_array_equal(*planes)


@pytest.mark.parametrize("method", ["thread", "process"])
def test_batches_have_the_labels_of_single_images(mapped: Path, method: Any) -> None:
    images = RangeImages(mapped, "all", labels="joints24", planes=["template"], epoch=1)
    single = {each["key"]: each for each in (images[index] for index in range(len(images)))}
    shapes = set()
    for batch in loader(images, 10, 2, worker_method=method):
        shapes.add((batch["labels"].shape[1:], batch["planes"]["template"].shape))
        for at, key in enumerate(batch["key"]):
            assert torch.equal(batch["labels"][at], single[key]["labels"])
            assert torch.equal(batch["planes"]["template"][at], single[key]["planes"]["template"])
    assert {rest[0] for _, rest in shapes} == {10, 4} and {rest for rest, _ in shapes} == {images.shape}
    for one, other in zip(images.webdataset(1), (images[1, at] for at in range(3)), strict=False):
        assert one["key"] == other["key"] and torch.equal(one["labels"], other["labels"])


def test_states_and_stored_maps_name_their_regions(mapped: Path, tmp_path: Path, quick_geodesics: None) -> None:
    images = RangeImages(mapped, "none", labels="joints24")
    stored = label_map_from_json(json.loads(json.dumps(images.label_map.to_json())), "a card")
    assert stored.template is None and stored == images.label_map
    again = RangeImages(mapped, "none", labels=stored)
    assert torch.equal(again[0]["labels"], images[0]["labels"]) and again.identity() == images.identity()
    other = {"landmarks": (3, 900), "parts": (5, 900)}
    maps = [
        written(tmp_path / f"{name}.toml", "landmarks", regions=f"a = {a}\nb = {b}") for name, (a, b) in other.items()
    ]
    one, two = (RangeImages(mapped, "none", labels=path).identity() for path in maps)
    assert one["regions"] != two["regions"]
    renamed = replace(stored, name="others")
    with pytest.raises(BadConfig, match="labels 'others' are of other classes than the set's"):
        RangeImages(mapped, "none", labels=renamed)


def test_a_set_without_the_map_says_so(
    mapped: Path, figures_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shape = (SMALL.camera.rows, SMALL.camera.columns)
    with ShardWriter(tmp_path, rig=SMALL, classes=["wall"]) as out:
        plane = np.zeros(shape, np.uint16)
        out.write(key="a", range_m=np.full(shape, 2.0), labels=plane, planes={"template": plane})  # its own: no column
    for folder in (figures_set, tmp_path):
        with pytest.raises(
            BadConfig, match="no map of the body, the column 'template', which labels 'joints24' need: `shard"
        ):
            RangeImages(folder, "none", labels="joints24")
    images = RangeImages(mapped, "none", labels="joints24")
    with pytest.raises(BadSample, match="labels 'joints24' need the column 'template'"):
        images.make({"__key__": images.keys[0], **images.reader.members(0, 0)[1]})
    monkeypatch.setattr("bodyseg_data.bodies.load_template", lambda: replace(load_template(), name="new"))
    with pytest.raises(BadShard, match="the column 'template' is of another template: 'anny 11 mm 1', here 'new'"):
        RangeImages(mapped, "none", labels="joints24")


def test_commands_know_the_column(mapped: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(mapped)]) == 0
    assert "columns: template: no fault" in capsys.readouterr().out
    assert main(["inspect", str(mapped), "--json", "--labels", "human3d15", "--variant", "none"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["columns"] == ["template"] and found["planes"] == {"template": "uint16"}
    assert len(found["class_shares"]) == 15 and sum(found["class_shares"].values()) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("labels", ["limbs14", "template33", "joints24"])
def test_exported_parts_are_one_persons_also_by_labels_of_the_template(
    mapped: Path, tmp_path: Path, labels: str
) -> None:
    words = ["export-labels", str(mapped), "--format", "panoptic", "--labels", labels]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    told = json.loads((tmp_path / "out" / "panoptic.json").read_text())
    assert {segment["instance"] for image in told["annotations"] for segment in image["segments_info"]} == {1}
    assert all(category["isthing"] for category in told["categories"])


def written(path: Path, template: str, classes: str | None = None, regions: str | None = None) -> Path:
    tables = "".join(f"[{name}]\n{text}\n" for name, text in (("classes", classes), ("regions", regions)) if text)
    path.write_text(f'format = "bodyseg labels 1"\nname = "{path.stem}"\ntemplate = "{template}"\n{tables}')
    return path


def test_own_landmarks_and_numbers_make_parts(tmp_path: Path, quick_geodesics: None) -> None:
    template = load_template()
    vertices = template.vertices
    ends, head = [int(vertices[:, 0].argmax()), int(vertices[:, 0].argmin())], int(vertices[:, 1].argmax())
    path = written(tmp_path / "own.toml", "landmarks", regions=f"left = {ends[0]}\nright = {ends[1]}\ntop = {head}")
    own = load_label_map(path)
    regions = region_labels(own)[: len(POINTS)]
    assert own.names == ("left", "right", "top") and own.mirrored[:3].tolist() == [1, 0, 2]
    assert regions[template.nearest(vertices[[*ends, head]])].tolist() == [0, 1, 2]
    assert (region_labels(own)[len(POINTS) :] == UNLABELLED).all()
    assert (POINTS[regions == 0, 0] > -0.03).all() and (POINTS[regions == 1, 0] < 0.03).all()

    for name, places in (("vertices", vertices), ("points", POINTS)):
        np.save(tmp_path / f"{name}.npy", np.where(places[:, 1] > 1, 7, 5))
        path = written(tmp_path / "halves.toml", f"{name}.npy", 'all = ["low", "high"]', "low = 5\nhigh = 7")
        found = region_labels(load_label_map(path))[: len(POINTS)]
        clear = np.abs(POINTS[:, 1] - 1) > 0.08
        assert (found[clear] == (POINTS[clear, 1] > 1)).all() and len(load_label_map(path)) == 1


def test_the_template_is_sound_and_its_parts_mirror_each_other() -> None:
    template = load_template()
    assert len(POINTS) == len(template.parts) == len(template.bones) < NOWHERE
    assert template.vertices.shape == (13_718, 3) and template.faces.shape == (27_420, 3)
    assert np.linalg.norm(POINTS[template.nearest(template.vertices)] - template.vertices, axis=1).max() < 0.0125
    np.testing.assert_array_equal(template.nearest(POINTS), np.arange(len(POINTS)))
    opposite = template.nearest(POINTS * (-1.0, 1.0, 1.0))
    for name in PART_SETS:
        label_map = load_label_map(name)
        classes = label_map.table[region_labels(label_map)[: len(POINTS)]]
        assert np.unique(classes).tolist() == list(range(PART_SETS[name])), "every point has one"
        assert (label_map.mirrored[classes[opposite]] == classes).mean() > 0.95
    assert load_label_map("template33").of == PARTS33.of


@pytest.mark.parametrize(
    ("template", "classes", "regions", "message"),
    [
        (
            "skin",
            "a = []",
            None,
            "'template' must be parts33, bones, landmarks or the path of a .npy file, found 'skin'",
        ),
        ("landmarks", None, None, "the table \\[regions\\] must give each region a whole number, found {}"),
        ("landmarks", None, "a = 1.5", "must give each region a whole number, found {'a': 1.5}"),
        ("landmarks", None, "a = 70000", "'a' must be a vertex of the template, 0 to 13717, found 70000"),
        ("landmarks", None, "a = 5\nb = 5", "landmarks must lie in different places, found a and b"),
        ("landmarks", 'x = ["c"]', "a = 5", "'c' is none of the classes 'regions'"),
        ("bones", None, None, "must give each region a whole number, found {}"),
        ("bones", 'a = ["tail"]', None, "the template has no bone 'tail'; it has root, pelvis.L"),
        ("bones", 'a = ["head up"]', None, "a half of a bone must be front, back, left, right, found 'head up'"),
        ("bones", 'a = ["toe*.L"]\nb = ["toe1-1.L"]', None, "points are in one region, found some in 'toe\\*.L' and"),
        ("gone.npy", None, "a = 1", "cannot read .*gone.npy"),
        ("short.npy", None, "a = 1", "a whole number for each of [0-9]+ points of the template or of Anny's 13718"),
        ("ones.npy", None, "a = 1\nb = 2", "ones.npy must hold the number of 'b', no 2 is there"),
    ],
)
def test_bad_regions_are_one_line(
    tmp_path: Path, template: str, classes: str | None, regions: str | None, message: str
) -> None:
    np.save(tmp_path / "short.npy", np.ones(5, np.int64))
    np.save(tmp_path / "ones.npy", np.ones(13_718, np.uint8))
    with pytest.raises(BadConfig, match=message) as caught:
        region_labels(load_label_map(written(tmp_path / "bad.toml", template, classes, regions)))
    assert "\n" not in str(caught.value) and "bad" in str(caught.value)
    with pytest.raises(BadConfig, match="labels 'limbs14' join classes of a set, not regions of the template"):
        region_labels(load_label_map("limbs14"))
