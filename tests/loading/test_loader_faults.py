"""What a loader leaves behind, and what it says, when something ends it early."""

from __future__ import annotations

import gc
import multiprocessing
import os
import re
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import warm

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BodysegError
from bodyseg_data.loading import Loader, WorkerLost
from bodyseg_data.loading.workers import ProcessWorkers

EPOCHS = int(os.environ.get("BODYSEG_LEAK_EPOCHS", "3"))

WITHIN_S = 60
"""How long what should happen at once may take on a busy machine."""


def worker_ids(batches: Loader) -> list[int]:
    assert batches._state is not None
    return [process.pid for process in batches._state.workers._processes]  # type: ignore[union-attr]  # not InlineWorkers


def alive(process: int) -> bool:
    """Whether it runs; one that has ended and that nobody has asked about does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def await_end(processes: list[int]) -> None:
    end = time.monotonic() + WITHIN_S
    while any(map(alive, processes)):
        assert time.monotonic() < end, f"still there: {[process for process in processes if alive(process)]}"
        time.sleep(0.02)


def with_processes(images: RangeImages, workers: int = 2) -> Loader:
    """A loader whose workers are forked: images of a test's own class cannot be pickled."""
    return loader(images, 3, workers, worker_method="process", start_method="fork")


def keys(batches: Loader) -> list[str]:
    return [key for batch in batches for key in batch["key"]]


@pytest.mark.parametrize(("number", "victim"), [(signal.SIGKILL, 0), (signal.SIGTERM, 1)])
def test_a_worker_that_is_killed_is_one_line_and_no_hang(small_set: Path, number: int, victim: int) -> None:
    batches = with_processes(RangeImages(small_set))
    delivered = iter(batches)
    next(delivered)
    processes = worker_ids(batches)
    os.kill(processes[victim], number)
    await_end([processes[victim]])
    with pytest.raises(WorkerLost) as caught:
        list(delivered)
    message = str(caught.value)
    assert message.startswith(f"worker {victim} of 2 (process {processes[victim]}) was ended by signal {number} (")
    assert "\n" not in message
    await_end(processes)
    assert len(keys(batches)) == 24, "the next pass has workers again"


def test_a_worker_that_ends_itself_is_named_too(small_set: Path) -> None:
    class Leaving(RangeImages):
        def write(self, *where: Any) -> None:
            os._exit(3)

    with pytest.raises(
        WorkerLost, match=r"worker 0 of 1 \(process \d+\) ended with status 3 before its batch was made"
    ):
        list(with_processes(Leaving(small_set), 1))


def test_an_unforeseen_error_in_a_worker_is_one_line_with_its_trace_noted(small_set: Path) -> None:
    class Failing(RangeImages):
        def write(self, *where: Any) -> None:
            raise MemoryError("no more\nof it")

    with pytest.raises(WorkerLost) as caught:
        list(with_processes(Failing(small_set)))
    assert re.fullmatch(r"worker 0 of 2 \(process \d+\) failed: MemoryError: no more of it", str(caught.value))
    assert "in write" in caught.value.__notes__[0]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_pass_may_be_left_and_another_begun(small_set: Path, workers: int) -> None:
    images = RangeImages(small_set, "all")
    batches = with_processes(images, workers)
    whole = [[batch["range"].sum().item() for batch in batches] for _ in range(3)]
    images.set_epoch(0)
    before: list[int] = []
    for _ in batches:
        before = worker_ids(batches) if workers else []
        break
    with pytest.raises(ZeroDivisionError):
        for _ in batches:
            1 / 0  # noqa: B018  # the user's own error
    assert [batch["range"].sum().item() for batch in batches] == whole[2]
    assert not workers or worker_ids(batches) == before, "the same workers go on"


def test_an_interrupt_is_passed_on_and_ends_the_workers(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batches = with_processes(RangeImages(small_set))
    delivered = iter(batches)
    next(delivered)
    assert batches._state is not None
    processes = worker_ids(batches)

    def interrupted() -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(batches._state.workers, "result", interrupted)
        list(delivered)
    await_end(processes)
    assert len(keys(batches)) == 24


def test_an_interrupt_while_workers_end_leaves_no_half_ended_ones(
    small_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = with_processes(RangeImages(small_set))
    delivered = iter(batches)
    next(delivered)
    assert batches._state is not None
    workers: Any = batches._state.workers

    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(workers, "result", interrupted)
        patch.setattr(workers._processes[0], "join", interrupted)
        list(delivered)
    assert len(keys(batches)) == 24, "the next pass has workers of its own"
    workers.close()


def test_a_pass_left_early_makes_no_batch_in_vain(small_set: Path) -> None:
    made = []

    class Counting(RangeImages):
        def write(self, index: int, *where: Any) -> None:
            made.append(index)

    batches = loader(Counting(small_set), 8)
    for _ in range(3):
        next(iter(batches))
    assert len(made) == 24


@pytest.mark.parametrize("held", ["nothing", "a batch", "an unfinished pass"])
def test_a_loader_that_is_dropped_ends_its_workers_at_once(small_set: Path, held: str) -> None:
    gc.disable()  # none of this waits for the garbage collector
    try:
        batches: Any = with_processes(RangeImages(small_set))
        delivered: Any = iter(batches)
        batch: Any = next(delivered)
        processes = worker_ids(batches)
        if held != "a batch":
            batch = None
        if held != "an unfinished pass":
            delivered = None
        del batches
        if held == "an unfinished pass":
            assert all(map(alive, processes))
            del delivered
        await_end(processes)
        assert batch is None or batch["range"].max() > 1
    finally:
        gc.enable()


def test_workers_end_when_told_to_whoever_else_has_their_pipes(
    small_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(process: Any) -> None:
        raise AssertionError("had to be killed")

    monkeypatch.setattr(multiprocessing.process.BaseProcess, "kill", kill)
    pair = [with_processes(RangeImages(small_set)) for _ in range(2)]
    for batches in pair:  # the second one's workers are forks that have the first one's pipes
        next(iter(batches))
    processes = worker_ids(pair[0])
    del batches, pair[0]
    await_end(processes)
    assert len(keys(pair[0])) == 24


def test_requests_and_answers_larger_than_a_pipe_pass_each_other() -> None:
    """As in large batches of which much is skipped."""
    workers, found = ProcessWorkers(lambda data: 2 * data, 1, "fork"), list[int]()

    def exchange() -> None:
        for _ in range(3):
            workers.submit(bytes(1 << 20))
        found.extend(len(workers.result()) for _ in range(3))

    thread = threading.Thread(target=exchange, daemon=True)
    thread.start()
    thread.join(WITHIN_S)
    workers._processes[0].kill()  # else a worker that hangs would end neither
    thread.join()
    workers.close()
    assert found == [1 << 21] * 3


def test_a_fork_of_the_process_has_workers_of_its_own(small_set: Path) -> None:
    batches = with_processes(RangeImages(small_set), 1)
    delivered = iter(batches)
    first = next(delivered)
    processes = worker_ids(batches)

    def elsewhere() -> None:
        os._exit(0 if len(keys(batches)) == 24 and worker_ids(batches) != processes else 1)

    child = multiprocessing.get_context("fork").Process(target=elsewhere)
    child.start()
    child.join(WITHIN_S)
    assert child.exitcode == 0
    assert len(first["key"]) + sum(len(batch["key"]) for batch in delivered) == 24
    assert worker_ids(batches) == processes


def own_kilobytes(process: int | str) -> int:
    """Memory of a process, less what it shares."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(status.partition("RssAnon:")[2].split()[0])


def resources() -> dict[str, int]:
    gc.collect()
    return {
        "handles": len(list(Path("/proc/self/fd").iterdir())),
        "threads": threading.active_count(),
        "children": len(multiprocessing.active_children()),
    }


def settled(expected: dict[str, int]) -> dict[str, int]:
    """`resources`, once they are as expected or after a while: batches made ahead come when their workers run."""
    end = time.monotonic() + WITHIN_S
    while (found := resources()) != expected and time.monotonic() < end:
        time.sleep(0.05)
    return found


@pytest.mark.parametrize("workers", [0, 2])
def test_epochs_leave_nothing_behind(figures_set: Path, workers: int) -> None:
    keys(with_processes(RangeImages(figures_set, "all"), 0))  # opens what a program opens once
    batches = with_processes(RangeImages(figures_set, "all"), workers)
    before = resources()
    seen = []
    sizes = []
    for epoch in range(3 + EPOCHS):
        for number, _ in enumerate(batches):
            if epoch % 3 == 2 and number == 4:
                break
        seen.append(settled(seen[0]) if seen else resources())
        sizes.append(max(own_kilobytes(process) for process in ["self", *(worker_ids(batches) if workers else [])]))
    assert seen == seen[:1] * len(seen)
    assert max(sizes) - sizes[2] < 8000
    del _, batches
    assert settled(before) == before


def test_errors_leave_nothing_behind(small_set: Path) -> None:
    class Failing(RangeImages):
        def write(self, index: int, *where: Any) -> None:
            if index == 20:
                raise BodysegError("twenty")
            super().write(index, *where)

    batches = with_processes(Failing(small_set))
    before = resources()
    for _ in range(3):
        with pytest.raises(BodysegError, match="^twenty$"):
            keys(batches)
    assert resources() == before


ENDLESS = """
import multiprocessing, sys
from bodyseg_data import RangeImages, loader
two = [loader(RangeImages(sys.argv[1], "none"), 3, 2, worker_method="process", start_method="fork") for _ in range(2)]
passes = [iter(batches) for batches in two]
while True:
    for number, batches in enumerate(two):
        if next(passes[number], None) is None:
            passes[number] = iter(batches)
    if len(passes) == 2:
        passes.append(None)
        workers = [process.pid for process in multiprocessing.active_children()]
        print(*workers, flush=True)
    if sys.argv[2:] == ["leave"]:
        sys.exit(0)
"""


def check_memory(*processes: int) -> None:
    """Batches lie in memory that has no name, so none could stay."""
    for process in processes:
        mapped = Path(f"/proc/{process}/maps").read_text()
        assert "/memfd:bodyseg-batches (deleted)" in mapped
        assert "/dev/shm/" not in mapped


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_signal_to_the_run_leaves_nothing_behind(small_set: Path, number: int) -> None:
    with warm.Program(["-c", ENDLESS, str(small_set)], start_new_session=True) as run:
        workers = [int(word) for word in run.stdout.readline().split()]
        assert len(workers) == 4
        check_memory(run.pid, *workers)
        if number == signal.SIGINT:  # as from a terminal: to everyone
            os.killpg(run.pid, number)
        else:
            run.send_signal(number)
        _, errors = run.communicate(timeout=WITHIN_S)
    assert run.returncode == -number
    await_end(workers)
    if number == signal.SIGINT:
        # One process speaks; where the signal met it in an `except`, in two tracebacks.
        assert errors.splitlines().count("KeyboardInterrupt") == 1 and errors.endswith("KeyboardInterrupt\n"), errors
    else:
        assert errors == ""


BUSY = """
import multiprocessing, os, sys, time
from bodyseg_data.loading import workers
workers.END_TIMEOUT_S = 0.5
held = workers.ProcessWorkers(lambda _: time.sleep(600), 2, "fork")
held.submit(0)
time.sleep(0.2)
print(*[process.pid for process in multiprocessing.active_children()], flush=True)
os.kill(os.getpid(), 9)
"""


def test_workers_in_a_long_request_end_with_a_run_that_is_killed() -> None:
    with warm.Program(["-c", BUSY], start_new_session=True) as run:
        workers = [int(word) for word in run.stdout.readline().split()]
        assert len(workers) == 2
        run.communicate(timeout=WITHIN_S)
    await_end(workers)


def test_ctrl_c_does_not_reach_workers_of_a_fork_server(small_set: Path) -> None:
    batches = loader(RangeImages(small_set, "none"), 3, 2, worker_method="process", start_method="forkserver")
    delivered = iter(batches)
    next(delivered)
    workers = worker_ids(batches)
    check_memory(os.getpid(), *workers)
    for process in workers:
        os.kill(process, signal.SIGINT)
    assert len(list(delivered)) == 7
    del batches, delivered
    await_end(workers)


def test_a_run_that_ends_in_the_middle_of_a_pass_ends_cleanly(small_set: Path) -> None:
    done = warm.run(["-c", ENDLESS, str(small_set), "leave"], strict=True)
    assert (done.returncode, done.stderr) == (0, "")
    await_end([int(word) for word in done.stdout.split()])
