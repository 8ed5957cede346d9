"""Worker threads: the bits, order, state and errors of worker processes, and nothing left when they end."""

from __future__ import annotations

import gc
import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import warm

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BadConfig, BadShard, BodysegError
from bodyseg_data.loading import Loader, WorkerLost
from bodyseg_data.loading import workers as loading_workers
from bodyseg_data.loading.workers import ThreadWorkers

WITHIN_S = 60
"""Time for what happens at once, on a busy machine."""


def worker_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("bodyseg-worker-")]


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    _collect()  # loaders of other files' tests
    assert worker_threads() == []
    yield
    _collect()
    assert worker_threads() == []


def _collect() -> None:
    """Collect garbage if it may hold a loader: a collection takes a quarter of a second in a process of many tests."""
    if worker_threads():
        gc.collect()


def threaded(images: RangeImages, batch_size: int = 3, workers: int = 2, **options: Any) -> Loader:
    return loader(images, batch_size, workers, worker_method="thread", **options)


def bits(batch: Any) -> tuple[list[str], bytes, bytes]:
    return batch["key"], batch["range"].numpy().tobytes(), batch["labels"].numpy().tobytes()


def keys(batches: Loader) -> list[str]:
    return [key for batch in batches for key in batch["key"]]


@pytest.mark.parametrize("variant", ["none", "all"])
@pytest.mark.parametrize("metres", [True, False])
def test_threads_give_the_bits_of_processes_and_of_no_workers(small_set: Path, variant: str, metres: bool) -> None:
    ways: list[tuple[int, Any]] = [(0, "thread"), (2, "process"), (1, "thread"), (2, "thread"), (5, "thread")]
    found = []
    for workers, method in ways:
        batches = loader(RangeImages(small_set, variant, "train"), 3, workers, metres=metres, worker_method=method)
        found.append([bits(batch) for _ in range(3) for batch in batches])
    assert found == found[:1] * len(ways)


@pytest.mark.parametrize(("first", "second"), [("process", "thread"), ("thread", "process")])
def test_a_state_goes_on_with_the_other_kind_of_workers(small_set: Path, first: Any, second: Any) -> None:
    images = RangeImages(small_set, "all", "train")
    batches = loader(images, 3, 2, worker_method=first)
    whole = [bits(batch) for batch in batches]
    images.set_epoch(0)
    delivered = iter(batches)
    begun = [bits(next(delivered)) for _ in range(2)]
    again = loader(RangeImages(small_set, "all", "train"), 3, 2, worker_method=second)
    again.load_state_dict(batches.state_dict())
    assert begun + [bits(batch) for batch in again] == whole


def test_a_bad_sample_is_the_same_line(small_set: Path, tmp_path: Path) -> None:
    damaged = damaged_copy(small_set, tmp_path)
    messages = []
    for workers, method in ((0, "thread"), (2, "process"), (2, "thread")):
        with pytest.raises(BadShard) as caught:
            keys(loader(RangeImages(damaged, "all"), 3, workers, worker_method=method))  # type: ignore[arg-type]
        messages.append(str(caught.value))
    assert messages == messages[:1] * 3
    assert re.fullmatch(
        r"train-00001\.tar: open-\S+: offset \d+: altered: CRC-32 [0-9a-f]{8} expected, found [0-9a-f]{8}", messages[0]
    )


def test_bad_samples_are_skipped_within_the_budget(small_set: Path, tmp_path: Path) -> None:
    damaged = damaged_copy(small_set, tmp_path)
    found = []
    for method in ("process", "thread"):
        batches = loader(
            RangeImages(damaged, "all"),
            3,
            2,
            on_error="skip",
            skip_budget=1,
            worker_method=method,  # type: ignore[arg-type]
        )
        found.append(([bits(batch) for batch in batches], batches.skipped, batches.state_dict()))
    assert found[0] == found[1]
    assert len(found[0][1]) == 1


def damaged_copy(small_set: Path, tmp_path: Path) -> Path:
    """A set with one altered byte in the second shard's third sample."""
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for path in small_set.iterdir():
        (damaged / path.name).write_bytes(path.read_bytes())
    record = RangeImages(small_set).manifest.shards[1]
    with (damaged / record.name).open("r+b") as shard:
        shard.seek(record.offsets[2] + record.lengths[2] // 2)
        before = shard.read(1)
        shard.seek(-1, os.SEEK_CUR)
        shard.write(bytes([before[0] ^ 0xFF]))
    return damaged


class Wordless(Exception):
    def __str__(self) -> str:
        raise AttributeError("no text")


def test_an_error_without_words_is_told_by_its_type(small_set: Path) -> None:
    class Failing(RangeImages):
        def write(self, *where: Any) -> None:
            raise Wordless

    with pytest.raises(WorkerLost, match=r"^worker [01] of 2 \(thread\) failed: Wordless\n"):
        keys(threaded(Failing(small_set)))


def test_a_batch_made_in_vain_that_fails_ends_no_later_pass(small_set: Path) -> None:
    class FailingOnce(RangeImages):
        def write(self, index: int, epoch: int, *where: Any) -> Any:
            if epoch == 0 and index == int(self.order(0)[4]):
                raise OSError("for a moment")
            return super().write(index, epoch, *where)

    for batches in (
        threaded(FailingOnce(small_set)),
        loader(FailingOnce(small_set), 3, 2, worker_method="process", start_method="fork"),
    ):
        next(iter(batches))
        assert batches.epoch == 1
        assert len(keys(batches)) == 24 and batches.epoch == 2
        assert batches.stats()["samples"] >= 27


def test_all_threads_together_are_waited_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading_workers, "END_TIMEOUT_S", 0.5)
    begun, go_on, waits = threading.Barrier(5), threading.Event(), list[float]()
    workers = ThreadWorkers(lambda _: (begun.wait(WITHIN_S), go_on.wait(WITHIN_S)), 4)
    for thread in workers._threads:
        join = thread.join
        monkeypatch.setattr(thread, "join", lambda seconds, join=join: (waits.append(seconds), join(seconds)))
    for request in range(4):
        workers.submit(request)
    begun.wait(WITHIN_S)
    threads = [*workers._threads]
    workers.close()
    go_on.set()
    for thread in threads:
        threading.Thread.join(thread, WITHIN_S)
    assert len(waits) == 4 and 0 < waits[0] <= 0.5 and waits[1:] == [0, 0, 0]


@pytest.mark.parametrize("error", [MemoryError("no more\nof it"), SystemExit("no more of it")])
def test_an_unforeseen_error_is_one_line_with_its_trace_noted(small_set: Path, error: BaseException) -> None:
    class Failing(RangeImages):
        def write(self, *where: Any) -> None:
            raise error

    with pytest.raises(WorkerLost) as caught:
        keys(threaded(Failing(small_set)))
    assert re.fullmatch(
        rf"worker [01] of 2 \(thread\) failed: {type(error).__name__}: no more of it", str(caught.value)
    )
    assert "in write" in caught.value.__notes__[0]


def test_an_error_ends_the_threads_and_the_next_pass_has_new_ones(small_set: Path) -> None:
    class Failing(RangeImages):
        failing = True

        def write(self, index: int, *where: Any) -> None:
            if self.failing and index == 20:
                raise BodysegError("twenty")
            super().write(index, *where)

    images = Failing(small_set)
    batches = threaded(images)
    for _ in range(3):
        with pytest.raises(BodysegError, match="^twenty$"):
            keys(batches)
        assert worker_threads() == []
    images.failing = False
    assert len(keys(batches)) == 24
    assert len(worker_threads()) == 2


def test_a_pass_may_be_left_and_another_begun(small_set: Path) -> None:
    images = RangeImages(small_set, "all")
    batches = threaded(images)
    whole = [bits(batch) for batch in batches]
    before = worker_threads()
    for _ in range(3):
        images.set_epoch(0)
        next(iter(batches))
    images.set_epoch(0)
    assert [bits(batch) for batch in batches] == whole
    assert worker_threads() == before, "the same threads go on"


@pytest.mark.parametrize("held", ["nothing", "a batch", "an unfinished pass"])
def test_a_loader_that_is_dropped_ends_its_threads_at_once(small_set: Path, held: str) -> None:
    gc.disable()  # none of this waits for the garbage collector
    try:
        batches: Any = threaded(RangeImages(small_set))
        delivered: Any = iter(batches)
        batch: Any = next(delivered)
        if held != "a batch":
            batch = None
        if held != "an unfinished pass":
            delivered = None
        del batches
        assert len(worker_threads()) == (2 if held == "an unfinished pass" else 0)
        del delivered
        assert worker_threads() == []
        assert batch is None or batch["range"].max() > 1
    finally:
        gc.enable()


def test_epochs_leave_nothing_behind(small_set: Path) -> None:
    def open_files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    gc.collect()  # files of other tests
    images = RangeImages(small_set, "all")
    before = open_files()
    batches: Any = threaded(images)
    for epoch in range(9):
        for number, _ in enumerate(batches):
            if epoch % 3 == 2 and number == 4:
                break
        assert len(worker_threads()) == 2
    del _, batches
    gc.collect()
    assert worker_threads() == []
    assert open_files() == before


def test_an_interrupt_is_passed_on_and_ends_the_threads(small_set: Path) -> None:
    begun = threading.Event()

    class Slow(RangeImages):
        slow = True

        def write(self, *where: Any) -> None:
            if self.slow:
                begun.set()
                time.sleep(0.5)
            super().write(*where)

    images = Slow(small_set)
    batches = threaded(images, batch_size=2)

    def interrupt() -> None:
        assert begun.wait(WITHIN_S)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    other = threading.Thread(target=interrupt)
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            keys(batches)
    finally:
        other.join()
        signal.signal(signal.SIGINT, before)
    assert worker_threads() == []
    images.slow = False
    assert len(keys(batches)) == 24


def test_a_fork_has_threads_of_its_own(small_set: Path) -> None:
    batches = threaded(RangeImages(small_set, "all"))
    delivered = iter(batches)
    first = bits(next(delivered))

    def elsewhere() -> None:
        try:
            next(delivered)
        except BadConfig as error:
            refused = str(error).startswith("a pass goes on in the process that began it")
        os._exit(0 if refused and len(keys(batches)) == 24 and len(worker_threads()) == 2 else 1)

    child = multiprocessing.get_context("fork").Process(target=elsewhere)
    child.start()
    child.join(WITHIN_S)
    assert child.exitcode == 0
    assert len(first[0]) + sum(len(batch["key"]) for batch in delivered) == 24


def test_a_daemonic_process_may_have_threads(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # type: ignore[attr-defined]
    assert len(keys(threaded(RangeImages(small_set)))) == 24


def test_threads_that_cannot_start(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = threading.Thread.start

    def limited(thread: threading.Thread) -> None:
        if thread.name == "bodyseg-worker-1":
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", limited)
    with pytest.raises(
        WorkerLost, match="^worker 1 of 2 could not be started: can't start new thread; use fewer workers$"
    ):
        keys(threaded(RangeImages(small_set)))


def test_workers_may_be_closed_by_one_of_their_threads() -> None:
    """As by the garbage collector, which runs in any thread."""
    workers: list[ThreadWorkers] = []

    def close(request: int) -> int:
        workers.pop().close()
        return request

    workers.append(ThreadWorkers(close, 2))
    workers[0].submit(7)
    end = time.monotonic() + WITHIN_S
    while worker_threads():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_closing_begins_no_further_request() -> None:
    begun: list[int] = []
    go_on = threading.Event()

    def work(request: int) -> None:
        begun.append(request)
        go_on.wait(WITHIN_S)

    workers = ThreadWorkers(work, 1)
    for request in range(5):
        workers.submit(request)
    while not begun:
        time.sleep(0.001)
    threading.Timer(0.1, go_on.set).start()
    workers.close()
    assert begun == [0]
    workers.close()


ENDLESS = """
import sys, threading
from bodyseg_data import RangeImages, loader
two = [loader(RangeImages(sys.argv[1], "none"), 3, 2, worker_method="thread") for _ in range(2)]
passes = [iter(batches) for batches in two]
said = False
while True:
    for number, batches in enumerate(two):
        try:
            next(passes[number])
        except StopIteration:
            passes[number] = iter(batches)
    if not said:
        print(threading.active_count(), flush=True)
        said = True
    if sys.argv[2:] == ["fail"]:
        raise ZeroDivisionError("the user's own")
"""


def test_an_interrupt_ends_the_run(small_set: Path) -> None:
    with warm.Program(["-c", ENDLESS, str(small_set)], strict=True) as run:
        assert run.stdout.readline() == "5\n"
        run.send_signal(signal.SIGINT)
        _, errors = run.communicate(timeout=WITHIN_S)
    assert run.returncode == -signal.SIGINT
    # One thread speaks; where the signal met it in an `except`, in two tracebacks.
    assert errors.splitlines().count("KeyboardInterrupt") == 1, errors


def test_a_run_that_fails_in_the_middle_of_a_pass_ends_cleanly(small_set: Path) -> None:
    done = warm.run(["-c", ENDLESS, str(small_set), "fail"], strict=True)
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    assert "bodyseg-worker" not in done.stderr


def test_pytorch_keeps_its_number_of_threads(small_set: Path) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        for _ in threaded(RangeImages(small_set, "all")):
            assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
