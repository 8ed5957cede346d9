"""Files written at once or not at all, by several writers, and folders that one call holds."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bodyseg_data import ShardWriter
from bodyseg_data.core import BadConfig
from bodyseg_data.files import claimed, held_part, make_folder, naming, part_beside, write_atomically, write_result


def test_a_second_writer_does_not_touch_what_the_first_one_writes(tmp_path: Path) -> None:
    path = tmp_path / "labels.png"

    def chunks() -> Iterator[bytes]:
        yield b"a" * 1000
        write_atomically(path, b"b" * 10)
        assert path.read_bytes() == b"b" * 10
        yield b"a" * 1000

    write_atomically(path, chunks())
    assert path.read_bytes() == b"a" * 2000
    assert list(tmp_path.iterdir()) == [path]


def test_whoever_looks_sees_a_whole_file(tmp_path: Path) -> None:
    path, ended = tmp_path / "file", threading.Event()
    write_atomically(path, b"0" * 50_000)

    def write(letter: bytes) -> None:
        while not ended.is_set():
            write_atomically(path, (letter * 1000 for _ in range(50)), flushed=False)

    writers = [threading.Thread(target=write, args=(letter,)) for letter in (b"a", b"b")]
    for writer in writers:
        writer.start()
    looks = [path.read_bytes() for _ in range(300)]
    ended.set()
    for writer in writers:
        writer.join()
    assert {(len(look), len(set(look))) for look in looks} == {(50_000, 1)}
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    def full() -> Iterator[bytes]:
        yield b"a"
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "file"
    with pytest.raises(OSError, match="No space left on device") as raised:
        write_atomically(path, full())
    assert raised.value.filename == str(path) and not list(tmp_path.iterdir())
    with pytest.raises(OSError, match="^of a library$") as other, naming(path):
        raise OSError("of a library")
    assert other.value.filename is None
    with pytest.raises(BadConfig, match=f"^cannot write {tmp_path / 'none' / 'file'}: No such file or directory$"):
        write_result(tmp_path / "none" / "file", b"")


def test_a_pipe_or_device_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    for name in ("pipe", "link"):
        with pytest.raises(BadConfig, match=f"^cannot write {tmp_path / name}: not a regular file$"):
            write_result(tmp_path / name, b"figures")
    assert (tmp_path / "pipe").is_fifo() and (tmp_path / "link").is_symlink() and len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("letter", ["x", "é", "走", "🚶"])
def test_a_name_may_be_as_long_as_the_disk_allows(letter: str, tmp_path: Path) -> None:
    name = letter * (255 // len(letter.encode()))
    write_result(tmp_path / name, b"figures")
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_a_folder_is_held_by_one(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "out"
    with claimed(folder, "training"):
        assert all(each.name.startswith(".") for each in folder.iterdir())
        held = pytest.raises(BadConfig, match=f"^another training is at work in {folder}: wait")
        with held as raised, claimed(folder, "training"):
            pass
        assert "\n" not in str(raised.value)
        with claimed(tmp_path / "other", "training"):
            pass
    assert not list(tmp_path.iterdir()), "folders that were made go when nothing is in them"
    with claimed(folder, "training"):
        (folder / "log.jsonl").touch()
    assert [each.name for each in folder.iterdir()] == ["log.jsonl"]


def test_an_address_is_no_folder_to_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    needed = "^a folder of this machine is needed, found the address s3:/bucket"
    with pytest.raises(BadConfig, match=needed), claimed(Path("s3://bucket/set"), "training"):
        pass
    with pytest.raises(BadConfig, match=needed), ShardWriter("s3://bucket/set", rig="kinect_v1", classes=["arm"]):
        pass
    assert not list(tmp_path.iterdir())
    (tmp_path / "s3:").mkdir()
    make_folder(Path("s3:/bucket"))  # in a folder that is truly called so
    make_folder(tmp_path / "12:")


def test_what_a_killed_process_leaves_holds_nobody_up(tmp_path: Path) -> None:
    (tmp_path / ".lock").write_text("")
    with claimed(tmp_path, "training"):
        pass
    assert not list(tmp_path.iterdir())


def test_a_folder_is_free_again_also_where_its_lock_cannot_be_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a disk that may no longer be written; the same process may go on when it may."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    held = claimed(tmp_path, "training")
    held.__enter__()
    with monkeypatch.context() as patch, pytest.raises(OSError, match="Read-only file system"):
        patch.setattr(Path, "unlink", refuse)
        held.__exit__(None, None, None)
    with claimed(tmp_path, "training"):
        pass


def test_a_file_system_without_locks_is_told_from_one_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(handle: int, operation: int) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")  # as Lustre does unless mounted with locks

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(BadConfig, match=r"^cannot write and lock .*: Function not"), claimed(tmp_path, "training"):
        pass


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EIO])
def test_folders_that_cannot_be_synced_still_take_files(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fsync(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr("os.fsync", fsync)
    with contextlib.nullcontext() if number == errno.EINVAL else pytest.raises(BadConfig, match="Input/output error"):
        write_result(tmp_path / "scores.json", b"{}")  # folders that VirtualBox shares answer EINVAL
    assert (tmp_path / "scores.json").read_bytes() == b"{}"


def test_a_planted_lock_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / ".lock").symlink_to(tmp_path / "victim")
    with pytest.raises(BadConfig, match=r"^cannot write and lock .*\.lock: "), claimed(tmp_path, "training"):
        pass
    assert not (tmp_path / "victim").exists()


def test_a_lock_that_its_holder_removes_meanwhile_is_taken_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    plain, calls = fcntl.flock, []

    def late(handle: int, flags: int) -> None:
        plain(handle, flags)
        calls.append(handle)
        if len(calls) == 1:
            (tmp_path / ".lock").unlink()

    monkeypatch.setattr(fcntl, "flock", late)
    with claimed(tmp_path, "training"):
        assert len(calls) == 2 and (tmp_path / ".lock").exists()


@pytest.mark.parametrize("make", [Path.touch, Path.mkdir], ids=["file", "folder"])
def test_what_killed_processes_left_goes_and_no_other_part(make: Callable[[Path], None], tmp_path: Path) -> None:
    out = tmp_path / "out[1].mcap"
    killed, other = part_beside(out), part_beside(tmp_path / "out1.mcap")
    make(killed)
    make(other)
    with held_part(out, make) as first, held_part(out, make) as second:
        assert set(tmp_path.iterdir()) == {other, first, second}
        second.rename(out)
    assert set(tmp_path.iterdir()) == {other, out}
