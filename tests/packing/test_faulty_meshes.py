"""Folders of meshes that are not perfect: all faults at once before the first view, or a set without the bad meshes."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import pickle
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from fakes import Figures
from people_on_disk import PERSON, VERTICES, write_by_point, write_by_vertex, write_lnd, write_mesh
from small_rig import SMALL

from bodyseg_data.bodies import SOURCES, Body, BodyRef, open_source
from bodyseg_data.commands import main
from bodyseg_data.commands.shard import Options
from bodyseg_data.core import BadConfig, BadMesh, BadSample, BadShard
from bodyseg_data.packing import FaultyMeshes, OnFaults, Packing, pack
from bodyseg_data.packing import packer as packing
from bodyseg_data.packing.writing import STATE_NAME
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import Manifest, read_manifest

POINTS: Final = PERSON.vertices[list(VERTICES)]
SKIP: Final = OnFaults("skip", 0.9)


def people(folder: Path) -> Path:
    """Three good meshes and five that are at fault, one way each."""
    for name in ("good-1", "good-2", "test/good-3"):
        write_mesh(folder / f"{name}.ply")
        write_lnd(folder / f"{name}.lnd", POINTS)
    write_mesh(folder / "cut.ply").write_bytes((folder / "good-1.ply").read_bytes()[:-100])
    write_lnd(folder / "cut.lnd", POINTS)
    write_mesh(folder / "few.ply", faces=PERSON.faces[:-1])
    write_by_vertex(folder / "few.json")
    write_mesh(folder / "inches.ply", PERSON.vertices / 0.0254)
    write_lnd(folder / "inches.lnd", POINTS)
    write_mesh(folder / "misspelt.ply")
    write_lnd(folder / "misspelt.lnd", POINTS, {"Lt. Acromion": "Lt. Akromium"})
    write_mesh(folder / "none.ply")
    return folder


def wanted(folder: Path, **options: Any) -> Packing:
    grid = ViewGrid(span_deg=360, azimuths=4, count=2)
    return Packing("folder", folder, views=grid, rig=SMALL, **{"shard_samples": 3, "geodesics": "edges", **options})


def packed(asked: Packing, out: Path, on_faults: OnFaults = SKIP) -> Manifest:
    with ThreadPoolExecutor(1) as executor:
        return pack(asked, out, executor, 1, on_faults=on_faults)


def samples(manifest: Manifest) -> list[tuple[str, int]]:
    return [(k, c) for shard in manifest.shards for k, c in zip(shard.keys, shard.crc32, strict=True)]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_all_faults_are_reported_before_anything_is_rendered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, checked = people(tmp_path / "people"), []
    monkeypatch.setattr(packing, "render_run", lambda *run: pytest.fail("rendered"))
    with pytest.raises(FaultyMeshes, match=r"^5 of 8 meshes cannot be packed: .*; .*; .*; and 2 more$") as caught:
        packed(wanted(folder), tmp_path / "out", OnFaults(progress=lambda *done: checked.append(done)))
    faults = caught.value.faults
    assert set(faults) == {"cut", "few", "inches", "misspelt", "none"}
    assert "cut.ply" in faults["cut"]
    assert "642 vertices and 1280 faces" in faults["few"] and "found 642 and 1279" in faults["few"]
    assert "cannot find the unit" in faults["inches"] and "Akromium" in faults["misspelt"]
    assert "no none.json" in faults["none"]
    assert checked == [(done, 8) for done in range(1, 9)]
    assert not (tmp_path / "out").exists()


def test_meshes_of_a_finished_set_are_checked_again_only_if_a_file_has_changed(tmp_path: Path) -> None:
    folder, out = people(tmp_path / "people"), tmp_path / "out"
    for name in ("cut", "few", "inches", "misspelt", "none"):
        for file in folder.glob(f"{name}.*"):
            file.unlink()
    checked: list[tuple[int, int]] = []
    on_faults = OnFaults(progress=lambda *done: checked.append(done))
    manifest = packed(wanted(folder), out, on_faults)
    before = contents(out)
    assert checked == [(done, 3) for done in range(1, 4)]
    checked.clear()
    assert packed(wanted(folder), out, on_faults) == manifest
    next(out.glob("*.tar")).unlink()
    assert packed(wanted(folder), out, on_faults) == manifest
    assert contents(out) == before and not checked
    mesh = folder / "good-1.ply"
    whole = mesh.read_bytes()
    mesh.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FaultyMeshes, match="1 of 3 meshes cannot be packed"):
        packed(wanted(folder), out, on_faults)
    mesh.write_bytes(whole)
    (out / "manifest.json").write_text("{")
    with pytest.raises(BadShard, match=r"manifest\.json"):
        packed(wanted(folder), out, on_faults)
    (out / "manifest.json").write_bytes(before["manifest.json"])
    mesh.unlink()
    (folder / "good-1.lnd").unlink()
    with pytest.raises(BadConfig, match="already holds a set of shards packed with other options or from other files"):
        packed(wanted(folder), out, on_faults)


def test_a_line_for_each_reason_names_its_meshes() -> None:
    raised = FaultyMeshes("3 of 9", {"m_1": "no file", "m_2": "no file", "m_9": "cut short"})
    error = pickle.loads(pickle.dumps(raised))  # as of a packing in another process
    assert str(error) == str(raised) == "3 of 9: no file; cut short"
    assert error.lines() == ["m_1 to m_2: no file", "m_9: cut short"]


def test_skipped_meshes_leave_the_set_of_a_folder_without_them(tmp_path: Path) -> None:
    folder, on_faults = people(tmp_path / "people"), OnFaults("skip", 5)
    manifest = packed(wanted(folder), tmp_path / "out", on_faults)
    good = tmp_path / "good" / "people"
    shutil.copytree(folder, good)
    for name in ("cut", "few", "inches", "misspelt", "none"):
        for file in good.glob(f"{name}.*"):
            file.unlink()
    alone = packed(wanted(good), tmp_path / "alone", OnFaults())
    assert samples(manifest) == samples(alone) and len(samples(alone)) == 6
    assert [*manifest.skipped] == ["cut", "few", "inches", "misspelt", "none"]
    assert not any(str(tmp_path) in why for why in manifest.skipped.values()), "paths are those within the folder"
    assert manifest == read_manifest(tmp_path / "out")
    assert f"none: skipped: {manifest.skipped['none']}" in manifest.notes() and not alone.skipped
    # Again, with more in flight, in another process: the same bytes; and into the finished set: nothing changes.
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as other:
        pack(wanted(folder), tmp_path / "again", other, 2, on_faults=SKIP)
    assert contents(tmp_path / "again") == contents(tmp_path / "out")
    assert packed(wanted(folder), tmp_path / "out", on_faults) == manifest


def test_beyond_the_budget_nothing_is_rendered(tmp_path: Path) -> None:
    folder = people(tmp_path / "people")
    for budget in (4, 0.6):
        with pytest.raises(FaultyMeshes, match="5 of 8 meshes cannot be packed, the skip budget allows 4: "):
            packed(wanted(folder), tmp_path / "out", OnFaults("skip", budget))
    assert not (tmp_path / "out").exists()
    for name in ("good-1", "good-2", "test/good-3"):
        (folder / f"{name}.lnd").unlink()
    with pytest.raises(FaultyMeshes, match="^none of 8 meshes can be packed: "):
        packed(wanted(folder), tmp_path / "out", OnFaults("skip", 8))


class Frail(Figures):
    """Figures of which some turn out late that they cannot be built."""

    broken: tuple[str, ...] = ("A-1", "people-2")

    def build(self, body: BodyRef) -> Body:
        if body.mesh in self.broken:
            raise BadMesh(f"mesh {body.mesh}: faces must point outwards")
        return super().build(body)


class Fewer(Figures):
    """The figures that are left, as they are in `Figures`."""

    def bodies(self) -> Sequence[BodyRef]:
        return [body for body in super().bodies() if body.mesh not in Frail.broken]

    def build(self, body: BodyRef) -> Body:
        return Figures.build(Figures(), body)


@pytest.fixture(scope="module")
def known() -> dict[Any, Any]:
    """All that was rendered for this file."""
    return {}


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch, known: dict[Any, Any]) -> Callable[..., Manifest]:
    """Pack figures of some class in threads; what was rendered once is not rendered again."""
    render = packing.render_run

    def remembered(asked: Packing, body: BodyRef, views: tuple[Any, ...], plan: str = "") -> Any:
        key = (type(asked.opened()), body, views)
        if key not in known:
            known[key] = render(asked, body, views, plan)
        return known[key]

    monkeypatch.setattr(packing, "render_run", remembered)

    def packed_figures(
        out: Path, kind: type[Figures], on_faults: OnFaults = SKIP, executor: Executor | None = None
    ) -> Manifest:
        monkeypatch.setitem(SOURCES, "open", kind)
        views = ViewGrid(span_deg=360, count=4)
        asked = Packing("open", views=views, rig=SMALL, shard_samples=3, geodesics="edges")
        with ThreadPoolExecutor(1) as thread:
            return pack(asked, out, executor or thread, 2, on_faults=on_faults)

    return packed_figures


def test_a_mesh_that_fails_late_is_skipped_by_the_same_rule(tmp_path: Path, figures: Callable[..., Manifest]) -> None:
    with pytest.raises(BadMesh, match="^mesh A-1: faces must point outwards$"):
        figures(tmp_path / "out", Frail, OnFaults())
    manifest = figures(tmp_path / "out", Frail)
    assert samples(manifest) == samples(figures(tmp_path / "fewer", Fewer, OnFaults()))
    assert [*manifest.skipped] == ["A-1", "people-2"]
    kept = contents(tmp_path / "out")
    figures(tmp_path / "again", Frail)
    assert contents(tmp_path / "again") == kept
    with pytest.raises(FaultyMeshes, match="2 of 6 meshes cannot be packed, the skip budget allows 1"):
        figures(tmp_path / "budget", Frail, OnFaults("skip", 1))
    with pytest.raises(FaultyMeshes, match="^2 of 6 meshes cannot be packed: mesh A-1"):
        figures(tmp_path / "out", Frail, OnFaults())
    # A shard that is lost is made again without asking the broken meshes.
    lost = sorted((tmp_path / "out").glob("*.tar"))[1]
    lost.unlink()
    figures(tmp_path / "out", Frail)
    assert contents(tmp_path / "out") == kept


class Interrupted(Exception):
    """Ends a packing."""


@pytest.mark.parametrize("renders", range(1, 12, 2))
def test_a_packing_cut_short_skips_the_same(
    renders: int, tmp_path: Path, figures: Callable[..., Manifest], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = figures(tmp_path / "whole", Frail)
    render, left = packing.render_run, [renders]

    def counted(*run: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise Interrupted
        return render(*run)

    monkeypatch.setattr(packing, "render_run", counted)
    with pytest.raises(Interrupted):
        figures(tmp_path / "out", Frail)
    monkeypatch.setattr(packing, "render_run", render)
    assert figures(tmp_path / "out", Frail) == whole
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert not (tmp_path / "out" / STATE_NAME).exists()


def test_a_mesh_that_fails_at_a_later_view_leaves_none_behind(
    tmp_path: Path, figures: Callable[..., Manifest], monkeypatch: pytest.MonkeyPatch
) -> None:
    render = packing.render_run

    def fails(asked: Packing, body: BodyRef, views: tuple[Any, ...], plan: str = "") -> Any:
        if body.mesh in Frail.broken and views[-1] == list(asked.views_of(body))[-1]:
            raise BadSample(f"{body.mesh}: too far away")
        return render(asked, body, views, plan)

    monkeypatch.setattr(packing, "render_run", fails)
    manifest = figures(tmp_path / "out", Figures)
    assert samples(manifest) == samples(figures(tmp_path / "fewer", Fewer, OnFaults()))
    assert {path.name for path in (tmp_path / "out").glob("*.tar")} == {shard.name for shard in manifest.shards}


def test_the_command_repairs_only_if_asked() -> None:
    assert not Options("folder").packing().pymeshlab
    assert Options("folder", pymeshlab=True).packing().pymeshlab


@pytest.mark.usefixtures("pymeshlab")
def test_a_scan_that_cannot_be_repaired_is_skipped(tmp_path: Path) -> None:
    folder = tmp_path / "people"
    write_mesh(folder / "good.ply")
    write_by_point(folder / "good.json", POINTS)
    around, across = 60, np.linspace(-0.1, 0.1, 3)
    turns = np.arange(around) * 2 * np.pi / around
    out = 0.5 + across * np.cos(turns / 2)[:, None]
    strip = np.stack(
        [out * np.cos(turns)[:, None], out * np.sin(turns)[:, None], across * np.sin(turns / 2)[:, None]], 2
    )
    faces = []
    for row in range(around):
        for column in range(2):
            near = [row * 3 + column, row * 3 + column + 1]
            after = (row + 1) % around
            far = [after * 3 + (column if after else 2 - column), after * 3 + (column + 1 if after else 1 - column)]
            faces += [[near[0], near[1], far[0]], [near[1], far[1], far[0]]]
    vertices = strip.reshape(-1, 3)
    write_mesh(folder / "strip.ply", vertices, np.array(faces, np.int32))
    spread = vertices[np.linspace(len(vertices) - 1, 0, 33).astype(int)]  # the other way round, it is mirrored
    write_by_point(folder / "strip.json", spread)
    manifest = packed(wanted(folder, up="y", pymeshlab=True), tmp_path / "out", OnFaults("skip", 1))
    ((mesh, why),) = manifest.skipped.items()
    assert mesh == "strip" and "cannot be repaired" in why


def test_meshes_of_one_group_name_the_mesh_that_decided_their_unit(tmp_path: Path) -> None:
    write_by_vertex(tmp_path / "landmarks.json")
    write_mesh(tmp_path / "a.ply")
    write_mesh(tmp_path / "b.ply", PERSON.vertices * 1000)
    source = open_source("folder", tmp_path)
    problem = rf"b\.ply, in the unit of {tmp_path}/a\.ply: a body must be .*, found .* 1700 .* m, which would fit in mm"
    with pytest.raises(BadMesh, match=problem):
        source.check(source.bodies()[1])
    source = open_source("folder", tmp_path, units="mm")
    with pytest.raises(BadMesh, match=r"a\.ply: a body must be .* mm, which would fit in m$"):
        source.check(source.bodies()[0])
    source.check(source.bodies()[1])


def test_a_mesh_of_a_group_that_cannot_be_read_does_not_stop_the_others(tmp_path: Path) -> None:
    write_by_vertex(tmp_path / "landmarks.json")
    write_mesh(tmp_path / "a.ply", faces=PERSON.faces[:-1])
    write_mesh(tmp_path / "b.ply").write_bytes(b"ply")
    write_mesh(tmp_path / "c.ply")
    manifest = packed(wanted(tmp_path), tmp_path / "out")
    assert [*manifest.skipped] == ["a", "b"] and manifest.samples() == 2


def test_landmarks_in_one_place_and_other_names_are_noted(tmp_path: Path) -> None:
    folder = tmp_path / "people"
    write_mesh(folder / "a.ply")
    both = list(VERTICES)
    both[22] = both[21]
    write_by_vertex(folder / "a.json", tuple(both))
    tree = json.loads((folder / "a.json").read_text())
    tree["landmarks"]["Crotch"] = 5
    (folder / "a.json").write_text(json.dumps(tree))
    write_mesh(folder / "b.ply")
    write_by_point(folder / "b.json", PERSON.vertices[both])
    notes = packed(wanted(folder), tmp_path / "out", OnFaults()).notes()
    assert [note.split(" by ")[0] for note in notes if "in one place" in note] == [
        "a: Lt. Dactylion moved",
        "b: Lt. Dactylion moved",
    ]
    assert "a: 1 other names in the landmark file ignored" in notes


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"on_error": "skip"}, "on_error='skip' needs a skip_budget, found 'skip' and None"),
        ({"skip_budget": 1}, "on_error='skip' needs a skip_budget, found 'stop' and 1"),
        ({"on_error": "skip", "skip_budget": 1.5}, "a number of meshes, or a share below 1, found 1.5"),
        ({"on_error": "skip", "skip_budget": -1}, "a number of meshes, or a share below 1, found -1"),
        ({"on_error": "skip", "skip_budget": float("nan")}, "a share below 1, found nan"),
        ({"on_error": "skip", "skip_budget": float("inf")}, "a share below 1, found inf"),
        ({"on_error": "other"}, "OnFaults: on_error must be 'stop' or 'skip', found 'other'"),
    ],
)
def test_options_that_do_not_fit_are_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        OnFaults(**options)


def test_a_share_of_meshes_is_cut_as_its_decimals_say() -> None:
    for share, meshes, most in [(0.29, 100, 29), (0.57, 100, 57), (0.6, 8, 4), (1 / 3, 3, 1), (7.0, 100, 7), (0, 9, 0)]:
        assert OnFaults("skip", share).budget(meshes) == most
    assert OnFaults("skip", 10**400).budget(9) == 10**400, "which no float holds"


def test_a_state_that_cannot_be_read_is_one_line(tmp_path: Path, figures: Callable[..., Manifest]) -> None:
    with pytest.raises(FaultyMeshes):
        figures(tmp_path / "out", Frail, OnFaults("skip", 1))
    stored = tmp_path / "out" / STATE_NAME / "skipped.json"
    assert json.loads(stored.read_text()) == {"A-1": "mesh A-1: faces must point outwards"}
    for damaged in ('{"A-1"', '{"A-1": 1}'):
        stored.write_text(damaged)
        with pytest.raises(BadConfig, match=r"skipped\.json cannot be read: delete the folder"):
            figures(tmp_path / "out", Frail)


@pytest.mark.usefixtures("packing_here")
def test_the_command_lists_every_fault_then_skips(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = people(tmp_path / "people")
    words = ["shard", "--source", "folder", "--path", str(folder), "--out", str(tmp_path / "out"), "--views", "1"]
    incomplete = "^the source folder is not complete, 1 missing: landmarks of none$"
    with pytest.warns(UserWarning, match=incomplete):
        assert main([*words, "--workers", "1"]) == 2
    lines = capsys.readouterr().err.splitlines()
    listed = [line for line in lines if line.startswith(("cut: ", "few: ", "inches: ", "misspelt: ", "none: "))]
    assert len(listed) == 5
    hint = "--on-error skip --skip-budget N leaves them out"
    ending = f"5 of 8 meshes cannot be packed, for the reasons above; {hint}"
    assert lines[-1] == f"bodyseg shard: {ending}"
    assert any(line.startswith("checking: 8 of 8 meshes") for line in lines)
    for one in (["--on-error", "skip"], ["--skip-budget", "5"]):
        assert main([*words, *one]) == 2
        assert "--on-error skip and --skip-budget, the most meshes" in capsys.readouterr().err
    with pytest.warns(UserWarning, match=incomplete):
        assert main([*words, "--on-error", "skip", "--skip-budget", "5", "--workers", "1"]) == 0
    said = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("skipped ") for line in said) == 5


@pytest.mark.parametrize("skipped", [3, [3], [{"mesh": "a"}], [{"mesh": "a", "why": 1}], [{"mesh": "a", "why": "b\n"}]])
def test_a_manifest_with_other_entries_of_skipped_meshes_is_refused(
    skipped: Any, figures_set: Path, tmp_path: Path
) -> None:
    tree = {key: value for key, value in read_manifest(figures_set).to_json().items() if key != "digest"}
    tree["skipped"] = skipped
    digest = hashlib.sha256(json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
    (tmp_path / "manifest.json").write_text(json.dumps({**tree, "digest": digest}))
    with pytest.raises(BadShard, match="'skipped' must be a list of meshes, each with its name and the reason"):
        read_manifest(tmp_path)
