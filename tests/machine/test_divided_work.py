"""Loops divided among threads."""

from __future__ import annotations

import multiprocessing
import threading

import pytest

from bodyseg_data.machine import of_each, pieces


@pytest.mark.parametrize(("count", "parts"), [(0, 1), (1, 3), (10, 3), (7, 7)])
def test_pieces_cover_everything_once(count: int, parts: int) -> None:
    found = pieces(count, parts)
    assert len(found) == parts
    assert [n for first, last in found for n in range(first, last)] == list(range(count))
    assert max(last - first for first, last in found) - min(last - first for first, last in found) <= 1


def _sum(found: multiprocessing.SimpleQueue[int]) -> None:
    found.put(sum(of_each(lambda run: sum(range(*run)), pieces(100, 2), 2)))


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own() -> None:
    context = multiprocessing.get_context("fork")
    found: multiprocessing.SimpleQueue[int] = context.SimpleQueue()
    _sum(found)
    assert found.get() == 4950
    child = context.Process(target=_sum, args=(found,))
    child.start()
    child.join(20)
    assert child.exitcode == 0 and found.get() == 4950


@pytest.mark.parametrize("threads", [1, 2, 9])
def test_results_are_in_the_order_of_the_items(threads: int) -> None:
    assert of_each(lambda item: 2 * item, range(40), threads) == list(range(0, 80, 2))
    assert of_each(len, [], threads) == []


def test_items_are_worked_on_at_once_each_by_one_thread() -> None:
    together = threading.Barrier(2, timeout=20)

    def work(item: int) -> tuple[int, int]:
        together.wait()  # passed by two threads together alone
        return item, threading.get_ident()

    found = of_each(work, range(6), 2)
    threads = {thread for _, thread in found}
    assert [item for item, _ in found] == list(range(6)) and len(threads) == 2 and threading.get_ident() in threads


@pytest.mark.parametrize("bad", [0, 1])
def test_an_error_in_any_thread_is_raised(bad: int) -> None:
    together = threading.Barrier(2, timeout=20)

    def work(item: int) -> None:
        together.wait()
        if item == bad:
            raise IndexError(f"item {item}")

    with pytest.raises(IndexError, match=f"^item {bad}$"):
        of_each(work, range(2), 2)
