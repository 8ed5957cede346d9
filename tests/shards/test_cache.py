"""Where sets are, what of them is kept on this machine, and what happens when that is full."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from samples import GOOD

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BadConfig, BadShard, MissingLibrary
from bodyseg_data.files import cache_folder
from bodyseg_data.shards import (
    LocalFolder,
    Manifest,
    RemoteFolder,
    RetryPolicy,
    ShardReader,
    ShardRecord,
    Store,
    Unreachable,
    open_file,
    open_store,
    read_manifest,
    with_cache,
)
from bodyseg_data.shards.cache import BUSY, CachedStore, ShardCache
from bodyseg_data.shards.records import BODY_FIELDS, describe, read_checked

fsspec = pytest.importorskip("fsspec")


def record(number: int, size: int = 1024) -> ShardRecord:
    """A shard of one sample whose bytes all are `number`."""
    data = bytes([number]) * size
    sha256 = hashlib.sha256(data).hexdigest()
    described = describe([GOOD.info], BODY_FIELDS)
    return ShardRecord(
        f"train-{number:05d}.tar", "train", size, sha256, (f"k-{number}",), (0,), (512,), (0,), (), described
    )


def used_bytes(cache: ShardCache) -> int:
    return sum(size for _, _, size in cache._entries())


def fill(cache: ShardCache, shard: ShardRecord, age_s: float = 0.0) -> bool:
    """Put a shard into the cache as its fetcher would; False if it is not wanted there."""
    with cache.claim(shard) as handle:
        if handle is None or handle == BUSY:
            return False
        os.write(handle, bytes([int(shard.name[6:11])]) * shard.size)
        cache.finish(shard)
    then = time.time() - age_s
    os.utime(cache.path(shard), (then, then))
    return True


@pytest.fixture
def memory(paper_set: Path) -> str:
    """The set behind an address that needs no server."""
    files = fsspec.filesystem("memory")
    for file in paper_set.iterdir():
        files.pipe_file(f"/sets/figures/{file.name}", file.read_bytes())
    return "memory://sets/figures"


@pytest.mark.parametrize(
    ("path", "folder", "pattern"),
    [
        ("shards", "shards", "*"),
        ("shards/", "shards", "*"),
        ("shards/train-*.tar", "shards", "train-*.tar"),
        ("shards/train-0000?.tar", "shards", "train-0000?.tar"),
        ("shards/manifest.json", "shards", "*"),
        ("train-00000.tar", ".", "train-00000.tar"),
        ("file:///data/my%20shards/t*.tar", "/data/my shards", "t*.tar"),
        ("FILE:///data", "/data", "*"),
        ("http://host", "http://host", "*"),
        ("http://[::1]:80", "http://[::1]:80", "*"),
        ("HTTPS://host/a/shards//", "https://host/a/shards", "*"),
        ("https://host/a/train-*.tar", "https://host/a", "train-*.tar"),
        ("https://host/a/t*.tar?token=secret", "https://host/a", "t*.tar"),
        ("https://host/a?token=secret", "https://host/a", "*"),
        ("https://user:secret@host/manifest.json", "https://host", "*"),
        ("memory://bucket/a/train-0000?.tar", "memory://bucket/a", "train-0000?.tar"),
        ("memory://bucket/a/manifest.json", "memory://bucket/a", "*"),
    ],
)
def test_a_path_names_a_folder_and_some_of_its_shards(path: str, folder: str, pattern: str) -> None:
    store, found = open_store(path)
    assert (store.name, found) == (folder, pattern)


@pytest.mark.parametrize(
    ("path", "options", "message"),
    [
        ("nosuch://host/shards", {}, "nosuch://host/shards: Protocol not known: nosuch"),
        ("file://data/shards", {}, "a file:// address has a path from the root on, like file:///data/shards, found"),
        ("http://[::1/shards", {}, "not an address: Invalid IPv6 URL"),
        ("s3:/bucket/shards", {}, "an address has :// in it, a folder of such a name ./ before it"),
        (
            "shards",
            {"storage_options": {"key": "x"}},
            "storage_options and retry_policy are for remote sets, found them",
        ),
        (
            "127.0.0.1:8765/",
            {"retry_policy": RetryPolicy()},
            "storage_options and retry_policy are for remote sets, found them given for '127.0.0.1:8765/': an address "
            "begins with its protocol, as http:// or s3://",
        ),
    ],
)
def test_addresses_that_name_nothing_are_refused(path: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=f"^{re.escape(message)}"):
        RangeImages(path, **options)


def test_cache_options_are_checked(paper_set: Path, memory: str, tmp_path: Path) -> None:
    with pytest.raises(BadConfig, match="cache and cache_bytes are for remote sets, found them given for"):
        RangeImages(paper_set, cache=tmp_path)
    for wrong in (-1, 1.5, True, "10"):
        with pytest.raises(BadConfig, match="cache_bytes must be a whole number of at least 0, found"):
            RangeImages(memory, cache_bytes=wrong)  # type: ignore[arg-type]  # on purpose
    for name, wrong, rule in (
        ("tries", 0, "at least 1"),
        ("tries", 1.5, "a whole number"),
        ("progress_bytes", 0, "at least 1"),
        ("progress_bytes", True, "a whole number"),
        ("total_s", 0, "above 0"),
        ("stall_s", float("nan"), "above 0"),
        ("first_wait_s", float("inf"), "above 0"),
        ("total_s", "5", "a number"),
    ):
        with pytest.raises(BadConfig, match=f"RetryPolicy: {name} must be {rule}, found {wrong!r}"):
            RetryPolicy(**{name: wrong})


@pytest.mark.parametrize("missing", ["fsspec", "aiohttp"])
def test_a_missing_package_is_one_line(missing: str) -> None:
    script = (
        "import sys; sys.modules[sys.argv[1]] = None\n"
        "from bodyseg_data.shards.remote import open_store\n"
        "from bodyseg_data.core.errors import MissingLibrary\n"
        "try: open_store('https://host/shards')\n"
        "except MissingLibrary as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", script, missing], capture_output=True, text=True, timeout=60)
    assert done.stdout.startswith("https:// addresses need packages: pip install 'bodyseg[remote]' has those"), (
        done.stderr
    )
    assert done.stdout.count("\n") == 1


def test_a_filesystem_without_its_package_is_one_line() -> None:
    pytest.importorskip("fsspec")
    with pytest.raises(MissingLibrary, match=r"gs:// addresses need packages: .*gcsfs"):
        open_store("gs://bucket/shards")


def test_whatever_fsspec_knows_is_read_with_the_same_bits(memory: str, paper_set: Path, tmp_path: Path) -> None:
    local = RangeImages(paper_set, "noise")
    some = local.manifest.shards[0].size + 1000
    for options in ({"cache": tmp_path}, {"cache_bytes": 0}, {"cache": tmp_path, "cache_bytes": some}):
        images = RangeImages(f"{memory}/t*.tar", "noise", **options)  # type: ignore[arg-type]  # of three kinds
        assert images.keys == local.keys
        for index in (0, 9, 23):
            assert images.image(index).range.tobytes() == local.image(index).range.tobytes()


def test_a_filesystem_that_is_not_asynchronous_is_used_by_one_thread(memory: str, paper_set: Path) -> None:
    """It may talk over a single connection, as those of FTP and SFTP do."""
    users: dict[int, set[int]] = {}

    class OneConnection(fsspec.get_filesystem_class("memory")):  # type: ignore[misc]  # known at run time only
        protocol = "oneconnection"

        @classmethod
        def _strip_protocol(cls, path: str) -> Any:
            return super()._strip_protocol(path.replace("oneconnection://", "memory://"))

        def cat_file(self, *arguments: Any, **options: Any) -> Any:
            users.setdefault(id(self), set()).add(threading.get_ident())
            return super().cat_file(*arguments, **options)

    fsspec.register_implementation("oneconnection", OneConnection, clobber=True)
    images = RangeImages(memory.replace("memory", "oneconnection"), "none", cache_bytes=0)
    first, *_ = loader(images, 3, 2, worker_method="thread")
    assert first["key"] == images.keys[:3]
    assert len(users) > 1
    assert all(len(threads) == 1 for threads in users.values())


def test_files_are_read_in_order_and_to_their_end(memory: str, paper_set: Path) -> None:
    whole = (paper_set / "train-00000.tar").read_bytes()
    for store in (LocalFolder(paper_set), open_store(memory)[0]):
        assert store.size("train-00000.tar") == len(whole)
        with open_file(store, "train-00000.tar") as file:
            assert file.read(1000) + file.read() + file.read() == whole
        assert store.read_file("nothing.json", 10) is None
        assert store.read_file("manifest.json", 1 << 20) == (paper_set / "manifest.json").read_bytes()


class Stricter:
    """A store that takes a file of 1 kB for one of 256 MiB."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def read_file(self, name: str, limit: int) -> bytes | None:
        assert limit == 1 << 30
        return self._store.read_file(name, 1000)


@pytest.mark.parametrize("remote", [False, True])
def test_a_manifest_larger_than_any_is_not_read(remote: bool, memory: str, paper_set: Path) -> None:
    store = open_store(memory if remote else str(paper_set))[0]
    with pytest.raises((BadShard, Unreachable), match=r"manifest.json.*at most 1000 bytes are read, found more"):
        read_manifest(Stricter(store))


def test_the_cache_is_where_the_system_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "bodyseg"
    monkeypatch.setenv("HOME", "/home/someone")
    for relative in ("", "not/absolute"):
        monkeypatch.setenv("XDG_CACHE_HOME", relative)
        assert cache_folder() == Path("/home/someone/.cache/bodyseg")


def test_a_user_without_a_home_is_told_to_name_a_cache(memory: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", no_home)  # in a container, as a user that it does not know
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    with pytest.raises(BadConfig, match="^a cache's folder must be given, by XDG_CACHE_HOME or HOME: Could not det"):
        RangeImages(memory, split="train")


def test_what_was_not_used_for_longest_goes_first(tmp_path: Path) -> None:
    cache = ShardCache(tmp_path / "new" / "folder", 4096)
    shards = [record(number) for number in range(6)]
    for shard, age in zip(shards[:4], (400, 900, 600, 800), strict=True):
        assert fill(cache, shard, age)
    assert cache.read(shards[1], 0, 3) == b"\1\1\1", "reading counts as use"
    assert fill(cache, shards[4], 700)
    assert [cache.path(shard).exists() for shard in shards] == [True, True, True, False, True, False]
    assert fill(cache, shards[5], 700)
    assert [cache.path(shard).exists() for shard in shards] == [True, True, True, False, False, True]
    assert used_bytes(cache) == 4096


def test_what_is_in_use_stays_and_nothing_goes_in_vain(tmp_path: Path) -> None:
    cache = ShardCache(tmp_path, 3072)
    for number, age in enumerate((30, 500, 50)):
        assert fill(cache, record(number), age)
    assert not fill(cache, record(3, size=2048)), "one old shard would not be enough"
    assert len(list(tmp_path.glob("*.tar"))) == 3
    assert fill(cache, record(4))
    assert not cache.path(record(1)).exists()
    assert not fill(cache, record(5, size=5000)), "larger than the cache"


def test_what_the_cache_holds_is_looked_at_only_where_it_may_be_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []
    plain = ShardCache._entries

    def counted(self: ShardCache) -> Any:
        looks.append(self.limit)
        return plain(self)

    monkeypatch.setattr(ShardCache, "_entries", counted)
    cache = ShardCache(tmp_path, 20 * 1024)
    assert all(fill(cache, record(number), 100 - number) for number in range(20))
    assert len(looks) == 1, "each shard would cost a look at all before it"
    assert fill(cache, record(20), 1000) and not cache.path(record(0)).exists()
    with monkeypatch.context() as patch:
        patch.setattr("bodyseg_data.shards.cache.IN_USE_S", 1e6)
        assert not fill(ShardCache(tmp_path, 10 * 1024), record(21)), "of another process, with another limit"
    assert len(looks) == 3
    for path in list(tmp_path.glob("*.tar"))[:5]:
        path.unlink()
    assert all(fill(cache, record(30 + number)) for number in range(5))
    assert len(looks) == 4, "what was deleted is found, and not looked for again"
    assert used_bytes(cache) == cache.limit


def test_a_clock_that_was_set_back_keeps_nothing_for_ever(tmp_path: Path) -> None:
    """As of a robot without a battery for its clock: what it read yesterday was read next year."""
    cache = ShardCache(tmp_path, 3072)
    year = 365 * 24 * 3600
    assert all(fill(cache, record(number), age_s=-year) for number in range(3))
    assert cache.read(record(1), 0, 4) == b"\1\1\1\1"
    assert abs(cache.path(record(1)).stat().st_mtime - time.time()) < 60
    assert fill(cache, record(3)) and fill(cache, record(4))
    assert [cache.path(record(number)).exists() for number in range(5)] == [False, True, False, True, True]
    assert not fill(cache, record(5)), "all of them are in use"


def test_files_that_are_not_the_caches_own_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bodyseg_data.shards.cache.IN_USE_S", 0)
    for name in ("thesis.tar", f"{'a' * 63}.tar", f"{'a' * 64}.tar.bak"):
        (tmp_path / name).write_bytes(b"x" * 9999)
        os.utime(tmp_path / name, (0, 0))
    cache = ShardCache(tmp_path, 1024)
    assert fill(cache, record(0), 10)
    assert fill(cache, record(1), 10)
    assert used_bytes(cache) == 1024
    assert len(list(tmp_path.iterdir())) == 5


def test_a_part_counts_in_full_and_is_evicted_only_if_nobody_writes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bodyseg_data.shards.cache.IN_USE_S", 0)
    cache = ShardCache(tmp_path, 3000)
    part = cache.part(record(0, size=2048))
    part.write_bytes(b"begun")
    os.utime(part, (0, 0))
    assert used_bytes(cache) == 2048
    with part.open("rb") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        assert not fill(cache, record(1))
        assert part.exists()
    assert fill(cache, record(1))
    assert not part.exists()


def test_threads_that_want_one_shard_fetch_it_once(tmp_path: Path) -> None:
    cache = ShardCache(tmp_path, 1 << 20)
    fetched = []

    def want() -> None:
        handle: int | None = BUSY
        while handle == BUSY:
            with cache.claim(record(7)) as handle:
                if handle is not None and handle != BUSY:
                    time.sleep(0.1)
                    os.write(handle, bytes([7]) * 1024)
                    fetched.append(cache.finish(record(7)))

    threads = [threading.Thread(target=want) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert len(fetched) == 1
    assert cache.read(record(7), 1020, 100) == b"\7" * 4


def test_a_shard_finished_between_the_look_and_the_claim_is_not_fetched_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_now = os.open

    def open_late(*arguments: Any) -> int:
        monkeypatch.setattr(os, "open", open_now)
        assert fill(ShardCache(tmp_path, 4096), record(3))  # another process, just now
        return os.open(*arguments)

    monkeypatch.setattr(os, "open", open_late)
    with ShardCache(tmp_path, 4096).claim(record(3)) as handle:
        assert handle is None
    assert os.open is open_now, "the part was opened"
    assert [path.name for path in tmp_path.glob("*.*")] == [f"{record(3).sha256}.tar"], "no empty part takes room"


def test_a_shard_that_another_process_has_fetched_anew_is_not_dropped(
    memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = ShardCache(tmp_path, 1 << 20)
    assert fill(cache, record(3))
    cache.path(record(3)).write_bytes(b"spoiled")
    store = CachedStore(RemoteFolder(memory, {}, RetryPolicy()), [record(3)], cache)
    digest = hashlib.file_digest

    def slowly(file: Any, name: str) -> Any:
        found = digest(file, name)
        cache.path(record(3)).unlink()
        assert fill(cache, record(3))  # another process, meanwhile
        return found

    monkeypatch.setattr(hashlib, "file_digest", slowly)
    assert store.prepare_reread(record(3).name), "what was read was wrong"
    assert cache.read(record(3), 1020, 100) == b"\3" * 4


def test_altered_bytes_of_a_part_are_read_again_from_the_shard_that_has_come_meanwhile(
    memory: str, manifest: Manifest, paper_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, cache = manifest.shards[0], ShardCache(tmp_path, 1 << 20)
    whole = (paper_set / first.name).read_bytes()
    store = CachedStore(RemoteFolder(memory, {}, RetryPolicy()), [first], cache)
    again = store.prepare_reread

    def late(name: str) -> bool:
        cache.part(first).write_bytes(whole)  # another process, which has fetched it anew
        cache.finish(first)
        return again(name)

    monkeypatch.setattr(store, "prepare_reread", late)
    with cache.claim(first) as handle:
        assert handle not in (None, BUSY)
        cache.part(first).write_bytes(bytes(len(whole)))
        assert read_checked(store, first, 0) == whole[: first.lengths[0]]


def test_a_fork_while_a_shard_is_fetched_keeps_nobody_waiting(tmp_path: Path) -> None:
    cache = ShardCache(tmp_path, 1 << 20)
    with cache.claim(record(1)) as handle:
        assert handle is not None
        child = os.fork()
        if child == 0:
            time.sleep(60)
            os._exit(0)
    try:  # not finished: the next one carries on though the child still holds what it inherited
        begun = time.monotonic()
        assert fill(cache, record(1))
        assert time.monotonic() - begun < 30
    finally:
        os.kill(child, 9)
        os.waitpid(child, 0)


@pytest.fixture
def manifest(paper_set: Path) -> Manifest:
    return read_manifest(paper_set)


@pytest.mark.parametrize("where", ["write", "fsync", "open"])
def test_a_disk_that_fills_up_ends_the_caching_and_not_the_run(
    where: str, memory: str, manifest: Manifest, paper_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = with_cache(open_store(memory)[0], manifest.shards, tmp_path, None)
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fail(*_: object, **__: object) -> None:
        raise full

    with monkeypatch.context() as patch:
        if where == "write":
            patch.setattr(CachedStore, "_fetch", fail)
        else:
            patch.setattr(os, where, fail)
        with pytest.warns(RuntimeWarning, match=f"^{tmp_path}: No space left on device: shards are no longer kept"):
            read = ShardReader(store, manifest).read(0, 0)
    assert (read.range == ShardReader(paper_set, manifest).read(0, 0).range).all()
    assert sum(path.stat().st_size for path in tmp_path.glob("*.part")) == 0, "what was begun takes no room"
    ShardReader(store, manifest).read(1, 0)
    assert not list(tmp_path.glob("*.tar"))


def test_a_disk_that_really_is_full(memory: str, manifest: Manifest, paper_set: Path, tmp_path: Path) -> None:
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(tmp_path)], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no small disk can be mounted here: {mounted.stderr.strip()}")
    try:
        store = with_cache(open_store(memory)[0], manifest.shards, tmp_path, None)
        with pytest.warns(RuntimeWarning, match="No space left on device"):
            read = ShardReader(store, manifest).read(0, 0)
        assert (read.range == ShardReader(paper_set, manifest).read(0, 0).range).all()
        assert sum(path.stat().st_size for path in tmp_path.glob("*.part")) == 0
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def test_a_cache_that_cannot_be_is_said_at_once(memory: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadConfig, match=r"file/cache: the cache's folder cannot .* XDG_CACHE_HOME, .*: Not a dir"):
        RangeImages(memory, cache=tmp_path / "file" / "cache")
    with pytest.raises(BadConfig, match=r"^/proc/cache: the cache's folder .*, or cache_bytes=0 for none: "):
        RangeImages(memory, cache="/proc/cache")
    RangeImages(memory, cache_bytes=0).clean(0)


def test_two_sets_never_mix_though_their_shards_have_the_same_names(
    memory: str, manifest: Manifest, paper_set: Path, tmp_path: Path
) -> None:
    """As when a set behind an address is replaced by another one."""
    RangeImages(memory, cache=tmp_path).clean(0)
    files = fsspec.filesystem("memory")
    first, second = manifest.shards[:2]
    files.copy(f"/sets/figures/{second.name}", f"/sets/figures/{first.name}")
    changed = replace(manifest, shards=(replace(second, name=first.name),))
    store = with_cache(open_store(memory)[0], changed.shards, tmp_path, None)
    assert ShardReader(store, changed).read(0, 0).key == second.keys[0]
    assert ShardReader(with_cache(open_store(memory)[0], manifest.shards, tmp_path, None), manifest).read(0, 0)


def test_a_manifest_at_odds_with_itself_empties_nobodys_cache(memory: str, manifest: Manifest, tmp_path: Path) -> None:
    RangeImages(memory, cache=tmp_path).clean(0)
    (held,) = tmp_path.glob("*.tar")
    first = manifest.shards[0]
    odd = replace(manifest, shards=(replace(first, crc32=(1, *first.crc32[1:])),))
    store = with_cache(open_store(memory)[0], odd.shards, tmp_path, None)
    assert isinstance(store, CachedStore)
    with pytest.raises(BadShard, match="altered: CRC-32 00000001 expected"):
        ShardReader(store, odd).read(0, 0)
    assert held.exists()
