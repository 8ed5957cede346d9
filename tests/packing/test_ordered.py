from __future__ import annotations

import contextlib
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest

from bodyseg_data.packing.jobs import ordered


def test_results_wait_for_the_reader_instead_of_filling_memory() -> None:
    started: list[int] = []

    def job(number: int) -> int:
        started.append(number)
        time.sleep(0.01 * (number % 3))
        return number

    with ThreadPoolExecutor(2) as executor:
        results = ordered((partial(executor.submit, job, number) for number in range(50)), 2)
        assert next(results) == 0
        assert started == [0], "the first job goes alone"
        assert next(results) == 1
        time.sleep(0.2)
        assert len(started) <= 7
        assert list(results) == list(range(2, 50))


def test_jobs_that_have_not_begun_are_cancelled_when_the_results_are_closed() -> None:
    started: list[int] = []
    free = threading.Event()

    def job(number: int) -> None:
        started.append(number)
        if number == 2:
            free.wait(30)
        if number == 1:
            raise ValueError("job 1")

    with ThreadPoolExecutor(1) as executor:
        with contextlib.closing(ordered((partial(executor.submit, job, n) for n in range(9)), 2)) as results:
            next(results)
            with pytest.raises(ValueError, match="job 1"):
                next(results)
        free.set()
    assert max(started) <= 2
