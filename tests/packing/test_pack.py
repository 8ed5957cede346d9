from __future__ import annotations

import contextlib
import json
import os
import signal
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import warm
from fakes import Figures
from folders import HELPERS
from packings import Interrupted, Renders, contents
from small_rig import SMALL_FILE

from bodyseg_data.bodies import SOURCES, Body, BodyRef, open_source
from bodyseg_data.commands import main
from bodyseg_data.core import BadConfig, BadMesh
from bodyseg_data.loading import RangeImages
from bodyseg_data.meshes import Partition
from bodyseg_data.packing import Packing, plan
from bodyseg_data.packing.options import evenly_sampled
from bodyseg_data.packing.writing import STATE_NAME, claimed
from bodyseg_data.samples import ViewGrid
from bodyseg_data.samples.views import Drawn
from bodyseg_data.shards import read_manifest

Pack = Callable[..., Path]


def test_packing_twice_gives_the_same_bytes(figures_set: Path, tmp_path: Path, pack_figures: Pack) -> None:
    assert contents(pack_figures(tmp_path / "again", shard_samples=5)) == contents(figures_set)


def test_shard_size_changes_how_samples_are_cut_and_nothing_else(
    figures_set: Path, tmp_path: Path, pack_figures: Pack
) -> None:
    other = read_manifest(pack_figures(tmp_path / "other", shard_samples=7))
    ours = read_manifest(figures_set)
    listed = [
        [(key, crc) for shard in manifest.shards for key, crc in zip(shard.keys, shard.crc32, strict=True)]
        for manifest in (ours, other)
    ]
    assert listed[0] == listed[1]
    assert [len(shard) for shard in other.shards] == [7, 7, 2, 7, 1]


def test_views_drawn_from_ranges_are_the_same_however_they_are_packed(tmp_path: Path, pack_figures: Pack) -> None:
    views = ViewGrid(span_deg=360, count=3, pitch_deg=Drawn(-30, 10), roll_deg=(0, 5), height_cm=Drawn(-20, 20))
    wanted: dict[str, Any] = {"views": views, "meshes": 3, "shard_samples": 4}
    once = pack_figures(tmp_path / "once", **wanted)
    rendered: dict[Any, Any] = {}
    with pytest.raises(Interrupted):
        pack_figures(tmp_path / "again", Renders(rendered, 2), **wanted)
    with ThreadPoolExecutor(2) as two:
        pack_figures(tmp_path / "again", two, **wanted)
    assert contents(tmp_path / "again") == contents(once)
    keys = [key for shard in read_manifest(once).shards for key in shard.keys]
    drawn = {key.partition("-d")[2] for key in keys}
    assert len(keys) == 9 and len(drawn) == 9, "every body has views of its own"
    for variant in ("none", "all"):
        assert len(list(RangeImages(once, variant))) == 9
    images = RangeImages(once, "none")
    assert [images.clean(index).info.view.name for index in range(9)] == [
        f"d{key.rpartition('-d')[2]}" for key in images.keys
    ]
    other = replace(views, pitch_deg=Drawn(-30, 11))
    with pytest.raises(BadConfig, match="already holds a set of shards packed with other options"):
        pack_figures(once, **wanted | {"views": other})


def test_no_mesh_has_views_on_both_sides(figures_set: Path) -> None:
    sides: dict[str, set[str]] = {}
    for shard in read_manifest(figures_set).shards:
        for key in shard.keys:
            sides.setdefault(key.rpartition("-d")[0], set()).add(shard.split)
    assert len(sides) == 6
    assert all(len(splits) == 1 for splits in sides.values())


@pytest.fixture(scope="module")
def known() -> dict[Any, Any]:
    """All that was rendered for this file: packing is cut short and taken up dozens of times."""
    return {}


@pytest.mark.parametrize("renders", range(9))
def test_a_packing_cut_short_carries_on_to_the_same_bytes(
    renders: int, figures_set: Path, tmp_path: Path, pack_figures: Pack, known: dict[Any, Any]
) -> None:
    out = tmp_path / "shards"
    with pytest.raises(Interrupted):
        pack_figures(out, Renders(known, renders), shard_samples=5)
    assert not (out / "manifest.json").exists(), "an unfinished set must not look finished"
    whole = contents(figures_set)
    assert all(whole[path.name] == contents(out)[path.name] for path in out.glob("*.tar"))
    pack_figures(out, Renders(known), shard_samples=5)
    assert contents(out) == whole
    assert not (out / STATE_NAME).exists()


def test_a_restart_renders_only_what_is_missing(tmp_path: Path, pack_figures: Pack, known: dict[Any, Any]) -> None:
    out = tmp_path / "shards"
    with pytest.raises(Interrupted):
        pack_figures(out, Renders(known, 4), shard_samples=4)  # one shard a mesh
    finished = {path.name for path in out.glob("*.tar")}
    assert finished
    pack_figures(out, Renders(known, 6 - len(finished)), shard_samples=4)


def test_notes_of_a_body_are_in_the_shard_where_it_begins_also_after_a_restart(
    tmp_path: Path, pack_figures: Pack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    build, divide = Figures.build, Body.partition
    monkeypatch.setattr(
        Figures, "build", lambda self, body: replace(build(self, body), notes=("closed 2 holes",) * (body.mesh < "B"))
    )

    def parted(body: Body, *rest: Any, **options: Any) -> Partition:
        parts = divide(body, *rest, **options)
        note = "by the edge graph: an edge has three faces"
        return replace(parts, note=note) if body.mesh.name == "people-1" else parts

    monkeypatch.setattr(Body, "partition", parted)
    out, known = tmp_path / "shards", dict[Any, Any]()
    with pytest.raises(Interrupted):
        pack_figures(out, Renders(known, 4), shard_samples=5)
    pack_figures(out, Renders(known), shard_samples=5)
    manifest = read_manifest(out)
    graph = "people-1: by the edge graph: an edge has three faces"
    assert {shard.name: shard.notes for shard in manifest.shards if shard.notes} == {
        "train-00000.tar": ("A-0: closed 2 holes", "A-1: closed 2 holes"),  # A-1 goes on in the next one
        "train-00002.tar": (graph,),
        "test-00000.tar": ("A-2: closed 2 holes",),
    }
    assert main(["inspect", str(out), "--json"]) == 0
    listed = ["A-0: closed 2 holes", "A-1: closed 2 holes", graph, "A-2: closed 2 holes"]
    assert json.loads(capsys.readouterr().out)["notes"] == listed
    assert main(["verify", str(out)]) == 0
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")] == [
        f"note: {line}" for line in listed
    ]


def test_a_finished_shard_that_was_altered_is_made_again(
    tmp_path: Path, figures_set: Path, pack_figures: Pack, known: dict[Any, Any]
) -> None:
    out = tmp_path / "shards"
    with pytest.raises(Interrupted):
        pack_figures(out, Renders(known, 5), shard_samples=5)
    first = out / "train-00000.tar"
    first.write_bytes(first.read_bytes()[:-1] + b"x")
    pack_figures(out, Renders(known), shard_samples=5)
    assert contents(out) == contents(figures_set)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "[]", '"\\ud800"', "NaN"])
def test_records_that_say_nothing_are_made_again(
    text: str, tmp_path: Path, figures_set: Path, pack_figures: Pack, known: dict[Any, Any]
) -> None:
    out = tmp_path / "shards"
    with pytest.raises(Interrupted):
        pack_figures(out, Renders(known, 4), shard_samples=5)
    records = list((out / STATE_NAME).glob("*.tar.json"))
    assert records
    for record in records:
        record.write_text(text)
    pack_figures(out, Renders(known), shard_samples=5)
    assert contents(out) == contents(figures_set)
    with pytest.raises(Interrupted):
        pack_figures(tmp_path / "other", Renders(known, 0), shard_samples=5)
    (tmp_path / "other" / STATE_NAME / "plan.json").write_text(text)
    with pytest.raises(BadConfig, match="holds an unfinished packing of other options"):
        pack_figures(tmp_path / "other", Renders(known), shard_samples=5)


def test_a_finished_set_is_left_as_it_is(tmp_path: Path, pack_figures: Pack, known: dict[Any, Any]) -> None:
    out = pack_figures(tmp_path / "shards", Renders(known), meshes=2)
    stamps = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
    pack_figures(out, Renders(known, 0), meshes=2)
    assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == stamps


@pytest.mark.parametrize("damage", ["gone", "altered"])
def test_a_damaged_finished_set_is_mended(
    damage: str, tmp_path: Path, figures_set: Path, pack_figures: Pack, known: dict[Any, Any]
) -> None:
    out = pack_figures(tmp_path / "shards", Renders(known), shard_samples=5)
    shard = out / "train-00002.tar"
    if damage == "gone":
        shard.unlink()
    else:
        shard.write_bytes(shard.read_bytes()[:-100])
    with pytest.raises(Interrupted):
        pack_figures(out, Renders(known, 0), shard_samples=5)
    assert not (out / "manifest.json").exists(), "a set with a damaged shard is not finished"
    pack_figures(out, Renders(known), shard_samples=5)
    assert contents(out) == contents(figures_set)


def test_other_bodies_of_the_same_names_are_another_packing(
    tmp_path: Path, pack_figures: Pack, known: dict[Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = pack_figures(tmp_path / "shards", Renders(known), meshes=2)
    monkeypatch.setattr(Figures, "fingerprint", lambda self, bodies: "other")
    with pytest.raises(BadConfig, match="already holds a set of shards packed with other options"):
        pack_figures(out, Renders(known), meshes=2)


def test_a_folder_with_something_else_is_refused(tmp_path: Path, pack_figures: Pack, known: dict[Any, Any]) -> None:
    (tmp_path / "shards").mkdir()
    (tmp_path / "shards" / "._train-00000.tar").touch()  # no tar: what macOS leaves beside one on other disks
    out = pack_figures(tmp_path / "shards", Renders(known), meshes=2)
    with pytest.raises(BadConfig, match="already holds a set of shards packed with other options"):
        pack_figures(out, Renders(known), meshes=3)
    with pytest.raises(Interrupted):
        pack_figures(tmp_path / "unfinished", Renders(known, 1), meshes=2)
    with pytest.raises(BadConfig, match="holds an unfinished packing of other options"):
        pack_figures(tmp_path / "unfinished", Renders(known), meshes=3)
    (tmp_path / "tars").mkdir()
    (tmp_path / "tars" / "mine.tar").touch()
    with pytest.raises(BadConfig, match="holds tar files that no packing wrote"):
        pack_figures(tmp_path / "tars", Renders(known))
    (tmp_path / "file").touch()
    with pytest.raises(BadConfig, match="is a file"):
        pack_figures(tmp_path / "file", Renders(known))


def test_two_packings_into_one_folder_do_not_meet(tmp_path: Path, pack_figures: Pack, known: dict[Any, Any]) -> None:
    out = tmp_path / "shards"
    with pytest.raises(Interrupted):
        pack_figures(out, Renders(known, 1))
    description = json.loads((out / STATE_NAME / "plan.json").read_bytes())
    with (
        claimed(out, description, "digest"),
        pytest.raises(BadConfig, match="another packing is at work in"),
    ):
        pack_figures(out, Renders(known))


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path, pack_figures: Pack, known: dict[Any, Any]) -> None:
    (tmp_path / "file").touch()
    for kind in (Path, str):
        with pytest.raises(BadConfig, match="cannot make the folder .*: Not a directory"):
            pack_figures(kind(tmp_path / "file" / "shards"), Renders(known))


def test_a_bad_body_stops_the_packing_by_name(
    tmp_path: Path, pack_figures: Pack, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Figures.build

    def build(self: Figures, body: BodyRef) -> Any:
        if body.mesh == bad:
            raise BadMesh(f"mesh {body.mesh}: faces must point outwards")
        return whole(self, body)

    monkeypatch.setattr(Figures, "build", build)
    for bad in ("A-0", "A-1"):
        with pytest.raises(BadMesh, match=f"mesh {bad}: faces must point outwards"):
            pack_figures(tmp_path / "shards")
        assert not [*(tmp_path / "shards").glob("*.tar")], "a shard that was begun looks whole"


def test_meshes_are_taken_evenly_from_every_subset() -> None:
    bodies = [
        BodyRef(subset, subset, f"{subset}{n}", "", "train") for subset, k in (("A", 4), ("P", 100)) for n in range(k)
    ]
    assert [body.mesh for body in evenly_sampled(bodies, 3)] == ["A1", "A3", "P50"]
    assert [body.subset for body in evenly_sampled(bodies, 20)].count("A") == 4
    assert evenly_sampled(bodies, 20)[-1].mesh == "P96"
    assert evenly_sampled(bodies, None) == bodies
    with pytest.raises(BadConfig, match="105 meshes asked for, the source has 104"):
        evenly_sampled(bodies, 105)


def test_a_plan_counts_without_rendering() -> None:
    counts = plan(Packing("open", views=ViewGrid(count=6)))
    assert counts["meshes"] == 71 + 825 + 850 + 583 == 2329
    assert counts["views"] == counts["meshes"] * 6 == counts["train"] + counts["test"]
    pitched = plan(Packing("open", views=ViewGrid(count=100, pitch_deg=(0, -15), roll_deg=Drawn(-5, 5))))
    assert pitched["views"] == counts["meshes"] * 100 and pitched["views_per_mesh"] == 100
    assert counts["subsets"]["A"] == {"meshes": 71, "views": 426, "train": 57 * 6, "test": 14 * 6}
    assert counts["subsets"]["people"] == {"meshes": 583, "views": 3498, "train": 467 * 6, "test": 116 * 6}


@pytest.mark.parametrize(("mesh", "split"), [("A-0", "train"), ("A-9", "val")])
def test_a_source_with_two_bodies_of_one_name_or_another_split_is_refused_at_once(
    mesh: str, split: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pack_figures: Pack
) -> None:
    """Its set could not be read when all was packed, or lacked bodies."""
    bodies = [*Figures().bodies(), BodyRef("people", "bob", mesh, "standing", split)]
    monkeypatch.setattr(Figures, "bodies", lambda _: bodies)
    with pytest.raises(BadConfig, match="each body has a 'mesh' of its own, and the split train or test"):
        pack_figures(tmp_path / "shards")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"meshes": 0}, "meshes must be at least 1, found 0"),
        ({"shard_samples": 0}, "shard_samples must be at least 1, found 0"),
        ({"renderer": "povray"}, "renderer .*found 'povray'"),
        ({"codec": "jpg"}, "codec .*found 'jpg'"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        Packing("open", **options)


def test_sources_say_what_they_need() -> None:
    with pytest.raises(BadConfig, match="one of open, .*found 'cinema'"):
        open_source("cinema")
    with pytest.raises(BadConfig, match="'mit' needs --path"):
        open_source("mit")
    with pytest.raises(BadConfig, match="'open' makes its bodies and reads no files"):
        open_source("open", Path())


@pytest.mark.parametrize(
    ("words", "views", "error"),
    [
        ("--pitch 0 -15 -30 --roll 0 90 --azimuths 2", 36, ""),
        ("--pitch -30..10 --roll -5..5 --height -20..20 --azimuths 2", 6, ""),
        ("--pitch -91", 0, "bodyseg shard: a view's pitch must be between -90 and 90 degrees, found [-91]\n"),
        ("--height 1.5", 0, "bodyseg shard: --height takes whole numbers, or one range like -30..10, found '1.5'\n"),
        ("--roll 5..5", 0, "bodyseg shard: a range of roll must go up, found 5..5\n"),
    ],
)
def test_views_are_options_of_the_command(
    words: str, views: int, error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status = main(["shard", "--source", "open", "--meshes", "4", "--plan", *words.split()])
    said = capsys.readouterr()
    assert (status, said.err) == (2 if error else 0, error)
    assert error or json.loads(said.out)["views_per_mesh"] == views


FIGURES = [str(HELPERS / "figure_command.py"), "shard", "--source", "open", "--views", "4", "--azimuth-span", "360"]
FIGURES += ["--rig", str(SMALL_FILE), "--shard-samples", "5"]  # as the fixture figures_set


def _shard(out: Path, workers: int, **options: Any) -> warm.Program:
    """The command, started; how it fares is told by files in the folder of `out`. options: those of `Program`."""
    words = [*FIGURES, "--workers", str(workers), "--out", str(out)]
    return warm.Program(words, env=os.environ | {"BODYSEG_TROUBLE": str(out.parent)}, **options)


def test_any_number_of_workers_gives_the_same_bytes(figures_set: Path, tmp_path: Path) -> None:
    """By the command with two processes, and in this one."""
    with _shard(tmp_path / "two", 2) as process:
        said, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert "24 samples in 6 shards" in said
    assert "packing: 24 of 24 views" in errors
    assert contents(tmp_path / "two") == contents(figures_set)


@pytest.mark.parametrize(
    ("tables", "line", "seen_by"),
    [
        (["[camera]", "[projector]"], "centre_px = [40.0, 600.0]", "camera sees"),
        (["[projector]"], "roll_deg = 170.0", ""),
    ],
)
@pytest.mark.usefixtures("packing_here")
def test_a_rig_that_sees_nothing_is_told(
    tables: list[str],
    line: str,
    seen_by: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = tmp_path / "rig.toml"
    text = SMALL_FILE.read_text()
    for table in tables:
        text = text.replace(table, f"{table}\n{line}")
    rig.write_text(text)
    monkeypatch.setitem(SOURCES, "open", Figures)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        assert main([*FIGURES[1:-3], str(rig), "--meshes", "1", "--out", str(tmp_path / "out")]) == 0
    told = [f"the {seen_by} nothing in 4 images looked at: are the rig's numbers, --distances and --height right?"]
    assert [str(each.message) for each in found] == (told if seen_by else [])


def test_a_packing_killed_and_started_again_ends_in_the_same_bytes(
    figures_set: Path, tmp_path: Path, pack_figures: Pack
) -> None:
    out = tmp_path / "shards"
    (tmp_path / "slow").touch()
    deadline = time.monotonic() + 200
    with _shard(out, 1) as process:
        while not (out / STATE_NAME / "train-00000.tar.json").exists():
            assert time.monotonic() < deadline
            assert _alive(process.pid)
            time.sleep(0.02)
        children = _children(process.pid)
        assert children
        process.send_signal(signal.SIGKILL)
    assert not (out / "manifest.json").exists()
    while any(_alive(child) for child in children):
        assert time.monotonic() < deadline, "workers outlive the process that started them"
        time.sleep(0.05)
    pack_figures(out, shard_samples=5)
    assert contents(out) == contents(figures_set)


@pytest.mark.parametrize(
    ("signals", "count", "said", "status"),
    [
        ([signal.SIGINT] * 6, 2, "interrupted", 130),
        ([signal.SIGTERM], 1, "terminated", 143),
    ],
)
def test_a_packing_that_is_stopped_ends_at_once_in_one_line(
    signals: list[signal.Signals], count: int, said: str, status: int, tmp_path: Path
) -> None:
    (tmp_path / "slow").touch()
    deadline = time.monotonic() + 200
    with _shard(tmp_path / "shards", count, start_new_session=True) as process:
        while len(_children(process.pid)) < count + 1:  # the workers and the tracker that multiprocessing starts
            assert time.monotonic() < deadline
            time.sleep(0.02)
        workers = _children(process.pid)
        for number in signals:
            with contextlib.suppress(ProcessLookupError):
                if number == signal.SIGINT:
                    os.killpg(process.pid, number)  # a terminal's Ctrl-C goes to all
                else:
                    os.kill(process.pid, number)
            time.sleep(0.03)
        _, printed = process.communicate(timeout=100)
    assert process.returncode == status
    lines = [line for line in printed.splitlines() if not line.startswith("packing: ")]
    assert lines == [f"bodyseg shard: {said}"]
    while any(_alive(worker) for worker in workers):
        assert time.monotonic() < deadline, "workers outlive the process that started them"
        time.sleep(0.05)


def _children(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(word) for word in listed.split()]


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


def test_a_set_may_be_of_some_poses() -> None:
    some = Packing("everyday", poses=("lying*", "kneeling"), meshes=12)
    everything = open_source("everyday").bodies()
    found = some.bodies()
    assert {body.pose for body in found} > {"kneeling", "lying_on_the_back"}
    assert all(body.pose.startswith(("lying", "kneeling")) for body in found)
    lying = [body for body in everything if body.pose.startswith("lying")]
    assert Packing("everyday", poses=("lying*",)).bodies() == lying != everything
    assert plan(some)["meshes"] == 12
    with pytest.raises(BadConfig, match="no body of everyday has a pose like flying or sleeping; its poses: bending, "):
        Packing("everyday", poses=("flying", "sleeping")).bodies()
