"""Reading ahead from a server, by shards and by ranges; the order by blocks; what a loader says of its time."""

from __future__ import annotations

import itertools
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from replies import Reply
from servers import WebServer, web_server

from bodyseg_data import Mixture, RangeImages, loader
from bodyseg_data.core import BadConfig, BadShard
from bodyseg_data.loading import WorkerLost
from bodyseg_data.loading.selection import BLOCK_SAMPLES, BlockOrder
from bodyseg_data.shards import LookAhead, RetryPolicy, Unreachable, ahead, read_manifest

QUICK = RetryPolicy(tries=12, first_wait_s=0.001)
WAYS: list[tuple[int, Any]] = [(0, "thread"), (2, "thread"), (2, "process")]

Bits = list[tuple[str, bytes]]


@pytest.fixture(scope="module")
def server(figures_set: Path) -> Iterator[WebServer]:
    pytest.importorskip("aiohttp")
    with web_server(figures_set) as running:
        yield running


@pytest.fixture
def web(server: WebServer) -> WebServer:
    server.forget()
    return server


@pytest.fixture(autouse=True)
def nothing_is_left() -> Iterator[None]:
    yield
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("bodyseg-ahead")]


def bits(batches: Any) -> Bits:
    return [
        (key, each.numpy().tobytes())
        for batch in batches
        for key, each in zip(batch["key"], batch["range"], strict=True)
    ]


def expected(figures_set: Path, shuffle: Any) -> Bits:
    return bits(loader(RangeImages(figures_set, "noise"), 4, shuffle=shuffle))


def order_of(count: int, epoch: int = 0) -> list[int]:
    return BlockOrder(count, 5, epoch)[:].tolist()


@pytest.mark.parametrize("count", [1, 31, 32, 33, 200, 5000])
def test_an_order_by_blocks_is_a_permutation_whatever_is_read_of_it(count: int) -> None:
    whole = order_of(count)
    assert sorted(whole) == list(range(count))
    assert whole == order_of(count) and (count == 1 or whole != order_of(count, 1))
    order = BlockOrder(count, 5, 0)
    for first in (count - 1, 0, count // 2):
        assert order[first : first + 70].tolist() == whole[first : first + 70]


def test_batches_by_blocks_come_from_few_places_and_then_from_many() -> None:
    whole = np.array(order_of(5000)) // BLOCK_SAMPLES
    assert len(set(whole[: 4 * BLOCK_SAMPLES - 8])) == 4
    assert len(set(whole[2000:2020])) > 12
    assert list(order_of(70)) != list(itertools.chain(range(32, 64), range(32), range(64, 70)))


def test_blocks_do_not_depend_on_the_cut_into_shards(figures_set: Path, small_set: Path) -> None:
    orders = [RangeImages(path, split="train").order(3, "blocks").tolist() for path in (figures_set, small_set)]
    assert orders[0] == orders[1] == BlockOrder(16, 0, 3)[:].tolist()


def test_ranks_share_an_order_by_blocks_and_go_on_in_the_middle_of_it(figures_set: Path) -> None:
    images = RangeImages(figures_set, "none")
    whole = [key for key, _ in bits(loader(images, 4, shuffle="blocks"))]
    ranks = [
        [key for key, _ in bits(loader(images, 2, shuffle="blocks", rank=rank, world_size=2))] for rank in range(2)
    ]
    assert sorted(ranks[0] + ranks[1]) == sorted(whole)
    assert ranks[0][:2] + ranks[1][:2] == whole[:4]
    first = loader(images, 4, shuffle="blocks")
    taken = next(iter(first))["key"]
    second = loader(images, 8, shuffle="blocks")
    second.load_state_dict(first.state_dict())
    assert taken + [key for key, _ in bits(second)] == whole
    with pytest.raises(BadConfig, match="the state belongs to another run: shuffle 'blocks', here True"):
        loader(images, 4, shuffle=True).load_state_dict(first.state_dict())
    with pytest.raises(BadConfig, match="shuffle must be True, False or 'blocks', found 'block'"):
        loader(images, 4, shuffle="block")  # type: ignore[arg-type]  # on purpose


def test_a_mixture_leaves_each_set_in_its_order_by_blocks(figures_set: Path, small_set: Path) -> None:
    sets = [RangeImages(path, "none", seed=seed) for seed, path in enumerate((figures_set, small_set))]
    mixture = Mixture([(sets[0], 2), (sets[1], 1)], samples=30)
    found = mixture.requests(4, "blocks").indices
    sides = [found[found < 24], found[found >= 24] - 24]
    assert [len(side) for side in sides] == mixture.counts(4) == [20, 10]
    streams = [[*images.order(3, "blocks"), *images.order(4, "blocks")] for images in sets]
    assert sides[1].tolist() == [*sets[1].order(1, "blocks"), *sets[1].order(2, "blocks")][16:26]
    assert len(streams[0]) == 48
    weighted = Mixture([(sets[0], 1, np.arange(24))])
    assert len(weighted.requests(0, "blocks").indices) == 24


@pytest.mark.parametrize("shuffle", [True, False, "blocks"])
@pytest.mark.parametrize(("workers", "method"), WAYS)
def test_shards_are_fetched_once_in_the_order_of_need(
    shuffle: Any, workers: int, method: Any, web: WebServer, figures_set: Path, tmp_path: Path
) -> None:
    images = RangeImages(web.url("good"), "noise", cache=tmp_path, retry_policy=QUICK)
    batches = loader(images, 4, workers, shuffle, worker_method=method)
    assert bits(batches) == expected(figures_set, shuffle)
    manifest = read_manifest(figures_set)
    assert sorted(line.sent for line in web.log(".tar")) == sorted(shard.size for shard in manifest.shards)
    stats = batches.stats()
    assert stats["bytes"] == sum(shard.size for shard in manifest.shards)
    assert stats["requests"] == len(manifest.shards)
    assert [stats[name] for name in ("samples", "batches", "ready", "in_flight")] == [24, 6, 0, 0]
    assert stats["hits"] + stats["stalls"] == 24
    web.forget()
    assert len(bits(batches)) == 24, "a second epoch"
    assert not web.log(".tar")


@pytest.mark.parametrize(("workers", "method"), WAYS)
def test_without_a_cache_neighbours_are_read_together(
    workers: int, method: Any, web: WebServer, figures_set: Path
) -> None:
    batches = loader(RangeImages(web.url("good"), "noise", cache_bytes=0), 4, workers, "blocks", worker_method=method)
    assert bits(batches) == expected(figures_set, "blocks")
    lengths = sum(sum(shard.lengths) for shard in read_manifest(figures_set).shards)
    served = web.log(".tar")
    if method == "thread":
        assert sum(line.sent for line in served) == lengths, "each byte once"
        assert len(served) == len(read_manifest(figures_set).shards)
        assert batches.images.sets[0].reader.store.pieces.size == 0, "all memory is given back"
    else:
        assert len(served) == 24, "processes read their own"


def test_beyond_the_cache_ranges_are_read_ahead(web: WebServer, figures_set: Path, tmp_path: Path) -> None:
    manifest = read_manifest(figures_set)
    limit = sum(shard.size for shard in manifest.shards[:2])
    images = RangeImages(web.url("good"), "noise", cache=tmp_path, cache_bytes=limit)
    batches = loader(images, 4, 2, "blocks")
    for _ in range(2):
        assert len(bits(batches)) == 24
    lengths = [length for shard in manifest.shards[2:] for length in shard.lengths]
    sent = sum(line.sent for line in web.log(".tar")) - limit - 2 * sum(lengths)
    assert 0 <= sent <= 2 * max(lengths)  # a pass's first sample may be due before it is planned: it comes twice then
    assert sum(path.stat().st_size for path in tmp_path.glob("*.tar")) == limit


@pytest.mark.parametrize("kept", [True, False])
def test_a_server_that_fails_now_and_then_does_not_show(
    kept: bool, web: WebServer, figures_set: Path, tmp_path: Path
) -> None:
    options: dict[str, Any] = {"cache": tmp_path} if kept else {"cache_bytes": 0}
    images = RangeImages(web.url("failing"), "noise", retry_policy=QUICK, **options)
    assert bits(loader(images, 4, 2, "blocks")) == expected(figures_set, "blocks")
    assert {line.status for line in web.log(".tar")} == {206, 500}


@pytest.mark.parametrize("kept", [True, False])
def test_an_error_shows_where_the_sample_is_due(kept: bool, web: WebServer, figures_set: Path, tmp_path: Path) -> None:
    shards = read_manifest(figures_set).shards
    options: dict[str, Any] = {"cache": tmp_path} if kept else {"cache_bytes": 0}
    images = RangeImages(web.url("faulty"), "noise", retry_policy=QUICK, **options)
    first = shards[-1].keys[0].encode()
    web.faults.act = lambda reply, before: replace(reply, status=404) if reply.body.startswith(first) else reply
    found = []
    with pytest.raises(Unreachable, match=rf"faulty/{shards[-1].name}: 404 Not Found$"):
        for batch in loader(images, 1, 2, False):
            found += batch["key"]
    assert len(found) == 24 - len(shards[-1])


def test_a_shard_whose_bytes_are_wrong_costs_its_bad_sample_alone(
    web: WebServer, figures_set: Path, tmp_path: Path
) -> None:
    shard = read_manifest(figures_set).shards[1]

    def spoil(reply: Reply, before: int) -> Reply:
        body = bytearray(reply.body)
        place = body.find(shard.keys[1].encode())
        if place >= 0:
            body[place + 600] ^= 1
        return replace(reply, body=bytes(body))

    web.faults.act = spoil
    images = RangeImages(web.url("faulty"), "noise", cache=tmp_path, retry_policy=QUICK)
    batches = loader(images, 4, 2, False, on_error="skip", skip_budget=len(shard))
    with pytest.warns(RuntimeWarning, match="altered.*not kept"):
        keys = [key for key, _ in bits(batches)]
    assert shard.keys[1] in [each.key for each in batches.skipped]
    assert batches.stats()["hits"] + batches.stats()["stalls"] == 24, "what is read by range in the end counts once"
    assert set(images.keys) - set(keys) == {each.key for each in batches.skipped}
    with pytest.raises(BadShard, match=f"{shard.keys[1]}: offset {shard.offsets[1]}: altered: CRC-32"):
        images.clean(images.keys.index(shard.keys[1]))


def test_two_loaders_of_one_set_and_an_early_end(web: WebServer, figures_set: Path, tmp_path: Path) -> None:
    for options in ({"cache": tmp_path}, {"cache_bytes": 0}):
        images = RangeImages(web.url("good"), "noise", **options)  # type: ignore[arg-type]
        one, two = loader(images, 4, 2, True), loader(images, 4, 2, "blocks")
        left = iter(loader(images, 4, 2))
        next(left)
        both = [[], []]  # type: list[list[Any]]
        for pair in zip(one, two, strict=True):
            for side, batch in zip(both, pair, strict=True):
                side += bits([batch])
        left.close()  # type: ignore[attr-defined]
        assert both == [expected(figures_set, True), expected(figures_set, "blocks")]
        for _ in one:
            break
        assert len(bits(one)) == 24, "the next pass"


def test_a_loop_that_is_left_ends_its_downloads(web: WebServer, tmp_path: Path) -> None:
    images = RangeImages(web.url("faulty"), "noise", cache=tmp_path)
    manifest, sample = images.manifest, images.manifest.shards[0].lengths[0]
    web.faults.act = lambda reply, before: replace(reply, step=sample, step_s=0.3)
    batches = loader(images, 1, 2, False)
    for _ in batches:
        break
    whole = {f"{shard.sha256}.tar": shard.size for shard in manifest.shards}
    assert all(path.stat().st_size == whole[path.name] for path in tmp_path.glob("*.tar"))
    assert len(list(tmp_path.glob("*.tar"))) < len(whole)
    assert list(tmp_path.glob("*.part")), "samples are read before their shard is whole"


def test_a_pass_that_a_program_leaves_open_ends_without_a_word(
    web: WebServer, figures_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_exit: list[Any] = []
    monkeypatch.setattr(ahead, "atexit", SimpleNamespace(register=at_exit.append, unregister=at_exit.remove))
    sets = RangeImages(figures_set, "noise"), RangeImages(web.url("good"), "noise", cache_bytes=0)
    passes = [iter(loader(images, 4)) for images in sets]
    for each in passes:
        next(each)
    at_exit[0]()
    assert not at_exit
    for module in ("atexit", "os", "time"):  # as Python leaves them when objects that live so long end
        monkeypatch.setattr(ahead, module, None)
    for each in passes:
        each.close()  # type: ignore[attr-defined]


def test_a_worker_that_is_killed_while_shards_come(web: WebServer, tmp_path: Path) -> None:
    batches = loader(RangeImages(web.url("slow"), "noise", cache=tmp_path), 1, 2, False, worker_method="process")
    with pytest.raises(WorkerLost, match="was ended by signal 9"):
        for _ in batches:
            os.kill(batches._state.workers._processes[1].pid, signal.SIGKILL)  # type: ignore[union-attr]
    assert len(bits(batches)) == 24


def test_an_unforeseen_error_leaves_nobody_waiting(web: WebServer, figures_set: Path) -> None:
    images = RangeImages(web.url("good"), "noise", cache_bytes=0)

    def places() -> Iterator[Any]:
        yield from images.places(0)
        raise BadShard("an index that cannot be read")

    ahead = LookAhead(places())
    ahead.start([images.reader.store])
    try:
        assert images.clean(0).key == images.keys[0]
    finally:
        ahead.close()
    assert images.reader.store.pieces.size == 0  # type: ignore[union-attr]


def test_a_range_that_cannot_be_fetched_at_first_does_not_end_the_look_ahead(web: WebServer, figures_set: Path) -> None:
    images = RangeImages(web.url("faulty"), "noise", cache_bytes=0, retry_policy=replace(QUICK, tries=2))
    first, late, *others = images.manifest.shards
    left = [503, 503]

    def fail_twice(reply: Reply, before: int) -> Reply:
        return replace(reply, status=left.pop()) if reply.body.startswith(late.keys[0].encode()) and left else reply

    web.faults.act = fail_twice
    batches = loader(images, 1, 1, False)
    assert bits(batches) == expected(figures_set, False)
    assert not left
    assert batches.stats()["requests"] <= len(first) + 2 + len(late) + len(others), "others are fetched once, as ever"


def test_a_sample_whose_look_ahead_is_given_up_counts_once(
    web: WebServer, figures_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = threading.Event()

    def give_up(self: LookAhead, one: Any) -> None:
        assert waiting.wait(10)
        raise BadShard("a range that does not come")

    plain = Future.result

    def told(piece: Any, timeout: float | None = None) -> Any:
        waiting.set()
        return plain(piece, timeout)

    monkeypatch.setattr(LookAhead, "_read", give_up)
    monkeypatch.setattr(Future, "result", told)
    batches = loader(RangeImages(web.url("good"), "noise", cache_bytes=0), 4, 2)
    assert len(bits(batches)) == 24
    stats = batches.stats()
    assert (stats["hits"], stats["stalls"], stats["requests"]) == (0, 24, 24)


def test_a_loader_says_where_its_time_goes(figures_set: Path) -> None:
    def slow(image: Any, random: Any) -> Any:
        time.sleep(0.002)
        return image

    batches = loader(RangeImages(figures_set, "all", transform=slow), 4, 2)
    assert set(batches.stats().values()) == {0}
    first = next(iter(batches))
    assert len(first["key"]) == 4 and batches.stats()["in_flight"] > 0
    bits(batches)
    stats = batches.stats()
    assert stats["samples"] >= 24 and stats["transform"] >= 24 * 0.002
    assert min(stats[name] for name in ("store", "decode", "artifacts", "deliver", "waited")) > 0
    assert {stats[name] for name in ("fetch", "bytes", "requests", "hits", "stalls", "ready", "in_flight")} == {0}
    rows = len(batches._tallied)
    bits(batches)
    assert batches.stats()["samples"] == stats["samples"] + 24
    assert len(batches._tallied) == rows, "rows of earlier passes are summed up, or every pass would take longer"
