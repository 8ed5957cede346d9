"""Peak memory of an executor's workers."""

from __future__ import annotations

import os
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from threading import Event

import pytest
from jobs import take

from bodyseg_data.core import BadMesh
from bodyseg_data.packing import MeasuringExecutor


def fail() -> None:
    raise BadMesh("a body")


def test_every_worker_is_measured() -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as processes:
        executor = MeasuringExecutor(processes)
        small = executor.submit(take, 1).result()
        (first,) = executor.workers_mb.values()
        assert executor.submit(take, 400_000_000).result() == small != os.getpid()
        ((worker, last),) = executor.workers_mb.items()
    assert worker.endswith(f":{small}")
    assert first is not None and last is not None and first < 400 < last


def test_errors_and_keywords_pass_through() -> None:
    with ThreadPoolExecutor(1) as thread:
        executor = MeasuringExecutor(thread)
        with pytest.raises(BadMesh, match="^a body$"):
            executor.submit(fail).result()
        assert not executor.workers_mb
        assert executor.submit(take, count=3).result() == os.getpid()


def test_a_job_that_is_dropped_is_cancelled() -> None:
    hold = Event()
    with ThreadPoolExecutor(1) as thread:
        executor = MeasuringExecutor(thread)
        running: Future[bool] = executor.submit(hold.wait, 10)
        dropped = executor.submit(take, 1)
        thread.shutdown(wait=False, cancel_futures=True)
        hold.set()
        assert running.result() is True
        with pytest.raises(CancelledError):
            dropped.result(5)
