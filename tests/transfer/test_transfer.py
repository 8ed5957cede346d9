"""Sets and networks copied to addresses and back, interrupted, resumed and checked."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest
from servers import WebServer, s3_server, web_server

from bodyseg_data import ColumnWriter, RangeImages
from bodyseg_data.core import BadConfig, BadShard
from bodyseg_data.shards import MANIFEST_NAME, LocalFolder, RemoteFolder, RetryPolicy, Unreachable, read_manifest
from bodyseg_data.transfer import LocalTarget, RemoteTarget, set_bundle, transfer
from bodyseg_data.transfer.transfers import Outcome
from bodyseg_model.commands import main

QUICK = RetryPolicy(tries=6, first_wait_s=0.001, stall_s=10)

fsspec = pytest.importorskip("fsspec")


class Breaking(fsspec.get_filesystem_class("memory")):  # type: ignore[misc]
    """A filesystem in memory that is interrupted, or alters what it gets, when its next upload of a shard is due."""

    protocol = "breaking"
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    uploads_left: ClassVar[float] = float("inf")
    alter: ClassVar[bool] = False

    def put_file(self, lpath: str, rpath: str, **options: Any) -> None:
        if Breaking.uploads_left <= 0:
            raise KeyboardInterrupt
        Breaking.uploads_left -= 1
        data = Path(lpath).read_bytes()
        self.pipe_file(rpath, data[:-1] + b"x" if Breaking.alter else data)


@pytest.fixture
def breaking() -> Iterator[type[Breaking]]:
    fsspec.register_implementation("breaking", Breaking, clobber=True)
    yield Breaking
    Breaking.store.clear()
    Breaking.uploads_left, Breaking.alter = float("inf"), False


class OfPaths(fsspec.get_filesystem_class("memory")):  # type: ignore[misc]
    """A filesystem in memory that takes what it writes to for a path, as fsspec's own of SFTP does an address."""

    protocol = "ofpaths"
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    written: ClassVar[set[str]] = set()

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(fsspec.utils.infer_storage_options(path)["path"])

    def makedirs(self, path: str, exist_ok: bool = False) -> None:
        self.written.add(path)

    def put_file(self, lpath: str, rpath: str, **options: Any) -> None:
        self.written.add(rpath)
        self.pipe_file(rpath, Path(lpath).read_bytes())


@pytest.fixture
def mine(small_set: Path, tmp_path: Path) -> Path:
    """A copy of the small set, 3 shards, with a page."""
    folder = tmp_path / "mine"
    shutil.copytree(small_set, folder, ignore=shutil.ignore_patterns(".*"))
    (folder / "README.md").write_text("# Mine\n")
    return folder


@pytest.fixture(scope="module")
def web(small_set: Path) -> Iterator[WebServer]:
    pytest.importorskip("aiohttp")
    with web_server(small_set) as running:
        yield running


def contents(folder: Path) -> dict[str, bytes]:
    """Name -> bytes of all files of a folder, hidden ones too."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def pushed(folder: Path, address: str, **options: Any) -> Outcome:
    target = RemoteTarget(RemoteFolder(address, {}, QUICK), folder)
    return transfer(set_bundle(LocalFolder(folder)), target, lambda done: None, **options)


def pulled(address: str, folder: Path, report: Callable[[int], None] = lambda done: None) -> Outcome:
    source = RemoteFolder(address, {}, QUICK)
    return transfer(set_bundle(source), LocalTarget(folder, source), report)


def test_a_set_goes_to_an_address_and_comes_back(
    mine: Path, breaking: type[Breaking], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["push", str(mine), "breaking://box/set"]) == 0
    size = sum(path.stat().st_size for path in mine.glob("*.tar")) / 1e6
    line = f"3 files and manifest.json, {size:.1f} MB: "
    assert capsys.readouterr().out == f"breaking://box/set: {line}0 were there, {size:.1f} MB copied\n"
    assert list(breaking.store)[-1] == "breaking://box/set/manifest.json"
    back = tmp_path / "back"
    assert main(["pull", "breaking://box/set", str(back)]) == 0
    assert contents(back) == contents(mine)
    assert main(["verify", str(back)]) == 0
    assert len(RangeImages(back)) == 24
    capsys.readouterr()
    for words in (["push", str(mine), "breaking://box/set"], ["pull", "breaking://box/set", str(back)]):
        assert main(words) == 0
        assert "3 were there, 0.0 MB copied\n" in capsys.readouterr().out


def test_user_and_password_name_no_file_of_a_filesystem_that_takes_addresses_for_paths(mine: Path) -> None:
    fsspec.register_implementation("ofpaths", OfPaths, clobber=True)
    assert pushed(mine, "ofpaths://me:secret@host/box/set").copied_bytes
    assert OfPaths.written == {"/box/set", *(f"/box/set/{path.name}" for path in mine.glob("*.tar"))}
    assert sorted(OfPaths.store) == sorted(f"/box/set/{path.name}" for path in mine.iterdir())


def test_a_set_goes_to_a_folder(mine: Path, tmp_path: Path) -> None:
    for address, folder in ((str(tmp_path / "a"), tmp_path / "a"), (f"file://{tmp_path}/b/c", tmp_path / "b" / "c")):
        folder.mkdir(parents=True)
        (folder / ".test-00000.tar.part").write_bytes(b"of another set")
        assert main(["push", str(mine), address]) == 0
        assert contents(folder) == contents(mine)
        assert main(["pull", address, str(tmp_path / "back")]) == 0


def test_a_bucket_gets_a_set_and_gives_it(mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("s3fs")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "AKID-EXAMPLE")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "very-secret")
    with s3_server(mine, "bucket", "there") as port:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        for _ in range(2):
            assert main(["push", str(mine), "s3://bucket/mine"]) == 0
        assert main(["pull", "s3://bucket/mine", str(tmp_path / "back")]) == 0
        with pytest.raises(Unreachable, match="no-bucket/mine/train-00000.tar"):
            pushed(mine, "s3://no-bucket/mine")
    assert contents(tmp_path / "back") == contents(mine)


def test_an_interrupted_push_is_never_whole_and_goes_on(mine: Path, breaking: type[Breaking]) -> None:
    breaking.uploads_left = 2
    assert main(["push", str(mine), "breaking://box/set"]) == 130
    with pytest.raises(BadShard, match=r"holds no manifest\.json"):
        read_manifest(RemoteFolder("breaking://box/set", {}, QUICK))
    breaking.uploads_left = 1
    assert pushed(mine, "breaking://box/set") == Outcome(3, 2, (mine / "test-00000.tar").stat().st_size)
    assert read_manifest(RemoteFolder("breaking://box/set", {}, QUICK)) == read_manifest(mine)


def test_files_that_a_set_may_lack_are_not_missed_where_names_are_not_listed(
    mine: Path, web: WebServer, breaking: type[Breaking], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(self: Breaking, path: str, **options: Any) -> bytes:
        if path not in self.store:
            raise PermissionError("Forbidden")
        return bytes(read(self, path, **options))

    read = Breaking.cat_file
    pushed(mine, "breaking://box/set")
    monkeypatch.setattr(Breaking, "cat_file", refused)
    for address in ("breaking://box/set", web.url("unlisted")):
        assert main(["verify", address]) == 0
        assert main(["pull", address, str(tmp_path / "back"), "--replace"]) == 0
        with pytest.raises(Unreachable, match="absent/manifest.json: (403|PermissionError)"):
            read_manifest(RemoteFolder(f"{address}/absent", {}, QUICK))


def test_a_pull_goes_on_within_a_shard(web: WebServer, small_set: Path, tmp_path: Path) -> None:
    web.forget()
    back, shards = tmp_path / "back", read_manifest(small_set).shards
    half = shards[0].size + shards[1].size // 2
    back.mkdir()
    (back / shards[0].name).write_bytes((small_set / shards[0].name).read_bytes())
    (back / f".{shards[1].name}.part").write_bytes((small_set / shards[1].name).read_bytes()[: shards[1].size // 2])
    seen: list[int] = []
    assert pulled(web.url("good"), back, seen.append) == Outcome(3, 1, shards[1].size + shards[2].size)
    assert seen[:2] == [shards[0].size, half]
    assert seen[-1] == sum(shard.size for shard in shards)
    assert sum(line.sent for line in web.log(".tar")) == seen[-1] - half
    assert contents(back) == contents(small_set)


def test_a_pull_that_is_interrupted_leaves_no_manifest(web: WebServer, small_set: Path, tmp_path: Path) -> None:
    back = tmp_path / "back"
    sizes = [shard.size for shard in read_manifest(small_set).shards]

    def stop(done: int) -> None:
        if done == sum(sizes):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pulled(web.url("good"), back, stop)
    assert MANIFEST_NAME not in contents(back)
    pulled(web.url("good"), back)
    assert contents(back) == contents(small_set)
    (back / "train-00001.tar").write_bytes(b"something else")
    with pytest.raises(KeyboardInterrupt):
        pulled(web.url("good"), back, stop)
    assert MANIFEST_NAME not in contents(back), "a set of which a shard is wrong is not whole"
    pulled(web.url("good"), back)
    assert contents(back) == contents(small_set)


def test_bytes_that_are_altered_on_their_way_are_fetched_again(web: WebServer, small_set: Path, tmp_path: Path) -> None:
    web.forget()
    web.faults.act = lambda reply, before: replace(reply, body=reply.body[:-1] + b"x") if before == 0 else reply
    sizes = [shard.size for shard in read_manifest(small_set).shards]
    seen: list[int] = []
    assert pulled(web.url("faulty"), tmp_path / "back", seen.append) == Outcome(3, 0, sum(sizes))
    assert contents(tmp_path / "back") == contents(small_set)
    assert seen[-1] == max(seen) == sum(sizes) and seen.count(0) >= 2, "progress goes back by what was wrong"


def test_wrong_bytes_are_fetched_again_and_sent_again(mine: Path, breaking: type[Breaking], tmp_path: Path) -> None:
    back, shard = tmp_path / "back", "test-00000.tar"
    pushed(mine, "breaking://box/set")
    pulled("breaking://box/set", back)
    good = (mine / shard).read_bytes()
    (back / shard).write_bytes(good[:-1] + b"x")
    (back / f".{shard}.part").write_bytes(b"something else")
    assert pulled("breaking://box/set", back).kept == 2
    assert contents(back) == contents(mine)
    file = f"breaking://box/set/{shard}"
    breaking.store[file].truncate(0)
    breaking.store[file].seek(0)
    breaking.store[file].write(good[:-1] + b"x")
    with pytest.raises(BadShard, match=rf"{shard}: altered: SHA-256 [0-9a-f]{{64}} expected, found "):
        pulled("breaking://box/set", tmp_path / "third")
    assert MANIFEST_NAME not in contents(tmp_path / "third")
    assert pushed(mine, "breaking://box/set", sizes_only=True).kept == 3
    assert pushed(mine, "breaking://box/set").kept == 2
    assert breaking.store[file].getvalue() == good


def test_a_push_checks_what_it_sends_and_what_arrives(mine: Path, breaking: type[Breaking]) -> None:
    breaking.alter = True
    with pytest.raises(BadShard, match="the bytes that arrived are not those that were sent"):
        pushed(mine, "breaking://box/set")
    breaking.alter = False
    data = (mine / "train-00001.tar").read_bytes()
    (mine / "train-00001.tar").write_bytes(data[:-1])
    with pytest.raises(BadShard, match=r"train-00001\.tar: altered: SHA-256"):
        pushed(mine, "breaking://box/set")
    with pytest.raises(BadShard, match=r"train-00001\.tar: altered: SHA-256"):
        source = LocalFolder(mine)
        transfer(set_bundle(source), LocalTarget(mine.parent / "back", source), lambda done: None)


def test_another_set_is_replaced_only_when_asked_and_leaves_nothing_behind(
    mine: Path, pack_figures: Callable[..., Path], breaking: type[Breaking], tmp_path: Path
) -> None:
    whole = pack_figures(tmp_path / "whole")
    with ColumnWriter(mine, "age", "int") as column:
        for key in RangeImages(mine).keys:
            column.write(key, 3)
    pushed(mine, "breaking://box/set")
    with pytest.raises(BadConfig, match=r"breaking://box/set holds another manifest\.json: choose another place, or"):
        pushed(whole, "breaking://box/set")
    breaking.uploads_left = 0
    with pytest.raises(KeyboardInterrupt):
        pushed(whole, "breaking://box/set", replace=True)
    assert "breaking://box/set/manifest.json" not in breaking.store
    breaking.uploads_left = 1
    pushed(whole, "breaking://box/set", replace=True)
    held = {name.rpartition("/")[2]: file.getvalue() for name, file in breaking.store.items()}
    assert held == {path.name: path.read_bytes() for path in whole.iterdir() if path.is_file()}
    (mine / "manifest.json").write_text("{}")
    (mine / "columns.json").write_text("damaged, too")
    assert main(["pull", "breaking://box/set", str(mine)]) == 2
    assert main(["pull", "breaking://box/set", str(mine), "--replace"]) == 0
    assert not (mine / "columns.json").exists(), "it would be taken for the new set's"
    assert main(["verify", str(mine)]) == 1  # the shards of the set of an unreadable manifest are strays now


def test_a_replacement_that_was_cut_while_it_removed_files_is_completed(
    mine: Path, pack_figures: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = pack_figures(tmp_path / "whole")
    with ColumnWriter(mine, "age", "int") as column:
        for key in RangeImages(mine).keys:
            column.write(key, 3)
    plain = LocalTarget.remove

    def cut(self: LocalTarget, name: str) -> None:
        plain(self, name)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(LocalTarget, "remove", cut)
        assert main(["pull", str(whole), str(mine), "--replace"]) == 130
    assert main(["pull", str(whole), str(mine), "--replace"]) == 0
    assert main(["push", str(mine), str(tmp_path / "copy")]) == 0, "no list of columns of the set before"
    assert main(["verify", str(tmp_path / "copy")]) == 0


def test_what_the_user_has_at_the_target_is_replaced_only_when_asked(
    mine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, damaged = tmp_path / "copy", b"x" + (mine / "train-00000.tar").read_bytes()[1:]
    copy.mkdir()
    (copy / "train-00000.tar").write_bytes(b"of a packing that has not ended")
    assert main(["pull", str(mine), str(copy)]) == 2
    assert "copy holds another train-00000.tar: choose another place, or --replace it" in capsys.readouterr().err
    assert contents(copy) == {"train-00000.tar": b"of a packing that has not ended"}
    assert main(["pull", str(mine), str(copy), "--replace"]) == 0
    with ColumnWriter(copy, "age", "int") as column:
        for key in RangeImages(copy).keys:
            column.write(key, 3)
    (copy / "train-00000.tar").write_bytes(damaged)
    assert main(["pull", str(mine), str(copy)]) == 0, "a file that is wrong beside its manifest"
    (copy / "README.md").write_text("# Edited\n")
    assert main(["pull", str(mine), str(copy)]) == 2
    assert "copy holds another README.md: choose another place, or --replace it" in capsys.readouterr().err
    assert (copy / "README.md").read_text() == "# Edited\n"
    assert list(RangeImages(copy, columns=["age"]).manifest.fields.kinds)[-1] == "age"


def test_files_at_an_address_are_replaced_only_when_asked(
    mine: Path, breaking: type[Breaking], capsys: pytest.CaptureFixture[str]
) -> None:
    files, file = breaking("breaking://"), "breaking://box/set/train-00000.tar"
    files.pipe_file(file, own := bytes((mine / "train-00000.tar").stat().st_size))
    assert main(["push", str(mine), "breaking://box/set"]) == 2
    assert "holds another train-00000.tar: choose another place, or --replace it" in capsys.readouterr().err
    assert {name: held.getvalue() for name, held in breaking.store.items()} == {file: own}
    assert main(["push", str(mine), "breaking://box/set", "--replace"]) == 0
    files.pipe_file(file, own[1:])
    files.rm_file("breaking://box/set/manifest.json")
    assert main(["push", str(mine), "breaking://box/set"]) == 0, "shorter, as an interrupted push leaves it"
    files.pipe_file(file, own)
    files.rm_file("breaking://box/set/manifest.json")
    breaking.alter = True
    assert main(["push", str(mine), "breaking://box/set", "--replace"]) == 2
    breaking.alter = False
    assert main(["push", str(mine), "breaking://box/set"]) == 0, "what arrived otherwise is removed"


def test_a_column_that_the_set_no_longer_has_goes_from_an_address_when_asked(
    mine: Path, breaking: type[Breaking]
) -> None:
    without = contents(mine)
    with ColumnWriter(mine, "age", "int") as column:
        for key in RangeImages(mine).keys:
            column.write(key, 3)
    pushed(mine, "breaking://box/set")
    for path in (*mine.glob("*.age.tar"), mine / "age.column.json", mine / "columns.json"):
        path.unlink()
    pushed(mine, "breaking://box/set")
    assert "breaking://box/set/columns.json" in breaking.store
    pushed(mine, "breaking://box/set", replace=True)
    assert {name.rpartition("/")[2]: file.getvalue() for name, file in breaking.store.items()} == without


def test_a_set_is_not_copied_to_itself(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (mine / "train-00000.tar").write_bytes(b"damaged")
    before = contents(mine)
    (mine.parent / "link").symlink_to(mine)
    for words in (["push", str(mine), str(mine.parent / "link")], ["pull", f"file://{mine}", str(mine)]):
        assert main(words) == 2
        assert "cannot be copied to itself: choose another place" in capsys.readouterr().err
    assert contents(mine) == before, "its manifest was removed, as before a repair"


def test_networks_are_copied_with_their_pages(
    mine: Path, breaking: type[Breaking], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "network.safetensors").write_bytes(bytes(5000))
    card = {"format": "bodyseg network 1", "weights_sha256": hashlib.sha256(bytes(5000)).hexdigest()}
    (run / "network.json").write_text(json.dumps(card))
    (run / "README.md").write_text("# Mine\n")
    (run / "log.jsonl").write_text("{}\n")
    assert main(["push", str(run), "breaking://box/run"]) == 0
    assert list(breaking.store)[-1] == "breaking://box/run/network.json"
    (tmp_path / "back").mkdir()
    (tmp_path / "back" / "README.md").write_text("# Of the project that lies here\n")
    assert main(["pull", "breaking://box/run", str(tmp_path / "back")]) == 2
    assert "back holds another README.md: choose another place, or --replace it" in capsys.readouterr().err
    assert contents(tmp_path / "back").keys() == {"README.md"}
    (tmp_path / "back" / "README.md").unlink()
    assert main(["pull", "breaking://box/run", str(tmp_path / "back")]) == 0
    del (files := contents(run))["log.jsonl"]
    assert contents(tmp_path / "back") == files
    (tmp_path / "back" / "network.json").unlink()  # as after a kill just before the end
    assert main(["pull", "breaking://box/run", str(tmp_path / "back")]) == 0
    assert contents(tmp_path / "back") == files
    shutil.copy(run / "network.safetensors", tmp_path / "six.safetensors")
    shutil.copy(run / "network.json", tmp_path / "six.json")
    (tmp_path / "six.confusion.json").write_text("{}")
    assert main(["push", str(tmp_path / "six.safetensors"), "breaking://box/many"]) == 0
    assert main(["pull", "breaking://box/many/six.safetensors", str(tmp_path / "many")]) == 0
    assert sorted(contents(tmp_path / "many")) == ["six.confusion.json", "six.json", "six.safetensors"]
    (tmp_path / "six.confusion.json").unlink()
    (tmp_path / "six.json").write_text(json.dumps({**card, "last_step": 2}))
    assert main(["push", str(tmp_path / "six.safetensors"), str(tmp_path / "many"), "--replace"]) == 0
    assert sorted(contents(tmp_path / "many")) == ["six.json", "six.safetensors"], "no scores of the network before"
    assert main(["push", str(tmp_path / "six.safetensors"), str(mine)]) == 0
    (tmp_path / "six.json").write_text(json.dumps(card))
    assert main(["push", str(tmp_path / "six.safetensors"), str(mine), "--replace"]) == 0
    assert main(["verify", str(mine)]) == 0, "the set beside it stays"
    (run / "network.json").write_text(json.dumps({**card, "last_step": 3}))
    (run / "checkpoint.json").write_text('{"step": 5}')  # of a training that was carried on, and stopped
    assert main(["push", str(run), "breaking://box/older"]) == 2
    assert f"the training in {run} has not ended" in capsys.readouterr().err
    assert main(["push", str(run / "network.safetensors"), "breaking://box/older"]) == 0
    (run / "checkpoint.json").unlink()
    (run / "network.json").write_text('{"format": "bodyseg network 1"}')
    capsys.readouterr()
    assert main(["push", str(run), "breaking://box/other"]) == 2
    assert "is no card of a network with 'weights_sha256'" in capsys.readouterr().err


def test_what_cannot_be_copied_gets_one_line(
    mine: Path, web: WebServer, breaking: type[Breaking], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "back")
    for words, message in (
        (["push", str(tmp_path), "breaking://box/set"], "neither a set of shards nor a trained network"),
        (
            ["push", str(mine), "breaking://box/train-*.tar"],
            "a copy needs the address of a folder, found 'train-*.tar'",
        ),
        (["push", str(mine), web.url("nowhere")], "http addresses are read, not written"),
        (["push", str(mine), ""], "a folder or an address must have a name, found ''"),
        (["verify", " "], "a folder or an address must have a name, found ' '"),
        (["pull", web.url("nowhere"), folder], "holds no manifest.json: not a set of shards"),
        (["pull", web.url("good/train-*.tar"), folder], "a whole set is copied, found 'train-*.tar'"),
        (["pull", web.url("good/six.safetensors?token=secret"), folder], "good/six.json is missing"),
    ):
        assert main(words) == 2
        said = capsys.readouterr().err
        assert message in said
        assert "secret" not in said
        assert said.count("\n") == 1
    assert not (tmp_path / "back").exists()


def test_two_pulls_of_one_folder_do_not_mix(web: WebServer, small_set: Path, tmp_path: Path) -> None:
    def again(done: int) -> None:
        with pytest.raises(BadConfig, match=r"\.part: another transfer writes this file"):
            pulled(web.url("good"), tmp_path / "back")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pulled(web.url("good"), tmp_path / "back", again)
