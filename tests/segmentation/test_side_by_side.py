"""Jobs in threads: so many at a time, in order, with errors in their places."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from functools import partial

import pytest
import torch

from bodyseg_data.core import BadConfig
from bodyseg_model.segmentation.frame_labeller import side_by_side


def test_so_many_jobs_are_done_at_a_time_and_no_more_are_asked_for() -> None:
    begun = [threading.Event() for _ in range(6)]
    asking: set[int] = set()
    working: set[int] = set()

    def job(number: int) -> int:
        working.add(threading.get_ident())
        begun[number].set()
        if number == 0:  # the answer to the first comes last, and is still the first
            assert begun[1].wait(10), "the second is done meanwhile"
        return number

    def jobs() -> Iterator[Callable[[], int]]:
        for number in range(6):
            asking.add(threading.get_ident())
            yield partial(job, number)

    seen = []
    for number in side_by_side(jobs(), 2):
        seen.append(number)
        assert all(event.wait(10) for event in begun[: number + 3]), "the next two are done without being asked for"
        assert not any(event.is_set() for event in begun[number + 3 :])
    assert seen == list(range(6))
    assert len(asking) == 1 and len(working) == 2 and threading.get_ident() not in asking | working
    assert list(side_by_side((), 3)) == []


def test_one_at_a_time_is_done_before_the_next_is_asked_for() -> None:
    said: list[str] = []

    def jobs() -> Iterator[Callable[[], None]]:
        for number in range(2):
            said.append(f"asked {number}")
            yield partial(said.append, f"done {number}")

    for number, _ in enumerate(side_by_side(jobs(), 1)):
        said += [f"taken {number}", threading.current_thread().name]
    assert said == ["asked 0", "done 0", "taken 0", "MainThread", "asked 1", "done 1", "taken 1", "MainThread"]
    with pytest.raises(BadConfig, match="^at_once must be a whole number of at least 1, found 0$"):
        list(side_by_side(jobs(), 0))


def test_a_thread_has_as_many_threads_of_torch_as_its_caller() -> None:
    before = torch.get_num_threads()
    try:
        for number in (3, 1):
            torch.set_num_threads(number)
            other = threading.Thread(target=torch.set_num_threads, args=(2,))  # whose number new threads would take
            other.start()
            other.join()
            assert list(side_by_side([torch.get_num_threads], 2)) == [number]
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("kind", [BadConfig, KeyboardInterrupt])
@pytest.mark.parametrize("asked", [True, False])
def test_an_error_comes_after_the_answers_before_it(asked: bool, kind: type[BaseException]) -> None:
    def fails() -> int:
        raise kind("third")

    def jobs() -> Iterator[Callable[[], int]]:
        yield lambda: 0
        yield lambda: 1
        if asked:
            raise kind("third")
        yield fails
        yield lambda: 3

    seen: list[int] = []
    with pytest.raises(kind, match="^third$"):
        seen.extend(side_by_side(jobs(), 2))
    assert seen == [0, 1]


def test_leaving_early_ends_the_threads() -> None:
    asked = []

    def jobs() -> Iterator[Callable[[], int]]:
        for number in range(9):
            asked.append(number)
            yield lambda number=number: number

    before = threading.active_count()
    coming = side_by_side(jobs(), 2)
    assert next(coming) == 0
    coming.close()
    assert threading.active_count() == before and asked == [0, 1, 2]
