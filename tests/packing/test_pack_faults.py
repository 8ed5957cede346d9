"""Packings that are killed, run out of disk, or lose their folder: nothing half-written, the same bytes after all."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import resource
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
from benches.fuzzing.interruptions import TROUBLES, Interrupted, Trouble, _forked, contents, left_over
from fakes import Figures, figures_are_open
from folders import ROOT
from small_rig import SMALL

from bodyseg_data.bodies import SOURCES
from bodyseg_data.core import BadConfig
from bodyseg_data.files import write_json
from bodyseg_data.packing import STATE_NAME, Packing
from bodyseg_data.samples import ViewGrid
from bodyseg_model.commands import main

PACKING = Packing("open", views=ViewGrid(count=1), rig=SMALL, shard_samples=2)  # shards of 10 kB


@pytest.fixture(scope="module")
def memory_folder() -> Iterator[Path]:
    """A folder in memory where there is one: hundreds of packings would wait for the disk."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def interrupted(memory_folder: Path) -> Iterator[Interrupted]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SOURCES, "open", Figures)
        yield Interrupted(PACKING, memory_folder)


@pytest.fixture(scope="module")
def small_process() -> Iterator[ProcessPoolExecutor]:
    """A process of its own: dozens of forks of that of the tests, which keeps much, would take most of the time."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("forkserver"), figures_are_open) as process:
        yield process


@pytest.mark.parametrize("trouble", TROUBLES)
def test_trouble_at_any_operation_leaves_nothing_half_written_and_the_same_bytes_in_the_end(
    trouble: Trouble, interrupted: Interrupted, small_process: ProcessPoolExecutor
) -> None:
    assert interrupted.operations > 30
    first = 1 + TROUBLES.index(trouble) % 3  # BODYSEG_FULL tries all operations, else every third
    step = 1 if os.environ.get("BODYSEG_FULL") else 3
    operations = range(first, interrupted.operations + 1, step)
    assert not small_process.submit(interrupted.all_at, trouble, operations).result()


def test_what_is_half_written_would_be_seen(interrupted: Interrupted, tmp_path: Path) -> None:
    out = tmp_path / "out"
    interrupted.pack(out)
    assert left_over(out, interrupted.whole) == []
    first, second = sorted(out.glob("*.tar"))[:2]
    second.unlink()
    assert left_over(out, interrupted.whole) == ["there is a manifest, and a shard is missing"]
    first.write_bytes(first.read_bytes()[:-512])
    (out / "x.tar").touch()
    assert {line.partition(" ")[0] for line in left_over(out, interrupted.whole)} == {first.name, "x.tar", "there"}


def test_a_packing_that_writes_in_place_would_be_seen(
    interrupted: Interrupted, monkeypatch: pytest.MonkeyPatch
) -> None:
    def in_place(path: Path, data: bytes) -> None:
        path.write_bytes(data[:10])
        path.write_bytes(data)

    monkeypatch.setattr("bodyseg_data.shards.manifest.write_atomically", in_place)
    seen = (fault for n in range(interrupted.operations, 0, -1) for fault in interrupted.at("killed", n))
    assert any("manifest.json is half-written or a stray" in fault for fault in seen)


@contextmanager
def no_file_above(size: int) -> Iterator[None]:
    """Writing fails in the middle of a file, as on a full disk, and needs no privilege to happen."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [0, 100, 2000, 5000, 10_000])
def test_a_write_that_fails_halfway_is_one_line_and_carried_on_from(
    size: int, interrupted: Interrupted, memory_folder: Path
) -> None:
    out = memory_folder / f"limited-{size}"
    with no_file_above(size), pytest.raises(BadConfig, match=f"cannot write shards in {out}: File too large"):
        interrupted.pack(out)
    assert left_over(out, interrupted.whole) == []
    assert not list(out.glob(".packing/*.part")), "what failed is taken away"
    interrupted.pack(out)
    assert contents(out) == interrupted.whole


_MS_REC_PRIVATE, _MS_REMOUNT, _MS_RDONLY = 0x4000 | 0x40000, 0x20, 0x1
_NEW_MOUNTS, _NEW_USER = 0x20000, 0x10000000


def _mount(folder: Path, options: str, flags: int = 0) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(b"none", bytes(folder), b"tmpfs", flags, options.encode()):
        raise OSError(ctypes.get_errno(), f"mount {options}")


def _own_mounts() -> None:
    """Let this process mount what no other sees. Raises OSError where that is not permitted."""
    libc = ctypes.CDLL(None, use_errno=True)
    user, group = os.getuid(), os.getgid()
    if libc.unshare(_NEW_MOUNTS | (_NEW_USER if user else 0)):
        raise OSError(ctypes.get_errno(), "unshare")
    if user:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
        Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    if libc.mount(b"none", b"/", None, _MS_REC_PRIVATE, None):
        raise OSError(ctypes.get_errno(), "make mounts private")


def _in_own_mounts(work: Callable[[], None], said: Path) -> None:
    """Run `work` in a fork that may mount; skip where that is not permitted."""
    said.write_text("")

    def whole() -> None:
        try:
            _own_mounts()
        except OSError as error:
            raise BadConfig(f"skip: {error}") from error
        work()

    status = _forked(whole, said)
    if said.read_text().startswith("skip: "):
        pytest.skip(f"mounting a small disk is not permitted here ({said.read_text()[6:].strip()})")
    assert status == 0, said.read_text()


@pytest.mark.parametrize("kilobytes", [4, 8, 16, 28, 36])
def test_a_full_disk_is_one_line_and_the_same_call_carries_on_when_there_is_space(
    kilobytes: int, interrupted: Interrupted, tmp_path: Path
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()

    def work() -> None:
        _mount(disk, f"size={kilobytes}k")
        with pytest.raises(
            BadConfig, match="cannot (write shards in|make the folder|write) .*: No space left on device"
        ):
            interrupted.pack(disk / "out")
        assert left_over(disk / "out", interrupted.whole) == []
        _mount(disk, "size=20m", _MS_REMOUNT)
        interrupted.pack(disk / "out")
        assert contents(disk / "out") == interrupted.whole

    _in_own_mounts(work, tmp_path / "said")


def test_a_disk_that_may_not_be_written_is_one_line(interrupted: Interrupted, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()

    def work() -> None:
        _mount(disk, "size=1m")
        _mount(disk, "size=1m", _MS_REMOUNT | _MS_RDONLY)
        with pytest.raises(BadConfig, match="cannot make the folder .*: Read-only file system"):
            interrupted.pack(disk / "out")
        with pytest.raises(BadConfig, match=r"cannot write .*x\.json: Read-only file system"):
            write_json(disk / "x.json", {})
        assert list(disk.iterdir()) == []
        _mount(disk, "size=1m", _MS_REMOUNT)
        interrupted.pack(disk / "out")
        assert contents(disk / "out") == interrupted.whole

    _in_own_mounts(work, tmp_path / "said")


def test_a_folder_without_permission_is_one_line(interrupted: Interrupted, memory_folder: Path) -> None:
    closed = memory_folder / "closed"
    closed.mkdir()
    closed.chmod(0o555)
    said = memory_folder / "said-closed"
    said.write_text("")
    memory_folder.chmod(0o755)

    def work() -> None:
        if os.getuid() == 0:
            os.setuid(65534)  # permissions do not bind root
        interrupted.pack(closed / "out")

    assert _forked(work, said) == 2
    assert said.read_text() == f"cannot make the folder {closed / 'out' / STATE_NAME}: Permission denied\n"
    assert list(closed.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "name"),
    [("inspect {set} --out {target}", "sheet.png")],
)
def test_a_result_that_does_not_fit_on_the_disk_is_one_line_and_leaves_nothing(
    words: str,
    name: str,
    figures_set: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    target = tmp_path / name
    with no_file_above(50):
        assert main(words.format(set=figures_set, target=target).split()) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if " steps, " not in line]
    assert lines == [f"bodyseg {words.split()[0]}: cannot write {target}: File too large"]
    assert list(tmp_path.iterdir()) == []


def test_charts_are_written_by_the_one_function_that_writes_them_whole() -> None:
    folders = [ROOT / name for name in ("bodyseg_data", "bodyseg_model", "tools")]
    files = (path for folder in folders for path in folder.rglob("*.py"))
    assert [path.name for path in files if ".savefig(" in path.read_text()] == ["style.py"]
