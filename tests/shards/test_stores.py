"""Sets behind an HTTP and an S3-compatible server, which fail in every way that networks do."""

from __future__ import annotations

import contextlib
import gc
import pickle
import shutil
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import warm
from replies import Reply, refusal
from servers import TOKEN, WebServer, free_port, s3_server, web_server
from torch.utils.data import DataLoader

from bodyseg_data import RangeImages, loader
from bodyseg_data.commands import main
from bodyseg_data.core import BadConfig, BadShard
from bodyseg_data.shards import (
    LocalFolder,
    Manifest,
    RemoteFolder,
    RetryPolicy,
    ShardReader,
    Unreachable,
    read_manifest,
    with_cache,
)
from bodyseg_data.shards.cache import CachedStore

QUICK = RetryPolicy(tries=12, first_wait_s=0.001)  # what waits for a busy machine has not stalled


@pytest.fixture(scope="module")
def server(paper_set: Path) -> Iterator[WebServer]:
    pytest.importorskip("aiohttp")
    with web_server(paper_set) as running:
        yield running


@pytest.fixture(scope="module")
def bucket(paper_set: Path) -> Iterator[WebServer]:
    """An S3-compatible server behind one that answers two requests in five with 503."""
    pytest.importorskip("s3fs")
    with s3_server(paper_set, "bucket", "shards") as port, web_server(paper_set, port) as running:
        yield running


@pytest.fixture
def s3(bucket: WebServer) -> WebServer:
    bucket.forget()
    return bucket


def s3_options(s3: WebServer) -> dict[str, Any]:
    return {"key": "AKID-EXAMPLE", "secret": "very-secret", "endpoint_url": s3.url("").rstrip("/")}


@pytest.fixture
def web(server: WebServer) -> WebServer:
    server.forget()
    return server


@pytest.fixture(scope="module")
def manifest(paper_set: Path) -> Manifest:
    return read_manifest(paper_set)


def bits(images: RangeImages) -> list[tuple[str, bytes, bytes]]:
    return [
        (image.key, image.range.tobytes(), image.labels.tobytes()) for image in map(images.image, range(len(images)))
    ]


@pytest.fixture(scope="module")
def expected(paper_set: Path) -> list[tuple[str, bytes, bytes]]:
    return bits(RangeImages(paper_set, "noise"))


def cached(
    url: str, manifest: Manifest, cache: Path, limit: int = 10**9, retry_policy: RetryPolicy = QUICK
) -> CachedStore:
    store = with_cache(RemoteFolder(url, {}, retry_policy), manifest.shards, cache, limit)
    assert isinstance(store, CachedStore)
    return store


def test_shards_are_fetched_once_and_then_read_from_the_cache(
    web: WebServer, manifest: Manifest, tmp_path: Path, expected: Any
) -> None:
    for _ in range(2):
        assert bits(RangeImages(web.url("good/"), "noise", cache=tmp_path / "cache")) == expected
    assert [(line.status, line.sent) for line in web.log(".tar")] == [(206, shard.size) for shard in manifest.shards]
    assert len(web.log("manifest.json")) == 2
    held = {path.name: path.read_bytes() for path in (tmp_path / "cache").glob("*.tar")}
    assert sorted(held) == sorted(f"{shard.sha256}.tar" for shard in manifest.shards)
    assert sorted(map(len, held.values())) == sorted(shard.size for shard in manifest.shards)


def test_without_a_cache_samples_are_read_by_range(web: WebServer, manifest: Manifest, expected: Any) -> None:
    assert bits(RangeImages(web.url("good"), "noise", cache_bytes=0)) == expected
    assert [line.sent for line in web.log(".tar")] == [length for shard in manifest.shards for length in shard.lengths]


def contents(store: Any, manifest: Manifest) -> list[bytes]:
    """What a reader reads, sample by sample."""
    places = ((shard, index) for shard in manifest.shards for index in range(len(shard)))
    return [store.read(shard.name, shard.offsets[index], shard.lengths[index]) for shard, index in places]


@pytest.fixture(scope="module")
def stored(paper_set: Path, manifest: Manifest) -> list[bytes]:
    return contents(LocalFolder(paper_set), manifest)


@pytest.mark.parametrize("location", ["failing", "limited", "moved", "slow"])
def test_trouble_that_passes_does_not_show(
    location: str, web: WebServer, manifest: Manifest, tmp_path: Path, stored: list[bytes]
) -> None:
    if location in ("slow", "limited"):
        manifest = replace(manifest, shards=manifest.shards[:2])
    policy = replace(QUICK, stall_s=0.5) if location == "slow" else QUICK
    read = contents(cached(web.url(location), manifest, tmp_path, retry_policy=policy), manifest)
    assert read == stored[: len(read)]
    assert len(list(tmp_path.glob("*.tar"))) == len(manifest.shards)
    assert not list(tmp_path.glob("*.part"))
    if location == "slow":
        burst = manifest.shards[0].size * 3 // 4
        assert sorted(line.start for line in web.log(".tar")) == [0, 0, burst, burst], "what stalls is taken up again"
    if location == "moved":
        assert {line.status for line in web.log()} == {302, 206}
    errors = {"failing": 500, "limited": 429}.get(location)
    if errors is not None:
        read = contents(RemoteFolder(web.url(location), {}, QUICK), manifest)
        assert read == stored[: len(read)]
        assert sum(line.status == errors for line in web.log()) > 0


def cut(reply: Reply, before: int) -> Reply:
    """The connection breaks after 8 kB, every time but every fourth."""
    return reply if before % 4 == 3 else replace(reply, body=reply.body[:8_000])


def cut_after_much(reply: Reply, before: int) -> Reply:
    """Every time, but never before something has come."""
    return replace(reply, body=reply.body[:12_000])


def short(reply: Reply, before: int) -> Reply:
    """A body that is too short and does not say so."""
    half = len(reply.body) // 2
    return reply if half < 5000 else replace(reply, body=reply.body[:half], length=half)


def nothing(reply: Reply, before: int) -> Reply:
    return reply if before % 3 == 2 else replace(reply, body=b"")


def busy(reply: Reply, before: int) -> Reply:
    return reply if before % 3 == 2 else replace(reply, status=503, body=b"", length=0)


def elsewhere(reply: Reply, before: int) -> Reply:
    """Other bytes than asked for, and it says so."""
    return reply if before % 2 else replace(reply, body=bytes(512), length=512, content_range="bytes 77-588/4096")


def altered(reply: Reply, before: int) -> Reply:
    """A bit flipped in the middle, the first time."""
    body = bytearray(reply.body)
    body[len(body) // 2] ^= 1 if before % 2 == 0 else 0
    return replace(reply, body=bytes(body))


def stalled(reply: Reply, before: int) -> Reply:
    return reply if before else replace(reply, body=reply.body[:1000], pause_s=60.0)


@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize("act", [cut, cut_after_much, short, nothing, busy, elsewhere, altered])
def test_replies_that_break_do_not_show(
    act: Any,
    direct: bool,
    web: WebServer,
    manifest: Manifest,
    tmp_path: Path,
    paper_set: Path,
) -> None:
    web.faults.act = act
    url = web.url("faulty")
    retry_policy = replace(QUICK, progress_bytes=10_000)  # the shards are small
    store = (
        RemoteFolder(url, {}, retry_policy) if direct else cached(url, manifest, tmp_path, retry_policy=retry_policy)
    )
    reader = ShardReader(store, manifest)
    local = ShardReader(paper_set, manifest)
    for shard, record in enumerate(manifest.shards[:2]):
        for index in range(len(record)):
            ours, theirs = reader.read(shard, index), local.read(shard, index)
            assert (ours.range == theirs.range).all() and (ours.labels == theirs.labels).all()
    served = sum(line.sent for line in web.log(".tar"))
    whole = sum(shard.size for shard in manifest.shards[:2])
    assert served < (2.1 if act is altered else 1.03) * whole, "only what is missing is fetched again"
    asked = sum(web.faults.asked.values())
    assert asked > (10 if direct else 2), "something broke"


def test_a_connection_that_stalls_is_given_up_and_taken_up_again(
    web: WebServer, manifest: Manifest, tmp_path: Path
) -> None:
    web.faults.act = stalled
    shard = manifest.shards[0]
    begun = time.monotonic()
    policy = replace(QUICK, stall_s=1)
    cached(web.url("faulty"), manifest, tmp_path, retry_policy=policy).read(shard.name, 0, 512)
    assert web.faults.asked[shard.name] == 2
    assert time.monotonic() - begun < 30, "the server would have gone on after a minute"
    assert [line.start for line in web.log(".tar")][-1] == 1000


def test_a_server_without_ranges_corrupts_nothing(
    web: WebServer, manifest: Manifest, tmp_path: Path, stored: list[bytes]
) -> None:
    store = cached(web.url("rangeless"), manifest, tmp_path)
    shard = manifest.shards[0]
    part = tmp_path / f"{shard.sha256}.{shard.size}.part"
    part.write_bytes(stored[0][:333])  # begun when the server still knew ranges
    assert contents(store, manifest) == stored
    assert {line.status for line in web.log()} == {200}
    with pytest.raises(
        Unreachable, match=r"rangeless/train-00000.tar: the server ignores byte ranges: .* or bodyseg pull"
    ):
        RemoteFolder(web.url("rangeless"), {}, QUICK).read(shard.name, 512, 512)


def test_a_part_of_another_object_is_found_out(
    web: WebServer, manifest: Manifest, tmp_path: Path, stored: list[bytes]
) -> None:
    """As when the shard was changed on the server between a cut and the resumption."""
    store = cached(web.url("good"), manifest, tmp_path)
    shard = manifest.shards[0]
    good = stored[0] + stored[1]
    (tmp_path / f"{shard.sha256}.{shard.size}.part").write_bytes(good + b"from an older shard")
    assert contents(store, manifest) == stored
    first, again = web.log(shard.name)
    assert (first.start, again.start) == (len(good) + 19, 0)


@pytest.mark.parametrize("direct", [False, True])
def test_bytes_altered_on_the_server_are_an_error_that_says_all(
    direct: bool, web: WebServer, manifest: Manifest, tmp_path: Path
) -> None:
    def always(reply: Reply, before: int) -> Reply:
        body = bytearray(reply.body)
        if len(body) > 700:
            body[700] ^= 1
        return replace(reply, body=bytes(body))

    web.faults.act = always
    url = web.url("faulty")
    store = RemoteFolder(url, {}, QUICK) if direct else cached(url, manifest, tmp_path)
    line = r"train-00000.tar: open-\S+: offset 0: altered: CRC-32 [0-9a-f]{8} expected, found [0-9a-f]{8}"
    warned = contextlib.nullcontext() if direct else pytest.warns(RuntimeWarning, match=r"altered \(fetched 3")
    with warned, pytest.raises(BadShard, match=f"^{line}$"):
        ShardReader(store, manifest).read(0, 0)
    assert web.faults.asked == {"train-00000.tar": 3 if direct else 6}
    assert not list(tmp_path.glob("*.tar"))


def test_one_sample_altered_on_the_server_spoils_no_other(
    web: WebServer, manifest: Manifest, tmp_path: Path, stored: list[bytes]
) -> None:
    shard = manifest.shards[0]
    place = shard.offsets[2] + 700

    def third(reply: Reply, before: int) -> Reply:
        start = int(reply.content_range[6:].partition("-")[0])
        body = bytearray(reply.body)
        if 0 <= place - start < len(body):
            body[place - start] ^= 1
        return replace(reply, body=bytes(body))

    web.faults.act = third
    reader = ShardReader(cached(web.url("faulty"), manifest, tmp_path), manifest)
    with pytest.warns(RuntimeWarning, match=f"{shard.name}: altered.*not kept"):
        reader.read(0, 0)
    for index in (1, 3, 4):
        assert reader.read(0, index).key == shard.keys[index]
    with pytest.raises(
        BadShard, match=f"^train-00000.tar: {shard.keys[2]}: offset {shard.offsets[2]}: altered: CRC-32"
    ):
        reader.read(0, 2)
    assert [line.start for line in web.log(shard.name)][:3] == [0, 0, 0]


@pytest.mark.parametrize(
    ("location", "message"),
    [
        ("forbidden", "manifest.json: 403 Forbidden"),
        ("private", "manifest.json: 401 Unauthorized"),
        ("nowhere", " holds no manifest.json: not a set of shards, or its packing has not ended"),
        ("silent", r"manifest.json: ServerDisconnectedError: Server disconnected \(3 attempts\)"),
        ("packed", r"manifest.json: the server sends it packed \(gzip\), though asked not to"),
        ("circle", "manifest.json: TooManyRedirects: .*"),
    ],
)
def test_what_cannot_be_had_is_one_clear_line(location: str, message: str, web: WebServer, tmp_path: Path) -> None:
    with pytest.raises((Unreachable, BadShard), match=f"^{web.url(location)}.?{message}$"):
        RangeImages(web.url(location), retry_policy=RetryPolicy(tries=3, first_wait_s=0.001), cache=tmp_path)
    asked = [line.status for line in web.log()]
    assert (len(asked) > asked.count(302) + 1) == (location == "silent"), "only trouble that may pass is tried again"
    assert asked.count(302) in (0, 10), "as often as is usual for one request"


@pytest.mark.parametrize(("workers", "status"), [(0, 404), (2, 404), (0, 403)])
def test_a_shard_that_is_missing_stops_a_run_in_one_line(
    workers: int, status: int, web: WebServer, tmp_path: Path
) -> None:
    web.faults.act = lambda reply, before: replace(reply, status=status)
    images = RangeImages(web.url("faulty"), cache=tmp_path, retry_policy=QUICK)
    with pytest.raises(Unreachable, match=rf"^http://127.0.0.1:\d+/faulty/train-0000\d.tar: {status} \w") as caught:
        list(loader(images, 8, workers))
    assert caught.type is Unreachable, "a traceback names the class that users know"


def shortened(reply: Reply, before: int) -> Reply:
    """As of a file of 700 bytes."""
    start = int(reply.content_range[6:].partition("-")[0])
    body = reply.body[: max(0, 700 - start)]
    whole = replace(reply, body=body, length=len(body), content_range=f"bytes {start}-{start + len(body) - 1}/700")
    return whole if body else refusal(416, Content_Range="bytes */700")


def a_page(reply: Reply, before: int) -> Reply:
    page = b"<!DOCTYPE html><html></html>"
    return Reply(page, len(page), status=200)


@pytest.mark.parametrize("kept", [True, False])
def test_a_shard_that_is_too_short_or_a_web_page_is_told(
    kept: bool, web: WebServer, manifest: Manifest, tmp_path: Path
) -> None:
    shard = manifest.shards[0]
    wanted = shard.size if kept else shard.offsets[1]
    for act, message in (
        (shortened, rf"cut short: {wanted} bytes or more expected, found 700 \(\d+ attempts\)"),
        (a_page, r"found a web page \(HTML\): is the address right, and may it be read without signing in\?"),
    ):
        web.faults.act = act
        few, url = replace(QUICK, tries=4), web.url("faulty")
        store = cached(url, manifest, tmp_path, retry_policy=few) if kept else RemoteFolder(url, {}, few)
        with pytest.raises(Unreachable, match=rf"/{shard.name}: {message}$"):
            ShardReader(store, manifest).read(0, 0)
        web.forget()


def test_a_row_of_failures_is_bounded_in_number_and_time(web: WebServer, manifest: Manifest) -> None:
    for status, words, retry_policy, least, most in (
        (500, "Internal Server Error", RetryPolicy(tries=4, first_wait_s=0.001), 4, 4),
        (507, "Insufficient Storage", RetryPolicy(tries=4, first_wait_s=0.001), 4, 4),
        (500, "Internal Server Error", RetryPolicy(tries=99, first_wait_s=0.02, total_s=0.2), 3, 7),
    ):
        web.faults.act = lambda reply, before, status=status: replace(reply, status=status)
        web.faults.asked.clear()
        with pytest.raises(Unreachable, match=rf"train-00000.tar: {status} {words} \(\d attempts\)$"):
            RemoteFolder(web.url("faulty"), {}, retry_policy).read("train-00000.tar", 0, 512)
        assert least <= web.faults.asked["train-00000.tar"] <= most


def test_a_server_that_asks_for_more_time_than_there_is_is_given_up_at_once(web: WebServer) -> None:
    retry_policy = RetryPolicy(tries=3, first_wait_s=0.001, total_s=0.5)
    for headers, attempts in (({}, 3), ({"Retry_After": "1"}, 1)):
        web.faults.act = lambda reply, before, headers=headers: refusal(429, **headers)
        with pytest.raises(Unreachable, match=rf"train-00000.tar: 429 Too Many Requests \({attempts} attempts\)$"):
            RemoteFolder(web.url("faulty"), {}, retry_policy).read("train-00000.tar", 0, 512)


def test_nobody_listening_is_one_clear_line(tmp_path: Path) -> None:
    url = f"http://127.0.0.1:{free_port()}/shards"
    with pytest.raises(
        Unreachable, match=r"manifest.json: ClientConnectorError: .*Connect call failed.*\(2 attempts\)$"
    ):
        RangeImages(url, cache=tmp_path, retry_policy=RetryPolicy(tries=2, first_wait_s=0.001))


def test_secrets_are_used_and_never_shown(web: WebServer, tmp_path: Path) -> None:
    host = web.url("").removeprefix("http://")
    for url, options in (
        (f"http://someone:pass-word@{host}private", {}),
        (f"http://{host}private", {"headers": {"Authorization": "Basic c29tZW9uZTpwYXNzLXdvcmQ="}}),
        (f"http://{host}signed/train-*.tar?token=hush-hush", {}),
    ):
        images = RangeImages(url, cache=tmp_path, storage_options=options, retry_policy=QUICK)
        images.clean(0)
        text = f"{images.path} {images.urls()}"
        wrong = url.replace("pass-word", "false-word").replace("hush", "tush")
        if options:
            options = {"headers": {"Authorization": "Basic ZmFsc2U6d29yZA=="}}
        with pytest.raises(Unreachable, match="40[13]") as caught:
            RangeImages(wrong, cache=tmp_path, storage_options=options, retry_policy=QUICK)
        text += str(caught.value)
        assert not any(secret in text for secret in ("word", "hush", "tush", "Basic", "someone", "token"))


def test_options_of_the_filesystem_and_of_requests_are_told_apart(web: WebServer, tmp_path: Path) -> None:
    own = {"use_listings_cache": True, "block_size": 4096, "encoded": True}
    retry_policy = RetryPolicy(tries=2, first_wait_s=0.001)
    RangeImages(web.url("moved"), cache=tmp_path, storage_options=own).clean(0)
    with pytest.raises(Unreachable, match="manifest.json: 302 Found$"):
        RangeImages(web.url("moved"), storage_options={**own, "allow_redirects": False}, retry_policy=retry_policy)


def test_one_shard_a_glob_and_the_manifest_choose_as_they_do_locally(
    web: WebServer, paper_set: Path, tmp_path: Path
) -> None:
    for choice in ("", "train-*.tar", "test-00001.tar", "manifest.json"):
        ours, theirs = RangeImages(web.url(f"good/{choice}"), cache=tmp_path), RangeImages(paper_set / choice)
        assert ours.keys == theirs.keys
        assert [url.rpartition("/")[2] for url in ours.urls()] == [url.rpartition("/")[2] for url in theirs.urls()]
    assert len(web.log()) == 4, "nothing but manifests is fetched before it is needed"


@pytest.mark.parametrize("method", ["fork", "forkserver"])
def test_workers_read_remote_sets_however_they_are_started(
    method: str, web: WebServer, manifest: Manifest, tmp_path: Path, expected: Any
) -> None:
    images = RangeImages(web.url("good"), "noise", cache=tmp_path, retry_policy=QUICK)
    images.image(0)  # the parent has a connection of its own
    batches = DataLoader(images, 6, num_workers=2 if method == "fork" else 1, multiprocessing_context=method)
    ranges = torch.cat([batch["range"] for batch in batches])
    images.image(23)
    local = torch.stack(
        [torch.frombuffer(bytearray(image[1]), dtype=torch.uint16).view(1, 640, -1) for image in expected]
    )
    assert torch.equal(ranges, local.to(torch.float32) * images.step_m)
    assert len(web.log(".tar")) == len(manifest.shards), "each shard is fetched once, whoever needs it"


@pytest.mark.parametrize("method", ["process", "thread"])
def test_workers_read_by_range_while_their_parent_does(method: Any, web: WebServer, expected: Any) -> None:
    images = RangeImages(web.url("good"), "noise", cache_bytes=0, retry_policy=QUICK)
    keys = []
    for batch in loader(images, 4, 2, worker_method=method):
        keys += batch["key"]
        assert images.image(len(keys) - 1).range.tobytes() == expected[len(keys) - 1][1]
    assert keys == [image[0] for image in expected]


def test_threads_fetch_each_shard_once(web: WebServer, manifest: Manifest, tmp_path: Path, expected: Any) -> None:
    images = RangeImages(web.url("good"), "noise", cache=tmp_path, retry_policy=QUICK)
    batches = loader(images, 1, 6, shuffle=True, metres=False, worker_method="thread")
    found = sorted((batch["key"][0], batch["range"].numpy().tobytes()) for batch in batches)
    assert found == sorted(image[:2] for image in expected)
    assert len(web.log(".tar")) == len(manifest.shards)


READER = """
import sys
from pathlib import Path
from bodyseg_data.shards.remote import open_store
from bodyseg_data.shards.cache import with_cache
from bodyseg_data.shards.manifest import read_manifest
store, _ = open_store(sys.argv[1])
manifest = read_manifest(store)
kept = with_cache(store, manifest.shards, sys.argv[2], None)
for shard in manifest.shards[: int(sys.argv[3])]:
    assert len(kept.read(shard.name, 0, 512)) == 512
"""


def start(url: str, cache: Path, shards: int) -> warm.Program:
    return warm.Program(["-c", READER, url, str(cache), str(shards)])


def test_two_processes_fetch_each_shard_once(web: WebServer, manifest: Manifest, tmp_path: Path) -> None:
    web.faults.act = lambda reply, before: replace(reply, step=manifest.shards[0].size * 3 // 4, step_s=0.3)
    url = web.url("faulty")
    with start(url, tmp_path / "cache", 2) as one, start(url, tmp_path / "cache", 2) as other:
        assert [reader.wait() for reader in (one, other)] == [0, 0]
    assert sorted(line.sent for line in web.log(".tar")) == sorted(shard.size for shard in manifest.shards[:2])


def test_a_killed_download_is_carried_on(web: WebServer, manifest: Manifest, tmp_path: Path) -> None:
    shard = manifest.shards[0]
    part = tmp_path / f"{shard.sha256}.{shard.size}.part"
    with start(web.url("crawling"), tmp_path, 1) as reader:
        while not part.exists() or part.stat().st_size < shard.size // 4:
            assert Path(f"/proc/{reader.pid}").exists(), reader.stderr.read()
            time.sleep(0.01)
        reader.send_signal(signal.SIGKILL)
    have = part.stat().st_size
    assert shard.size // 4 <= have < shard.size
    assert len(web.log(".tar")) == 1, "the server has seen it"
    cached(web.url("good"), manifest, tmp_path).read(shard.name, 0, 512)
    before, after = web.log(".tar")
    assert (after.start, after.sent) == (have, shard.size - have)
    assert before.sent < shard.size
    assert [path.name for path in tmp_path.glob(f"{shard.sha256}*")] == [f"{shard.sha256}.tar"]


def test_what_has_no_room_is_read_by_range(
    web: WebServer, manifest: Manifest, tmp_path: Path, stored: list[bytes]
) -> None:
    limit = sum(shard.size for shard in manifest.shards[:2]) + 1000
    store = cached(web.url("good"), manifest, tmp_path, limit)
    for _ in range(2):
        assert contents(store, manifest) == stored
    fetched = [line.sent for line in web.log(".tar") if line.path.endswith(("train-00000.tar", "train-00001.tar"))]
    assert fetched == [shard.size for shard in manifest.shards[:2]]
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= limit
    others = sum(len(shard) for shard in manifest.shards[2:])
    assert len(web.log(".tar")) == 2 + 2 * others


def test_a_spoiled_cache_is_mended(web: WebServer, manifest: Manifest, tmp_path: Path) -> None:
    store = cached(web.url("good"), manifest, tmp_path)
    reader = ShardReader(store, manifest)
    reader.read(0, 0)
    path = tmp_path / f"{manifest.shards[0].sha256}.tar"
    whole = path.read_bytes()
    for spoiled in (whole[:700] + b"?" + whole[701:], whole[:700], b""):
        path.write_bytes(spoiled)
        reader.read(0, 0)
        assert path.read_bytes() == whole


def test_a_reader_is_pickled_without_connections_but_with_its_options(web: WebServer, manifest: Manifest) -> None:
    options = {"headers": {"Authorization": "Basic c29tZW9uZTpwYXNzLXdvcmQ="}}
    reader = ShardReader(RemoteFolder(web.url("private"), options, QUICK), manifest)
    first = reader.read(0, 0)
    again = pickle.loads(pickle.dumps(reader)).read(0, 0)
    assert (first.range == again.range).all()


def test_connections_of_a_set_end_with_it(web: WebServer) -> None:
    store = RemoteFolder(web.url("good"), {}, QUICK)
    assert store.read_file("manifest.json", 10**6)
    opened = weakref.ref(store._transport._filesystem.get())
    gc.disable()  # a collection in a fork would close them there, which waits
    try:
        del store
        until = time.monotonic() + 10  # fsspec's thread may still be ending the request
        while opened() is not None and time.monotonic() < until:
            time.sleep(0.01)
        assert opened() is None
    finally:
        gc.enable()


def test_commands_take_addresses(
    web: WebServer,
    manifest: Manifest,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert main(["verify", web.url("good/")]) == 0
    assert f"{web.url('good')}: 24 samples in 6 shards" in capsys.readouterr().out
    for address in (web.url("good/test-*.tar"), web.url(f"signed/test-*.tar?token={TOKEN}")):
        assert main(["inspect", address, "--json"]) == 0
        assert '"samples": 8' in capsys.readouterr().out
    assert len(list((tmp_path / "bodyseg").glob("*.tar"))) == 2
    out = tmp_path / "sheet.png"
    assert main(["inspect", web.url("good/test-*.tar"), "--rows", "2", "--out", str(out)]) == 0
    assert out.exists()
    web.faults.act = lambda reply, before: replace(reply, body=b"x" + reply.body[1:]) if before == 1 else reply
    assert main(["verify", web.url("faulty")]) == 0, "bytes altered on the way are no fault of the set"
    web.faults.act = lambda reply, before: replace(reply, body=b"x" + reply.body[1:])
    assert main(["verify", web.url("faulty")]) == 1
    assert "train-00000.tar: open-" in capsys.readouterr().out
    web.faults.act = lambda reply, before: replace(reply, status=404)
    assert main(["verify", web.url("faulty")]) == 1
    assert "train-00000.tar: -: offset 0: cannot be read: http://127.0.0.1" in capsys.readouterr().out


def test_a_set_in_a_bucket_is_read_like_any_other(
    s3: WebServer, tmp_path: Path, manifest: Manifest, expected: Any
) -> None:
    for limit in (None, 0):
        images = RangeImages(
            "s3://bucket/shards/",
            "noise",
            cache=None if limit == 0 else tmp_path,
            cache_bytes=limit,
            storage_options=s3_options(s3),
            retry_policy=QUICK,
        )
        assert bits(images) == expected
    gone = [line for line in s3.log(".tar") if line.status == 206]
    assert len(gone) == 6 + 24
    assert sum(line.sent for line in gone) == sum(shard.size + sum(shard.lengths) for shard in manifest.shards)
    assert sum(line.status == 503 for line in s3.log()) > 2


@pytest.mark.parametrize("method", ["process", "thread"])
def test_workers_read_buckets(method: Any, s3: WebServer, tmp_path: Path, expected: Any) -> None:
    options = s3_options(s3)
    images = RangeImages(
        "s3://bucket/shards/t*.tar", "noise", cache=tmp_path, storage_options=options, retry_policy=QUICK
    )
    images.image(0)
    batches = loader(images, 4, 2, worker_method=method)
    assert [key for batch in batches for key in batch["key"]] == [image[0] for image in expected]


@pytest.mark.parametrize(
    ("url", "options", "message"),
    [
        ("s3://bucket/nowhere", {}, "s3://bucket/nowhere holds no manifest.json"),
        ("s3://elsewhere/shards", {}, "s3://elsewhere/shards holds no manifest.json|403|Forbidden|404"),
        ("s3://bucket/shards", {"key": None}, "PartialCredentialsError"),
        ("s3://Bucket!/shards", {}, "ParamValidationError"),
    ],
)
def test_what_a_bucket_refuses_is_one_clear_line(
    url: str, options: dict[str, Any], message: str, s3: WebServer, tmp_path: Path
) -> None:
    with pytest.raises((Unreachable, BadShard), match=message) as caught:
        RangeImages(url, cache=tmp_path, storage_options={**s3_options(s3), **options}, retry_policy=QUICK)
    assert "very-secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_webdataset_pipeline_reads_addresses(web: WebServer, tmp_path: Path, expected: Any) -> None:
    pytest.importorskip("webdataset")
    images = RangeImages(web.url("good"), "noise", cache=tmp_path)
    assert [sample["key"] for sample in images.webdataset()] == [image[0] for image in expected]


def test_an_address_that_cannot_be_opened_is_one_error_and_nothing_else_on_standard_error() -> None:
    addresses = ["ftp://127.0.0.1:1/set", "ftp:///set", "github://set", "foo://set", "webhdfs:///s"]
    program = (
        "import sys\n"
        "from bodyseg_data.core.errors import BodysegError\n"
        "from bodyseg_data.shards.remote import RemoteFolder, RetryPolicy\n"
        "for address in sys.argv[1:]:\n"
        "    try:\n        RemoteFolder(address, {}, RetryPolicy())\n"
        "    except BodysegError as error:\n        print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, *addresses], capture_output=True, text=True, timeout=100)
    assert done.stderr == "" and done.returncode == 0
    lines = done.stdout.splitlines()
    assert len(lines) == len(addresses)
    assert all(line.startswith(f"{address}: ") for line, address in zip(lines, addresses, strict=True)), lines


def test_host_and_port_of_an_address_reach_the_filesystem() -> None:
    with pytest.raises(BadConfig, match=r"ftp://127\.0\.0\.1:1/set: .*refused"):
        RemoteFolder("ftp://127.0.0.1:1/set", {}, RetryPolicy())


def test_what_a_filesystem_cannot_do_without_may_be_in_fsspecs_configuration(
    paper_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, expected: Any
) -> None:
    fsspec = pytest.importorskip("fsspec")

    class Packed(fsspec.get_filesystem_class("zip")):  # type: ignore[misc]
        protocol = "packed"

        def __init__(self, archive: str, **options: Any) -> None:
            super().__init__(archive, **options)

    fsspec.register_implementation("packed", Packed, clobber=True)
    archive = shutil.make_archive(str(tmp_path / "archive"), "zip", paper_set.parent, paper_set.name)
    monkeypatch.setitem(fsspec.config.conf, "packed", {"archive": archive})
    assert bits(RangeImages(f"packed://{paper_set.name}", "noise", cache_bytes=0)) == expected
    assert main(["verify", f"packed://{paper_set.name}"]) == 0


HUB = "hf://datasets/owner/name"


def test_a_set_on_the_hub_is_read_at_one_commit(
    web: WebServer, tmp_path: Path, expected: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("huggingface_hub")
    monkeypatch.setattr(web, "commits", {"main": "a" * 40, "v1.0": "b" * 40})
    monkeypatch.setenv("HF_ENDPOINT", web.url("").rstrip("/"))
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    options: dict[str, Any] = {"variant": "noise", "retry_policy": QUICK, "cache_bytes": 0}
    images = RangeImages(HUB, **options)
    assert images.path == f"{HUB}@{'a' * 40}"
    monkeypatch.setitem(web.commits, "main", "c" * 40)
    monkeypatch.setitem(web.commits, "refs/pr/1", "a" * 40)  # the old commit is still there
    monkeypatch.delenv("HF_TOKEN")
    copy = pickle.loads(pickle.dumps(images))
    for each in (images, copy):
        assert bits(each) == expected
    assert {request.path.split("/")[5] for request in web.log("/resolve/")} == {"a" * 40}
    assert all(request.status in (200, 206) for request in web.log("/content/"))
    named = RangeImages(f"{HUB}@v1.0", **options, storage_options={"token": TOKEN})
    assert named.path == f"{HUB}@{'b' * 40}"
    assert bits(named) == expected
    other = RangeImages(f"{HUB}@refs%2Fpr%2F1/train-*.tar", **options, storage_options={"token": TOKEN})
    assert other.path == f"{HUB}@{'a' * 40}" and set(other.keys) <= set(images.keys)


@pytest.mark.parametrize(
    ("address", "options", "message"),
    [
        (HUB, {}, "401"),
        (HUB, {"token": "wrong-token"}, "401"),
        (f"{HUB}@absent", {"token": TOKEN}, "404"),
        ("hf://datasets/owner/other", {"token": TOKEN}, "404"),
        ("hf://owner/name", {}, "must be hf://datasets/OWNER/NAME"),
        ("hf://datasets/owner", {}, "must be hf://datasets/OWNER/NAME"),
        (HUB, {"token": TOKEN, "endpoint": "http://127.0.0.1:1"}, f"{HUB}"),
    ],
)
def test_what_the_hub_refuses_is_one_line(
    address: str, options: dict[str, str], message: str, web: WebServer, tmp_path: Path
) -> None:
    pytest.importorskip("huggingface_hub")
    given = {"endpoint": web.url("").rstrip("/"), **options}
    policy = RetryPolicy(tries=2, first_wait_s=0.001)
    with pytest.raises((Unreachable, BadConfig)) as caught:
        RangeImages(address, variant="none", storage_options=given, retry_policy=policy, cache=tmp_path)
    said = str(caught.value)
    assert message in said and "\n" not in said and TOKEN not in said and "wrong-" not in said


def test_a_hub_that_names_no_commit_is_refused(web: WebServer, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("huggingface_hub")
    monkeypatch.setattr(web, "commits", {"main": "../../elsewhere"})
    with pytest.raises(Unreachable, match="must name a commit of 40 digits"):
        RemoteFolder(HUB, {"endpoint": web.url("").rstrip("/"), "token": TOKEN}, QUICK)
